"""Other weights for a controller's FMU, without compiling anything."""

import zipfile
import zlib
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.files import replacing
from bayesrace.gp.weights import GpWeights
from codegen.host_files import HEAD, IDENTITY_BYTES, WEIGHTS_FILE, weights_file

__all__ = ["exchange_weights"]

_LARGEST: Final = 1 << 30


def exchange_weights(fmu: Path, weights: GpWeights | None, out: Path) -> None:
    """Writes ``fmu``, a controller's, with other weights to ``out`` (which may be ``fmu``).

    InputError if ``fmu`` is no controller's FMU, or the weights are for another model or have more
    points than the controller has room for.
    """
    name = f"resources/{WEIGHTS_FILE}"
    try:
        with zipfile.ZipFile(fmu) as archive:
            size = sum(info.file_size for info in archive.infolist())
            if size > _LARGEST:
                raise InputError(f"{fmu} would unpack to {size >> 20} MB: no FMU of a controller")
            members = {info: archive.read(info) for info in archive.infolist()}
    except (OSError, RuntimeError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise InputError(f"{fmu} cannot be read as an FMU: {error}") from None
    before = next((data for info, data in members.items() if info.filename == name), None)
    if before is None:
        raise InputError(f"{fmu} is not a controller's FMU: it holds no {name}")
    if len(before) < HEAD.size + IDENTITY_BYTES:
        raise InputError(f"{fmu}: {name} is cut off; export the FMU again")
    capacity = HEAD.unpack_from(before)[4]
    identity = before[HEAD.size :][:IDENTITY_BYTES].rstrip(b"\0").decode("utf-8", "replace")
    data = weights_file(weights, identity, capacity)
    with replacing(out) as partial, zipfile.ZipFile(partial, "w") as archive:
        for info, content in members.items():
            archive.writestr(info, data if info.filename == name else content)
