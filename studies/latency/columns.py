"""Reads a log into tables of numbers, and splits them where numbers or clocks begin anew."""

from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bayesrace import messages
from bayesrace.errors import InputError
from bayesrace.log import LogReader, topic_of

__all__ = ["MOST_CYCLES", "Columns", "Tables", "begins_anew", "read_tables", "split"]

Columns = NDArray[Any]
"""A structured array of 64-bit floats, in which the nanoseconds of a hundred days are exact: the
columns of :data:`_COLUMNS`; ``n``, the message's number in the log; ``at``, calendar time [ns]."""

Tables = dict[str, Columns]

MOST_CYCLES: Final = 1_000_000
"""Of one analysis: 5.5 h at 50 Hz. Each takes some 2 kB of memory and 0.3 ms."""

_COLUMNS: Final = {
    "states": "seq sampled epoch run lockstep",
    "answers": "state arrival_s acting_s",
    "truth": "epoch run lap x_m y_m",
    "actuations": "seq state sent epoch run",
    "ticks": "seq state run tick released received missed fallback "
    "wake_us decode_us prepare_us solve_us encode_us",
    "heartbeats": "controller seq epoch sent received lost overruns rate_hz",
}
"""Times without a unit in their name are in ns, by the clock of the sender."""


def read_tables(
    path: Path, name: str, warm_up_s: float, duration_s: float
) -> tuple[Tables, str, int]:
    """The tables of the car ``name`` (if empty: of the only one in the log), its name, and how many
    messages could not be decoded.

    States count from ``warm_up_s`` of plant time in each run on; reading ends ``duration_s`` after
    the first one that counts, or at :data:`MOST_CYCLES`. InputError if no state counts.
    """
    reader = LogReader(path)
    cars = {key.split("/")[1] for key in reader.channels() if topic_of(key) is messages.STATE}
    if (name or len(cars) > 1) and name not in cars:
        raise InputError(f"{path} holds cars {', '.join(sorted(cars))}; choose one with --name")
    name = name or "".join(cars)
    tables = {table: array("d") for table in _COLUMNS}
    end_ns, cycles = float("inf"), 0
    for n, entry in enumerate(reader.messages()):
        at, message = entry.wall_ns, entry.message
        if cycles >= MOST_CYCLES or at > end_ns:
            break
        if entry.key.split("/")[1] != name:
            continue
        for table, row in _rows(message):
            if table == "states" and message.time_s < warm_up_s:
                continue
            if table == "states":
                end_ns = end_ns if cycles else at + round(1e9 * duration_s)
                cycles += 1
            tables[table].extend((n, at, *row))
    if not cycles:
        raise InputError(f"{path} holds no states of a car after {warm_up_s:g} s of driving")
    found = {
        table: np.frombuffer(tables[table], [(one, float) for one in ("n", "at", *names.split())])
        for table, names in _COLUMNS.items()
    }
    return found, name, reader.refused


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
        for name in rows if len(rows["states"]) else ():
            for column in {"epoch", "run"} & set(_COLUMNS[name].split()):
                rows[name] = rows[name][rows[name][column] == rows["states"][column][0]]
        if len(rows["states"]):
            yield rows


def begins_anew(table: Columns) -> NDArray[np.bool_]:
    """Whether the sender began its numbers again, from each row to the next one."""
    found: NDArray[np.bool_] = np.diff(table["seq"]) <= 0
    return found


def _rows(message: Any) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """The rows that one message adds, each with the name of its table."""
    m = message
    match m:
        case messages.State():
            yield "states", (m.seq, m.source_time_ns, m.epoch, m.run, m.lockstep)
            for k in range(0, len(m.actuation_delays), 3):
                yield "answers", m.actuation_delays[k : k + 3]
        case messages.Truth():
            yield "truth", (m.epoch, m.run, m.lap, *m.x[:2])
        case messages.Actuation():
            yield "actuations", (m.seq, m.state_seq, m.source_time_ns, m.epoch, m.run)
        case messages.Telemetry():
            cycle = m.seq, m.state_seq, m.run, m.tick, m.released_ns, m.received_ns
            parts = m.wake_us, m.decode_us, m.prepare_us, m.solve_us, m.encode_us
            yield "ticks", (*cycle, m.missed, m.fallback, *parts)
        case messages.Status():
            stream = "states" if m.source == "controller" else "actuations"
            counts = [m.counters.get(f"{stream}_{name}") for name in ("received", "lost")]
            counts = [v if type(v) is int else 0 for v in (*counts, m.counters.get("overruns"))]
            here = m.source == "controller", m.seq, m.epoch, m.source_time_ns
            yield "heartbeats", (*here, *counts, m.rate_hz)
