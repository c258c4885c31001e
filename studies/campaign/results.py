"""The results of a campaign: a folder of Parquet, one row a lap, safe against kills.

What workers return at once is written as a small file of its own, whole or not at all. When a
campaign begins or ends, all of them become one, ``laps.parquet``.
"""

import fcntl
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import NoneType
from typing import Any, Final, get_args

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic.fields import FieldInfo

from bayesrace.errors import InputError
from bayesrace.files import clear_partials, replacing
from studies.campaign.case import factors
from studies.campaign.execute import FAILED, Row

__all__ = ["LAPS", "Results", "read_results"]

LAPS: Final = "laps.parquet"
_PARTS: Final = "parts"
_SUFFIX: Final = ".parquet"


def _type(field: FieldInfo) -> pa.DataType:
    form: Any = field.annotation
    kinds = {one for one in get_args(form) or (form,) if one is not NoneType}
    numbers = {bool: pa.bool_(), int: pa.int64(), float: pa.float64()}
    return next((one for kind, one in numbers.items() if kinds == {kind}), pa.string())


def _schema() -> pa.Schema:
    text, number, count = pa.string(), pa.float64(), pa.int64()
    return pa.schema(
        [
            ("key", text),
            *((name, _type(field)) for name, field in factors().items()),
            *(
                (name, text)
                for name in ("controller", "car_identity", "weights", "software", "cpu")
            ),
            ("lap", count),
            ("lap_time_s", number),
            ("samples", count),
            ("off_track_samples", count),
            ("off_track_max_m", number),
            ("fallbacks", count),
            ("ended", text),
            ("reason", text),
            ("trajectory_sha256", text),
            *((name, number) for name in ("step_p50_us", "step_p99_us", "step_max_us")),
            *((name, number) for name in ("simulated_s", "drive_s", "case_s")),
            ("host", text),
            ("settings", text),
        ]
    )


MEASURED: Final = (
    "step_p50_us", "step_p99_us", "step_max_us", "drive_s", "case_s", "host",
)  # fmt: skip
"""Columns that differ from machine to machine and from time to time; all others do not."""


class Results:
    """The folder of one campaign, which this process alone writes."""

    def __init__(self, folder: Path) -> None:
        """``folder`` exists; see :func:`writing`."""
        self._folder = folder

    def done(self, again: bool) -> set[str]:
        """Keys of the cases that need not be computed; ``again``: failed ones are."""
        table = read_results(self._folder, ["key", "ended"])
        keys = set(table["key"].to_pylist())
        if again:
            failed = table.filter(pc.equal(table["ended"], FAILED))
            keys -= set(failed["key"].to_pylist())
        return keys

    def add(self, rows: Sequence[Row]) -> None:
        """All rows of some cases; they are on the disk when this returns."""
        if not rows:
            return
        folder = self._folder / _PARTS
        folder.mkdir(exist_ok=True)
        table = pa.Table.from_pylist(rows, _schema())
        _write(folder / f"{time.time_ns():020d}{_SUFFIX}", table)

    def join(self) -> None:
        """Makes one file of all."""
        parts = _parts(self._folder)
        if not parts:
            return
        _write(self._folder / LAPS, read_results(self._folder))
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
            raise InputError(
                f"another campaign writes into {folder}: wait for its end, or give another folder"
            ) from None
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
    whole = [folder / LAPS] if (folder / LAPS).exists() else []
    tables: list[pa.Table] = []
    seen = pa.array([], pa.string())
    for path in reversed([*whole, *_parts(folder)]):
        try:
            table = pq.read_table(path, columns=columns)
        except (pa.ArrowException, OSError) as error:
            raise InputError(
                f"{path} is no table of a campaign: {error}; remove it, and its rows are computed "
                "again"
            ) from None
        table = table.filter(pc.invert(pc.is_in(table["key"], seen)))
        seen = pa.concat_arrays([seen, *table["key"].chunks])
        tables.append(table)
    if not tables:
        schema = _schema()
        return (schema if columns is None else pa.schema(map(schema.field, columns))).empty_table()
    return pa.concat_tables(reversed(tables), promote_options="default")


def _parts(folder: Path) -> list[Path]:
    """In the order in which they were written."""
    return sorted((folder / _PARTS).glob(f"[0-9]*{_SUFFIX}"))


def _write(path: Path, table: pa.Table) -> None:
    with replacing(path) as partial:
        pq.write_table(table, partial, compression="zstd")
