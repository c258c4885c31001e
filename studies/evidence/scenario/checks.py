"""Judges the recording of a scenario: numbers of the drive, and whether what must hold does."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.columns import Columns, LogColumns
from bayesrace.messages import EVENT, HEARTBEAT, STATE, TELEMETRY, TRUTH, Topic
from bayesrace.operation.analysis.laps import LapTimes, time_laps, trajectory_digest
from bayesrace.studies.evidence.scenario.description import Scenario
from bayesrace.studies.evidence.scenario.events import SensorEvent
from bayesrace.studies.evidence.verdict import Check
from bayesrace.tracks import Track

__all__ = ["Drive", "judged"]

_STANDING_MPS: Final = 0.05
_DRIVING_MPS: Final = 0.5
_STEADY_S: Final = 0.5
"""For so long the car has to stand, or to drive."""
_ROUNDING_S: Final = 1e-9
_HELD_S: Final = 0.1
"""An input drives until the next one, and no longer than this."""

_WANTED: Final[dict[Topic[Any], str]] = {
    STATE: "seq run actuation_delays",
    TRUTH: "seq run x time_s lap",
    TELEMETRY: "run state_seq fallback sensor_fault",
    EVENT: "source kind text data",
    HEARTBEAT: "source node counters",
}
_TRAFFIC: Final = (
    ("plant", "states_sent", "controller", "states"),
    ("controller", "actuations_sent", "plant", "actuations"),
)


@dataclass(frozen=True, eq=False)
class Drive:
    """What was recorded of one drive."""

    track: Track
    truth: Columns
    states: Columns
    cycles: Columns
    events: Columns
    heartbeats: Columns

    @classmethod
    def read(cls, log: Path, track: Track) -> "Drive":
        """InputError if there is no log, or no state in it."""
        columns = LogColumns(log, _WANTED).read()
        return cls(track, *(columns[one] for one in (TRUTH, STATE, TELEMETRY, EVENT, HEARTBEAT)))

    @cached_property
    def off_track_m(self) -> Floats:
        """Of each true state; negative on the track."""
        return self.track.project_path(self.truth["x"][:, :2]).off_track_m

    @cached_property
    def laps(self) -> LapTimes:
        """Of the whole drive."""
        xy = self.truth["x"][:, :2]
        return time_laps(self.track, self.time_s, xy, self.track.project_path(xy).s_m)

    @property
    def time_s(self) -> Floats:
        """Of the true states."""
        return np.asarray(self.truth["time_s"])

    @property
    def speed_mps(self) -> Floats:
        """Of the true states."""
        return np.abs(np.asarray(self.truth["x"], dtype=np.float64)[:, 3])

    @property
    def flying_s(self) -> tuple[float, ...]:
        """Lap times but for the first."""
        return self.laps.times_s[1:]

    @property
    def ended(self) -> dict[str, Any]:
        """Data of the plant's event at the end; empty without it."""
        ends = self.events["data"][self.events["kind"] == "run_ended"]
        return dict(ends[-1]) if len(ends) else {}

    @cached_property
    def level(self) -> Floats:
        """Fallback level at each true state: of the cycle that answered it first, or of one before,
        whose input is held; NaN where none has answered for a while."""
        cycles = zip(
            self.cycles["state_seq"].tolist(), self.cycles["fallback"].tolist(), strict=True
        )
        found: dict[int, int] = {}
        for seq, level in cycles:
            found.setdefault(seq, level)
        held, since_s, levels = np.nan, -np.inf, list[float]()
        for seq, time_s in zip(self.truth["seq"].tolist(), self.time_s.tolist(), strict=True):
            if seq in found:
                held, since_s = found[seq], time_s
            levels.append(held if time_s - since_s <= _HELD_S else np.nan)
        return np.array(levels, dtype=np.float64)

    @property
    def fallback_share(self) -> float:
        """Of all cycles."""
        return float(np.mean(self.cycles["fallback"] > 0)) if len(self.cycles) else 1.0

    def latency_ms(self, quantile: float) -> float:
        """From a state to the arrival of the actuation that answers it; NaN without any."""
        delays = [row for one in self.states["actuation_delays"] for row in one[1::3]]
        return 1e3 * float(np.quantile(delays, quantile)) if delays else float("nan")

    def first_fault(self, since_s: float) -> tuple[float, str] | None:
        """When, and of which kind, a fault was found first from then on."""
        times = dict(zip(self.truth["seq"].tolist(), self.time_s.tolist(), strict=True))
        for seq, fault in zip(self.cycles["state_seq"].tolist(), self.cycles["sensor_fault"],
                              strict=True):  # fmt: skip
            if fault and (time_s := times.get(seq, -1.0)) >= since_s:
                return time_s, fault
        return None

    def drives_from(self, since_s: float) -> float | None:
        """When solutions drive the car again, for a while, from then on."""
        drives = (self.level == 0) & (self.speed_mps > _DRIVING_MPS)
        for k in np.flatnonzero(drives & (self.time_s >= since_s)).tolist():
            while_ = (self.time_s >= self.time_s[k]) & (self.time_s < self.time_s[k] + _STEADY_S)
            if drives[while_].all():
                return float(self.time_s[k])
        return None

    @property
    def stands(self) -> bool:
        """At the end, for a while."""
        last = self.time_s >= self.time_s[-1] - _STEADY_S
        return bool((self.speed_mps[last] < _STANDING_MPS).all())

    @property
    def unaccounted(self) -> int:
        """Messages between the two that were sent, not received and not counted as lost."""
        beats, total = self.heartbeats, 0
        last = {
            name: beats["counters"][beats["source"] == name][-1] for name in ("plant", "controller")
        }
        for sender, sent, receiver, what in _TRAFFIC:
            there = last[receiver][f"{what}_received"] + last[receiver][f"{what}_lost"]
            total += abs(int(last[sender][sent]) - int(there))
        return total

    @property
    def digest(self) -> str:
        """Of the true states."""
        return trajectory_digest(np.asarray(self.truth["x"]), LapTimes((), (), None))


def judged(scenario: Scenario, drive: Drive, undisturbed: Drive | None) -> list[Check]:
    """What must hold, each as a check. ``undisturbed``: where laps are compared with it."""
    if not len(drive.truth):
        return [Check(scenario.name, "drives", False, "there is no state of the run")]
    judge = _Judge(scenario, drive, undisturbed)
    return [Check(scenario.name, *one) for one in (*judge.driven(), *judge.events(), *judge.end())]


_Found = tuple[str, bool, str]
"""What must hold, whether it does, and what was found."""


def _most(name: str, bound: float | None, value: float, unit: str = "") -> Iterator[_Found]:
    if bound is not None:  # NaN does not hold
        yield f"{name}: at most {bound:g}{unit}", value <= bound, f"{value:.4g}{unit}"


class _Judge:
    def __init__(self, scenario: Scenario, drive: Drive, undisturbed: Drive | None) -> None:
        self._scenario, self._holds = scenario, scenario.holds
        self._drive, self._undisturbed = drive, undisturbed

    def driven(self) -> Iterator[_Found]:
        """How the car was driven."""
        holds, drive = self._holds, self._drive
        off = drive.off_track_m
        yield from _most("samples off the track", holds.off_track_samples, int((off > 0).sum()))
        yield from _most("off the track", holds.off_track_m, max(float(off.max()), 0.0), " m")
        if holds.laps is not None:
            count = len(drive.laps.times_s)
            yield f"laps: at least {holds.laps}", count >= holds.laps, f"{count}"
        slowest_s = max(drive.flying_s, default=float("nan"))
        yield from _most("slowest flying lap", holds.lap_s, slowest_s, " s")
        if self._undisturbed is not None:
            ratio = slowest_s / max(self._undisturbed.flying_s, default=float("nan"))
            yield from _most("lap over undisturbed", holds.lap_over_undisturbed, ratio)
        yield from _most("share of fallback", holds.fallback_share, drive.fallback_share)

    def events(self) -> Iterator[_Found]:
        """What follows upon what happened."""
        holds, drive, kinds = self._holds, self._drive, self._drive.events["kind"].tolist()
        for kind in holds.happens:
            yield f"event {kind}", kind in kinds, f"{kinds.count(kind)} times"
        for kind in holds.happens_not:
            yield f"no event {kind}", kind not in kinds, f"{kinds.count(kind)} times"
        if holds.detected_within_s is not None or holds.detected is not None:
            yield from self._detected()
        if (within_s := holds.drives_on_within_s) is not None:
            over_s = max(one.settled_s for one in self._scenario.event)
            again_s = drive.drives_from(over_s)
            soon = again_s is not None and again_s - over_s <= within_s + _ROUNDING_S
            found = "never" if again_s is None else f"after {again_s - over_s:.2f} s"
            yield f"drives on within {within_s:g} s", soon, found

    def _detected(self) -> Iterator[_Found]:
        holds = self._holds
        began_s = min(o.at_s for o in self._scenario.event if isinstance(o, SensorEvent))
        first = self._drive.first_fault(began_s)
        found = "nothing" if first is None else f"{first[1]} after {first[0] - began_s:.2f} s"
        if (within_s := holds.detected_within_s) is not None:
            intime = first is not None and first[0] - began_s <= within_s + _ROUNDING_S
            yield f"fault found within {within_s:g} s", intime, found
        if holds.detected is not None:
            known = first is not None and first[1] in holds.detected
            yield f"fault found: {' or '.join(holds.detected)}", known, found

    def end(self) -> Iterator[_Found]:
        """Where it led to, and what the messages say."""
        holds, drive = self._holds, self._drive
        if holds.stands is not None:
            name = "stands at the end" if holds.stands else "does not stand at the end"
            yield name, drive.stands == holds.stands, f"{drive.speed_mps[-1]:.2f} m/s"
        for share, bound in ((0.5, holds.latency_p50_ms), (0.99, holds.latency_p99_ms)):
            name = f"state to actuation, {100 * share:g} %"
            yield from _most(name, bound, drive.latency_ms(share), " ms")
        if holds.unaccounted is not None:
            yield from _most("messages unaccounted for", holds.unaccounted, drive.unaccounted)
        if holds.ends is not None:
            reason = str(drive.ended.get("reason", "no end"))
            yield f"ends by {holds.ends}", reason == holds.ends, reason
