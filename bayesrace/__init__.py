"""BayesRace: a race car driven at its limit by GP-MPC that learns from its own laps.

    import bayesrace as br

    car = br.Car.load("orca")
    track = br.Track.load("harbour")
    line = br.racing_line(track, car)
    controller = br.Controller(car, track, line)
    run = br.drive(controller, br.Simulator(car, track), laps=2)
    controller.weights = br.train(run)
    learned = br.drive(controller, br.Simulator(car, track), laps=2)
    print(run.laps, learned.laps)
    learned.plot().savefig("learned.png")

What ``__all__`` names is public, and besides the modules ``gym`` and ``testing``, which need other
packages; nothing else is. It is imported when it is first used.
docs/index.md explains each line.
"""

from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from bayesrace import gym as gym
    from bayesrace import ocp as ocp
    from bayesrace import testing as testing
    from bayesrace.api.controller import Controller as Controller
    from bayesrace.api.controller import Step as Step
    from bayesrace.api.controller import Times as Times
    from bayesrace.api.logs import Log as Log
    from bayesrace.api.mpc import Mpc as Mpc
    from bayesrace.api.mpc import Solution as Solution
    from bayesrace.api.runs import Run as Run
    from bayesrace.api.runs import drive as drive
    from bayesrace.api.simulator import OwnSimulator as OwnSimulator
    from bayesrace.api.simulator import Simulator as Simulator
    from bayesrace.api.training import Drive as Drive
    from bayesrace.api.training import residuals as residuals
    from bayesrace.api.training import train as train
    from bayesrace.api.values import Input as Input
    from bayesrace.api.values import State as State
    from bayesrace.codegen.problems.problem import Problem as Problem
    from bayesrace.controller.driver import Level as Level
    from bayesrace.controller.native_step import Status as Status
    from bayesrace.errors import InputError as InputError
    from bayesrace.gp.weights import Weights as Weights
    from bayesrace.raceline import RaceLine as RaceLine
    from bayesrace.raceline import RaceLineSettings as RaceLineSettings
    from bayesrace.raceline import racing_line as racing_line
    from bayesrace.tracks import Track as Track
    from bayesrace.vehicles import Car as Car

__version__: str

_PLACES: Final = {
    "Car": "vehicles", "Controller": "api.controller", "Drive": "api.training",
    "Input": "api.values", "InputError": "errors", "Level": "controller.driver", "Log": "api.logs",
    "Mpc": "api.mpc", "OwnSimulator": "api.simulator", "Problem": "codegen.problems.problem",
    "RaceLine": "raceline", "RaceLineSettings": "raceline", "Run": "api.runs",
    "Simulator": "api.simulator", "Solution": "api.mpc", "State": "api.values",
    "Status": "controller.native_step",
    "Step": "api.controller", "Times": "api.controller", "Track": "tracks",
    "Weights": "gp.weights", "drive": "api.runs", "gym": "", "ocp": "",
    "racing_line": "raceline", "residuals": "api.training", "testing": "",
    "train": "api.training",
}  # fmt: skip
"""The module of each public name; empty: it is a module itself."""

_OPTIONAL: Final = ("gym", "testing")
"""Modules that need packages of other extras."""

__all__ = ["__version__", *(name for name in _PLACES if name not in _OPTIONAL)]


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first used: that takes longer than to print a help."""
    from importlib import import_module

    if name == "__version__":
        return _version()
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    place = _PLACES[name]
    if name == "ocp" or place.startswith(("api", "codegen")):
        _check_packages()
    if not place:
        return import_module(f"{__name__}.{name}")
    found = getattr(import_module(f"{__name__}.{place}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)


def _check_packages() -> None:
    """InputError on a host that only controls, which has not all that this interface needs."""
    from importlib.util import find_spec

    from bayesrace.errors import InputError

    for package in ("casadi", "mcap", "scipy"):
        if find_spec(package) is None:
            raise InputError(
                f"the Python interface needs {package}, which is not installed: "
                "pip install 'bayesrace[race]'"
            )


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("bayesrace")
    except PackageNotFoundError:  # a source tree that was never installed
        return "0+unknown"
