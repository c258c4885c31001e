"""Measures a system that somebody else has started, from outside."""

from pathlib import Path

from bayesrace.errors import InputError
from bayesrace.tracks import load_track
from bayesrace.transport import Director, Endpoints, open_session
from experiments.latency.settings import LatencySettings
from experiments.latency.stand import Measured, Stand, check_new, measure, measurement, open_folder
from experiments.progress import Stages

__all__ = ["measure_attached"]


def measure_attached(settings: LatencySettings, out: Path, stages: Stages) -> Measured:
    """Measures a run that is under way elsewhere, and leaves it as it is; otherwise the same."""
    check_new(out)
    track = load_track(settings.track) if settings.track else None
    with open_session(Endpoints(connect=settings.attach)) as session:
        director = Director(session, settings.car_name)
        with stages.stage("attach"):
            director.wait_for(("plant", "controller"), 10.0)
            status, plant = director.status("controller"), director.status("plant")
            if plant.phase != "running" or not status.rate_hz:
                raise InputError(
                    f"car '{settings.car_name}' is not driving by the wall clock (plant: "
                    f"{plant.phase}); start a run with 'bayesrace drive --mode realtime'"
                )
            open_folder(out, settings)
            stand = Stand(session, director, [], {})
            measured = measurement(settings, stand, status.rate_hz, track, out)
        return measure(settings, stand, measured, out, stages)
