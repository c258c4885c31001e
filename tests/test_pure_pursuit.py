"""The data-collecting driver: laps complete, limits hold, the car is excited, seeds repeat."""

import math
from typing import Any

import numpy as np
import pytest

from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.pure_pursuit import PurePursuit, PurePursuitSettings
from bayesrace.controller.python_controller import PythonController
from bayesrace.errors import InputError
from bayesrace.operation.closed_loop import ClosedLoop, Driven
from bayesrace.plant.simulator import Simulator
from bayesrace.tracks import DEFAULT_TRAINING_TRACK, Track, load_track
from bayesrace.vehicles import default_car
from bayesrace.vehicles.models import dynamic
from tests.conftest import offset_line

CAR = default_car()
SIMULATOR = Simulator(dynamic(CAR))


def oval(points: int = 200) -> tuple[Any, Any, Any]:
    angle = np.linspace(0, 2 * np.pi, points, endpoint=False)
    return 2 * np.cos(angle), np.sin(angle), np.full(points, 1.5)


TRACK = Track.from_points("oval", np.column_stack(oval()[:2]), 0.5, 0.5)


def drive(
    driver: PurePursuit,
    laps: int,
    time_s: float,
    track: Track = TRACK,
    x0: tuple[float, ...] | None = None,
) -> Driven:
    line = offset_line(track, 0.0, 5.0, 1.5)
    controller = PythonController(build(BuildSettings())[0], driver)
    return ClosedLoop(CAR, track, line, controller, SIMULATOR).drive(laps, time_s, x0=x0)


START = (2.0, 0.0, math.pi / 2, 0.1, 0.0, 0.0, 0.0)


def test_it_laps_an_oval_without_leaving_it() -> None:
    driven = drive(PurePursuit(CAR, *oval()), 2, 60.0)
    assert driven.lap[-1] == 2
    radius = np.hypot(driven.x[:, 0] / 2, driven.x[:, 1])
    assert np.abs(radius - 1).max() < 0.2


@pytest.mark.parametrize("seed", [0, 1])
def test_it_laps_a_built_in_track_within_the_cars_limits(seed: int) -> None:
    """Along the centreline at 1.6 m/s: no racing line is needed to see it drive."""
    track = load_track(DEFAULT_TRAINING_TRACK)
    s_m = np.linspace(0, track.length_m, 400, endpoint=False)
    xy = track.position(s_m)
    driver = PurePursuit(CAR, xy[:, 0], xy[:, 1], np.full(400, 1.6), PurePursuitSettings(seed=seed))
    clipped = SIMULATOR.guard.counters.clipped
    driven = drive(driver, 2, 60.0, track)
    states, inputs = driven.x, driven.u
    assert driven.lap[-1] == 2
    assert SIMULATOR.guard.counters.clipped == clipped, "it saturates as the car does"
    assert (inputs[:, 0] >= CAR.d_min).all()
    assert (inputs[:, 0] <= CAR.d_max).all()
    assert (np.abs(inputs[:, 1]) <= CAR.delta_rate_max_radps).all()
    assert (np.abs(states[:, 6]) <= CAR.delta_max_rad).all()
    off = track.project_path(states[:, :2]).off_track_m
    assert off.max() < 0.1
    assert inputs[:, 0].std() > 0.05
    assert inputs[:, 1].std() > 0.3


def test_the_seed_and_nothing_else_decides_the_disturbance() -> None:
    runs = [
        drive(PurePursuit(CAR, *oval(), PurePursuitSettings(seed=seed)), 1, 3.0).x
        for seed in (5, 5, 6)
    ]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert np.abs(runs[0] - runs[2]).max() > 1e-3


def test_the_target_speed_sways_as_the_cars_tuning_says() -> None:
    quiet = PurePursuitSettings(speed_scale=1.0, excite_d=0.0, excite_delta_rad=0.0)

    def speeds(slower: float) -> tuple[float, float]:
        pursuit = CAR.tuning.pursuit.model_copy(update={"faster": 0.1, "slower": slower})
        car = CAR.model_copy(update={"tuning": CAR.tuning.model_copy(update={"pursuit": pursuit})})
        vx = drive(PurePursuit(car, *oval(), quiet), 0, 9.0).x[200:, 3]
        return float(vx.min()), float(vx.max())

    assert speeds(0.15) == pytest.approx((0.85 * 1.5, 1.1 * 1.5), abs=0.05)
    assert speeds(0.6) == pytest.approx((0.4 * 1.5, 1.1 * 1.5), abs=0.1)


def test_a_mirrored_line_is_driven_with_mirrored_steering() -> None:
    quiet = PurePursuitSettings(excite_d=0.0, excite_delta_rad=0.0)
    x, y, v = oval()
    left = drive(PurePursuit(CAR, x, y, v, quiet), 1, 3.0, x0=START).x
    mirrored = (*START[:2], -START[2], *START[3:])
    right = drive(PurePursuit(CAR, x, -y, v, quiet), 1, 3.0, x0=mirrored).x
    signs = np.array([1, -1, -1, 1, -1, -1, -1])
    np.testing.assert_allclose(right, left * signs, rtol=0, atol=1e-6)


def test_a_car_far_from_where_it_was_finds_the_line_again() -> None:
    driver = PurePursuit(CAR, *oval())
    driver.reset()
    driver.step(np.array(START), np.zeros(2))
    elsewhere = np.array([-2.0, 0.1, -math.pi / 2, 1.0, 0.0, 0.0, 0.0])
    arc = driver.step(elsewhere, np.zeros(2)).numbers["s_ref_m"]
    perimeter = 9.688
    assert arc == pytest.approx(perimeter / 2, abs=0.2)


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        (oval(5), "at least 10 finite points"),
        ((oval()[0] * np.nan, *oval()[1:]), "finite points"),
        ((*oval()[:2], np.ones(3)), "one finite speed for each point"),
        ((np.append(oval()[0], 2.0), np.append(oval()[1], 0.0), np.ones(201)), "repeats a point"),
    ],
)
def test_an_unusable_line_is_refused(line: Any, fault: str) -> None:
    with pytest.raises(InputError, match=fault):
        PurePursuit(CAR, *line)
