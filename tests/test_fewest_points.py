"""``train --points auto``: the rule, the learned car that it asks, and drives of no known track."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace.controller.assembly import compiled_controller
from bayesrace.errors import InputError
from bayesrace.gp.expression import corrected_function
from bayesrace.gp.weights import Weights, read_weights, zero_weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.sources import Samples
from bayesrace.learning.training import Training, fit
from bayesrace.learning.validation import NOMINAL, identity
from bayesrace.operation.closed_loop import ClosedLoop, built_in_car
from bayesrace.operation.fewest_points import Attempt, LearnedCar, fewest_points
from bayesrace.operation.terminal.terminal import Stages, Terminal
from bayesrace.raceline import racing_line
from bayesrace.tracks import load_track
from bayesrace.vehicles.models import dynamic
from tests.command_line import Cli, refused
from tests.driven import CAR, QUICK, drive, write_log


def attempt(*laps_s: float, spread: tuple[float, ...] = (0.0,) * 3, off: int = 0) -> Attempt:
    """Three laps about each of these times, one a track; ``spread``: as shares of them."""
    unused: Any = None
    return Attempt(unused, np.outer(laps_s, 1 + np.array(spread)), off)


def varied(steady_s: float, varied_s: float) -> Attempt:
    """One track with equal laps, and one without."""
    both = attempt(steady_s, varied_s)
    both.laps_s[1] += (-0.03, 0.0, 0.03)
    return both


@pytest.mark.parametrize(
    ("fewer", "enough"),
    [
        (attempt(5.004, 10.0), True),
        (attempt(5.006, 10.0), False),
        (attempt(4.9, 10.02), False),  # the track on which it loses most decides
        (attempt(4.9, float("nan")), False),
        (attempt(4.9, 9.9, off=2), True),
        (attempt(4.9, 9.9, off=3), False),
        (attempt(5.002, 10.0, spread=(-0.0002, 0.0, 0.0002)), True),
        (attempt(5.002, 10.0, spread=(-0.002, 0.0, 0.002)), False),  # not shown: laps vary by more
        (varied(5.002, 10.0), False),  # nor on the track where less seems to be lost
    ],
)
def test_fewer_points_are_enough_where_they_are_shown_to_cost_no_thousandth_of_a_lap(
    fewer: Attempt, enough: bool
) -> None:
    assert fewer.enough(attempt(5.0, 10.0, off=2)) is enough


def test_the_learned_car_is_the_corrected_map_of_what_the_guard_lets_act() -> None:
    weights = fit(drive(dynamic(CAR), 160, seed=1), PREDICTION, QUICK).weights
    corrected = corrected_function(NOMINAL(CAR), PREDICTION, weights)
    car, x0 = LearnedCar(CAR, PREDICTION, weights), (1.0, 2.0, 0.3, 1.5, 0.1, -0.5, 0.1)
    for given, acts in (((0.4, 2.0), (0.4, 2.0)), ((9.0, 0.0), (CAR.d_max, 0.0))):
        car.reset(x0)
        car.step(given)
        expected = np.asarray(corrected(x0, acts))[:, 0]
        assert car.u_applied == acts
        assert car.x == pytest.approx(expected, abs=1e-12)


def test_drives_of_no_known_track_are_refused_with_the_remedy(cli: Cli, tmp_path: Path) -> None:
    data = drive(dynamic(CAR), 160, seed=1)
    for track in ("", "nowhere", "harbour"):  # it was not on harbour, whatever its log says
        write_log(tmp_path / "drive.mcap", data, metadata={"drive": {"track": track}})
        refused(cli("train", "drive.mcap", "--points", "auto"), "--track")
    refused(cli("train", "drive.mcap", "--points", "19"), "--points 19", "20")
    refused(cli("train", "drive.mcap", "--track", "harbour"), "--track", "--points auto")


def test_a_learned_car_that_drives_no_lap_is_refused(kinematic_artefact: Path) -> None:
    data = drive(dynamic(CAR), 160, seed=1)
    samples = Samples(data, PREDICTION)
    nothing = zero_weights(CAR.name, identity(data, PREDICTION))
    vx, vy, omega = nothing.outputs
    braked = replace(nothing, outputs=(replace(vx, y_mean=-0.2), vy, omega))  # by 10 m/s²
    training = Training(braked, (), data)
    stages = Stages(Terminal(), None)
    with pytest.raises(InputError, match="--track"):
        fewest_points(
            samples, [load_track("harbour")], kinematic_artefact, lambda _: training, stages
        )


@pytest.mark.check
def test_the_chosen_points_cost_the_true_car_no_more_than_was_said(
    cli: Cli, tmp_path: Path, kinematic_artefact: Path
) -> None:
    """Learned and chosen without it, the true car is an independent judge: within 0.2 % of a lap,
    twice what is allowed. The weights are those of ``--points N``."""
    assert cli("raceline", "random:7", "--out", "line.csv").code == 0
    course = ("--track", "random:7", "--raceline", "line.csv")
    assert cli("collect", *course, "--out", "drive.mcap").code == 0
    done = cli("train", "drive.mcap", "--points", "auto", "--out", "auto.bin")
    assert done.code == 0, done.err
    chosen = read_weights(tmp_path / "auto.bin")
    points = max(chosen.counts)
    assert f"{points} ✓" in done.out
    assert points < 400
    laps_s = {}
    for count in (400, points):
        assert cli("train", "drive.mcap", "--points", str(count), "--out", f"{count}.bin").code == 0
        laps_s[count] = true_lap_s(kinematic_artefact, read_weights(tmp_path / f"{count}.bin"))
    assert read_weights(tmp_path / f"{points}.bin").version == chosen.version
    assert laps_s[points] < 1.002 * laps_s[400]


def true_lap_s(artefact: Path, weights: Weights) -> float:
    """Mean flying lap of random:7."""
    track = load_track("random:7")
    line = racing_line(track, CAR)
    controller = compiled_controller(artefact, CAR, track, line, weights)
    driven = ClosedLoop(CAR, track, line, controller, built_in_car(CAR)).drive(4)
    assert float(driven.off_track_m.max()) <= 0
    return float(np.mean(driven.laps_s[1:]))
