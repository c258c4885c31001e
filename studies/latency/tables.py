"""The tables of a measurement: columns of the log, split where numbers or clocks begin anew."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bayesrace.columns import Columns, LogColumns
from bayesrace.errors import InputError
from bayesrace.log import LogReader, topic_of
from bayesrace.messages import ACTUATION, HEARTBEAT, STATE, TELEMETRY, TRUTH, Topic

__all__ = ["MOST_CYCLES", "Tables", "begins_anew", "read_tables", "split"]

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
