"""A controller host needs few packages: the controller drives without any other."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from bayesrace.operation.drive import RunPlan
from bayesrace.operation.preparation import prepare
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.system import started_system
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.vehicles import DEFAULT_CAR
from tests.car_fmu import packed_car
from tests.command_line import Cli, refused
from tests.programs import ROOT, peanut

NEEDED = {"cffi", "cryptography", "eclipse-zenoh", "msgpack", "numpy", "pydantic", "typer"}
NOT_NEEDED = {"casadi", "fmpy", "jinja2", "matplotlib", "mcap", "scipy"}


@pytest.mark.check
@pytest.mark.unmeasured
def test_the_controller_drives_with_its_own_extra_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    python = str(tmp_path / "env" / "bin" / "python")
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "env"], check=True)
    install = [python, "-m", "pip", "install", "--quiet", "--no-compile", "-c", "constraints.txt"]
    subprocess.run([*install, "hatchling"], cwd=ROOT, check=True)
    project = ["--no-build-isolation", f"{ROOT}[controller]"]  # as a wheel
    subprocess.run([*install, *project], cwd=ROOT, check=True)
    listed = subprocess.run(
        [python, "-m", "pip", "list", "--format", "json"], capture_output=True, check=True
    )
    installed = {package["name"].lower() for package in json.loads(listed.stdout)}
    assert installed >= NEEDED
    assert not installed & NOT_NEEDED
    with stages_on(Console(quiet=True)) as stages:
        files = prepare(PreparationSettings(), (str(peanut(tmp_path / "peanut.csv")),), stages)
    with started_system(DEFAULT_CAR, tmp_path) as system:
        monkeypatch.setattr("bayesrace.operation.system.RUN_MODULE", (python, "-P", "-m"))
        with system.controller(files.arguments):
            end = system.drive(files.first.track, RunPlan(1, "bayesrace", 1, 20.0, lockstep=True))
    assert end.data["reason"] == "laps"


@pytest.mark.parametrize(
    ("modules", "package", "command", "extra"),
    [
        ("studies.campaign.report studies.campaign.results", "pandas",
         "campaign-report .", "campaign"),
        ("plant.fmu", "fmpy", "fmu inspect FMU", "fmu"),
    ],
)  # fmt: skip
def test_a_missing_package_is_named_with_the_extra_that_brings_it(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, modules: str, package: str, command: str, extra: str
) -> None:
    fmu = packed_car()
    users = tuple(f"bayesrace.{one}" for one in modules.split())
    for name in [one for one in sys.modules if one.startswith((*users, package))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    refused(cli(*command.replace("FMU", str(fmu)).split()), package, f"bayesrace[{extra}]")
