"""From settings to a loadable controller: generate C, compile, cache by a hash of everything.

The artefact folder holds the library, what its headers declare in the form that Python reads, the
manifest, and everything it was made from (our C, CasADi's C, DAQP's headers and its static library
for this platform or its C, MIT licence), so that it can be rebuilt or embedded without Python:
``cc -O3 *.c libdaqpstat.a -I. -lm``, or ``cc -O3 *.c daqp/*.c -I. -lm``. Its folder ``host`` has
the C of a program that hosts it: loop, messages, links, files of line, weights and settings.
"""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bayesrace.cache import code_folder, digest, kept, locked, note_use, software
from bayesrace.codegen.compiler import FLAGS, Compiler, find_compiler
from bayesrace.codegen.daqp import HOW_TO_GET, unpack_sources
from bayesrace.codegen.messages import messages_header
from bayesrace.codegen.platforms import Platform, host_platform
from bayesrace.codegen.settings import BuildSettings
from bayesrace.errors import InputError
from bayesrace.files import read_whole
from bayesrace.integrators import PERFECT, PREDICTION
from bayesrace.manifest import (
    DECLARATIONS,
    LIBRARY,
    MANIFEST,
    Manifest,
    ParameterInfo,
    ProblemInfo,
    interface_version,
    opened_library,
    read_manifest,
    runs_here,
)
from bayesrace.trusted_files import trusted
from bayesrace.vehicles import Car, get_car

if TYPE_CHECKING:
    from bayesrace.codegen.problems.problem import Problem

__all__ = [
    "HOST",
    "NATIVE",
    "PROGRAM",
    "archives_of",
    "artefact_compiler",
    "build",
    "build_hash",
    "casadi_includes",
    "checking_artefact",
    "generate",
    "host_program",
    "problem_of",
    "write_sizes",
]

NATIVE: Final = Path(__file__).parents[1] / "controller" / "native"
"""The hand-written part of the step: read as files, not imported."""

DAQP_ARCHIVE: Final = "libdaqpstat.a"
"""DAQP of CasADi's wheel, in an artefact without DAQP's C."""

HOST: Final = "host"
"""Folder of the C that is for hosts, and no part of the library."""

PROGRAM: Final = "bayesrace-controller"
"""The controller without Python: :func:`host_program`."""

_MODE: Final = 0o755
"""Of the files that are loaded: the umask may allow more, and files that others may write are
refused."""

_SHAPED_BY: Final = (
    "controller/native",
    "controller/host",
    "messages",
    "codegen",
    "codegen/problems",
    "vehicles",
    "integrators.py",
)


def build_hash(
    settings: BuildSettings,
    compiler: Compiler,
    problem: "Problem | None" = None,
    daqp: Path | None = None,
) -> str:
    """Identity of the artefact: settings, car, every source file, CasADi, compiler.

    Of a problem that no source file here describes, its header and functions, too.
    """
    return digest(
        [
            *_identity_of(problem),
            *([] if daqp is None else [read_whole(daqp, "DAQP")]),
            settings.model_dump_json(),
            get_car(settings.car).model_dump_json(),
            *compiler.command,
            compiler.version,
            *FLAGS,
            *software(_SHAPED_BY, ("casadi", "cffi")),
        ]
    )


def _identity_of(problem: "Problem | None") -> list[str]:
    if problem is None:
        return []
    from bayesrace.codegen.problems.generate import c_header, functions

    return [c_header(problem), *(one.serialize() for one in functions(problem))]


def problem_of(settings: BuildSettings) -> "Problem":
    """The control problem that these settings name."""
    from bayesrace.codegen.problems.progress import progress
    from bayesrace.codegen.problems.tracking import tracking
    from bayesrace.vehicles.models import MODELS

    make = {"tracking": tracking, "progress": progress}[settings.problem]
    return make(MODELS[settings.model](get_car(settings.car)), settings.discretisation)


def generate(problem: "Problem", settings: BuildSettings, folder: Path) -> None:
    """Writes br_model.c, br_model.h, br_config.h and br_problem.h into a folder."""
    import casadi as ca

    from bayesrace.codegen.problems.generate import functions

    # CasADi derives the include guard from the name and writes into the working folder
    generator = ca.CodeGenerator(
        "br_model.c", {"with_header": True, "casadi_int": "int", "with_export": False}
    )
    for function in functions(problem):
        generator.add(function)
    generator.generate(str(folder) + os.sep)
    write_sizes(problem, settings, folder)


def write_sizes(problem: "Problem", settings: BuildSettings, folder: Path) -> None:
    """Writes br_config.h and br_problem.h alone, by which the memory of a controller is known."""
    from bayesrace.codegen.problems.generate import c_header

    (folder / "br_problem.h").write_text(c_header(problem))
    free, block = settings.blocks
    (folder / "br_config.h").write_text(
        "/* generated: dimensions of this controller */\n"
        "#ifndef BR_CONFIG_H\n#define BR_CONFIG_H\n"
        f"#define BR_N {settings.stages}\n"
        f"#define BR_FREE {free}\n"
        f"#define BR_BLOCK {block}\n"
        f"#define BR_TS {settings.discretisation.step_s!r}\n"
        f"#define BR_GP_CAPACITY {settings.gp_capacity}\n"
        f"#define BR_PATH_CAPACITY {settings.path_rows}\n"
        f"#define BR_WEIGHT_BUFFERS {settings.weight_buffers}\n"
        f"#define BR_HAS_ESTIMATOR {settings.estimator:d}\n"
        f"#define BR_ABI {interface_version()}\n"
        f'#define BR_MODEL_IDENTITY "{_model_identity(settings)}"\n'
        "#endif\n"
    )


def _model_identity(settings: BuildSettings) -> str:
    """Of the discretised model, as weights name it."""
    return settings.discretisation.identity(settings.model, get_car(settings.car))


def casadi_includes() -> tuple[Path, Path]:
    """Include folder of the CasADi wheel and its static DAQP library."""
    import casadi as ca

    package = Path(ca.__file__).parent
    return package / "include", package / DAQP_ARCHIVE


def _compile(
    problem: "Problem", settings: BuildSettings, compiler: Compiler, daqp: Path | None, folder: Path
) -> None:
    """Everything of an artefact but its manifest, into an empty folder."""
    include, archive = casadi_includes()
    generate(problem, settings, folder)
    for path in NATIVE.glob("*.[ch]"):
        shutil.copy(path, folder)
    shutil.copytree(NATIVE.parent / HOST, folder / HOST)
    (folder / HOST / "br_messages.h").write_text(messages_header())
    shutil.copytree(include / "daqp", folder / "daqp")
    # its licence wants to go where its code goes
    shutil.copy(include / "licenses" / "daqp-external" / "LICENSE", folder / "daqp")
    if daqp is None:
        shutil.copy(archive, folder)
    else:
        unpack_sources(daqp, folder / "daqp")
    (folder / LIBRARY).write_bytes(_library(compiler, folder))
    _write_declarations(compiler, folder)


def _write_declarations(compiler: Compiler, folder: Path) -> None:
    """Writes what the headers declare in cffi's own form, which it reads within a millisecond; to
    parse C takes it a hundred."""
    from cffi import FFI
    from cffi.recompiler import make_py_source

    with tempfile.TemporaryDirectory() as temporary:
        empty = Path(temporary)
        for name in ("stddef.h", "stdint.h"):  # cffi knows their types
            (empty / name).touch()
        text = empty / "interface.i"
        includes = ("-nostdinc", f"-I{empty}", f"-I{folder}")
        header = folder / "bayesrace_cycle.h"
        compiler.run("-E", "-P", "-DBR_API=", *includes, header, "-o", text)
        ffi = FFI()
        ffi.cdef(text.read_text())
        make_py_source(ffi, Path(DECLARATIONS).stem, str(folder / DECLARATIONS))


def _library(compiler: Compiler, folder: Path) -> bytes:
    """The library of the sources in a folder; compiled once for all cars that share them, such as
    those that differ in weights, margins or friction alone."""
    return _compiled("library", compiler.shared_library, compiler, folder)


def archives_of(artefact: Path) -> list[Path]:
    """What is linked with an artefact's C on this machine; none where DAQP's C is part of it."""
    archive = artefact / DAQP_ARCHIVE
    return [archive] if archive.exists() else []


def host_program(artefact: Path, compiler: Compiler) -> bytes:
    """The executable of ``controller/host`` with the artefact's controller linked in."""
    return _compiled("host", compiler.program, compiler, artefact, artefact / HOST)


def _compiled(
    what: str, link: Callable[[list[Path], list[Path], list[Path], Path], None],
    compiler: Compiler, folder: Path, *more: Path,
) -> bytes:  # fmt: skip
    """What ``link`` makes of the sources of an artefact's folder and of others; from the cache if
    it is there."""
    archives, folders = archives_of(folder), [folder, *more]
    sources = sorted(one for each in (*folders, folder / "daqp") for one in each.glob("*.c"))
    files = sorted((*folder.rglob("*.[ch]"), *archives))
    named = (part for file in files for part in (file.name, file.read_bytes()))
    identity = digest((*compiler.command, compiler.version, *FLAGS, *named))

    def make(path: Path) -> None:
        link(sources, folders, archives, path)
        data = path.read_bytes()
        path.write_bytes(hashlib.sha256(data).digest() + data)

    return kept(code_folder() / f"{what}-{identity}", make, _read_sealed)


def _read_sealed(path: Path) -> bytes:
    """What is behind its SHA-256; InputError if it is absent, damaged or another user's."""
    try:
        data = trusted(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    seal, code = data[:32], data[32:]
    if hashlib.sha256(code).digest() != seal:
        raise InputError(f"{path} is damaged")
    return code


def build(
    settings: BuildSettings,
    progress: Callable[[str], None] = lambda _: None,
    problem: "Problem | None" = None,
    platform: Platform | None = None,
    daqp: Path | None = None,
    compiler: Compiler | None = None,
) -> tuple[Path, Manifest]:
    """Artefact folder and manifest of the controller; from the cache if it is there.

    ``problem``: one of your own, with the step of ``settings.discretisation``; that of the
    settings without. ``platform``: what it is to run on (None: this machine), by the compiler that
    ``CC`` names or else by ziglang. ``daqp``: DAQP's source distribution in place of the static
    library that CasADi's wheel has, which is for this machine alone. ``compiler``: in place of
    these.
    Raises CompileError with the compiler's own words, InputError if there is no compiler.
    """
    cache = code_folder()
    compiler = compiler or artefact_compiler(platform, daqp)
    identity = build_hash(settings, compiler, problem, daqp)
    name = problem.name if problem else f"{settings.problem}-{settings.model}"
    target = cache / f"{name}-{identity}"

    def built() -> tuple[Path, Manifest] | None:
        """What the cache has; None if it is absent, damaged, or another user's."""
        try:
            manifest = read_manifest(target)
            with opened_library(target, manifest):
                pass
        except InputError:
            return None
        progress(f"{name}: cached")
        note_use(made=False)
        return target, manifest

    if found := built():
        return found
    with locked(target):
        if found := built():  # by another process, meanwhile
            return found
        progress(f"{name}: generating and compiling")
        _clear(target)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=_partial(target)) as temporary:
            folder = Path(temporary) / "artefact"
            folder.mkdir()
            problem = problem or problem_of(settings)
            _compile(problem, settings, compiler, daqp, folder)
            if platform is not None:
                platform.check(folder / LIBRARY, compiler)
            manifest = _manifest(problem, settings, compiler, identity, folder)
            (folder / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n")
            for one in (folder, *(folder / name for name in (LIBRARY, DECLARATIONS, MANIFEST))):
                one.chmod(_MODE)
            folder.rename(target)
    note_use(made=True)
    return target, manifest


def checking_artefact(artefact: Path, car: Car) -> Path:
    """A controller of this machine to check weights by: itself, or where it is for another platform
    one that predicts alike.

    InputError where it is of another release or car.
    """
    wanted = read_manifest(artefact)
    wanted.check_car(car, artefact)
    if runs_here(artefact):
        return artefact
    discretisation = PERFECT if wanted.model == "dynamic" else PREDICTION
    settings = BuildSettings.model_validate(
        {
            "car": car, "model": wanted.model, "problem": wanted.problem.name,
            "discretisation": discretisation, "horizon": wanted.horizon,
            "gp_capacity": wanted.gp_capacity,
        }
    )  # fmt: skip
    folder, made = build(settings, compiler=find_compiler(by_name=True))
    if made.discretisation != wanted.discretisation:
        raise InputError(f"{artefact} predicts otherwise than what is built now: build it again")
    return folder


def artefact_compiler(platform: Platform | None, daqp: Path | None) -> Compiler:
    """What builds for a platform, this machine's own by default."""
    if platform is None or platform == host_platform():
        return find_compiler()
    if not platform.machine:
        raise InputError(f"controllers are built for Linux, not for {platform.name}")
    if daqp is None:
        raise InputError(f"for {platform.name}, DAQP's C is missing: {HOW_TO_GET}")
    return find_compiler() if os.environ.get("CC") else platform.compiler()


def _partial(target: Path) -> str:
    """How the folders begin in which this artefact, and no other, is built."""
    return f".{target.name}-"


def _clear(target: Path) -> None:
    """Removes the artefact, and what killed builds of it have left; with its lock.

    InputError if it cannot be removed.
    """
    try:
        for old in (target, *target.parent.glob(f"{_partial(target)}*")):
            if old.exists():
                shutil.rmtree(old)
    except OSError as error:
        raise InputError(
            f"{target} is not usable and cannot be replaced ({error.strerror}): remove it, or set "
            "BAYESRACE_CACHE to a folder of yours"
        ) from None


def _manifest(
    problem: "Problem", settings: BuildSettings, compiler: Compiler, identity: str, folder: Path
) -> Manifest:
    """What the compiled controller in the folder is."""
    car = get_car(settings.car)
    return Manifest(
        abi=interface_version(),
        problem=ProblemInfo(
            name=problem.name,
            states=[one.name for one in problem.states],
            inputs=[one.name for one in problem.inputs],
            stage_parameters=[one.name for one in problem.stage_parameters],
            parameters=[ParameterInfo(**asdict(one)) for one in problem.parameters],
            features=list(problem.features),
            outputs=problem.outputs,
            follows_path=bool(problem.path),
        ),
        model=settings.model,
        car=car.name,
        car_digest=car.digest(),
        discretisation=_model_identity(settings),
        horizon=settings.stages,
        step_s=settings.discretisation.step_s,
        gp_capacity=settings.gp_capacity,
        path_rows=settings.path_rows,
        weight_buffers=settings.weight_buffers,
        estimator=settings.estimator,
        casadi=version("casadi"),
        compiler=compiler.version,
        flags=list(FLAGS),
        build_hash=identity,
        library_sha256=hashlib.sha256((folder / LIBRARY).read_bytes()).hexdigest(),
        interface_sha256=hashlib.sha256((folder / DECLARATIONS).read_bytes()).hexdigest(),
    )
