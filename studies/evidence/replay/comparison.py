"""What is compared of a recorded drive and its replay: inputs, where they part first, and why."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bayesrace.arrays import Flags, Floats
from bayesrace.errors import InputError
from bayesrace.messages import QUANTITIES
from bayesrace.studies.evidence.replay.hosts import Answer
from bayesrace.studies.evidence.verdict import Check
from bayesrace.vehicles import Car

__all__ = ["INPUTS", "ROWS", "Replayed", "Tolerance", "parting", "rows_of", "tolerance"]

INPUTS: Final = ("d", "delta_rate")

Tolerance = tuple[float, float]
"""Largest difference of each of :data:`INPUTS`; 0: to the bit."""

ROWS: Final = np.dtype(
    [
        ("run", "i8"), ("state_seq", "i8"), ("seq", "i8"), ("time_s", "f8"), ("recorded", "f8", 2),
        ("u", "f8", 2), ("recorded_level", "i8"), ("level", "i8"), ("recorded_cost", "f8"),
        ("cost", "f8"), ("known", "?"),
    ]
)  # fmt: skip
"""Of a cycle; ``known``: the recording says all that it depends on."""


def tolerance(text: str) -> Tolerance:
    """As ``d=1e-9,delta_rate=1e-7``; InputError for anything else."""
    try:
        found = {name: float(value) for name, value in (one.split("=") for one in text.split(","))}
    except ValueError:
        found = {}
    if set(found) != set(INPUTS) or not all(0 <= one < np.inf for one in found.values()):
        raise InputError(
            f"--tolerance '{text}': give one for each input, as d=1e-9,delta_rate=1e-7"
        )
    return found["d"], found["delta_rate"]


def rows_of(found: Sequence[Answer]) -> NDArray[Any]:
    """A row for each cycle that was answered."""
    rows = np.zeros(len(found), ROWS)
    for row, one in zip(rows, found, strict=True):
        cycle, how = one.cycle, one.how
        row["run"], row["state_seq"], row["seq"] = (
            cycle.sent.run,
            cycle.sent.state_seq,
            cycle.how.seq,
        )
        row["time_s"] = cycle.sent.decided_at_s
        row["recorded"], row["u"] = cycle.sent.u, one.u
        row["recorded_level"], row["level"] = cycle.how.fallback, one.level
        row["recorded_cost"], row["cost"] = cycle.how.cost, -1.0 if how is None else how.cost
        row["known"] = not cycle.unknown
    return rows


@dataclass(frozen=True, eq=False)
class Replayed:
    """A drive that was answered once more."""

    name: str
    rows: NDArray[Any]
    cycles: int
    """In the log; the host may not have answered all."""
    same: bool
    """By the controller that was recorded."""
    unknown: str
    """Why cycles cannot be reproduced, with their number; empty: all can."""
    parting: str
    """The first cycle whose input is another, and why; empty: there is none."""
    seconds: float

    def checks(self, allowed: Tolerance | None) -> list[Check]:
        """``allowed`` None: to the bit by the recorded controller; of another what it drives is
        reported, and that it needs the fallback no more often is checked."""
        rows = self.rows
        compared = rows[rows["known"]] if self.same else rows
        checks = []
        if self.same or allowed is not None:
            checks.append(
                self._check("inputs as recorded", compared, compared["recorded"], allowed)
            )
        if not self.same:
            before, now = (int((rows[one] > 0).sum()) for one in ("recorded_level", "level"))
            named = f"cycles by the fallback: at most the {before} recorded"
            checks.append(Check(self.name, named, now <= before and len(rows) > 0, self.quality))
        return checks

    def against(self, baseline: NDArray[Any], allowed: Tolerance | None) -> Check:
        """That the inputs are those of another replay, or recording, of the same states."""
        keys = ["run", "state_seq", "seq"]
        places = {tuple(key): at for at, key in enumerate(baseline[keys].tolist())}
        own = [i for i, key in enumerate(self.rows[keys].tolist()) if tuple(key) in places]
        rows = self.rows[own]
        theirs = baseline["u"][[places[key] for key in rows[keys].tolist()]]
        return self._check("inputs as the baseline's", rows, theirs.reshape(-1, 2), allowed)

    def _check(
        self, what: str, rows: NDArray[Any], wanted: Floats, allowed: Tolerance | None
    ) -> Check:
        bounds = np.array(allowed or (0.0, 0.0))
        within: Flags = np.all(np.abs(rows["u"] - wanted) <= bounds, axis=1)
        bound = " to the bit" if not bounds.any() else f" within {_numbers(bounds)}"
        found = f"{int(within.sum())} of {len(within)} cycles"
        if not within.all():
            found += f"; {_spread(rows['u'] - wanted)}"
            found += f"; {self.parting}" if "recorded" in what and self.parting else ""
            first = rows[~within][0]
            found += f"; first at {first['time_s']:.2f} s of run {first['run']}"
        if self.same and self.unknown:
            found += f"; left out: {self.unknown}"
        if not len(within):
            found = "no cycle to compare"
        return Check(
            self.name, what + bound, bool(len(within) and within.all()), found, self.seconds
        )

    @property
    def driven_s(self) -> float:
        """Time that the car took for what was answered."""
        steps = np.diff(self.rows["time_s"])
        return float(steps[steps > 0].sum())

    @property
    def quality(self) -> str:
        """How the inputs differ, and what becomes of plans and levels."""
        rows = self.rows
        text = f"{_spread(rows['u'] - rows['recorded'])}; levels {_levels(rows['level'])}"
        text += f", recorded {_levels(rows['recorded_level'])}"
        both = rows[(rows["cost"] > 0) & (rows["recorded_cost"] > 0)]
        if len(both):
            ratio = np.percentile(both["cost"] / both["recorded_cost"], [50, 95])
            text += f"; cost of the plan {ratio[0]:.3f} times (95 %: {ratio[1]:.3f})"
        return text


def _numbers(values: Any) -> str:
    return ", ".join(f"{name} {value:.2g}" for name, value in zip(INPUTS, values, strict=True))


def _spread(differences: Floats) -> str:
    quantiles = np.percentile(np.abs(differences), [50, 99, 100], axis=0)
    said = zip(("median", "99 %", "largest"), quantiles, strict=True)
    return "difference " + "; ".join(f"{what}: {_numbers(one)}" for what, one in said)


def _levels(levels: NDArray[Any]) -> str:
    return "/".join(str(int((levels == one).sum())) for one in range(4))


def parting(found: Sequence[Answer], car: Car, allowed: Tolerance | None, known: bool) -> str:
    """The first cycle whose input is not the recorded one, and what else differs there."""
    bounds = np.array(allowed or (0.0, 0.0))
    for at, one in enumerate(found):
        if known and one.cycle.unknown:
            continue
        if (np.abs(np.subtract(one.u, one.cycle.sent.u)) > bounds).any():
            return _why(found[: at + 1], car)
    return ""


def _why(found: Sequence[Answer], car: Car) -> str:
    one = found[-1]
    cycle, how = one.cycle, one.how
    sent, recorded = cycle.sent, cycle.how
    words = [
        f"they part at state {sent.state_seq} of run {sent.run}, {sent.decided_at_s:.3f} s",
        f"recorded {_pair(sent.u)}, replayed {_pair(one.u)}",
        _differs("level", recorded.fallback, one.level),
        _differs("status", sent.status, one.status),
        "" if one.accepted else "the state is not accepted",
    ]
    if how is not None:
        words += [
            _differs("weights", sent.weights_version, one.version),
            _differs("iterations", recorded.iterations, how.iterations),
            _differs("second start", recorded.second_start, how.second_start),
            _differs("sensor fault", recorded.sensor_fault, how.sensor_fault),
            _differs("delay", recorded.delay_s, how.delay_s),
            _differs("at bounds", _bounds(recorded, car), _bounds(how, car)),
        ]
        earlier = [
            before for before in found[:-1]
            if before.how and before.how.plan_u != before.cycle.how.plan_u
        ]  # fmt: skip
        if earlier:
            words.append(f"plans differ from state {earlier[0].cycle.sent.state_seq} on")
        else:
            words.append("all plans before are the same")
    return "; ".join(word for word in words if word)


def _pair(u: Sequence[float]) -> str:
    return " ".join(f"{value:.17g}" for value in u)


def _differs(what: str, recorded: object, replayed: object) -> str:
    return (
        f"{what} {recorded or 0} recorded, {replayed or 0} replayed" if recorded != replayed else ""
    )


def _bounds(how: Any, car: Car) -> str:
    """The working set as the plan shows it: stages at each bound of the car."""
    u = np.reshape(how.plan_u, (-1, 2))
    delta = np.reshape(how.plan_x, (-1, len(QUANTITIES)))[1:, QUANTITIES.index("delta")]
    limits = (
        ("d", u[:, 0], car.d_min, car.d_max),
        ("delta_rate", u[:, 1], -car.delta_rate_max_radps, car.delta_rate_max_radps),
        ("delta", delta, -car.delta_max_rad, car.delta_max_rad),
    )
    count: Counter[str] = Counter()
    for name, values, low, high in limits:
        for side, at in (("low", values <= low + 1e-6), ("high", values >= high - 1e-6)):
            count[f"{name} {side}"] += int(at.sum())
    return ", ".join(f"{name} in {many} stages" for name, many in count.items() if many) or "none"
