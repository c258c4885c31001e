"""The outcome of a race: the content of ``result.json``, and nothing that is not in it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import Field, ValidationError

from bayesrace.arrays import Floats
from bayesrace.defaults import LEAST_LOSS_S
from bayesrace.errors import InputError, faults_in
from bayesrace.files import read_whole, write_whole
from bayesrace.strict import StrictModel

__all__ = [
    "GpMetrics",
    "LapResult",
    "Percentiles",
    "RaceResult",
    "ResultModel",
    "SettingsSummary",
    "gp_metrics",
    "read_result",
    "write_result",
]


class ResultModel(StrictModel):
    """What is written as JSON. Numbers that are not finite have no place there: what is not known
    is null."""


class Percentiles(ResultModel):
    """Of numbers, such as the execution times of the controller's steps."""

    p50: float
    p99: float
    max: float

    @classmethod
    def of(cls, values: Floats) -> Self:
        """Those of at least one number."""
        p50, p99, most = np.percentile(values, [50, 99, 100]).tolist()
        return cls(p50=p50, p99=p99, max=most)


class LapResult(ResultModel):
    """One driven controller. Samples count up to the last counted crossing of the start line."""

    controller: str = Field(description="worstcase, bayesrace, bayesrace-updated, bestcase, …")
    number: int | None = Field(
        None, description="of the run among those of its controller, from 1; null for the only one"
    )
    run: int = Field(description="number of the run in all messages of the log")
    finished: bool = Field(description="at least one lap was driven, all of it")
    lap_time_s: float | None = Field(description="first lap, from standstill")
    flying_lap_time_s: float | None = Field(description="best of the laps after the first")
    lap_times_s: list[float] = Field(description="all laps in order")
    limit_ratios: list[float] | None = Field(
        None,
        description="each lap over the fastest that the car can drive: the first over that from "
        "standstill, the others over a flying one; null if these are not known",
    )
    off_track_samples: int = Field(description="samples with the centre of gravity off the track")
    off_track_max_m: float = Field(description="deepest excursion, 0 without any")
    off_track_ms: int | None = Field(
        None,
        description="the same each millisecond; null where the built-in equations are not the car",
    )
    off_track_ms_max_m: float | None = Field(None, description="deepest of these, 0 without any")
    deviation_mean_m: float | None = Field(description="mean distance from the racing line")
    deviation_max_m: float | None = Field(description="largest distance from the racing line")
    lateral_max_mps2: float | None = Field(
        None,
        description="largest acceleration across the way; beyond friction times 9.81: tyres "
        "that do not saturate",
    )
    slip_max_rad: float | None = Field(
        None, description="largest angle between the car's axis and its velocity"
    )
    speed_max_mps: float | None = Field(None, description="largest speed along the car's axis")
    solve_us: Percentiles | None = Field(
        description="execution times of the controller's step [us]; null without telemetry"
    )
    cycles: dict[str, int] = Field(
        description="number of the controller's cycles at each level: solution, and of the "
        "fallback shifted_plan, brake, stop"
    )
    sensor_faults: dict[str, int] = Field(
        {}, description="number of measured states that the controller did not believe, by kind"
    )
    passed: bool = Field(
        description="all laps were driven on the track, and by solutions for most of the time"
    )
    verdict: str = Field(description="whether the run passed, with the facts, in one sentence")
    weights_version: str = Field(description="of the weights that drove; empty without any")
    trajectory_sha256: str = Field(
        description="over all states as little-endian float64, up to and with the first sample "
        "after the last counted crossing; all states if not finished"
    )
    samples: int = Field(description="states of the run in the log")
    ended: str = Field(description="why the run ended")
    refused: str = Field(
        "",
        description="why the controller refused its weights, so that it was not driven; or empty",
    )
    remarks: list[str] = Field(
        [], description="of the controller in mid-run: weights rolled back, speed limited"
    )
    unknown_s: float | None = Field(
        None,
        description="what a lap loses where the racing line is faster than what the run's first "
        "weights have learned; null where the controller has not said so",
    )

    @property
    def lost_s(self) -> float | None:
        """:attr:`unknown_s`, if it is large enough to report."""
        return self.unknown_s if (self.unknown_s or 0) >= LEAST_LOSS_S else None

    @property
    def fallbacks(self) -> int:
        """Cycles that the fallback drove."""
        return sum(self.cycles.values()) - self.cycles.get("solution", 0)

    @property
    def name(self) -> str:
        """Of the controller, with the run's number if there are several."""
        return self.controller if self.number is None else f"{self.controller} {self.number}"


class GpMetrics(ResultModel):
    """How well one output's GP predicts the residual of a drive, SI units."""

    rmse: float
    uncorrected_rmse: float = Field(description="without the GP")
    r2: float
    coverage: float = Field(description="share of the residuals in the 95 % interval")
    log_density: float = Field(description="mean log predictive density")


def gp_metrics(metrics: Mapping[str, Mapping[str, float]]) -> dict[str, GpMetrics]:
    """Of each output, from those of a :class:`bayesrace.learning.validation.Validation`."""
    return {output: GpMetrics.model_validate(dict(one)) for output, one in metrics.items()}


class SettingsSummary(ResultModel):
    """What was raced; ``settings.json`` has all of it."""

    car: str
    track: str
    train_track: str
    mode: str
    seed: int
    laps: int
    constraints: bool
    tyres: str = Field("", description="model of the car's tyres: pacejka or linear")
    friction: float | None = Field(None, description="acceleration over g that the line assumes")
    fmu: str = Field("", description="what simulated the car; empty: the built-in equations")


class RaceResult(ResultModel):
    """``result.json``: made from a run directory by :mod:`bayesrace.operation.analysis.race`."""

    settings: SettingsSummary
    laps: list[LapResult]
    training: LapResult | None = Field(
        None,
        description="the last training drive on its own track, all of its samples; null without",
    )
    practices: dict[str, LapResult] = Field(
        default_factory=dict,
        description="the controller's own laps before it raced, all of their samples, by track: "
        "the training track, and larger copies of it; empty without",
    )
    line_driven: float | None = Field(
        None,
        description="share of the racing line's time at speeds and lateral accelerations that "
        "were driven before, in training drives and practice; null without these",
    )
    gp: dict[str, GpMetrics] = Field(
        description="output (vx, vy, omega) to metrics of the first weights on the BestCase run; "
        "empty without these weights or without that run"
    )
    gp_updated: dict[str, GpMetrics] = Field(description="the same for the updated weights")
    limit_s: dict[str, float] = Field(
        default_factory=dict,
        description="the fastest laps that the car can drive, standing and flying, by "
        "'bayesrace limit'; empty if not known",
    )
    real_time_factor: float | None = Field(
        description="simulated seconds per second of the lockstep runs; null without any"
    )
    complete: bool = Field(description="the logs are whole: no message missing, refused or cut off")
    gaps: int = Field(description="messages missing by their numbers")
    judged_by: Literal["truth", "measurement"] = Field(
        "measurement",
        description="what laps and GP metrics are made of: measurement if the log holds no truth",
    )

    def lap(self, controller: str) -> LapResult | None:
        """The last run of that controller, None if it did not drive."""
        return next((lap for lap in reversed(self.laps) if lap.controller == controller), None)


def write_result(path: Path, result: RaceResult) -> None:
    """Writes ``result.json``: the whole file or nothing."""
    write_whole(path, result.model_dump_json(indent=2) + "\n")


def read_result(path: Path) -> RaceResult:
    """The result in a file; InputError if it is not one."""
    try:
        return RaceResult.model_validate_json(read_whole(path, "the result", 1 << 26))
    except ValidationError as error:
        raise InputError(f"{path} is no result of a race: {faults_in(error)}") from None
