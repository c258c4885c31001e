"""The outcome of ``bayesrace latency``: what ``latency.json`` holds, and nothing beside it."""

from pydantic import BaseModel, ConfigDict, Field

__all__ = [
    "BareLoop",
    "ClockResult",
    "Clocks",
    "Distribution",
    "LatencyResult",
    "LegResult",
    "Memory",
    "Percentiles",
    "Traffic",
]


class _Frozen(BaseModel):
    # Numbers that are not finite have no place in JSON: what is not known is null.
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Percentiles(_Frozen):
    """Of one leg [us]."""

    p50: float
    p90: float
    p99: float
    p999: float
    max: float


class Distribution(Percentiles):
    """The same with the number of values."""

    count: int


class LegResult(Distribution):
    """One leg."""

    clock: str = Field(description="whose clock it is measured on; both: it crosses")
    uncertainty_us: float = Field(
        description="of each value, largest over the run; 0 where one clock measured it"
    )
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
    """Messages of one direction, counted by its sender and its receiver."""

    sent: int
    received: int
    lost: int
    in_flight: int = Field(
        description="sent - received - lost: 0, or what lay between two processes' counting"
    )
    complete: bool = Field(description="sent = received + lost, but for what was in flight")


class ClockResult(_Frozen):
    """A process's clock against that of the measuring one."""

    host: str
    offset_us: float
    uncertainty_us: float = Field(description="half the round trip of the exchange used, largest")
    drift_ppm: float
    drift_uncertainty_ppm: float | None = Field(description="null: one reading only")
    exchanges: int
    failed: int


class Clocks(_Frozen):
    """How times of plant and controller were brought together."""

    shared: bool = Field(description="one clock: legs that cross from one to the other are exact")
    text: str
    uncertainty_us: float = Field(description="of a leg that crosses, largest over the run")
    plant: ClockResult
    controller: ClockResult


class Memory(_Frozen):
    """Resident memory of one process."""

    begin_bytes: int = Field(description="after the first minute, or third of a shorter run")
    most_bytes: int = Field(description="largest from then on")

    @property
    def growth_bytes(self) -> int:
        """What came in between."""
        return self.most_bytes - self.begin_bytes


class LatencyResult(_Frozen):
    """One measurement. Counts are over the time observed, but for messages (see ``traffic``)."""

    car: str
    track: str = Field(description="empty if not known")
    rate_hz: float
    duration_s: float = Field(description="observed")
    load: int = Field(description="busy processes beside")
    attached: bool
    started: str = Field(description="calendar time")
    host: str = Field(description="of the measuring process, and of the bare loop")
    state_to_actuation_us: Percentiles | None
    legs_us: dict[str, LegResult]
    ticks: int = Field(description="releases, those passed over included")
    skipped: int = Field(description="releases passed over")
    deadline_misses: int = Field(description="actuations sent after the next release")
    overruns: int = Field(description="cycles that took more than their budget")
    fallbacks: int = Field(description="cycles that the fallback drove")
    bare_loop_misses: int | None = Field(description="null if there was no bare loop")
    bare_loop_us: BareLoop | None
    mean_period_us: float | None
    rate_error: float | None = Field(description="mean period over the nominal one, less 1")
    sent: int = Field(description="states and actuations, by their senders")
    received: int
    lost: int
    traffic: dict[str, Traffic] = Field(description="of states and of actuations, each by itself")
    rss_growth_bytes: int | None = Field(description="the larger one of the two; null: not known")
    rss: dict[str, Memory]
    repeated_answers: int = Field(description="further answers to a state, predicted forward")
    overtaken_answers: int = Field(description="answers that never acted")
    unobserved: int = Field(description="messages that only the measuring process did not get")
    restarts: int
    laps: int | None
    states: int = Field(description="since the run's start, where it was started here")
    off_track_samples: int | None = Field(description="of these states; null: track not known")
    clocks: Clocks
    notes: list[str] = Field(description="what a reader must know, such as an early end")
