"""The analysis against numbers worked out by hand; what is cut short is reported, not guessed."""

import hashlib
import io
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.columns import LogColumns
from bayesrace.errors import InputError
from bayesrace.limit import LimitLap, write_limit
from bayesrace.operation.analysis.laps import positions_between, time_laps
from bayesrace.operation.analysis.race import read_race
from bayesrace.operation.analysis.recording import RUN_COLUMNS, read_recording, runs_of
from bayesrace.operation.analysis.results import LapResult, RaceResult, read_result, write_result
from bayesrace.operation.report import write_report
from bayesrace.operation.terminal.tables import COLUMNS, print_table
from bayesrace.plant.simulator import Simulator, plant_discretisation
from bayesrace.vehicles import default_car
from bayesrace.vehicles.models import dynamic
from tests.synthetic_race import LAP_S, LINE_M, STEP_S, Drive, analyse, circle, track, write_race

TWO_LAPS: Floats = np.asarray(
    2 * np.pi * STEP_S * np.arange(134) / LAP_S
)  # crosses after samples 65 and 130


def only_lap(path: Path) -> LapResult:
    result = analyse(path)
    assert len(result.laps) == 1
    return result.laps[0]


def test_two_laps_on_a_circle(tmp_path: Path) -> None:
    lap = only_lap(write_race(tmp_path, [Drive("bayesrace", circle(TWO_LAPS, 1.1), weights="v1")]))
    assert (lap.controller, lap.finished, lap.weights_version) == ("bayesrace", True, "v1")
    assert lap.lap_times_s == pytest.approx([LAP_S, LAP_S], abs=1e-4)
    assert lap.lap_time_s == lap.lap_times_s[0]
    assert lap.flying_lap_time_s == lap.lap_times_s[1]
    assert (lap.off_track_samples, lap.off_track_max_m) == (0, 0.0)
    assert lap.deviation_mean_m == pytest.approx(1.1 - LINE_M, abs=1e-5)
    assert lap.deviation_max_m == pytest.approx(1.1 - LINE_M, abs=1e-5)
    assert lap.ended == "2 lap(s) done"


def test_cornering_is_that_of_the_circle_driven(tmp_path: Path) -> None:
    """At 2 m/s on a circle of 0.5 m, the nose 0.2 rad inwards of the way."""
    path = write_race(tmp_path, [Drive("bayesrace", circle(TWO_LAPS, 1.1))])
    run = read_race(path).recording.runs[0]
    turning = np.array([0.0, 0.0, 0.08, 0.0, 0.0, 0.0, 0.0]) * np.arange(len(run.truth))[:, None]
    speeds = np.array([0.0, 0.0, 0.0, 2 * np.cos(-0.2), 2 * np.sin(-0.2), 4.0, 0.1])
    run.truth["x"] = turning + speeds
    np.testing.assert_allclose(run.lateral_mps2, 8.0)
    np.testing.assert_allclose(run.slip_rad, -0.2)


def test_off_track_counts_up_to_the_last_counted_crossing(tmp_path: Path) -> None:
    radius = np.full(134, 1.0)
    radius[10:14] = (1.21, 1.23, 1.25, 1.21)  # outside on the right
    radius[40] = 0.77  # outside on the left
    radius[132:] = 1.5  # after the last lap's end
    lap = only_lap(write_race(tmp_path, [Drive("bayesrace", circle(TWO_LAPS, radius))]))
    assert lap.off_track_samples == 5
    assert lap.off_track_max_m == pytest.approx(0.05, abs=1e-5)
    mean = (126 * 0.05 + 0.16 + 0.18 + 0.2 + 0.16 + 0.28) / 131
    assert lap.deviation_mean_m == pytest.approx(mean, abs=1e-5)
    assert lap.deviation_max_m == pytest.approx(LINE_M - 0.77, abs=1e-5)


def test_off_track_counts_all_samples_without_a_lap(tmp_path: Path) -> None:
    lap = only_lap(write_race(tmp_path, [Drive("worstcase", circle(TWO_LAPS[:50], 1.3))]))
    assert (lap.finished, lap.lap_time_s, lap.lap_times_s) == (False, None, [])
    assert lap.off_track_samples == 50
    assert lap.off_track_max_m == pytest.approx(0.1, abs=1e-5)


def driven(
    start: Sequence[float], commands: Sequence[tuple[float, float]]
) -> tuple[Floats, Floats]:
    """States each 20 ms (n + 1, 7) and positions each millisecond (n, 20, 2) of the plant."""
    coarse = Simulator(dynamic(default_car()))
    fine = Simulator(dynamic(default_car()), plant_discretisation(1000))
    coarse.reset(start)
    states, between = [coarse.x.copy()], []
    for command in commands:
        fine.reset(coarse.x.tolist())
        coarse.step(command)
        for _ in range(20):
            fine.step(coarse.u_applied)
            between.append(fine.x[:2].copy())
        states.append(coarse.x.copy())
    return np.array(states), np.array(between).reshape(-1, 20, 2)


def test_between_the_samples_the_car_is_where_the_plant_had_it(tmp_path: Path) -> None:
    """A car that turns at the outer edge is off the track for less than a period."""
    commands = [(0.5, 0.0)] * 20
    start = [0.0, -1.19896, 0.11, 2.0, -0.3, 2.5, 0.25]
    states, between = driven(start, commands)
    depth = np.linalg.norm(between.reshape(-1, 2), axis=1) - 1.2
    assert 0 < (depth > 0).sum() < 20
    assert np.linalg.norm(states[:, :2], axis=1).max() < 1.2
    path = write_race(tmp_path, [Drive("bayesrace", states)])
    lap = only_lap(path)
    assert lap.off_track_ms == (depth > 0).sum()
    assert lap.off_track_ms_max_m == pytest.approx(depth.max(), abs=2e-5)
    places = positions_between(read_race(path).recording.runs[0], default_car())
    np.testing.assert_array_equal(places, between)


@pytest.mark.parametrize("cause", ["equations", "settings", "truth"])
def test_between_the_samples_of_another_car_nothing_is_known(tmp_path: Path, cause: str) -> None:
    states, _ = driven([1.0, 0.0, np.pi / 2, 1.0, 0.0, 0.0, 0.0], [(0.5, 0.0)] * 10)
    states = circle(TWO_LAPS, 1.25) if cause == "equations" else states
    path = write_race(tmp_path, [Drive("bayesrace", states)], truth=cause != "truth")
    if cause == "settings":
        settings = json.loads((path / "settings.json").read_text())
        (path / "settings.json").write_text(json.dumps(settings | {"simulator": "slipx"}))
    lap = only_lap(path)
    assert (lap.off_track_ms, lap.off_track_ms_max_m) == (None, None)


def test_laps_are_compared_with_the_limits_of_their_kinds(tmp_path: Path) -> None:
    path = write_race(tmp_path, [Drive("bayesrace", circle(TWO_LAPS, 1.1))])
    assert only_lap(path).limit_ratios is None
    for kind, time_s in (("standing", 1.25), ("flying", 1.2)):
        one = np.zeros((1, 9))
        lap = LimitLap("orca", "circle", time_s, 1, 0.0, 0.0, one[0, :1], one[:, :7], one[:, :2])
        write_limit(path / f"limit-{kind}.csv", lap)
    result = analyse(path)
    assert result.limit_s == {"standing": 1.25, "flying": 1.2}
    assert result.laps[0].limit_ratios == pytest.approx([LAP_S / 1.25, LAP_S / 1.2], abs=1e-4)
    text = io.StringIO()
    print_table(result, Console(file=text, width=80))
    assert "standing 1.250 s, flying 1.200 s" in text.getvalue()
    assert "1.048 1.092" in text.getvalue()


def test_the_fingerprint_ends_with_the_sample_after_the_last_lap(tmp_path: Path) -> None:
    x = circle(TWO_LAPS, 1.0)
    whole = only_lap(write_race(tmp_path / "a", [Drive("bayesrace", x)]))
    assert whole.trajectory_sha256 == hashlib.sha256(x[:132].astype("<f8").tobytes()).hexdigest()
    tail = x.copy()
    tail[132:] += 0.001
    same = only_lap(write_race(tmp_path / "b", [Drive("bayesrace", tail)]))
    assert same.trajectory_sha256 == whole.trajectory_sha256
    part = only_lap(write_race(tmp_path / "c", [Drive("bayesrace", x[:30])]))
    assert part.trajectory_sha256 == hashlib.sha256(x[:30].astype("<f8").tobytes()).hexdigest()


def test_solve_times_and_fallbacks(tmp_path: Path) -> None:
    drive = Drive("bayesrace", circle(TWO_LAPS[:102], 1.0), range(1, 102), (3, 4, 50))
    lap = only_lap(write_race(tmp_path, [drive]))
    assert lap.solve_us is not None
    assert (lap.solve_us.p50, lap.solve_us.p99, lap.solve_us.max) == (51.0, 100.0, 101.0)
    assert lap.fallbacks == 3


def test_a_lap_counts_only_once_when_the_car_rolls_back_over_the_line() -> None:
    there_and_back = np.array([0.05, 0.02, -0.01, -0.03, 0.01, 0.04])
    angle = np.concatenate([there_and_back, np.arange(0.1, 2 * np.pi + 0.1, 0.05)])
    xy = circle(angle, 1.0)[:, :2]
    time_s: Floats = np.asarray(STEP_S * np.arange(len(angle)))
    laps = time_laps(track(), time_s, xy, track().project_path(xy).s_m)
    assert len(laps.times_s) == 1
    before = laps.after[0] - 1
    assert angle[before] < 2 * np.pi <= angle[before + 1]


def test_a_short_cut_is_no_lap(tmp_path: Path) -> None:
    angle = np.concatenate([np.linspace(0, 2, 40), np.linspace(4.5, 2 * np.pi + 1, 60)])
    lap = only_lap(write_race(tmp_path, [Drive("worstcase", circle(angle, 1.0))]))
    assert not lap.finished
    assert "at 0.80 s the car left out a piece of the track" in lap.verdict


def test_laps_before_a_short_cut_count(tmp_path: Path) -> None:
    angle = np.append(TWO_LAPS[:100], np.linspace(TWO_LAPS[99] + 2.0, 4 * np.pi + 1, 30))
    lap = only_lap(write_race(tmp_path, [Drive("bayesrace", circle(angle, 1.0))]))
    assert lap.lap_times_s == pytest.approx([LAP_S], abs=1e-4)
    assert lap.flying_lap_time_s is None


def test_gp_metrics_are_those_of_the_bestcase_run(tmp_path: Path) -> None:
    drives = [Drive("bayesrace", circle(TWO_LAPS, 1.1)), Drive("bestcase", circle(TWO_LAPS, 1.0))]
    result = analyse(write_race(tmp_path, drives))
    assert list(result.gp) == list(result.gp_updated) == ["vx", "vy", "omega"]
    for metrics in result.gp.values():  # a GP that knows nothing corrects nothing
        assert metrics.rmse == metrics.uncorrected_rmse


def test_without_bestcase_or_weights_there_are_no_gp_metrics(tmp_path: Path) -> None:
    drive = Drive("bestcase", circle(TWO_LAPS, 1.0))
    assert analyse(write_race(tmp_path / "a", [drive], weights=False)).gp == {}
    other = Drive("bayesrace", circle(TWO_LAPS, 1.0))
    assert analyse(write_race(tmp_path / "b", [other])).gp == {}


@pytest.mark.parametrize("truth", [True, False])
def test_a_recording_read_in_pieces_is_that_of_the_whole_log(tmp_path: Path, truth: bool) -> None:
    """Also of a log without truth, and whatever has been computed of what was read before."""
    drives = [Drive("worstcase", circle(TWO_LAPS, 1.1)), Drive("bayesrace", circle(TWO_LAPS, 1.0))]
    path = write_race(tmp_path, drives, truth=truth) / "run.mcap"
    whole = path.read_bytes()
    expected = read_recording(tmp_path)
    path.write_bytes(whole[: len(whole) // 3])
    log = LogColumns(path, RUN_COLUMNS)
    first = runs_of(log.read())[1]
    samples = len(first.states)
    path.write_bytes(whole[: 2 * len(whole) // 3])
    early = read_recording(tmp_path, log)
    assert samples < len(early.runs[0].states) > len(early.runs[1].states)
    path.write_bytes(whole)
    for _ in range(2):
        recording = read_recording(tmp_path, log)
        assert recording.truth is expected.truth is truth
        assert not recording.truncated
        for run, other in zip(recording.runs, expected.runs, strict=True):
            assert run.plan == other.plan
            for name in ("states", "truth", "actuations", "telemetry", "events"):
                np.testing.assert_array_equal(getattr(run, name), getattr(other, name))
    # What was returned before has not changed.
    assert len(first.states) == samples
    assert len(early.runs[1].states) < len(expected.runs[1].states)


def test_real_time_factor_is_that_of_lockstep_runs(tmp_path: Path) -> None:
    x = circle(TWO_LAPS, 1.0)
    result = analyse(write_race(tmp_path / "a", [Drive("a", x), Drive("b", x, lockstep=False)]))
    assert result.real_time_factor == pytest.approx(20.0)  # 20 ms simulated, 1 ms of the clock
    alone = analyse(write_race(tmp_path / "b", [Drive("b", x, lockstep=False)]))
    assert alone.real_time_factor is None


def test_gaps_are_counted(tmp_path: Path) -> None:
    drive = Drive("bayesrace", circle(TWO_LAPS, 1.0), drop=(0, 20, 21))
    result = analyse(write_race(tmp_path, [drive]))
    assert (result.complete, result.gaps) == (False, 3)
    whole = analyse(write_race(tmp_path, [Drive("bayesrace", circle(TWO_LAPS, 1.0))]))
    assert (whole.complete, whole.gaps) == (True, 0)


def test_a_forged_number_is_no_gap(tmp_path: Path) -> None:
    drive = Drive("bayesrace", circle(TWO_LAPS, 1.0))
    run = read_race(write_race(tmp_path, [drive])).recording.runs[0]
    forged = np.insert(run.actuations, 20, run.actuations[20])
    forged["seq"][20] = 2**60
    assert replace(run, actuations=forged).gaps == 0


def test_a_killed_plant_is_reported(tmp_path: Path) -> None:
    drive = Drive("bayesrace", circle(TWO_LAPS[:60], 1.0), ended=None)
    lap = only_lap(write_race(tmp_path, [drive]))
    assert not lap.finished
    assert "the log ends 1.18 s into the run" in lap.ended


def test_a_run_that_never_started_is_reported(tmp_path: Path) -> None:
    lap = only_lap(write_race(tmp_path, [Drive("bayesrace", np.zeros((0, 7)), ended=None)]))
    assert not lap.finished
    assert lap.ended == "the run never started"
    assert (lap.deviation_mean_m, lap.deviation_max_m, lap.solve_us) == (None, None, None)


def test_runs_of_one_controller_are_numbered(tmp_path: Path) -> None:
    """In table and report; the only run of a controller is not."""
    names = ("bayesrace-limit", "bestcase", "bayesrace-limit")
    path = write_race(tmp_path, [Drive(name, circle(TWO_LAPS, 1.0)) for name in names])
    result = analyse(path)
    assert [lap.name for lap in result.laps] == [
        "bayesrace-limit 1",
        "bestcase",
        "bayesrace-limit 2",
    ]
    text = io.StringIO()
    print_table(result, Console(file=text, width=80))
    assert "\nbayesrace-limit 2 " in text.getvalue()
    page = write_report(tmp_path).read_text()
    assert "BayesRace at the limit, 2</b>" in page
    assert "BestCase</b>" in page
    tops = re.findall('class="card" style="border-top-color: (#[0-9a-fA-F]{6})"', page)
    assert len(tops) == len(set(tops)) == 3


def test_refused_weights_are_a_row_with_the_reason(tmp_path: Path) -> None:
    refused = Drive(
        "bayesrace-updated", np.zeros((0, 7)), ended=None, refused="absurd over the car's range"
    )
    result = analyse(write_race(tmp_path, [refused, Drive("bestcase", circle(TWO_LAPS, 1.0))]))
    lap = result.laps[0]
    assert (lap.refused, lap.finished, lap.samples) == ("absurd over the car's range", False, 0)
    assert (result.complete, result.laps[1].finished, result.laps[1].refused) == (True, True, "")
    text = io.StringIO()
    print_table(result, Console(file=text, width=80))
    rows = [line.split() for line in text.getvalue().splitlines()]
    assert ["bayesrace-updated", "refused", "–"] in [row[:3] for row in rows]
    assert "bayesrace-updated: refused: absurd over the car's range" in text.getvalue()
    page = write_report(tmp_path).read_text()
    assert '<div class="time">refused</div>' in page
    assert "absurd over the car&#39;s range" in page


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8, 0.999])
def test_a_log_that_was_cut_off_is_analysed_as_far_as_it_goes(tmp_path: Path, share: float) -> None:
    drives = [Drive("bayesrace", circle(TWO_LAPS, 1.0)), Drive("bestcase", circle(TWO_LAPS, 1.0))]
    path = write_race(tmp_path, drives)
    log = path / "run.mcap"
    data = log.read_bytes()
    log.write_bytes(data[: int(share * len(data))])
    result = analyse(path)
    assert not result.complete
    assert 1 <= len(result.laps) <= 2
    assert result.laps[0].finished == (share >= 0.5)
    page = write_report(path).read_text(encoding="utf-8")
    assert "The log is not complete" in page
    unfinished = '<div class="time">DNF</div>' in page
    assert unfinished is not all(lap.finished for lap in result.laps)


def test_a_run_of_a_file_car_needs_its_settings_only(tmp_path: Path) -> None:
    """They describe the whole car, so that a report can be made again."""
    path = write_race(tmp_path, [])
    settings = json.loads((path / "settings.json").read_text())
    mine = default_car().model_copy(update={"name": "mine", "mass_kg": 0.05})
    settings["car"] = json.loads(mine.model_dump_json())
    (path / "settings.json").write_text(json.dumps(settings))
    analysis = read_race(path)
    assert analysis.recording.settings.car == mine
    assert analysis.result.settings.car == "mine"
    (path / "settings.json").write_text(json.dumps(settings | {"car": "lorry"}))
    with pytest.raises(InputError, match=r"settings\.json holds .* unknown car 'lorry'"):
        read_race(path)


def test_settings_are_summarised(tmp_path: Path) -> None:
    summary = analyse(write_race(tmp_path, [])).settings
    assert (summary.track, summary.train_track, summary.mode) == ("circle", "paddock", "lockstep")
    assert (summary.car, summary.seed, summary.laps, summary.constraints) == ("orca", 7, 2, True)


def race(path: Path) -> Path:
    angle: Floats = TWO_LAPS
    return write_race(
        path,
        [
            Drive("worstcase", circle(angle[:50], 1.3), [88.4], weights="worstcase"),
            Drive("bayesrace", circle(angle, 1.1), [1234.5, 678.9], (5,), "orca-0123456789"),
            Drive("bayesrace-updated", circle(angle, 1.06), [12345.0], (), "orca-9876543210"),
            Drive("bestcase", circle(angle, 1.05), [99.5]),
        ],
    )


def test_the_result_file_gives_back_the_result_and_its_form_is_fixed(tmp_path: Path) -> None:
    result = analyse(race(tmp_path))
    write_result(tmp_path / "result.json", result)
    assert read_result(tmp_path / "result.json") == result
    content = json.loads((tmp_path / "result.json").read_text())
    assert [lap["controller"] for lap in content["laps"]] == [
        "worstcase", "bayesrace", "bayesrace-updated", "bestcase",
    ]  # fmt: skip
    assert {"lap_time_s", "flying_lap_time_s", "off_track_samples", "trajectory_sha256"} < set(
        content["laps"][0]
    )
    assert set(content["laps"][1]["solve_us"]) == {"p50", "p99", "max"}
    assert {"rmse", "r2", "coverage"} < set(content["gp"]["vx"])
    content["laps"][0]["speed"] = 1
    with pytest.raises(ValueError, match="speed"):
        RaceResult.model_validate(content)


def test_reading_what_is_no_result_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    with pytest.raises(InputError, match="cannot read"):
        read_result(path)
    path.write_text("{}")
    with pytest.raises(InputError, match="no result of a race"):
        read_result(path)


def test_the_table_shows_the_results_numbers_within_80_columns(tmp_path: Path) -> None:
    result = analyse(race(tmp_path))
    wide = {"rmse": 0.000123, "uncorrected_rmse": 0.000123, "r2": -10.1234, "log_density": -123.45}
    metrics = {output: one.model_copy(update=wide) for output, one in result.gp_updated.items()}
    result = result.model_copy(update={"gp": metrics, "gp_updated": metrics})
    text = io.StringIO()
    print_table(result, Console(file=text, width=80))
    lines = text.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in text.getvalue()
    for lap in result.laps:
        row = next(line for line in lines if line.split()[:1] == [lap.controller])
        shown = [column for column in COLUMNS if column.narrow]
        assert row.split() == [column.cell(lap) for column in shown]
        assert not lap.weights_version or f"weights {lap.weights_version}" in text.getvalue()
    assert "worstcase failed: 0 of 2 laps driven" in text.getvalue()
    assert sum(line.split()[:1] == ["updated"] for line in lines) == 3


def test_analysis_reads_the_log_once_for_result_and_report(tmp_path: Path) -> None:
    analysis = read_race(race(tmp_path))
    assert analysis.result is analysis.result
    assert analysis.result == analyse(tmp_path)
