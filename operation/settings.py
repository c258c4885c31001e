"""Settings of a race, as one resolved object that goes into the run directory."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from bayesrace.codegen.settings import ProblemName
from bayesrace.controller.pure_pursuit import PurePursuitSettings
from bayesrace.controller.settings import MpcSettings
from bayesrace.defaults import Option
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.learning.settings import DEFAULT_KERNELS, WIDEN, Kernel
from bayesrace.plant.settings import CarSimulation
from bayesrace.raceline import RaceLineSettings
from bayesrace.vehicles import Car

__all__ = ["BayesianSettings", "PreparationSettings", "RaceSettings", "TimeMode"]

TimeMode = Literal["lockstep", "realtime"]
"""How time passes in a run."""


class PreparationSettings(CarSimulation):
    """From what, and with what, everything is made that a drive needs."""

    train_track: str = Field(
        "",
        description="track of the training drive: name, random:SEED, random10:SEED or CSV file; "
        "empty: the car's",
    )
    true_grip: float = Field(
        1.0,
        gt=0,
        le=3,
        description="tyre forces of the simulated car, as a multiple of those in its file, "
        "which all controllers but BestCase assume",
    )
    seed: int = Field(
        0,
        ge=0,
        le=2**32 - 1,
        description="seed of the training drives, the GP's starts and the sensors' errors",
    )
    start_speed_mps: float = Field(0.1, ge=0, le=5, description="speed at the start line")
    collect_s: Annotated[float | None, Option("--train-time")] = Field(
        None,
        ge=1,
        le=3600,
        description="length of the training drives [s]; None: the car's, and a lap at least",
    )
    practice_laps: int = Field(
        3,
        ge=0,
        le=100,
        description="laps of the training track by the controller itself, with its default "
        "settings, which it learns from before it races",
    )
    practice_until: float = Field(
        0.01,
        ge=0,
        le=1,
        description="practice goes on, on larger copies of the training track, while more than "
        "this share of a lap would be lost where the racing line is faster than what was learned",
    )
    points: int = Field(400, ge=20, le=1024, description="training points per output")
    kernels: tuple[Kernel, ...] = Field(
        DEFAULT_KERNELS, min_length=1, description="candidates of the GPs; held-out errors decide"
    )
    widen: float = Field(
        WIDEN,
        ge=1,
        le=100,
        description="factor on the standard deviations of first weights, where states are measured "
        "and there is no practice",
    )
    threads: int = Field(
        0, ge=0, description="of the training, which they do not change; 0: one per core"
    )
    problem: ProblemName = Field(
        "tracking",
        description="control problem: tracking (the line, at its speed) or progress (as fast as "
        "possible)",
    )
    horizon: int | None = Field(
        None, ge=2, le=100, description="stages of the horizon; None: the car's, from its tuning"
    )
    discretisation: Discretisation = PREDICTION
    raceline: RaceLineSettings = RaceLineSettings()
    pursuit: PurePursuitSettings = PurePursuitSettings()

    @model_validator(mode="after")
    def _of_the_car(self) -> Self:
        """What is not stated and the car knows."""
        object.__setattr__(self, "train_track", self.train_track or self.car.train_track)
        return self

    @property
    def driven_car(self) -> Car:
        """With the friction that the line is asked for: the controller must assume the same."""
        grip = self.raceline.friction
        return self.car if grip is None else self.car.model_copy(update={"friction": grip})

    @property
    def true_car(self) -> Car:
        """What the plant simulates and BestCase knows: the driven car with its true tyres."""
        car = self.driven_car
        if self.true_grip == 1:
            return car
        return car.model_copy(update={"tyres": car.true_tyres.with_grip(self.true_grip)})

    @model_validator(mode="after")
    def _simulated(self) -> Self:
        """One simulator; one that is not the built-in equations has its own tyres."""
        if self.fmu is not None and self.simulator != "equations":
            raise ValueError(f"{self.simulator} and {self.fmu}: only one can simulate the car")
        other = self.fmu or (None if self.simulator == "equations" else self.simulator)
        if other is not None and self.true_grip != 1:
            raise ValueError(
                f"true_grip {self.true_grip:g} is for the built-in car, and {other} simulates "
                "the car: leave one of them out"
            )
        return self

    @property
    def built_in(self) -> bool:
        """Whether the built-in equations simulate the car."""
        return self.fmu is None and self.simulator == "equations"


class RaceSettings(PreparationSettings):
    """Settings of ``bayesrace race``; defaults are the shown run."""

    track: str = Field(
        "", description="race track: name, random:SEED, random10:SEED or CSV file; empty: the car's"
    )
    line: Annotated[Path | None, Option("--raceline")] = Field(
        None, description="racing line to drive, as 'bayesrace raceline' writes it; None: computed"
    )
    laps: int = Field(2, ge=1, le=100, description="laps of a controller, the first from rest")
    every: float | None = Field(
        None,
        ge=2,
        le=3600,
        description="time after which BayesRace takes over an update, again and again within its "
        "laps [s]; in lockstep; None: only BayesRace-updated learns from them",
    )
    progress_drives: int | None = Field(
        None,
        ge=0,
        le=20,
        description="runs of bayesrace-limit, which maximises progress, each after the first with "
        "weights learned from all before; None: 3; 0 on linear tyres, which have no limit, and "
        "with slipx, where they can leave the track",
    )
    mode: TimeMode = Field(
        "lockstep", description="time mode: lockstep (as fast as possible) or realtime (the clock)"
    )
    time_limit: float = Field(
        3.0, gt=1, description="a run ends at this multiple of the racing line's time"
    )
    mpc: MpcSettings = MpcSettings()
    limit: bool = Field(
        True,
        description="compare the laps of the built-in car with the fastest it can drive; without "
        "effect on linear tyres, which have no limit",
    )

    @property
    def compares_limit(self) -> bool:
        """Whether there is a limit to compare laps with, and it is wanted."""
        return self.limit and self.built_in and self.car.has_limit

    @property
    def progress_runs(self) -> int:
        """Of bayesrace-limit, resolved."""
        return self.progress_drives or 0

    def limit_s(self, line_lap_s: float) -> float:
        """When a run ends at the latest, on a line whose flying lap takes ``line_lap_s``."""
        return self.time_limit * line_lap_s * self.laps + 2.0

    @model_validator(mode="after")
    def _resolve(self) -> Self:
        """One seed and one sampling time hold for all parts; the plant's time is not to choose."""
        if self.fmu is None and self.fmu_map is not None:
            raise ValueError(f"map {self.fmu_map} without an FMU to apply it to: add --fmu")
        from bayesrace.plant.simulator import PLANT  # with CasADi, which the help does not need

        steps = {self.discretisation.step_s, self.pursuit.step_s, PLANT.step_s}
        if len(steps) > 1:
            raise ValueError(f"all parts must share the plant's period of {PLANT.step_s} s")
        if self.every is not None and self.mode == "realtime":
            raise ValueError(
                f"every {self.every:g}: updates within the lap are for lockstep, where the car "
                "waits for them: leave out --mode realtime, or use 'bayesrace learn --every'"
            )
        seeded = self.pursuit.model_copy(update={"seed": self.seed})
        object.__setattr__(self, "pursuit", seeded)
        object.__setattr__(self, "track", self.track or self.car.race_track)
        if self.progress_drives is None:
            without = not self.car.has_limit or self.simulator != "equations"
            object.__setattr__(self, "progress_drives", 0 if without else 3)
        return self


class BayesianSettings(RaceLineSettings):
    """Everything that a line found by :func:`bayesrace.operation.line_search.searched_line` depends
    on, but for weights."""

    objective: Annotated[Literal["ideal", "driven"], Option(metavar="LAP")] = Field(
        "ideal", description="lap to minimise, ideal (by the line's own speeds) or driven"
    )
    nodes: int = Field(21, ge=6, le=60, description="nodes of the line, the search's dimension")
    evaluations: int = Field(
        110, ge=1, le=2000, description="lines that are tried, of which the first 10 are random"
    )
    seed: int = Field(0, ge=0, le=2**32 - 1, description="seed of the search")
