"""A scenario in simulated time: the processes' own loops, the same to the bit each time."""

from functools import partial
from pathlib import Path

from bayesrace.codegen.compiler import compiled
from bayesrace.controller.assembly import predictive_controller
from bayesrace.files import write_whole
from bayesrace.log import LogWriter
from bayesrace.operation.simulation import SimulatedSystem
from bayesrace.operation.simulation.system import Part
from bayesrace.plant.vehicle import open_vehicle
from bayesrace.studies.evidence.scenario.events import timeline
from bayesrace.studies.evidence.scenario.preparing import Ready
from bayesrace.transport.relay import Link

__all__ = ["SETTLING_S", "drive_simulated"]

SETTLING_S = 1.5
"""After the run, until all counters are in the log."""


class _Simulated:
    """The simulated system as :class:`.events.System`."""

    def __init__(self, system: SimulatedSystem) -> None:
        self._system = system
        self.stop, self.go, self.roll_back = system.stop, system.go, system.roll_back
        self.pause = system.pause
        self.kill = partial(system.kill, "controller")
        self.restart = partial(system.start, "controller")

    def set_link(self, to: Part, link: Link) -> None:
        self._system.ways[to].link = link

    def hold(self, to: Part) -> None:
        self._system.ways[to].hold()

    def release(self, to: Part) -> None:
        self._system.ways[to].release()

    def publish(self, weights: Path) -> object:
        return self._system.publish(weights.read_bytes())


def drive_simulated(ready: Ready, folder: Path) -> None:
    """Leaves ``run.mcap`` in the folder. InputError if the drive cannot be begun, or an event
    cannot happen."""
    scenario, plant, first = ready.scenario, ready.plant, ready.prepared.first
    mpc = folder / "mpc.json"
    write_whole(mpc, scenario.mpc.model_dump_json(indent=1) + "\n")
    make = partial(
        predictive_controller, ready.prepared.artefacts[0], ready.controller.car,
        first.track_file, first.line_file, mpc, ready.first_weights,
    )  # fmt: skip
    played = plant.car, plant.fmu, plant.fmu_map, plant.rate_hz, compiled
    log = LogWriter(folder / "run.mcap")
    try:
        with (
            open_vehicle(*played, simulator=plant.simulator, world=plant.changes) as vehicle,
            SimulatedSystem(
                first.track, make, log, plant, ready.controller, vehicle=vehicle, seed=scenario.seed
            ) as system,
        ):
            acted_on = _Simulated(system)
            for time_s, act in timeline(scenario.event, ready.weights):
                system.at(time_s, partial(act, acted_on))
            system.drive(ready.plan)
            system.sleep(SETTLING_S)
    finally:
        log.close()
