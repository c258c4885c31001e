"""What the controller's status says of the instruments by which it estimates its state."""

from pathlib import Path

import numpy as np
from msgspec import structs

from bayesrace.controller.driver import Driver
from bayesrace.controller.instruments import Instruments
from bayesrace.controller.interface import NO_PLAN, StepOutput
from bayesrace.messages import Reading
from tests.cycle_rig import STEP_S, ScriptedLaw, scripted_driver, state

REST = (0.0,) * 7


def observe(driver: Driver, seq: int, *seen: tuple[str, float, float]) -> None:
    """A state with readings: instrument, x, time; y and heading are 0."""
    readings = tuple(
        Reading(
            instrument=name, time_s=time_s,
            values={"x": (x, 1e-3), "y": (0.0, 1e-3), "psi": (0.0, 3e-3)},
        )
        for name, x, time_s in seen
    )  # fmt: skip
    one = structs.replace(state(seq, run=1, x=REST), estimated=True, readings=readings)
    assert driver.observe(one)
    driver.decide(one.time_s)


def test_status_names_instruments_with_rates_and_shares(kinematic_artefact: Path) -> None:
    law = ScriptedLaw(lambda _: StepOutput(u=np.zeros(2), plan_u=NO_PLAN))
    driver = scripted_driver(kinematic_artefact, law)
    shown = Instruments(driver)
    assert shown.words() == ""
    observe(driver, 0)
    assert "no position yet" in shown.words()
    for seq in range(1, 121):
        now_s = seq * STEP_S
        wrong = ("pose", 1.0, now_s) if seq % 10 == 0 else ("pose", 0.0, now_s)
        late = [("slow", 0.0, now_s - 5)] if seq % 5 == 0 else []
        observe(driver, seq, wrong, *late)
        said = shown.words()
    assert "pose 50 Hz (10.0 % refused)" in said
    assert "slow 10 Hz (100.0 % too late)" in said
    assert "; position and heading ±" in said
    for seq in range(121, 240):
        observe(driver, seq)
        said = shown.words()
    assert "pose silent" in said
