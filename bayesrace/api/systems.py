"""A plant and a controller as processes of their own that drive one run: for tests of systems."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bayesrace.api.controller import Controller
from bayesrace.api.runs import ended
from bayesrace.api.values import validated
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.gp.weights import Weights, write_weights
from bayesrace.operation.analysis.laps import judge, laps_in
from bayesrace.operation.lifecycle import SOURCES
from bayesrace.operation.race import plant_options
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.settings import RaceSettings, TimeMode
from bayesrace.operation.system import private_network, started_system
from bayesrace.raceline import RaceLine, write_raceline
from bayesrace.recorder import Recorder
from bayesrace.scene import Scene
from bayesrace.sensors import Sensors
from bayesrace.testing import RECORDING, SystemRun
from bayesrace.tracks import Track, write_track
from bayesrace.vehicles import Car, car_text, write_car

if TYPE_CHECKING:
    from bayesrace.codegen.problems.problem import Problem

__all__ = ["drive_system"]

_RUN: Final = 1


def drive_system(
    folder: Path,
    car: Car | Path | str = "orca",
    track: Track | Path | str = "harbour",
    laps: int = 2,
    *,
    mode: TimeMode = "lockstep",
    max_time_s: float | None = None,
    plant: Sequence[str | Path] = (),
    fmu: Path | str | None = None,
    sensors: Sensors | Path | str | None = None,
    world: Path | str | None = None,
    delay_ms: float = 0.0,
    seed: int = 0,
    controller: Sequence[str | Path] = (),
    line: RaceLine | None = None,
    weights: Weights | Path | str | None = None,
    problem: "str | Problem" = "tracking",
    horizon: int | None = None,
    settings: Mapping[str, Any] | None = None,
) -> SystemRun:
    """Drives one run of a plant and a controller process, which have ended when this returns or
    raises; they meet where only this user can, and leave everything in the empty ``folder``.

    ``mode``: ``"lockstep"`` (as fast as possible) or ``"realtime"``. ``max_time_s``: three times
    the racing line's time for so many laps, and 2 s, without. ``fmu`` to ``seed`` are options of
    ``bayesrace plant``, ``line`` to ``settings`` are as of :class:`bayesrace.Controller`.
    ``plant`` and ``controller`` are commands to start in place of the project's own; in them
    ``{plant}`` and ``{controller}`` stand for the endpoints at which the two listen, and ``{car}``,
    ``{track}``, ``{line}``, ``{weights}``, ``{settings}`` and ``{artefact}`` for files.

    InputError for what cannot be used, for a process that does not start, with its last words, and
    for a run that was broken off by anything but its laps, its time or the car's leaving the world.
    """
    simulated = {
        "fmu": fmu, "sensors": sensors, "world": world, "delay_s": delay_ms * 1e-3, "seed": seed,
    }  # fmt: skip
    if plant and (given := [name for name, value in simulated.items() if value]):
        name = "delay_ms" if given[0] == "delay_s" else given[0]
        raise InputError(f"{name}: the plant is a command of its own; give it there, or leave it")
    driver = Controller(
        car, track, line,
        problem=problem, weights=weights, horizon=horizon, settings=settings,
    )  # fmt: skip
    asked = simulated | {"car": driver.car, "laps": laps, "mode": mode}
    chosen = validated(RaceSettings, asked)
    limit_s = chosen.limit_s(driver.line.lap_time_s) if max_time_s is None else max_time_s
    plan = RunPlan(_RUN, "bayesrace", laps, limit_s, mode == "lockstep")
    names, options = _written(folder, driver)
    about = {"drive": {"car": car_text(driver.car), "track": driver.track.name}}
    with private_network() as network:
        names |= {one: getattr(network.network, one)[0] for one in SOURCES}
        commands = {"plant": plant, "controller": controller}
        own = {name: _filled(words, names) for name, words in commands.items() if words}
        with (
            started_system(
                driver.car.name, folder, plant_options(chosen, folder), configuration=network,
                # what others start need not know of links without priorities
                lockstep=plan.lockstep and not own, own=own,
            ) as system,
            Recorder(
                system.recording, driver.car.name, folder / RECORDING, about,
                scene=Scene(driver.car, driver.track, driver.line),
            ) as recorder,
            system.controller(options),
        ):  # fmt: skip
            end = system.drive(driver.track, plan, recorder)
            statuses = {source: system.director.status(source) for source in SOURCES}
    driven = laps_in(folder / RECORDING, _RUN, driver.track)
    verdict = judge(*driven, laps)
    if not 0 < laps <= len(driven.laps.times_s):  # all of the run counts
        off_m = driver.track.project_path(driven.samples["x"][:, :2]).off_track_m
        driven = driven._replace(off_track_m=off_m)
    return SystemRun(folder, driven, ended(end.text, driven.laps), verdict, laps, statuses)


def _written(folder: Path, driver: Controller) -> tuple[dict[str, Any], list[str]]:
    """What a controller process is started with, by name, and as options of the project's own."""
    files: dict[str, Any] = {
        "car": folder / "car.toml", "track": folder / "track.csv", "line": folder / "raceline.csv",
        "settings": folder / "mpc.json", "artefact": driver.artefact,
    }  # fmt: skip
    write_car(files["car"], driver.car)
    write_track(files["track"], driver.track)
    write_raceline(files["line"], driver.line)
    write_whole(files["settings"], driver._settings.model_dump_json(indent=1) + "\n")
    if driver.weights is not None:
        files["weights"] = folder / "weights.bin"
        write_weights(files["weights"], driver.weights)
    pairs = [("--raceline" if name == "line" else f"--{name}", files[name]) for name in files]
    return files, [str(one) for pair in pairs for one in pair]


def _filled(command: Sequence[str | Path], names: Mapping[str, Any]) -> list[str]:
    """The command's words with what stands in braces."""
    words = [str(word) for word in command]
    for name, value in names.items():
        words = [word.replace(f"{{{name}}}", str(value)) for word in words]
    return words
