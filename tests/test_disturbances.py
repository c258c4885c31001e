"""Delays in lockstep: what acts when, and how the controller copes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.controller.settings import CompensationSettings, MpcSettings
from bayesrace.gp.weights import Weights
from bayesrace.messages import RunRequest
from bayesrace.operation.closed_loop import ClosedLoop, Driven
from bayesrace.plant.car import CarRun
from bayesrace.plant.simulator import Simulator
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import dynamic
from tests.conftest import Circuit
from tests.driven import blank

START = (0.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.05)


@pytest.mark.parametrize("delay_ms", [3, 20, 47])
def test_an_input_acts_after_its_delay_and_the_state_reports_it(car: Car, delay_ms: int) -> None:
    """Against the same inputs, each held from its own moment on, a millisecond at a time."""
    inputs = [(0.4, 0.5), (0.9, -1.0), (0.2, 2.0), (0.6, 0.0), (0.3, -0.5), (0.5, 0.1)]
    request = blank(
        RunRequest, lockstep=True, x0=START, line_x_m=9.0, max_time_s=9.0, laps=1, line_left_m=0.1
    )
    run = CarRun(request, Simulator(dynamic(car)), 1, delay_s=delay_ms * 1e-3)
    reports: list[float] = []
    for seq, u in enumerate(inputs):
        run.step(u, seq)
        reports += run.sample(seq + 1)[0].actuation_delays
    expected = Simulator(dynamic(car))
    expected.reset(START)
    acting: list[Any] = [None] * delay_ms + [u for u in inputs for _ in range(20)]
    for period in range(len(inputs)):
        expected.step_switched([(1, u) for u in acting[20 * period : 20 * period + 20]])
    np.testing.assert_allclose(run.vehicle.x, expected.x, atol=1e-9)
    rows = np.reshape(reports, (-1, 3))
    assert rows[:, 0].tolist() == list(range(len(rows)))
    assert len(rows) >= len(inputs) - 1 - delay_ms // 20
    np.testing.assert_allclose(rows[:, 1:], delay_ms * 1e-3)


def test_a_delay_is_measured_and_compensated_in_lockstep_too(
    circuit: Circuit, car: Car, kinematic_artefact: Path, weights: Weights
) -> None:
    """20 ms each way: nearly the lap without a delay; uncompensated far from it."""

    def driven(delay_s: float, compensation: CompensationSettings | None = None) -> Driven:
        how = compensation or CompensationSettings()
        settings = ControllerSettings(car=car, compensation=how)
        controller = compiled_controller(
            kinematic_artefact, car, circuit.track, circuit.line, weights, MpcSettings(caution=0.0)
        )
        loop = ClosedLoop(
            car, circuit.track, circuit.line, controller, settings=settings, delay_s=delay_s
        )
        return loop.drive(1, 30.0)

    at_once, late = driven(0.0), driven(0.02)
    fixed = driven(0.02, CompensationSettings(mode="fixed", delay_s=0.04))
    ignored = driven(0.02, CompensationSettings(mode="off"))
    lap_s = at_once.laps_s[0]
    assert late.laps_s[0] == pytest.approx(lap_s, abs=0.1)
    assert fixed.laps_s[0] == pytest.approx(lap_s, abs=0.1)
    assert not ignored.laps_s or ignored.laps_s[0] > 1.2 * lap_s
