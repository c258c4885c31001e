"""The 1:10 car through all parts: FMU, a lap that was learned, the whole comparison."""

from pathlib import Path

import numpy as np
import pytest
from fmpy.validation import validate_fmu
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.codegen.build import build
from bayesrace.codegen.fmu import car_fmu, pack
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.pure_pursuit import PurePursuit
from bayesrace.controller.python_controller import PythonController
from bayesrace.gp.weights import Weights, read_weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.settings import TrainingSettings
from bayesrace.learning.training import train
from bayesrace.operation.analysis.results import read_result
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.preparation import prepare
from bayesrace.operation.settings import PreparationSettings, RaceSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.plant.simulator import Simulator
from bayesrace.plant.vehicle import Vehicle, open_vehicle
from bayesrace.raceline import RaceLine, racing_line, read_raceline_for
from bayesrace.tracks import load_track
from bayesrace.vehicles import get_car
from bayesrace.vehicles.models import dynamic
from tests.cycle_rig import STEP_S, ScriptedLaw, scripted_driver, state
from tests.programs import Race
from tests.takeover.spoilt_weights import SPOILT, spoilt
from tests.takeover.watched import Course

CAR = get_car("f1tenth")
SMALL = "workshop"


def driven(vehicle: Vehicle, start: list[float], commands: list[tuple[float, float]]) -> Floats:
    """States and inputs that acted, a row a period."""
    vehicle.reset(start)
    rows = []
    for command in commands:
        vehicle.step(command)
        rows.append([*vehicle.x, *vehicle.u_applied])
    return np.array(rows)


def test_its_fmu_is_the_plant_to_the_bit_limits_of_the_drive_included(tmp_path: Path) -> None:
    """From standstill to a speed where power limits the drive, and braking from there to a stop."""
    fmu = pack(car_fmu(CAR), tmp_path / "car.fmu", None)
    assert validate_fmu(str(fmu)) == []
    random = np.random.default_rng(3)
    commands = [(99.0, float(rate)) for rate in random.uniform(-0.1, 0.1, 60)]
    commands += [(np.nan, 0.0)] * 3 + [(-4.0, 0.0)] * 150
    commands += [(float(d), float(r)) for d, r in random.uniform([-9, -5], [9, 5], (200, 2))]
    start = [0, 0, 0.3, 0.1, 0, 0, 0.0]
    ours = driven(Simulator(dynamic(CAR)), start, commands)
    with open_vehicle(CAR, fmu) as theirs:
        np.testing.assert_array_equal(driven(theirs, start, commands), ours)
    assert ours[:, 3].max() > 9.0
    assert np.ptp(ours[213:, 6]) > CAR.delta_max_rad
    assert 4.0 < ours[59, 7] < 0.9 * CAR.d_max
    assert 0 <= ours[212, 3] < 0.01


def test_it_exports_for_model_exchange_and_on_saturating_tyres(tmp_path: Path) -> None:
    for car, kind in ((CAR, "me"), (CAR.on_tyres("pacejka"), "cs")):
        fmu = pack(car_fmu(car, 3, kind), tmp_path / f"{kind}.fmu", None)  # type: ignore[arg-type]
        assert validate_fmu(str(fmu)) == []


def test_the_car_names_the_tracks_that_are_driven_where_none_is_named() -> None:
    settings = RaceSettings(car=CAR)
    assert (settings.track, settings.train_track) == (CAR.race_track, CAR.train_track)
    assert RaceSettings(car=CAR, track="harbour").track == "harbour"
    assert RaceSettings().track == "harbour"


def in_the_form_of_others(line: RaceLine, path: Path) -> Path:
    """As the F1TENTH community writes racing lines: few digits, headings that wrap, no origin."""
    heading = np.angle(np.exp(1j * line.psi_rad))
    columns = (line.s_m, line.x_m, line.y_m, heading, line.kappa_radpm, line.vx_mps, line.ax_mps2)
    names = "s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2"
    np.savetxt(path, np.column_stack(columns), "%.7f", ";", header=f"17b4de0d\n{names}")
    return path


def test_a_lap_that_was_learned_from_pure_pursuit_stays_on_the_small_track(tmp_path: Path) -> None:
    """On a line from a file of others' form; it corners beyond what tyres of its friction could
    hold, which the trajectory shows."""
    track = load_track(SMALL, CAR.width_m)
    path = in_the_form_of_others(racing_line(track, CAR), tmp_path / "line.csv")
    line, artefact = read_raceline_for(path, track, CAR), build(BuildSettings(car=CAR))[0]
    pursuit = PurePursuit(CAR, line.x_m, line.y_m, line.vx_mps)
    loop = ClosedLoop(CAR, track, line, PythonController(artefact, pursuit))
    samples = loop.drive(0, CAR.tuning.pursuit.drive_s).samples()
    settings = TrainingSettings(kernels=("matern25",), restarts=0, hyper_points=200)
    weights = train(samples, PREDICTION, settings)
    controller = compiled_controller(artefact, CAR, track, line, weights)
    run = ClosedLoop(CAR, track, line, controller).drive()
    assert len(run.laps_s) == 2
    assert not (run.off_track_m > 0).any()
    assert run.laps_s[1] < 1.02 * line.lap_time_s
    assert np.abs(run.lateral_mps2).max() > CAR.friction * 9.81
    assert 0.1 < np.abs(run.slip_rad).max() < 0.6


@pytest.fixture(scope="module")
def first_weights() -> Weights:
    """Those that a race on the small track begins with, of a seed whose GP errs at low speed."""
    with stages_on(Console(quiet=True)) as stages:
        return read_weights(prepare(PreparationSettings(car=CAR, seed=1), (), stages).weights)


@pytest.mark.parametrize(("what", "found"), [("as learned", ""), ("flip omega", "back at 1")])
def test_first_weights_outlast_a_standing_start_if_they_are_good(
    first_weights: Weights, what: str, found: str
) -> None:
    """Sent before the car has driven. From a standing start the nominal model errs less than they
    do, until the car corners: too few samples to roll good weights back. Spoilt ones are."""
    course = Course(CAR, SMALL, 11.0)
    spoils = what in SPOILT
    sent, proven = (spoilt(first_weights, what), first_weights) if spoils else (first_weights, None)
    became, watched_m = course.drive(sent, proven)
    assert (became == "kept") if not spoils else became.startswith(found)
    assert watched_m < 0.0


def braked_by_fallback(x0: Floats) -> tuple[Floats, list[int]]:
    """States until the car stands, no step usable any more; how many cycles each level drove."""
    artefact = build(BuildSettings(car=CAR))[0]
    driver = scripted_driver(artefact, ScriptedLaw(), CAR)
    simulator = Simulator(dynamic(CAR))
    simulator.reset(x0.tolist())
    rows = [x0]
    while rows[-1][3] > 0.02:
        seq, x = len(rows), tuple(rows[-1].tolist())
        assert len(rows) < 500
        assert driver.observe(state(seq, time_s=seq * STEP_S, x=x, lockstep=True))
        decision = driver.decide(seq * STEP_S, 0.0, 0.0)
        simulator.step((decision.d, decision.delta_rate))
        rows.append(simulator.x.copy())
        without = simulator.guard.apply(None, rows[-2], STEP_S)[0]
        assert simulator.u_applied[0] == without  # the plant brakes as the controller does
    return np.array(rows), driver.levels


@pytest.mark.parametrize(("across_mps2", "slip_rad"), [(0.0, 0.05), (2.0, 0.2), (5.0, 0.3)])
def test_braking_by_the_fallback_is_braking_that_the_car_can_hold(
    across_mps2: float, slip_rad: float
) -> None:
    """On a straight and in bends, with a shove. A full brake spins it: load goes to the front."""
    v_mps = 10.0
    steady = Simulator(dynamic(CAR))
    delta = across_mps2 / v_mps**2 * CAR.wheelbase_m
    steady.reset([0.0, 0.0, 0.0, v_mps, 0.0, across_mps2 / v_mps, delta])
    for _ in range(50):
        steady.step((5.0 * (v_mps - steady.x[3]), 0.0))
    x0 = steady.x.copy()
    x0[5] += 0.3
    x, levels = braked_by_fallback(x0)
    moving = x[x[:, 3] > CAR.brake_fade_mps]
    assert np.abs(np.arctan2(moving[:, 4], moving[:, 3])).max() < slip_rad
    assert np.abs(x[:, 5]).max() < across_mps2 / 5 + 0.4
    assert np.all(np.diff(x[:, 3]) < 1e-9)
    assert levels[0] == levels[1] == 0
    assert levels[2] > 20
    way = np.linalg.norm(np.diff(x[:, :2], axis=0), axis=1).sum()
    assert way < 18.0  # at 1.6 m/s^2 all the way it is 31 m
    steady.reset(x0.tolist())
    for _ in range(40):
        steady.step((CAR.d_min, 0.0))
    assert abs(np.arctan2(steady.x[4], steady.x[3])) > 1.0


@pytest.mark.check
def test_the_papers_comparison_on_its_own_small_track(tmp_path: Path) -> None:
    race = Race.running(tmp_path / "race", "--car", "f1tenth")()
    result = read_result(race.out / "result.json")
    laps = {lap.controller: lap for lap in result.laps}
    assert result.settings.track == SMALL
    assert laps["worstcase"].off_track_samples > 0
    best = laps["bestcase"].flying_lap_time_s
    for name in ("bayesrace", "bayesrace-updated", "bestcase"):
        assert laps[name].off_track_samples == 0
        assert laps[name].fallbacks == 0
    updated = laps["bayesrace-updated"].flying_lap_time_s
    assert best is not None
    assert updated == pytest.approx(best, rel=0.005)
