"""Racing line: optimal against analytic answers, drivable everywhere, and its file form."""

from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.raceline import (
    RaceLine,
    RaceLineError,
    RaceLineSettings,
    compute_raceline,
    read_raceline,
    read_raceline_for,
    write_raceline,
)
from bayesrace.raceline.friction import car_limits, speed_profile
from bayesrace.raceline.line import line_identity
from bayesrace.tracks import StartLine, Track, load_track
from bayesrace.vehicles import described_car, get_car
from bayesrace.vehicles.parts import GRAVITY_MPS2
from tests.reference import reference_file

CAR = get_car("orca")
REFERENCE = ("ethz", "ethzmobil")
NAMES = (*REFERENCE, "paddock", "harbour", "random:1", "random:2")


def circle(radius: float = 1.0, width: float = 0.2, count: int = 120) -> Track:
    """Anticlockwise circle about the origin, ``width`` to each side."""
    angle = np.arange(count) * (2 * np.pi / count)
    xy = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return Track.from_points("circle", xy, width, width)


@cache
def track_called(name: str) -> Track:
    return load_track(reference_file(f"tracks/{name}.csv") if name in REFERENCE else name)


@cache
def line_on(name: str, **options: Any) -> RaceLine:
    step_m = options.pop("step_m", CAR.tuning.raceline.step_m)
    car = described_car(CAR.model_dump() | {"tuning": {"raceline": {"step_m": step_m}}})
    return compute_raceline(track_called(name), car, RaceLineSettings(**options))


def closed_difference(values: Floats, gain: float = 0.0) -> Floats:
    return np.diff(np.append(values, values[0] + gain))


@pytest.mark.parametrize("name", NAMES)
def test_line_keeps_the_margin_to_the_real_track(name: str) -> None:
    """The optimiser's frame is smoothed; the check is against the track itself, to 1 mm."""
    where = track_called(name).project_path(line_on(name).xy_m)
    assert where.off_track_m.max() <= -CAR.width_m / 2 + 1e-3
    assert where.off_track_m.max() > -CAR.width_m / 2 - 2e-3, "the optimum uses all of the track"


@pytest.mark.parametrize("name", NAMES)
def test_line_is_one_closed_consistent_curve(name: str) -> None:
    """s, x, y, psi, kappa, vx, ax of the same curve, across the lap seam too."""
    line = line_on(name)
    step = line.length_m / len(line.s_m)
    np.testing.assert_allclose(np.diff(line.s_m), step, rtol=1e-9)
    assert 0.008 < step < 0.012
    edge = np.roll(line.xy_m, -1, axis=0) - line.xy_m
    np.testing.assert_allclose(np.linalg.norm(edge, axis=1), step, rtol=2e-3)
    turn = 2 * np.pi * np.round((line.psi_rad[-1] - line.psi_rad[0]) / (2 * np.pi))
    assert abs(turn) == pytest.approx(2 * np.pi)
    middle = line.psi_rad + closed_difference(line.psi_rad, turn) / 2
    chord = np.arctan2(edge[:, 1], edge[:, 0])
    assert np.abs(np.angle(np.exp(1j * (chord - middle)))).max() < 2e-3
    # between two stations kappa is linear; within a sample it may kink by the steering rate limit
    kappa = (line.kappa_radpm + np.roll(line.kappa_radpm, -1)) / 2
    np.testing.assert_allclose(closed_difference(line.psi_rad, turn) / step, kappa, atol=0.1)
    gained = closed_difference(line.vx_mps**2) / (2 * step)
    meant = (line.ax_mps2 + np.roll(line.ax_mps2, -1)) / 2
    assert np.abs(gained - meant).max() < 0.2
    assert np.median(np.abs(gained - meant)) < 1e-3


@pytest.mark.parametrize("name", NAMES)
def test_speeds_can_be_driven_everywhere(name: str) -> None:
    """Friction circle, drive and brake limits, steering angle and rate, at every point."""
    line, limits = line_on(name), car_limits(CAR, RaceLineSettings())
    v, a = line.vx_mps, line.ax_mps2
    ay = line.kappa_radpm * v**2
    assert np.hypot(a, ay).max() <= 1.005 * CAR.friction * GRAVITY_MPS2

    assert (a - limits.straight_values(v, CAR.d_max)).max() <= 0.02
    too_little = limits.straight_values(v, CAR.d_min) - a
    assert too_little.max() <= 0.005
    steering = np.asarray(limits.steering(line.kappa_radpm)).ravel()
    assert np.abs(steering).max() <= CAR.delta_max_rad + 1e-3
    rate = closed_difference(steering) / (line.length_m / len(v)) * v
    assert np.abs(rate).max() <= 1.04 * CAR.delta_rate_max_radps


@pytest.mark.parametrize("name", NAMES)
def test_line_begins_on_the_start_line_at_the_optimum_of_a_flying_lap(name: str) -> None:
    line = line_on(name)
    start = StartLine(track_called(name))
    assert start.signed_distance(line.x_m[0], line.y_m[0]) == pytest.approx(0.0, abs=1e-9)
    assert line.track_name == track_called(name).name
    step = line.length_m / len(line.s_m)
    assert line.lap_time_s == pytest.approx(float(np.sum(step / line.vx_mps)), rel=1e-3)


@pytest.mark.parametrize(("name", "limit_s"), [("ethz", 7.06), ("ethzmobil", 5.14)])
def test_lap_time_is_near_that_of_the_true_model(name: str, limit_s: float) -> None:
    """reference/README.md: minimum time with the true tyre curves, without a margin, flying."""
    assert line_on(name).lap_time_s == pytest.approx(limit_s, rel=0.05)


@pytest.mark.check
def test_halving_the_intervals_hardly_changes_the_lap() -> None:
    coarse, fine = line_on("harbour", step_m=0.05), line_on("harbour", step_m=0.025)
    assert coarse.lap_time_s == pytest.approx(fine.lap_time_s, rel=0.01)
    path = track_called("harbour").project_path(coarse.xy_m)
    other = track_called("harbour").project_path(fine.xy_m)
    n = np.interp(path.s_m, np.sort(other.s_m), other.n_m[np.argsort(other.s_m)])
    assert np.abs(n - path.n_m).max() < 0.02


def test_mirrored_track_gives_the_mirrored_line() -> None:
    line = line_on("paddock")
    mirror = compute_raceline(track_called("paddock").mirrored(), CAR, RaceLineSettings())
    assert mirror.lap_time_s == pytest.approx(line.lap_time_s, rel=1e-5)
    np.testing.assert_allclose(mirror.x_m, line.x_m, atol=1e-3)
    np.testing.assert_allclose(mirror.y_m, -line.y_m, atol=1e-3)
    np.testing.assert_allclose(mirror.vx_mps, line.vx_mps, atol=1e-2)
    np.testing.assert_allclose(mirror.psi_rad, -line.psi_rad, atol=1e-2)


def test_circle_limited_by_grip_is_driven_on_its_inner_edge() -> None:
    """T = 2 pi sqrt(r / (mu g)) grows with r: the smallest circle is the fastest."""
    settings = RaceLineSettings(friction=0.4, margin_m=0.02)
    line = compute_raceline(circle(1.0, 0.2), CAR, settings)
    np.testing.assert_allclose(np.hypot(line.x_m, line.y_m), 0.82, atol=1e-3)
    np.testing.assert_allclose(line.kappa_radpm, 1 / 0.82, rtol=5e-3)
    expected = 2 * np.pi * np.sqrt(0.82 / (0.4 * GRAVITY_MPS2))
    assert line.lap_time_s == pytest.approx(expected, rel=1e-3)
    np.testing.assert_allclose(line.ax_mps2, 0.0, atol=0.02)


def test_limits_are_those_of_the_reference() -> None:
    """reference/README.md: drive 4.40/3.04/1.67/.28 m/s^2 at 1/2/3/4 m/s, braking 1.6 to 2.0."""
    limits = car_limits(CAR, RaceLineSettings())
    v = np.array([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(limits.straight_values(v, 1.0), [4.40, 3.04, 1.67, 0.28], atol=0.02)
    brake = limits.straight_values(v, -0.1)
    assert ((brake > -2.0) & (brake < -1.55)).all()


def test_guess_closes_the_lap_within_the_limits() -> None:
    """Forward-backward profile: no acceleration beyond the limits, across the seam too."""
    rng = np.random.default_rng(3)
    kappa = np.repeat(rng.uniform(-4, 4, 20), 30)
    step = np.full(len(kappa), 0.03)
    v = speed_profile(kappa, step, 8.0, lambda v: 4 - v, lambda v: -2 + 0 * v, 0.3, 4.0)
    a = (np.roll(v, -1) ** 2 - v**2) / (2 * step)
    assert (v**2 * np.abs(kappa)).max() <= 8.0 + 1e-9
    assert (a <= 4 - v + 1e-2).all()
    assert (a >= -2 - 1e-9).all()


def test_a_margin_without_room_is_refused() -> None:
    with pytest.raises(InputError, match=r"'paddock' is too narrow for a margin of 0.3 m"):
        compute_raceline(track_called("paddock"), CAR, RaceLineSettings(margin_m=0.3))


def test_no_convergence_is_an_error_not_a_line() -> None:
    with pytest.raises(RaceLineError, match="Maximum_Iterations_Exceeded after 3 iterations"):
        compute_raceline(track_called("paddock"), CAR, RaceLineSettings(max_iterations=3))


def test_file_round_trip(tmp_path: Path) -> None:
    line = line_on("paddock")
    path = tmp_path / "line.csv"
    write_raceline(path, line)
    again = read_raceline(path, "paddock")
    for field in fields(RaceLine):
        here, there = getattr(line, field.name), getattr(again, field.name)
        np.testing.assert_array_equal(here, there)
    assert again.lap_time_s == line.lap_time_s
    first, last = (path.read_text().splitlines()[i] for i in (0, -1))
    assert first == "# s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2"
    assert float(last.split(";")[0]) == pytest.approx(line.length_m)


def ring(count: int = 40) -> RaceLine:
    """A circle of radius 1 at 2 m/s."""
    angle = np.arange(count, dtype=np.float64) * (2 * np.pi / count)
    one = np.ones(count)
    xy = np.cos(angle), np.sin(angle)
    return RaceLine("ring", angle, *xy, angle + np.pi / 2, one, 2 * one, 0 * one, 2 * np.pi)


def test_lines_of_others_without_the_repeated_point_are_read(tmp_path: Path) -> None:
    path = tmp_path / "ring.csv"
    write_raceline(path, ring())
    lines = path.read_text().splitlines()[:-1]
    path.write_text("\n".join(["# made elsewhere", *[x.replace(";", ",") for x in lines]]))
    line = read_raceline(path)
    assert line.track_name == "ring"
    assert line.length_m == pytest.approx(2 * np.pi, rel=1e-3)
    assert line.lap_time_s == pytest.approx(np.pi, rel=1e-3)


@pytest.mark.parametrize("turned", [0.0, -np.pi / 2])
def test_headings_of_others_become_continuous_and_count_from_the_x_axis(
    tmp_path: Path, turned: float
) -> None:
    """TUM's planner counts them from the y axis. Both wrap. No other number moves."""
    path, again, here = tmp_path / "ring.csv", tmp_path / "again.csv", ring()
    write_raceline(path, replace(here, psi_rad=np.angle(np.exp(1j * (here.psi_rad + turned)))))
    line = read_raceline(path)
    np.testing.assert_allclose(line.psi_rad - line.psi_rad[0], here.psi_rad - here.psi_rad[0])
    assert np.cos(line.psi_rad[0] - here.psi_rad[0]) == pytest.approx(1)
    write_raceline(again, line)
    for field in fields(RaceLine)[1:]:
        there = getattr(read_raceline(again), field.name)
        np.testing.assert_array_equal(getattr(line, field.name), there)
    np.testing.assert_array_equal(line.xy_m, here.xy_m)
    np.testing.assert_array_equal(line.vx_mps, here.vx_mps)


def test_a_published_line_is_read_number_by_number() -> None:
    path = reference_file("tracks/spielberg_map/Spielberg_raceline.csv")
    table, line = np.loadtxt(path, delimiter=";", comments="#"), read_raceline(path)
    for column, name in enumerate(("s_m", "x_m", "y_m", "psi_rad", "kappa_radpm", "vx_mps")):
        if name != "psi_rad":
            np.testing.assert_array_equal(getattr(line, name), table[:-1, column])
    np.testing.assert_allclose(np.cos(line.psi_rad - table[:-1, 3]), 1)
    assert line.length_m == table[-1, 0] - table[0, 0]
    assert np.ptp(line.psi_rad) > 6.0


def test_a_line_says_what_it_was_made_for(tmp_path: Path) -> None:
    line, path = line_on("paddock"), tmp_path / "line.csv"
    write_raceline(path, line)
    head = path.read_text().splitlines()[1:6]
    assert head[:3] == [f"# car: {CAR.identity}", "# width_m: 0.05", "# friction: 0.75"]
    assert read_raceline(path).made_for == line.made_for
    slower = line_identity(track_called("paddock"), CAR, RaceLineSettings(margin_m=0.03))
    assert line.made_for is not None
    assert slower.settings != line.made_for.settings


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mass_kg": 0.05}, ("orca-", "for the car", "bayesrace raceline")),
        ({"width_m": 0.06}, ("0.05 m wide", "0.06 m", "bayesrace raceline")),
        ({"friction": 0.7}, ("friction of 0.75", "has 0.7:", "bayesrace raceline")),
        ({}, ("track 'paddock-", "this is 'ring-", "bayesrace raceline")),
    ],
)
def test_a_line_for_another_car_grip_or_track_is_refused(
    tmp_path: Path, change: dict[str, float], words: tuple[str, ...]
) -> None:
    """Both are named, and what to do."""
    track, path = track_called("paddock"), tmp_path / "line.csv"
    made = line_identity(track, CAR, RaceLineSettings())
    write_raceline(path, replace(ring(), made_for=made))
    other = CAR.model_copy(update=change)
    driven = track if change else replace(circle(1.0, 0.2), name="ring")
    with pytest.raises(InputError) as caught:
        read_raceline_for(path, driven, other)
    assert all(word in str(caught.value) for word in (str(path), *words))
    named = CAR.model_copy(update={"name": "mine"})
    assert read_raceline_for(path, replace(track, name="mine"), named).made_for == made


def test_a_line_from_elsewhere_is_accepted_and_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "ring.csv"
    write_raceline(path, ring())
    path.write_text("# car: a note\n" + path.read_text())
    assert read_raceline_for(path, track_called("paddock"), CAR).made_for is None
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert str(path) in record.getMessage()


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("1; 2; 3", "3 columns instead of 7"),
        ("0.1; 2; 3; 0; 0; 1; 0", "s_m does not grow"),
        ("0.47124; 2; 3; 0; 0; 1; 0", "s_m and the distance"),
        ("0.4712; 0.891007; 0.453990; 2; 1; 0; 0", "vx_mps is not positive"),
    ],
)
def test_a_bad_row_of_a_line_is_named(tmp_path: Path, bad: str, message: str) -> None:
    path = tmp_path / "ring.csv"
    write_raceline(path, ring())
    lines = path.read_text().splitlines()
    lines[4] = bad
    path.write_text("\n".join(lines))
    with pytest.raises(InputError) as caught:
        read_raceline(path)
    assert f"{path}, row 5: {message}" in str(caught.value)


def test_open_and_short_lines_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "ring.csv"
    write_raceline(path, ring())
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:25]))
    with pytest.raises(InputError, match=r"row 25: the line ends .* must be closed"):
        read_raceline(path)
    path.write_text("\n".join(lines[:4]))
    with pytest.raises(InputError, match=r"too few points \(3\)"):
        read_raceline(path)


def test_a_second_try_from_lower_speeds_finds_the_same_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On the 343 m of Spielberg the first, from the car's limits, does not converge."""
    monkeypatch.setattr("bayesrace.raceline.ocp._FIRST_ITERATIONS", 3)
    again, line = compute_raceline(track_called("paddock"), CAR), line_on("paddock")
    assert again.lap_time_s == pytest.approx(line.lap_time_s, rel=1e-6)
    np.testing.assert_allclose(again.xy_m, line.xy_m, atol=1e-4)
