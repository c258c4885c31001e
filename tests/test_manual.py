"""A person drives with a gamepad or at a terminal: an ordinary log, and braking without a word."""

import math
import os
import pty
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bayesrace.controller import manual
from bayesrace.controller.interface import Environment
from bayesrace.controller.manual import (
    NO_DRIVER,
    Device,
    Gamepad,
    Keyboard,
    ManualDriver,
)
from bayesrace.controller.python_controller import PythonController
from bayesrace.learning.sources import read_samples
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.collect import _log_of
from bayesrace.vehicles import get_car
from tests.command_line import Cli, refused
from tests.conftest import Circuit
from tests.programs import until

CAR = get_car("orca")
AXIS, BUTTON, INITIAL = 2, 1, 0x80
STEERING, DRIVE = 0, 4


def event(number: int, share: float, kind: int = AXIS) -> bytes:
    """As the kernel reports a stick; it counts to the right and down."""
    return struct.pack("<IhBB", 0, round(32767 * share), kind, number)


def test_a_wheel_has_other_axes(pad: int, tmp_path: Path) -> None:
    device = Gamepad(f"{tmp_path / 'js0'}:3,1")
    os.write(pad, event(3, 1.0) + event(1, -1.0))
    heard(device, 1.0, -1.0)


@pytest.fixture
def pad(tmp_path: Path) -> Iterator[int]:
    """The end of a FIFO that a gamepad writes to."""
    os.mkfifo(tmp_path / "js0")
    file = os.open(tmp_path / "js0", os.O_RDWR)
    yield file
    os.close(file)


def heard(device: Gamepad | Keyboard, drive: float, steering: float) -> None:
    expected = pytest.approx((drive, steering), abs=0.03)
    until(lambda: device.wanted() == expected, f"{drive}, {steering}; there is {device.wanted()}")


def test_the_sticks_are_read_as_the_kernel_reports_them(pad: int, tmp_path: Path) -> None:
    device = Gamepad(str(tmp_path / "js0"))
    assert device.wanted() is None
    os.write(pad, event(DRIVE, -1.0, AXIS | INITIAL) + event(STEERING, 0.54))
    heard(device, 1.0, -0.5)
    data = event(DRIVE, 0.04) + event(STEERING, -1.0) + event(DRIVE, 1.0, BUTTON)
    os.write(pad, data[:13])  # in the middle of an event
    os.write(pad, data[13:])
    heard(device, 0.0, 1.0)


def test_a_person_drives_a_car_and_the_log_is_one_to_learn_from(
    pad: int, circuit: Circuit, kinematic_artefact: Path, tmp_path: Path
) -> None:
    """In simulated time, which passes faster than the second after which there is no driver."""
    os.write(pad, event(DRIVE, -0.5) + event(STEERING, -0.4))
    law = ManualDriver(CAR, Gamepad(str(tmp_path / "js0")), 0.02)
    controller = PythonController(kinematic_artefact, law, circuit.track.identity)
    log = _log_of(tmp_path / "log.mcap", circuit.track, CAR)
    loop = ClosedLoop(CAR, circuit.track, circuit.line, controller, log=log)
    until(lambda: law.device.wanted() is not None, "the gamepad")
    driven = loop.drive(0, 2.0)
    log.close()
    assert driven.fallbacks == 0
    way_m = np.linalg.norm(np.diff(driven.x[:, :2], axis=0), axis=1).sum()
    assert way_m > 2.0
    assert driven.x[-1, 2] - driven.x[0, 2] > math.pi / 2  # to the left
    u = driven.moments["u_applied"][1:]
    assert u[:, 0] == pytest.approx(CAR.d_max * (0.5 - 0.08) / 0.92, abs=1e-4)
    assert np.abs(u[:, 1]).max() <= CAR.delta_rate_max_radps
    assert driven.x[-1, 6] == pytest.approx(CAR.delta_max_rad * (0.4 - 0.08) / 0.92, abs=1e-4)
    samples = read_samples([tmp_path / "log.mcap"]).dataset
    assert len(samples) > 90
    assert samples.x[:, 3].max() > 1.5


class Hands(Device):
    """As a test wants it."""

    def __init__(self, drive: float, steering: float) -> None:
        self.said = drive, steering

    def wanted(self) -> tuple[float, float]:
        return self.said


@pytest.mark.parametrize(
    ("wanted", "vx", "limit", "d"),
    [
        ((1.0, 0.0), 2.0, math.inf, CAR.d_max),
        ((-1.0, 0.0), 2.0, math.inf, CAR.d_min),
        ((-1.0, 0.0), 0.0, math.inf, 0.0),  # not backwards
        ((1.0, 0.0), 2.0, 0.0, CAR.d_min),  # stop
        ((0.1, 0.0), 1.0, 2.0, 0.1 * CAR.d_max),
    ],
)
def test_the_inputs_keep_to_the_car_and_to_a_speed_limit(
    wanted: tuple[float, float], vx: float, limit: float, d: float
) -> None:
    law = ManualDriver(CAR, Hands(*wanted), 0.02)
    x = np.array([0, 0, 0, vx, 0, 0, 0.9 * CAR.delta_max_rad])
    assert law.step(x, np.zeros(2), Environment(limit, 0.0)).u[0] == pytest.approx(d)
    law = ManualDriver(CAR, Hands(wanted[0], -1.0), 0.02)
    assert law.step(x, np.zeros(2)).u[1] == -CAR.delta_rate_max_radps


@pytest.mark.parametrize("fault", ["silent", "unplugged"])
def test_a_car_without_a_driver_brakes(
    fault: str, circuit: Circuit, kinematic_artefact: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(manual, "_SILENT_S", 0.3)
    os.mkfifo(tmp_path / "js0")
    file = os.open(tmp_path / "js0", os.O_RDWR)
    device = Gamepad(str(tmp_path / "js0"))
    controller = PythonController(kinematic_artefact, ManualDriver(CAR, device, 0.02))
    os.write(file, event(DRIVE, -0.5))
    until(lambda: device.wanted() is not None, "the gamepad")

    def leave(x: object) -> None:
        """A second after the start, in simulated time."""
        if len(seen) == 50:
            if fault == "unplugged":
                os.close(file)
            until(lambda: device.wanted() is None, "nobody there")
        elif len(seen) < 50:
            os.write(file, event(DRIVE, -0.5))
        seen.append(x)

    seen: list[object] = []
    loop = ClosedLoop(CAR, circuit.track, circuit.line, controller)
    driven = loop.drive(0, 6.0, watch=leave)
    assert driven.levels[:49].max() == 0
    assert driven.levels[52:].min() > 0
    assert set(driven.statuses[52:-1]) <= {NO_DRIVER, 253}
    assert driven.x[49, 3] > 1.0
    assert abs(driven.x[-1, 3]) < 0.05
    if fault == "silent":
        os.close(file)


def test_the_keys_drive_and_let_go() -> None:
    person, terminal = pty.openpty()
    device = Keyboard(terminal)
    assert device.wanted() is None
    for drive, steering in ((b"w", b"a"), (b"\x1b[A", b"\x1b[D"), (b"W", b"\x1bOD")):
        os.write(person, drive + steering)
        until(lambda: min(device.wanted() or (0.0,)) > 0.8, "forwards and to the left")
        until(lambda: (device.wanted() or (1, 1))[1] == 0, "straight again")
    os.write(person, b"s\x1b[C")
    until(lambda: max(device.wanted() or (0.0,)) < -0.8, "braking, and to the right")
    until(lambda: device.wanted() is None, "nobody there")
    os.close(person)
    os.close(terminal)


def test_what_cannot_be_driven_with_is_refused(
    cli: Cli, kinematic_artefact: Path, tmp_path: Path
) -> None:
    base = ("controller", "--artefact", kinematic_artefact, "--track", "paddock")
    refused(cli(*base, "--manual", "js7"), "cannot read the gamepad js7", "/dev/input/js0")
    refused(cli(*base, "--manual", "js7:left"), "--manual js7:left", "js7:0,4")
    refused(cli(*base, "--manual", "keyboard"), "standard input is no terminal")
    refused(cli(*base, "--manual", "js7", "--pursuit", "0.5"), "without --pursuit")
    refused(cli(*base, "--manual", "js7", "--weights", "w.bin"), "without --weights")
    refused(cli(*base), "--raceline FILE")
