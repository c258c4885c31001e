"""``bayesrace race`` keeps what it promises: laps, order, determinism, and one truth in the log.

The races run once a module, some at the same time: lockstep does not care how fast the machine is.
"""

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace.log import LogReader
from bayesrace.messages import STATE
from experiments.results import RaceResult, read_result
from tests.car_fmu import packed_car
from tests.foreign_fmu import FOREIGN_MAP, build_foreign_fmu
from tests.programs import Race, leftovers, peanut, run
from tests.reference import reference_file

pytestmark = [pytest.mark.slow, pytest.mark.alone]

CONTROLLERS = ["worstcase", "bayesrace", "bayesrace-updated", "bestcase"]
LAP_FORM: dict[str, type | tuple[type, ...]] = {
    "controller": str,
    "finished": bool,
    "lap_time_s": (float, type(None)),
    "flying_lap_time_s": (float, type(None)),
    "off_track_samples": int,
    "off_track_max_m": float,
    "deviation_mean_m": float,
    "deviation_max_m": float,
    "solve_us": dict,
    "fallbacks": int,
    "weights_version": str,
    "trajectory_sha256": str,
}


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Race:
    """The race of the issue: the paper's tracks, everything else by default."""
    tracks = [reference_file(f"tracks/{name}.csv") for name in ("ethz", "ethzmobil")]
    out = tmp_path_factory.mktemp("race") / "published"
    return Race.running(out, "--track", tracks[0], "--train-track", tracks[1])()


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> tuple[Race, Race]:
    """Two races at once, all by default: built-in tracks, one seed."""
    folder = tmp_path_factory.mktemp("race")
    waits = [Race.running(folder / name) for name in ("first", "second")]
    first, second = (wait() for wait in waits)
    return first, second


@pytest.fixture(scope="module")
def builtin(twins: tuple[Race, Race]) -> Race:
    """A race with all defaults."""
    return twins[0]


@pytest.fixture(scope="module")
def played_by_fmu(tmp_path_factory: pytest.TempPathFactory) -> Race:
    """The race by default, but for an FMU as the car."""
    out = tmp_path_factory.mktemp("race") / "fmu"
    return Race.running(out, "--fmu", packed_car())()


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory) -> tuple[Race, Race]:
    """One lap with another seed, and one without track constraints."""
    folder = tmp_path_factory.mktemp("race")
    seeded = Race.running(folder / "seed", "--laps", "1", "--seed", "1")
    free = Race.running(folder / "free", "--laps", "1", "--no-constraints")
    return seeded(), free()


@pytest.fixture(scope="module")
def realtime(tmp_path_factory: pytest.TempPathFactory) -> Race:
    """By the wall clock, on the shortest track."""
    folder = tmp_path_factory.mktemp("race")
    track = peanut(folder / "peanut.csv")
    tracks = ("--track", track, "--train-track", track)
    return Race.running(folder / "out", *tracks, "--laps", "1", "--mode", "realtime")()


def trajectory(race: Race, controller: str, count: int = 100) -> np.ndarray[Any, Any]:
    """The first states of that controller's run, from the log."""
    number = race.lap(controller)["run"]
    states = LogReader(race.out / "run.mcap").select(STATE)
    return np.array([state.x for state in states if state.run == number][:count])


def assert_order(race: Race) -> None:
    worst, first, updated, best = (race.lap(name) for name in CONTROLLERS)
    assert first["finished"]
    assert updated["finished"]
    assert best["finished"]
    assert not worst["finished"] or worst["lap_time_s"] >= first["lap_time_s"] + 0.5
    assert abs(updated["lap_time_s"] - best["lap_time_s"]) <= 0.1
    # Learning from the lap must not cost time; where nothing is left to win it may change little.
    assert updated["lap_time_s"] <= first["lap_time_s"] + 0.02
    assert updated["off_track_samples"] == 0
    assert updated["off_track_max_m"] == 0.0


def test_the_published_race_is_won_as_the_paper_says_and_faster(published: Race) -> None:
    assert_order(published)
    assert published.lap("bayesrace-updated")["lap_time_s"] <= 7.7


def test_on_the_builtin_tracks_the_order_is_the_same(builtin: Race) -> None:
    assert_order(builtin)


def test_result_has_the_promised_form(builtin: Race) -> None:
    result = builtin.result
    assert [lap["controller"] for lap in result["laps"]] == CONTROLLERS
    for lap in result["laps"]:
        for key, kind in LAP_FORM.items():
            assert isinstance(lap[key], kind), (key, lap[key])
        percentiles = lap["solve_us"]
        assert sorted(percentiles) == ["max", "p50", "p99"]
        assert 0 < percentiles["p50"] <= percentiles["p99"] <= percentiles["max"]
        assert re.fullmatch(r"[0-9a-f]{64}", lap["trajectory_sha256"])
    for name in ("gp", "gp_updated"):
        assert sorted(result[name]) == ["omega", "vx", "vy"]
        for metrics in result[name].values():
            assert metrics["rmse"] < metrics["uncorrected_rmse"]
            assert metrics["r2"] <= 1
            assert 0 <= metrics["coverage"] <= 1
    assert result["real_time_factor"] > 0
    assert result["complete"] is True
    assert result["gaps"] == 0


def test_the_weights_are_swapped_in_the_running_controller(builtin: Race) -> None:
    versions = [builtin.lap(name)["weights_version"] for name in CONTROLLERS]
    assert versions[0] == versions[3] == ""
    assert versions[1]
    assert versions[2]
    assert versions[1] != versions[2]
    # one process drove all three: its log has one start
    assert (builtin.out / "controller-bayesrace.log").read_text().count("plant at") == 1


def test_the_run_directory_is_whole(builtin: Race) -> None:
    names = {path.name for path in builtin.out.iterdir()}
    wanted = {"settings.json", "run.mcap", "result.json", "report.html", "collect.mcap"}
    assert wanted <= names
    assert {"manifest-e_kinematic.json", "manifest-dynamic.json"} <= names
    assert not {name for name in names if name.endswith(".part")}


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
def test_no_process_outlives_a_race(twins: tuple[Race, Race], others: tuple[Race, Race]) -> None:
    for race in (*twins, *others):
        assert leftovers(race.pid) == {}


def test_one_seed_gives_one_race_to_the_bit(twins: tuple[Race, Race]) -> None:
    first, second = twins
    for name in CONTROLLERS:
        mine, other = first.lap(name), second.lap(name)
        for volatile in ("solve_us",):
            del mine[volatile], other[volatile]
        assert mine == other
    assert first.result["gp_updated"] == second.result["gp_updated"]
    for name in ("race.csv", "race_raceline.csv", "settings.json"):
        assert (first.out / name).read_bytes() == (second.out / name).read_bytes()


def test_the_car_as_an_fmu_gives_the_same_race_to_the_bit(
    builtin: Race, played_by_fmu: Race
) -> None:
    for name in CONTROLLERS:
        mine, other = builtin.lap(name), played_by_fmu.lap(name)
        assert mine["trajectory_sha256"] == other["trajectory_sha256"]
        assert mine["weights_version"] == other["weights_version"]
    assert played_by_fmu.result["settings"]["fmu"] == packed_car().name
    assert (played_by_fmu.out / "car.fmu").read_bytes() == packed_car().read_bytes()
    assert f"car played by {packed_car().name}" in played_by_fmu.process.stdout
    assert leftovers(played_by_fmu.pid) == {}


def test_the_car_as_an_fmu_gives_the_published_lap_to_the_bit(
    published: Race, tmp_path: Path
) -> None:
    """FMI 2.0 here, FMI 3.0 above."""
    settings = json.loads((published.out / "settings.json").read_text())
    tracks = ("--track", settings["track"], "--train-track", settings["train_track"])
    race = Race.running(tmp_path / "fmi2", *tracks, "--fmu", packed_car(2))()
    for name in CONTROLLERS:
        mine, other = published.lap(name), race.lap(name)
        assert mine["trajectory_sha256"] == other["trajectory_sha256"]


def test_a_foreign_fmu_laps_through_a_map(builtin: Race, tmp_path: Path) -> None:
    """Percent, degrees to the right, compass headings, km/h and cm, from another tool."""
    fmu, fmu_map = build_foreign_fmu(tmp_path), tmp_path / "map.toml"
    fmu_map.write_text(FOREIGN_MAP)
    race = Race.running(tmp_path / "out", "--laps", "1", "--fmu", fmu, "--map", fmu_map)()
    assert (race.out / "car-map.toml").read_text() == FOREIGN_MAP
    for name in ("bayesrace", "bayesrace-updated", "bestcase"):
        lap = race.lap(name)
        assert lap["finished"], lap
        assert abs(lap["lap_time_s"] - builtin.lap(name)["lap_time_s"]) < 0.3


def test_a_map_without_an_fmu_is_refused_at_once(tmp_path: Path) -> None:
    done = run("race", "--map", "car.toml", "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "map car.toml without an FMU" in done.stderr
    assert not (tmp_path / "out").exists()


def test_another_seed_gives_another_race(builtin: Race, others: tuple[Race, Race]) -> None:
    seeded = others[0]
    assert seeded.lap("bayesrace")["weights_version"] != builtin.lap("bayesrace")["weights_version"]
    assert not np.array_equal(trajectory(seeded, "bayesrace"), trajectory(builtin, "bayesrace"))
    # what learned nothing has no seed
    assert np.array_equal(trajectory(seeded, "worstcase"), trajectory(builtin, "worstcase"))


def test_without_constraints_another_ocp_is_solved(
    builtin: Race, others: tuple[Race, Race]
) -> None:
    free = others[1]
    assert free.result["settings"]["constraints"] is False
    assert builtin.result["settings"]["constraints"] is True
    assert "constraints off" in free.process.stdout
    assert not np.array_equal(trajectory(free, "worstcase"), trajectory(builtin, "worstcase"))


def test_table_report_and_result_say_the_same(builtin: Race) -> None:
    html = (builtin.out / "report.html").read_text()
    for lap in builtin.result["laps"]:
        row = next(
            line.split()
            for line in builtin.process.stdout.splitlines()
            if line.split()[:1] == [lap["controller"]] and "finish" not in line
        )
        time_s, flying_s, solve = lap["lap_time_s"], lap["flying_lap_time_s"], lap["solve_us"]
        cells = [
            f"{time_s:.3f}" if lap["finished"] else "DNF",
            "–" if flying_s is None else f"{flying_s:.3f}",
            str(lap["off_track_samples"]),
            f"{lap['off_track_max_m']:.3f}" if lap["off_track_samples"] else "–",
            f"{lap['deviation_mean_m']:.3f}",
            f"{lap['deviation_max_m']:.3f}",
            *(f"{solve[name]:.0f}" for name in ("p50", "p99", "max")),
            str(lap["fallbacks"]),
        ]
        assert row == [lap["controller"], lap["weights_version"] or "–", *cells]
        assert all(cell in html for cell in row)


def test_report_makes_the_same_again_from_the_log(builtin: Race, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(builtin.out, copy)
    (copy / "result.json").unlink()
    (copy / "report.html").unlink()
    done = run("report", copy)
    assert done.returncode == 0, done.stderr
    assert (copy / "result.json").read_bytes() == (builtin.out / "result.json").read_bytes()
    assert isinstance(read_result(copy / "result.json"), RaceResult)
    assert (copy / "report.html").read_text() == (builtin.out / "report.html").read_text()
    table = [line for line in done.stdout.splitlines() if line.split()[:1] == ["bestcase"]]
    assert table
    assert table[0] in builtin.process.stdout


def test_a_run_directory_is_never_overwritten(builtin: Race) -> None:
    before = (builtin.out / "run.mcap").stat().st_size
    done = run("race", "--out", builtin.out)
    assert done.returncode == 2
    assert str(builtin.out) in done.stderr
    assert (builtin.out / "run.mcap").stat().st_size == before


def test_by_the_wall_clock_it_drives_too(realtime: Race) -> None:
    result = realtime.result
    assert [lap["controller"] for lap in result["laps"]] == CONTROLLERS
    for lap in result["laps"]:
        # on a machine that is busy with something else a lap may fail, but never without a reason
        assert lap["finished"] or lap["ended"]
        assert lap["samples"] > 10
    assert result["real_time_factor"] is None
    assert result["settings"]["mode"] == "realtime"
    assert leftovers(realtime.pid) == {}
