"""Training data: a pure-pursuit drive of the car, logged as a race's drives are.

It follows the racing line where that leaves room to the track's edges, and else a line made of it.
A drive that leaves the track is driven again, slower.
"""

from pathlib import Path
from typing import Final

from bayesrace.log import LogWriter
from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track
from bayesrace.vehicles import CarParameters, car_text
from controller.pure_pursuit import PurePursuit, PurePursuitSettings
from controller.python_controller import PythonController
from operation.closed_loop import ClosedLoop, Driven, built_in_car
from operation.training_line import room_beside, training_line
from plant.settings import SensorNoise
from plant.vehicle import FmuFault, Vehicle

__all__ = ["collect"]

_ATTEMPTS: Final = 8
_SLOWER: Final = 0.93
"""Speed of an attempt over that of the one before; that of the last is 0.6 times the style's."""


def collect(
    track: Track,
    line: RaceLine,
    car: CarParameters,
    artefact: Path,
    path: Path,
    duration_s: float,
    settings: PurePursuitSettings,
    start_speed_mps: float = 0.1,
    vehicle: Vehicle | None = None,
    noise: SensorNoise | None = None,
    delay_s: float = 0.0,
) -> Driven:
    """Drives for ``duration_s`` and logs the run at ``path``: the first that stays on the track, or
    the slowest. With a ``speed_scale`` in ``settings`` there is but one.

    ``noise``, ``delay_s``: as in :class:`ClosedLoop`, the seed is that of ``settings``.

    The same settings give the same drive to the bit. ``artefact``: a controller built for the car,
    whose control cycle drives. ``vehicle``: what simulates the car; the built-in equations without.
    Raises FmuFault if it fails.
    """
    followed = training_line(track, line, car, settings.style)
    room_m, columns = room_beside(track, followed), (followed.x_m, followed.y_m, followed.vx_mps)
    vehicle = vehicle or built_in_car(car)
    for attempt in range(1 if settings.speed_scale else _ATTEMPTS):
        scale = settings.scale * _SLOWER**attempt
        slower = settings.model_copy(update={"speed_scale": scale})
        pursuit = PurePursuit(car, *columns, slower, room_m=room_m)
        about = {"track": track.name, "car": car_text(car), "speed_scale": f"{scale:.3g}"}
        log = LogWriter(path, {"collect": about})
        try:
            loop = ClosedLoop(
                car, track, line, PythonController(artefact, pursuit), vehicle, log,
                noise=noise, seed=settings.seed, delay_s=delay_s,
            )  # fmt: skip
            driven = loop.drive(0, duration_s, start_speed_mps, name="pure-pursuit")
        finally:
            log.close()
        if driven.end.reason == "plant_fault":
            raise FmuFault(driven.end.text)
        if float(track.project_path(driven.x[:, :2]).off_track_m.max()) <= 0:
            break
    return driven
