"""The results of a campaign: a folder of Parquet, one row a lap, safe against kills.

What workers return at once is written as a small file of its own, whole or not at all. When a
campaign begins or ends, all of them become one, ``laps.parquet``.
"""

import fcntl
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Final, get_args

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic.fields import FieldInfo

from bayesrace.errors import InputError
from bayesrace.files import clear_partials, replacing
from bayesrace.studies.campaign.case import FAILED, Row, factors

__all__ = ["Results", "read_results", "writing"]

_LAPS: Final = "laps.parquet"
_PARTS: Final = "parts"

_COLUMNS: Final = {
    "controller": str, "car_identity": str, "weights": str, "software": str, "cpu": str,
    "lap": int, "lap_time_s": float, "samples": int, "off_track_samples": int,
    "off_track_max_m": float, "fallbacks": int, "ended": str, "reason": str,
    "trajectory_sha256": str, "step_p50_us": float, "step_p99_us": float, "step_max_us": float,
    "simulated_s": float, "drive_s": float, "case_s": float, "host": str, "settings": str,
}  # fmt: skip
"""All but the key and the factors; docs/campaigns.md says what they mean."""
_TYPES: Final = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}


def _schema() -> pa.Schema:
    columns = {"key": str, **{name: _kind(field) for name, field in factors().items()}, **_COLUMNS}
    return pa.schema([(name, _TYPES[kind]) for name, kind in columns.items()])


def _kind(field: FieldInfo) -> type:
    """Of a factor's values, which may be None; text for what is no single number."""
    form: Any = field.annotation
    kinds = {one for one in get_args(form) or (form,) if one is not NoneType}
    return next((kind for kind in _TYPES if kinds == {kind}), str)


@dataclass(frozen=True)
class Results:
    """The folder of one campaign, which this process alone writes; see :func:`writing`."""

    folder: Path

    def done(self, again: bool) -> set[str]:
        """Keys of the cases that need not be computed; ``again``: failed ones are."""
        rows = read_results(self.folder, ["key", "ended"]).to_pylist()
        failed = {row["key"] for row in rows if row["ended"] == FAILED and again}
        return {row["key"] for row in rows} - failed

    def add(self, rows: Sequence[Row]) -> None:
        """All rows of some cases; they are on the disk when this returns."""
        (self.folder / _PARTS).mkdir(exist_ok=True)
        path = self.folder / _PARTS / f"{time.time_ns():020d}.parquet"
        _write(path, pa.Table.from_pylist(list(rows), _schema()))

    def join(self) -> None:
        """Makes one file of all."""
        if parts := _parts(self.folder):
            _write(self.folder / _LAPS, read_results(self.folder))
        for part in parts:
            part.unlink()


@contextmanager
def writing(folder: Path) -> Iterator[Results]:
    """The results in a folder, made if there is none; joined before and after the block.

    Raises InputError if another process writes there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            remedy = "wait for its end, or give another folder"
            raise InputError(f"another campaign writes into {folder}: {remedy}") from None
        clear_partials(folder)
        clear_partials(folder / _PARTS)
        results = Results(folder)
        results.join()
        try:
            yield results
        finally:
            results.join()


def read_results(folder: Path, columns: list[str] | None = None) -> pa.Table:
    """All rows in a folder; of a case that was computed again, the last ones.

    Raises InputError for a file that is damaged.
    """
    whole = [folder / _LAPS] if (folder / _LAPS).exists() else []
    tables: list[pa.Table] = []
    seen = pa.array([], pa.string())
    for path in reversed([*whole, *_parts(folder)]):
        try:
            table = pq.read_table(path, columns=columns)
        except (pa.ArrowException, OSError) as error:
            remedy = "remove it, and its rows are computed again"
            raise InputError(f"{path} is no table of a campaign: {error}; {remedy}") from None
        table = table.filter(pc.invert(pc.is_in(table["key"], seen)))
        seen = pa.concat_arrays([seen, *table["key"].chunks])
        tables.insert(0, table)
    if not tables:
        empty = _schema().empty_table()
        return empty if columns is None else empty.select(columns)
    return pa.concat_tables(tables, promote_options="default")


def _parts(folder: Path) -> list[Path]:
    """In the order in which they were written."""
    return sorted((folder / _PARTS).glob("[0-9]*.parquet"))


def _write(path: Path, table: pa.Table) -> None:
    with replacing(path) as partial:
        pq.write_table(table, partial, compression="zstd")
