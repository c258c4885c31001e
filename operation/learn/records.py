"""Settings and records of a learning job; ``laps.json`` holds its :class:`Record`."""

from collections.abc import Mapping
from typing import Literal

from pydantic import BaseModel, Field

from bayesrace.defaults import MAX_POINTS
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.strict import StrictModel
from bayesrace.vehicles import CarSetting, default_car

__all__ = ["LapRecord", "LearnSettings", "Record", "UpdateRecord", "Verdict"]

Verdict = Literal[
    "pending", "accepted", "refused", "rolled back", "not sent", "superseded", "failed"
]
"""Of weights: ``pending``: no controller has answered yet; ``superseded``: newer weights came
before; ``not sent``: the same were refused or rolled back before; ``failed``: the training."""


class LearnSettings(StrictModel):
    """Settings of ``bayesrace learn``."""

    car: CarSetting = Field(default_factory=default_car)
    name: str = Field(
        default_factory=lambda known: known["car"].name if "car" in known else "",
        description="name of the car in the network; empty: the car's own",
    )
    discretisation: Discretisation = PREDICTION
    points: int = Field(400, ge=20, le=MAX_POINTS, description="training points per output")
    keep: int = Field(1200, ge=100, le=20_000, description="samples kept from lap to lap")
    laps: int | None = Field(None, ge=1, description="end after so many laps")
    every: float | None = Field(
        None,
        ge=2,
        le=200,
        description="learn after so many seconds of driving, and after each lap; a shorter stretch "
        "has too few samples to show that the car has changed",
    )
    track: str | None = Field(
        None, description="track that is driven, for exact lap times and excursions"
    )
    seed: int = Field(0, ge=0, le=2**32 - 1, description="seed of the optimiser's starts")


class LapRecord(BaseModel):
    """One lap that was driven."""

    lap: int = Field(0, description="number in this folder, from 1")
    run: int = Field(description="number of the run in all messages")
    time_s: float | None = Field(description="lap time; null if an end of it was not seen")
    flying: bool = Field(description="begun at speed, where the lap before ended")
    versions: list[str] = Field([], description="of the weights that drove it, in order")
    samples: int = Field(0, description="fit to learn from")
    left_out: Mapping[str, int] = Field({}, description="samples left out, by reason")
    fallbacks: int = Field(0, description="cycles that the fallback drove")
    off_track_m: float | None = Field(None, description="deepest excursion; null without a track")


class UpdateRecord(BaseModel):
    """One training, and what became of its weights."""

    after_lap: int = Field(description="last lap that had ended; 0: none")
    version: str = Field("", description="of its weights; empty if there are none")
    file: str = Field("", description="of the weights; old ones are deleted")
    samples: int = Field(0, description="learned from")
    moved: int = Field(0, description="of these, from before the car has changed")
    kept: int = Field(0, description="samples kept for the next training")
    points: int = Field(0, description="training points per output, the most")
    training_s: float = 0.0
    metrics: Mapping[str, Mapping[str, float]] = Field({}, description="held out, per output")
    verdict: Verdict = "pending"
    answer: str = Field("", description="of the controller, in words")
    cycle: int | None = Field(None, description="of the controller, at which it took over")
    acceptance: int | None = Field(None, description="number of the takeover")


class Record(BaseModel):
    """Everything that a job reports."""

    schema_version: Literal[2] = 2
    settings: LearnSettings | None = Field(None, description="of the last job")
    laps: list[LapRecord] = []
    updates: list[UpdateRecord] = []
    remarks: list[str] = Field([], description="why a drive gave nothing to learn from, each once")
