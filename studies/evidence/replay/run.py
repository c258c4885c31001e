"""``bayesrace replay``: all drives of a library on all cores, the verdict, and files."""

import json
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesrace.errors import InputError
from bayesrace.files import replacing, write_whole
from bayesrace.learning.sources import log_facts
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.studies.evidence.replay.comparison import (
    ROWS,
    Replayed,
    Tolerance,
    parting,
    rows_of,
)
from bayesrace.studies.evidence.replay.controller import Given, set_up
from bayesrace.studies.evidence.replay.hosts import Answer, answers
from bayesrace.studies.evidence.replay.recording import read_lives
from bayesrace.studies.evidence.verdict import Verdict

__all__ = ["replay"]

_LOG = "run.mcap"


def replay(
    logs: Sequence[Path],
    given: Given,
    stages: Stages,
    allowed: Tolerance = None,
    against: Path | None = None,
    out: Path | None = None,
) -> Verdict:
    """Replays each drive and compares its inputs with those recorded, or with those ``against``.

    ``allowed`` None: to the bit, where the recorded controller answers.
    ``out`` gets result.json, and the inputs and a picture of each drive. InputError for a drive
    that cannot be replayed.
    """
    drives = find_drives(logs)
    baselines = {} if against is None else {name: _baseline(against, name) for name in drives}
    begin_s = time.monotonic()
    found: list[Replayed] = []
    with stages.stage(f"replay {len(drives)} drive(s)") as stage:
        for one in _each(drives, given, allowed):
            found.append(one)
            stage.update(len(found) / len(drives))
    took_s = time.monotonic() - begin_s
    checks = []
    for one in found:
        if against is None:
            checks += one.checks(allowed)
        else:
            checks.append(one.against(baselines[one.name], allowed))
    verdict = Verdict("replay", tuple(checks))
    if out is not None:
        _leave(out, found, verdict, took_s)
    return verdict


def find_drives(logs: Sequence[Path]) -> dict[str, Path]:
    """Log files by name: those given, and those in the folders given, which may be runs' or hold
    folders of runs."""
    found: dict[str, Path] = {}
    for given in logs:
        for name, path in _logs_in(given):
            if found.setdefault(name, path) != path:
                raise InputError(f"two drives are called '{name}': replay them one by one")
    return found


def _logs_in(given: Path) -> Iterator[tuple[str, Path]]:
    if not given.is_dir():
        yield (given.resolve().parent.name if given.name == _LOG else given.stem), given
        return
    if (given / _LOG).is_file():
        yield given.resolve().name, given / _LOG
        return
    every = sorted(given.rglob("*.mcap"))
    runs = {path.parent for path in every if path.name == _LOG}
    kept = [path for path in every if path.name == _LOG or path.parent not in runs]
    if not kept:
        raise InputError(f"no log (*.mcap) in {given}: give a log, or a folder that holds some")
    for path in kept:
        named = path.parent if path.name == _LOG else path.with_suffix("")
        yield named.relative_to(given).as_posix(), path


def _each(drives: Mapping[str, Path], given: Given, allowed: Tolerance) -> Iterator[Replayed]:
    """In order; several of them by as many processes as there are cores."""
    workers = min(len(drives), len(os.sched_getaffinity(0)))
    if workers == 1:
        for name, path in drives.items():
            yield _one(name, path, given, allowed)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(_one, name, path, given, allowed) for name, path in drives.items()]
        try:
            for one in waiting:
                yield one.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _one(name: str, path: Path, given: Given, allowed: Tolerance) -> Replayed:
    begin_s = time.monotonic()
    every: list[Answer] = []
    same, cycles, said = True, 0, ""
    unknown: Counter[str] = Counter()
    try:
        facts = log_facts(path)
        for life in read_lives(path, facts.names):
            setup = set_up(path, facts.car, life.controller, given)
            found = list(answers(setup, life))
            same &= setup.same
            cycles += len(life.cycles)
            missed = len(life.cycles) - len(found)
            unknown += Counter({f"the {given.host} host cannot be told what comes": missed})
            unknown += Counter(one.cycle.unknown for one in found if one.cycle.unknown)
            said = said or parting(found, setup.car, allowed, setup.same)
            every += found
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    left_out = ", ".join(f"{count} cycles ({why})" for why, count in unknown.items())
    took_s = time.monotonic() - begin_s
    return Replayed(name, rows_of(every), cycles, same, left_out, said, took_s)


# Files -------------------------------------------------------------------------------------------


def _baseline(folder: Path, name: str) -> NDArray[Any]:
    """Inputs of an earlier replay of that drive, or of a recording."""
    kept = folder / f"{name}.npz"
    if kept.is_file():
        try:
            with np.load(kept, allow_pickle=False) as arrays:
                rows: NDArray[Any] = arrays["rows"]
        except (OSError, KeyError, ValueError) as error:
            raise InputError(f"{kept} holds no replay ({error}): replay with --out again") from None
        if rows.dtype != ROWS:
            raise InputError(f"{kept} is of another release: replay with --out again")
        return rows
    for path in (folder / f"{name}.mcap", folder / name / _LOG):
        if path.is_file():
            every = [one for life in read_lives(path, log_facts(path).names) for one in life.cycles]
            recorded = [
                Answer(one, (one.sent.u[0], one.sent.u[1]), one.sent.status, one.how.fallback)
                for one in every
            ]
            return rows_of(recorded)
    raise InputError(f"{folder} holds neither {name}.npz nor a recording of that drive")


def _leave(out: Path, found: Sequence[Replayed], verdict: Verdict, took_s: float) -> None:
    """Inputs and a picture of each drive, and the result."""
    from bayesrace.studies.evidence.replay.picture import draw  # a second, which workers need not

    drives = []
    for one in found:
        kept = out / f"{one.name}.npz"
        kept.parent.mkdir(parents=True, exist_ok=True)
        with replacing(kept) as partial, partial.open("wb") as file:
            np.savez_compressed(file, rows=one.rows)
        draw(one, out / f"{one.name}.png")
        drives.append({
            "name": one.name, "cycles": one.cycles, "answered": len(one.rows), "same": one.same,
            "driven_s": one.driven_s, "seconds": one.seconds, "unknown": one.unknown,
            "parting": one.parting, "quality": one.quality,
        })  # fmt: skip
    driven_s = sum(one.driven_s for one in found)
    result = {
        "passed": verdict.passed, "text": verdict.text, "seconds": took_s,
        "times_real_time": driven_s / took_s, "drives": drives,
        "checks": [vars(one) for one in verdict.checks],
    }  # fmt: skip
    write_whole(out / "result.json", json.dumps(result, indent=1) + "\n")
