"""From settings to a loadable controller: generate C, compile, cache by a hash of everything.

The artefact folder holds the library, its manifest and everything it was made from (our C, CasADi's
C, DAQP's headers and static library for this platform, MIT licence), so that it can be rebuilt or
embedded without Python: ``cc -O3 *.c libdaqpstat.a -I. -lm``.
"""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from bayesrace.cpu import cpu_digest, cpu_identity
from bayesrace.errors import InputError
from bayesrace.manifest import ABI, LIBRARY, MANIFEST, Manifest, read_manifest
from bayesrace.vehicles import get_car
from codegen.compiler import FLAGS, Compiler, find_compiler
from codegen.settings import BuildSettings

__all__ = ["NATIVE", "build", "build_hash", "cache_folder", "generate"]

_ROOT: Final = Path(__file__).resolve().parents[1]

NATIVE: Final = _ROOT / "controller" / "native"
"""The hand-written part of the step: read as files, not imported."""

_SHAPED_BY: Final = ("codegen", "bayesrace/vehicles", "bayesrace/integrators.py")


def cache_folder() -> Path:
    """$BAYESRACE_CACHE, else the user's cache folder."""
    chosen = os.environ.get("BAYESRACE_CACHE")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "bayesrace"


def _source_files() -> Iterator[Path]:
    yield from sorted(NATIVE.glob("*.[ch]"))
    for name in _SHAPED_BY:
        path = _ROOT / name
        yield from sorted(path.glob("*.py")) if path.is_dir() else [path]


def _casadi_version() -> str:
    from importlib.metadata import version

    return version("casadi")


def build_hash(settings: BuildSettings, compiler: Compiler) -> str:
    """Identity of the artefact: settings, car, every source file, CasADi, compiler, CPU."""
    digest = hashlib.sha256()
    parts = [
        settings.model_dump_json(),
        get_car(settings.car).model_dump_json(),
        _casadi_version(),
        *compiler.command,
        compiler.version,
        *FLAGS,
        cpu_identity(),
    ]
    for part in parts:
        digest.update(part.encode() + b"\0")
    for path in _source_files():
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def generate(settings: BuildSettings, folder: Path) -> None:
    """Writes br_model.c, br_model.h and br_config.h into ``folder``."""
    import casadi as ca

    from bayesrace.vehicles.models import MODELS
    from codegen.stage import advance_function, linearise_function

    model = MODELS[settings.model](get_car(settings.car))
    # CasADi derives the include guard from the name and writes into the working folder
    generator = ca.CodeGenerator(
        "br_model.c", {"with_header": True, "casadi_int": "int", "with_export": False}
    )
    generator.add(linearise_function(model, settings.discretisation))
    generator.add(advance_function(model, settings.discretisation))
    generator.generate(str(folder) + os.sep)
    (folder / "br_config.h").write_text(
        "/* generated: dimensions of this controller */\n"
        "#ifndef BR_CONFIG_H\n#define BR_CONFIG_H\n"
        f"#define BR_N {settings.horizon}\n"
        f"#define BR_TS {settings.discretisation.step_s!r}\n"
        f"#define BR_GP_CAPACITY {settings.gp_capacity}\n"
        f'#define BR_MODEL_NAME "{settings.model}"\n'
        "#endif\n"
    )


def casadi_includes() -> tuple[Path, Path]:
    """Include folder of the CasADi wheel and its static DAQP library."""
    import casadi as ca

    package = Path(ca.__file__).parent
    return package / "include", package / "libdaqpstat.a"


def _compile(settings: BuildSettings, compiler: Compiler, folder: Path) -> None:
    include, daqp = casadi_includes()
    generate(settings, folder)
    for path in NATIVE.glob("*.[ch]"):
        shutil.copy(path, folder)
    shutil.copytree(include / "daqp", folder / "daqp")
    # its licence wants to go where its code goes
    shutil.copy(include / "licenses" / "daqp-external" / "LICENSE", folder / "daqp")
    shutil.copy(daqp, folder)
    compiler.shared_library(
        sorted(folder.glob("*.c")), [folder], [folder / daqp.name], folder / LIBRARY
    )


def build(
    settings: BuildSettings, progress: Callable[[str], None] = lambda _: None
) -> tuple[Path, Manifest]:
    """Artefact folder and manifest of the controller; from the cache if it is there.

    Raises CompileError with the compiler's own words, InputError if there is no compiler.
    """
    compiler = find_compiler()
    identity = build_hash(settings, compiler)
    target = cache_folder() / f"{settings.model}-{identity}"
    if (target / MANIFEST).is_file():
        try:
            manifest = read_manifest(target)
        except InputError:  # damaged: build it again
            shutil.rmtree(target, ignore_errors=True)
        else:
            progress(f"{settings.model}: cached")
            return target, manifest
    progress(f"{settings.model}: generating and compiling")
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".build-") as temporary:
        folder = Path(temporary) / "artefact"
        folder.mkdir()
        _compile(settings, compiler, folder)
        manifest = Manifest(
            abi=ABI,
            model=settings.model,
            car=settings.car,
            car_digest=get_car(settings.car).digest(),
            discretisation=settings.discretisation.identity(settings.model, get_car(settings.car)),
            horizon=settings.horizon,
            step_s=settings.discretisation.step_s,
            gp_capacity=settings.gp_capacity,
            casadi=_casadi_version(),
            compiler=compiler.version,
            cpu=cpu_digest(),
            flags=list(FLAGS),
            build_hash=identity,
            library_sha256=hashlib.sha256((folder / LIBRARY).read_bytes()).hexdigest(),
        )
        (folder / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n")
        _install(folder, target)
    return target, manifest


def _install(folder: Path, target: Path) -> None:
    """Moves the finished folder into place; a concurrent build of the same hash may win."""
    try:
        folder.rename(target)
    except OSError:
        if not (target / MANIFEST).is_file():
            shutil.rmtree(target, ignore_errors=True)
            folder.rename(target)
