"""``import bayesrace``: car, track, controller, simulator, closed loop, training, recordings."""

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import (
    RBF,
    ConstantKernel,
    DotProduct,
    Matern,
    RationalQuadratic,
    WhiteKernel,
)

import bayesrace as br
from bayesrace.arrays import Floats
from bayesrace.raceline import read_raceline
from tests import public_interface
from tests.conftest import smooth_drive
from tests.programs import Race


@pytest.fixture(scope="module")
def orca() -> br.Car:
    return br.Car.load("orca")


@pytest.fixture(scope="module")
def harbour() -> br.Track:
    return br.Track.load("harbour")


@pytest.fixture(scope="module")
def controller(orca: br.Car, harbour: br.Track) -> br.Controller:
    return br.Controller(orca, harbour)


@pytest.fixture(scope="module")
def first(controller: br.Controller) -> br.Run:
    """Without a correction; the car leaves the track, which it learns from."""
    simulator = br.Simulator(controller.car, controller.track)
    return br.drive(controller, simulator, laps=0, max_time_s=8.0)


@pytest.fixture(scope="module")
def weights(first: br.Run) -> br.Weights:
    return br.train(first, points=200)


@pytest.fixture(autouse=True)
def _as_new(request: pytest.FixtureRequest) -> None:
    """No test sees the weights or the run of the one before."""
    if "controller" in request.fixturenames:
        controller = request.getfixturevalue("controller")
        controller.weights = None
        controller.reset()


# What is public -----------------------------------------------------------------------------------


def test_nothing_becomes_public_by_accident() -> None:
    """After a change that is meant: python -m tests.public_interface"""
    assert public_interface.LISTED.read_text() == public_interface.described()


def test_the_package_imports_what_is_used_and_no_zenoh() -> None:
    blocked = (
        "import sys; sys.modules['zenoh'] = None\n"
        "import bayesrace as br\n"
        "assert set(br.__all__) <= set(dir(br))\n"
        "print(sorted({'numpy', 'casadi', 'pydantic'} & set(sys.modules)))\n"
        "br.Controller, br.Simulator, br.drive, br.train, br.Log, br.Mpc, br.ocp\n"
        "print('bayesrace.transport' in sys.modules)"
    )
    said = subprocess.check_output([sys.executable, "-c", blocked], text=True)
    assert said.split() == ["[]", "False"]


# A loop of one's own ------------------------------------------------------------------------------


def test_a_loop_of_ones_own_is_the_closed_loop_to_the_bit(
    controller: br.Controller, weights: br.Weights
) -> None:
    """Which in turn is that of the processes: test_closed_loop."""
    controller.weights = weights
    simulator = br.Simulator(controller.car, controller.track)
    run = br.drive(controller, simulator, laps=1)
    state = simulator.reset()
    for x, u in zip(run.x[:-1], run.u, strict=True):
        assert (state.to_numpy() == x).all()
        out = controller.step(state, dt=0.02, u_applied=simulator.u_applied)
        state = simulator.step(out.u)
        assert (simulator.u_applied.to_numpy() == u).all()
    assert (state.to_numpy() == run.x[-1]).all()


@pytest.mark.parametrize("model", ["e_kinematic", "dynamic"])
def test_a_run_is_that_of_a_race_to_the_bit(
    model: Literal["e_kinematic", "dynamic"], peanut_race: Race
) -> None:
    """What plant and controller processes drove over Zenoh, from the files that they left."""
    out = peanut_race.out
    name = {"e_kinematic": "bayesrace", "dynamic": "bestcase"}[model]
    laps = json.loads((out / "result.json").read_text())["laps"]
    number = next(one["run"] for one in laps if one["controller"] == name)
    truth = br.Log(out / "run.mcap")["truth"]
    raced = truth[truth["run"] == number]["x"]
    car = br.Car.load(out / "car.toml")
    track = br.Track.load(out / "race.csv", car)
    controller = br.Controller(car, track, read_raceline(out / "race_raceline.csv"), model=model)
    if model == "e_kinematic":
        controller.weights = br.Weights.load(out / "weights-bayesrace.bin")
    run = br.drive(controller, br.Simulator(car, track), laps=2)
    assert (run.x == raced).all()


def test_a_step_tells_plan_tube_level_and_times(
    controller: br.Controller, weights: br.Weights
) -> None:
    controller.weights = weights
    simulator = br.Simulator(controller.car, controller.track)
    state, out = simulator.state, None
    for _ in range(20):
        out = controller.step(state)
        state = simulator.step(out.u)
    assert out is not None
    assert (out.status, out.level, out.fault) == (br.Status.CONVERGED, br.Level.SOLUTION, "")
    assert (out.plan.shape, out.plan_u.shape, out.tube.shape) == ((21, 7), (20, 2), (20,))
    assert np.allclose(out.plan_u[0], out.u)
    assert np.allclose(out.plan[1], state, atol=0.02)
    assert 0 < out.tube.max() < 0.5
    assert 0 < out.times.solve_us < 1e5 > out.times.prepare_us > 0
    kept = out.plan.copy()
    controller.step(state)
    assert (out.plan == kept).all()  # it is the caller's


def test_without_a_state_the_car_is_driven_on_then_braked(controller: br.Controller) -> None:
    simulator = br.Simulator(controller.car, controller.track)
    state = simulator.state
    for _ in range(10):
        state = simulator.step(controller.step(state).u)
    levels = [controller.step(None).level for _ in range(12)]
    assert levels[0] < br.Level.BRAKE <= levels[-1]


def test_a_known_delay_is_compensated(orca: br.Car, harbour: br.Track) -> None:
    """By the constant, and by what a step is told of the one before."""
    simulator = br.Simulator(orca, harbour)
    at_speed = br.State(*harbour.start_pose(), 1.0, 0.0, 0.0, 0.0)
    constant = br.Controller(orca, harbour, delay_s=0.04)
    told = br.Controller(orca, harbour)
    for one, delay_s, wanted_s in ((constant, None, 0.04), (told, 0.04, 0.04), (told, 0.0, 0.0)):
        one.reset()
        state = simulator.step(one.step(simulator.reset(at_speed)).u)
        ahead = one.step(state, delay_s=delay_s).plan[0, :2] - state.to_numpy()[:2]
        assert np.linalg.norm(ahead) == pytest.approx(wanted_s * state.vx, rel=0.15, abs=1e-9)


def test_both_problems_and_the_perfect_model_drive(orca: br.Car, harbour: br.Track) -> None:
    best = br.Controller(orca, harbour, model="dynamic")
    limit = br.Controller(orca, harbour, problem="progress", model="dynamic")
    simulator = br.Simulator(orca, harbour)
    laps = [br.drive(one, simulator, laps=2).laps for one in (best, limit)]
    assert laps[1][1] < laps[0][1] < 6.7


# A simulator of one's own -------------------------------------------------------------------------


class Own:
    """The equations again, behind ``reset`` and ``step``."""

    def __init__(self, car: br.Car, track: br.Track) -> None:
        self._car = br.Simulator(car, track)

    def reset(self, x0: Floats) -> Any:
        return self._car.reset(x0)

    def step(self, u: Floats) -> Any:
        return self._car.step(u).to_numpy()  # a state or an array


def test_a_simulator_of_ones_own_is_driven(controller: br.Controller, weights: br.Weights) -> None:
    controller.weights = weights
    own = br.drive(controller, Own(controller.car, controller.track), laps=1)
    run = br.drive(controller, br.Simulator(controller.car, controller.track), laps=1)
    # What the actuators clip by rounding is not reported back.
    assert own.laps == pytest.approx(run.laps, abs=1e-6)


def test_what_a_simulator_of_ones_own_raises_passes_through(controller: br.Controller) -> None:
    class Broken(Own):
        def step(self, u: Floats) -> Any:
            raise KeyError("engine")

    with pytest.raises(KeyError, match="engine"):
        br.drive(controller, Broken(controller.car, controller.track))
    simulator = br.Simulator(controller.car, controller.track)
    assert controller.step(simulator.state).level == br.Level.SOLUTION  # it goes on


# Runs and recordings ------------------------------------------------------------------------------


def test_a_run_is_a_table_a_picture_and_a_recording(
    controller: br.Controller, weights: br.Weights, tmp_path: Path
) -> None:
    controller.weights = weights
    log = tmp_path / "run.mcap"
    simulator = br.Simulator(controller.car, controller.track)
    run = br.drive(controller, simulator, laps=1, log=log)
    frame = run.frame()
    assert frame.columns[:8].tolist() == ["t", *["x", "y", "psi", "vx", "vy", "omega", "delta"]]
    assert len(frame) == len(run.t) == len(run.x)
    assert (frame[["d", "delta_rate"]].to_numpy()[:-1] == run.u).all()
    assert (frame.status[:-1] == 0).all()
    assert set(run.fault) == {""}
    assert frame.off_track_m.max() < 0
    figure = run.plot()
    assert len(figure.axes) == 5
    figure.savefig(tmp_path / "run.png")
    assert repr(run).startswith("<Run of 'orca' on 'harbour': ")

    read = br.Log(log)
    assert {"state", "truth", "actuation", "telemetry", "event"} <= set(read.topics)
    assert (read["state"]["x"] == run.x).all()
    assert read["state"]["time_s"] == pytest.approx(run.t)
    assert read.frame("telemetry").fallback.max() == 0
    assert read.table("state").column("x.3").to_pylist() == run.x[:, 3].tolist()
    assert read.car == controller.car
    assert br.train(read, points=60).counts == br.train(run, points=60).counts
    with pytest.raises(br.InputError, match="no topic 'states': there are state, truth"):
        read["states"]


def test_arrays_teach_what_a_run_does(first: br.Run, orca: br.Car) -> None:
    z, y = br.residuals(first)
    drive = br.Drive(first.x, first.u, 0.02)
    features, errors = br.residuals(drive, orca)
    assert len(z) < len(features)  # a run knows which of its cycles the fallback drove
    assert {tuple(row) for row in z} <= {tuple(row) for row in features}
    assert y.shape == (len(z), 3)
    assert errors.shape == (len(features), 3)


def test_an_update_goes_on_from_earlier_weights(first: br.Run, weights: br.Weights) -> None:
    starts: list[float] = []
    again = br.train(first, points=200, initial=weights, progress=lambda one, _: starts.append(one))
    anew: list[float] = []
    br.train(first, points=200, progress=lambda one, _: anew.append(one))
    assert again.version != weights.version  # its variances are not those of first weights
    assert again.kernels == weights.kernels


# Weights and scikit-learn -------------------------------------------------------------------------


def test_weights_are_scikit_learns_and_back(weights: br.Weights, first: br.Run) -> None:
    z, _ = br.residuals(first)
    regressors = weights.to_sklearn()
    predicted = np.column_stack([one.predict(z) for one in regressors])
    assert np.abs(predicted - weights.predict(z)).max() < 1e-9
    again = br.Weights.from_sklearn(regressors, first.driven.car)
    assert np.abs(again.predict(z) - weights.predict(z)).max() < 1e-9
    made, given = ([one.amplitudes for one in each.outputs] for each in (again, weights))
    assert np.allclose(made, given, rtol=1e-12, atol=0)


KERNELS: dict[str, Any] = {
    "rbf": ConstantKernel(2.0) * RBF(np.full(6, 2.0)) + WhiteKernel(1e-4),
    "one length scale": RBF(2.0),
    "matern05": ConstantKernel(0.5) * Matern(np.full(6, 4.0), nu=0.5),
    "matern15": WhiteKernel(1e-3) + Matern(np.full(6, 3.0), nu=1.5) * ConstantKernel(3.0),
    "matern25": ConstantKernel(2.0) * (Matern(np.full(6, 3.0), nu=2.5) + WhiteKernel(1e-3)),
    "matern of infinite nu": Matern(np.full(6, 3.0), nu=np.inf),
}


def regressors(kernel: Any, first: br.Run, **options: Any) -> list[GaussianProcessRegressor]:
    """Fitted to some 50 samples."""
    z, y = (one[::8] for one in br.residuals(first))
    fitted = [GaussianProcessRegressor(kernel, optimizer=None, **options) for _ in y.T]
    return [one.fit(z, target) for one, target in zip(fitted, y.T, strict=True)]


@pytest.mark.parametrize("name", KERNELS)
def test_regressors_of_these_kernels_become_weights(
    name: str, first: br.Run, controller: br.Controller
) -> None:
    fitted = regressors(KERNELS[name], first, normalize_y=True, alpha=1e-8)
    weights = br.Weights.from_sklearn(fitted, controller.car, version=name)
    z, _ = br.residuals(first)
    predicted = np.column_stack([one.predict(z) for one in fitted])
    assert np.abs(weights.predict(z) - predicted).max() < 1e-9
    # The compiled variance is scikit-learn's, too, where all points count.
    controller.native.set_weights(weights)
    total, _ = controller.native.variance(np.concatenate([first.x[40], first.u[40]]))
    at_40 = np.concatenate([first.x[40, 3:], first.u[40]])[None]
    known = [float(one.predict(at_40, return_std=True)[1][0]) ** 2 for one in fitted]
    jitter = [output.y_scale**2 * 1e-8 for output in weights.outputs]
    assert np.allclose(total, np.add(known, jitter), rtol=1e-5)


@pytest.mark.parametrize(
    ("kernel", "options", "message"),
    [
        (RationalQuadratic(), {}, "the regressor of vx has a RationalQuadratic kernel"),
        (RBF() + RBF(3.0), {}, "a sum of kernels"),
        (RBF() * Matern(), {}, "a product of kernels"),
        (RBF() + ConstantKernel(2.0), {}, "a constant that is added"),
        (RBF() * DotProduct(), {}, "DotProduct"),
        (WhiteKernel(1e-2), {}, "white noise alone"),
        (Matern(nu=0.7), {}, "nu = 0.7: give 0.5, 1.5 or 2.5"),
    ],
)
def test_other_kernels_are_refused_by_name(
    kernel: Any, options: dict[str, Any], message: str, first: br.Run, orca: br.Car
) -> None:
    fitted = regressors(kernel, first, alpha=1e-6, **options)
    with pytest.raises(br.InputError, match=message):
        br.Weights.from_sklearn(fitted, orca)


def test_training_by_scikit_learn_drives_as_well(first: br.Run, controller: br.Controller) -> None:
    controller.weights = br.train(first, points=100, method="scikit-learn")
    run = br.drive(controller, br.Simulator(controller.car, controller.track), laps=2)
    assert run.laps[1] < 6.75
    assert run.off_track == 0


def test_weights_are_checked_as_published_ones_are(
    first: br.Run, controller: br.Controller, weights: br.Weights
) -> None:
    other = br.Car.load("f1tenth")
    with pytest.raises(br.InputError, match="were learned for"):
        br.Controller(other, br.Track.load("random10:1", other), weights=weights)
    flipped = regressors(KERNELS["rbf"], first)
    for one in flipped:
        one.alpha_ = -one.alpha_  # as large as the right one, the other way
    with pytest.raises(br.InputError, match=r"absurd|worse"):
        controller.weights = br.Weights.from_sklearn(flipped, controller.car)
    assert controller.weights is None
    with pytest.raises(br.InputError, match="weights = str: give what"):
        controller.weights = "weights.bin"  # type: ignore[assignment]


# What is refused ----------------------------------------------------------------------------------


def at(track: br.Track, **changes: float) -> list[float]:
    x, y, psi = track.start_pose()
    state = {"x": x, "y": y, "psi": psi, "vx": 1.0, "vy": 0.0, "omega": 0.0, "delta": 0.0}
    return list((state | changes).values())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vx": float("nan")}, "state.vx = nan: give a number, or None"),
        ({"vx": 40.0}, r"state.vx = 40 is outside .*: give metres per second, not km/h"),
        ({"delta": 15.0}, r"state.delta = 15 is outside .*: give radians, not degrees"),
        ({"omega": 2e3}, r"state.omega = 2000 .*: give radians per second, not degrees"),
        ({"x": 1500.0}, r"state.x = 1500 .*: give metres, in the track's own coordinates"),
    ],
)
def test_states_in_other_units_are_refused(
    changes: dict[str, float], message: str, controller: br.Controller
) -> None:
    state = at(controller.track, **changes)
    for act in (controller.step, br.Simulator(controller.car, controller.track).reset):
        with pytest.raises(br.InputError, match=message):
            act(state)


RAIL = {"r": 0.1}


def rail() -> br.Problem:
    """A mass on a rail; docs/extending.md has the whole of it."""
    s, e = br.ocp.Symbols.of(2, 1, 1, 1), ca.SX.sym("e", 0)

    def motion(h: Any) -> Any:
        return ca.vertcat(s.x[0] + h * s.x[1] + h**2 / 2 * s.u, s.x[1] + h * s.u)

    return br.Problem(
        name="rail",
        states=(br.ocp.State("position", "m"), br.ocp.State("speed", "m/s")),
        inputs=(br.ocp.Input("acceleration", "m/s2"),),
        stage_parameters=(br.ocp.Parameter("target", "m"),),
        parameters=(br.ocp.Parameter("r", "s4", positive=True),),
        symbols=s,
        f=ca.Function("stage", [s.x, s.u, e], [motion(0.1)]),
        advance=ca.Function("advance", [s.x, s.u, e, s.h], [motion(s.h)]),
        cost=(s.x[0] - s.p) ** 2 + s.theta * s.u**2,
        rows=(),
        u_lower=-1.0,
        u_upper=1.0,
        guess=s.share,
    )


def drive(columns: Any = 1.0, inputs: Any = (0, 1)) -> br.Drive:
    """An unbroken drive, its states multiplied, its inputs in this order."""
    x, u = smooth_drive(br.Car.load("orca"), 60, 1)
    return br.Drive(x * columns, u[:-1, inputs], 0.02)


def _turned(line: br.RaceLine) -> br.RaceLine:
    return br.racing_line(br.Track.load("harbour").driven_from(reverse=True), br.Car.load("orca"))


REFUSED: dict[str, tuple[Callable[[br.Controller], object], str]] = {
    "shape": (lambda c: c.step([0.0] * 6), r"state: an array of shape \(6,\), expected \(7,\): x"),
    "no state": (lambda c: c.step(None), "the first step of a run needs a state"),
    "input": (
        lambda c: br.Simulator(c.car, c.track).step([1.0]),
        r"input: an array of shape \(1,\), expected \(2,\): d, delta_rate",
    ),
    "input not finite": (
        lambda c: br.Simulator(c.car, c.track).step([np.nan, 0.0]),
        "u = .*: give finite numbers",
    ),
    "direction": (
        lambda c: br.Controller(c.car, c.track, _turned(c.line)),
        "runs against the track 'harbour': turn one of them round",
    ),
    "line of another car": (
        lambda c: br.Controller(c.car.changed(friction=0.5), c.track, c.line),
        "the racing line was made for a friction of",
    ),
    "no tyres": (
        lambda c: br.Simulator(c.car.changed(tyres=None), c.track),
        "no tyres in its file, which the simulator",
    ),
    "settings": (
        lambda c: br.Controller(c.car, c.track, c.line, settings={"cautoin": 0}),
        "unknown setting 'cautoin': did you mean 'caution'",
    ),
    "problem": (
        lambda c: br.Controller(c.car, c.track, c.line, problem="racing"),
        "problem = 'racing': ",
    ),
    "simulator": (
        lambda c: br.drive(c, object()),  # type: ignore[arg-type]
        "simulator = object: it has no reset and no step",
    ),
    "laps": (
        lambda c: br.drive(c, br.Simulator(c.car, c.track), laps=0),
        "laps = 0: give a whole number from 1 on, or 0 and max_time_s",
    ),
    "laps that are no number": (
        lambda c: br.drive(c, br.Simulator(c.car, c.track), laps=float("nan")),  # type: ignore[arg-type]
        "laps = nan: give a whole number",
    ),
    "another car": (
        lambda c: br.drive(c, br.Simulator("f1tenth", "workshop")),
        "the simulator plays the car 'f1tenth', the controller drives 'orca'",
    ),
    "another track": (
        lambda c: br.drive(c, br.Simulator(c.car, "paddock")),
        "the simulator is on the track 'paddock', the controller on 'harbour'",
    ),
    "engine": (lambda c: br.Simulator(c.car, c.track, engine="fmu"), "engine = 'fmu': give one of"),  # type: ignore[arg-type]
    "delay": (lambda c: br.Simulator(c.car, c.track, delay_s=-5.0), "delay_s = -5.0: give seconds"),
    "told delay": (
        lambda c: c.step(at(c.track), delay_s=float("nan")),
        "delay_s = nan: give seconds, at most 1",
    ),
    "applied input": (
        lambda c: c.step(at(c.track), u_applied=(np.nan, 0.0)),
        r"u_applied = \(nan, 0.0\): give finite numbers",
    ),
    "no numbers": (lambda c: c.step("fast"), "state = 'fast': give numbers"),
    "exchanged arguments": (
        lambda c: br.Controller(c.track, c.car),  # type: ignore[arg-type]
        "car = Track: give a bayesrace.Car",
    ),
    "no track": (
        lambda c: br.Controller(c.car, c.line),  # type: ignore[arg-type]
        "track = RaceLine: give a bayesrace.Track",
    ),
    "too narrow": (
        lambda c: br.Controller(c.car.changed(width_m=0.5), c.track),
        "track 'harbour' is 0.37 m wide, the car 0.5 m",
    ),
    "horizon": (
        lambda c: br.Controller(c.car, c.track, c.line, horizon=0.4),  # type: ignore[arg-type]
        "horizon = 0.4: has to be a whole number",
    ),
    "changed": (
        lambda c: c.car.changed(mass=0.05),
        "unknown setting 'mass': did you mean 'mass_kg'",
    ),
    "points": (lambda c: br.train(drive(), c.car, points=0), "points = 0: has to be"),
    "speeds": (
        lambda c: br.train(drive([1, 1, 1, 3.6, 3.6, 1, 1]), c.car),
        r"by x\[:, 3:5\] and dt .* m: give metres, metres per second",
    ),
    "angles": (lambda c: br.residuals(drive([1, 1, 57, 1, 1, 1, 1]), c.car), "turns faster than"),
    "exchanged": (lambda c: br.residuals(drive(inputs=(1, 0)), c.car), r"drive.u\[:, 0\] is up to"),
    "several cars": (
        lambda c: br.train(br.drive(c, br.Simulator(c.car, c.track), 0, max_time_s=1.0), "f1tenth"),
        r"drives of several cars \(orca-.*, f1tenth-.*\): train on those of one",
    ),
    "period": (
        lambda c: br.train(
            br.drive(c, br.Simulator(c.car, c.track, step_s=0.01), 0, max_time_s=1.0)
        ),
        "the run's states are 0.01 s apart, the controller's stages 0.02 s: give a Drive",
    ),
    "problem of no car": (
        lambda c: br.Controller(c.car, c.track, c.line, problem=rail()),
        "problem 'rail' drives no car along a line: step it by bayesrace.Mpc",
    ),
    "stage": (lambda _: br.Mpc(rail(), 10, 0.2, RAIL), "step_s = 0.2: problem.f gives"),
    "missing parameter": (
        lambda _: br.Mpc(rail(), 10, 0.1, {}),
        "parameters: r of 'rail' are missing",
    ),
    "parameter": (
        lambda _: br.Mpc(rail(), 10, 0.1, {"r": -1.0}),
        "r = -1, which has to be above 0",
    ),
    "solver": (
        lambda _: br.Mpc(rail(), 10, 0.1, RAIL, solver={"tol": 1e-3}),
        "solver: no tol; there are tolerance, defect_max",
    ),
    "stages": (
        lambda _: br.Mpc(rail(), 10, 0.1, RAIL).step([0.0, 0.0], [1.0, 2.0]),
        r"stages: an array of shape \(2,\), expected \(10, 1\)",
    ),
    "nothing to learn from": (lambda _: br.train([]), r"drives = \[\]: give at least one run"),
    "no car": (
        lambda _: br.train(br.Drive(np.zeros((30, 7)), np.zeros((29, 2)), 0.02)),
        "name the",
    ),
    "method": (lambda _: br.train([], method="keras"), "method = 'keras': give one of"),  # type: ignore[arg-type]
    "track": (lambda _: br.Track.load(np.zeros((5, 3))), r"shape \(5, 3\), expected \(n, 4\)"),
    "rate": (lambda c: br.Simulator(c.car, c.track, step_s=0.0173), "cannot sample at"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_used_is_named_with_its_remedy(what: str, controller: br.Controller) -> None:
    act, message = REFUSED[what]
    controller.reset()
    with pytest.raises(br.InputError, match=message):
        act(controller)
    assert issubclass(br.InputError, ValueError)


def test_time_that_does_not_pass_is_refused(controller: br.Controller) -> None:
    state = br.Simulator(controller.car, controller.track).state
    controller.reset()
    controller.step(state)
    for dt in (0.0, -0.02, float("nan"), 20.0):
        with pytest.raises(br.InputError, match="give seconds since the state before"):
            controller.step(state, dt)


def test_a_host_without_casadi_is_told_what_to_install() -> None:
    code = (
        "import sys; sys.modules['casadi'] = None\n"
        "import bayesrace as br\n"
        "br.Car.load('orca'), br.Track.load('harbour')\n"
        "try: br.Controller\n"
        "except br.InputError as error: print(error)"
    )
    said = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert said.strip() == (
        "the Python interface needs casadi, which is not installed: pip install 'bayesrace[race]'"
    )


def test_values_that_are_refused_change_nothing(controller: br.Controller) -> None:
    state = br.Simulator(controller.car, controller.track).state
    before = controller.step(state).u
    with pytest.raises(br.InputError, match="margin_m = -1, which has to be from 0"):
        controller.set_parameters(r_duty=5.0, margin_m=-1.0)
    with pytest.raises(br.InputError, match="parameter margin_m = 'wide': give a number"):
        controller.set_parameters(margin_m="wide")  # type: ignore[arg-type]
    controller.set_parameters(margin_m=0.01)  # as it was
    controller.reset()
    assert controller.step(state).u == before


def own(car: br.Car, stage: Any = br.ocp.PREDICTION, **changes: Any) -> br.Problem:
    """Tracking, as a problem of one's own."""

    def cost(x: Any, p: Any, theta: Any, last: Any) -> Any:
        return theta["q_position"] * ((x[0] - p["x"]) ** 2 + (x[1] - p["y"]) ** 2)

    return br.ocp.driving_problem("mine", br.ocp.e_kinematic(car), stage, cost, **changes)


def test_a_driving_problem_of_another_car_or_stage_is_refused(controller: br.Controller) -> None:
    car, track, line = controller.car, controller.track, controller.line
    slow = br.ocp.Discretisation(step_s=0.04, pose="interpolated")
    for problem in (own(br.Car.load("f1tenth")), own(car, slow)):
        with pytest.raises(br.InputError, match="does not predict as the e_kinematic model"):
            br.Controller(car, track, line, problem=problem)
    weighed = own(car, cost_weights=(br.ocp.Parameter("q_slip", "1"),))
    with pytest.raises(br.InputError, match="parameters: q_slip of 'mine' are missing"):
        br.Controller(car, track, line, problem=weighed)


def test_functions_of_other_sizes_and_names_that_are_taken_are_refused() -> None:
    with pytest.raises(br.InputError, match=r"problem 'rail': f takes \[2, 1, 0\] numbers"):
        dataclasses.replace(rail(), outputs=1, features=("speed",))
    taken = (br.ocp.Parameter("tolerance", "1"),)
    with pytest.raises(br.InputError, match="'tolerance' is a setting of the solver"):
        dataclasses.replace(rail(), parameters=taken)


def test_a_simulator_that_begins_elsewhere_is_timed_from_there(
    controller: br.Controller, weights: br.Weights
) -> None:
    class Behind(Own):
        def reset(self, x0: Floats) -> Any:
            x, y, psi = controller.track.start_pose()
            return self._car.reset([x - 0.3 * np.cos(psi), y - 0.3 * np.sin(psi), *x0[2:]])

    controller.weights = weights
    run = br.drive(controller, Behind(controller.car, controller.track), laps=1)
    assert len(run.laps) == 1


def test_a_start_in_other_units_is_refused_and_leaves_no_recording(
    controller: br.Controller, tmp_path: Path
) -> None:
    simulator, log = br.Simulator(controller.car, controller.track), tmp_path / "run.mcap"
    with pytest.raises(br.InputError, match=r"state.vx = 40 is outside"):
        br.drive(controller, simulator, x0=at(controller.track, vx=40.0), log=log)
    assert not log.exists()


def test_a_run_that_did_not_drive_its_laps_is_judged_to_its_end(first: br.Run) -> None:
    assert len(first.off_track_m) == len(first.x)
    assert first.off_track == int((first.frame().off_track_m > 0).sum()) > 0


def test_a_closed_simulator_is_not_used(orca: br.Car, harbour: br.Track) -> None:
    with br.Simulator(orca, harbour) as simulator:
        simulator.step((0.1, 0.0))
    with pytest.raises(br.InputError, match="has been closed"):
        simulator.reset()
    with pytest.raises(br.InputError, match="has been closed"):
        simulator.step((0.1, 0.0))


def test_weights_correct_a_problem_of_ones_own(
    controller: br.Controller, weights: br.Weights
) -> None:
    """Also one with parameters that have to be above 0."""
    weighed = own(controller.car, cost_weights=(br.ocp.Parameter("q_slip", "1", positive=True),))
    mine = br.Controller(
        controller.car, controller.track, controller.line,
        problem=weighed, parameters={"q_slip": 1.0}, weights=weights,
    )  # fmt: skip
    assert mine.weights is weights
