"""Messages of a log as rows that a page can draw: one a control cycle, in columns of plain numbers.

What a page is told are *updates*, objects of JSON: ``course`` (track, line, car), for each run
``run`` with the rows and laps that are new, ``gone`` for a run that is not kept any more, and
``fault`` where the log is not whole. A page that has missed some gets more rows the next time, so a
slow one takes no memory.
"""

import math
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final, cast

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.log import Entry
from bayesrace.messages import QUANTITIES, Actuation, Event, State, Telemetry, Truth
from bayesrace.operation.analysis.laps import SHORT_CUT
from bayesrace.operation.analysis.race import LineOffset
from bayesrace.operation.analysis.recording import RUN_EVENT, PlannedRun
from bayesrace.operation.look import Look, look
from bayesrace.operation.view.errors import StepErrors
from bayesrace.plant.car import LineCounter
from bayesrace.raceline import RaceLine
from bayesrace.tracks import StartLine, Track
from bayesrace.vehicles import Car

__all__ = ["Runs", "course"]

_DIGITS: Final = {
    "t": 4, "x": 4, "y": 4, "psi": 3, "v": 3, "d": 3, "delta": 4, "slip_deg": 2, "s": 4,
    "aside_m": 4, "level": 0, "solve_us": 0, "answer_ms": 2, "pace": 3, "tube_m": 4,
    "error_mm": 2, "band_mm": 2, "omega_error": 5, "omega_band": 5,
}  # fmt: skip
"""Columns of a run, and the digits behind the point that a page is told. ``s`` is the progress
along the centreline [m], laps included; ``aside_m`` the distance from the racing line, ``tube_m``
half the width of the tube at the end of the plan; ``error_mm`` the distance from the path that was
planned 0.1 s before, ``band_mm`` half the width of the tube around it. Distances are
positive to the left. ``omega_error`` and ``omega_band`` [rad/s]: :class:`.StepErrors`."""

_MOST_ROWS: Final = 20_000
"""Of a run that are kept, the newest: at 50 rows a second more than six minutes ..."""
_MOST_IN_ALL: Final = 80_000
"""... or, of all runs, an even share of this: a row takes some 1.6 kB, with its part of the plans.
A run forgets when it has half as much again."""
_MOST_RUNS: Final = 40
_ROWS_AT_ONCE: Final = 5_000
"""That a page is told, of all runs: it may be slow."""
_NEWEST_ROWS: Final = 3
"""So many rows wait for the delays of their answers ..."""
_OPEN_ROWS: Final = 100
"""... and so many for what is said of them at all: plant and controller are recorded over links of
their own, in lockstep one of them many cycles earlier."""
_PERIOD_S: Final = 0.0095
"""Rows are no closer to each other."""
_AHEAD_S: Final = 0.1
_MOST_PLANS: Final = 16
"""That are waited for until they are so old."""
_JOINED_S: Final = 0.5
"""A run whose first row is later was joined in mid-run."""
_SLOW_MPS: Final = 0.1
"""Below it a slip angle says nothing."""
_PLAN_S: Final = 0.1
"""Between two plans that are kept."""


def course(track: Track | None, line: RaceLine | None, car: Car | None, title: str) -> Any:
    """The update that begins a page: what does not change while it is driven."""
    found: dict[str, Any] = {"kind": "course", "title": title, "columns": list(_DIGITS)}
    if track is not None:
        right, left = track.boundaries(max(0.02, track.length_m / 800))
        found |= {
            "length": round(track.length_m, 4),
            "right": _points(right), "left": _points(left), "start": _points([right[0], left[0]]),
        }  # fmt: skip
    if line is not None:
        found["line"] = _points(line.xy_m[:: max(1, len(line.xy_m) // 600)])
    if car is not None:
        found["car"] = [car.length_m, car.width_m]
    return found


def _points(points: Any) -> list[list[float]]:
    """Columns x and y."""
    return cast(list[list[float]], np.round(np.asarray(points, float).T, 3).tolist())


class _Run:
    """One run of a car, in columns."""

    def __init__(
        self, car: str, shown: Look, track: Track | None, offset: LineOffset | None, begin_s: float,
        errors: StepErrors | None,
    ) -> None:  # fmt: skip
        """``car``: empty where the car's name is the label, for want of a controller's."""
        self.car, self.label, self.colour = car, shown.name, shown.colour
        self.base = 0
        """Rows that are not kept any more."""
        self.columns: dict[str, list[Any]] = {name: [] for name in _DIGITS}
        self.laps: list[tuple[int, float, float]] = []
        """Whole ones: number from 0, plant time at its begin, time [s]."""
        self.begun: tuple[int, float] | None = None
        """The lap that has begun: its number, and when."""
        self.plans: list[tuple[int, list[list[float]], list[float]]] = []
        """Row, points (columns x and y), tube [m] at all points but the first."""
        self.text = ""
        """Why it has ended."""
        self._track, self._offset, self._begin_s, self._errors = track, offset, begin_s, errors
        self._open: dict[int, dict[str, Any]] = {}
        """Rows by the number of their state. What is said of it may come before it."""
        self._closed = -1
        """The number of the last row that is not open any more."""
        self._told_truth = False
        self._planned: deque[tuple[float, Any, Sequence[float]]] = deque(maxlen=_MOST_PLANS)
        """Time and plans of the last rows."""
        self._planned_s = -math.inf
        if track is not None:
            start = StartLine(track)
            self._start = LineCounter(*track.start_pose(), start.left_m, start.right_m)
        self._last: tuple[float, float] | None = None
        """Time and arc length of the last row."""
        self._last_rows: list[dict[str, Any]] = []
        """The last row itself, if there is one."""
        self._joined_in = self._counted = 0
        """Laps before the first row; laps that are counted."""
        self._cut = False
        """The car has left out a piece of the track: laps are not counted any more."""

    @property
    def count(self) -> int:
        """Of rows so far."""
        return self.base + len(self.columns["t"])

    def state(self, state: State) -> None:
        """Begins a row; completes those that it reports delays of."""
        for seq, arrival_s, _ in zip(*[iter(state.actuation_delays)] * 3, strict=True):
            if (row := self._open.get(int(seq))) is not None:
                row["answer_ms"] = 1e3 * arrival_s
        if "true" not in self._row(state.seq):
            self._place(state)

    def _row(self, seq: int) -> dict[str, Any]:
        """The open row of a state."""
        return self._open.setdefault(seq, {}) if seq > self._closed else {}

    def _place(self, sample: State | Truth) -> None:
        row = self._row(sample.seq)
        row |= {"t": sample.time_s, "d": sample.u_applied[0], "lap": sample.lap}
        if not (isinstance(sample, State) and sample.estimated):
            row |= {"sample": sample, **_pose(sample.x)}

    def truth(self, truth: Truth) -> None:
        """Where the car has really been goes before what was measured."""
        self._told_truth = True
        self._place(truth)
        self._row(truth.seq)["true"] = True

    def cycle(self, cycle: Telemetry | Actuation) -> None:
        """What the controller has made of a state."""
        row = self._row(cycle.state_seq)
        if isinstance(cycle, Actuation):
            row["weights"] = cycle.weights_version
            return
        row |= {"level": cycle.fallback, "solve_us": cycle.solve_us, "pace": cycle.pace}
        if cycle.plan_x:
            row["plan"] = np.array(cycle.plan_x).reshape(-1, len(QUANTITIES)), cycle.tube_m
        if cycle.tube_m:
            row["tube_m"] = cycle.tube_m[-1]
        if cycle.estimate and "x" not in row:
            row |= _pose(cycle.estimate)

    def close(self, all_of_them: bool = False) -> None:
        """Moves rows to the columns: those of which all is known, or that have waited long."""
        order = sorted(self._open)
        ready = order if all_of_them else order[: self._known(order)]
        if not ready:
            return
        self._closed = ready[-1]
        rows = [row for row in map(self._open.pop, ready) if self._kept(row)]
        if not rows:
            return
        self._follow(rows)
        for row in rows:
            for name, digits in _DIGITS.items():
                value = row.get(name)
                self.columns[name].append(None if value is None else round(value, digits))

    def _known(self, order: list[int]) -> int:
        """How many of the open rows can go, from the oldest on."""
        wanted = {"t", "level", "true"} if self._told_truth else {"t", "level"}
        for count, seq in enumerate(order[:-_NEWEST_ROWS]):
            if not wanted <= self._open[seq].keys() and len(order) - count < _OPEN_ROWS:
                return count
        return max(len(order) - _NEWEST_ROWS, 0)

    def _kept(self, row: dict[str, Any]) -> bool:
        """Whether a row is shown; notes how far the car is from an earlier plan."""
        if not {"x", "t"} <= row.keys() or row["t"] - self._begin_s < _PERIOD_S:
            return False
        self._begin_s = row["t"]
        while len(self._planned) > 1 and row["t"] - self._planned[1][0] > _AHEAD_S - 1e-6:
            self._planned.popleft()
        if self._planned and row["t"] - self._planned[0][0] > _AHEAD_S - 1e-6:
            _, plan, tube_m = self._planned[0]
            row["error_mm"], row["band_mm"] = _distance_mm(plan, tube_m, row["x"], row["y"])
        if "plan" in row:
            self._planned.append((row["t"], *row["plan"]))
        return True

    def _follow(self, rows: list[dict[str, Any]]) -> None:
        """Progress of new rows, laps, plans, and errors of the model."""
        if self._track is not None:
            self._progress(self._track, rows)
        if self._errors is not None:
            self._errors.note([*self._last_rows, *rows])
            self._last_rows = rows[-1:]
        for number, row in enumerate(rows, self.count):
            if "plan" in row and row["t"] - self._planned_s >= _PLAN_S:
                self._planned_s = row["t"]
                points, tube_m = row["plan"]
                self.plans.append((number, _points(points[:, :2]), np.round(tube_m, 4).tolist()))

    def _progress(self, track: Track, rows: list[dict[str, Any]]) -> None:
        known = self.columns["s"][-1] if self.columns["s"] else None
        xy, length = np.array([[row["x"], row["y"]] for row in rows]), track.length_m
        found = track.project_path(xy, None if known is None else known % length)
        if known is not None:
            laps = round((known - float(found.progress_m[0])) / length)
        else:
            first, laps = rows[0], rows[0]["lap"]
            if joined := first["t"] > _JOINED_S:
                laps += found.progress_m[0] < 0
            self.begun = None if joined else (0, 0.0)
            self._counted = self._joined_in = first["lap"]
        self._count(rows, xy, found.s_m, length)
        for row, s in zip(rows, (found.progress_m + laps * length).tolist(), strict=True):
            row["s"] = s
        if self._offset is not None:
            aside_m = self._offset.of(xy).tolist()
            for row, aside in zip(rows, aside_m, strict=True):
                row["aside_m"] = aside

    def _count(self, rows: list[dict[str, Any]], xy: Floats, s_m: Floats, length: float) -> None:
        """Laps that new rows complete, as :func:`.time_laps` counts them."""
        for row, (x, y), s in zip(rows, xy.tolist(), s_m.tolist(), strict=True):
            before, self._last = self._last, (row["t"], s)
            if before is None:
                self._start.restart(x, y)
                continue
            before_s, before_m = before
            leap = abs((s - before_m + length / 2) % length - length / 2)
            if self._cut or leap > SHORT_CUT * length:
                self._cut, self.begun = True, None
            elif (crossings := self._joined_in + self._start.move(x, y)) > self._counted:
                self._counted = crossings
                at_s = before_s + self._start.newest.fraction * (row["t"] - before_s)
                if self.begun is not None:
                    self.laps.append((*self.begun, at_s - self.begun[1]))
                self.begun = crossings, at_s

    def keep(self, most: int) -> None:
        """So many of the newest rows, if there are many more."""
        if (count := len(self.columns["t"]) - most) <= most / 2:
            return
        for values in self.columns.values():
            del values[:count]
        self.base += count
        del self.plans[: bisect_left(self.plans, (self.base,))]

    def update(self, key: str, known: int, laps: int, most: int) -> dict[str, Any]:
        """What a page is told that has the rows up to ``known`` and so many laps: ``most`` rows."""
        begin = max(known, self.base)
        end = min(begin + most, self.count)
        first, last = (bisect_left(self.plans, (row,)) for row in (begin, end))
        return {
            "kind": "run", "key": key, "colour": self.colour, "base": self.base, "from": begin,
            "rows": {
                name: values[begin - self.base : end - self.base]
                for name, values in self.columns.items()
            },
            "plans": self.plans[first:last], "laps": self.laps[laps:], "begun": self.begun,
            "text": self.text, "to": end,
        }  # fmt: skip


def _pose(x: Sequence[float]) -> dict[str, float]:
    slip_deg = math.degrees(math.atan2(x[4], x[3])) if x[3] > _SLOW_MPS else 0.0
    return {
        "x": x[0], "y": x[1], "psi": x[2], "v": x[3], "delta": x[6], "slip_deg": slip_deg,
    }  # fmt: skip


def _distance_mm(plan: Any, tube_m: Sequence[float], x: float, y: float) -> tuple[Any, Any]:
    """From the path of a plan (n, 7), positive to its left, and half the tube's width there."""
    if len(plan) < 2:
        return None, None
    at = np.array([x, y])
    ahead = np.einsum("ij,ij->i", at - plan[:-1, :2], np.diff(plan[:, :2], axis=0))
    stage = max(int(np.argmax(ahead < 0)) if (ahead < 0).any() else len(ahead), 1) - 1
    begin, along = plan[stage, :2], plan[stage + 1, :2] - plan[stage, :2]
    length = float(np.hypot(*along))
    if length < 1e-4:
        return None, None
    off = (along[0] * (y - begin[1]) - along[1] * (x - begin[0])) / length
    return float(1e3 * off), 1e3 * tube_m[stage] if stage < len(tube_m) else None


class Runs:
    """All runs of a log, as far as it has been read; of one car, or of several."""

    def __init__(
        self, track: Track | None = None, line: RaceLine | None = None,
        errors: StepErrors | None = None,
    ) -> None:  # fmt: skip
        self._track, self._errors = track, errors
        self._offset = None if track is None or line is None else LineOffset(track, line)
        self._runs: dict[str, _Run] = {}
        self._by_number: dict[tuple[str, int], _Run] = {}
        self._names: dict[tuple[str, int], str] = {}
        self._early: deque[tuple[str, Telemetry | Actuation]] = deque(maxlen=128)
        """Cycles of a run whose first state is still on its way."""
        self._driven: dict[str, Counter[str]] = {}
        """Runs of each car by each controller, in the order in which the cars drive."""

    def take(self, entries: Iterable[Entry[Any]], whole: bool = False) -> None:
        """New messages, in order; ``whole``: there are no more."""
        heard = set()
        for entry in entries:
            (_, car, kind, *_), message = entry.key.split("/"), entry.message
            if kind == "shadow":  # it does not drive
                continue
            if isinstance(message, Event):
                self._event(car, message)
            elif isinstance(message, State | Truth):
                heard.add(run := self._run(car, message))
                if isinstance(message, Truth):
                    run.truth(message)
                else:
                    run.state(message)
            elif not isinstance(message, Telemetry | Actuation):
                continue
            elif (known := self._by_number.get((car, message.run))) is not None:
                heard.add(known)
                known.cycle(message)
            else:
                self._early.append((car, message))
        for run in self._runs.values():
            run.close(whole or bool(run.text and run not in heard))
            run.keep(min(_MOST_ROWS, _MOST_IN_ALL // len(self._runs)))

    def _event(self, car: str, event: Event) -> None:
        if event.kind == RUN_EVENT and (planned := PlannedRun.of_event(event.data)) is not None:
            self._names[car, planned.run] = planned.controller
        elif event.kind == "run_ended" and (car, event.run) in self._by_number:
            self._by_number[car, event.run].text = event.text

    def _run(self, car: str, state: State | Truth) -> _Run:
        key, place = f"{car}/{state.epoch}/{state.run}", (car, state.run)
        if key in self._runs:
            return self._runs[key]
        controller = self._names.get(place, car)
        driven = self._driven.setdefault(car, Counter())
        driven[controller] += 1
        number, order = driven[controller], list(self._driven).index(car)
        shown = look(controller, number if number > 1 else None, order)
        of = car if place in self._names else ""
        own = None if controller == "bestcase" else self._errors  # its model is another one
        run = _Run(of, shown, self._track, self._offset, state.time_s - 1, own)
        for other, one in self._runs.items():
            if other.startswith(f"{car}/") and not one.text:
                one.text = "the end of this run is not known"
        self._runs[key] = self._by_number[place] = run
        for other, cycle in self._early:
            if (other, cycle.run) == place:
                run.cycle(cycle)
        while len(self._runs) > _MOST_RUNS:
            ended = (key for key, one in self._runs.items() if one.text)
            old = self._runs.pop(next(ended, next(iter(self._runs))))
            self._by_number = {at: one for at, one in self._by_number.items() if one is not old}
        for name in list(self._names)[: -2 * _MOST_RUNS]:
            del self._names[name]
        return run

    def updates(self, known: dict[str, tuple[int, int, int, str]]) -> list[dict[str, Any]]:
        """What is new to a page, whose knowledge ``known`` is brought up to date: all runs at
        once, but of their rows perhaps only a part."""
        found, most = list[dict[str, Any]](), _ROWS_AT_ONCE
        for key in known.keys() - self._runs.keys():
            del known[key]
            found.append({"kind": "gone", "key": key})
        for key, run in self._runs.items():
            named = f"{run.car}: {run.label}" if run.car and len(self._driven) > 1 else run.label
            now = run.count, len(run.laps), run.base, named + run.text
            if known.get(key) != now and run.count:
                update = run.update(key, *known.get(key, (0, 0))[:2], most) | {"label": named}
                found.append(update)
                known[key] = update["to"], *now[1:]
                most -= update["to"] - update["from"]
        return found

    def all_updates(self) -> Iterator[dict[str, Any]]:
        """All that there is to tell."""
        known: dict[str, tuple[int, int, int, str]] = {}
        while new := self.updates(known):
            yield from new
