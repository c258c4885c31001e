"""The legs of a control cycle, each computed from the message fields that hold its two times.

:func:`read_tables` reads columns of the log, and :func:`split` splits them where numbers or clocks
begin anew. :class:`Cycles` joins the messages of such a part. Durations that one process measured
are exact; those between the clocks of both processes are as good as the map of one clock to the
other (:class:`ClockMap`).
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from bayesrace.arrays import Floats
from bayesrace.columns import Columns, LogColumns
from bayesrace.errors import InputError
from bayesrace.log import LogReader
from bayesrace.messages import ACTUATION, HEARTBEAT, STATE, TELEMETRY, TRUTH, Topic, topic_of

__all__ = ["ANSWER", "BESIDE", "LEGS", "MOST_CYCLES", "ClockMap", "Cycles", "begins_anew"]
__all__ += ["read_tables", "split"]

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

BESIDE: Final = {
    "bare_loop": "bare loop's wake-up error",
    "round_trip": "bare round trip of messages",
}
"""Title of each series that is measured beside the run, not in it."""

ANSWER: Final = "state_to_actuation"
"""The leg that counts."""


_DRIFT: Final = 200e-6
"""Of one clock against another at most: quartz is within 100 ppm on either side."""

_SECOND: Final = 10
"""Heartbeats in a second."""

Tables = dict[str, Columns]
"""``states``, ``truth``, ``actuations``, ``ticks`` (telemetry), ``heartbeats``; and ``answers``, a
row for each actuation whose delays a state reports."""

MOST_CYCLES: Final = 1_000_000
"""Of one analysis: 5.5 h at 50 Hz. Each takes some 2 kB of memory and 0.3 ms."""

_COLUMNS: Final[Mapping[str, tuple[Topic[Any], str]]] = {
    "states": (STATE, "seq source_time_ns epoch run time_s lockstep actuation_delays"),
    "truth": (TRUTH, "epoch run lap x"),
    "actuations": (ACTUATION, "seq state_seq source_time_ns epoch run"),
    "ticks": (
        TELEMETRY,
        """seq state_seq run tick released_ns received_ns missed fallback
        wake_us decode_us prepare_us solve_us encode_us""",
    ),
    "heartbeats": (
        HEARTBEAT,
        """source seq epoch source_time_ns rate_hz counters.overruns
        counters.states_received counters.states_lost
        counters.actuations_received counters.actuations_lost""",
    ),
}


# Columns of the log -------------------------------------------------------------------------------


def read_tables(
    path: Path, name: str, warm_up_s: float, duration_s: float
) -> tuple[Tables, str, int]:
    """The tables of the car ``name`` (if empty: of the only one in the log), its name, and how many
    messages could not be decoded.

    States count from ``warm_up_s`` of plant time in each run on, for ``duration_s`` after the first
    one that counts; at most, about :data:`MOST_CYCLES`. InputError if no state counts.
    """
    wanted = dict(_COLUMNS.values())
    cars = {key.split("/")[1] for key in LogReader(path).channels() if topic_of(key) is STATE}
    if (name or len(cars) > 1) and name not in cars:
        raise InputError(f"{path} holds cars {', '.join(sorted(cars))}; choose one with --name")
    name = name or "".join(cars)
    log = LogColumns(path, wanted, name, MOST_CYCLES).read()
    tables = {table: log[topic] for table, (topic, _) in _COLUMNS.items()}
    counted = tables["states"][tables["states"]["time_s"] >= warm_up_s]
    if not len(counted):
        raise InputError(f"{path} holds no states of a car after {warm_up_s:g} s of driving")
    tables |= {"answers": _answers(tables["states"]), "states": counted}
    end_ns = int(counted["wall_ns"][0]) + round(1e9 * duration_s)
    return (
        {table: rows[rows["wall_ns"] <= end_ns] for table, rows in tables.items()},
        name,
        log.reader.refused,
    )


def _answers(states: Columns) -> Columns:
    """A row for each actuation whose delays the states report."""
    rows = [
        (n, wall_ns, *delays[k : k + 3])
        for n, wall_ns, delays in states[["n", "wall_ns", "actuation_delays"]].tolist()
        for k in range(0, len(delays), 3)
    ]
    numbers = [(one, np.int64) for one in ("n", "wall_ns", "state_seq")]
    return np.array(rows, [*numbers, ("arrival_s", np.float64), ("acting_s", np.float64)])


def split(tables: Tables) -> Iterator[Tables]:
    """The tables of each run of a plant process with a controller process.

    In each of them message numbers are unique, and both clocks run on. A new run and a plant that
    was restarted send another ``run`` or ``epoch``; a controller that was restarted begins its
    numbers again.
    """
    states, actuations = tables["states"], tables["actuations"]
    other = (np.diff(states["epoch"]) != 0) | (np.diff(states["run"]) != 0)
    bounds = np.union1d(states["n"][1:][other], actuations["n"][1:][begins_anew(actuations)])
    for part in range(len(bounds) + 1):
        rows = {
            name: table[np.searchsorted(bounds, table["n"], side="right") == part]
            for name, table in tables.items()
        }
        if not len(rows["states"]):
            continue
        for name, table in rows.items():
            for column in {"epoch", "run"} & set(table.dtype.names or ()):
                rows[name] = rows[name][rows[name][column] == rows["states"][column][0]]
        yield rows


def begins_anew(table: Columns) -> NDArray[np.bool_]:
    """Whether the sender began its numbers again, from each row to the next one."""
    found: NDArray[np.bool_] = np.diff(table["seq"]) <= 0
    return found


# Cycles -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ClockMap:
    """The offset of the controller's clock, controller minus plant, at some times [ns].

    A state and its answer are an exchange of four timestamps, as in NTP (RFC 5905, section 8): the
    plant samples, the controller receives and later sends the answer, and the plant receives that.
    Neither message arrives before it was sent, so the offset between both clocks is bounded from
    both sides: the middle is wrong by at most half of the round trip less the controller's own
    time, however unequal the two ways are. An exchange counts if none near it bounds the offset at
    its time more closely, drift included. Between two that count the offset is interpolated, so the
    truth stays within the bounds as long as the clocks run evenly from one to the next.
    """

    shared: bool
    """It is one clock: no exchange contradicts an offset of zero."""
    exchanges: int
    uncertainty: float
    """The largest of the run, from the first exchange to the last one; 0 if shared."""
    at: Floats
    """Controller's clock, rising."""
    offset: Floats

    @classmethod
    def of(cls, sampled: Floats, received: Floats, sent: Floats, arrived: Floats) -> Self | None:
        """The map that exchanges give, in the order of their four times: the first and the last one
        by the plant's clock, the others by the controller's. None without any."""
        if not len(received):
            return None
        order = np.argsort(received, kind="stable")
        at, most, least = received[order], (received - sampled)[order], (sent - arrived)[order]
        shared = bool((most >= 0).all() and (least <= 0).all())
        # The clocks run apart also during an exchange.
        half = (most - least) / 2 + _DRIFT * (arrived - sampled)[order]
        drifted = _DRIFT * (at - at[0])
        before = np.minimum.accumulate(half - drifted) + drifted
        after = np.minimum.accumulate((half + drifted)[::-1])[::-1] - drifted
        bound = np.minimum(before, after) + 1.0
        best = half <= bound
        offset = (most + least)[best] / 2
        return cls(shared, len(at), 0.0 if shared else float(bound.max()), at[best], offset)

    def to_plant(self, controller: Floats) -> Floats:
        """Readings of the controller's clock in terms of the plant's."""
        offset = 0.0 if self.shared else np.interp(controller, self.at, self.offset)
        return np.asarray(controller - offset)


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
        self.answers, ticks = self._known(tables["answers"]), self._known(tables["ticks"])
        # After the last state the controller predicts and falls back, until it gives up.
        self.ticks = ticks[ticks["n"] < self.states["n"][-1]]
        self._starts = self.ticks[_first(self.ticks, "state_seq")]
        """The first cycle of each state."""
        self._releases = self.ticks[_first(self.ticks, "tick")]
        """The first cycle of each release; all others are late ones."""
        self._sent, self._arrived = _paired(self._known(self.actuations), self.answers)
        self._arrived_at = self._sampled(self._arrived) + self._arrived["arrival_s"] * 1e9
        self.clock = ClockMap.of(*self._exchanges())
        self._tables = tables

    def _exchanges(self) -> tuple[Floats, Floats, Floats, Floats]:
        """The first answer to each state as an exchange of timestamps: sampled at the plant,
        received and sent by the controller's clock, arrived at the plant [ns]."""
        k = _first(self._arrived, "state_seq")
        _, i, j = np.intersect1d(
            self._starts["state_seq"], self._arrived["state_seq"][k], return_indices=True
        )
        starts, k = self._starts[i], k[j]
        return (
            self._sampled(starts),
            starts["received_ns"],
            self._sent["source_time_ns"][k],
            self._arrived_at[k],
        )

    def legs(self) -> dict[str, tuple[Floats, Floats]]:
        """Calendar times at the recorder, and values, of each leg that the messages give [ns]."""
        ticks, starts, releases = self.ticks, self._starts, self._releases
        first = self.answers[_first(self.answers, "state_seq")]
        acted = self.answers[self.answers["acting_s"] >= 0]
        # Every cycle sends one actuation and one telemetry message, with equal numbers.
        _, i, j = np.intersect1d(self.actuations["seq"], ticks["seq"], return_indices=True)
        made, released = self.actuations["source_time_ns"][i], ticks["released_ns"][j]
        legs = {
            "wake_up": (releases["wall_ns"], releases["wake_us"] * 1e3),
            "decode": (starts["wall_ns"], starts["decode_us"] * 1e3),
            "release_wait": (starts["wall_ns"], starts["released_ns"] - starts["received_ns"]),
            "feedback": (ticks["wall_ns"], ticks["solve_us"] * 1e3),
            "compute": (ticks["wall_ns"][j], made - released),
            "encode": (ticks["wall_ns"], ticks["encode_us"] * 1e3),
            "state_to_actuation": (first["wall_ns"], first["arrival_s"] * 1e9),
            "acting": (acted["wall_ns"], acted["acting_s"] * 1e9),
            "prepare": (releases["wall_ns"], releases["prepare_us"] * 1e3),
        }
        if self.clock is not None:
            readings = starts["received_ns"], ticks["released_ns"], self._sent["source_time_ns"]
            received, released, sent = map(self.clock.to_plant, readings)
            legs["state_transport"] = starts["wall_ns"], received - self._sampled(starts)
            legs["state_age"] = ticks["wall_ns"], released - self._sampled(ticks)
            legs["actuation_transport"] = self._arrived["wall_ns"], self._arrived_at - sent
        return legs

    def counts(self) -> Counter[str]:
        """What can be added up over the parts of a log; messages as :func:`_traffic` names them."""
        ticks, answers, releases = self.ticks, self.answers, self._releases
        late = len(ticks) - len(releases)
        streams = self.states, self.actuations, self._tables["ticks"]
        beats = _heartbeats(self._tables, "controller")
        found = {
            "releases": len(releases),
            "late_states": late,
            "skipped": np.maximum(np.diff(ticks["tick"]) - np.diff(ticks["seq"]), 0).sum(),
            "deadline_misses": ticks["missed"].sum(),
            "fallbacks": np.count_nonzero(ticks["fallback"]),
            "overruns": np.diff(beats["counters.overruns"]).sum(),
            "periods": np.diff(ticks["seq"]).sum() - late,
            "length_ns": np.diff(releases["released_ns"]).sum(),
            "repeated_answers": len(answers) - len(_first(answers, "state_seq")),
            "overtaken_answers": np.count_nonzero(answers["acting_s"] < 0),
            # By their numbers; the run itself may have had them.
            "unobserved": sum((np.diff(np.unique(one["seq"])) - 1.0).sum() for one in streams),
        }
        if self.clock is not None:
            found |= _traffic(self._tables, self.clock)
        return Counter({name: int(count) for name, count in found.items()})

    def _sampled(self, rows: Columns) -> Floats:
        """When the state of each row was, on the plant's clock."""
        found: Floats = self.states["source_time_ns"][
            np.searchsorted(self.states["seq"], rows["state_seq"])
        ]
        return found

    def _known(self, rows: Columns) -> Columns:
        """The rows whose state is one of those that count."""
        return rows[np.isin(rows["state_seq"], self.states["seq"])]


def _first(table: Columns, key: str = "seq") -> NDArray[np.intp]:
    """Indices of the first row of each key, by rising keys."""
    return np.unique(table[key], return_index=True)[1]


def _paired(one: Columns, other: Columns) -> tuple[Columns, Columns]:
    """The rows of the states of which both tables have equally many, the k-th with the k-th."""
    one, other = (rows[np.argsort(rows["state_seq"], kind="stable")] for rows in (one, other))
    (keys, counts), (others, more) = (
        np.unique(rows["state_seq"], return_counts=True) for rows in (one, other)
    )
    common, i, j = np.intersect1d(keys, others, return_indices=True)
    whole = common[counts[i] == more[j]]
    return one[np.isin(one["state_seq"], whole)], other[np.isin(other["state_seq"], whole)]


def _heartbeats(tables: Tables, source: str) -> Columns:
    """Those of one process, up to a restart of it: its counters begin anew there."""
    beats = tables["heartbeats"]
    beats = beats[beats["source"] == source]
    return np.split(beats, np.flatnonzero(begins_anew(beats)) + 1)[0]


def _traffic(tables: Tables, clock: ClockMap) -> dict[str, float]:
    """``states_sent``, ``…_received``, ``…_lost``, ``actuations_sent`` and so on; of a direction
    without heartbeats nothing.

    A heartbeat of the receiver carries what it had received and counted as lost until then; what
    had been sent until then follows from the numbers and times in the log. Messages are counted
    between two heartbeats, of the first and of the last second, at which the fewest were in flight.
    """
    states, actuations = tables["states"], tables["actuations"]
    actuations = actuations[actuations["state_seq"] >= states["seq"][0]]  # none of the warm-up
    plant, controller = (_heartbeats(tables, one) for one in ("plant", "controller"))
    at = clock.to_plant(controller["source_time_ns"])
    found = _counted("states", states["seq"], states["source_time_ns"], controller, at)
    sent_at = clock.to_plant(actuations["source_time_ns"])
    return found | _counted(
        "actuations", actuations["seq"], sent_at, plant, plant["source_time_ns"]
    )


def _counted(
    stream: str, numbers: Floats, sent_at: Floats, beats: Columns, at: Floats
) -> dict[str, float]:
    """``sent_at`` of the messages and ``at`` of the receiver's heartbeats are on one clock."""
    before = np.searchsorted(sent_at, at, side="right")
    inside = (before > 0) & (before < len(sent_at))
    if not inside.any():
        return {}
    sent, beats = numbers[before[inside] - 1], beats[inside]
    columns = {one: beats[f"counters.{stream}_{one}"] for one in ("received", "lost")}
    left = sent - columns["received"] - columns["lost"]
    begin, end = left[:_SECOND].argmin(), len(left) - 1 - left[::-1][:_SECOND].argmin()
    columns["sent"] = sent
    return {f"{stream}_{name}": one[end] - one[begin] for name, one in columns.items()}
