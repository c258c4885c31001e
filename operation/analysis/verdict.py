"""The verdict on a run: whether it did what was asked, by the truth and by what drove the car."""

from collections import Counter
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from bayesrace.arrays import Floats, Rows
from bayesrace.columns import Columns, LogColumns
from bayesrace.controller.driver import Level
from bayesrace.learning.sources import CYCLES, STATES
from bayesrace.messages import STATE, TELEMETRY, TRUTH, Topic
from bayesrace.operation.analysis.laps import LapTimes, time_laps
from bayesrace.tracks import Track

__all__ = ["Cycles", "Verdict", "judge", "judge_log"]

_DRIVEN: Final = 0.5
"""Share of a run's time that solutions must have driven."""

_HELD_S: Final = 0.1
"""An input drives until the next one, and no longer than this."""


class Verdict(NamedTuple):
    """The verdict and the facts that it follows from, in one sentence."""

    passed: bool
    text: str


class Cycles:
    """The controller's cycles in one run: the state that each answered, what spoke against that
    state, and at which level the input was found."""

    def __init__(self, telemetry: Columns) -> None:
        """``telemetry``: its columns :data:`bayesrace.learning.sources.CYCLES`; of several cycles
        for one state the newest counts."""
        seqs = telemetry["state_seq"].tolist()
        self._levels = dict(zip(seqs, telemetry["fallback"].tolist(), strict=True))
        self._faults = dict(zip(seqs, telemetry["sensor_fault"], strict=True))

    @property
    def counts(self) -> dict[str, int]:
        """Number of cycles by the name of their level, of all levels."""
        found = Counter(self._levels.values())
        return {level.name.lower(): found[level] for level in Level}

    @property
    def sensor_faults(self) -> dict[str, int]:
        """Number of states that were not believed, by kind."""
        return dict(Counter(filter(None, self._faults.values())))

    def __str__(self) -> str:
        levels = [f"{count} {name}" for name, count in self.counts.items() if count]
        faults = [f"{count} {name}" for name, count in self.sensor_faults.items()]
        text = f"cycles: {', '.join(levels) or 'none'}".replace("_", " ")
        return text + (f"; sensor faults: {', '.join(faults)}" if faults else "")

    def driven_s(self, seqs: Rows, time_s: Floats) -> float:
        """Time for which solutions have driven, of a run with these states."""
        levels = np.array([self._levels.get(seq, -1) for seq in seqs.tolist()])
        answered = levels >= 0
        held = np.minimum(np.diff(np.append(time_s[answered], time_s[-1])), _HELD_S)
        return float(held[levels[answered] == Level.SOLUTION].sum())


def judge(
    samples: Columns, off_track_m: Floats, laps: LapTimes, cycles: Cycles, asked: int
) -> Verdict:
    """Judges a run of which ``asked`` laps were wanted; 0: none.

    ``samples``: the truth, or the measurements of a car that knows none. ``off_track_m``: how far
    outside of the track the counted ones are.
    """
    faults: list[str] = []
    if not len(samples):
        return Verdict(False, "failed: there is no state of the run")
    if len(laps.times_s) < asked:
        fault = f"{len(laps.times_s)} of {asked} laps driven"
        if laps.cut_at is not None:
            cut_s = samples["time_s"][laps.cut_at]
            fault += f": at {cut_s:.2f} s the car left out a piece of the track"
        faults.append(fault)
    if (off := int((off_track_m > 0).sum())) > 0:
        faults.append(f"{off} samples off the track, up to {off_track_m.max():.3f} m")
    time_s = samples["time_s"]
    lasted_s = float(time_s[-1] - time_s[0])
    driven_s = cycles.driven_s(samples["seq"], time_s)
    if driven_s < _DRIVEN * lasted_s:
        faults.append(f"solutions drove the car for {driven_s:.2f} of {lasted_s:.2f} s")
    if faults:
        return Verdict(False, f"failed: {'; '.join(faults)} ({cycles})")
    times = ", ".join(f"{time:.3f}" for time in laps.times_s)
    count = f"{len(laps.times_s)} lap{'s' if len(laps.times_s) > 1 else ''}"
    done = f"{count} in {times} s" if times else f"{lasted_s:.2f} s driven"
    return Verdict(True, f"passed: {done}, on the track throughout ({cycles})")


def judge_log(log: Path, run: int, track: Track, asked: int) -> Verdict:
    """Judges a run in a log."""
    wanted: dict[Topic[Any], str] = {STATE: STATES, TRUTH: STATES, TELEMETRY: CYCLES}
    columns = LogColumns(log, wanted).read()
    states, truth, telemetry = (columns[one][columns[one]["run"] == run] for one in wanted)
    known = truth if len(truth) else states
    projected = track.project_path(known["x"][:, :2])
    laps = time_laps(track, known["time_s"], known["x"][:, :2], projected.s_m)
    counted = laps.after[-1] if laps.after else len(known)
    return judge(known, projected.off_track_m[:counted], laps, Cycles(telemetry), asked)
