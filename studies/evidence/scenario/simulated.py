"""A scenario in simulated time: the processes' own loops, the same to the bit each time."""

from functools import partial
from pathlib import Path

from bayesrace.codegen.compiler import compiled
from bayesrace.controller.assembly import predictive_controller
from bayesrace.log import LogWriter
from bayesrace.operation.simulation import SimulatedSystem
from bayesrace.plant.vehicle import open_vehicle
from bayesrace.scene import Scene
from bayesrace.studies.evidence.scenario.events import timeline
from bayesrace.studies.evidence.scenario.preparing import Ready

__all__ = ["SETTLING_S", "drive_simulated"]

SETTLING_S = 1.5
"""After the run, until all counters are in the log."""


def drive_simulated(ready: Ready, folder: Path) -> None:
    """Leaves ``run.mcap`` in the folder of ``mpc.json``. InputError if the drive cannot be begun,
    or an event cannot happen."""
    scenario, plant, first = ready.scenario, ready.plant, ready.prepared.first
    make = partial(
        predictive_controller, ready.prepared.artefacts[0], ready.controller.car,
        first.track_file, first.line_file, folder / "mpc.json", ready.first_weights,
    )  # fmt: skip
    played = plant.car, plant.fmu, plant.fmu_map, plant.rate_hz, compiled
    scene = Scene(plant.car, first.track, first.line, plant.name)
    log = LogWriter(folder / "run.mcap", scene=scene)
    try:
        with (
            open_vehicle(*played, simulator=plant.simulator, world=plant.changes) as vehicle,
            SimulatedSystem(
                first.track, make, log, plant, ready.controller, vehicle=vehicle, seed=scenario.seed
            ) as system,
        ):
            for time_s, act in timeline(scenario.event, ready.weights):
                system.at(time_s, partial(act, system))
            system.drive(ready.plan)
            system.sleep(SETTLING_S)
    finally:
        log.close()
