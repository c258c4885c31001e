"""From what was observed to the numbers of the report."""

import socket
from collections.abc import Callable
from datetime import datetime

from experiments.latency.bare_loop import BareRun
from experiments.latency.clocks import ClockPair, OffsetEstimator
from experiments.latency.histograms import LegHistogram, distribution
from experiments.latency.legs import ANSWER, LEGS, Leg
from experiments.latency.measure import Measurement
from experiments.latency.results import (
    ClockResult,
    Clocks,
    LatencyResult,
    LegResult,
    Percentiles,
)
from experiments.latency.settings import LatencySettings
from experiments.latency.traffic import Counted, counted, traffic

__all__ = ["outcome"]


def outcome(
    settings: LatencySettings, measured: Measurement, bare: BareRun | None, started: datetime
) -> LatencyResult:
    """The result of one measurement; ``bare`` None: the bare loop did not run to its end."""
    observer, tally = measured.observer, measured.observer.cycles.tally
    apart_s = measured.begin.apart_s + measured.end.apart_s
    by = {
        "plant": counted(measured.begin.plant, measured.end.plant),
        "controller": counted(measured.begin.controller, measured.end.controller),
    }
    messages = traffic(by, measured.rate_hz, apart_s)
    legs = _legs(observer.histograms, measured.clocks.pair)
    answer = legs.get(ANSWER)
    controller = by["controller"]
    memory = measured.memory.result()
    period_us = None if tally.mean_period_ns is None else tally.mean_period_ns * 1e-3
    bare_result = None if bare is None else bare.result()
    return LatencyResult(
        car=settings.car_name,
        track=settings.track,
        rate_hz=measured.rate_hz,
        duration_s=measured.elapsed_s,
        load=settings.load,
        attached=bool(settings.attach),
        started=started.isoformat(timespec="seconds"),
        host=socket.gethostname(),
        state_to_actuation_us=None if answer is None else _percentiles(answer),
        legs_us=legs,
        ticks=controller["ticks"] + controller["skipped"],
        skipped=controller["skipped"],
        deadline_misses=controller["deadline_misses"],
        overruns=controller["overruns"],
        fallbacks=sum(controller[name] for name in ("shifted_plan", "brake", "stop")),
        bare_loop_misses=None if bare is None else bare.misses,
        bare_loop_us=bare_result,
        mean_period_us=period_us,
        rate_error=None if period_us is None else period_us * measured.rate_hz * 1e-6 - 1.0,
        sent=sum(one.sent for one in messages.values()),
        received=sum(one.received for one in messages.values()),
        lost=sum(one.lost for one in messages.values()),
        traffic=messages,
        rss_growth_bytes=max((one.growth_bytes for one in memory.values()), default=None),
        rss=memory,
        repeated_answers=tally.repeated,
        overtaken_answers=tally.overtaken,
        unobserved=tally.unobserved,
        restarts=tally.restarts,
        laps=observer.course.laps,
        states=observer.course.states,
        off_track_samples=observer.course.off_track_samples,
        clocks=_clocks(measured.clocks.pair),
        notes=[*measured.notes, *_remarks(measured, by, bare)],
    )


def _remarks(measured: Measurement, by: dict[str, Counted], bare: BareRun | None) -> list[str]:
    """What a reader must know beside the numbers."""
    observer = measured.observer
    said: list[tuple[bool, Callable[[], str]]] = [
        (bool(measured.ended_early), lambda: f"ended early: {measured.ended_early}"),
        (bare is None, lambda: "the bare loop was lost: nothing to compare the misses with"),
        (
            bool(observer.cycles.tally.unobserved),
            lambda: (
                f"{observer.cycles.tally.unobserved} messages did not get as far as here; "
                "the run knows nothing of it"
            ),
        ),
        (
            bool(observer.refused_messages),
            lambda: f"{observer.refused_messages} messages could not be decoded here",
        ),
        (bool(observer.lockstep), lambda: f"{observer.lockstep} states of lockstep left out"),
    ]
    remarks = [text() for true, text in said if true]
    remarks += [
        f"the {source} was restarted: its counters are those since then"
        for source, counts in by.items()
        if counts.restarted
    ]
    return remarks + [f"bare loop: {text}" for text in (bare.refused if bare else [])]


def _percentiles(leg: LegResult) -> Percentiles:
    return Percentiles.model_validate(leg.model_dump(include=set(Percentiles.model_fields)))


def _legs(histograms: dict[str, LegHistogram], clocks: ClockPair) -> dict[str, LegResult]:
    legs = {}
    for leg in LEGS:
        histogram = histograms[leg.name]
        found = distribution(histogram.total)
        if found is not None:
            legs[leg.name] = LegResult(
                **found.model_dump(),
                clock=leg.clock,
                uncertainty_us=_uncertainty_us(leg, clocks),
                min=(histogram.lowest_ns or 0) * 1e-3,
                below_zero=histogram.below_zero,
            )
    return legs


def _uncertainty_us(leg: Leg, clocks: ClockPair) -> float:
    return clocks.uncertainty_ns * 1e-3 if leg.clock == "both" else 0.0


def _clocks(pair: ClockPair) -> Clocks:
    if pair.shared:
        text = f"plant and controller read one clock, that of {pair.hosts['plant']}"
    else:
        apart_ns = pair.controller.last.offset - pair.plant.last.offset
        text = (
            f"the controller's is {abs(apart_ns) * 1e-9:.6f} s "
            f"{'behind' if apart_ns < 0 else 'ahead of'} the plant's; legs from one to the other "
            f"are corrected, ± {pair.uncertainty_ns * 1e-3:.0f} us"
        )
    return Clocks(
        shared=pair.shared,
        text=text,
        uncertainty_us=pair.uncertainty_ns * 1e-3,
        plant=_clock(pair.hosts["plant"], pair.plant),
        controller=_clock(pair.hosts["controller"], pair.controller),
    )


def _clock(host: str, estimator: OffsetEstimator) -> ClockResult:
    drift = estimator.drift_ppm
    return ClockResult(
        host=host,
        offset_us=estimator.last.offset * 1e-3,
        uncertainty_us=estimator.last.uncertainty * 1e-3,
        drift_ppm=0.0 if drift is None else drift[0],
        drift_uncertainty_ppm=None if drift is None else drift[1],
        exchanges=estimator.exchanges,
        failed=estimator.failed,
    )
