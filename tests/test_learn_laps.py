"""Laps and samples as the learning job makes them of messages: the same as from the log."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec.structs import replace

from bayesrace.learning.dataset import Dataset
from bayesrace.messages import Actuation, State
from bayesrace.operation.learn import collector
from bayesrace.operation.learn.collector import Collector, Stretch
from bayesrace.tracks import Track
from bayesrace.vehicles.models import dynamic
from tests.driven import CAR, STEP_S, blank, dataset_of, drive, logged, state, telemetry


@pytest.fixture(scope="module")
def states() -> list[State]:
    """A drive of 200 periods in which the plant counts a lap at the 61st and at the 161st."""
    messages = logged(drive(dynamic(CAR), 200, seed=4), run=7)
    return [replace(one, lap=(one.seq >= 61) + (one.seq >= 161)) for one in messages]


def fed(
    states: list[State],
    fallbacks: tuple[int, ...] = (),
    track: Track | None = None,
    every_s: float | None = None,
) -> tuple[list[Stretch], list[Stretch]]:
    """What is given out as it arrives, and at the end."""
    made, taken = Collector(CAR, STEP_S, track, every_s), []
    for one in states:
        made.state(one)
        version = f"v{one.seq // 100}"
        made.actuation(blank(Actuation, run=one.run, state_seq=one.seq, weights_version=version))
        made.telemetry(telemetry(one.run, one.seq, int(one.seq in fallbacks)))
        taken += made.take()
    return taken, made.take(at_once=True)


def samples(driven: list[Stretch]) -> Dataset:
    sets = [one.samples for one in driven if one.samples is not None]
    rows = [np.hstack((one.x, one.u, one.x_next)) for one in sets]
    every = np.vstack(rows)
    return Dataset(CAR, STEP_S, every[:, :7], every[:, 7:9], every[:, 9:])


def test_samples_are_those_of_the_log(states: list[State]) -> None:
    """Each pair once, over the ends of laps too; fallback cycles and gaps are left out."""
    lossy = [one for one in states if one.seq not in (30, 31, 120)]
    fallbacks = (10, 60, 61, 199)
    taken, rest = fed(lossy, fallbacks)
    log = dataset_of(lossy, [telemetry(7, k, 1) for k in fallbacks])
    got = samples(taken + rest)
    np.testing.assert_array_equal(got.x, log.x)
    np.testing.assert_array_equal(got.u, log.u)
    np.testing.assert_array_equal(got.x_next, log.x_next)


def test_laps_are_timed_from_crossing_to_crossing(states: list[State]) -> None:
    taken, rest = fed(states, (10, 60, 61, 62))
    laps = [one.lap for one in taken]
    assert [one.lap for one in rest] == [None]
    assert laps[0] is not None
    assert laps[1] is not None
    assert (laps[0].run, laps[0].flying, laps[1].flying) == (7, False, True)
    assert laps[0].time_s == pytest.approx(61 * STEP_S)
    assert laps[1].time_s == pytest.approx(100 * STEP_S)
    assert (laps[0].fallbacks, laps[1].fallbacks) == (2, 2)
    assert laps[0].versions == ["v0"]
    assert laps[1].versions == ["v0", "v1"]


SPEED = 1.5


def circled(count: int, late_s: float = 0.0) -> tuple[Track, list[State]]:
    """A car on a circle of 1 m, whose plant counts laps so late."""
    angle = 2 * np.pi * np.arange(128) / 128
    track = Track.from_points("circle", np.column_stack([np.cos(angle), np.sin(angle)]), 0.2, 0.2)
    at = SPEED * STEP_S * np.arange(count) + 1e-6
    x = np.zeros((count, 7))
    x[:, 0], x[:, 1], x[:, 2], x[:, 3] = np.cos(at), np.sin(at), at + np.pi / 2, SPEED
    lap = np.maximum(np.floor((at - SPEED * late_s) / (2 * np.pi)), 0).astype(int)
    return track, [state(0, k, x[k], np.zeros(2), lap=int(lap[k])) for k in range(count)]


@pytest.mark.parametrize("late_s", [0.0, 0.05])
def test_estimated_crossings_are_interpolated(late_s: float) -> None:
    """By the estimates in the telemetry; a run's last state, at the line too, has none."""
    track, exact = circled(450, late_s)
    made, taken = Collector(CAR, STEP_S, track), []
    for one in exact[: [one.lap for one in exact].index(2) + 1]:
        final = one.lap == 2
        made.state(replace(one, x=(0.0,) * 7, estimated=True, final=final))
        taken += made.take()
        known = {"estimate": (*one.x, 0.0, 0.0), "deviation": (1e-3,) * 9}
        if not final:
            made.telemetry(telemetry(0, one.seq, 0, **known))
    laps = [one.lap for one in taken + made.take(at_once=True)]
    times = [lap.time_s for lap in laps if lap is not None]
    assert times == pytest.approx([2 * np.pi / SPEED] * 2, abs=1e-3)


def test_with_the_track_crossings_are_interpolated() -> None:
    """A car at 1.5 m/s on a circle crosses the line between two samples, as geometry says."""
    track, states = circled(450)
    taken, _ = fed(states, track=track)
    times = [one.lap.time_s for one in taken if one.lap is not None]
    assert times == pytest.approx([2 * np.pi / SPEED] * 2, abs=2e-3)
    assert all(one.lap is not None and one.lap.off_track_m == 0.0 for one in taken)
    far = [replace(one, x=(1.3 * one.x[0], 1.3 * one.x[1], *one.x[2:])) for one in states]
    taken, _ = fed(far, track=track)
    assert taken[0].lap is not None
    assert taken[0].lap.off_track_m == pytest.approx(0.1, abs=1e-3)


def test_who_comes_late_times_the_next_lap(states: list[State]) -> None:
    taken, _ = fed([one for one in states if one.seq >= 20])
    assert [one.lap and one.lap.time_s for one in taken] == [None, pytest.approx(100 * STEP_S)]


def test_a_lap_whose_end_was_lost_has_no_time(states: list[State]) -> None:
    taken, _ = fed([one for one in states if not 55 <= one.seq < 70])
    assert [one.lap and one.lap.time_s for one in taken] == [None, None]


def test_another_plant_with_the_same_run_is_another_run(states: list[State]) -> None:
    """Its numbers begin anew, and no pair reaches over."""
    first, second = states[:100], [replace(one, epoch=2) for one in states[:50]]
    taken, rest = fed(first + second)
    assert len(samples(taken + rest)) == 99 + 49


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Advances the collector's clock."""
    now = [0.0]
    monkeypatch.setattr(collector, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def advance(by_s: float) -> None:
        now[0] += by_s

    return advance


def test_a_lap_waits_for_the_telemetry_of_its_last_cycle_however_long_the_host_stalls(
    states: list[State], clock: Callable[[float], None]
) -> None:
    made = Collector(CAR, STEP_S)
    for one in states[:70]:
        made.state(one)
    clock(60.0)  # the telemetry waits to be read
    assert made.take() == []
    made.telemetry(telemetry(7, 59, 0))
    assert made.take() == []
    made.telemetry(telemetry(7, 60, 1))
    (stretch,) = made.take()
    assert stretch.lap is not None
    assert stretch.lap.fallbacks == 1


def test_a_lap_whose_telemetry_was_dropped_is_given_out_after_a_while(
    states: list[State], clock: Callable[[float], None]
) -> None:
    made, calls = Collector(CAR, STEP_S), 0
    for one in states[:70]:
        made.state(one)
    while not (taken := made.take()):
        clock(0.1)
        calls += 1
    assert calls == pytest.approx(10 * collector._PATIENCE_S, abs=1)
    assert taken[0].lap is not None
    for one in states[70:]:
        made.state(one)
    made.telemetry(telemetry(7, 165, 0))  # of a later cycle: the others were dropped
    assert len(made.take()) == 1


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda one: replace(one, x=(*one.x[:3], 0.0, *one.x[4:])), "bayesrace status"),
        (lambda one: replace(one, x=(*one.x[:6], 0.5)), "--car"),
        (lambda one: replace(one, u_applied=(0.1, 0.0)), "the FMU's map"),
        (lambda one: replace(one, seq=2 * one.seq), "lose messages"),
        (lambda one: one, ""),
    ],
    ids=["standstill", "another car", "steering", "gaps", "good"],
)
def test_each_cause_of_nothing_to_learn_from_has_its_remedy(
    states: list[State], spoil: Callable[[State], State], words: str
) -> None:
    _, (stretch,) = fed([spoil(one) for one in states[:60]])
    assert words in stretch.why_not
    assert bool(words) == bool(stretch.why_not)
    _, (stretch,) = fed(states[:60], tuple(range(60)))
    assert "the fallback drove" in stretch.why_not


def test_memory_does_not_follow_a_car_that_stands(
    states: list[State], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stretches are cut, no sample is lost by it, and the lap keeps its time."""
    monkeypatch.setattr(collector, "MOST_STATES", 25)
    taken, rest = fed(states)
    sizes = [len(one.samples) for one in taken + rest if one.samples is not None]
    assert max(sizes) <= 25
    assert sum(sizes) == 200
    times = [one.lap.time_s for one in taken if one.lap is not None]
    assert times == pytest.approx([61 * STEP_S, 100 * STEP_S])


def test_stretches_of_some_seconds_make_the_same_laps(states: list[State]) -> None:
    """No sample, fallback or version of a lap is lost, and laps have the same times."""
    fallbacks = (10, 60, 61, 62, 130)
    (whole, rest), (taken, left) = fed(states, fallbacks), fed(states, fallbacks, every_s=0.5)
    assert len(taken) > len(whole) + 4
    assert all(len(one.states) <= 26 for one in taken + left)
    np.testing.assert_array_equal(samples(taken + left).x, samples(whole + rest).x)
    laps = [[one.lap for one in some if one.lap is not None] for some in (whole, taken)]
    assert laps[0] == laps[1]
    assert (laps[0][1].fallbacks, laps[0][1].versions) == (3, ["v0", "v1"])
    assert laps[0][1].samples + sum(laps[0][1].left_out.values()) == 100
