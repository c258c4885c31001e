"""What a race's log holds, in numbers: the one source of ``result.json``, the table and the report.

Everything is computed from the messages in ``run.mcap`` and from the track, racing line and weights
beside it; nothing is taken over from the processes that were running.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import read_weights
from bayesrace.learning.coverage import Coverage, coverage
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.sources import dataset_from_columns
from bayesrace.learning.validation import Validation, validate
from bayesrace.limit import read_limit
from bayesrace.operation.analysis.laps import (
    Cycles,
    judge,
    positions_between,
    time_laps,
    trajectory_digest,
)
from bayesrace.operation.analysis.recording import (
    LIMIT_FILES,
    Recording,
    RunRecord,
    TrainingRecord,
    read_recording,
)
from bayesrace.operation.analysis.results import (
    LapResult,
    Percentiles,
    RaceResult,
    SettingsSummary,
    gp_metrics,
)
from bayesrace.raceline import RaceLine
from bayesrace.tracks import PathProjection, Track
from bayesrace.tracks.spline import CentrelineSearch, PlaneSpline
from bayesrace.vehicles import Car

__all__ = ["DrivenRun", "LineOffset", "RaceAnalysis", "read_race"]


_SURELY: Final = 1.5
"""The distance from the edge changes by less than so much of the way, as wide as the track may
become."""

_WEIGHTS_FILES: Final = {
    "bayesrace": "weights-bayesrace.bin",
    "bayesrace-updated": "weights-updated.bin",
}


class LineOffset:
    """Signed distance from the racing line, positive to its left."""

    def __init__(self, track: Track, line: RaceLine) -> None:
        self._reach_m = float(np.max(track.width_right_m + track.width_left_m))
        self._curve = PlaneSpline(line.s_m, line.xy_m, line.length_m)
        self._search = CentrelineSearch(self._curve, self._reach_m / 16)

    def of(self, xy: Floats) -> Floats:
        """Of the places (n, 2) of a trajectory: (n,)."""
        s = self._search.follow(xy, None, self._reach_m)
        tangent, away = self._curve(s, 1), xy - self._curve(s)
        side = np.sign(tangent[:, 0] * away[:, 1] - tangent[:, 1] * away[:, 0])
        return np.asarray(side * np.linalg.norm(away, axis=1))


class DrivenRun:
    """One run on its track: where the car was and how long its laps took."""

    def __init__(
        self,
        record: RunRecord,
        track: Track,
        line: RaceLine,
        car: Car | None = None,
        *,
        whole: bool = False,
        number: int | None = None,
    ) -> None:
        """``car``: what the built-in equations simulated; None if something else was driven.
        ``whole``: all samples count, also after the last lap. ``number``: among the runs of the
        controller, if there are several."""
        self.record, self._track, self._car, self._whole = record, track, car, whole
        self.controller, self.number = record.plan.controller, number
        xy = record.x[:, :2]
        self.on_track: PathProjection = track.project_path(xy)
        self.laps = time_laps(track, record.time_s, xy, self.on_track.s_m)
        self.offset_m = LineOffset(track, line).of(xy)

    @property
    def finished(self) -> bool:
        """Whether a whole lap was driven."""
        return bool(self.laps.times_s)

    @property
    def counted(self) -> slice:
        """The samples that count: up to the last counted crossing, or all."""
        ended = self.finished and not self._whole
        return slice(0, self.laps.after[-1] if ended else len(self.record.truth))

    def lap(self, number: int) -> slice:
        """Samples of the lap with that number, from 0, with one beyond each end."""
        after = (0, *self.laps.after)
        return slice(max(after[number] - 1, 0), after[number + 1] + 1)

    def shown(self, number: int = 0) -> slice:
        """Samples to show as a lap: that lap, or what there is of a run without one."""
        return self.lap(number) if self.finished else slice(0, self.laps.cut_at)

    @property
    def off_track(self) -> NDArray[np.bool_]:
        """Which of the counted samples are off the track."""
        return np.asarray(self.on_track.off_track_m[self.counted] > 0)

    def off_track_between(self) -> tuple[int, float] | None:
        """Counted milliseconds off the track, and the deepest of them; None if not known."""
        places = None if self._car is None else positions_between(self.record, self._car)
        if places is None:
            return None
        at = self.on_track.off_track_m[:-1]
        moved = np.linalg.norm(places - self.record.x[:-1, None, :2], axis=2).max(axis=1)
        nearest, farthest = at - _SURELY * moved, at + _SURELY * moved
        counts = np.arange(len(at)) < self.counted.stop
        deepest = max(float(np.max(at[counts], initial=0.0)), 0.0)
        # Off the track for the whole period, the car is not sought again, but where it is farthest.
        whole = counts & (nearest > 0) & (farthest < deepest)
        sought = counts & (farthest > 0) & ~whole
        depth = self._track.project_path(places[sought].reshape(-1, 2)).off_track_m
        off = depth[depth > 0]
        return int(whole.sum()) * places.shape[1] + len(off), float(np.max(off, initial=0.0))

    def result(self, laps: int = 0, limit_s: Mapping[str, float] | None = None) -> LapResult:
        """The run in numbers; ``laps``: that it was to have, 0: any number; ``limit_s``: the limits
        of a standing and of a flying lap."""
        cycles = Cycles(self.record.telemetry)
        verdict = judge(
            self.record.truth, self.on_track.off_track_m[self.counted], self.laps, cycles, laps
        )
        depth = self.on_track.off_track_m[self.counted]
        between = self.off_track_between()
        deviation = np.abs(self.offset_m[self.counted])
        times, solve_us = self.laps.times_s, self.record.telemetry["solve_us"]
        return LapResult(
            controller=self.controller,
            number=self.number,
            run=self.record.plan.run,
            finished=self.finished,
            lap_time_s=times[0] if times else None,
            flying_lap_time_s=min(times[1:], default=None),
            lap_times_s=list(times),
            limit_ratios=_ratios(times, limit_s or {}),
            off_track_samples=int(self.off_track.sum()),
            off_track_max_m=max(float(np.max(depth, initial=0.0)), 0.0),
            off_track_ms=None if between is None else between[0],
            off_track_ms_max_m=None if between is None else between[1],
            deviation_mean_m=float(deviation.mean()) if len(deviation) else None,
            deviation_max_m=float(deviation.max()) if len(deviation) else None,
            lateral_max_mps2=self._largest(self.record.lateral_mps2),
            slip_max_rad=self._largest(self.record.slip_rad),
            speed_max_mps=self._largest(self.record.x[:, 3]),
            solve_us=Percentiles.of(solve_us) if len(solve_us) else None,
            cycles=cycles.counts,
            sensor_faults=cycles.sensor_faults,
            passed=verdict.passed,
            verdict=verdict.text,
            weights_version=self.record.weights_version,
            trajectory_sha256=trajectory_digest(self.record.x, self.laps),
            samples=len(self.record.truth),
            ended=self.record.ended,
            refused=self.record.plan.refused,
            remarks=self.record.remarks,
            unknown_s=self.record.unknown_s,
        )

    def _largest(self, values: Floats) -> float | None:
        """Of the counted samples."""
        counted = np.abs(values[self.counted])
        return float(counted.max()) if len(counted) else None


def _ratios(times_s: Sequence[float], limit_s: Mapping[str, float]) -> list[float] | None:
    """Of the laps to the limits of their kinds."""
    kinds = ["standing", *["flying"] * (len(times_s) - 1)]
    if not set(kinds) <= set(limit_s):
        return None
    return [time / limit_s[kind] for time, kind in zip(times_s, kinds, strict=False)]


def _training_run(found: TrainingRecord | None) -> DrivenRun | None:
    return None if found is None else DrivenRun(found.run, found.track, found.line, whole=True)


class RaceAnalysis:
    """A recording with all that is computed from it, each thing once."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.track, self.line = recording.track, recording.line
        car = recording.settings.car if recording.built_in else None
        drives = Counter(run.plan.controller for run in recording.runs)
        driven: Counter[str] = Counter()
        self.runs: list[DrivenRun] = []
        for record in recording.runs:
            name = record.plan.controller
            driven[name] += 1
            number = driven[name] if drives[name] > 1 else None
            self.runs.append(DrivenRun(record, self.track, self.line, car, number=number))

    @cached_property
    def training(self) -> DrivenRun | None:
        """The last training drive, all of it; None where weights were given."""
        return _training_run(self.recording.training)

    @cached_property
    def practices(self) -> dict[str, DrivenRun]:
        """Track → the controller's own laps of it after the training drives, all of them."""
        return {
            one.track.name: DrivenRun(one.run, one.track, one.line, whole=True)
            for one in self.recording.practices
        }

    @cached_property
    def coverage(self) -> Coverage | None:
        """How much of the racing line was driven in training and practice; None without these."""
        found = [one.x for one in (self.recording.training, *self.recording.practices) if one]
        return coverage([self.line], np.vstack(found)) if found else None

    @cached_property
    def best_case(self) -> Dataset | None:
        """The samples on which the GPs are validated: those of the BestCase run."""
        run = self.recording.run_of("bestcase")
        if run is None:
            return None
        settings = self.recording.settings
        car, step_s = settings.car, settings.discretisation.step_s
        try:
            return dataset_from_columns(run.truth, run.telemetry, car, step_s)
        except InputError:  # cut off before its second state
            return None

    @cached_property
    def validations(self) -> dict[str, Validation]:
        """Controller whose weights they are → what they predict of the BestCase run."""
        data = self.best_case
        found = {}
        for controller, name in _WEIGHTS_FILES.items():
            path = self.recording.directory / name
            if data is not None and len(data) and path.is_file():
                weights = read_weights(path)
                discretisation = self.recording.settings.discretisation
                found[controller] = validate(weights, data, discretisation)
        return found

    @cached_property
    def result(self) -> RaceResult:
        """The race in numbers."""
        gaps = sum(run.record.gaps for run in self.runs)
        metrics = {who: gp_metrics(one.metrics) for who, one in self.validations.items()}
        recording = self.recording
        limit_s = _limits_in(recording.directory)
        practised = recording.settings.practice_laps or 0
        return RaceResult(
            settings=_summary(recording),
            laps=[run.result(recording.settings.laps, limit_s) for run in self.runs],
            limit_s=limit_s,
            training=None if self.training is None else self.training.result(),
            practices={on: run.result(practised) for on, run in self.practices.items()},
            line_driven=None if self.coverage is None else self.coverage.share,
            gp=metrics.get("bayesrace", {}),
            gp_updated=metrics.get("bayesrace-updated", {}),
            real_time_factor=_real_time_factor(recording.runs),
            complete=not (gaps or recording.truncated or recording.refused),
            gaps=gaps,
            judged_by="truth" if recording.truth else "measurement",
        )


def _summary(recording: Recording) -> SettingsSummary:
    settings, line = recording.settings, recording.line
    other = "" if settings.simulator == "equations" else settings.simulator
    return SettingsSummary(
        car=settings.car.name,
        tyres=settings.car.tyres.model if settings.car.tyres else "",
        friction=line.made_for.friction if line.made_for else None,
        track=Path(settings.track).stem,
        train_track=Path(settings.train_track).stem,
        mode=settings.mode,
        seed=settings.seed,
        laps=settings.laps,
        constraints=settings.mpc.constraints,
        fmu=Path(settings.fmu or other).name,
    )


def _limits_in(run_dir: Path) -> dict[str, float]:
    """The limits [s] by kind of lap, without any not found."""
    found = {}
    for kind, name in LIMIT_FILES.items():
        with suppress(InputError):
            found[kind] = read_limit(run_dir / name).lap_s
    return found


def _real_time_factor(runs: Sequence[RunRecord]) -> float | None:
    driven = [run.states for run in runs if run.lockstep and len(run.states) > 1]
    simulated_s = sum(np.ptp(states["time_s"]) for states in driven)
    wall_ns = sum(np.ptp(states["source_time_ns"]) for states in driven)
    return float(simulated_s / (wall_ns * 1e-9)) if wall_ns > 0 else None


def read_race(run_dir: Path) -> RaceAnalysis:
    """The analysis of a run directory; InputError if it is none.

    A race that was cut short can be analysed, too; what did not finish is marked so.
    """
    return RaceAnalysis(read_recording(run_dir))
