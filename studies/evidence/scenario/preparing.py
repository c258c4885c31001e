"""What a scenario's plant and controller are started with, made or taken from the cache."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.errors import InputError
from bayesrace.files import read_whole
from bayesrace.operation.closed_loop import ClosedLoop, built_in_car
from bayesrace.operation.preparation import Prepared, prepare, updated_weights
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.plant.process_settings import PlantSettings
from bayesrace.plant.settings import CarSimulation
from bayesrace.studies.evidence.scenario.description import Scenario

__all__ = ["RUN", "Ready", "make_ready"]

RUN = 1
"""Number of the run in each recording."""


@dataclass(frozen=True, eq=False)
class Ready:
    """A scenario, and all files that it names."""

    scenario: Scenario
    prepared: Prepared
    named: dict[str, Path]

    def weights(self, name: str) -> bytes:
        """Content of the weights of that name."""
        return read_whole(self.named[name], "the weights")

    @property
    def first_weights(self) -> Path | None:
        """That the controller begins with."""
        return self.named.get(self.scenario.weights)

    @property
    def plan(self) -> RunPlan:
        """The run."""
        one = self.scenario
        return RunPlan(
            RUN, one.name, one.laps, one.max_time_s, lockstep=False,
            start_speed_mps=one.race.start_speed_mps,
        )  # fmt: skip

    @property
    def plant(self) -> PlantSettings:
        """Of its process."""
        one, race = self.scenario, self.scenario.race
        values: dict[str, Any] = {name: getattr(race, name) for name in CarSimulation.model_fields}
        values |= {
            "car": race.true_car, "world": one.world(self.prepared.first.track),
            "rate_hz": one.states_hz, "seed": race.seed, "sensor_faults": one.faults,
            "buffer_s": 1e-3 * one.buffer_ms,
        }  # fmt: skip
        return PlantSettings.model_validate(values)

    @property
    def controller(self) -> ControllerSettings:
        """Of its process."""
        return self.scenario.controller.model_copy(update={"car": self.scenario.race.driven_car})


def make_ready(scenario: Scenario, stages: Stages) -> Ready:
    """InputError for a car, track or weights that cannot be used; others as of ``prepare``."""
    race = scenario.race
    prepared = prepare(race, (scenario.track or race.car.race_track,), stages)
    named = dict[str, Path]()
    for name in sorted(scenario.wanted_weights - {"none"}):
        if name == "learned":
            named[name] = prepared.weights
        elif name == "updated":
            with stages.stage("update the weights"):
                named[name] = _updated(scenario, prepared)
        elif (path := Path(name)).is_file():
            named[name] = path
        else:
            raise InputError(
                f"weights = '{name}': no such file; give one, or learned, updated or none"
            )
    return Ready(scenario, prepared, named)


def _updated(scenario: Scenario, prepared: Prepared) -> Path:
    """Learned once more, from two laps with those of the training drives."""
    race, first = scenario.race, prepared.first
    controller = compiled_controller(
        prepared.artefacts[0], race.driven_car, first.track, first.line, prepared.weights
    )
    loop = ClosedLoop(
        race.driven_car, first.track, first.line, controller, built_in_car(race.true_car),
        sensors=race.instruments, seed=race.seed,
    )  # fmt: skip
    samples = [*prepared.samples, loop.drive(2).samples()]
    return updated_weights(samples, race, prepared.weights)[0]
