"""Training data: a pure-pursuit drive of the car, logged as a race's drives are."""

from pathlib import Path

from bayesrace.log import LogWriter
from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track
from bayesrace.vehicles import CarParameters, car_text
from controller.pure_pursuit import PurePursuit, PurePursuitSettings
from controller.python_controller import PythonController
from operation.closed_loop import ClosedLoop
from plant.fmu.faults import FmuFault
from plant.sensors import SensorNoise
from plant.vehicle import Vehicle

__all__ = ["collect"]


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
) -> int:
    """Drives for ``duration_s`` and logs the run at ``path``; returns the number of samples.

    ``noise``, ``delay_s``: as in :class:`ClosedLoop`, the seed is that of ``settings``.

    The same settings give the same drive to the bit. ``artefact``: a controller built for the car,
    whose control cycle drives. ``vehicle``: what simulates the car; the built-in equations without.
    Raises FmuFault if it fails.
    """
    pursuit = PurePursuit(car, line.x_m, line.y_m, line.vx_mps, settings)
    log = LogWriter(path, {"collect": {"track": track.name, "car": car_text(car)}})
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
    return len(driven.u)
