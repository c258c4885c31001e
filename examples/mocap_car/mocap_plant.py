"""The plant of a car that motion capture sees: poses and commands by UDP. See README.md.

What is special about this car is in ``MocapCar``: two kinds of datagrams. Write such a class for
yours; runs, guard, braking plan, laps and status are those of every plant.
"""

import argparse
import logging
import math
import socket
import struct
import sys

from bayesrace.errors import InputError
from bayesrace.plant.hardware import Hardware, Report
from bayesrace.plant.process import main
from bayesrace.plant.process_settings import PlantSettings
from bayesrace.transport import Endpoints
from bayesrace.vehicles import Car, get_car

POSE = struct.Struct("!4d")  # clock of the cameras [s], x, y [m], heading [rad]
COMMAND = struct.Struct("!3d")  # drive command, steering angle [rad], to be reached at [rad/s]
DEVIATION = {"x": 0.0005, "y": 0.0005, "psi": math.radians(0.2)}  # of one pose
DELAY_S = 0.01  # from the exposure of a picture to the datagram's arrival, at the least
COMMAND_S = 0.001  # from sending a command to its acting


class MocapCar(Hardware):
    """Poses arrive at ``here``; commands go to ``there``."""

    def __init__(self, car: Car, here: tuple[str, int], there: tuple[str, int]) -> None:
        super().__init__(car, delays_s={"pose": DELAY_S}, command_s=COMMAND_S)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(here)
        self._socket.settimeout(0.1)
        self._there = there

    def receive(self) -> Report | None:
        """The next pose."""
        try:
            data = self._socket.recv(1024)
        except TimeoutError:
            return None
        if len(data) != POSE.size:
            return None
        clock_s, *pose = POSE.unpack(data)
        values = {
            name: (value, DEVIATION[name]) for name, value in zip(DEVIATION, pose, strict=True)
        }
        return Report("pose", values, clock_s)

    def send(self, d: float, delta_rad: float, rate_radps: float) -> None:
        """One command; the car brakes by itself when none has come for 0.2 s."""
        self._socket.sendto(COMMAND.pack(d, delta_rad, rate_radps), self._there)


def address(text: str) -> tuple[str, int]:
    """HOST:PORT"""
    host, _, port = text.rpartition(":")
    return host, int(port)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--car", default="orca", help="built-in car, or its file")
    parser.add_argument("--poses", type=address, default="127.0.0.1:7500", help="they arrive here")
    parser.add_argument("--commands", type=address, default="127.0.0.1:7501", help="they go there")
    parser.add_argument("--endpoint", default="tcp/127.0.0.1:7447", help="of the controller's link")
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO)
    try:
        settings = PlantSettings(
            car=get_car(given.car), endpoints=Endpoints(listen=(given.endpoint,))
        )
        with MocapCar(settings.car, given.poses, given.commands) as car:
            sys.exit(main(settings, hardware=car))
    except InputError as error:
        sys.exit(f"plant: {error}")
