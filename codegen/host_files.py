"""Racing line, weights and settings as files for controllers that run without Python.

The controller without Python and its FMU load them by controller/host/br_files.c; br_files.h
describes the formats. Being data, they can be exchanged without compiling anything.
"""

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.gp.weights import Weights, pack_weights, zero_weights
from bayesrace.manifest import Manifest

__all__ = [
    "HEAD",
    "IDENTITY_BYTES",
    "PATH_FILE",
    "SETTINGS_FILE",
    "WEIGHTS_FILE",
    "export",
    "packed_weights_file",
    "path_file",
    "settings_file",
    "weights_file",
]

PATH_FILE: Final = "path.bin"
WEIGHTS_FILE: Final = "weights.bin"
SETTINGS_FILE: Final = "settings.txt"

PATH_COLUMNS: Final = 7
"""BR_PATH_COLUMNS in controller/native/bayesrace_mpc.h."""

_LEAST_ROWS: Final = 8

_SCHEMA: Final = 3
HEAD: Final = struct.Struct("<8sIIQQ")
IDENTITY_BYTES: Final = 256
_VERSION_BYTES: Final = 801


def _fnv1a(data: bytes) -> int:
    value = 14695981039346656037
    for byte in data:
        value = (value ^ byte) * 1099511628211 & 0xFFFFFFFFFFFFFFFF
    return value


def _file(magic: bytes, body: bytes, room: int = 0) -> bytes:
    return HEAD.pack(magic, _SCHEMA, len(body), _fnv1a(body), room) + body


def path_file(rows: ArrayLike, spacing_m: float, manifest: Manifest) -> bytes:
    """The file of a racing line: rows (n, 7) of ``br_mpc_set_path``, every ``spacing_m``.

    InputError if they do not fit into the controller of ``manifest``.
    """
    table = np.ascontiguousarray(rows, dtype="<f8")
    if table.ndim != 2 or table.shape[1] != PATH_COLUMNS or len(table) < _LEAST_ROWS:
        raise InputError(
            f"path table has shape {table.shape}, not ({_LEAST_ROWS} or more, {PATH_COLUMNS})"
        )
    manifest.check_rows(len(table))
    if not np.isfinite(table).all():
        raise InputError("path table holds a number that is not finite")
    return _file(b"BRFMPATH", struct.pack("<d", spacing_m) + table.tobytes())


def weights_file(weights: Weights | None, identity: str, capacity: int) -> bytes:
    """The file of the residual's weights; None: no correction.

    ``identity``: of the discretised model that the controller predicts with, ``capacity``: training
    points that it has room for. InputError for weights of another model or with more.
    """
    if weights is None:
        packed, version = pack_weights(zero_weights("none", identity)), ""
    else:
        weights.check_fit(identity, capacity)
        packed, version = pack_weights(weights), weights.version
    return packed_weights_file(packed, version, identity, capacity)


def packed_weights_file(packed: bytes, version: str, identity: str, capacity: int) -> bytes:
    """The same of what :func:`.pack_weights` makes; empty: no correction."""
    if not packed:
        return weights_file(None, identity, capacity)
    words = [(identity, IDENTITY_BYTES), (version, _VERSION_BYTES)]
    if any(len(word.encode()) >= room for word, room in words):
        raise InputError(f"identity or version of weights is too long for their file: {words}")
    head = b"".join(word.encode().ljust(room, b"\0") for word, room in words)
    return _file(b"BRFMGPWT", head + packed, capacity)


def settings_file(values: Mapping[str, float | tuple[float, ...]]) -> str:
    """The file of the settings: parameters of the problem and its solver, of the cycle and of the
    estimator."""
    rows = {name: v if isinstance(v, tuple) else (v,) for name, v in values.items()}
    return "".join(f"{name} {' '.join(map(repr, row))}\n" for name, row in rows.items())


def export(
    folder: Path,
    manifest: Manifest,
    rows: ArrayLike,
    spacing_m: float,
    values: Mapping[str, float | tuple[float, ...]],
    weights: Weights | None,
) -> None:
    """Writes all three files for a built controller; arguments as of the functions above."""
    folder.mkdir(parents=True, exist_ok=True)
    learned = weights_file(weights, manifest.discretisation, manifest.gp_capacity)
    write_whole(folder / PATH_FILE, path_file(rows, spacing_m, manifest))
    write_whole(folder / WEIGHTS_FILE, learned)
    write_whole(folder / SETTINGS_FILE, settings_file(values))
