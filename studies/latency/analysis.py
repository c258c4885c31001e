"""What is measured of a leg over time, and the content of ``latency.json``: computed from the log
of a run, and from what is known beside it."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import Field

from bayesrace.arrays import Floats
from bayesrace.columns import Columns
from bayesrace.operation.analysis.results import ResultModel
from bayesrace.studies.latency.legs import (
    ANSWER,
    LEGS,
    MOST_CYCLES,
    ClockMap,
    Cycles,
    begins_anew,
    read_tables,
    split,
)
from bayesrace.studies.latency.settings import LatencySettings
from bayesrace.tracks import Track

__all__ = ["Analysis", "BareLoop", "Beside", "Clocks", "Distribution", "LatencyResult", "LegResult"]
__all__ += ["Memory", "Series", "Traffic", "analyse"]

_PERCENTILES: Final = (50.0, 90.0, 99.0, 99.9, 100.0)
_IN_FLIGHT: Final = 2
"""Messages in flight at most: sent, but neither received nor lost, at an end of a part."""

_COUNTS: Final = (
    "skipped", "deadline_misses", "fallbacks", "repeated_answers", "late_states",
    "overtaken_answers", "unobserved", "restarts",
)  # fmt: skip
"""That the result has as they are."""

_BATCH: Final = 4096
_INTERVALS: Final = 60
"""Of the medians, at most; each takes two seconds at least."""


class Distribution(ResultModel):
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


class Traffic(ResultModel):
    """Messages of one direction, by the sender's numbers and the receiver's counters."""

    sent: int
    received: int
    lost: int
    in_flight: int = Field(description="sent - received - lost")
    complete: bool = Field(description="in_flight is at most what can be on its way")


class Clocks(ResultModel):
    """How times of plant and controller were brought together."""

    shared: bool = Field(description="one clock: legs that cross from one to the other are exact")
    text: str
    offset_us: float = Field(description="controller minus plant at the end; 0 if shared")
    uncertainty_us: float = Field(description="of a leg that crosses, largest over the run")
    exchanges: int = Field(description="states and answers that bound the offset")


class Memory(ResultModel):
    """Resident memory of one process."""

    begin_bytes: int = Field(description="after the first minute, or third of a shorter run")
    most_bytes: int = Field(description="largest from then on")

    @property
    def growth_bytes(self) -> int:
        """Largest value less the one at the beginning."""
        return self.most_bytes - self.begin_bytes


class LatencyResult(ResultModel):
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


# The analysis ------------------------------------------------------------------------------------


@dataclass
class Beside:
    """What is known of a measurement besides its log; of a recorded run: nothing."""

    host: str = ""
    bare: tuple[Series, BareLoop] | None = None
    round_trip: Series | None = None
    """Of messages alone."""
    rss: dict[str, Memory] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Analysis:
    """The result, and the values that it summarises."""

    result: LatencyResult
    series: dict[str, Series]
    """By leg, and of what ran beside; one without values is left out."""
    edges_s: Floats
    """Of the intervals of medians, since the first state that counts."""


def analyse(log: Path, settings: LatencySettings, track: Track | None, beside: Beside) -> Analysis:
    """The analysis of a recorded run; InputError if the log holds no state that counts."""
    limits = settings.warm_up_s, settings.duration_s
    tables, car, refused = read_tables(log, settings.car_name, *limits)
    parts = list(split(tables))
    # Runs in real time, or those in lockstep if there are no others.
    chosen = [part for part in parts if not part["states"]["lockstep"][0]] or parts
    cycles = [Cycles(part) for part in chosen]
    counts = sum((one.counts() for one in cycles), Counter())
    begun = np.diff(tables["states"]["epoch"]) != 0, begins_anew(tables["actuations"])
    counts["restarts"] = int(sum(map(np.count_nonzero, begun)))
    remarks = {
        "messages are missing in the log; the run may have had them": counts["unobserved"],
        "messages of the log could not be decoded": refused,
        "restarts of plant or controller": counts["restarts"],
        "runs in lockstep are left out": len(parts) - len(chosen),
        "runs are in lockstep, without deadlines and wake-ups": (
            len(chosen) if chosen[0]["states"]["lockstep"][0] else 0
        ),
        "cycles are the most for one analysis; the log is longer": (
            MOST_CYCLES if len(tables["states"]) >= MOST_CYCLES else 0
        ),
    }
    begin_ns = int(cycles[0].states["wall_ns"][0])
    span_s = float(np.ptp(np.concatenate([one.states["wall_ns"] for one in cycles]))) * 1e-9
    clocks = _clocks([one.clock for one in cycles if one.clock is not None])
    series = _series([one.legs() for one in cycles], begin_ns)
    legs = {leg: _leg(leg, one, clocks) for leg, one in series.items()}
    result = LatencyResult(
        car=car, track=settings.track, duration_s=span_s, load=settings.load,
        attached=settings.attach is not None, recorded=settings.log is not None,
        started=datetime.fromtimestamp(begin_ns // 1e9, UTC).astimezone().isoformat(),
        state_to_actuation_us=legs.get(ANSWER), legs_us=legs, clocks=clocks,
        notes=[*beside.notes, *(f"{many} {text}" for text, many in remarks.items() if many)],
        **_beside(beside), **_timing(counts, tables["heartbeats"]),
        **_messages(counts, len(cycles)), **_drive(tables["truth"], track),
    )  # fmt: skip
    edges_s = np.linspace(0.0, max(span_s, 1e-3), int(np.clip(span_s // 2.0, 1, _INTERVALS)) + 1)
    if beside.bare:
        series["bare_loop"] = beside.bare[0]
    if beside.round_trip is not None:
        series["round_trip"] = beside.round_trip
    return Analysis(result, series, edges_s)


def _series(
    parts: Sequence[Mapping[str, tuple[Floats, Floats]]], begin_ns: float
) -> dict[str, Series]:
    """The values of each leg, all parts together, by rising time."""
    found = {}
    for leg in LEGS:
        columns = [np.array(legs[leg]) for legs in parts if leg in legs]
        at, ns = np.concatenate(columns, axis=1) if columns else ((), ())
        if len(at):
            order = np.argsort(at, kind="stable")
            found[leg] = Series((at[order] - begin_ns) * 1e-9, ns[order])
    return found


def _leg(leg: str, series: Series, clocks: Clocks | None) -> LegResult:
    clock = LEGS[leg][1]
    return LegResult(
        **series.distribution().model_dump(),
        clock=clock,
        uncertainty_us=clocks.uncertainty_us if clocks and clock == "both" else 0.0,
        min=float(series.ns.min()) * 1e-3,
        below_zero=int((series.ns < 0).sum()),
    )


def _beside(beside: Beside) -> dict[str, Any]:
    """What was measured beside the run."""
    bare = beside.bare[1] if beside.bare else None
    return {
        "host": beside.host,
        "bare_loop_misses": bare.misses if bare else None,
        "bare_loop_us": bare,
        "round_trip_us": beside.round_trip and beside.round_trip.distribution(),
        "rss": beside.rss,
        "rss_growth_bytes": max((one.growth_bytes for one in beside.rss.values()), default=None),
    }


def _timing(counts: Counter[str], heartbeats: Columns) -> dict[str, Any]:
    """Counts of cycles, all runs together, and their mean period."""
    period_us = counts["length_ns"] * 1e-3 / counts["periods"] if counts["periods"] else None
    rate_hz = float(heartbeats["rate_hz"].max(initial=0.0))
    rate_hz = rate_hz or (1e6 / period_us if period_us else 0.0)
    return {
        **{name: counts[name] for name in _COUNTS},
        "ticks": counts["releases"] + counts["skipped"],
        "overruns": counts["overruns"] if len(heartbeats) else None,
        "rate_hz": rate_hz,
        "mean_period_us": period_us,
        "rate_error": period_us * rate_hz * 1e-6 - 1.0 if period_us else None,
    }


def _messages(counts: Counter[str], parts: int) -> dict[str, Any]:
    """Of states and of actuations, if they are counted, and of both."""
    traffic = {}
    for stream in ("states", "actuations"):
        if f"{stream}_sent" in counts:
            numbers = {name: counts[f"{stream}_{name}"] for name in ("sent", "received", "lost")}
            left = numbers["sent"] - numbers["received"] - numbers["lost"]
            complete = abs(left) <= parts * _IN_FLIGHT
            traffic[stream] = Traffic(**numbers, in_flight=left, complete=complete)
    both = {
        name: sum(getattr(one, name) for one in traffic.values()) if traffic else None
        for name in ("sent", "received", "lost")
    }
    return {"traffic": traffic, **both}


def _drive(truth: Columns, track: Track | None) -> dict[str, Any]:
    """Laps, and samples off the track, all runs together."""
    one_run = (np.diff(truth["epoch"]) == 0) & (np.diff(truth["run"]) == 0)
    places = truth["x"][:, :2]
    batches = [places[k : k + _BATCH] for k in range(0, len(places), _BATCH)]
    return {
        "laps": int(np.diff(truth["lap"])[one_run].sum()) if len(truth) else None,
        "states": len(truth),
        "off_track_samples": None if track is None else sum(
            int((track.project_path(one).off_track_m > 0).sum()) for one in batches
        ),
    }  # fmt: skip


def _clocks(clocks: Sequence[ClockMap]) -> Clocks | None:
    if not clocks:
        return None
    shared = all(one.shared for one in clocks)
    uncertainty_us = max(one.uncertainty for one in clocks) * 1e-3
    offset_s = 0.0 if shared else float(clocks[-1].offset[-1]) * 1e-9
    text = (
        f"the controller's is {abs(offset_s):.6f} s {'behind' if offset_s < 0 else 'ahead of'} the "
        f"plant's; legs from one to the other are corrected, ± {uncertainty_us:.0f} us"
    )
    return Clocks(
        shared=shared,
        text="plant and controller read one clock" if shared else text,
        offset_us=offset_s * 1e6,
        uncertainty_us=uncertainty_us,
        exchanges=sum(one.exchanges for one in clocks),
    )
