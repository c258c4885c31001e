"""What the tests of the native step share: built controllers, a track, weights, a recorded drive.

Everything is synthetic and made in seconds: no optimal racing line, no trained model, no data file.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from bayesrace.arrays import Floats
from bayesrace.cache import code_folder
from bayesrace.codegen.build import build
from bayesrace.codegen.daqp import VERSION
from bayesrace.codegen.problems.tracking import tracking
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import PathTable, PredictiveController, make_path_table
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import MpcSettings
from bayesrace.errors import InputError
from bayesrace.gp.expression import kernel_matrix
from bayesrace.gp.weights import KERNELS, GpOutput, Weights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.log import LogReader, LogWriter
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.host import HostProgram
from bayesrace.raceline.line import RaceLine
from bayesrace.tracks import Track
from bayesrace.vehicles import Car, get_car
from bayesrace.vehicles.models import Model, dynamic, e_kinematic
from tests.command_line import cli
from tests.programs import Race, leftovers, peanut
from tests.shared import session_folder, shared_folder
from tests.zig import ziglang

__all__ = ["cli", "ziglang"]  # fixtures for all tests


try:
    code_folder()
except InputError:  # as for root with the home of another user, which some CI containers have
    os.environ["BAYESRACE_CACHE"] = f"{tempfile.gettempdir()}/bayesrace-tests-{os.geteuid()}"

# the components that change sign in a mirror at the x axis
MIRROR_STATE = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0, -1.0])
MIRROR_INPUT = np.array([1.0, -1.0])
_MIRROR_OUTPUT = (1.0, -1.0, -1.0)

SETTINGS = MpcSettings(
    q_position=1.0,
    r_duty=0.005,
    r_delta_rate=1e-4,
    s_slack=100.0,
    constraints=True,
    margin_m=0.0,
    caution=0.0,
    tolerance=1e-6,
    defect_max=0.1,
    early_stop_tol=0.0,
    iterations=1,
    iterations_cold=30,
)
CAUTIOUS = SETTINGS.model_copy(update={"caution": 0.95})
"""Written out, so that tuning the defaults does not change what is tested."""

TRUTH = Discretisation(scheme="rk4", step_s=0.02, substeps=20)
"""Accurate for the dynamic model also at standstill, where the tyres are stiff."""

NOISE = 0.02
LENGTH_SCALES = np.array([2.0, 1.0, 10.0, 0.5, 1.5, 10.0])


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Modules without a marker that ``-m`` asks for need not be imported, which takes seconds."""
    expression = config.getoption("markexpr")
    wanted = [f"mark.{one}" for one in re.findall(r"(?<!not )\b(check|wall_clock)\b", expression)]
    if not wanted or not collection_path.match("test_*.py"):
        return None
    text = collection_path.read_text()
    return any(marker not in text for marker in wanted) or None


@pytest.fixture
def interruptible() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt, though a shell's background job ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def discrete(
    model: Model, discretisation: Discretisation = TRUTH
) -> Callable[[Floats, Floats], Floats]:
    """The discretised model as a function of numpy arrays."""
    function = discretisation.discretise(model)
    return lambda x, u: np.asarray(function(x, u), dtype=float).ravel()


def smooth_drive(car: Car, count: int, seed: int) -> tuple[Floats, Floats]:
    """States (count, 7) and inputs (count, 2) of the dynamic model under smooth random driving."""
    random, step = np.random.default_rng(seed), discrete(dynamic(car))
    x, u = np.array([0.0, 0, 0, 1.5, 0, 0, 0]), np.array([0.5, 0.0])
    states, inputs = [], []
    for k in range(count):
        if k % 8 == 0:
            duty = random.uniform(0.0, 1.0) if x[3] < 2.5 else random.uniform(-0.1, 0.3)
            target = random.uniform(-0.3, 0.3)
        u = np.array([duty, np.clip(8 * (target - x[6]), -5, 5)])
        states.append(x)
        inputs.append(u)
        x = step(x, u)
    return np.array(states), np.array(inputs)


def fit_output(kind: str, z: Floats, y: Floats) -> GpOutput:
    """Posterior mean for fixed hyperparameters; the noise keeps the alphas moderate."""
    mean, scale = float(y.mean()), float(y.std())
    gram = kernel_matrix(kind, z, z, LENGTH_SCALES) + NOISE * np.eye(len(z))
    alpha = np.asarray(np.linalg.solve(gram, (y - mean) / scale), dtype=np.float64)
    return GpOutput(
        kernel=kind,
        signal_variance=1.0,
        noise_variance=NOISE,
        y_mean=mean,
        y_scale=scale,
        length_scales=LENGTH_SCALES,
        inputs=z,
        alpha=alpha,
    )


def fit_weights(car: Car, kinds: tuple[str, str, str], count: int = 160, seed: int = 1) -> Weights:
    """Weights learned from the one-step error of the e-kinematic model on a random drive."""
    states, inputs = smooth_drive(car, count + 1, seed)
    nominal = discrete(e_kinematic(car), PREDICTION)
    predicted = np.array([nominal(x, u) for x, u in zip(states[:-1], inputs[:-1], strict=True)])
    residual = (states[1:] - predicted)[:, 3:6]
    z = np.column_stack([states[:-1, 3:7], inputs[:-1]])
    vx, vy, omega = (fit_output(kinds[j], z, residual[:, j]) for j in range(3))
    identity = PREDICTION.identity("e_kinematic", car)
    return Weights(
        version="-".join(kinds),
        car=car.name,
        discretisation=identity,
        sample_features=z,
        sample_residuals=residual,
        outputs=(vx, vy, omega),
    )


def mirrored_weights(weights: Weights) -> Weights:
    """The weights that the mirrored car would have learned."""
    signs = np.r_[MIRROR_STATE[3:], MIRROR_INPUT]
    vx, vy, omega = (
        replace(o, inputs=o.inputs * signs, alpha=o.alpha * sign, y_mean=o.y_mean * sign)
        for o, sign in zip(weights.outputs, _MIRROR_OUTPUT, strict=True)
    )
    return replace(
        weights,
        version=f"{weights.version}-mirrored",
        sample_features=weights.sample_features * signs,
        sample_residuals=weights.sample_residuals * np.array(_MIRROR_OUTPUT),
        outputs=(vx, vy, omega),
    )


def mirrored_line(line: RaceLine) -> RaceLine:
    """The line mirrored at the x axis."""
    return replace(line, y_m=-line.y_m, psi_rad=-line.psi_rad, kappa_radpm=-line.kappa_radpm)


def offset_line(track: Track, offset_m: float, lateral_mps2: float, v_max: float) -> RaceLine:
    """A line that swings about the centreline, at the speed of a lateral acceleration limit."""
    count = round(track.length_m / 0.02)
    s = np.arange(count) * (track.length_m / count)
    n = offset_m * np.sin(4 * np.pi * s / track.length_m)
    xy = track.position(s) + n[:, None] * track.normal(s)
    chord = np.roll(xy, -1, axis=0) - xy
    step = np.linalg.norm(chord, axis=1)
    psi = np.unwrap(np.arctan2(chord[:, 1], chord[:, 0]))
    kappa = np.angle(np.exp(1j * (np.roll(psi, -1) - psi))) / step
    v = np.minimum(v_max, np.sqrt(lateral_mps2 / np.maximum(np.abs(kappa), 1e-3)))
    v = np.real(np.fft.ifft(np.fft.fft(v) * np.exp(-((np.fft.fftfreq(count) * 60) ** 2))))
    along = np.r_[0.0, np.cumsum(step)]
    return RaceLine(
        track.name, along[:-1], xy[:, 0], xy[:, 1], psi, kappa, v, 0 * v, float(along[-1])
    )


@dataclass(frozen=True, eq=False)
class Problem:
    """One recorded control step: everything that shaped it."""

    x0: Floats
    d_previous: float
    reference: Floats


@dataclass(frozen=True, eq=False)
class Circuit:
    """Track, line, and the table made of them."""

    track: Track
    line: RaceLine
    table: PathTable

    def start(self, s_m: float = 0.0, v_mps: float = 1.0) -> Floats:
        """State of a car that follows the line at arc length ``s_m``."""
        i = int(np.searchsorted(self.line.s_m, s_m))
        line = self.line
        return np.array([line.x_m[i], line.y_m[i], line.psi_rad[i], v_mps, 0.0, 0.0, 0.0])


@pytest.fixture(scope="session")
def car() -> Car:
    """The 1:43 car."""
    return get_car("orca")


@pytest.fixture(scope="session")
def kinematic_artefact() -> Path:
    """Built controller that predicts with the e-kinematic model, from the cache if it is there."""
    return build(BuildSettings())[0]


@pytest.fixture(scope="session")
def dynamic_artefact() -> Path:
    """Built BestCase controller."""
    return build(BuildSettings.best_case())[0]


@pytest.fixture(scope="session")
def weights(car: Car) -> Weights:
    """Plausible weights of 160 points with three different kernels."""
    return fit_weights(car, ("rbf", "matern25", "matern15"))


def native_numbers(settings: MpcSettings, car: Car, weights: Weights) -> Floats:
    """Parameters and weights in the order of the C structures, as the C programs read them."""
    values = settings.parameters(car)
    problem = tracking(e_kinematic(car), PREDICTION)
    solver = ("tolerance", "defect_max", "early_stop_tol", "caution_sigmas", "iterations",
              "iterations_cold", "qp_steps")  # fmt: skip
    names = [*(one.name for one in problem.parameters), *solver]
    parts: list[ArrayLike] = [[values[name] for name in names]]
    for output in weights.outputs:
        parts.append([KERNELS.index(output.kernel), output.count, *output.amplitudes])
        parts += [output.length_scales, output.inputs.ravel(), output.alpha]
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def make_circuit() -> Circuit:
    """A peanut of 6.4 m, bends to both sides, with a line on which every kind of limit binds."""
    angle = np.linspace(0, 2 * np.pi, 160, endpoint=False)
    radius = 0.8 + 0.32 * np.cos(2 * angle)
    points = np.column_stack([1.15 * radius * np.cos(angle), radius * np.sin(angle)])
    track = Track.from_points("peanut", points, 0.16, 0.18)
    line = offset_line(track, offset_m=0.17, lateral_mps2=6.0, v_max=2.6)
    return Circuit(track, line, make_path_table(track, line, get_car("orca").tuning.path.spacing_m))


@pytest.fixture(scope="session")
def circuit() -> Circuit:
    """Track, racing line and table, synthetic."""
    return make_circuit()


def drive(
    step: NativeStep, circuit: Circuit, count: int, x: Floats | None = None
) -> tuple[list[Problem], Floats]:
    """Closed loop with the dynamic model as plant: problems and the inputs (count, 2) applied."""
    car = get_car("orca")
    plant = discrete(dynamic(car))
    x, d, problems, inputs = circuit.start() if x is None else x, 0.0, [], []
    for _ in range(count):
        status = step.step(x, d)
        assert status.usable, status
        problems.append(Problem(x.copy(), d, step.read_reference()))
        inputs.append(step.u.copy())
        d, x = float(step.u[0]), plant(x, step.u)
        x[6] = np.clip(x[6], -car.delta_max_rad, car.delta_max_rad)
    return problems, np.array(inputs)


def ready(
    artefact: Path, car: Car, weights: Weights, circuit: Circuit, settings: MpcSettings
) -> NativeStep:
    """A GP controller on the circuit."""
    step = NativeStep(artefact, car, settings)
    step.set_weights(weights)
    step.set_path(circuit.table)
    return step


Driven = Callable[..., LogReader]
Make = Callable[..., NativeStep]


@pytest.fixture
def make(kinematic_artefact: Path, car: Car, weights: Weights, circuit: Circuit) -> Make:
    """Makes a GP controller on the circuit, with other weights and changes of the settings."""

    def made(weights: Weights = weights, **changes: float) -> NativeStep:
        changed = SETTINGS.model_copy(update=changes)
        return ready(kinematic_artefact, car, weights, circuit, changed)

    return made


@pytest.fixture
def native(make: Make) -> NativeStep:
    """A ready GP controller on the circuit."""
    return make()


@pytest.fixture(scope="session")
def recorded(
    kinematic_artefact: Path, car: Car, weights: Weights, circuit: Circuit
) -> list[Problem]:
    """Problems of 300 closed-loop steps with the GP, constraints on: about two laps."""
    step = NativeStep(kinematic_artefact, car, SETTINGS)
    step.set_weights(weights)
    step.set_path(circuit.table)
    return drive(step, circuit, 300)[0]


@pytest.fixture(scope="session")
def peanut_track(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File of the shortest track."""
    folder = session_folder(tmp_path_factory, "track", lambda path: peanut(path / "peanut.csv"))
    return folder / "peanut.csv"


@pytest.fixture(scope="session")
def peanut_race(peanut_track: Path, tmp_path_factory: pytest.TempPathFactory) -> Race:
    """A race that collects and drives on the shortest track, all else by default."""

    def make(folder: Path) -> None:
        out = tmp_path_factory.mktemp("race") / "driven"
        tracks = ("--track", peanut_track, "--train-track", peanut_track, "--progress-drives", "2")
        race = Race.running(out, *tracks)()
        assert leftovers(race.pid) == {}
        shutil.copytree(race.out, folder / "run")
        (folder / "stdout").write_text(race.process.stdout)

    folder = session_folder(tmp_path_factory, "race", make)
    text = (folder / "stdout").read_text()
    return Race(folder / "run", 0, subprocess.CompletedProcess([], 0, text, ""))


@pytest.fixture(scope="session")
def host(
    tmp_path_factory: pytest.TempPathFactory, kinematic_artefact: Path, circuit: Circuit,
    car: Car, weights: Weights,
) -> HostProgram:  # fmt: skip
    folder = tmp_path_factory.mktemp("host")
    return HostProgram.made(
        folder, kinematic_artefact, car, circuit.track, circuit.line, weights, SETTINGS
    )


@pytest.fixture
def driven(native: NativeStep, circuit: Circuit, car: Car, tmp_path: Path) -> Driven:
    """The log of a lockstep drive with the controller in Python."""

    def drive(max_time_s: float = 60.0, **given: Any) -> LogReader:
        log = LogWriter(tmp_path / "log.mcap")
        controller = PredictiveController(native)
        loop = ClosedLoop(car, circuit.track, circuit.line, controller, log=log, **given)
        loop.drive(1, max_time_s=max_time_s)
        log.close()
        return LogReader(tmp_path / "log.mcap")

    return drive


@pytest.fixture(scope="session")
def daqp() -> Path:
    """Its source distribution, of the package index."""
    wanted = f"daqp=={VERSION}"

    def download(folder: Path) -> None:
        line = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary", "daqp"]
        subprocess.run([*line, wanted, "-d", folder], check=True, timeout=600)

    try:
        return next(shared_folder("daqp", [wanted], download).glob("daqp-*.tar.gz"))
    except (subprocess.SubprocessError, StopIteration) as error:
        pytest.skip(f"{wanted} cannot be downloaded: {error}")
