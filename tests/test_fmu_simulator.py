"""An FMU as the car: the guard in front of it, commands that change, faults, its own step; another
tool's FMU, in its own names, units and signs, is the same car through its map."""

import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from bayesrace.errors import InputError
from bayesrace.plant.fmu.host import FmuHost
from bayesrace.plant.fmu.inspection import inspect
from bayesrace.plant.fmu.simulator import FmuSimulator, communication_step, open_fmu
from bayesrace.plant.fmu.wiring import Link, Wiring
from bayesrace.plant.simulator import Simulator
from bayesrace.plant.vehicle import FmuFault
from bayesrace.vehicles import get_car
from bayesrace.vehicles.models import dynamic
from tests.faulty_fmu import (
    STATES,
    Mode,
    faulty_fmu,
    faulty_host,
    faulty_library,
    process_of,
)
from tests.foreign_fmu import FOREIGN_MAP, build_foreign_fmu

CAR = get_car("orca")


@pytest.fixture(scope="module")
def host(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FmuHost]:
    path = faulty_fmu(faulty_library(2), tmp_path_factory.mktemp("fmu") / "faulty.fmu")
    with closing(faulty_host(path)) as host:
        yield host


def simulator(
    host: FmuHost, *, angle: bool = False, part_s: float = 1e-3, any_size: bool = True
) -> FmuSimulator:
    """``angle``: the second input takes the steering angle."""
    inputs = (Link("d", "d"), Link("delta_rate", "delta" if angle else "delta_rate"))
    links = [Link(name, name) for name in STATES]
    wiring = Wiring(inputs, links, links)
    return FmuSimulator(CAR, host, wiring, period_s=0.02, part_s=part_s, any_size=any_size)


def test_the_guard_stays_in_front_of_the_fmu(host: FmuHost) -> None:
    car = simulator(host)
    car.reset((0, 0, 0, 2.0, 0, 0, 0.3))
    car.step((5.0, 99.0))
    assert car.u_applied == pytest.approx((CAR.d_max, 0.05 / 0.02))
    car.step((math.nan, 0.0))
    assert car.u_applied == pytest.approx((CAR.d_min, 0.0), abs=0)
    assert asdict(car.guard.counters) == {"rejected": 1, "clipped": 1, "planned": 0, "braked": 1}
    assert (car.steps, car.time_s) == (2, 0.04)
    with pytest.raises(InputError, match="steering angle"):
        car.reset((0, 0, 0, 0, 0, 0, 0.5))


def test_a_command_that_changes_within_the_period_acts_from_there(
    host: FmuHost,
) -> None:
    """One step of any size, steps of 1 ms, and steering angles that follow the rate."""
    deltas = []
    for angle, any_size in ((False, True), (False, False), (True, True)):
        car = simulator(host, angle=angle, any_size=any_size)
        car.reset((0, 0, 0, 1.0, 0, 0, 0.01))
        car.step_switched([(5, (0.5, 2.0)), (0, None), (15, None)])
        assert car.u_applied == pytest.approx(((5 * 0.5 + 15 * CAR.d_min) / 20, 0.5))
        deltas.append(car.x[6])
    assert deltas[:2] == pytest.approx([0.02, 0.02])
    # This FMU integrates its second input: the sum of the angles sent.
    first = [0.01 + 0.002 * k for k in range(1, 6)]
    held = 0.01 + 1e-3 * sum(first)
    assert deltas[2] == pytest.approx(held + 0.015 * held)
    with pytest.raises(ValueError, match="20 substeps"):
        car.step_switched([(7, None)])


def test_after_a_fault_the_last_sample_stands(host: FmuHost) -> None:
    car = simulator(host)
    car.reset((0, 0, 0, 1.0, 0, 0, 0))
    car.step((0.5, 1.0))
    before, applied = car.x.copy(), car.u_applied
    process_of(host).kill()
    process_of(host).wait()
    with pytest.raises(FmuFault, match="SIGKILL"):
        car.step_switched([(5, None), (15, (0.1, 0.0))])
    np.testing.assert_array_equal(car.x, before)
    assert (car.steps, car.u_applied) == (1, applied)
    car.reset((0, 0, 0, 1.0, 0, 0, 0))
    host.start({"mode": float(Mode.HUGE_VALUE), "at_s": 0.0})
    with pytest.raises(FmuFault, match=r"vx = 1e\+09"):
        car.step((0.5, 1.0))


def test_the_communication_step(tmp_path: Path) -> None:
    def step(attributes: str, wanted_s: float | None = None, version: int = 2) -> float:
        path = faulty_fmu(faulty_library(2), tmp_path / "s.fmu", version, attributes=attributes)
        return communication_step(inspect(path), wanted_s, 0.02)

    any_size = 'canHandleVariableCommunicationStepSize="true"'
    assert step(any_size) == 1e-3
    assert step(any_size, 0.005) == 0.005
    assert step("") == 0.02
    assert step('fixedInternalStepSize="0.004"', version=3) == 0.004
    assert step('fixedInternalStepSize="0.003"', version=3) == 0.02
    assert step(any_size + ' fixedInternalStepSize="0.0025"', version=3) == 0.0025
    for wrong in (0.003, 0.04, 0.0):
        with pytest.raises(InputError, match="does not divide the plant's period"):
            step("", wrong)


START = [1.0, 2.0, -math.pi / 4, 0.1, 0.0, 0.0, 0.1]


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_foreign_fmu(tmp_path_factory.mktemp("foreign"))


@pytest.mark.parametrize(
    "settings", ["", "step_s = 0.005", "step_s = 0.02"], ids=["any step", "5 ms", "a period"]
)
def test_another_tools_fmu_drives_as_the_built_in_car(
    foreign: Path, tmp_path: Path, settings: str
) -> None:
    """Turning left and right, several turns of heading, commands that change within a period."""
    map_ = tmp_path / "map.toml"
    patient = f"[fmu]\ntimeout_s = 20\nstartup_s = 60\n{settings}"
    map_.write_text(FOREIGN_MAP.replace("[fmu]", patient))
    ours = Simulator(dynamic(CAR))
    with open_fmu(CAR, foreign, map_) as theirs:
        for run in range(2):  # the second one starts afresh
            ours.reset(START)
            theirs.reset(START)
            assert np.abs(theirs.x - ours.x).max() < 1e-12
            for k in range(200):
                u = (0.4 if k % 50 else -0.05, 5.0 if k < 4 else 0.3 * math.sin(0.05 * k))
                if k % 10 == 5 and theirs.substeps % 4 == 0:
                    part = theirs.substeps // 4
                    theirs.step_switched([(part, (0.2, -2.0)), (3 * part, u)])
                    ours.step_switched([(5, (0.2, -2.0)), (15, u)])
                else:
                    theirs.step(u)
                    ours.step(u)
                assert np.abs(theirs.x - ours.x).max() < 1e-9, (run, k)
                assert theirs.u_applied == pytest.approx(ours.u_applied, abs=1e-12)
            assert abs(ours.x[2] - START[2]) > 2 * math.pi
