"""Code generation: the cache's hash sees everything, what cannot be built or loaded is reported."""

import hashlib
import io
import os
import re
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, cast

import casadi as ca
import numpy as np
import pytest

import bayesrace.cache as cache_module
import bayesrace.codegen.build as build_module
from bayesrace.cache import cache_folder
from bayesrace.codegen.build import build, build_hash, checking_artefact, generate
from bayesrace.codegen.compiler import FLAGS, CompileError, Compiler, find_compiler
from bayesrace.codegen.platforms import get_platform, host_platform
from bayesrace.codegen.problems.driving import linearise_function
from bayesrace.codegen.problems.problem import Problem
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.driver import (
    Level,
    Phase,
)
from bayesrace.controller.native_step import Artefact, NativeStep, Status
from bayesrace.controller.settings import SAMPLES, WATCHED, MpcSettings
from bayesrace.errors import InputError
from bayesrace.integrators import PERFECT, PREDICTION, Discretisation
from bayesrace.manifest import (
    DECLARATIONS,
    LIBRARY,
    MANIFEST,
    Manifest,
    opened_library,
    read_manifest,
    runs_here,
)
from bayesrace.messages.types import BRAKING_ROWS, SENSOR_FAULTS
from bayesrace.operation.cli import export
from bayesrace.processes import RUN_MODULE
from bayesrace.vehicles import Car, get_car
from bayesrace.vehicles.models import MODELS

SMALL = BuildSettings(
    horizon=3, gp_capacity=8, discretisation=Discretisation(scheme="euler", pose="integrated")
)


@pytest.fixture(autouse=True)
def _fresh_compiler_search() -> Iterator[None]:
    find_compiler.cache_clear()
    yield
    find_compiler.cache_clear()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, filled by a compiler that does not optimise, which is what takes its time."""
    quick = tuple(flag for flag in FLAGS if flag != "-O3")
    _, exports = cast("tuple[Any, str]", Compiler.shared_library.__defaults__)
    monkeypatch.setattr(Compiler.shared_library, "__defaults__", (quick, exports))
    monkeypatch.setenv("BAYESRACE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def contents(cache: Path) -> list[Path]:
    """What the cache holds, but for its locks, the compilers that work and compiled libraries."""
    others = (".locks", ".compilers")
    return [
        path
        for path in cache.iterdir()
        if path.name not in others and not path.name.startswith("library-")
    ]


@pytest.fixture
def artefact(kinematic_artefact: Path, tmp_path: Path) -> Path:
    """A copy that may be damaged."""
    return Path(shutil.copytree(kinematic_artefact, tmp_path / "copy"))


def test_the_second_build_comes_from_the_cache(cache: Path) -> None:
    first_words: list[str] = []
    second_words: list[str] = []
    folder, manifest = build(SMALL, first_words.append)
    library = (folder / LIBRARY).stat()
    again, same = build(SMALL, second_words.append)
    assert (folder, manifest) == (again, same)
    assert "compiling" in first_words[0]
    assert "cached" in second_words[0]
    assert (again / LIBRARY).stat().st_mtime_ns == library.st_mtime_ns
    assert folder.parent == cache == cache_folder()
    assert contents(cache) == [folder]  # nothing temporary is left


def test_the_horizon_is_the_cars_unless_it_is_stated(car: Car) -> None:
    objective = car.tuning.objective.model_copy(update={"horizon": 12})
    tuning = car.tuning.model_copy(update={"objective": objective})
    short = car.model_copy(update={"tuning": tuning})
    assert BuildSettings(car=short).stages == BuildSettings.best_case(short).stages == 12
    assert BuildSettings(car=short, horizon=10).stages == 10


def test_the_artefact_describes_itself(kinematic_artefact: Path, car: Car) -> None:
    manifest = read_manifest(kinematic_artefact)
    settings = BuildSettings()
    assert manifest.discretisation == settings.discretisation.identity("e_kinematic", car)
    assert (manifest.horizon, manifest.step_s) == (settings.stages, 0.02)
    assert manifest.gp_capacity == settings.gp_capacity
    assert manifest.car == car.name
    assert find_compiler().version == manifest.compiler
    for name in ("br_model.c", "br_config.h", "bayesrace_mpc.h", "br_sqp.c"):
        assert (kinematic_artefact / name).is_file()


@pytest.mark.parametrize(
    "change",
    [
        {"model": "dynamic"},
        {"horizon": 21},
        {"gp_capacity": 1025},
        {"discretisation": PERFECT},
        {"discretisation": PREDICTION.model_copy(update={"step_s": 0.021})},
        {"discretisation": PREDICTION.model_copy(update={"substeps": 2})},
        {"discretisation": PREDICTION.model_copy(update={"scheme": "heun"})},
    ],
)
def test_the_hash_changes_with_every_setting(change: dict[str, object]) -> None:
    compiler = find_compiler()
    ours = build_hash(BuildSettings(), compiler)
    assert build_hash(BuildSettings().model_copy(update=change), compiler) != ours


def test_the_hash_changes_with_compiler_flags_casadi_car_and_sources(
    monkeypatch: pytest.MonkeyPatch, car: Car
) -> None:
    compiler, settings = find_compiler(), BuildSettings()
    seen = {build_hash(settings, compiler)}
    source = next(build_module.NATIVE.glob("br_sqp.c"))
    read = Path.read_bytes
    heavier = car.model_copy(update={"mass_kg": 0.05})
    changes: tuple[tuple[object, str, object], ...] = (
        (build_module, "FLAGS", ("-O0",)),
        (build_module, "get_car", lambda _: heavier),
        (cache_module, "version", lambda _: "9.9"),
        (Path, "read_bytes", lambda p: read(p) + (b" " if p == source else b"")),
    )
    for where, name, value in changes:
        with monkeypatch.context() as patch:
            patch.setattr(where, name, value)
            seen.add(build_hash(settings, compiler))
    seen.add(build_hash(settings, Compiler(("othercc",), compiler.version)))
    seen.add(build_hash(settings, Compiler(compiler.command, "version 99")))
    assert len(seen) == 1 + len(changes) + 2
    assert build_hash(settings, compiler) in seen


@pytest.mark.parametrize(
    ("name", "discretisation"),
    [("e_kinematic", PREDICTION), ("dynamic", PERFECT), ("dynamic", PREDICTION)],
)
def test_the_chain_rule_gives_the_derivatives_of_the_whole(
    car: Car, name: str, discretisation: Discretisation
) -> None:
    """(F, J', H) of the stage function against CasADi's own derivatives of corrected(x, u, e)."""
    model = MODELS[name](car)
    stage = linearise_function(model, discretisation)
    whole = discretisation.corrected(model)
    w, lam = ca.MX.sym("w", 12), ca.MX.sym("lam", 7)
    x_next = whole(w[:7], w[7:9], w[9:])
    jacobian = ca.jacobian(x_next, w)
    hessian = ca.hessian(ca.dot(lam, x_next), w)[0]
    oracle = ca.Function("oracle", [w, lam], [x_next, jacobian.T, hessian])
    random = np.random.default_rng(0)
    for _ in range(5):
        at = np.array([0, 0, 0.3, 1.8, 0.1, 1, 0.1, 0.5, 1, 0.01, 0.02, 0.1])
        at += 0.1 * random.normal(size=12)
        costate = random.normal(size=7)
        ours = stage(at[:7], at[7:9], at[9:], costate)
        for a, b in zip(ours, oracle(at, costate), strict=True):
            expected = np.asarray(ca.densify(b))
            size = np.abs(expected).max()
            np.testing.assert_allclose(np.asarray(a), expected, rtol=0, atol=1e-12 * size)


def test_cars_that_differ_in_tuning_alone_share_a_library(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiling is what takes the time; a damaged library is compiled again."""
    compiled: list[Path] = []
    shared_library = Compiler.shared_library

    def counted(compiler: Compiler, sources: list[Path], *rest: Any) -> None:
        compiled.append(sources[0])
        shared_library(compiler, sources, *rest)

    monkeypatch.setattr(Compiler, "shared_library", counted)
    own = get_car(SMALL.car)
    folders = [
        build(SMALL.model_copy(update={"car": own.model_copy(update={"friction": friction})}))[0]
        for friction in (0.7, 0.8)
    ]
    assert len({*folders}) == 2
    assert len(compiled) == 1
    (library,) = cache.glob("library-*")
    _cut(library)
    build(SMALL.model_copy(update={"car": own.model_copy(update={"friction": 0.9})}))
    assert len(compiled) == 2


def test_a_compile_error_comes_with_the_compilers_words(tmp_path: Path) -> None:
    """Whatever their encoding."""
    source = tmp_path / "wrong.c"
    source.write_bytes(b'#pragma message("\xfc")\nint main(void) { return undeclared_thing; }\n')
    with pytest.raises(CompileError, match="undeclared_thing"):
        find_compiler().shared_library([source], [], [], tmp_path / "out.so")


def test_a_failed_build_leaves_nothing_in_the_cache(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(problem: Problem, settings: BuildSettings, folder: Path) -> None:
        generate(problem, settings, folder)
        (folder / "br_model.h").write_text("#error broken on purpose\n")

    monkeypatch.setattr(build_module, "generate", broken)
    with pytest.raises(CompileError, match="broken on purpose"):
        build(SMALL)
    assert contents(cache) == []


def test_no_compiler_is_an_input_error_with_the_remedy(
    cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("bayesrace.codegen.compiler.find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"no C compiler.*install gcc.*ziglang"):
        build(SMALL)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("no-such-compiler -m64", "no-such-compiler"),
        ("false", "false"),
        ("gcc 'unbalanced", r"CC=gcc 'unbalanced: No closing quotation"),
    ],
)
def test_a_chosen_compiler_that_does_not_work_is_named(
    monkeypatch: pytest.MonkeyPatch, command: str, words: str
) -> None:
    monkeypatch.setenv("CC", command)
    with pytest.raises(InputError, match=words):
        find_compiler()


def test_a_compiler_that_has_built_a_library_is_not_asked_again(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = find_compiler()
    find_compiler.cache_clear()
    asked: list[str] = []

    def answer(line: list[str]) -> str:
        asked.append(line[-1])
        return found.version

    monkeypatch.setattr("bayesrace.codegen.compiler._run", answer)
    assert find_compiler() == found
    assert asked == ["--version"]


def load(folder: Path, car: Car) -> NativeStep:
    return NativeStep(folder, car, MpcSettings())


def test_a_damaged_library_is_refused(artefact: Path, car: Car) -> None:
    load(artefact, car)
    data = bytearray((artefact / LIBRARY).read_bytes())
    data[len(data) // 2] ^= 1
    (artefact / LIBRARY).unlink()  # this process has it loaded: never write into that file
    (artefact / LIBRARY).write_bytes(data)
    with pytest.raises(InputError, match=r"not the file its manifest describes.*build"):
        load(artefact, car)
    (artefact / LIBRARY).unlink()
    with pytest.raises(InputError, match="cannot be read"):
        load(artefact, car)


def test_changed_declarations_are_refused(artefact: Path, car: Car) -> None:
    with (artefact / DECLARATIONS).open("a") as file:
        file.write("raise RuntimeError('executed')\n")
    with pytest.raises(InputError, match=rf"{DECLARATIONS} is not the file its manifest describes"):
        load(artefact, car)


def _cut(library: Path) -> None:
    data = library.read_bytes()
    library.unlink()
    library.write_bytes(data[:-100])


@pytest.mark.parametrize(
    "spoil",
    [_cut, Path.unlink, lambda library: library.chmod(0o777)],
    ids=["cut", "missing", "for anybody"],
)
def test_an_artefact_that_cannot_be_trusted_is_built_again(
    cache: Path, car: Car, spoil: Callable[[Path], None]
) -> None:
    folder, _ = build(SMALL)
    left = folder.with_name(f".{folder.name}-killed")
    left.mkdir()
    spoil(folder / LIBRARY)
    assert build(SMALL)[0] == folder
    load(folder, car)
    assert contents(cache) == [folder]


@pytest.mark.parametrize("name", [LIBRARY, DECLARATIONS, MANIFEST, "."])
def test_what_others_may_write_or_own_is_not_loaded(
    artefact: Path, car: Car, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    one = artefact / name
    mode = one.stat().st_mode
    one.chmod(mode | 0o002)
    with pytest.raises(InputError, match=rf"{one} is writable for other users.*chmod go-w"):
        load(artefact, car)
    one.chmod(mode)
    load(artefact, car)
    monkeypatch.setattr("os.geteuid", lambda: 12345)
    monkeypatch.setattr("bayesrace.trusted_files._ROOT", 54321)
    with pytest.raises(InputError, match=r"belongs to another user.*BAYESRACE_CACHE"):
        load(artefact, car)


_EVIL = """#include <stdio.h>
__attribute__((constructor)) static void run(void) { FILE *f = fopen("%s", "w"); fclose(f); }
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root becomes another user")
def test_code_of_a_user_in_the_group_is_not_executed(
    artefact: Path, car: Car, tmp_path: Path
) -> None:
    """The attacker may write library and manifest, as the umask 002 and a shared group allow."""
    ran = tmp_path / "ran"
    with tempfile.TemporaryDirectory() as temporary:  # where the attacker gets, unlike tmp_path
        top = Path(temporary)
        top.chmod(0o755)
        (top / "evil.c").write_text(_EVIL % ran)
        find_compiler().run("-shared", "-fPIC", top / "evil.c", "-o", top / "evil.so")
        digest = hashlib.sha256((top / "evil.so").read_bytes()).hexdigest()
        forged = read_manifest(artefact).model_copy(update={"library_sha256": digest})
        (top / "forged").write_text(forged.model_dump_json())
        shared = Path(shutil.copytree(artefact, top / "artefact"))
        for one in (shared / LIBRARY, shared / MANIFEST):
            os.chown(one, -1, 54321)
            one.chmod(0o775)
        attack = f"cat evil.so >artefact/{LIBRARY}; cat forged >artefact/{MANIFEST}"
        subprocess.run(
            ["sh", "-ec", attack], cwd=top, user=12345, group=54321, extra_groups=[], check=True
        )
        with pytest.raises(InputError, match=r"writable for other users.*chmod go-w"):
            load(shared, car)
    assert not ran.exists()


def test_what_is_exchanged_after_it_was_checked_is_not_loaded(
    artefact: Path, car: Car, monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextmanager
    def exchanged(folder: Path, manifest: Manifest) -> Iterator[tuple[bytes, BinaryIO]]:
        with opened_library(folder, manifest) as opened:
            for name in (DECLARATIONS, LIBRARY):
                (folder / name).unlink()
                (folder / name).write_text("raise RuntimeError('not what was checked')")
            yield opened

    monkeypatch.setattr("bayesrace.controller.native_step.opened_library", exchanged)
    step = load(artefact, car)
    assert step.predict(np.r_[0.0, 0, 0, 1, 0, 0, 0], np.r_[0.5, 0], 0.02)[0] > 0
    monkeypatch.undo()
    with pytest.raises(InputError, match="is not the file its manifest describes"):
        load(artefact, car)


@pytest.mark.parametrize("umask", [0, 0o002])
def test_what_is_built_may_be_loaded_whatever_the_umask(
    cache: Path, car: Car, tmp_path: Path, umask: int
) -> None:
    before = os.umask(umask)
    try:
        export.build(cast("Any", lambda **_: SMALL), tmp_path / "new" / "copy", None, None, False)
    finally:
        os.umask(before)
    (folder,) = contents(cache)
    load(folder, car)
    load(tmp_path / "new" / "copy", car)


def test_nothing_is_built_where_it_would_not_be_loaded(cache: Path, tmp_path: Path) -> None:
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(InputError, match=r"open is writable for other users.*chmod go-w"):
        export.build(cast("Any", lambda **_: SMALL), tmp_path / "open" / "copy", None, None, False)
    assert not cache.exists()
    assert not [*tmp_path.rglob(LIBRARY)]
    cache.mkdir()
    cache.chmod(0o777)
    with pytest.raises(InputError, match=rf"{cache} is writable for other users.*chmod go-w"):
        build(SMALL)
    assert contents(cache) == []


def test_the_names_and_numbers_in_python_are_those_of_the_header(kinematic_artefact: Path) -> None:
    artefact = Artefact(kinematic_artefact)
    statuses = Status.__members__
    of_steps = {name: one for name, one in statuses.items() if one < Status.DOUBTED}
    no_steps = {name: one for name, one in statuses.items() if one >= Status.DOUBTED}
    tables: dict[str, tuple[str, Iterable[str]]] = {
        "br_mpc_status": ("", of_steps),
        "br_level": ("", Level.__members__),
        "br_no_step": ("", no_steps),
        "br_phase": ("PHASE_", Phase.__members__),
        "br_fault": ("FAULT_", ["NONE", *(name.upper() for name in SENSOR_FAULTS[1:])]),
        "br_compensation": ("COMPENSATION_", ["OFF", "MEASURED", "FIXED"]),
    }
    for name, (prefix, names) in tables.items():
        elements = dict(sorted(artefact.ffi.typeof(name).elements.items()))
        assert list(elements.values()) == [f"BR_{prefix}{one}" for one in names]
        first = 251 if name == "br_no_step" else 0
        assert list(elements) == list(range(first, first + len(elements)))
    assert list(of_steps.values()) == list(range(len(of_steps)))
    assert list(no_steps.values()) == list(range(251, 256))
    duty = dict(artefact.ffi.typeof("br_braking").fields)["duty"].type
    numbers = duty.length, artefact.library.BR_SAMPLES, artefact.library.BR_WATCHED
    assert numbers == (BRAKING_ROWS, SAMPLES, WATCHED)


def test_what_is_no_controller_of_this_car_and_release_is_refused(
    artefact: Path, tmp_path: Path, car: Car
) -> None:
    with pytest.raises(InputError, match="not a built controller"):
        load(tmp_path, car)
    with pytest.raises(InputError, match="built for car"):
        load(artefact, car.model_copy(update={"name": "other"}))
    manifest = read_manifest(artefact)
    other = manifest.model_copy(update={"abi": manifest.abi + 1}).model_dump_json()
    broken = r"is no manifest .*: run 'bayesrace build'"
    texts = dict.fromkeys(["", "{", "{}", '{"abi": "one"}'], broken)
    for text, words in {**texts, other: r"built for interface .*build"}.items():
        (artefact / MANIFEST).write_text(text)
        with pytest.raises(InputError, match=words):
            load(artefact, car)


@pytest.mark.check
def test_concurrent_builds_of_the_same_hash_all_succeed(cache: Path) -> None:
    with ThreadPoolExecutor(3) as pool:
        results = list(pool.map(lambda _: build(SMALL), range(3)))
    folders = {folder for folder, _ in results}
    assert len(folders) == 1
    folder = folders.pop()
    assert contents(cache) == [folder]
    assert build(SMALL)[1] == read_manifest(folder)


def symbols(artefact: Path, which: str) -> set[str]:
    """Names in the library that ``nm`` lists."""
    if not shutil.which("nm"):
        pytest.skip("nm (binutils) is not installed")
    line = ["nm", "-D", which, str(artefact / LIBRARY)]
    listing = subprocess.run(line, capture_output=True, text=True, check=True).stdout
    return {row.split()[-1].split("@")[0] for row in listing.splitlines()}


def test_the_library_exports_the_interface_only(kinematic_artefact: Path) -> None:
    names = symbols(kinematic_artefact, "--defined-only")
    interface = ("br_mpc_", "br_cycle_", "br_estimator_")
    assert {n for n in names if not n.startswith(interface)} == set()
    headers = ("bayesrace_mpc.h", "bayesrace_cycle.h", "bayesrace_estimator.h")
    header = "".join((kinematic_artefact / one).read_text() for one in headers)
    assert all(name in header for name in names)
    assert "br_mpc_step" in names


def test_the_library_cannot_print_exit_or_start_threads(kinematic_artefact: Path) -> None:
    """It is not linked with functions for that; that it never allocates is counted in C."""
    names = symbols(kinematic_artefact, "--undefined-only")
    unwanted = ("printf", "puts", "putchar", "fwrite", "exit", "abort", "pthread", "mutex", "Py")
    assert not [name for name in names if any(word in name for word in unwanted)]


@pytest.mark.check
def test_ziglang_builds_the_controller_where_there_is_no_compiler(
    ziglang: None, cache: Path, monkeypatch: pytest.MonkeyPatch, car: Car
) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr("bayesrace.codegen.compiler.shutil.which", lambda _: None)
    compiler = find_compiler()
    assert compiler.command == (*RUN_MODULE, "ziglang", "cc")
    folder, manifest = build(BuildSettings(gp_capacity=8))
    assert manifest.compiler == compiler.version
    step = load(folder, car)
    x_next, _, _ = step.evaluate(np.r_[0.0, 0, 0, 1, 0, 0, 0, 0.5, 0], np.zeros(7))
    expected = PREDICTION.discretise(MODELS["e_kinematic"](car))([0, 0, 0, 1, 0, 0, 0], [0.5, 0])
    np.testing.assert_allclose(x_next, np.asarray(expected).ravel(), rtol=1e-12, atol=1e-14)


def test_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BAYESRACE_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", os.sep + "somewhere")
    assert cache_folder() == Path(os.sep) / "somewhere" / "bayesrace"


# --- other platforms ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("files", "fault"),
    [
        ({}, "no source distribution of DAQP that fits: 'pip download"),
        ({"daqp/csrc/include/api.h": b"int other;"}, "(api.h is not that of CasADi)"),
        (None, "not a gzip file"),
    ],
)
def test_what_is_not_daqp_is_refused(
    tmp_path: Path, files: dict[str, bytes] | None, fault: str
) -> None:
    distribution = tmp_path / "daqp.tar.gz"
    if files is None:
        distribution.write_bytes(b"no archive")
    else:
        with tarfile.open(distribution, "w:gz") as archive:
            for name, data in files.items():
                entry = tarfile.TarInfo(name)
                entry.size = len(data)
                archive.addfile(entry, io.BytesIO(data))
    with pytest.raises(InputError, match=re.escape(fault)):
        build(SMALL, daqp=distribution)


def test_what_another_platform_lacks_is_said_in_a_line(kinematic_artefact: Path) -> None:
    arm = get_platform("aarch64-linux")
    with pytest.raises(InputError, match="aarch64-linux, DAQP's C is missing: 'pip download"):
        build(SMALL, platform=arm)
    with pytest.raises(InputError, match="for Linux, not for x86_64-windows"):
        build(SMALL, platform=get_platform("x86_64-windows"))
    with pytest.raises(InputError, match="does not compile for aarch64-linux: set CC to"):
        arm.check(kinematic_artefact / LIBRARY, find_compiler())
    host_platform().check(kinematic_artefact / LIBRARY, find_compiler())


def test_a_controller_for_another_processor_has_one_here_that_checks_its_weights(
    artefact: Path, tmp_path: Path, car: Car
) -> None:
    foreign = Path(shutil.copytree(artefact, tmp_path / "foreign"))
    data = bytearray((foreign / LIBRARY).read_bytes())
    data[18] ^= 1  # the machine, in the head of the file
    (foreign / LIBRARY).write_bytes(data)
    assert (runs_here(artefact), runs_here(foreign)) == (True, False)
    here = checking_artefact(foreign, car)
    assert runs_here(here)
    assert read_manifest(here).discretisation == read_manifest(foreign).discretisation
    with pytest.raises(InputError, match="was built for car"):
        checking_artefact(foreign, get_car("f1tenth"))
