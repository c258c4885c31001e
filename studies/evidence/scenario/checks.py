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
from bayesrace.studies.evidence.scenario.description import Holds, Scenario
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
_AT_MOST: Final = (
    "off_track_samples", "off_track_m", "lap_s", "lap_over_undisturbed", "fallback_share",
    "latency_p50_ms", "latency_p99_ms", "unaccounted",
)  # fmt: skip
"""What must not be larger than its bound: fields of :class:`Holds` and, but for the comparison of
two drives, properties of :class:`Drive`. The last part of a name may be its unit."""
_UNITS: Final = ("m", "s", "ms")
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
    def beyond_edge_m(self) -> Floats:
        """Of each true state; negative on the track."""
        return self.track.project_path(self.truth["x"][:, :2]).off_track_m

    @property
    def off_track_samples(self) -> int:
        """True states off the track."""
        return int((self.beyond_edge_m > 0).sum())

    @property
    def off_track_m(self) -> float:
        """How far off the track it was at most; 0 if never."""
        return max(float(self.beyond_edge_m.max()), 0.0)

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
    def lap_s(self) -> float:
        """Slowest lap but for the first; NaN without any."""
        return max(self.laps.times_s[1:], default=np.nan)

    @property
    def ended(self) -> dict[str, Any]:
        """Data of the plant's event at the end; empty without it."""
        ends = self.events["data"][self.events["kind"] == "run_ended"]
        return dict(ends[-1]) if len(ends) else {}

    @cached_property
    def level(self) -> Floats:
        """Fallback level at each true state: of the cycle that answered it first, or of one before,
        whose input is held; NaN where none has answered for a while."""
        seqs, levels_of = self.cycles["state_seq"].tolist(), self.cycles["fallback"].tolist()
        # The first answer to a state stays: it overwrites those after it.
        found = dict(zip(reversed(seqs), reversed(levels_of), strict=True))
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

    @property
    def latency_p50_ms(self) -> float:
        """From a state to the arrival of the actuation that answers it, median; NaN without any."""
        return self._latency_ms(0.5)

    @property
    def latency_p99_ms(self) -> float:
        """The same, 99 % of them."""
        return self._latency_ms(0.99)

    def _latency_ms(self, quantile: float) -> float:
        delays = [row for one in self.states["actuation_delays"] for row in one[1::3]]
        return 1e3 * float(np.quantile(delays, quantile)) if delays else np.nan

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


_Found = tuple[str, bool, str]
"""What must hold, whether it does, and what was found."""


def judged(scenario: Scenario, drive: Drive, undisturbed: Drive | None) -> list[Check]:
    """What must hold, each as a check. ``undisturbed``: where laps are compared with it."""
    if not len(drive.truth):
        return [Check(scenario.name, "drives", False, "there is no state of the run")]
    parts = (
        _bounded(scenario.holds, drive, undisturbed),
        _ended(scenario.holds, drive),
        _detected(scenario, drive),
        _drives_on(scenario, drive),
    )
    return [Check(scenario.name, *found) for part in parts for found in part]


def _bounded(holds: Holds, drive: Drive, undisturbed: Drive | None) -> Iterator[_Found]:
    for field in _AT_MOST:
        if (bound := getattr(holds, field)) is None:
            continue
        if field != "lap_over_undisturbed":
            value = getattr(drive, field)
        else:
            value = drive.lap_s / undisturbed.lap_s if undisturbed else np.nan
        *words, last = field.split("_")
        unit = f" {last}" if last in _UNITS else ""
        name = " ".join(words if unit else [*words, last])
        holds_it = bool(value <= bound)  # NaN does not
        yield f"{name}: at most {bound:g}{unit}", holds_it, f"{value:.4g}{unit}"


def _ended(holds: Holds, drive: Drive) -> Iterator[_Found]:
    """Where it led to, and what is in the log."""
    if holds.laps is not None:
        count = len(drive.laps.times_s)
        yield f"laps: at least {holds.laps}", count >= holds.laps, f"{count}"
    if holds.stands is not None:
        name = "stands at the end" if holds.stands else "does not stand at the end"
        yield name, drive.stands == holds.stands, f"{drive.speed_mps[-1]:.2f} m/s"
    if holds.ends is not None:
        reason = str(drive.ended.get("reason", "no end"))
        yield f"ends by {holds.ends}", reason == holds.ends, reason
    kinds = drive.events["kind"].tolist()
    for kind in holds.happens:
        yield f"event {kind}", kind in kinds, f"{kinds.count(kind)} times"
    for kind in holds.happens_not:
        yield f"no event {kind}", kind not in kinds, f"{kinds.count(kind)} times"


def _detected(scenario: Scenario, drive: Drive) -> Iterator[_Found]:
    """Whether a fault was found, when, and which."""
    within_s, kinds = scenario.holds.detected_within_s, scenario.holds.detected
    if within_s is None and kinds is None:
        return
    began_s = min(o.at_s for o in scenario.event if isinstance(o, SensorEvent))
    time_s, kind = drive.first_fault(began_s) or (np.inf, "")
    found = f"{kind} after {time_s - began_s:.2f} s" if kind else "nothing"
    if within_s is not None:
        in_time = time_s - began_s <= within_s + _ROUNDING_S
        yield f"fault found within {within_s:g} s", in_time, found
    if kinds is not None:
        yield f"fault found: {' or '.join(kinds)}", kind in kinds, found


def _drives_on(scenario: Scenario, drive: Drive) -> Iterator[_Found]:
    """Whether solutions drive again after what happened."""
    if (within_s := scenario.holds.drives_on_within_s) is None:
        return
    over_s = max(one.settled_s for one in scenario.event)
    again_s = drive.drives_from(over_s)
    soon = again_s is not None and again_s - over_s <= within_s + _ROUNDING_S
    found = "never" if again_s is None else f"after {again_s - over_s:.2f} s"
    yield f"drives on within {within_s:g} s", soon, found
