"""A person in place of the controller, at a gamepad or at the keys of a terminal: driving by hand
is training data, as in the paper.

When nothing has been heard of the device for a second, or it is gone, the step has no solution, and
the control cycle brakes the car as it does where any controller fails.
"""

import atexit
import logging
import math
import os
import re
import struct
import termios
import threading
import tty
from contextlib import suppress
from typing import Any, Final

import numpy as np

from bayesrace import clock
from bayesrace.arrays import Floats
from bayesrace.controller.interface import NO_LIMITS, Environment, StepOutput
from bayesrace.controller.pure_pursuit import dead_reckoning, turning
from bayesrace.errors import InputError
from bayesrace.vehicles.parameters import Car

__all__ = ["KEYBOARD", "NO_DRIVER", "Device", "Gamepad", "Keyboard", "ManualDriver"]

KEYBOARD: Final = "keyboard"
"""In place of the device of a gamepad."""
NO_DRIVER: Final = 100
"""Status of a step without a driver."""

_SILENT_S: Final = 1.0
"""Without a word of the device the driver is taken to be gone."""
_DEAD_ZONE: Final = 0.08
"""Of a stick's way on each side."""
_DECAY_S: Final = (0.8, 0.3)
"""In which a key that is not pressed again lets go of the drive, and of the steering."""

_EVENT: Final = struct.Struct("<IhBB")  # js_event of linux/joystick.h: ms, value, type, number
_AXIS: Final = 0x02
_FULL: Final = 32767
_KEY: Final = re.compile(rb"\x1b[\[O]([ABCD])|([wasd])", re.IGNORECASE)
"""Arrows, which are sent as ESC [ A, and letters."""
_WAYS: Final = {
    b"A": (0, 1.0), b"B": (0, -1.0), b"D": (1, 1.0), b"C": (1, -1.0),
    b"w": (0, 1.0), b"s": (0, -1.0), b"a": (1, 1.0), b"d": (1, -1.0),
}  # fmt: skip
"""Whether an arrow or a letter is for the drive or for the steering, and which way."""

_log = logging.getLogger("bayesrace.manual")


class Device:
    """What a person drives with: a file, read in a thread of its own."""

    def __init__(self, file: int, name: str) -> None:
        self._file, self._name, self._heard_s = file, name, -math.inf
        threading.Thread(target=self._run, daemon=True, name="manual").start()

    def wanted(self) -> tuple[float, float] | None:
        """Drive (1 full, -1 braking) and steering (1 left); None without a driver."""
        return self._wanted() if clock.monotonic() - self._heard_s < _SILENT_S else None

    def _run(self) -> None:
        why = "it has ended"
        try:
            while data := os.read(self._file, 4096):
                self._take(data)
                self._heard_s = clock.monotonic()
        except OSError as error:
            why = str(error.strerror)
        self._heard_s = -math.inf
        _log.error("%s: %s: the car brakes; start the controller again", self._name, why)

    def _take(self, data: bytes) -> None:
        raise NotImplementedError

    def _wanted(self) -> tuple[float, float]:
        raise NotImplementedError


class Gamepad(Device):
    """A device of Linux's joystick interface, ``/dev/input/js0``: the left stick steers, the right
    one drives, as Xbox and PlayStation pads have them. ``DEVICE:STEERING,DRIVE`` has other axes."""

    def __init__(self, device: str) -> None:
        """InputError if there is none."""
        path, _, axes = device.partition(":")
        try:
            steering, drive = map(int, (axes or "0,4").split(","))
        except ValueError:
            raise InputError(f"--manual {device}: give axes as {path}:0,4") from None
        self._axes, self._values, self._rest = (drive, steering), dict[int, int](), b""
        try:
            file = os.open(path, os.O_RDONLY)
        except OSError as error:
            raise InputError(
                f"cannot read the gamepad {path}: {error.strerror}; give its device, as "
                f"/dev/input/js0, or '{KEYBOARD}'"
            ) from error
        super().__init__(file, path)

    def _take(self, data: bytes) -> None:
        data = self._rest + data
        whole = len(data) - len(data) % _EVENT.size
        self._rest = data[whole:]
        for _, value, kind, number in _EVENT.iter_unpack(data[:whole]):
            if kind & _AXIS:
                self._values[number] = value

    def _wanted(self) -> tuple[float, float]:
        drive, steering = (self._pushed(axis) for axis in self._axes)
        return drive, steering

    def _pushed(self, axis: int) -> float:
        """1: all the way to the left or forwards, where axes are lowest."""
        share = -self._values.get(axis, 0) / _FULL
        beyond = max(abs(share) - _DEAD_ZONE, 0.0) / (1 - _DEAD_ZONE)
        return min(beyond, 1.0) * (1 if share > 0 else -1)


def _restore(terminal: int, before: list[Any]) -> None:
    with suppress(termios.error):  # it may be gone
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


class Keyboard(Device):
    """The keys of a terminal, WASD or the arrows; each lets go by and by."""

    def __init__(self, terminal: int = 0) -> None:
        """InputError if the file is no terminal."""
        if not os.isatty(terminal):
            raise InputError(f"--manual {KEYBOARD}: standard input is no terminal; start it in one")
        atexit.register(_restore, terminal, termios.tcgetattr(terminal))
        tty.setcbreak(terminal)  # Ctrl-C still ends the program
        self._pressed = [(0.0, 0.0), (0.0, 0.0)]
        super().__init__(terminal, KEYBOARD)

    def _take(self, data: bytes) -> None:
        now = clock.monotonic()
        for arrow, letter in _KEY.findall(data):
            which, way = _WAYS[arrow.upper() or letter.lower()]
            self._pressed[which] = way, now

    def _wanted(self) -> tuple[float, float]:
        now, pressed = clock.monotonic(), zip(self._pressed, _DECAY_S, strict=True)
        drive, steering = (way * max(1 - (now - at) / decay, 0) for (way, at), decay in pressed)
        return drive, steering


class ManualDriver:
    """A :class:`bayesrace.controller.interface.ControlLaw` that does as a person wants, within the
    car's limits and, at a speed limit, such as that of a stop, no faster."""

    def __init__(self, car: Car, device: Device, step_s: float) -> None:
        self.device, self._car, self._step_s = device, car, step_s
        self._output = StepOutput(u=np.zeros(2))

    def reset(self) -> None:
        """It knows nothing of the past."""

    def predict(self, x: Floats, u: Floats, duration_s: float) -> Floats:
        """As :func:`.dead_reckoning`."""
        return dead_reckoning(self._car, x, u, duration_s)

    def step(
        self,
        x: Floats,
        u_previous: Floats,
        environment: Environment = NO_LIMITS,
        elapsed_s: float = 0.0,
        budget_s: float = 0.0,
    ) -> StepOutput:
        """What the person wants; status :data:`NO_DRIVER` without one."""
        car, output, vx = self._car, self._output, float(x[3])
        wanted = self.device.wanted()
        output.status = NO_DRIVER if wanted is None else 0
        drive, steering = wanted or (0.0, 0.0)
        # Braking fades to none at standstill: the car does not drive backwards.
        lowest = car.d_min * min(max(vx / car.brake_fade_mps, 0.0), 1.0)
        d = drive * car.d_max if drive > 0 else -drive * car.d_min
        slower = environment.speed_limit_mps - vx
        held = car.tuning.pursuit.speed_gain_spm * slower + car.drive.command_at(vx, 0, car.mass_kg)
        output.u[0] = min(max(min(d, held), lowest), car.d_max)
        output.u[1] = turning(car, float(x[6]), steering * car.delta_max_rad, self._step_s)
        return output
