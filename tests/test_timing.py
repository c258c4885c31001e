"""``bayesrace timing``: its extrapolation against laws that are known, and what it measures."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.stats import genpareto

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights, write_weights
from bayesrace.operation.preparation import Prepared
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.operation.training_drives import PreparedTrack
from bayesrace.studies.evidence.timing import study
from bayesrace.studies.evidence.timing.instructions import missing
from bayesrace.studies.evidence.timing.problems import KINDS, Case, Rig, search, work
from bayesrace.studies.evidence.timing.report import print_study, write_study
from bayesrace.studies.evidence.timing.settings import TimingSettings
from bayesrace.studies.evidence.timing.tail import fit_tail
from bayesrace.vehicles import Car
from tests.conftest import Circuit

COUNT, RARE = 600, 1e-6


def drawn(seed: int, shape: float = -0.2) -> Floats:
    """Times that are 1 and an excess by the law, whose tail is of the same law."""
    random = np.random.default_rng(seed)
    return 1 + np.asarray(genpareto.rvs(shape, scale=0.3, size=COUNT, random_state=random))


@pytest.mark.parametrize("shape", [-0.3, -0.1, 0.0])
def test_the_upper_limit_is_above_the_true_level_as_often_as_it_says(shape: float) -> None:
    true, runs = 1 + genpareto.isf(RARE, shape, scale=0.3), 60
    fits = [fit_tail(drawn(seed, shape), RARE, samples=19) for seed in range(runs)]
    assert all(fits)
    covered = sum(fit.upper >= true for fit in fits if fit)
    assert covered >= 0.95 * runs - 4  # two standard deviations and a bit
    assert np.median([fit.level for fit in fits if fit]) == pytest.approx(true, rel=0.25)


def test_the_fit_is_that_of_scipy() -> None:
    values = drawn(3)
    fit = fit_tail(values, RARE)
    assert fit
    y = values[values > fit.threshold] - fit.threshold
    shape, _, scale = genpareto.fit(y, floc=0)
    assert (fit.shape, fit.scale) == pytest.approx((shape, scale), rel=2e-3, abs=2e-3)


def test_stalls_among_the_times_are_flagged() -> None:
    """One in fifty takes longer by a Cauchy-like law: no bounded work does that."""
    flagged = 0
    for seed in range(20):
        random = np.random.default_rng(seed)
        values = drawn(seed)
        late = random.random(COUNT) < 0.02
        values[late] += np.asarray(genpareto.rvs(1.0, size=late.sum(), random_state=random)) * 3
        fit = fit_tail(values, RARE)
        flagged += bool(fit and fit.rejected)
    assert flagged >= 18


def test_too_few_or_equal_times_have_no_tail() -> None:
    assert fit_tail(drawn(0)[:60], RARE) is None
    assert fit_tail(np.repeat([1.0, 2.0, 3.0], 200), RARE) is None


# --- what is measured --------------------------------------------------------------------------


@pytest.fixture
def prepared(
    kinematic_artefact: Path, weights: Weights, circuit: Circuit, tmp_path: Path
) -> Prepared:
    write_weights(tmp_path / "weights.bin", weights)
    one = PreparedTrack(circuit.track, circuit.line, tmp_path / "none", tmp_path / "none")
    return Prepared((one,), None, (), tmp_path / "weights.bin", (kinematic_artefact,))


@pytest.fixture
def rig(prepared: Prepared, car: Car) -> Rig:
    return Rig(TimingSettings(car=car, tracks=("peanut",)), prepared)


def test_the_search_finds_the_same_each_time_and_worse_than_what_is_driven(
    rig: Rig, prepared: Prepared, car: Car
) -> None:
    """All kinds of starts, within the bounds by construction, fall-back times without a step."""
    found = list(search(rig, 10, seed=1))
    again = Rig(TimingSettings(car=car, tracks=("peanut",)), prepared)
    assert {case.kind for case, _ in found} == set(KINDS)
    for (case, rows), (other, others) in zip(found, search(again, 10, 1), strict=True):
        assert case == other
        assert np.array_equal(rows[:, 4:6], others[:, 4:6])
        assert (rows[:, :4] > 0).all()
        assert rows[:, 4].max() <= rig.most_iterations
        assert rows[:, 5].max() <= rig.most_qp_steps
    worst = max(work(rows) for _, rows in found)
    drawn_alone = max(work(rows) for _, rows in found[:10])
    assert worst >= drawn_alone >= 3 * work(rig.drive(0, 60)[5:])


def test_a_start_is_where_its_kind_says(rig: Rig, circuit: Circuit, car: Car) -> None:
    for kind, (low, high) in KINDS.items():
        middle = tuple(0.5 * (a + b) for a, b in zip(low, high, strict=True))
        x, y, _, vx, *_, delta = rig._start(Case(kind, 0, middle))
        assert circuit.track.project_points([[x, y]]).off_track_m[0] < 0
        assert 0 <= vx <= circuit.line.vx_mps.max()
        assert abs(delta) <= car.delta_max_rad


@pytest.mark.check  # half a minute
@pytest.mark.skipif(bool(missing()), reason=missing())
def test_instructions_are_counted_the_same_each_time_and_grow_with_the_work(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A launch takes more to answer than a step soon after it; half the points take fewer.

    Counts of a launch have differed by 6e-5 once.
    """
    estimate, feedback, prepare = rig.count_recorded(4).T
    again = rig.count_recorded(4)[:, 1]
    assert again[0] == pytest.approx(feedback[0], rel=2e-4)
    assert again[1:] == pytest.approx(feedback[1:], rel=1e-5)
    assert feedback[0] > 2 * feedback[3] > 20 * estimate[3] > 0
    first, second, third = (
        replace(one, inputs=one.inputs[::2], alpha=one.alpha[::2]) for one in rig._weights.outputs
    )
    half = replace(rig._weights, outputs=(first, second, third))
    monkeypatch.setattr(rig, "_weights", half)
    assert rig.count_recorded(4)[:, 2].sum() < 0.85 * prepare.sum()


@pytest.mark.parametrize(("at_most_ms", "code"), [(1e6, 0), (1e-6, 1)])
def test_the_verdict_is_by_the_limit_and_files_are_left(
    prepared: Prepared, car: Car, monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
    at_most_ms: float, code: int,
) -> None:  # fmt: skip
    monkeypatch.setattr(study, "prepare", lambda *_, **__: prepared)
    settings = TimingSettings(
        car=car, tracks=("peanut",), problems=900, cases=5, count=0, at_most_ms=at_most_ms
    )
    console = Console(file=(tmp_path / "text").open("w"), width=120)
    done = study.run_timing(settings, (), Stages(console, None))
    print_study(done, console)
    write_study(done, tmp_path)
    assert done.verdict.exit_code == code
    failing = {one.subject for one in done.verdict.checks if not one.passed}
    assert failing == ({"answer", "prepare", "fallback"} if code else set())
    content = json.loads((tmp_path / "timing.json").read_text())
    assert content["cycles"] == {"recorded": 900, "adversarial": 100}
    assert [one["bound"] for one in content["hardest"]][:2] == [90, 6000]
    assert content["statement"] in " ".join((tmp_path / "text").read_text().split())
    assert (tmp_path / "timing.png").stat().st_size > 10_000
    assert len(np.load(tmp_path / "times.npz")["recorded answer"]) == 900


def test_a_log_without_states_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no log"):
        study.run_timing(
            TimingSettings(tracks=("harbour",)), [tmp_path / "no.mcap"], Stages(Console(), None)
        )
