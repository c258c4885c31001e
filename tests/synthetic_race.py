"""A run directory whose numbers are known by hand: cars on circles, on a circular track.

Track: radius 1 m, anticlockwise (left is inwards), .2 m wide on each side. Racing line: 1.05 m.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.gp.weights import write_weights, zero_weights
from bayesrace.integrators import PREDICTION
from bayesrace.log import LogWriter
from bayesrace.messages import Actuation, Event, Message, State, Telemetry, Truth, encode
from bayesrace.operation.analysis.race import read_race
from bayesrace.operation.analysis.results import RaceResult
from bayesrace.raceline import RaceLine, write_raceline
from bayesrace.tracks import Track, write_track
from bayesrace.vehicles import get_car
from tests.driven import blank

__all__ = ["LAP_S", "LINE_M", "STEP_S", "Drive", "analyse", "circle", "track", "write_race"]


STEP_S = 0.02
LAP_S = 1.31
LINE_M = 1.05
WALL_S = 0.001


def track() -> Track:
    angle = 2 * np.pi * np.arange(128) / 128
    return Track.from_points("circle", np.column_stack([np.cos(angle), np.sin(angle)]), 0.2, 0.2)


def line() -> RaceLine:
    count = 256
    angle = 2 * np.pi * np.arange(count) / count
    ones = np.ones(count)
    return RaceLine(
        "circle",
        LINE_M * angle,
        LINE_M * np.cos(angle),
        LINE_M * np.sin(angle),
        angle + np.pi / 2,
        ones / LINE_M,
        4.0 * ones,
        0.0 * ones,
        2 * np.pi * LINE_M,
    )


def circle(angle: Floats, radius: Floats | float) -> Floats:
    """States (n, 7) at these angles [rad] and radii [m], steering straight ahead."""
    x = np.zeros((len(angle), 7))
    x[:, 0], x[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    x[:, 2] = angle + np.pi / 2
    x[:, 3] = 2.0
    return x


def analyse(run_dir: Path) -> RaceResult:
    """The outcome of a race."""
    return read_race(run_dir).result


@dataclass
class Drive:
    """One run: who, where the car was, the execution times of its steps, cycles with a fallback."""

    controller: str
    x: Floats
    solve_us: Sequence[float] = (100.0,)
    fallback_cycles: tuple[int, ...] = ()
    weights: str = ""
    ended: str | None = "2 lap(s) done"
    refused: str = ""
    """Why the controller refused its weights."""
    lockstep: bool = True
    drop: tuple[int, ...] = ()
    """Samples that are missing in the log."""
    measured: Floats | None = None
    """What the sensors measured, if not what was true."""


class _Log:
    def __init__(self, path: Path, truth: bool) -> None:
        self._writer = LogWriter(path)
        self._truth = truth
        self._next: dict[str, int] = {}
        self.now_ns = 1_000_000_000

    def seq(self, key: str) -> int:
        self._next[key] = self._next.get(key, -1) + 1
        return self._next[key]

    def put(self, key: str, message: Message) -> None:
        self._writer.write(f"bayesrace/orca/{key}", encode(message), self.now_ns)

    def event(self, run: int, source: str, kind: str, text: str, data: dict[str, object]) -> None:
        key = f"event/{source}"
        known = {"source_time_ns": self.now_ns, "run": run, "data": data}
        self.put(key, blank(Event, seq=self.seq(key), source=source, kind=kind, text=text, **known))

    def drive(self, run: int, drive: Drive) -> None:
        data: dict[str, object] = {
            "run": run, "controller": drive.controller, "weights_version": drive.weights,
            "refused": drive.refused,
        }  # fmt: skip
        self.event(run, "race", "run", f"run {run}", data)
        measured = drive.x if drive.measured is None else drive.measured
        for k, (x, seen) in enumerate(zip(drive.x, measured, strict=True)):
            self.now_ns += round(WALL_S * 1e9)
            seq = self.seq("state")
            if k in drive.drop:
                continue
            u = (0.5, 0.0) if k else (0.0, 0.0)
            now, time_s = self.now_ns, STEP_S * k
            final = k == len(drive.x) - 1
            sample: dict[str, Any] = {
                "seq": seq, "source_time_ns": now, "epoch": 1, "run": run, "time_s": time_s,
                "u_applied": u, "lap": 0,
            }  # fmt: skip
            rest: dict[str, Any] = {
                "lockstep": drive.lockstep,
                "actuation_delays": (),
                "final": final,
                "estimated": False,
                "readings": (),
            }
            self.put("state", State(**sample, x=tuple(seen), **rest))
            if self._truth:
                self.put("truth", Truth(**sample, x=tuple(x)))
            if k % 10 == 0:
                self._writer.flush()  # as a recorder does
            if final:
                break
            actuation = self.seq("actuation")
            answer = blank(
                Actuation, seq=actuation, source_time_ns=now, epoch=1, run=run, state_seq=seq,
                decided_at_s=time_s, u=u, weights_version=drive.weights,
            )  # fmt: skip
            self.put("actuation", answer)
            self.put("telemetry", self._telemetry(run, seq, drive, k))
        if drive.ended is not None:
            self.event(run, "plant", "run_ended", drive.ended, {"reason": "laps"})

    def _telemetry(self, run: int, seq: int, drive: Drive, k: int) -> Telemetry:
        level = int(k in drive.fallback_cycles)
        solve_us = float(drive.solve_us[k % len(drive.solve_us)])
        number = self.seq("telemetry")
        return blank(
            Telemetry, seq=number, source_time_ns=self.now_ns, run=run, state_seq=seq,
            fallback=level, tick=number, solve_us=solve_us,
        )  # fmt: skip

    def close(self) -> None:
        self._writer.close()


def write_race(
    path: Path, drives: Sequence[Drive], weights: bool = True, truth: bool = True
) -> Path:
    """Writes the directory as a race does; the GPs know nothing (their mean is zero).

    ``truth`` False: as of a real car, of which only measurements are known.
    """
    path.mkdir(parents=True, exist_ok=True)
    settings = {
        "car": "orca", "track": "some/where/circle.csv", "train_track": "paddock", "laps": 2,
        "mode": "lockstep", "seed": 7, "mpc": {"constraints": True},
        "discretisation": PREDICTION.model_dump(),
    }  # fmt: skip
    (path / "settings.json").write_text(json.dumps(settings))
    write_track(path / "race.csv", track())
    write_raceline(path / "race_raceline.csv", line())
    if weights:
        identity = PREDICTION.identity("e_kinematic", get_car("orca"))
        for name in ("bayesrace", "updated"):
            write_weights(path / f"weights-{name}.bin", zero_weights("orca", identity, name))
    log = _Log(path / "run.mcap", truth)
    for number, drive in enumerate(drives, 1):
        log.drive(number, drive)
    log.close()
    return path
