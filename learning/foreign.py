"""Drives of others as logs of ours: a map says what their names and units mean, and what they have
recorded becomes states at even times, with the inputs that acted in between.

States are interpolated linearly, the heading without jumps. Inputs are held from when they were
recorded; a commanded steering angle is reached as fast as the car steers. Within a period our
steering turns at a constant rate, that from one angle to the next.
"""

import math
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from pydantic import Field

from bayesrace import clock
from bayesrace.arrays import Flags, Floats
from bayesrace.errors import InputError
from bayesrace.learning.dataset import left_out
from bayesrace.learning.recordings import Series, csv_columns, read_bag, read_csv
from bayesrace.log import LogWriter
from bayesrace.messages import QUANTITIES, STATE, State, car_key, encode
from bayesrace.units import Affine, Section
from bayesrace.vehicles import Car, car_text

__all__ = ["DriveMap", "ForeignDrive", "Signal", "read_drive", "write_drive"]

Quantity = Literal[
    "x", "y", "psi", "vx", "vy", "omega", "delta", "delta_command", "d", "speed_command"
]
_UNITS: Final = {
    "x": "m", "y": "m", "psi": "rad", "vx": "m/s", "vy": "m/s", "omega": "rad/s", "delta": "rad",
    "delta_command": "rad", "speed_command": "m/s",
}  # fmt: skip
"""Of what can be recorded, beside d, whose unit is the car's."""
_EITHER: Final = (("delta", "delta_command"), ("d", "speed_command"))
_HELD: Final = ("delta_command", "d", "speed_command")
_F1TENTH: Final = {
    "x": "/odom:pose.pose.position.x",
    "y": "/odom:pose.pose.position.y",
    "psi": "/odom:pose.pose.orientation",
    "vx": "/odom:twist.twist.linear.x",
    "vy": "/odom:twist.twist.linear.y",
    "omega": "/odom:twist.twist.angular.z",
    "delta_command": "/drive:drive.steering_angle",
    "speed_command": "/drive:drive.speed",
}
_SAME_S: Final = 1e-6
_LARGEST: Final = 1e6
"""Number of a message."""
_LEAST: Final = 50
"""States of a drive."""


class Signal(Affine):
    """Where a quantity is found, and in what unit: ours = sign * scale * theirs + offset."""

    named = "from"
    source: str = Field(alias="from", description="the column, or TOPIC:FIELD of a bag")


class DriveMap(Section):
    """What is what in a recording; what it leaves out is named as by default."""

    time: Signal | None = Field(None, description="column or field with the time, or 'recorded'")
    ahead_m: float | Literal["rear_axle"] | None = Field(
        None,
        description="how far ahead of the centre of mass position and velocity are measured; None: "
        "not, but at the rear axle in a bag with F1TENTH's names",
    )
    speed_lag_s: float = Field(
        0.21, gt=0, description="time constant with which the car follows speed_command"
    )
    gap_s: float | None = Field(
        None, gt=0, description="between values that are interpolated; None: two periods"
    )
    hold_s: float = Field(0.5, gt=0, description="for which an input is taken to act")
    signals: dict[Quantity, Signal] = Field({})


@dataclass(frozen=True, eq=False)
class ForeignDrive:
    """A drive at even times."""

    step_s: float
    x: Floats
    """States (n, 7)."""
    u: Floats
    """Inputs (n, 2) that acted in the period before each."""
    run: Floats
    """Number of the unbroken part that each state is of, (n,)."""
    dropped: Mapping[str, int]
    """By reason: times without a state, jumps from one to the next, states without another."""


def read_drive(path: Path, map_: DriveMap, car: Car, step_s: float) -> ForeignDrive:
    """The drive of a car in a CSV file or a rosbag2 recording, at times ``step_s`` apart.

    InputError for what is missing, wrong or too short.
    """
    if path.suffix.lower() == ".csv":
        reader, time, own = read_csv, "time_s", {name: name for name in csv_columns(path)}
    else:
        reader, time, own = read_bag, "header.stamp", _F1TENTH
    clock_of, signals = map_.time or Signal(source=time), _signals(path, map_.signals, own)
    found = reader(path, {one.source for one in signals.values()}, clock_of.source)
    scale, series = clock_of.factor("time", "s"), dict[str, Series]()
    for name, one in signals.items():
        since, theirs = found[one.source]
        unit = _UNITS.get(name, car.drive.unit)
        ours = one.sign * one.factor(name, unit) * theirs + one.offset
        series[name] = Series(scale * since, np.unwrap(ours) if name == "psi" else ours)
    even, known = _even(series, map_, step_s)
    rear = map_.ahead_m is None and signals["x"].source == _F1TENTH["x"]
    ahead_m = -car.lr_m if rear or map_.ahead_m == "rear_axle" else map_.ahead_m or 0.0
    even["x"] -= ahead_m * np.cos(even["psi"])
    even["y"] -= ahead_m * np.sin(even["psi"])
    even["vy"] -= ahead_m * even["omega"]
    return _drive(path, even, known, car, map_.speed_lag_s, step_s)


def _signals(path: Path, given: Mapping[Any, Signal], own: Mapping[str, str]) -> dict[str, Signal]:
    """The quantities that a drive is made of, as the map gives them or as they are ``own``."""
    chosen: dict[str, Signal] = {}
    for ways in (*((name,) for name in QUANTITIES[:6]), *_EITHER):
        way = next((one for names in (given, own) for one in ways if one in names), None)
        if way is None:
            named = " or ".join(ways)
            raise InputError(f"{path} has no {named}: say in [signals] of --map what it is there")
        if len(both := given.keys() & {*ways}) > 1:
            raise InputError(f"the map has {' and '.join(sorted(both))}: give one of them")
        chosen[way] = given.get(way) or Signal(source=own[way])
    return chosen


def _even(
    series: Mapping[str, Series], map_: DriveMap, step_s: float
) -> tuple[dict[str, Floats], Flags]:
    """All series at the same even times, (n,) each, and at which of them all are known."""
    first = max(one.time[0] for one in series.values())
    last = min(one.time[-1] for name, one in series.items() if name not in _HELD)
    times = first + step_s * np.arange(max(math.floor((last - first + _SAME_S) / step_s) + 1, 0))
    gap_s = 2 * step_s if map_.gap_s is None else map_.gap_s
    even: dict[str, Floats] = {}
    known = np.ones(len(times), dtype=bool)
    for name, (time, value) in series.items():
        before = np.searchsorted(time, times + _SAME_S, side="right") - 1
        age = times - time[before]
        if name in _HELD:
            even[name] = value[before]
            known &= age <= map_.hold_s + _SAME_S
        else:
            even[name] = np.interp(times, time, value)
            after = np.minimum(before + 1, len(time) - 1)
            known &= (age <= _SAME_S) | (time[after] - time[before] <= gap_s + _SAME_S)
    return even, known


def _drive(
    path: Path, even: Mapping[str, Floats], known: Flags, car: Car, lag_s: float, step_s: float
) -> ForeignDrive:
    measured = np.column_stack([even[name] for name in QUANTITIES[:6]])
    both = known[1:] & known[:-1]
    jumped = both & _jumps(measured, car, step_s)
    run = np.cumsum(np.append(0, ~both | jumped)[: len(known)])
    kept = known & (np.bincount(run, weights=known)[run] > 1)
    counts = int((~known).sum()), int(jumped.sum()), int((known & ~kept).sum())
    dropped = dict(zip(("gap", "jump", "single"), counts, strict=True))
    if kept.sum() < _LEAST:
        raise InputError(
            f"{path}: only {kept.sum()} of {len(known)} states at {1 / step_s:g} Hz can be used "
            f"({left_out(dropped)}), {_LEAST} are needed: record for longer, states and inputs at "
            "the same time, or give a lower --rate or another gap_s"
        )
    delta = even["delta"] if "delta" in even else _reached(even["delta_command"], run, car, step_s)
    d = even["d"] if "d" in even else _driven(even, car, lag_s)
    acted = np.column_stack((np.roll(d, 1), np.diff(delta, prepend=0.0) / step_s))
    acted[np.diff(run, prepend=-1) != 0] = 0.0
    x = np.column_stack((measured, delta))
    if np.abs(x[kept]).max() > _LARGEST:
        raise InputError(f"{path}: states beyond {_LARGEST:g}; bring them near to 0 by an offset")
    return ForeignDrive(step_s, x[kept], acted[kept], run[kept], dropped)


def _jumps(x: Floats, car: Car, step_s: float) -> Flags:
    """Which states (n - 1,) contradict the one before by more than the sensor monitor allows."""
    limits, change, mean = car.tuning.monitor, np.diff(x, axis=0), (x[1:] + x[:-1]) / 2
    c, s = np.cos(mean[:, 2]), np.sin(mean[:, 2])
    moved = np.stack((c * mean[:, 3] - s * mean[:, 4], s * mean[:, 3] + c * mean[:, 4]), axis=1)
    found: Flags = (
        (np.linalg.norm(change[:, :2] - step_s * moved, axis=1) > limits.position_m)
        | (np.abs(change[:, 2] - step_s * mean[:, 5]) > limits.heading_rad)
        | (np.linalg.norm(change[:, 3:5], axis=1)
           > limits.speed_mps + step_s * limits.acceleration_mps2)
        | (np.abs(change[:, 5])
           > limits.yaw_rate_radps + step_s * limits.yaw_acceleration_radps2)
    )  # fmt: skip
    return found


def _reached(command: Floats, run: Floats, car: Car, step_s: float) -> Floats:
    """Steering angles, (n,), of a car that follows the commanded ones as fast as it steers; at the
    beginning of a run its wheels stand as commanded."""
    delta, most = np.clip(command, -car.delta_max_rad, car.delta_max_rad), car.delta_rate_max_radps
    wanted = delta.copy()
    for k in np.flatnonzero(np.diff(run) == 0):
        turned = min(max(wanted[k] - delta[k], -most * step_s), most * step_s)
        delta[k + 1] = delta[k] + turned
    return delta


def _driven(even: Mapping[str, Floats], car: Car, lag_s: float) -> Floats:
    """Drive commands, (n,), by which the speeds that were commanded are reached."""
    vx, wanted = even["vx"].tolist(), even["speed_command"].tolist()
    command, mass_kg = car.drive.command_at, car.mass_kg
    d = [command(v, (w - v) / lag_s, mass_kg) for v, w in zip(vx, wanted, strict=True)]
    return np.clip(d, car.d_min, car.d_max)


def write_drive(path: Path, drive: ForeignDrive, car: Car, track: str = "") -> None:
    """The drive as a log of measured states, each unbroken part a run."""
    now_ns, key = clock.monotonic_ns(), car_key(STATE.key, car.name)
    times = drive.step_s * (np.arange(len(drive.x)) - np.searchsorted(drive.run, drive.run))
    settings = {"collect": {"track": track, "car": car_text(car)}}
    with closing(LogWriter(path, settings)) as log:
        for k, (x, u) in enumerate(zip(drive.x.tolist(), drive.u.tolist(), strict=True)):
            state = State(
                seq=k, source_time_ns=now_ns, epoch=1, run=int(drive.run[k]) + 1,
                time_s=float(times[k]), x=tuple(x), u_applied=tuple(u), lap=0, estimated=False,
                readings=(), lockstep=True, actuation_delays=(), final=False,
            )  # fmt: skip
            log.write(key, encode(state), now_ns + round(1e9 * k * drive.step_s))
