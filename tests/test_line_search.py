"""Racing lines by Bayesian optimisation: speeds, expected improvement, searches, the command."""

import math
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import Matern

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.learning.search import log_improvement, search
from bayesrace.operation.line_search import driven_lap
from bayesrace.raceline import RaceLineSettings, read_raceline_for
from bayesrace.raceline.friction import NodeLines, roughness, speed_profile
from bayesrace.tracks import StartLine, load_track
from bayesrace.vehicles import get_car
from tests.command_line import Cli, refused
from tests.published_line import NODES, objective
from tests.reference import reference_file

CAR = get_car("orca")
PADDOCK = load_track("paddock")


def bowl(x: Floats) -> float:
    return float(np.sum((x - np.array([0.3, 0.6, 0.8])) ** 2) + 1)


def test_speeds_along_an_open_path_are_the_optimum_of_the_convex_program() -> None:
    """Minimum time over a fixed path (Lipp and Boyd 2014), from standstill, solved by IPOPT."""
    s = np.linspace(0, 6, 400)
    step, grip, drive = s[1] - s[0], 7.0, 3.0
    kappa = 2.5 * np.sin(1.7 * s) * np.sin(0.6 * s)
    v = speed_profile(
        kappa,
        np.full(len(s), step),
        grip,
        lambda v: np.full_like(v, drive),
        lambda v: np.full_like(v, -20.0),
        0.1,
        9.0,
        start_mps=0.0,
    )
    energy = ca.MX.sym("E", len(s))
    a = (energy[1:] - energy[:-1]) / (2 * step)
    across = (kappa[1:] + kappa[:-1]) / 2 * (energy[1:] + energy[:-1]) / 2
    speed = ca.sqrt(energy + 1e-9)
    time = ca.sum1(2 * step / (speed[1:] + speed[:-1]))
    programme = {"x": energy, "f": time, "g": ca.vertcat(a**2 + across**2, a)}
    solver = ca.nlpsol("path", "ipopt", programme, {"print_time": 0, "ipopt.print_level": 0})
    high = np.full(len(s), 81.0)
    high[0] = 0.0
    limits = np.concatenate([np.full(len(s) - 1, grip**2), np.full(len(s) - 1, drive)])
    best = float(solver(x0=0.5 * v**2, lbx=0, ubx=high, lbg=-np.inf, ubg=limits)["f"])
    assert solver.stats()["success"]
    ours = float(np.sum(2 * step / (v[1:] + v[:-1])))
    assert ours == pytest.approx(best, rel=5e-3)


def test_expected_improvement_is_that_of_samples_of_the_function() -> None:
    """The mean improvement of 100,000 values that the function may have at a point."""
    rng = np.random.default_rng(1)
    x, points = rng.random((10, 3)), rng.random((100, 3))
    y = np.array([bowl(one) for one in x])
    process = GaussianProcessRegressor(Matern(nu=2.5), optimizer=None, normalize_y=True).fit(x, y)
    found = log_improvement(process, points, y.min())
    for k in np.argsort(-found)[:5]:
        mean, sigma = process.predict(points[k : k + 1], return_std=True)
        values = rng.normal(mean, sigma, 100_000)
        expected = math.log(np.maximum(y.min() - values, 0).mean())
        assert found[k] == pytest.approx(expected, abs=0.05)
    assert np.isfinite(found).all()


def test_a_search_finds_the_minimum_and_is_one_of_its_seed() -> None:
    """Also where the function has no value for half of the points."""

    def half(x: Floats) -> float:
        return bowl(x) if x[0] < 0.5 else math.inf

    for function in (bowl, half):
        first, again = (search(function, np.eye(3), 30, seed=0) for _ in range(2))
        np.testing.assert_array_equal(first.x, again.x)
        assert first.y.min() < 1.01 < first.y[:10].min()
        assert bowl(first.point) == first.y.min()
    with pytest.raises(InputError, match="none of the first 10 evaluations"):
        search(lambda x: math.inf, np.eye(3), 11, seed=0)


@pytest.mark.parametrize("name", ["paddock", "harbour"])
def test_lines_through_nodes_keep_the_margin_and_begin_on_the_start_line(name: str) -> None:
    track = load_track(name)
    lines = NodeLines(track, CAR, RaceLineSettings(), 21)
    rng = np.random.default_rng(0)
    found = [line for line in (lines.line(rng.random(21)) for _ in range(6)) if line is not None]
    assert len(found) >= 3
    for line in found:
        beyond = track.project_points(line.xy_m).off_track_m + CAR.width_m / 2
        assert beyond.max() <= CAR.tuning.raceline.tolerance_m
        start = StartLine(track).signed_distance(line.x_m[0], line.y_m[0])
        assert start == pytest.approx(0.0, abs=1e-9)
        across = line.kappa_radpm * line.vx_mps**2
        assert np.abs(across).max() <= CAR.friction * 9.81 + 1e-6
        assert np.hypot(across, line.ax_mps2).max() <= 1.05 * CAR.friction * 9.81


def test_a_margin_without_room_is_refused() -> None:
    with pytest.raises(InputError, match=r"'paddock' is too narrow for a margin of 0.3 m"):
        NodeLines(PADDOCK, CAR, RaceLineSettings(margin_m=0.3), 12)


def test_command(cli: Cli, tmp_path: Path) -> None:
    """The file is that of its seed and says what it was made for."""
    how = ("--method", "bayesian", "--evaluations", "12", "--nodes", "14")
    done = cli("raceline", "paddock", *how, "--out", "a.csv")
    assert done.code == 0, done.err
    assert "ideal lap; along the minimum-time line" in done.out
    cli("raceline", "paddock", *how, "--out", "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    cli("raceline", "paddock", *how, "--out", "c.csv", "--seed", "3")
    lines = [read_raceline_for(tmp_path / f"{one}.csv", PADDOCK, CAR) for one in "ac"]
    assert lines[0].made_for != lines[1].made_for


def test_refusals(cli: Cli) -> None:
    refused(cli("raceline", "paddock", "--nodes", "12"), "--nodes needs --method bayesian")
    bayesian = ("raceline", "paddock", "--method", "bayesian")
    refused(cli(*bayesian, "--nodes", "3"), "--nodes")
    refused(cli(*bayesian, "--weights", "w.bin"), "--objective driven")


def test_the_driven_lap_is_the_objective(dynamic_artefact: Path) -> None:
    """The controller drives a line through nodes; a lap that it does not finish has no time."""
    lap = driven_lap(dynamic_artefact, None, PADDOCK, CAR)
    line = NodeLines(PADDOCK, CAR, RaceLineSettings(friction=0.5), 16).line(np.full(16, 0.5))
    assert line is not None
    assert 0.8 * line.lap_time_s < lap(line) < 1.5 * line.lap_time_s
    hurried = replace(line, vx_mps=10 * line.vx_mps)
    assert math.isinf(lap(hurried))


@pytest.mark.check
@pytest.mark.parametrize(("name", "published_s"), [("ethz", 7.033), ("ethzmobil", 4.871)])
def test_fifty_evaluations_beat_the_published_mean_of_110(name: str, published_s: float) -> None:
    """reference/README.md, its better method; the objective is the published one."""
    folder = reference_file(f"tracks/{name}.csv").parent
    function, count = objective(folder, name), len(NODES[name])
    laps = [
        search(function, roughness(count), evaluations=50, seed=seed).y.min() for seed in range(3)
    ]
    assert np.mean(laps) < published_s
