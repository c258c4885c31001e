"""The legs of a control cycle, each computed from the message fields that hold its two times.

Durations that one process measured are exact. What lies between the clocks of both processes is as
good as the map of one clock to the other (:mod:`experiments.latency.clocks`).
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.latency.clocks import ClockMap
from experiments.latency.columns import Columns, Tables

__all__ = ["ANSWER", "LEGS", "Cycles", "Values"]

Ints = NDArray[np.int64]

LEGS: Final = {
    "wake_up": ("wake-up error", "controller"),
    "state_transport": ("state transport", "both"),
    "decode": ("decode", "controller"),
    "release_wait": ("wait for release", "controller"),
    "state_age": ("age of state at release", "both"),
    "feedback": ("feedback", "controller"),
    "compute": ("cycle", "controller"),
    "encode": ("encode and send", "controller"),
    "actuation_transport": ("actuation transport", "both"),
    "state_to_actuation": ("state → actuation", "plant"),
    "acting": ("delay until acting", "plant"),
    "prepare": ("preparation", "controller"),
}
"""Title of each leg, and the clock on which it begins and ends; both: it crosses from one to the
other. In the order of a cycle; docs/latency.md says from where to where each goes."""

ANSWER: Final = "state_to_actuation"
"""The leg that counts."""

_MOST_NS: Final = 1e15


class Values(NamedTuple):
    """One leg, cycle by cycle."""

    leg: str
    at: Ints
    """Calendar time at the recorder [ns]."""
    ns: Ints


class Cycles:
    """The messages of one plant and controller process, joined by the state that they answer.

    A state is answered more than once where no newer one came in time: the controller predicts it
    forward. Which of several actuations is which is known only if none of them was lost; the
    transports of the others are left out.
    """

    def __init__(self, tables: Tables) -> None:
        states = tables["states"]
        self.states = states[_first(states)]
        self.actuations = tables["actuations"]
        self.ticks, self.answers = (self._known(tables[name]) for name in ("ticks", "answers"))
        self._starts = self.ticks[_first(self.ticks, "state")]
        """The first cycle of each state."""
        self._sent, self._arrived = _paired(self._known(self.actuations), self.answers)
        streams = (self.states, self.actuations, tables["ticks"])
        self.unobserved = sum(map(_missing, streams))
        """Messages missing in the log, by their numbers; the run itself may have had them."""

    def exchanges(self) -> tuple[Ints, Ints, Ints, Ints]:
        """The first answer to each state as an exchange of timestamps: sampled at the plant,
        received and sent by the controller's clock, arrived at the plant [ns]."""
        k = _first(self._arrived, "state")
        sent, arrived = self._sent[k], self._arrived[k]
        _, i, j = np.intersect1d(self._starts["state"], sent["state"], return_indices=True)
        sampled = self._sampled(arrived)
        arrival = sampled + _ns(arrived["arrival_s"] * 1e9)
        return sampled[j], self._starts["received"][i], sent["sent"][j], arrival[j]

    def legs(self, clock: ClockMap | None) -> Iterator[Values]:
        """All legs that the messages give; those between both clocks only with a map of them."""
        ticks, starts, answers = self.ticks, self._starts, self.answers
        for leg, column in (
            ("wake_up", "wake_us"), ("prepare", "prepare_us"), ("feedback", "solve_us"),
            ("encode", "encode_us"),
        ):  # fmt: skip
            yield Values(leg, ticks["at"], _ns(ticks[column] * 1e3))
        yield Values("decode", starts["at"], _ns(starts["decode_us"] * 1e3))
        yield Values("release_wait", starts["at"], starts["released"] - starts["received"])
        # Every cycle sends one actuation and one telemetry message, with equal numbers.
        _, i, j = np.intersect1d(self.actuations["seq"], ticks["seq"], return_indices=True)
        made = self.actuations["sent"][i]
        yield Values("compute", ticks["at"][j], made - ticks["released"][j])
        first = answers[_first(answers, "state")]
        yield Values(ANSWER, first["at"], _ns(first["arrival_s"] * 1e9))
        acted = answers[answers["acting_s"] >= 0]
        yield Values("acting", acted["at"], _ns(acted["acting_s"] * 1e9))
        if clock is not None:
            for leg, rows, column in (
                ("state_transport", starts, "received"), ("state_age", ticks, "released")
            ):  # fmt: skip
                yield Values(leg, rows["at"], clock.to_plant(rows[column]) - self._sampled(rows))
            arrived = self._sampled(self._arrived) + _ns(self._arrived["arrival_s"] * 1e9)
            transport = arrived - clock.to_plant(self._sent["sent"])
            yield Values("actuation_transport", self._arrived["at"], transport)

    @property
    def skipped(self) -> int:
        """Releases passed over, by the numbers of the cycles."""
        passed = np.diff(self.ticks["tick"]) - np.diff(self.ticks["seq"])
        return int(np.maximum(passed, 0).sum())

    @property
    def periods(self) -> tuple[int, int]:
        """Periods from the first cycle to the last one, and their total length [ns]."""
        if not len(self.ticks):
            return 0, 0
        first, last = self.ticks[0], self.ticks[-1]
        return int(last["seq"] - first["seq"]), int(last["released"] - first["released"])

    @property
    def repeated(self) -> int:
        """Answers to a state that had been answered already."""
        return len(self.answers) - len(_first(self.answers, "state"))

    def _sampled(self, rows: Columns) -> Ints:
        """When the state of each row was, on the plant's clock."""
        found: Ints = self.states["sampled"][np.searchsorted(self.states["seq"], rows["state"])]
        return found

    def _known(self, rows: Columns) -> Columns:
        """The rows whose state is one of those that count."""
        return rows[np.isin(rows["state"], self.states["seq"])]


def _ns(values: NDArray[np.float64]) -> Ints:
    return np.rint(np.clip(values, -_MOST_NS, _MOST_NS)).astype(np.int64)


def _first(table: Columns, key: str = "seq") -> Ints:
    """Indices of the first row of each key, by rising keys."""
    return np.unique(table[key], return_index=True)[1]


def _missing(table: Columns) -> int:
    return int(np.ptp(table["seq"])) + 1 - len(_first(table)) if len(table) else 0


def _paired(one: Columns, other: Columns) -> tuple[Columns, Columns]:
    """The rows of the states of which both tables have equally many, the k-th with the k-th."""
    one, other = (rows[np.argsort(rows["state"], kind="stable")] for rows in (one, other))
    (keys, counts), (others, more) = (
        np.unique(rows["state"], return_counts=True) for rows in (one, other)
    )
    common, i, j = np.intersect1d(keys, others, return_indices=True)
    whole = common[counts[i] == more[j]]
    return one[np.isin(one["state"], whole)], other[np.isin(other["state"], whole)]
