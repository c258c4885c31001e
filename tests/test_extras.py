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

NEEDED = {"cffi", "eclipse-zenoh", "msgpack", "numpy", "pydantic", "typer"}
NOT_NEEDED = {"casadi", "fmpy", "jinja2", "matplotlib", "mcap", "pint", "scipy"}


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


def test_a_missing_package_of_campaigns_is_named_with_its_extra(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("page", "summary", "results"):
        monkeypatch.delitem(sys.modules, f"bayesrace.studies.campaign.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "pandas", None)
    refused(cli("campaign-report", tmp_path), "pandas", "bayesrace[campaign]")


def test_a_missing_package_of_certificates_is_named_with_its_extra(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "bayesrace.operation.certificates", raising=False)
    monkeypatch.setitem(sys.modules, "cryptography", None)
    refused(cli("certs", "init"), "cryptography", "bayesrace[certificates]")


def test_a_missing_package_is_named_with_the_extra_that_brings_it(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    fmu = packed_car()
    for name in [one for one in sys.modules if one.startswith(("bayesrace.plant.fmu", "fmpy"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "fmpy", None)
    refused(cli("fmu", "inspect", fmu), "fmpy", "bayesrace[fmu]")
