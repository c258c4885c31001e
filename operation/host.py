"""The controller without Python: its program, the files that it drives by, and a run of it.

The program is ``controller/host``, compiled with the problem of an artefact linked in.
"""

import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayesrace.codegen.build import PROGRAM, host_program
from bayesrace.codegen.compiler import Compiler, find_compiler
from bayesrace.codegen.host_files import export
from bayesrace.controller.assembly import path_table_for
from bayesrace.controller.settings import CycleSettings, GateSettings, MpcSettings
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.gp.weights import Weights
from bayesrace.manifest import read_manifest
from bayesrace.messages import (
    ACTUATION,
    STATE,
    TELEMETRY,
    Actuation,
    State,
    Telemetry,
    datagrams_in,
    framed,
    from_datagram,
    to_datagram,
)
from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track
from bayesrace.vehicles import Car

__all__ = ["HostProgram", "drives_by", "export_for", "write_program"]

_EXECUTABLE = 0o755


def write_program(artefact: Path, folder: Path, compiler: Compiler | None = None) -> Path:
    """The executable in a folder; ``compiler``: of another platform, as the artefact's."""
    path = folder / PROGRAM
    write_whole(path, host_program(artefact, compiler or find_compiler()))
    path.chmod(_EXECUTABLE)
    return path


def drives_by(
    artefact: Path, car: Car, track: Track, line: RaceLine, weights: Weights | None,
    mpc: MpcSettings,
) -> dict[str, Any]:  # fmt: skip
    """What a controller's files and FMU are made from: the line as ``rows`` every ``spacing_m``,
    ``settings`` of problem and solver, ``weights``."""
    manifest = read_manifest(artefact)
    table = path_table_for(manifest, car, track, line)
    settings = mpc.parameters(car, manifest.problem.name)
    return {
        "rows": table.rows, "spacing_m": table.spacing_m, "settings": settings, "weights": weights
    }  # fmt: skip


def export_for(
    folder: Path, artefact: Path, car: Car, track: Track, line: RaceLine,
    weights: Weights | None, mpc: MpcSettings,
) -> None:  # fmt: skip
    """Writes what the program drives by: racing line, weights, and all settings in one file."""
    given = drives_by(artefact, car, track, line, weights, mpc)
    values = given["settings"] | CycleSettings().cycle_values(car)
    manifest = read_manifest(artefact)
    values |= GateSettings().probation(car, manifest.step_s)
    learned = car.tuning.estimation(nominal=False)
    values |= car.tuning.estimation(nominal=True)
    values |= {f"learned_{name}": learned[name] for name in ("acceleration", "acceleration_s")}
    export(folder, manifest, given["rows"], given["spacing_m"], values, weights)


@dataclass(frozen=True)
class HostProgram:
    """The program and its files, in a folder."""

    folder: Path

    @classmethod
    def made(
        cls, folder: Path, artefact: Path, car: Car, track: Track, line: RaceLine,
        weights: Weights | None, mpc: MpcSettings,
    ) -> "HostProgram":  # fmt: skip
        """Compiles the one and writes the others."""
        write_program(artefact, folder)
        export_for(folder, artefact, car, track, line, weights, mpc)
        return cls(folder)

    def answers(
        self, states: Iterable[State], tool: Sequence[str] = ()
    ) -> list[tuple[Actuation, Telemetry]]:
        """Its answers to states of lockstep runs; ``tool``: a command that runs the program."""
        given = b"".join(framed(to_datagram(STATE, one)) for one in states)
        line = [*tool, str(self.folder / PROGRAM), str(self.folder), "stdio", "--telemetry"]
        done = subprocess.run(line, input=given, capture_output=True, check=False)
        if done.returncode:
            said = done.stderr.decode(errors="replace")
            raise InputError(f"{PROGRAM} ended with {done.returncode}: {said}")
        sent = [from_datagram(one) for one in datagrams_in(done.stdout)]
        actuations = [one for topic, one in sent if topic is ACTUATION]
        reports = [one for topic, one in sent if topic is TELEMETRY]
        return list(zip(actuations, reports, strict=True))  # type: ignore[arg-type]
