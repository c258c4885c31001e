"""``bayesrace paper``: verdicts follow from numbers, nothing is made twice, the page is whole."""

import json
import re
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from rich.progress import TaskID

from bayesrace.errors import InputError
from bayesrace.integrators import PREDICTION
from bayesrace.learning.gaussian_process import PairDistances, maximise, starts
from bayesrace.learning.validation import residual
from bayesrace.operation.settings import RaceSettings
from bayesrace.operation.terminal.terminal import Stage, stages_on
from bayesrace.studies.paper import make
from bayesrace.studies.paper import models as learning
from bayesrace.studies.paper.experiment import Experiment, Finding, at_most
from bayesrace.studies.paper.loop import line_section, published_line, tenth_section
from bayesrace.studies.paper.models import gains, kernel_section, model_section, smoothness
from bayesrace.studies.settings import DRIVES, PaperSettings
from bayesrace.vehicles import Car, builtin_cars, get_car, parameters
from bayesrace.vehicles.models import dynamic
from bayesrace.vehicles.tuning import PursuitTuning
from tests.command_line import Cli, refused
from tests.conftest import Circuit
from tests.driven import CAR, drive
from tests.programs import peanut
from tests.reference import reference_file

QUIET = Stage(None, TaskID(0))


# Verdicts ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ours", "word"), [(0.9, "agrees"), (1.0, "agrees"), (1.1, "differs"), (np.nan, "differs")]
)
def test_a_verdict_follows_from_the_numbers(ours: float, word: str) -> None:
    found = at_most("RMSE", 1.0, ours, "m/s", "the track is another one")
    assert found.verdict == word
    assert found.sentence.startswith("Agrees: " if word == "agrees" else "Differs: ")
    assert ("another one" in found.sentence) == (word == "differs")
    assert found.criterion in found.sentence


def test_without_anything_to_compare_with_the_sentence_says_why() -> None:
    found = Finding("lap", "7.797 s", "6.972 s", "ours is shorter", None, "another track")
    assert (found.verdict, found.sentence) == ("not compared", "Not compared: another track.")


def test_an_update_that_has_little_left_to_gain_says_so() -> None:
    """Published: 0.08, 0.02, 0.001."""
    for first, reason in ((0.01, "has left less error"), (0.03, "visits fewer states")):
        correction, update = gains("vy", (0.08, 0.02, 0.001), (0.08, first, 0.005))
        assert correction.holds
        assert update.sentence.startswith("Differs")
        assert reason in update.sentence


def test_the_models_diverge_as_in_the_paper() -> None:
    section = model_section(CAR)
    assert [one.holds for one in section.findings] == [True, True]


# Kernels -------------------------------------------------------------------------------------


def test_an_isotropic_kernel_has_one_length_scale_and_less_likelihood() -> None:
    data = drive(dynamic(CAR), 80, seed=1)
    z = data.features / data.features.std(axis=0)
    y = residual(data, PREDICTION)[:, 0]
    y = (y - y.mean()) / y.std()
    (start,) = starts(0, 0)
    pairs = PairDistances(z)
    one, six = (maximise("rbf", pairs, y, start, 60, isotropic=flag) for flag in (True, False))
    assert np.ptp(one.covariance.lengths) == 0
    assert np.ptp(six.covariance.lengths) > 0
    assert one.log_likelihood < six.log_likelihood


def test_what_was_computed_before_an_interruption_is_not_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BAYESRACE_CACHE", str(tmp_path))
    training, test = drive(dynamic(CAR), 60, seed=1), drive(dynamic(CAR), 40, seed=2)
    computed: list[tuple[str, bool]] = []

    def errors(kind: str, isotropic: bool, *_: object) -> object:
        if len(computed) == 3:
            raise KeyboardInterrupt
        computed.append((kind, isotropic))
        return [0.1 * len(computed)] * 6

    monkeypatch.setattr(learning, "_errors", errors)
    with pytest.raises(KeyboardInterrupt):
        smoothness("our", training, test, 30, 2, QUIET)
    before, computed[:] = [*computed], []
    monkeypatch.setattr(learning, "_errors", lambda *_: [1.0] * 6)
    found = smoothness("our", training, test, 30, 2, QUIET)
    assert len(before) == 3
    assert found.rmse.shape == (2, 4, 2, 3)
    assert found.rmse[0, :, 0, 0] == pytest.approx([0.1, 0.2, 0.3, 1.0])
    verdicts = [one.verdict for one in kernel_section([found], 30).findings]
    assert verdicts == ["differs"] * 3


# Input ---------------------------------------------------------------------------------------


def test_a_folder_without_the_files_is_refused(cli: Cli, tmp_path: Path) -> None:
    refused(cli("paper", "--tracks", tmp_path), "ethz.csv", "ethzmobil.csv", str(tmp_path))
    refused(cli("paper", "--data", tmp_path / "none"), *DRIVES, "docs/paper.md")
    with pytest.raises(InputError, match=re.escape(DRIVES[0])):
        _ = PaperSettings(data=tmp_path).drives


def test_the_tenth_car_takes_the_papers_track_where_there_is_one(tmp_path: Path) -> None:
    for name in ("ethz", "ethzmobil"):
        peanut(tmp_path / f"{name}.csv")
    assert PaperSettings(tracks=tmp_path).tenth.track == "workshop"
    (tmp_path / "f110_map2.csv").touch()
    settings = PaperSettings(tracks=tmp_path).tenth
    assert settings.train_track == settings.track == str(tmp_path / "f110_map2.csv")
    assert settings.driven_car.friction == 1.0


# What is frozen ------------------------------------------------------------------------------


@pytest.mark.parametrize("car", ["orca", "f1tenth"])
def test_every_setting_is_frozen(car: str) -> None:
    frozen = json.loads(Path(make.__file__).with_name(f"{car}.json").read_text())
    assert RaceSettings.model_validate(frozen).model_dump(mode="json") == frozen


def test_a_cars_tuning_may_change_and_what_is_published_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In the car's file and in the defaults of all cars."""
    before = PaperSettings().orca, PaperSettings().tenth
    monkeypatch.setattr(
        PursuitTuning.model_fields["slower"], "json_schema_extra", {"reference": 0.9}
    )
    cars = {
        name: Car.model_validate(one.model_dump(exclude={"tuning"}))
        for name, one in builtin_cars().items()
    }
    monkeypatch.setattr(parameters, "builtin_cars", lambda: cars)
    assert get_car("f1tenth").tuning.pursuit.slower == 0.9
    assert (PaperSettings().orca, PaperSettings().tenth) == before


@pytest.mark.check
@pytest.mark.parametrize("seed", range(3))
def test_the_small_car_laps_as_the_paper_says(seed: int) -> None:
    """Appendix B, on its own track: with correction, and not without."""
    tracks = reference_file("tracks/f110_map2.csv").parent
    with stages_on(Console(quiet=True)) as stages:
        one = Experiment(PaperSettings(tracks=tracks, seed=seed).tenth, stages, ("e_kinematic",))
        verdicts = [found.verdict for found in tenth_section(one).findings]
    assert verdicts == ["agrees", "agrees", "differs"]


# The published line --------------------------------------------------------------------------


def published_file(path: Path, circuit: Circuit) -> Path:
    """A lap from standstill and 1 m more, faster, in the published form; the first again is left
    out of the track by 1 cm, as a line that was not closed is."""
    line = circuit.line
    more = int(np.searchsorted(line.s_m, 1.0))
    first = np.column_stack([line.s_m, line.xy_m, np.minimum(line.vx_mps, 4 * line.s_m)])
    again = np.column_stack([line.s_m + line.length_m, line.xy_m, line.vx_mps])[:more]
    again[:, 1:3] *= 1.01
    rows = np.concatenate([first, again])
    np.savetxt(path, np.column_stack([rows, rows[:, 0]]), delimiter=",", header="s,x,y,v,t")
    return path


def test_a_published_line_is_closed_and_at_speed_from_its_start(
    circuit: Circuit, tmp_path: Path
) -> None:
    file = published_file(tmp_path / "published.csv", circuit)
    line = published_line(file, circuit.track, CAR)
    off_m = np.linalg.norm(line.xy_m[:, None] - circuit.line.xy_m, axis=2).min(axis=1)
    assert off_m.max() < 0.02
    assert line.length_m == pytest.approx(circuit.line.length_m, rel=1e-3)
    there = np.interp(line.s_m, circuit.line.s_m, circuit.line.vx_mps)
    assert line.vx_mps == pytest.approx(there, rel=0.05)


@pytest.mark.check
def test_on_the_papers_line_our_laps_take_as_long_as_the_published_ones() -> None:
    file = reference_file("tracks/ethz_published_raceline.csv")
    with stages_on(Console(quiet=True)) as stages:
        one = Experiment(PaperSettings(tracks=file.parent).orca, stages)
    weights = {"bayesrace": one.weights, "bestcase": None}
    pairs = product(weights, (True, False))
    laps = {(name, on): one.drive(name, weights[name], on) for name, on in pairs}
    section = line_section(one, published_line(file, one.track, one.car), laps)
    assert [found.verdict for found in section.findings] == ["agrees"] * 4


# The page ------------------------------------------------------------------------------------


@pytest.mark.check
def test_the_quick_page_is_whole(cli: Cli, circuit: Circuit, tmp_path: Path) -> None:
    for name in ("ethz", "ethzmobil"):
        peanut(tmp_path / f"{name}.csv")
    published_file(tmp_path / "ethz_published_raceline.csv", circuit)
    out = tmp_path / "out"
    made = cli("paper", "--quick", "--tracks", tmp_path, "--out", out)
    assert made.code == 0, made.err
    page, findings = (
        (out / "paper.html").read_text(),
        json.loads((out / "numbers.json").read_text()),
    )
    for one in findings:
        assert (one["verdict"] == "not compared") == (one["holds"] is None)
        assert one["reason"] or one["holds"] is not None
        assert f"{one['verdict']}: {one['what']}" in made.out
    drawn = [sorted(path.stem for path in out.glob(f"figures/*.{kind}")) for kind in ("svg", "pdf")]
    assert drawn[0] == drawn[1]
    assert page.count("<svg") == len(drawn[0]) >= 20
    assert page.count('<td class="who">') == len(findings) >= 30
