"""The C program of examples/c_host, compiled for an artefact: answers states without Python."""

import itertools
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bayesrace.codegen.build import HOST
from bayesrace.codegen.compiler import find_compiler
from bayesrace.codegen.host_files import export
from bayesrace.controller.assembly import make_path_table
from bayesrace.controller.settings import CycleSettings, MpcSettings
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights
from bayesrace.manifest import LIBRARY, read_manifest
from bayesrace.messages import QUANTITIES, State
from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track
from bayesrace.vehicles import Car

__all__ = ["C_HOST", "CHost"]

C_HOST: Final = Path(__file__).resolve().parents[2] / "examples" / "c_host" / "main.c"
"""In the repository; the package has no examples."""


@dataclass(frozen=True)
class CHost:
    """The program and its data, in a folder."""

    folder: Path

    @classmethod
    def made(
        cls, folder: Path, artefact: Path, car: Car, track: Track, line: RaceLine,
        weights: Weights | None, mpc: MpcSettings,
    ) -> "CHost":  # fmt: skip
        """Compiles it. InputError where the program is not there."""
        if not C_HOST.is_file():
            raise InputError(f"no {C_HOST}: the C host needs the repository, whose example it is")
        host = artefact / HOST
        shutil.copy(artefact / LIBRARY, folder / LIBRARY)
        find_compiler().run(
            "-O2", "-std=gnu11", C_HOST, host / "br_files.c", f"-I{artefact}", f"-I{host}",
            folder / LIBRARY, f"-Wl,-rpath,{folder}", "-lm", "-o", folder / "c_host",
        )  # fmt: skip
        table = make_path_table(track, line, car.tuning.path.spacing_m)
        manifest, cycle = read_manifest(artefact), CycleSettings().cycle_values(car)
        values = mpc.parameters(car, manifest.problem.name) | cycle
        values |= car.tuning.estimation(nominal=False)
        export(folder, manifest, table.rows, table.spacing_m, values, weights)
        return cls(folder)

    def answers(
        self, states: Iterable[State], tool: Sequence[str] = ()
    ) -> dict[int, tuple[tuple[float, float], int, int]]:
        """Input, status and level by ``seq``; ``tool``: a command that runs the program."""
        instruments: dict[str, int] = {}
        lines = "".join(_line(one, instruments) for one in states)
        line = [*tool, str(self.folder / "c_host"), str(self.folder)]
        done = subprocess.run(line, input=lines, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"{C_HOST.parent.name} ended with {done.returncode}: {done.stderr}")
        rows = map(str.split, done.stdout.splitlines())
        return {int(r[2]): ((float(r[4]), float(r[5])), int(r[6]), int(r[7])) for r in rows}


def _line(state: State, instruments: dict[str, int]) -> str:
    """A state as the program reads it; ``instruments``: numbers by name, to which it adds."""
    flags = int(state.lockstep), int(state.final)
    numbers = (
        state.epoch, state.run, state.seq, state.time_s, *flags, *state.x, *state.u_applied,
        *state.actuation_delays[2::3],
    )  # fmt: skip
    words = [" ".join(map(repr, numbers))]
    for one in state.readings if state.estimated else ():
        number = instruments.setdefault(one.instrument, len(instruments))
        values = ((QUANTITIES.index(name), *both) for name, both in one.values.items())
        words.append(" ".join(map(repr, itertools.chain((number, one.time_s), *values))))
    if state.estimated and not state.readings:
        words.append("")
    return " ; ".join(words) + "\n"
