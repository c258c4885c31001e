"""A car of one's own, driven by bayesrace-controller over UDP. See README.md.

    python python_plant.py harbour.csv --car orca.toml --laps 2

Needs msgpack and nothing of BayesRace. To bring your simulator, write a class like :class:`Car`.
"""

import argparse
import contextlib
import csv
import math
import select
import socket
import sys
import time
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgpack

PATIENCE_S = 3.0  # without an answer
REPEAT_S = 0.2  # in lockstep, until an unanswered state is sent again
OVERDUE = 1.5  # periods after which an input is not held any more


def clip(value: float, low: float, high: float) -> float:
    """The value within its limits."""
    return min(max(value, low), high)


def moved(x: Sequence[float], h: float, rates: Sequence[float]) -> list[float]:
    """The state after so long at these rates."""
    return [a + h * rate for a, rate in zip(x, rates, strict=True)]


def numbers(*values: float) -> bool:
    """Whether these are numbers; raises TypeError if they cannot be."""
    return all(abs(one) <= 1e9 for one in values)


CHECKS: dict[str, Callable[[dict[str, Any]], bool]] = {
    "actuation": lambda m: len(m["u"]) == 2 and numbers(*m["u"], m["state_seq"], m["decided_at_s"]),
    "braking": lambda m: len(m["d"]) == len(m["delta"]) and m["step_s"] > 0
    and numbers(*m["d"], *m["delta"], m["begins_s"], m["step_s"]),
}  # fmt: skip
"""What a plant reads, and whether it is as it must be."""


class Car:
    """Dynamic single-track car with Pacejka tyres and a DC motor, by Runge-Kutta of order 4."""

    step_s = 0.001

    def __init__(self, file: Path, pose: Sequence[float]) -> None:
        parts = tomllib.loads(file.read_text())
        if (parts["tyres"]["model"], parts["drive"]["model"]) != ("pacejka", "dc_motor"):
            raise ValueError(f"{file}: not a car on Pacejka tyres with a DC motor")
        self.body, self.drive, self.limits = parts["geometry"], parts["drive"], parts["limits"]
        self.front, self.rear = parts["tyres"]["front"], parts["tyres"]["rear"]
        self.x = [*pose, 0.1, 0.0, 0.0, 0.0]  # x, y, psi, vx, vy, omega, delta

    def measured(self, time_s: float) -> dict[str, Any]:
        """What the state message says of the car."""
        return {"x": self.x, "estimated": False, "readings": []}

    def step(self, d: float, rate: float) -> tuple[float, float]:
        """One step of time; drive command and steering rate that the actuators make of these."""
        low, delta_max = self.limits["d_min"], self.limits["delta_max_rad"]
        rate_max, delta = self.limits["delta_rate_max_radps"], self.x[6]
        low *= clip(self.x[3] / self.limits["brake_fade_mps"], 0.0, 1.0)  # brakes do not reverse
        d = clip(d, low, self.limits["d_max"])
        after = delta + self.step_s * clip(rate, -rate_max, rate_max)
        rate = (clip(after, -delta_max, delta_max) - delta) / self.step_s
        x, h = self.x, self.step_s
        k1 = self.rates(x, d, rate)
        k2 = self.rates(moved(x, h / 2, k1), d, rate)
        k3 = self.rates(moved(x, h / 2, k2), d, rate)
        k4 = self.rates(moved(x, h, k3), d, rate)
        mean = [a + 2 * b + 2 * c + e for a, b, c, e in zip(k1, k2, k3, k4, strict=True)]
        self.x = moved(x, h / 6, mean)
        return d, rate

    def rates(self, x: Sequence[float], d: float, rate: float) -> list[float]:
        """Derivative of the state."""
        _, _, psi, vx, vy, omega, delta = x
        body, drive, front, rear = self.body, self.drive, self.front, self.rear
        m, lf, lr = body["mass_kg"], body["lf_m"], body["lr_m"]
        v = max(vx, 0.1)  # below, slip fades with the speed, so that a standing car stays
        slip_front = delta - math.atan((vy + lf * omega) / v)
        slip_rear = math.atan((lr * omega - vy) / v)
        force_front = front["d"] * math.sin(front["c"] * math.atan(front["b"] * slip_front))
        force_rear = rear["d"] * math.sin(rear["c"] * math.atan(rear["b"] * slip_rear))
        rolling = drive["cr0"] * clip(vx / 0.02, -1.0, 1.0) + drive["cr2"] * vx * abs(vx)
        force = (drive["cm1"] - drive["cm2"] * vx) * d - rolling
        return [
            vx * math.cos(psi) - vy * math.sin(psi),
            vx * math.sin(psi) + vy * math.cos(psi),
            omega,
            (force - force_front * math.sin(delta) + m * vy * omega) / m,
            (force_rear + force_front * math.cos(delta) - m * vx * omega) / m,
            (force_front * lf * math.cos(delta) - force_rear * lr) / body["inertia_kgm2"],
            rate,
        ]


class StartLine:
    """The start line of a track's file: its pose, and when it is crossed."""

    def __init__(self, file: Path) -> None:
        lines = [one for one in file.read_text().splitlines() if not one.startswith("#")]
        rows = [[float(value) for value in row] for row in csv.reader(lines)]
        (x, y, *widths), (x1, y1, *_), (x2, y2, *_) = rows[0], rows[1], rows[-1]
        self.pose = (x, y, math.atan2(y1 - y2, x1 - x2))
        self.reach = 1.5 * max(widths)

    def along(self, at: Sequence[float]) -> tuple[float, float]:
        """Distance past the line, and to the left of its middle."""
        x, y, psi = self.pose
        x, y = at[0] - x, at[1] - y
        return x * math.cos(psi) + y * math.sin(psi), y * math.cos(psi) - x * math.sin(psi)

    def crossing(self, before: Sequence[float], after: Sequence[float]) -> tuple[int, float]:
        """1 forwards, -1 backwards, 0 not crossed; and at which share of the way."""
        (s0, _), (s1, n1) = self.along(before), self.along(after)
        if (s0 < 0) == (s1 < 0) or abs(n1) > self.reach:
            return 0, 0.0
        return (1 if s1 >= 0 else -1), s0 / (s0 - s1)


class Plant:
    """Sends states at a fixed rate, and applies what comes by zero-order hold."""

    def __init__(
        self,
        car: Any,
        line: StartLine,
        there: tuple[str, int],
        rate_hz: float = 50.0,
        lockstep: bool = True,
    ) -> None:
        self.car, self.line, self.lockstep, self.period_s = car, line, lockstep, 1 / rate_hz
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(there)  # nobody else is heard
        self.epoch, self.seq, self.steps, self.lap = time.time_ns() // 1000, 0, 0, 0
        self.u: Sequence[float] = (-1e3, 0.0)  # it brakes until there is an answer
        self.decided_s, self.heard_s = -1.0, 0.0
        self.plan: dict[str, Any] | None = None
        self.begin_period()

    def begin_period(self) -> None:
        """Nothing has acted in it yet."""
        self.applied, self.count = (0.0, 0.0), 0
        self.delays: list[float] = []

    @property
    def time_s(self) -> float:
        """Since the start, of the car."""
        return self.steps * float(self.car.step_s)

    def send(self, final: bool = False) -> None:
        """The state of the car."""
        message = {
            "schema": 3, "seq": self.seq, "source_time_ns": time.monotonic_ns(),
            "epoch": self.epoch, "run": 1, "time_s": self.seq * self.period_s,
            "u_applied": [one / max(self.count, 1) for one in self.applied],
            "lap": self.lap, "lockstep": self.lockstep, "actuation_delays": self.delays[:192],
            "final": final, **self.car.measured(self.time_s),
        }  # fmt: skip
        with contextlib.suppress(ConnectionRefusedError):  # nobody listens yet, or any more
            self.socket.send(msgpack.packb(["state", message]))

    def receive(self, wait_s: float) -> tuple[str, dict[str, Any]] | None:
        """Topic and message of the next datagram; None: none came, or it is not for this run."""
        if not select.select([self.socket], [], [], wait_s)[0]:
            return None
        try:
            topic, message = msgpack.unpackb(self.socket.recv(65536))
            mine = (message["epoch"], message["run"]) == (self.epoch, 1)
            return (topic, message) if mine and CHECKS[topic](message) else None
        except (OSError, ValueError, TypeError, KeyError):
            return None  # nobody listens, or this is no such message

    def await_answer(self) -> None:
        """Lockstep: the input that answers the newest state, which is repeated until then."""
        begin = sent = time.monotonic()
        while (now := time.monotonic()) - begin < PATIENCE_S:
            if now - sent > REPEAT_S:
                self.send()
                sent = now
            topic, message = self.receive(REPEAT_S) or ("", {})
            if topic == "actuation" and message["state_seq"] == self.seq:
                self.u, self.heard_s = message["u"], self.time_s
                return
        sys.exit(f"no answer to state {self.seq} within {PATIENCE_S:g} s")

    def is_new(self, message: dict[str, Any]) -> bool:
        """Whether it answers a state of ours later than the input at hand. One of the future would
        never grow old, and all that follow would count as overtaken."""
        latest_s = (self.seq + 2) * self.period_s
        of_ours: bool = 0 <= message["state_seq"] <= self.seq
        return of_ours and self.decided_s < message["decided_at_s"] <= latest_s

    def listen(self, start: float, end_s: float) -> None:
        """Real time: what comes until the end of the period acts as soon as it has come."""
        while (left_s := start + end_s - time.monotonic()) > 0:
            topic, message = self.receive(left_s) or ("", {})
            if topic == "braking":
                self.plan = message
            elif topic == "actuation" and self.is_new(message):
                now_s = time.monotonic() - start
                self.advance(min(now_s, end_s))
                self.u, self.decided_s = message["u"], message["decided_at_s"]
                self.heard_s = self.time_s
                sent_s = message["state_seq"] * self.period_s
                acting_s = self.time_s - self.decided_s
                self.delays += [float(message["state_seq"]), now_s - sent_s, acting_s]

    def command(self) -> tuple[float, float]:
        """The input that acts now. Whoever notices silence first brakes: here by the braking plan
        that the controller has sent ahead, and fully where that ends."""
        silent_s = self.time_s - self.heard_s
        if self.lockstep or silent_s <= OVERDUE * self.period_s:
            return self.u[0], self.u[1]
        if self.plan:
            into_s, step_s = self.time_s - self.plan["begins_s"], self.plan["step_s"]
            row = math.floor(into_s / step_s)
            if -1 <= row < len(self.plan["d"]):
                row = max(row, 0)
                left_s = max((row + 1) * step_s - into_s, self.car.step_s)
                return self.plan["d"][row], (self.plan["delta"][row] - self.car.x[6]) / left_s
        return -1e3, 0.0

    def advance(self, to_s: float) -> None:
        """Drives the car."""
        while (self.steps + 0.5) * self.car.step_s < to_s:
            d, rate = self.car.step(*self.command())
            self.applied = self.applied[0] + d, self.applied[1] + rate
            self.count += 1
            self.steps += 1

    def drive(self, laps: int) -> list[float]:
        """Drives so many laps; their times."""
        start, times = time.monotonic(), list[float]()
        while self.lap < laps:
            self.send()
            before, end_s = self.car.x, (self.seq + 1) * self.period_s
            if self.lockstep:
                self.await_answer()
            self.begin_period()
            if not self.lockstep:
                self.listen(start, end_s)
            self.advance(end_s)
            direction, share = self.line.crossing(before, self.car.x)
            self.lap += direction
            if self.lap > len(times):
                times.append((self.seq + share) * self.period_s - sum(times))
                print(f"lap {self.lap}: {times[-1]:.9f} s", flush=True)
            self.seq += 1
            if abs(self.car.x[3]) < 0.02 and self.time_s - self.heard_s > PATIENCE_S:
                self.send(final=True)
                sys.exit(f"no answer for {PATIENCE_S:g} s; the car stands")
        self.send(final=True)  # the controller is free for another plant
        return times


def arguments() -> argparse.ArgumentParser:
    """What all plants take."""
    parser = argparse.ArgumentParser()
    parser.add_argument("track", type=Path, help="CSV file, its first row the start line")
    parser.add_argument("--to", default="127.0.0.1:7450", help="the controller's UDP address")
    parser.add_argument("--laps", type=int, default=2)
    parser.add_argument("--rate", type=float, default=50.0, help="states a second, Hz")
    parser.add_argument("--realtime", action="store_true", help="by the clock, not in lockstep")
    return parser


def plant_of(given: argparse.Namespace, car: Any, line: StartLine) -> Plant:
    """The plant of these arguments."""
    host, _, port = given.to.rpartition(":")
    return Plant(car, line, (host, int(port)), given.rate, not given.realtime)


if __name__ == "__main__":
    parser = arguments()
    parser.add_argument("--car", type=Path, default="bayesrace/cars/orca.toml", help="TOML file")
    given = parser.parse_args()
    try:
        line = StartLine(given.track)
        plant = plant_of(given, Car(given.car, line.pose), line)
    except (OSError, ValueError, LookupError) as error:
        parser.error(str(error))
    plant.drive(given.laps)
