"""From the log of a run, and what is known beside it, to the numbers of the report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bayesrace.tracks import Track
from experiments.latency.clocks import ClockMap
from experiments.latency.columns import MOST_CYCLES, Columns, Tables, fallen, read_tables, split
from experiments.latency.legs import ANSWER, LEGS, Cycles, Values
from experiments.latency.results import BareLoop, Clocks, LatencyResult, LegResult, Memory
from experiments.latency.series import Series
from experiments.latency.settings import LatencySettings
from experiments.latency.traffic import heartbeats, traffic

__all__ = ["Analysis", "Beside", "analyse"]

_BATCH: Final = 4096
_INTERVALS: Final = 60
_SHORTEST_S: Final = 2.0
"""Intervals of the histogram logs and of the medians."""


@dataclass(frozen=True)
class Beside:
    """What is known of a measurement besides its log; of a recorded run: nothing."""

    host: str = ""
    bare: tuple[Series, BareLoop] | None = None
    rss: Mapping[str, Memory] = field(default_factory=dict)
    notes: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class Analysis:
    """The result, and the values that it summarises."""

    result: LatencyResult
    series: dict[str, Series]
    """By leg, and of the bare loop; one without values is left out."""
    edges_s: NDArray[np.float64]
    """Of the intervals of logs and medians, since the first state that counts."""
    begin_s: float
    """Calendar time of that state."""


def analyse(log: Path, settings: LatencySettings, track: Track | None, beside: Beside) -> Analysis:
    """The analysis of a recorded run; InputError if the log holds no state that counts."""
    limits = settings.warm_up_s, settings.duration_s
    tables, car, refused = read_tables(log, settings.car_name, *limits)
    parts = list(split(tables))
    # Runs in real time, or those in lockstep if there are no others.
    chosen = [part for part in parts if not part["states"]["lockstep"][0]] or parts
    cycles = [Cycles(part) for part in chosen]
    clocks = [ClockMap.of(*one.exchanges()) for one in cycles]
    values = [leg for one, clock in zip(cycles, clocks, strict=True) for leg in one.legs(clock)]
    begin_ns = int(cycles[0].states["at"][0])
    series = {leg: found for leg in LEGS if (found := _series(leg, values, begin_ns))}
    known = [(part, clock) for part, clock in zip(chosen, clocks, strict=True) if clock]
    messages = traffic(known)
    clock = _clocks([clock for _, clock in known])
    legs = {leg: _leg(leg, one, clock) for leg, one in series.items()}
    timing = _timing(chosen, cycles, settings)
    restarts = int(np.count_nonzero(np.diff(tables["states"]["epoch"])))
    restarts += int(np.count_nonzero(fallen(tables["actuations"])))
    unobserved = sum(one.unobserved for one in cycles)
    remarks = {
        f"{unobserved} messages are missing in the log; the run may have had them": unobserved,
        f"{refused} messages of the log could not be decoded": refused,
        f"plant or controller was restarted {restarts} times": restarts,
        f"{len(parts) - len(chosen)} runs in lockstep are left out": len(parts) > len(chosen),
        "lockstep: the plant waits, so there are neither deadlines nor wake-ups": (
            chosen[0]["states"]["lockstep"][0]
        ),
        f"only the first {MOST_CYCLES:,} cycles": len(tables["states"]) >= MOST_CYCLES,
        "no bare loop to compare the misses with": beside.host and not beside.bare,
    }
    bare = beside.bare[1] if beside.bare else None
    result = LatencyResult(
        car=car,
        track=settings.track,
        load=settings.load,
        attached=bool(settings.attach),
        recorded=settings.log is not None,
        started=datetime.fromtimestamp(begin_ns // 10**9, UTC).astimezone().isoformat(),
        host=beside.host,
        legs_us=legs,
        state_to_actuation_us=legs.get(ANSWER),
        **timing,
        bare_loop_us=bare,
        bare_loop_misses=bare.misses if bare else None,
        sent=sum(one.sent for one in messages.values()) if messages else None,
        received=sum(one.received for one in messages.values()) if messages else None,
        lost=sum(one.lost for one in messages.values()) if messages else None,
        traffic=messages,
        rss=dict(beside.rss),
        rss_growth_bytes=max((one.growth_bytes for one in beside.rss.values()), default=None),
        repeated_answers=sum(one.repeated for one in cycles),
        overtaken_answers=sum(int((one.answers["acting_s"] < 0).sum()) for one in cycles),
        unobserved=unobserved,
        restarts=restarts,
        **_drive(tables["truth"], track),
        clocks=clock,
        notes=[*beside.notes, *(text for text, true in remarks.items() if true)],
    )
    count = int(np.clip(result.duration_s // _SHORTEST_S, 1, _INTERVALS))
    edges_s = np.linspace(0.0, max(result.duration_s, 1e-3), count + 1)
    if beside.bare:
        series["bare_loop"] = beside.bare[0]
    return Analysis(result, series, edges_s, begin_ns * 1e-9)


def _series(leg: str, values: Sequence[Values], begin_ns: int) -> Series | None:
    """The values of one leg, all parts together, by rising time; None without any."""
    several = [one for one in values if one.leg == leg and len(one.ns)]
    if not several:
        return None
    at, ns = (np.concatenate([one[k] for one in several]) for k in (1, 2))
    order = np.argsort(at, kind="stable")
    return Series((at[order] - begin_ns) * 1e-9, ns[order])


def _leg(leg: str, series: Series, clocks: Clocks | None) -> LegResult:
    clock = LEGS[leg][1]
    return LegResult(
        **series.distribution().model_dump(),
        clock=clock,
        uncertainty_us=clocks.uncertainty_us if clocks and clock == "both" else 0.0,
        min=float(series.ns.min()) * 1e-3,
        below_zero=int((series.ns < 0).sum()),
    )


def _timing(
    parts: Sequence[Tables], cycles: Sequence[Cycles], settings: LatencySettings
) -> dict[str, Any]:
    """Deadlines and periods by the telemetry, rate and overruns by the heartbeats."""
    ticks = np.concatenate([one.ticks for one in cycles])
    beats = [heartbeats(part, controller=True) for part in parts]
    over = [int(np.ptp(one["overruns"])) for one in beats if len(one)]
    rates = np.concatenate([one["rate_hz"] for one in beats])
    skipped = sum(one.skipped for one in cycles)
    periods, length_ns = np.sum([one.periods for one in cycles], axis=0).tolist()
    period_us = length_ns * 1e-3 / periods if periods else None
    rate_hz = float(rates.max(initial=0.0)) or (1e6 / period_us if period_us else settings.rate_hz)
    at = np.concatenate([one.states["at"] for one in cycles])
    return {
        "rate_hz": rate_hz,
        "duration_s": float(np.ptp(at)) * 1e-9,
        "ticks": len(ticks) + skipped,
        "skipped": skipped,
        "deadline_misses": int(ticks["missed"].sum()),
        "overruns": sum(over) if over else None,
        "fallbacks": int((ticks["fallback"] > 0).sum()),
        "mean_period_us": period_us,
        "rate_error": None if period_us is None else period_us * rate_hz * 1e-6 - 1.0,
    }


def _drive(truth: Columns, track: Track | None) -> dict[str, Any]:
    """Laps, and samples off the track, all runs together."""
    one_run = (np.diff(truth["epoch"]) == 0) & (np.diff(truth["run"]) == 0)
    places = np.column_stack([truth["x_m"], truth["y_m"]])
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
    offset_ns = 0 if shared else int(clocks[-1].offset[-1])
    text = (
        f"the controller's is {abs(offset_ns) * 1e-9:.6f} s "
        f"{'behind' if offset_ns < 0 else 'ahead of'} the plant's; legs from one to the other are "
        f"corrected, ± {uncertainty_us:.0f} us"
    )
    return Clocks(
        shared=shared,
        text="plant and controller read one clock" if shared else text,
        offset_us=offset_ns * 1e-3,
        uncertainty_us=uncertainty_us,
        exchanges=sum(one.exchanges for one in clocks),
    )
