"""Call graph and stack of the compiled controller, by what gcc has made of it.

    python -m tests.native_stack [--json FILE]

Prints how much stack each function of the interface takes at most, by gcc's frames
(-fcallgraph-info=su) along the deepest calls. DAQP comes compiled: its frames and calls are read
from its machine code. What the C library and the host's clock take is not in it.
"""

import argparse
import json
import re
import subprocess
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from bayesrace.codegen.build import build, casadi_includes
from bayesrace.codegen.compiler import FLAGS
from bayesrace.codegen.settings import BuildSettings
from tests.native_programs import artefact_objects, gcc

WITH_GRAPH: Final = (*FLAGS, "-fcallgraph-info=su")
"""The library's own flags; gcc leaves a graph beside each object."""

CLOCK: Final = "the host's clock"

CODES: Final = ("br_step.c", "br_avx2.c", "br_avx512.c")
"""Where the step is compiled to, by instructions: see controller/native/br_parts.h."""

PIVOTING: Final = "DAQP's pivoting"
PIVOTS: Final = frozenset({"add_constraint", "pivot_last", "remove_constraint"})
"""They call each other while rows of the active set change places. Each call within another has an
active row less than that."""

INTERFACE: Final = re.compile(r"br_(mpc|cycle|estimator)_\w+")


@dataclass
class Graph:
    """Functions by name; static ones by file and name."""

    frames: dict[str, int]
    """Bytes of stack, return address included."""
    calls: dict[str, set[str]]
    unbounded: list[str]
    """Whose frame has no bound, as with variable-length arrays."""

    def outside(self) -> set[str]:
        """Functions that are called and not compiled here."""
        return {name for called in self.calls.values() for name in called} - set(self.frames)

    def order(self) -> list[str]:
        """All functions, callees first; CycleError where a function can call itself."""
        return list(TopologicalSorter(self.calls).static_order())

    def depths(self) -> dict[str, int]:
        """Bytes of stack of each function and all that it calls."""
        deepest: dict[str, int] = {}
        for name in self.order():
            below = max((deepest[one] for one in self.calls.get(name, ())), default=0)
            deepest[name] = self.frames.get(name, 0) + below
        return deepest


def _text(place: str) -> str:
    """The line of source that a call is in, from the place on that gcc names."""
    file, line, column = place.rsplit(":", 2)
    return Path(file).read_text().splitlines()[int(line) - 1][int(column) - 1 :]


def _pointed(place: str, names: set[str]) -> set[str]:
    """What a call through a pointer reaches: one of the tables of functions, or the clock."""
    text = _text(place)
    if found := re.search(r"code->(\w+)\(", text):
        table = {"mismatch": "br_get_mismatch", "load": "br_gp_load", "limit": "br_limit_speeds"}
        target = table.get(found[1], f"br_{found[1]}")
        return names & {target, *(f"{file}:{target}" for file in CODES)}
    if found := re.search(r"controller(?:\.|->)(\w+)\(", text):
        return names & {f"br_cycle.c:mpc_{found[1]}"}
    return {CLOCK} if "clock(" in text else set()


def own_graph(artefact: Path) -> Graph:
    """Of our own C and CasADi's."""
    folder = artefact_objects(artefact, WITH_GRAPH)[0].parent
    graph = Graph({}, {}, [])
    pointers = []
    for file in sorted(folder.glob("*.ci")):
        text = re.sub(r'"[^"\s]*/([\w.]+:[\w.]+")', r'"\1', file.read_text())
        for name, size, kind in re.findall(
            r'node: \{ title: "(\S+)" label: "[^"]*?(\d+) bytes \(([\w,]+)\)', text
        ):
            graph.frames[name] = int(size)
            graph.calls.setdefault(name, set())
            if kind not in ("static", "dynamic,bounded"):
                graph.unbounded.append(name)
        for name, called, place in re.findall(
            r'edge: \{ sourcename: "(\S+)" targetname: "(\S+)"(?: label: "(\S+)")?', text
        ):
            if called == "__indirect_call":
                pointers.append((name, place))
            else:
                graph.calls.setdefault(name, set()).add(called)
    for name, place in pointers:
        reached = _pointed(place, set(graph.frames))
        assert reached, f"{place}: a call through a pointer to nothing that is known"
        graph.calls[name] |= reached
    return graph


def daqp_graph(archive: Path) -> Graph:
    """Of DAQP's machine code (x86-64): what it pushes and takes of the stack, and what it calls."""
    line: list[str | Path] = ["objdump", "-dr", "--no-show-raw-insn", archive]
    text = subprocess.run(line, capture_output=True, text=True, check=True).stdout
    graph = Graph({}, {}, [])
    for name, body in re.findall(r"^[0-9a-f]+ <(\w+)>:\n((?:.+\n)+)", text, re.MULTILINE):
        taken = sum(int(one, 16) for one in re.findall(r"sub +\$0x(\w+),%rsp", body))
        graph.frames[name] = 8 + 8 * len(re.findall(r"\tpush ", body)) + taken
        graph.calls[name] = set(re.findall(r"R_X86_64_PLT32\t(\w+)", body))
        graph.calls[name] |= set(re.findall(r"\tjmp +\w+ <(\w+)>\n", body)) - {name}
        if re.search(r"\t(and|lea|mov) .*,%rsp$|\tsub +%\w+,%rsp$", body, re.MULTILINE):
            graph.unbounded.append(name)
    return graph


def active_rows(artefact: Path) -> int:
    """BR_ACTIVE: most rows that DAQP holds active at a time."""
    with TemporaryDirectory() as folder:
        source = Path(folder) / "rows.c"
        source.write_text('#include "br_internal.h"\nchar rows[BR_ACTIVE];\n')
        place = source.with_suffix(".o")
        gcc("-c", f"-I{artefact}", "-isystem", casadi_includes()[0], source, "-o", place)
        line: list[str | Path] = ["nm", "-S", place]
        text = subprocess.run(line, capture_output=True, text=True, check=True).stdout
    return int(text.split()[1], 16)


def whole_graph(artefact: Path) -> Graph:
    """Both, with DAQP's pivoting as one function that takes what its deepest calls take."""
    own, daqp = own_graph(artefact), daqp_graph(casadi_includes()[1])
    wanted = own.outside() & set(daqp.frames)
    while new := {one for name in wanted for one in daqp.calls[name]} & set(daqp.frames) - wanted:
        wanted |= new
    frames = {name: daqp.frames[name] for name in wanted - PIVOTS}
    frames[PIVOTING] = active_rows(artefact) * sum(daqp.frames[name] for name in PIVOTS)
    calls: dict[str, set[str]] = {name: set() for name in frames}
    for name in wanted:
        called = {PIVOTING if one in PIVOTS else one for one in daqp.calls[name]}
        caller = PIVOTING if name in PIVOTS else name
        calls[caller] |= called - {caller} if caller == PIVOTING else called
    unbounded = [name for name in daqp.unbounded if name in wanted]
    return Graph(own.frames | frames, own.calls | calls, own.unbounded + unbounded)


def recursive(graph: Graph) -> list[str]:
    """Functions that call themselves by way of each other, one after another; none: []."""
    try:
        graph.order()
    except CycleError as error:
        return list(error.args[1])
    return []


def interface_depths(artefact: Path) -> dict[str, int]:
    """Most stack of each function of the interface [bytes], the deepest first."""
    depths = whole_graph(artefact).depths()
    of = {name: size for name, size in depths.items() if INTERFACE.fullmatch(name)}
    return dict(sorted(of.items(), key=lambda item: -item[1]))


def main() -> None:
    """Prints a table of the built-in car's controllers."""
    parser = argparse.ArgumentParser(prog="native_stack", description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="writes the numbers, too")
    given = parser.parse_args()
    found = {}
    for problem in ("tracking", "progress"):
        found[problem] = interface_depths(build(BuildSettings(problem=problem))[0])
        print(f"{problem}: most stack by function, bytes, from 1,000 on")
        for name, size in found[problem].items():
            if size >= 1000:
                print(f"{size:9,}  {name}")
    if given.json:
        given.json.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
