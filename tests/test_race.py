"""``bayesrace race`` keeps what it promises: laps, order, determinism, and one truth in the log.

Most tests look at one race on the shortest track.
"""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.errors import InputError
from bayesrace.gp.weights import read_weights, write_weights
from bayesrace.learning.dataset import Dataset
from bayesrace.operation import race as driving
from bayesrace.operation.analysis.results import RaceResult, read_result
from bayesrace.operation.preparation import Prepared, prepare, updated_weights
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.settings import RaceSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.raceline import read_raceline, write_raceline
from bayesrace.vehicles import default_car, read_car, write_car
from tests.car_fmu import packed_car
from tests.command_line import Cli, refused
from tests.foreign_fmu import FOREIGN_MAP, build_foreign_fmu
from tests.programs import Race, leftovers
from tests.reference import reference_file
from tests.synthetic_race import Drive, analyse, circle, write_race

CONTROLLERS = ["worstcase", "bayesrace", "bayesrace-updated", "bestcase"]
LIMIT = "bayesrace-limit"

ShortRace = Callable[..., Callable[[], Race]]


@pytest.fixture(scope="module")
def short(peanut_track: Path, tmp_path_factory: pytest.TempPathFactory) -> ShortRace:
    """Starts a race on the shortest track; ``options`` are those of the command line."""
    folder = tmp_path_factory.mktemp("race")

    def begin(name: str, *options: str | Path, **environment: str) -> Callable[[], Race]:
        tracks = ("--track", peanut_track, "--train-track", peanut_track)
        return Race.running(folder / name, *tracks, *options, **environment)

    return begin


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


def runs_of_limit(race: Race) -> list[dict[str, Any]]:
    return [lap for lap in race.result["laps"] if lap["controller"] == LIMIT]


def test_progress_is_faster_than_the_line_and_stays_on_the_track(peanut_race: Race) -> None:
    """Each run after the first with weights learned from those before."""
    updated = peanut_race.lap("bayesrace-updated")
    first, last = runs_of_limit(peanut_race)
    assert first["weights_version"] == updated["weights_version"] != last["weights_version"]
    assert last["lap_time_s"] < updated["lap_time_s"]
    assert last["flying_lap_time_s"] < 0.99 * updated["flying_lap_time_s"]
    assert last["off_track_samples"] == 0


def test_the_order_is_that_of_the_paper(peanut_race: Race) -> None:
    assert_order(peanut_race)


@pytest.mark.check
def test_the_published_race_is_won_as_the_paper_says_and_faster(tmp_path: Path) -> None:
    """The paper's tracks, everything else by default."""
    tracks = [reference_file(f"tracks/{name}.csv") for name in ("ethz", "ethzmobil")]
    options = ("--track", tracks[0], "--train-track", tracks[1], "--progress-drives", "3")
    race = Race.running(tmp_path / "published", *options)()
    assert_order(race)
    assert race.lap("bayesrace-updated")["lap_time_s"] <= 7.7
    fastest = runs_of_limit(race)[-1]
    assert fastest["lap_time_s"] <= 7.32
    assert fastest["flying_lap_time_s"] <= 7.12
    assert fastest["off_track_samples"] == 0


@pytest.mark.check
def test_another_car_seed_and_problem_are_driven_and_reported(
    peanut_race: Race, short: ShortRace, cli: Cli, tmp_path: Path
) -> None:
    """A car from a file, which the report does without; no track constraints."""
    mine = default_car().model_copy(update={"name": "mine", "mass_kg": 0.043})
    write_car(tmp_path / "mine.toml", mine)
    options = ("--car", tmp_path / "mine.toml", "--seed", "1", "--no-constraints")
    race = short("other", "--laps", "1", *options)()
    (tmp_path / "mine.toml").unlink()
    assert read_car(race.out / "car.toml") == mine
    assert race.lap("bayesrace-updated")["finished"]
    assert (race.result["settings"]["seed"], peanut_race.result["settings"]["seed"]) == (1, 0)
    assert race.result["settings"]["constraints"] is False
    assert peanut_race.result["settings"]["constraints"] is True
    assert "constraints off" in race.process.stdout
    text = (race.out / "result.json").read_text()
    assert cli("report", race.out).code == 0
    assert (race.out / "result.json").read_text() == text
    assert read_result(race.out / "result.json").settings.car == "mine"


@pytest.mark.check
def test_a_given_line_is_driven(peanut_race: Race, short: ShortRace, tmp_path: Path) -> None:
    """The same path, at two thirds of the speed."""
    line = read_raceline(peanut_race.out / "race_raceline.csv", "peanut")
    write_raceline(tmp_path / "slow.csv", replace(line, vx_mps=2 / 3 * line.vx_mps))
    race = short("line", "--raceline", tmp_path / "slow.csv")()
    kept = race.out / "race_raceline.csv"
    assert kept.read_bytes() == (tmp_path / "slow.csv").read_bytes()
    fast, slow = (one.lap("bayesrace")["flying_lap_time_s"] for one in (peanut_race, race))
    assert slow == pytest.approx(1.5 * fast, rel=0.1)


@pytest.mark.check
def test_on_the_builtin_tracks_the_order_is_the_same(tmp_path: Path) -> None:
    assert_order(Race.running(tmp_path / "builtin")())


def test_the_result_is_whole(peanut_race: Race) -> None:
    result = read_result(peanut_race.out / "result.json")
    *first, best = CONTROLLERS
    assert [lap.controller for lap in result.laps] == [*first, LIMIT, LIMIT, best]
    for lap in result.laps:
        assert lap.solve_us is not None
        assert 0 < lap.solve_us.p50 <= lap.solve_us.p99 <= lap.solve_us.max
        assert re.fullmatch(r"[0-9a-f]{64}", lap.trajectory_sha256)
    for found in (result.gp, result.gp_updated):
        assert sorted(found) == ["omega", "vx", "vy"]
        for metrics in found.values():
            assert metrics.rmse < metrics.uncorrected_rmse
            assert metrics.r2 <= 1
            assert 0 <= metrics.coverage <= 1
    assert (result.real_time_factor or 0.0) > 0
    assert (result.complete, result.gaps) == (True, 0)


def test_no_lap_is_faster_than_the_limit(peanut_race: Race) -> None:
    assert sorted(peanut_race.result["limit_s"]) == ["flying", "standing"]
    for lap in peanut_race.result["laps"]:
        assert lap["off_track_ms"] >= 19 * lap["off_track_samples"] - 20
        if lap["finished"] and lap["off_track_ms"] == 0:
            assert min(lap["limit_ratios"]) > 1
    assert peanut_race.lap("bayesrace-updated")["limit_ratios"][0] < 1.2


def test_the_weights_are_swapped_in_the_running_controller(peanut_race: Race) -> None:
    laps = [peanut_race.lap(name) for name in CONTROLLERS]
    versions = [lap["weights_version"] for lap in laps]
    assert [lap["unknown_s"] is None for lap in laps] == [True, False, False, True]
    assert versions[0] == versions[3] == ""
    assert versions[1]
    assert versions[2]
    assert versions[1] != versions[2]
    # one process drove all three: its log has one start
    assert (peanut_race.out / "controller-bayesrace.log").read_text().count("plant at") == 1


def absurd(weights: Path, path: Path) -> Path:
    vx, vy, omega = (read := read_weights(weights)).outputs
    write_weights(path, replace(read, outputs=(vx, vy, replace(omega, alpha=1e4 * omega.alpha))))
    return path


@pytest.mark.parametrize("all_refused", [False, pytest.param(True, marks=pytest.mark.check)])
def test_a_refusal_is_a_row_and_the_race_goes_on(
    peanut_track: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, all_refused: bool
) -> None:
    """The update, or the first training, too, has learned something absurd."""

    def learn(*arguments: Any) -> tuple[Path, Dataset]:
        weights, samples = updated_weights(*arguments)
        return absurd(weights, tmp_path / "updated.bin"), samples

    def prepared(*arguments: Any) -> Prepared:
        found = prepare(*arguments)
        return replace(found, weights=absurd(found.weights, tmp_path / "first.bin"))

    monkeypatch.setattr(driving, "updated_weights", learn)
    if all_refused:
        monkeypatch.setattr(driving, "prepare", prepared)
    track = str(peanut_track)
    settings = RaceSettings(track=track, train_track=track, laps=1, progress_drives=1)
    with stages_on(Console(quiet=True)) as stages:
        driving.race(settings, tmp_path / "out", stages)
    laps = {lap.controller: lap for lap in analyse(tmp_path / "out").laps}
    *first, best = CONTROLLERS
    assert list(laps) == [*first, LIMIT, best]
    assert "absurd" in laps["bayesrace-updated"].refused
    assert ("absurd" in laps["bayesrace"].refused) is all_refused
    assert laps["bayesrace"].finished is not all_refused
    # It begins with the weights that were accepted, or without any.
    accepted = "" if all_refused else laps["bayesrace"].weights_version
    assert laps[LIMIT].weights_version == accepted
    assert laps["bestcase"].finished


def test_updates_within_the_lap_are_refused_in_real_time(cli: Cli, tmp_path: Path) -> None:
    done = cli("race", "--every", "2", "--mode", "realtime", "--out", tmp_path / "out")
    refused(done, "updates within the lap are for lockstep", "bayesrace learn --every")


@pytest.mark.check
def test_an_update_within_the_lap_may_fail_or_be_refused_and_the_race_goes_on(
    peanut_track: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    updates = list[int]()

    def learn(*arguments: Any) -> tuple[Path, Dataset]:
        updates.append(len(updates))
        if len(updates) == 1:
            raise np.linalg.LinAlgError("singular")
        weights, samples = updated_weights(*arguments)
        return absurd(weights, tmp_path / "absurd.bin") if len(updates) == 2 else weights, samples

    monkeypatch.setattr(driving, "updated_weights", learn)
    track = str(peanut_track)
    settings = RaceSettings(track=track, train_track=track, progress_drives=0, every=2, laps=3)
    with stages_on(Console(quiet=True)) as stages:
        driving.race(settings, tmp_path / "out", stages)
    laps = {lap.controller: lap for lap in analyse(tmp_path / "out").laps}
    versions = laps["bayesrace"].weights_version.split(" → ")
    assert len(updates) >= 4  # the last one is that after the run
    assert len(versions) == len(updates) - 2
    assert laps["bayesrace"].passed
    assert laps["bayesrace-updated"].passed


@pytest.mark.check
def test_updates_within_the_lap_are_those_of_every_race_of_the_seed(short: ShortRace) -> None:
    races = [short(f"every {i}", "--every", "2", "--progress-drives", "0")() for i in range(2)]
    one, other = (race.lap("bayesrace") for race in races)
    versions = one["weights_version"].split(" → ")
    assert len(versions) == int(one["lap_times_s"][0] + one["lap_times_s"][1]) // 2 + 1
    assert (one["passed"], one["remarks"]) == (True, [])
    assert one["trajectory_sha256"] == other["trajectory_sha256"]


def test_the_run_directory_is_whole(peanut_race: Race) -> None:
    names = {path.name for path in peanut_race.out.iterdir()}
    wanted = {"settings.json", "run.mcap", "result.json", "report.html", "collect.mcap"}
    assert wanted <= names
    manifests = {f"manifest-{one}.json" for one in ("e_kinematic", "progress", "dynamic")}
    assert manifests <= names
    assert not [name for name in names if ".part" in name]


@pytest.mark.check
def test_one_seed_gives_one_race_to_the_bit(
    peanut_race: Race, short: ShortRace, tmp_path: Path
) -> None:
    """Prepared anew, too: lines and weights do not come from the cache, as controllers do."""
    kinds = BuildSettings(), BuildSettings(problem="progress"), BuildSettings.best_case()
    for settings in kinds:
        artefact = build(settings)[0]
        shutil.copytree(artefact, tmp_path / artefact.name)
    again = short("again", "--progress-drives", "2", BAYESRACE_CACHE=str(tmp_path))()
    for name in CONTROLLERS:
        mine, other = peanut_race.lap(name), again.lap(name)
        for volatile in ("solve_us",):
            del mine[volatile], other[volatile]
        assert mine == other
    assert peanut_race.result["gp_updated"] == again.result["gp_updated"]
    for name in ("race.csv", "race_raceline.csv", "settings.json"):
        assert (peanut_race.out / name).read_bytes() == (again.out / name).read_bytes()


@pytest.mark.check
def test_the_car_as_an_fmu_gives_the_same_race_to_the_bit(
    peanut_race: Race, short: ShortRace
) -> None:
    """FMI 3.0; test_fmu_export.py has the same bits by FMI 2.0."""
    fmu = packed_car()
    race = short("fmu", "--fmu", fmu)()
    for name in CONTROLLERS:
        mine, other = peanut_race.lap(name), race.lap(name)
        assert mine["trajectory_sha256"] == other["trajectory_sha256"]
        assert mine["weights_version"] == other["weights_version"]
    assert race.result["settings"]["fmu"] == fmu.name
    assert (race.out / "car.fmu").read_bytes() == fmu.read_bytes()
    assert f"car simulated by {fmu.name}" in race.process.stdout
    assert leftovers(race.pid) == {}


@pytest.mark.check
def test_a_foreign_fmu_laps_through_a_map(
    peanut_race: Race, short: ShortRace, tmp_path: Path
) -> None:
    """Percent, degrees to the right, compass headings, km/h and cm, from another tool."""
    fmu, fmu_map = build_foreign_fmu(tmp_path), tmp_path / "map.toml"
    fmu_map.write_text(FOREIGN_MAP)
    race = short("foreign", "--laps", "1", "--fmu", fmu, "--map", fmu_map)()
    assert (race.out / "car-map.toml").read_text() == FOREIGN_MAP
    for name in ("bayesrace", "bayesrace-updated", "bestcase"):
        lap = race.lap(name)
        assert lap["finished"], lap
        assert abs(lap["lap_time_s"] - peanut_race.lap(name)["lap_time_s"]) < 0.3


def test_a_map_without_an_fmu_is_refused_at_once(cli: Cli, tmp_path: Path) -> None:
    refused(cli("race", "--map", "car.toml", "--out", "out"), "map car.toml without an FMU")
    assert not (tmp_path / "out").exists()


def test_report_makes_the_same_again_from_the_log(
    peanut_race: Race, cli: Cli, tmp_path: Path
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(peanut_race.out, copy)
    (copy / "result.json").unlink()
    (copy / "report.html").unlink()
    done = cli("report", copy)
    assert done.code == 0, done.err
    assert (copy / "result.json").read_bytes() == (peanut_race.out / "result.json").read_bytes()
    assert isinstance(read_result(copy / "result.json"), RaceResult)
    assert (copy / "report.html").read_text() == (peanut_race.out / "report.html").read_text()
    table = [line for line in done.out.splitlines() if line.split()[:1] == ["bestcase"]]
    assert table
    assert table[0] in peanut_race.process.stdout


def test_a_run_that_cannot_be_learned_from_is_named_with_its_log(tmp_path: Path) -> None:
    write_race(tmp_path, [Drive("worstcase", circle(np.zeros(1), 1.0))])
    recorder: Any = SimpleNamespace(drain=lambda at_most_s: None)
    prepared: Any = SimpleNamespace(samples=[])
    unused: Any = None
    drives = driving.Drives(RaceSettings(), tmp_path, unused, prepared, unused, recorder)
    for run, reason in ((1, "no two states follow one another"), (2, "the log does not hold it")):
        plan = RunPlan(run, "worstcase", 2, 10.0, True, 0.0)
        with pytest.raises(InputError, match=rf"run\.mcap, run {run} \(worstcase\): {reason}"):
            drives.samples(plan)


def test_a_run_directory_is_never_overwritten(peanut_race: Race, cli: Cli) -> None:
    before = (peanut_race.out / "run.mcap").stat().st_size
    refused(cli("race", "--out", peanut_race.out), str(peanut_race.out))
    assert (peanut_race.out / "run.mcap").stat().st_size == before


@pytest.mark.check
@pytest.mark.wall_clock
def test_in_real_time_it_drives_too_and_a_second_race_prepares_nothing(
    peanut_race: Race, short: ShortRace
) -> None:
    race = short("realtime", "--laps", "1", "--mode", "realtime")()
    lines = race.process.stdout.splitlines()
    found = [line.removesuffix(": from the cache") for line in lines if line.endswith("the cache")]
    assert found == [
        "racing line, peanut",
        "build the controllers",
        "training line, peanut",
        "training drive (pure pursuit)",
        "train the residual",
        "practice, peanut",
        "train the residual with practice",
        "limit, peanut",
    ]
    result = race.result
    assert [lap["controller"] for lap in result["laps"]] == CONTROLLERS
    for lap in result["laps"]:
        # on a machine that is busy with something else a lap may fail, but never without a reason
        assert lap["finished"] or lap["ended"]
        assert lap["samples"] > 10 or "refused its weights" in lap["ended"]
    assert result["real_time_factor"] is None
    assert result["settings"]["mode"] == "realtime"
    assert leftovers(race.pid) == {}
