"""``train`` and ``validate`` from the command line, the horizon's mismatch, tables and pictures."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.gp.expression import corrected_function
from bayesrace.gp.weights import OUTPUTS, Weights, read_weights, write_weights, zero_weights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.sources import write_npz
from bayesrace.learning.training import train
from bayesrace.learning.validation import identity, mismatch, unbroken, validate
from bayesrace.operation.analysis.validation import ValidationResult, validate_weights
from bayesrace.operation.terminal.tables import print_validation
from bayesrace.vehicles.models import dynamic, e_kinematic
from tests.command_line import Cli, refused
from tests.driven import CAR, QUICK, STEP_S, drive, write_log


@pytest.fixture(scope="module")
def driven() -> Dataset:
    return drive(dynamic(CAR), 160, seed=1)


@pytest.fixture(scope="module")
def fresh() -> Dataset:
    return drive(dynamic(CAR), 90, seed=2)


@pytest.fixture(scope="module")
def weights(driven: Dataset) -> Weights:
    return train(driven, PREDICTION, QUICK)


@pytest.fixture
def files(tmp_path: Path, weights: Weights, driven: Dataset, fresh: Dataset) -> Path:
    """A folder with weights.bin, driven.mcap and fresh.npz."""
    write_weights(tmp_path / "weights.bin", weights)
    write_log(tmp_path / "driven.mcap", driven)
    write_npz(tmp_path / "fresh.npz", fresh)
    return tmp_path


# Horizon -----------------------------------------------------------------------------------------


def test_a_horizon_starts_only_where_the_drive_is_unbroken(driven: Dataset) -> None:
    count = len(driven)
    assert list(unbroken(driven, 1)) == list(range(count))
    assert list(unbroken(driven, 20)) == list(range(count - 19))
    assert len(unbroken(driven, count)) == 1
    assert len(unbroken(driven, count + 1)) == 0
    torn = driven.select(np.arange(count) != 50)
    starts = unbroken(torn, 20)
    assert not set(starts) & set(range(31, 50))
    assert {30, 50} <= set(starts)
    two = concatenate([driven, drive(dynamic(CAR), 30, seed=9)])
    assert len(unbroken(two, 20)) == count - 19 + 30 - 19


def test_the_model_that_drove_has_no_mismatch() -> None:
    data = drive(e_kinematic(CAR), 60, seed=0, substeps=PREDICTION.substeps)
    integrated = Discretisation(scheme="rk4", step_s=STEP_S, substeps=PREDICTION.substeps)
    found = mismatch(data, integrated, None)
    assert len(found) == 41
    assert np.abs(found).max() < 1e-12


def test_mismatch_is_the_open_loop_prediction_of_the_corrected_map(
    weights: Weights, fresh: Dataset
) -> None:
    step = corrected_function(e_kinematic(CAR), PREDICTION, weights)
    found, start = mismatch(fresh, PREDICTION, weights, 20), 7
    x = fresh.x[start]
    for u in fresh.u[start : start + 20]:
        x = np.asarray(step(x, u))[:, 0]
    assert found[start] == pytest.approx(fresh.x_next[start + 19] - x, abs=1e-11)


def test_one_step_mismatch_of_the_velocities_is_the_residual(
    weights: Weights, fresh: Dataset
) -> None:
    checked = validate(weights, fresh, PREDICTION)
    plain, corrected = (mismatch(fresh, PREDICTION, w, 1) for w in (None, weights))
    assert plain[:, 3:6] == pytest.approx(checked.residual, abs=1e-11)
    assert corrected[:, 3:6] == pytest.approx(checked.error, abs=1e-11)


def test_mismatch_of_other_weights_is_refused(fresh: Dataset) -> None:
    with pytest.raises(InputError, match="another"):
        mismatch(fresh, PREDICTION, zero_weights("orca", "another model"))


# validate ----------------------------------------------------------------------------------------


def test_validate_writes_what_it_prints(
    files: Path, cli: Cli, fresh: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    arguments = ("--on", "fresh.npz", "--json", "v.json", "--out", "all")
    said = cli("validate", "weights.bin", *arguments).out
    assert "…" not in said
    assert max(map(len, said.splitlines())) <= 80
    content = json.loads((files / "v.json").read_text())
    result = ValidationResult.model_validate(content)
    checked = validate(read_weights(files / "weights.bin"), fresh, PREDICTION)
    for output in OUTPUTS:
        assert content[output] == pytest.approx(dict(checked.metrics[output]), rel=1e-6)
        assert {"rmse", "r2", "coverage", "log_density"} <= set(content[output])
        assert f"{content[output]['rmse']:.3g}" in said
    assert (result.samples, result.learned_from) == (len(fresh), False)
    assert result.one_step is not None
    assert result.horizon is not None
    assert (result.one_step.predictions, result.horizon.predictions) == (90, 71)
    drift = result.horizon
    assert drift.corrected["position_m"].max < 0.3 * drift.nominal["position_m"].max
    for picture in ("all/error.png", "all/track.png"):
        assert (files / picture).read_bytes().startswith(b"\x89PNG")
    assert (files / "all/validation.json").read_text() == (files / "v.json").read_text()


def test_validate_says_when_the_samples_were_learned_from(files: Path, cli: Cli) -> None:
    assert "learned from" in cli("validate", "weights.bin", "--on", "driven.mcap").out


def test_weights_are_judged_by_the_discretisation_that_they_were_learned_with(
    tmp_path: Path, fresh: Dataset
) -> None:
    euler = Discretisation(scheme="euler", step_s=STEP_S)
    write_npz(tmp_path / "fresh.npz", fresh)
    judged = validate_weights(
        zero_weights("orca", identity(fresh, euler)), [tmp_path / "fresh.npz"]
    )
    usual = validate(zero_weights("orca", identity(fresh, PREDICTION)), fresh, PREDICTION)
    assert judged.result.vy.rmse != pytest.approx(usual.metrics["vy"]["rmse"], rel=1e-3)


def test_a_drive_shorter_than_the_horizon_has_no_horizon(
    tmp_path: Path, weights: Weights, fresh: Dataset
) -> None:
    write_npz(tmp_path / "short.npz", fresh.select(slice(12)))
    result = validate_weights(weights, [tmp_path / "short.npz"]).result
    assert result.horizon is None
    text = io.StringIO()
    print_validation(result, Console(file=text, width=80))
    assert "no stretch is long enough" in text.getvalue()


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"alpha": 1e300}, "not finite"),
        ({"alpha": 1e150}, "not finite"),
        ({"noise_variance": 0.0}, "singular"),
    ],
)
def test_weights_that_predict_nothing_finite_are_refused(
    files: Path, weights: Weights, driven: Dataset, change: dict[str, float], fault: str
) -> None:
    """Numbers that JSON does not have: huge corrections, or certainty where a sample was."""
    vx, vy, omega = (
        replace(
            output,
            **{name: value * np.sign(getattr(output, name)) for name, value in change.items()},
        )
        for output in weights.outputs
    )
    bad = replace(weights, outputs=(vx, vy, omega))
    with pytest.raises(InputError, match=fault):
        validate_weights(bad, [files / "driven.mcap"])


# train -------------------------------------------------------------------------------------------


def test_train_chooses_the_kernel_and_prints_why(
    files: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    arguments = ("--data", "fresh.npz", "--restarts", "0", "--points", "60")
    said = cli("train", "driven.mcap", *arguments, "--out", "new.bin").out
    assert "…" not in said.replace("residual …", "")
    assert max(map(len, said.splitlines())) <= 80
    assert said.count("✓") == 3
    for word in ("matern05", "matern15", "matern25", "rbf", "250 samples"):
        assert word in said
    weights = read_weights(files / "new.bin")
    assert weights.counts == (60, 60, 60)
    assert weights.version in said
    assert cli("validate", "new.bin", "--on", "fresh.npz").code == 0


def test_train_takes_one_kernel(files: Path, cli: Cli) -> None:
    arguments = ("--kernel", "matern15", "--restarts", "0")
    assert cli("train", "--data", "fresh.npz", *arguments).code == 0
    assert set(read_weights(files / "weights.bin").kernels) == {"matern15"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("validate missing.bin --on fresh.npz", "missing.bin"),
        ("validate fresh.npz --on fresh.npz", "weights file"),
        ("validate weights.bin --on missing.mcap", "missing.mcap"),
        ("validate weights.bin --on weights.bin", "MCAP"),
        ("validate weights.bin --on driven.mcap --run 7", "driven"),
        ("validate weights.bin --on fresh.npz --track nowhere", "nowhere"),
        ("validate weights.bin --on fresh.npz --json no/where.json", "where.json"),
        ("validate weights.bin", "--on"),
        ("validate foreign.bin --on fresh.npz", "names no discretised model"),
        ("validate weights.bin --on still.npz", "standstill"),
        ("train", "at least one log"),
        ("train driven.mcap --kernel cubic", "cubic"),
        ("train driven.mcap --points 5000", "4096"),
        ("train driven.mcap driven.mcap", "same samples"),
        ("train driven.mcap --car lorry", "lorry"),
        ("train driven.mcap --artefact nowhere", "bayesrace build"),
        ("train --data short.npz", "at least 20"),
        ("train --data constant.npz", "d is 0.5 in every sample"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    files: Path, cli: Cli, fresh: Dataset, arguments: str, words: str
) -> None:
    write_weights(files / "foreign.bin", zero_weights("orca", "another model"))
    still = replace(fresh, x=fresh.x * [1, 1, 1, 0, 1, 1, 1])
    constant = replace(fresh, u=fresh.u * [0, 1] + [0.5, 0])
    short = fresh.select(slice(10))
    for name, data in {"still": still, "short": short, "constant": constant}.items():
        write_npz(files / f"{name}.npz", data)
    refused(cli(*arguments.split()), words)
