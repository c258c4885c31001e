"""Racing line and weights as the files that the controller's FMU loads when it is instantiated.

The format is described in ``native/controller_resources.h``. Being data, they can be exchanged in
the archive without compiling anything: :func:`exchange_weights`.
"""

import struct
import zipfile
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from bayesrace.errors import InputError
from bayesrace.files import replacing
from bayesrace.gp.weights import KERNELS, GpWeights, zero_weights

__all__ = ["PATH_FILE", "WEIGHTS_FILE", "exchange_weights", "path_resource", "weights_resource"]

PATH_FILE: Final = "path.bin"
WEIGHTS_FILE: Final = "weights.bin"

PATH_COLUMNS: Final = 7
"""BR_PATH_COLUMNS in controller/native/bayesrace_mpc.h."""

PATH_CAPACITY: Final = 8192
"""BR_PATH_CAPACITY there."""

_SCHEMA: Final = 1
_HEAD: Final = struct.Struct("<8sIIQQ")
_IDENTITY_BYTES: Final = 256


def _fnv1a(data: bytes) -> int:
    value = 14695981039346656037
    for byte in data:
        value = (value ^ byte) * 1099511628211 & 0xFFFFFFFFFFFFFFFF
    return value


def _file(magic: bytes, body: bytes, room: int = 0) -> bytes:
    return _HEAD.pack(magic, _SCHEMA, len(body), _fnv1a(body), room) + body


def path_resource(rows: ArrayLike, spacing_m: float) -> bytes:
    """The file of a racing line: rows (n, 7) of ``br_mpc_set_path``, every ``spacing_m``."""
    table = np.ascontiguousarray(rows, dtype="<f8")
    if table.ndim != 2 or table.shape[1] != PATH_COLUMNS or not 8 <= len(table) <= PATH_CAPACITY:
        raise InputError(
            f"path table has shape {table.shape}, not (8 to {PATH_CAPACITY}, {PATH_COLUMNS})"
        )
    if not np.isfinite(table).all():
        raise InputError("path table holds a number that is not finite")
    return _file(b"BRFMPATH", struct.pack("<d", spacing_m) + table.tobytes())


def weights_resource(weights: GpWeights | None, identity: str, capacity: int) -> bytes:
    """The file of the residual's weights; None: no correction.

    ``identity``: of the discretised model that the controller predicts with, ``capacity``: training
    points that it has room for. InputError for weights of another model or with more.
    """
    if weights is None:
        weights = zero_weights("none", identity)
    if weights.discretisation != identity:
        raise InputError(
            f"weights '{weights.version}' were learned for {weights.discretisation}, this "
            f"controller predicts with {identity}: train with the same car and discretisation"
        )
    if max(weights.counts) > capacity:
        raise InputError(
            f"weights '{weights.version}' have {max(weights.counts)} points, the controller was "
            f"built for {capacity}: train with fewer points or build with a larger capacity"
        )
    name = identity.encode()
    if len(name) >= _IDENTITY_BYTES:
        raise InputError(f"the model's identity '{identity}' is too long for a weights file")
    parts = [name.ljust(_IDENTITY_BYTES, b"\0")]
    for output in weights.outputs:
        scale = output.y_scale * output.signal_variance
        kernel = KERNELS.index(output.kernel)
        parts.append(struct.pack("<IIdd", kernel, output.count, output.y_mean, scale))
        numbers = (output.length_scales, output.inputs, output.alpha)
        parts += [np.ascontiguousarray(array, dtype="<f8").tobytes() for array in numbers]
    return _file(b"BRFMGPWT", b"".join(parts), capacity)


def exchange_weights(fmu: Path, weights: GpWeights | None, out: Path) -> None:
    """Writes ``fmu``, a controller's, with other weights to ``out`` (which may be ``fmu``).

    InputError if ``fmu`` is no controller's FMU, or the weights are for another model or have more
    points than the controller has room for.
    """
    name = f"resources/{WEIGHTS_FILE}"
    try:
        with zipfile.ZipFile(fmu) as archive:
            members = [(info, archive.read(info)) for info in archive.infolist()]
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(f"{fmu} cannot be read as an FMU: {error}") from None
    before = next((data for info, data in members if info.filename == name), None)
    if before is None:
        raise InputError(f"{fmu} is not a controller's FMU: it holds no {name}")
    if len(before) < _HEAD.size + _IDENTITY_BYTES:
        raise InputError(f"{fmu}: {name} is cut off; export the FMU again")
    capacity = _HEAD.unpack_from(before)[4]
    identity = before[_HEAD.size :][:_IDENTITY_BYTES].rstrip(b"\0").decode("utf-8", "replace")
    data = weights_resource(weights, identity, capacity)
    with replacing(out) as partial, zipfile.ZipFile(partial, "w") as archive:
        for info, content in members:
            archive.writestr(info, data if info.filename == name else content)
