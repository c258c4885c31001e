"""The FMI layers: saved states to the last bit, and a message instead of a crash for misuse."""

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

from bayesrace.codegen.fmu import car_fmu
from bayesrace.codegen.fmu.build import sources_of, write_sources
from bayesrace.vehicles import Car
from tests.car_fmu import Kind, Version, commands, driven, slave
from tests.fmu_master import Slave
from tests.native_programs import PROGRAMS, SANITIZERS, gcc

VERSIONS = pytest.mark.parametrize("version", [2, 3])


def stepping(version: Version = 3, vx: float = 1.0) -> Slave:
    one = slave(version)
    one.initialise({"vx": vx})
    return one


def save(one: Slave) -> Any:
    return one.fmu.getFMUState()


def refused(one: Slave, call: Callable[[], object], words: str) -> None:
    """The call fails, and the importer's log says why."""
    count = len(one.messages)
    with pytest.raises(FMICallException):
        call()
    assert len(one.messages) == count + 1
    assert words in one.messages[-1]


@VERSIONS
def test_a_rolled_back_step_is_repeated_to_the_last_bit(version: Version) -> None:
    inputs = commands(200)
    one = stepping(version)
    driven(one, inputs[:100])
    state, time = save(one), one.time
    first = driven(one, inputs[100:])
    for _ in range(2):
        one.fmu.setFMUState(state)
        one.time = time
        np.testing.assert_array_equal(driven(one, inputs[100:]), first)
    one.fmu.freeFMUState(state)
    one.close()


@VERSIONS
def test_a_serialised_state_goes_on_in_another_instance(version: Version) -> None:
    inputs = commands(200)
    one = slave(version)
    one.initialise({"vx": 1.0, "mass_kg": 0.05})
    driven(one, inputs[:100])
    state = save(one)
    data = bytes(one.fmu.serializeFMUState(state))
    expected = driven(one, inputs[100:])
    other = slave(version)  # not even initialised
    copy = other.fmu.deserializeFMUState(data)
    other.fmu.setFMUState(copy)
    other.time = 100 * 0.02
    assert other.get("mass_kg") == [0.05]
    np.testing.assert_array_equal(driven(other, inputs[100:]), expected)
    other.fmu.freeFMUState(copy)
    other.close()
    one.close()  # with a state that was not freed


@VERSIONS
def test_a_state_of_another_instance_or_of_none_is_refused(version: Version) -> None:
    one, other = stepping(version), stepping(version)
    refused(one, lambda: one.fmu.setFMUState(save(other)), "not made by this instance")
    state = save(one)
    stale = type(state)(state.value)
    one.fmu.freeFMUState(state)
    refused(one, lambda: one.fmu.setFMUState(stale), "freed")
    refused(one, lambda: one.fmu.freeFMUState(stale), "freed")
    refused(one, lambda: one.fmu.setFMUState(type(state)()), "NULL")
    refused(one, lambda: one.fmu.deserializeFMUState(b"x"), "no state")
    one.close()
    other.close()


@VERSIONS
def test_calls_out_of_their_phase_are_refused(version: Version) -> None:
    one = slave(version)
    refused(one, lambda: one.step(0.02), "not allowed in phase 'instantiated'")
    refused(one, one.fmu.exitInitializationMode, "phase 'instantiated'")
    refused(one, one.fmu.terminate, "phase 'instantiated'")
    one.initialise()
    refused(one, lambda: one.set({"mass_kg": 1.0}), "'mass_kg' cannot be set in phase 'stepping'")
    refused(one, lambda: one.set({"vx": 1.0}), "'vx' cannot be set")
    refused(one, lambda: one.set({"d_applied": 1.0}), "'d_applied' cannot be set")
    refused(one, one.fmu.enterInitializationMode, "phase 'stepping'")
    one.step(0.02)
    one.fmu.terminate()
    refused(one, lambda: one.step(0.02), "phase 'terminated'")
    refused(one, lambda: one.set({"d": 1.0}), "phase 'terminated'")
    assert one.get("time") == [0.02]
    one.reset()
    one.initialise({"mass_kg": 1.0})
    one.step(0.02)
    one.close()


@VERSIONS
@pytest.mark.parametrize("h", [0.0, -0.02, np.nan, np.inf, -np.inf])
def test_a_step_that_is_none_is_refused_and_changes_nothing(version: Version, h: float) -> None:
    one = stepping(version)
    before = one.get("x", "vx", "time")
    refused(one, lambda: one.fmu.doStep(0.0, h), "must be positive")
    refused(one, lambda: one.fmu.doStep(1.0, 0.02), "asked to continue at 1")
    refused(one, lambda: one.fmu.doStep(np.nan, 0.02), "asked to continue")
    assert one.get("x", "vx", "time") == before
    one.step(0.02)
    one.close()


@VERSIONS
def test_a_step_beyond_the_stop_time_is_refused(version: Version) -> None:
    one = slave(version)
    if version == 2:
        one.fmu.setupExperiment(startTime=1.0, stopTime=1.04)
        one.fmu.enterInitializationMode()
    else:
        one.fmu.enterInitializationMode(startTime=1.0, stopTime=1.04)
    one.fmu.exitInitializationMode()
    one.time = 1.0
    one.step(0.02)
    one.step(0.02)
    refused(one, lambda: one.step(0.02), "stop time")
    one.close()


@VERSIONS
def test_values_are_set_all_or_none(version: Version) -> None:
    one = stepping(version)
    put = one.fmu.setReal if version == 2 else one.fmu.setFloat64
    integer = one.fmu.getInteger if version == 2 else one.fmu.getInt32
    before = one.get("d")
    refused(one, lambda: put([one.references["d"], 12345], [0.3, 1.0]), "reference 12345")
    assert one.get("d") == before
    refused(one, lambda: integer([0]), "'x'")
    one.close()


@pytest.mark.check
@pytest.mark.parametrize(("version", "kind"), [(2, "cs"), (3, "cs"), (3, "me")])
def test_misuse_under_sanitizers(version: Version, kind: Kind, car: Car, tmp_path: Path) -> None:
    """tests/native/fmi_misuse.c: NULL, wrong sizes, wrong phases, damaged bytes, stale states."""
    sources = write_sources(sources_of(car_fmu(car, version, kind))[1], tmp_path)
    program = PROGRAMS / "fmi_misuse.c"
    flags = (*SANITIZERS, "-Wall", "-Werror", "-I.")
    gcc(*flags, *sources, program, "-lm", "-o", "misuse", cwd=tmp_path)
    ran = subprocess.run(
        [str(tmp_path / "misuse")], capture_output=True, text=True, check=False, timeout=60
    )
    assert ran.returncode == 0, ran.stderr[-3000:]
    assert ran.stdout.endswith("fine\n")
