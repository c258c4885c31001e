"""The limit: against a closed form, the plant and published laps; mesh, outline, refusals."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import fsolve

from bayesrace.arrays import Floats
from bayesrace.cache import uses
from bayesrace.errors import InputError
from bayesrace.limit import (
    LimitLap,
    LimitSettings,
    compute_limit,
    limit_lap,
    read_limit,
    write_limit,
)
from bayesrace.operation.settings import RaceSettings
from bayesrace.plant.simulator import Simulator, plant_discretisation
from bayesrace.tracks import StartLine
from bayesrace.vehicles import Car, get_car
from bayesrace.vehicles.models import command_limits, dynamic, top_command
from tests.command_line import Cli, refused
from tests.test_raceline import circle, track_called

CAR = get_car("orca")


def limit_on(name: str, car: Car = CAR, **options: float) -> LimitLap:
    return limit_lap(track_called(name), car, LimitSettings.model_validate(options))


def steady_speed(radius: float) -> float:
    """Of the ORCA car on a circle at full steering lock, by the paper's equations alone.

    Faster it cannot hold the circle: the front tyres have their peak far beyond full lock.
    """
    lf, lr, mass, lock = 0.029, 0.033, 0.041, 0.35

    def unbalanced(speed: Floats) -> list[float]:
        vx, vy = speed
        omega = np.hypot(vx, vy) / radius
        slip = lock - np.arctan((omega * lf + vy) / vx), np.arctan((omega * lr - vy) / vx)
        front = 0.192 * np.sin(1.2 * np.arctan(2.579 * slip[0])) * np.cos(lock)
        rear = 0.1737 * np.sin(1.2691 * np.arctan(3.3852 * slip[1]))
        return [front + rear - mass * vx * omega, 10 * (front * lf - rear * lr)]

    return float(np.hypot(*fsolve(unbalanced, [np.sqrt(7.5 * radius), 0.0], xtol=1e-12)))


@pytest.mark.parametrize("radius", [0.3, 0.5])
def test_on_a_circle_it_is_the_fastest_steady_drive_along_the_inner_edge(radius: float) -> None:
    lap = compute_limit(circle(radius + 0.2, 0.2), CAR)
    assert lap.lap_s == pytest.approx(2 * np.pi * radius / steady_speed(radius), rel=2e-4)
    np.testing.assert_allclose(np.hypot(lap.x[:, 0], lap.x[:, 1]), radius, atol=1e-5)


def driven_by_the_plant(lap: LimitLap, car: Car, piece_s: float) -> tuple[Floats, float]:
    """What the plant makes of the inputs at 1 kHz, beginning anew after each piece: positions (n,
    2), and the largest error of the states at the ends of the pieces, over their sizes."""
    simulator = Simulator(dynamic(car), plant_discretisation(1000))
    size = np.maximum(np.abs(lap.x).max(axis=0), 1e-3)

    def at(time_s: float, values: Floats) -> Floats:
        return np.array([np.interp(time_s, lap.t_s, column) for column in values.T])

    places, worst = [], 0.0
    for begin in np.arange(0.0, lap.lap_s - piece_s, piece_s):
        k = int(np.searchsorted(lap.t_s, begin))
        start = lap.t_s[k]
        simulator.reset(np.clip(lap.x[k], None, [*[np.inf] * 6, car.delta_max_rad]).tolist())
        end = lap.t_s[np.searchsorted(lap.t_s, start + piece_s) - 1]
        steps = int((end - start) * 1000)
        for step in range(steps):
            simulator.step(at(start + (step + 0.5) / 1000, lap.u).tolist())
            places.append(simulator.x[:2].copy())
        error = simulator.x - at(start + steps / 1000, lap.x)
        worst = max(worst, float(np.abs(error / size).max()))
    return np.array(places), worst


@pytest.mark.parametrize(("name", "car"), [("paddock", "orca"), ("workshop", "f1tenth")])
def test_the_plant_can_drive_it_and_stays_on_the_track(name: str, car: str) -> None:
    """With the plant's equations and its guard, at 1 kHz."""
    parameters = get_car(car)
    lap = limit_on(name, parameters)
    places, error = driven_by_the_plant(lap, parameters, 0.1 if car == "orca" else 0.2)
    assert error < 0.02
    off = track_called(name).project_path(places).off_track_m
    assert off.max() < 0.01 * parameters.width_m


def test_a_standing_lap_begins_at_the_start_pose_and_ends_on_the_start_line() -> None:
    track, lap = track_called("paddock"), limit_on("paddock", standing=True)
    np.testing.assert_allclose(lap.x[0], [*track.start_pose(), 0.1, 0, 0, 0], atol=1e-6)
    assert StartLine(track).signed_distance(*lap.x[-1, :2]) == pytest.approx(0, abs=1e-6)
    assert lap.lap_s > limit_on("paddock").lap_s + 0.3


def test_a_flying_lap_closes_and_its_mesh_is_checked() -> None:
    lap = limit_on("paddock")
    assert lap.mesh_change < 1e-3
    assert lap.intervals + 1 == len(lap.t_s) == len(lap.x) == len(lap.u)
    assert lap.t_s[-1] == pytest.approx(lap.lap_s)
    gained = lap.x[-1] - lap.x[0]
    assert abs(gained[2]) == pytest.approx(2 * np.pi)
    np.testing.assert_allclose(np.delete(gained, 2), 0, atol=1e-9)


def test_a_mirrored_track_gives_the_same_lap() -> None:
    mirrored = compute_limit(track_called("paddock").mirrored(), CAR)
    assert mirrored.lap_s == pytest.approx(limit_on("paddock").lap_s, rel=2e-4)


def test_the_outline_stays_on_the_track() -> None:
    """Points all along its sides, not those alone that the optimisation has."""
    track, lap = track_called("paddock"), limit_on("paddock", body=True)
    x, y, psi = lap.x[:, 0], lap.x[:, 1], lap.x[:, 2]
    for ahead in np.linspace(-0.5, 0.5, 23) * CAR.length_m:
        for aside in (-CAR.width_m / 2, CAR.width_m / 2):
            corner = np.column_stack([
                x + ahead * np.cos(psi) - aside * np.sin(psi),
                y + ahead * np.sin(psi) + aside * np.cos(psi),
            ])  # fmt: skip
            assert track.project_path(corner).off_track_m.max() < 5e-4
    assert lap.lap_s > limit_on("paddock").lap_s


def test_a_margin_and_a_largest_lateral_speed_are_kept_and_cost_time() -> None:
    flying, near = limit_on("paddock"), limit_on("paddock", margin_m=0.03)
    gripping = limit_on("paddock", lateral_speed_mps=0.3)
    off = track_called("paddock").project_path(near.x[:, :2]).off_track_m
    assert off.max() == pytest.approx(-0.03, abs=2e-4)
    assert np.abs(gripping.x[:, 4]).max() == pytest.approx(0.3, abs=1e-4)
    assert min(near.lap_s, gripping.lap_s) > flying.lap_s


@pytest.mark.parametrize(
    ("name", "lateral_speed_mps", "published_s"), [("ethz", 0.5, 7.06), ("ethzmobil", 0.7, 5.14)]
)
def test_without_slides_it_is_what_was_published(
    name: str, lateral_speed_mps: float, published_s: float
) -> None:
    lap = limit_on(name, lateral_speed_mps=lateral_speed_mps)
    assert lap.lap_s == pytest.approx(published_s, rel=0.003)


@pytest.mark.parametrize(
    ("name", "standing", "published_s"),
    [("ethz", True, 7.21), ("ethz", False, 7.06), ("ethzmobil", True, 5.40),
     ("ethzmobil", False, 5.14)],
)  # fmt: skip
def test_no_slower_than_what_was_published(name: str, standing: bool, published_s: float) -> None:
    """reference/README.md: of curvilinear coordinates, which do not find the turns in hairpins."""
    lap = limit_on(name, standing=standing)
    assert 0.97 * published_s < lap.lap_s < 1.003 * published_s


def test_a_drive_that_follows_accelerations_keeps_to_its_power() -> None:
    car = get_car("f1tenth")
    lap = limit_on("workshop", car)
    speed = np.hypot(lap.x[:, 3], lap.x[:, 4])
    most = [car.d_max * car.drive.available(v, 0.0) for v in speed.tolist()]
    assert (lap.u[:, 0] <= np.array(most) + 1e-4).all()
    assert speed.max() > car.drive.power_speed_mps  # type: ignore[union-attr]


def test_smooth_limits_of_the_drive_are_its_top_command() -> None:
    car = get_car("f1tenth")
    for v in np.linspace(0.1, 19.9, 67):
        top = float(top_command(car, v, car.d_max))
        assert max(command_limits(car, v, top)) == pytest.approx(0, abs=1e-9)


def test_a_margin_without_room_is_refused() -> None:
    with pytest.raises(InputError, match=r"'paddock' is too narrow for a margin of 0.3 m"):
        compute_limit(track_called("paddock"), CAR, LimitSettings(margin_m=0.3))


def test_no_convergence_is_an_error_not_a_lap() -> None:
    with pytest.raises(InputError, match=r"Maximum_Iterations_Exceeded after 3 .*try a smaller"):
        compute_limit(track_called("paddock"), CAR, LimitSettings(max_iterations=3))


def test_file_round_trip(tmp_path: Path) -> None:
    lap, path = limit_on("paddock"), tmp_path / "limit.csv"
    write_limit(path, lap)
    again = read_limit(path)
    for field in fields(LimitLap):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(lap, field.name))
    text = path.read_text()
    said = f"# lap_s: {lap.lap_s}"
    assert said in text
    for damaged in ("\n".join(text.splitlines()[8:]), text.replace(said, "# lap_s: nan")):
        path.write_text(damaged)
        with pytest.raises(InputError, match="does not say which limit it is"):
            read_limit(path)


def test_the_command_prints_and_writes_it_and_keeps_it_in_the_cache(
    cli: Cli, tmp_path: Path
) -> None:
    lap = limit_on("paddock", standing=True)
    with uses() as made:
        limit_on("paddock", standing=True)
    assert made == [False]
    out = tmp_path / "lap.csv"
    printed = cli("limit", "paddock", "--standing", "--out", out)
    assert printed.code == 0, printed.err
    assert f"standing lap {lap.lap_s:.3f} s" in printed.out
    assert f"{lap.intervals}, solved in {lap.solve_s:.1f} s" in printed.out
    assert read_limit(out).lap_s == lap.lap_s
    kept = limit_on("paddock", lateral_speed_mps=0.3)
    printed = cli("limit", "paddock", "--lateral-speed", 0.3)
    assert f"flying lap {kept.lap_s:.3f} s, centre of gravity" in printed.out
    assert "at most 0.3 m/s sideways" in printed.out


def test_a_start_speed_is_that_of_a_standing_lap(cli: Cli) -> None:
    refused(cli("limit", "paddock", "--start-speed", "1"), "--start-speed", "add --standing")


def test_on_linear_tyres_it_is_said_to_be_no_limit_and_races_leave_it_out(cli: Cli) -> None:
    assert "linear tyres have no limit" in cli("limit", "workshop", "--car", "f1tenth").out
    car = get_car("f1tenth")
    assert not RaceSettings(car=car).compares_limit
    assert RaceSettings(car=car.on_tyres("pacejka")).compares_limit
    assert not RaceSettings(car=CAR, limit=False).compares_limit
