"""The plugin for pytest: laps in this process, or of two processes, as fixtures; and how to assert
a lap. docs/pytest.md has a test project.

pytest loads this module in every project where bayesrace is installed: it imports pytest and the
standard library alone, and does nothing until one of its fixtures is used.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import pytest

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from bayesrace.api.logs import Log
    from bayesrace.api.runs import Run
    from bayesrace.api.simulator import OwnSimulator, Simulator
    from bayesrace.arrays import Floats
    from bayesrace.messages import Status
    from bayesrace.operation.analysis.laps import DrivenLaps, Verdict
    from bayesrace.sensors import Sensors
    from bayesrace.tracks import Track
    from bayesrace.vehicles import Car

__all__ = ["SystemRun", "assert_lap"]

RECORDING: Final = "run.mcap"


class AnyRun(Protocol):
    """What both fixtures return: a run in one process, or of two."""

    @property
    def laps(self) -> tuple[float, ...]:
        """Lap times [s], the first from the start state."""

    @property
    def asked(self) -> int:
        """Laps that were to be driven; 0: no number."""

    @property
    def off_track(self) -> int:
        """States of these laps, or of a run that did not drive them, that are off the track."""

    @property
    def off_track_m(self) -> "Floats":
        """How far the car's centre is outside the track at each of these [m]; negative inside."""

    @property
    def level(self) -> "NDArray[np.int64]":
        """Who gave the inputs: :class:`bayesrace.Level`."""

    @property
    def end(self) -> str:
        """Why the run ended, a sentence."""


@dataclass(frozen=True, eq=False)
class SystemRun:
    """What a plant and a controller process have driven, by the recording of their messages."""

    folder: Path
    """Holds the recording, the outputs of the processes, and the files they were started with."""
    driven: "DrivenLaps"
    """What the verdict follows from."""
    end: str
    """Why the run ended, a sentence of the plant's."""
    verdict: "Verdict"
    """Of ``bayesrace drive``: ``passed``, if the laps were driven on the track, by solutions of the
    control problem for half of the time or more; and ``text``, a sentence."""
    asked: int
    """Laps that were to be driven; 0: no number."""
    statuses: Mapping[str, "Status"]
    """Of ``plant`` and ``controller`` after the run: among others their counters by name."""

    @property
    def laps(self) -> tuple[float, ...]:
        """Lap times [s], the first from the start state; interpolated at the line."""
        return self.driven.laps.times_s

    @property
    def off_track(self) -> int:
        """States of the laps that were asked for, or of a run that did not drive them, that are off
        the track."""
        return int((self.off_track_m > 0).sum())

    @property
    def off_track_m(self) -> "Floats":
        """How far the car's centre is outside the track at each of these [m]; negative inside."""
        return self.driven.off_track_m

    @cached_property
    def level(self) -> "NDArray[np.int64]":
        """Who gave the input of each control cycle: :class:`bayesrace.Level`, shape (m,)."""
        found: NDArray[np.int64] = self.log["telemetry"]["fallback"]
        return found

    @cached_property
    def log(self) -> "Log":
        """The recording (MCAP)."""
        from bayesrace.api.logs import Log

        return Log(self.folder / RECORDING)

    def __repr__(self) -> str:
        return f"<SystemRun in {self.folder}: {self.verdict.text}>"


def assert_lap(
    run: AnyRun, at_most_s: float | None = None, *, off_track: int = 0, lap: int = -1
) -> None:
    """AssertionError unless all laps were driven, this one in that time, and on the track.

    ``at_most_s``: of the lap [s]; any time without. ``off_track``: samples of the laps, one a
    period, that may be off the track. ``lap``: index into ``run.laps``; the last without, 0 is the
    one from the start. The message says laps, samples off and how far, fallbacks, and why the run
    ended.
    """
    __tracebackhide__ = True
    faults = []
    if len(run.laps) < run.asked:
        faults.append(f"{len(run.laps)} of {run.asked} laps were driven")
    if not -len(run.laps) <= lap < len(run.laps):
        faults.append(f"laps[{lap}] was not driven")
    elif at_most_s is not None and not run.laps[lap] <= at_most_s:
        faults.append(f"laps[{lap}] took {run.laps[lap]:.3f} s, more than {at_most_s:g} s")
    if run.off_track > off_track:
        faults.append(f"{run.off_track} samples are off the track, more than {off_track}")
    if not faults:
        return
    times = ", ".join(f"{one:.3f}" for one in run.laps)
    deepest_m = max([0.0, *run.off_track_m])
    raise AssertionError(
        f"{'; '.join(faults)}\n  laps: {f'{times} s' if times else 'none'}"
        f"\n  off the track: {run.off_track} samples, deepest {deepest_m:.3f} m"
        f"\n  fallbacks: {int((run.level > 0).sum())}\n  end: {run.end}"
    )


@pytest.fixture(scope="session")
def bayesrace_loop() -> "Callable[..., Run]":
    """Drives laps in this process: call it with the arguments of docs/pytest.md."""
    return _loop


@pytest.fixture
def bayesrace_system(request: pytest.FixtureRequest, tmp_path: Path) -> "Callable[..., SystemRun]":
    """Drives laps by a plant and a controller process: call it with the arguments of
    docs/pytest.md. Each call has a folder in ``tmp_path``, which a failure's report names."""
    numbers = count(1)

    def drive(*arguments: Any, **options: Any) -> "SystemRun":
        from bayesrace.api.systems import drive_system

        folder = tmp_path / f"bayesrace_system-{next(numbers)}"
        folder.mkdir()
        # now, and not when the test has failed: what ends the test may end this function
        kept = f"kept in {folder}: {RECORDING}, plant.log, controller.log"
        request.node.add_report_section("call", "bayesrace_system", kept)
        return drive_system(folder, *arguments, **options)

    return drive


def _loop(
    car: "Car | Path | str" = "orca",
    track: "Track | Path | str" = "harbour",
    laps: int = 2,
    *,
    simulator: "Simulator | OwnSimulator | None" = None,
    max_time_s: float | None = None,
    log: "Path | str | None" = None,
    fmu: "Path | str | None" = None,
    sensors: "Sensors | Path | str | None" = None,
    world: "Path | str | None" = None,
    delay_ms: float = 0.0,
    seed: int = 0,
    **controller: Any,
) -> "Run":
    """One run of :func:`bayesrace.drive`.

    ``simulator``: your own; else there is a :class:`bayesrace.Simulator` with ``fmu`` to ``seed``.
    ``controller``: options of :class:`bayesrace.Controller`, such as ``weights``.

    InputError for what cannot be driven; what your simulator raises passes through.
    """
    import bayesrace as br

    options: Mapping[str, Any] = {
        "fmu": fmu, "sensors": sensors, "world": world, "delay_ms": delay_ms, "seed": seed,
    }  # fmt: skip
    given = [name for name, value in options.items() if value]
    if simulator is not None and given:
        raise br.InputError(f"{given[0]}: the simulator is your own; give it there, or leave it")
    driver = br.Controller(car, track, **controller)
    with ExitStack() as opened:
        if simulator is None:
            simulator = opened.enter_context(
                br.Simulator(
                    driver.car, driver.track, fmu=fmu, world=world, delay_s=delay_ms * 1e-3,
                    sensors=driver.car.sensors if sensors is None else sensors, seed=seed,
                )
            )  # fmt: skip
        return br.drive(driver, simulator, laps, max_time_s=max_time_s, log=log)
