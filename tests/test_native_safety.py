"""What the project's C keeps: strict warnings, no recursion, a bounded stack, and no other outside
functions than named ones.
"""

import re
import subprocess
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, Literal

import pytest

from bayesrace.codegen.build import HOST, NATIVE, build, casadi_includes, generate, problem_of
from bayesrace.codegen.fmu import FmuDefinition, car_fmu
from bayesrace.codegen.fmu.build import NATIVE as FMU
from bayesrace.codegen.fmu.build import fmi_headers, sources_of
from bayesrace.codegen.messages import messages_header
from bayesrace.codegen.settings import BuildSettings
from bayesrace.vehicles import Car
from tests.fmu_lockstep import (  # noqa: F401 - a fixture is used by name
    Exported,
    exported_controllers,
)
from tests.native_misra import by_number, deviations, findings
from tests.native_programs import (
    OPTIMISED,
    PROGRAMS,
    STRICT,
    artefact_objects,
    gcc,
    native_program,
)
from tests.native_stack import (
    CLOCK,
    PIVOTS,
    WITH_GRAPH,
    daqp_graph,
    interface_depths,
    recursive,
    whole_graph,
)
from tests.test_native_c import problems  # noqa: F401 - a fixture is used by name
from tests.test_python_interface import rail

HOST_FOLDER: Final = NATIVE.parent / HOST

CONTROL_THREAD, STAGING_THREAD = 128 << 10, 192 << 10
"""Bytes of stack, as docs/c-code.md asks for."""

AT_START = ("br_mpc_set_", "br_mpc_stage_", "br_cycle_set_")
"""Functions that are not for the control loop."""

OUTSIDE: Final = {
    *("memcmp", "memcpy", "memmove", "memset"),
    *("asin", "atan", "atan2", "cos", "exp", "fmax", "fmin", "fmod", "hypot", "log", "pow"),
    *("remainder", "sin", "sincos"),
}
"""Functions of the C library that the step may call: none allocates, waits, reads or prints.
``clock_gettime`` is br_clock.c's, a clock for hosts that have no other."""

DAQP: Final = {"activate_constraints", "daqp_ldp", "reset_daqp_workspace"}


def warn(files: Iterable[Path], *folders: Path) -> None:
    """Compiles files as far as warnings go; headers of others warn of nothing."""
    others = (casadi_includes()[0], fmi_headers(3)[0].parent)
    found = [f"-I{folder}" for folder in folders] + [f"-isystem{folder}" for folder in others]
    with ThreadPoolExecutor() as pool:
        line = ("-std=gnu11", "-fsyntax-only", *STRICT, *found)
        list(pool.map(lambda file: gcc(*line, file), files))


def generated(folder: Path, name: str) -> Path:
    """The headers that the code generation writes, for a problem of this name."""
    settings = BuildSettings(problem="progress") if name == "progress" else BuildSettings()
    generate(rail() if name == "rail" else problem_of(settings), settings, folder)
    (folder / "br_messages.h").write_text(messages_header())
    return folder


@pytest.mark.parametrize("name", ["tracking", "progress", "rail"])
def test_the_library_has_no_warnings(name: str, tmp_path: Path) -> None:
    """Also of a problem without a path, where BR_HAS_PATH is 0."""
    warn(NATIVE.glob("*.c"), NATIVE, generated(tmp_path, name))


def test_the_program_without_python_has_no_warnings(tmp_path: Path) -> None:
    warn(HOST_FOLDER.glob("*.c"), HOST_FOLDER, NATIVE, generated(tmp_path, "tracking"))


@pytest.mark.parametrize(
    "what", ["car 2 cs", "car 3 cs", "car 3 me", "controller 2", "controller 3"]
)
def test_fmus_have_no_warnings(what: str, exported: Exported, car: Car, tmp_path: Path) -> None:
    model, version, *kind = what.split()
    definition: FmuDefinition = (
        car_fmu(car, int(version), *kind)  # type: ignore[arg-type]
        if model == "car"
        else exported.define(version=int(version))
    )
    sources: Mapping[str, bytes] = sources_of(definition)[1]
    for name in {"fmu_config.h", "car_model.h", "controller_tables.h"} & set(sources):
        (tmp_path / name).write_bytes(sources[name])
    files = (FMU / f"{model}.c", FMU / "fmi.c", FMU / f"fmi{version}.c")
    artefact = exported.artefact
    warn(files, tmp_path, artefact, artefact / HOST)


@pytest.mark.check
@pytest.mark.parametrize("problem", ["tracking", "progress"])
def test_nothing_calls_itself_and_the_stack_is_bounded(
    problem: Literal["tracking", "progress"],
) -> None:
    artefact = build(BuildSettings(problem=problem))[0]
    graph = whole_graph(artefact)
    assert recursive(graph) == []
    assert graph.unbounded == []
    depths = interface_depths(artefact)
    assert depths["br_mpc_step"] > 10_000  # gcc's frames were found
    assert max(depths.values()) < STAGING_THREAD
    assert max(depths[one] for one in depths if not one.startswith(AT_START)) < CONTROL_THREAD


@pytest.mark.check
def test_of_daqp_only_the_pivoting_calls_itself() -> None:
    """Which docs/c-code.md names, with its bound."""
    found = recursive(daqp_graph(casadi_includes()[1]))
    assert found
    assert set(found) <= PIVOTS


@pytest.mark.check
def test_the_library_calls_no_outside_functions_but_named_ones(kinematic_artefact: Path) -> None:
    """No object as much as names another one, and of DAQP the functions that the step calls."""
    objects = artefact_objects(kinematic_artefact, WITH_GRAPH)
    defined = {name for one in objects for name in _symbols(one, "--defined-only")}
    for one in objects:
        named = _symbols(one, "--undefined-only") - defined - {"_GLOBAL_OFFSET_TABLE_"}
        assert named <= OUTSIDE | DAQP | ({"clock_gettime"} if one.stem == "br_clock" else set())
    assert whole_graph(kinematic_artefact).outside() <= OUTSIDE | {CLOCK, "clock_gettime"}


@pytest.mark.check
def test_the_library_has_no_variables_of_its_own(kinematic_artefact: Path) -> None:
    """Everything that is ever written is in the memory that the host gives."""
    for one in artefact_objects(kinematic_artefact, WITH_GRAPH):
        line: list[str | Path] = ["objdump", "-h", one]
        text = subprocess.run(line, capture_output=True, text=True, check=True).stdout
        assert re.findall(r" \.(?:data|bss) +(\w+)", text) == ["00000000", "00000000"]


def _symbols(file: Path, which: str) -> set[str]:
    line: list[str | Path] = ["nm", which, file]
    text = subprocess.run(line, capture_output=True, text=True, check=True).stdout
    return {one.split()[-1] for one in text.splitlines() if one}


@pytest.mark.check
def test_measured_stack_is_within_the_bound(
    kinematic_artefact: Path,
    problems: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    """Set-up, steps, preparations and new weights; 16 KiB are the harness's and the C library's."""
    program = native_program(
        kinematic_artefact, PROGRAMS / "stack.c", tmp_path / "used", *OPTIMISED, also=["-pthread"]
    )
    line: list[str | Path] = [program, problems, tmp_path / "results.bin"]
    used = int(subprocess.run(line, capture_output=True, text=True, check=True).stdout)
    most = max(interface_depths(kinematic_artefact).values())
    assert most / 3 < used < most + (16 << 10)


@pytest.mark.check
@pytest.mark.timeout(900)
def test_every_rule_of_misra_c_that_is_violated_is_a_deviation_with_a_reason() -> None:
    """And none is listed that is kept."""
    assert by_number(findings()) == by_number(deviations())
