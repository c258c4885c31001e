"""What is measured of a leg over time, and the content of ``latency.json``."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from bayesrace.arrays import Floats

__all__ = ["BareLoop", "Clocks", "Distribution", "LatencyResult", "LegResult", "Memory", "Series"]
__all__ += ["Traffic"]

_PERCENTILES: Final = (50.0, 90.0, 99.0, 99.9, 100.0)


class _Frozen(BaseModel):
    # Numbers that are not finite have no place in JSON: what is not known is null.
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Distribution(_Frozen):
    """Percentiles [us], each the smallest value that this share of all do not exceed."""

    p50: float
    p90: float
    p99: float
    p999: float
    max: float
    count: int


@dataclass(frozen=True, eq=False)
class Series:
    """Durations and the times at which they were measured, at least one of them.

    A duration below zero counts as zero: it is shorter than its clocks are uncertain.
    """

    at_s: Floats
    """Since the beginning, rising."""
    ns: Floats

    def distribution(self) -> Distribution:
        """Percentiles."""
        values = np.percentile(self.ns, _PERCENTILES, method="inverted_cdf").clip(0) * 1e-3
        numbers = dict(zip(("p50", "p90", "p99", "p999", "max"), values.tolist(), strict=True))
        return Distribution(**numbers, count=len(self.ns))

    def intervals(self, edges_s: Floats) -> list[Floats]:
        """The values of each interval; the outer ones take the values beyond the edges."""
        return np.split(self.ns, np.searchsorted(self.at_s, edges_s[1:-1]))


class LegResult(Distribution):
    """One leg."""

    clock: str = Field(description="on which it is measured; both: it crosses")
    uncertainty_us: float = Field(description="of each value, largest; 0 where one clock measured")
    min: float = Field(description="smallest value; below 0 only within the uncertainty")
    below_zero: int = Field(description="values below 0, which count as 0 in the percentiles")


class BareLoop(Distribution):
    """Wake-up error of a loop that only sleeps, in a process of its own in the same run."""

    misses: int = Field(description="wake-ups after the next release: no work could be done")
    skipped: int = Field(description="releases passed over because of that")
    ticks: int
    mean_period_us: float | None
    refused: list[str] = Field(description="scheduling options that the system refused")


class Traffic(_Frozen):
    """Messages of one direction, by the sender's numbers and the receiver's counters."""

    sent: int
    received: int
    lost: int
    in_flight: int = Field(description="sent - received - lost")
    complete: bool = Field(description="in_flight is at most what can be on its way")


class Clocks(_Frozen):
    """How times of plant and controller were brought together."""

    shared: bool = Field(description="one clock: legs that cross from one to the other are exact")
    text: str
    offset_us: float = Field(description="controller minus plant at the end; 0 if shared")
    uncertainty_us: float = Field(description="of a leg that crosses, largest over the run")
    exchanges: int = Field(description="states and answers that bound the offset")


class Memory(_Frozen):
    """Resident memory of one process."""

    begin_bytes: int = Field(description="after the first minute, or third of a shorter run")
    most_bytes: int = Field(description="largest from then on")

    @property
    def growth_bytes(self) -> int:
        """Largest value less the one at the beginning."""
        return self.most_bytes - self.begin_bytes


class LatencyResult(_Frozen):
    """One measurement; null: not known from the log or the measurement."""

    car: str
    track: str = Field(description="empty if not known")
    rate_hz: float
    duration_s: float = Field(description="from the first state that counts to the last one")
    load: int = Field(description="busy processes beside")
    attached: bool
    recorded: bool = Field(description="made from a log of an earlier run")
    started: str = Field(description="calendar time")
    host: str = Field(description="of the measuring process and of the bare loop")
    state_to_actuation_us: Distribution | None
    legs_us: dict[str, LegResult]
    ticks: int = Field(description="releases, those passed over included")
    skipped: int = Field(description="releases passed over")
    deadline_misses: int = Field(description="actuations sent after the next release")
    overruns: int | None = Field(description="cycles that took more than their budget")
    fallbacks: int = Field(description="cycles that the fallback drove")
    bare_loop_misses: int | None
    bare_loop_us: BareLoop | None
    round_trip_us: Distribution | None = Field(
        description="of messages between two processes without any work, beside the run"
    )
    mean_period_us: float | None
    rate_error: float | None = Field(description="mean period over the nominal one, less 1")
    sent: int | None = Field(description="states and actuations")
    received: int | None
    lost: int | None
    traffic: dict[str, Traffic] = Field(description="of states and of actuations, each by itself")
    rss_growth_bytes: int | None = Field(description="the larger one of the two")
    rss: dict[str, Memory]
    repeated_answers: int = Field(description="further answers to a state, predicted forward")
    late_states: int = Field(description="states that came after their window, answered at once")
    overtaken_answers: int = Field(description="answers that never acted")
    unobserved: int = Field(description="messages missing in the log alone")
    restarts: int
    laps: int | None
    states: int = Field(description="true states in the log, those of the warm-up included")
    off_track_samples: int | None = Field(description="of these states")
    clocks: Clocks | None = Field(description="null: no state reports when an answer arrived")
    notes: list[str] = Field(description="what a reader must know, such as an early end")
