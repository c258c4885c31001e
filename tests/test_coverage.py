"""What of a racing line was driven before, and practice until enough of it was."""

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import compiled_controller
from bayesrace.gp.weights import read_weights
from bayesrace.learning.coverage import NEAR, Coverage, asked, coverage
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.preparation import Prepared, prepare
from bayesrace.operation.report.coverage import coverage_figures
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.operation.training_drives import LARGER, PreparedTrack, larger_course
from bayesrace.raceline import RaceLine, RaceLineSettings, read_raceline
from bayesrace.raceline.friction import timed_line
from bayesrace.tracks import Track, load_track, write_track
from bayesrace.tracks.spline import fit_arc_length
from bayesrace.vehicles import Car, get_car
from tests.conftest import offset_line


@pytest.fixture
def on(tmp_path: Path) -> PreparedTrack:
    track = load_track("random:3")
    return PreparedTrack(track, offset_line(track, 0.0, 5.0, 2.0), tmp_path, tmp_path)


def driving(line: RaceLine) -> Floats:
    """States of a car that drives the line without slip."""
    x = np.zeros((len(line.s_m), 7))
    x[:, 3], x[:, 5] = line.vx_mps, line.vx_mps * line.kappa_radpm
    return x


def test_a_place_counts_where_a_sample_is_near_in_speed_and_in_acceleration(
    on: PreparedTrack,
) -> None:
    line = on.line
    assert coverage([line], driving(line)).share == 1
    assert "slowly" not in str(coverage([line], driving(line)))
    assert coverage([line], np.zeros((0, 7))).share == 0
    slow = driving(line)[line.vx_mps < 1.5]
    known = coverage([line], slow)
    step = np.diff(np.append(line.s_m, line.length_m))
    duration = 2 * step / (line.vx_mps + np.roll(line.vx_mps, -1))
    fast = line.vx_mps > 1.5 + NEAR[0] * line.vx_mps.max()
    slower = line.vx_mps < 1.5
    assert not known.near[fast].any()
    assert known.near[slower].all()
    assert duration[slower].sum() <= known.share * duration.sum() <= duration[~fast].sum()
    assert f"to {line.vx_mps.max():.2f} m/s" in str(known)
    straight = driving(line)
    straight[:, 5] = 0  # at the speeds of the lap, and never in a bend
    bends = np.abs(asked([line])[:, 1]) > NEAR[1] * asked([line])[:, 1].max()
    assert not coverage([line], straight).near[bends].any()


def test_the_left_and_the_right_count_as_one_and_lines_by_their_time(on: PreparedTrack) -> None:
    x = driving(on.line) * [1, 1, 1, 1, 1, -1, 1]
    assert coverage([on.line], x).share == 1
    faster = offset_line(load_track("random:4"), 0.0, 5.0, 3.0)
    both, alone = coverage([on.line, faster], x).share, coverage([faster], x).share
    assert alone < both < 1


def test_the_report_shows_where_the_line_asks_for_what_was_not_driven(on: PreparedTrack) -> None:
    track, line = on.track, on.line
    fast, slow = coverage([line], driving(line)), coverage([line], driving(line)[:30])
    assert len(coverage_figures(fast, track, line)) == 1
    _, where = coverage_figures(slow, track, line)
    (marked,) = (one for one in where.axes[0].lines if one.get_label() == "not driven before")
    shown: Floats = np.array(marked.get_xydata(), dtype=np.float64)
    np.testing.assert_allclose(shown, line.xy_m[~slow.near])


def test_the_smallest_larger_copy_that_has_what_is_missing_is_chosen(
    on: PreparedTrack, car: Car, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("BAYESRACE_CACHE", str(tmp_path / "cache"))
    settings, here, sizes = RaceLineSettings(), driving(on.line), list[float]()
    for times in (2.0, 4.0):  # a race on the same track, so many times as large
        wanted = coverage([larger_line(on, times, car)], here)
        found = larger_course(on, 1.0, wanted, car, settings)
        assert found is not None
        size, course = found

        def missing(copy: float, wanted: Coverage = wanted) -> float:
            return 1 - wanted.with_samples(asked([larger_line(on, copy, car)])).share

        enough = max(0.1 * (1 - wanted.share), 0.02)
        assert missing(size) <= enough < min([1, *(missing(o) for o in LARGER if o < size)])
        assert course.track.length_m == pytest.approx(size * on.track.length_m, rel=1e-3)
        assert course.track.widths(0.0)[0] == pytest.approx(size * on.track.widths(0.0)[0])
        assert load_track(course.track_file).length_m == pytest.approx(course.track.length_m)
        assert read_raceline(course.line_file).vx_mps == pytest.approx(course.line.vx_mps)
        sizes.append(size)
    assert sizes[1] > sizes[0]
    assert larger_course(on, LARGER[-1], wanted, car, settings) is None
    never = coverage([offset_line(on.track, 0.0, 50.0, 20.0)], here)
    assert larger_course(on, 1.0, never, car, settings) is None  # no copy is so fast


def larger_line(on: PreparedTrack, size: float, car: Car) -> RaceLine:
    """The line on a copy of that size, as fast as the car can."""
    path = fit_arc_length(size * on.line.xy_m)
    return timed_line("larger", path, car, RaceLineSettings())


def large_race(folder: Path, practice_until: float) -> Prepared:
    """For a race of ``f1tenth`` on ``random10:3``, four times as large: 15 m/s."""
    track = load_track("random10:3")
    centre, half = 4 * np.column_stack([track.x_m, track.y_m]), 4 * track.width_left_m
    write_track(folder / "large.csv", Track.from_points("large", centre, half, half))
    settings = PreparationSettings(car=get_car("f1tenth"), practice_until=practice_until)
    with stages_on(Console(quiet=True)) as stages:
        return prepare(settings, (str(folder / "large.csv"),), stages, ("e_kinematic", "dynamic"))


@pytest.mark.check
def test_practice_goes_on_until_the_racing_line_is_known_and_first_laps_are_fast(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    files, car = large_race(tmp_path, 0.005), get_car("f1tenth")
    names = [one.driven_on.track.name for one in files.practices]
    assert names[0] == "airfield"
    assert len(names) > 1
    assert all(name.startswith("airfield-x") for name in names[1:])
    on = files.first
    known = [
        coverage([on.line], np.vstack([one.x for one in files.samples[: 1 + count]])).share
        for count in range(1, len(names) + 1)
    ]
    assert (np.diff(known) > 0).all()
    assert not caplog.records

    def laps_s(artefact: Path, weights: Path | None) -> tuple[float, ...]:
        learned = None if weights is None else read_weights(weights)
        controller = compiled_controller(artefact, car, on.track, on.line, learned)
        driven = ClosedLoop(car, on.track, on.line, controller).drive(2)
        assert driven.off_track_m.max() <= 0
        return driven.laps_s

    first, best = laps_s(files.artefacts[0], files.weights), laps_s(files.artefacts[1], None)
    assert np.max(np.divide(first, best)) < 1.003
    without = large_race(tmp_path, 1.0)
    assert len(without.practices) == 1
    assert laps_s(without.artefacts[0], without.weights)[1] > 1.003 * best[1]
