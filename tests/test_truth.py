"""Truth and measurement: a sensor that errs misleads controller and learning, and no judge."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace as changed

from bayesrace.controller.pure_pursuit import PurePursuit, PurePursuitSettings
from bayesrace.controller.python_controller import PythonController
from bayesrace.gp.weights import zero_weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.sources import dataset_from_log
from bayesrace.learning.validation import identity
from bayesrace.log import LogReader, LogWriter
from bayesrace.messages import STATE, TRUTH, State
from bayesrace.operation.analysis.race import read_race
from bayesrace.operation.analysis.results import RaceResult
from bayesrace.operation.analysis.validation import validate_weights
from bayesrace.operation.closed_loop import ClosedLoop, Driven
from bayesrace.plant.car import CarRun
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import dynamic
from tests.conftest import Circuit
from tests.driven import CAR, STEP_S, drive, write_log
from tests.synthetic_race import LAP_S, Drive, analyse, circle, write_race

ERROR = np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.0])
"""Of vy and omega, which :class:`Spy` does not look at: the car drives on as it did."""
CALM = PurePursuitSettings(style="calm")
exactly = CarRun.sample
TWO_LAPS = np.array([2 * np.pi * k * STEP_S / LAP_S for k in range(137)])


def erring(run: CarRun, *given: Any, **named: Any) -> tuple[State, tuple[float, ...]]:
    """Adds :data:`ERROR`."""
    state, x = exactly(run, *given, **named)
    return changed(state, x=tuple((np.array(x) + ERROR).tolist())), x


class Spy(PurePursuit):
    """Keeps what it is given, and takes vy and omega for zero."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.given: list[Any] = []

    def step(self, x: Any, *arguments: Any, **options: Any) -> Any:
        """As pure pursuit."""
        self.given.append(x.copy())
        return super().step(x * (1, 1, 1, 1, 0, 0, 1), *arguments, **options)


@pytest.fixture
def drives(
    circuit: Circuit, car: Car, kinematic_artefact: Path
) -> Callable[[Path], tuple[Driven, Spy]]:
    line = circuit.line

    def drive_once(log: Path) -> tuple[Driven, Spy]:
        spy, writer = Spy(car, line.x_m, line.y_m, line.vx_mps, CALM), LogWriter(log)
        controller = PythonController(kinematic_artefact, spy)
        driven = ClosedLoop(car, circuit.track, line, controller, log=writer).drive(1)
        writer.close()
        return driven, spy

    return drive_once


def test_a_sensor_that_errs_misleads_the_controller_and_learning_alone(
    drives: Callable[[Path], tuple[Driven, Spy]],
    car: Car,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    exact, spy = drives(tmp_path / "exact.mcap")
    assert np.array_equal(exact.x[:-1], spy.given)
    monkeypatch.setattr(CarRun, "sample", erring)
    erred, spy = drives(tmp_path / "erred.mcap")
    # The car, its laps and its excursions are the same, and so is the end by the plant's count.
    assert np.array_equal(erred.x, exact.x)
    assert (erred.laps_s, erred.end, erred.lap[-1]) == (exact.laps_s, exact.end, 1)
    assert np.array_equal(erred.off_track_m, exact.off_track_m)
    # The controller and the samples have the error.
    assert np.array_equal(spy.given, exact.x[:-1] + ERROR)
    step_s, log = exact.step_s, tmp_path / "erred.mcap"
    measured, true = (dataset_from_log(log, car, step_s, truth=one) for one in (False, True))
    assert erred.samples().digest() == measured.digest()
    assert np.array_equal(measured.x, true.x + ERROR)
    assert true.digest() == exact.samples().digest()
    # The log has both, number by number.
    states, truths = LogReader(log).select(STATE), LogReader(log).select(TRUTH)
    assert [one.seq for one in states] == [one.seq for one in truths]
    assert np.array_equal([one.x for one in truths], exact.x)


def judged(folder: Path, measured: Any, truth: bool = True) -> RaceResult:
    """Two runs on a circle, and what the sensors say of them."""
    names = "bayesrace", "bestcase"
    x = circle(TWO_LAPS, 1.0)
    runs = [Drive(name, x, measured=measured) for name in names]
    return analyse(write_race(folder, runs, truth=truth))


def test_a_race_is_judged_by_the_truth(tmp_path: Path) -> None:
    """Laps, excursions, the trajectory's digest and the metrics of the GPs."""
    elsewhere = circle(TWO_LAPS, 1.5)
    elsewhere[:, 3:6] += 0.3
    result = judged(tmp_path / "erred", elsewhere)
    assert result == judged(tmp_path / "exact", None)
    assert (result.complete, result.judged_by) == (True, "truth")
    assert result.laps[0].off_track_samples == 0
    run = read_race(tmp_path / "erred").recording.runs[0]
    assert np.array_equal(run.states["x"], elsewhere)


def test_without_a_truth_a_race_is_judged_by_what_was_measured(tmp_path: Path) -> None:
    """As of a real car, or from a log made before there was a truth."""
    elsewhere = circle(TWO_LAPS, 1.5)
    result = judged(tmp_path, elsewhere, truth=False)
    assert (result.complete, result.judged_by) == (True, "measurement")
    assert result.laps[0].off_track_samples == result.laps[0].samples


def test_a_truth_that_is_missing_is_a_gap(tmp_path: Path) -> None:
    judged(tmp_path, None)
    run = read_race(tmp_path).recording.runs[0]
    assert replace(run, truth=np.delete(run.truth, [5, 6, 7, -1])).gaps == 4


def test_weights_are_validated_by_the_truth_and_know_their_samples_by_the_measurement(
    tmp_path: Path,
) -> None:
    data = drive(dynamic(CAR), 90, seed=2)
    erred = replace(data, x=data.x + ERROR, x_next=data.x_next + ERROR)
    write_log(tmp_path / "exact.mcap", data)
    write_log(tmp_path / "erred.mcap", erred, truth=data)
    weights = replace(
        zero_weights("orca", identity(data, PREDICTION)), dataset_digest=erred.digest()
    )
    of_exact, of_erred = (
        validate_weights(weights, [tmp_path / f"{name}.mcap"]).result for name in ("exact", "erred")
    )
    assert (of_exact.learned_from, of_erred.learned_from) == (False, True)
    assert of_erred.model_copy(update={"learned_from": False}) == of_exact
