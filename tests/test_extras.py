"""A controller host needs few packages: the controller drives without any other."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from bayesrace.operation.preparation import prepare
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.system import started_system
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.vehicles import DEFAULT_CAR
from tests.car_fmu import packed_car
from tests.command_line import Cli, refused
from tests.programs import ROOT, peanut

UNIT = ROOT / "examples" / "systemd" / "bayesrace@.service"

NEEDED = {"cffi", "cryptography", "eclipse-zenoh", "msgpack", "numpy", "pydantic", "typer"}
NOT_NEEDED = {"casadi", "fmpy", "jinja2", "matplotlib", "mcap", "scipy"}


def pins(name: str) -> dict[str, str]:
    """Packages and versions of a list."""
    found = re.findall(r"^([\w.-]+)==(\S+)", (ROOT / name).read_text(), re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", package).lower(): version for package, version in found}


def test_the_hashes_are_of_the_constraints_and_name_no_host() -> None:
    assert pins("constraints.hashed.txt") == pins("constraints.txt"), "run 'make hashes'"
    text = re.sub("^#.*\n", "", (ROOT / "constraints.hashed.txt").read_text(), flags=re.MULTILINE)
    hashed = r"[\w.-]+==[\w.+!-]+( ; [^\\\n]+)?( \\\n    --hash=sha256:[0-9a-f]{64})+\n"
    assert re.fullmatch(f"({hashed})+", text)


def test_what_is_not_for_every_python_is_marked_so_in_every_list() -> None:
    marked = [
        set(re.findall(r"^[ \"]*([\w-]+)[=>][^;\n]*; ?python_", text, re.MULTILINE))
        for name in ("pyproject.toml", "constraints.txt", "constraints.hashed.txt")
        if (text := (ROOT / name).read_text())
    ]
    assert marked == [{"slipx"}] * 3


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("release")
    made = [f"{name}={folder / part}" for name, part in (("RELEASE", "files"), ("LISTED", "env"))]
    done = subprocess.run(
        ["make", "release", *made], cwd=ROOT, check=False, capture_output=True, text=True
    )
    if "Failed to fetch" in done.stderr:
        pytest.skip("no package index can be reached, from which a release is installed")
    assert done.returncode == 0, done.stderr
    return folder / "files"


@pytest.mark.check
def test_a_release_lists_what_users_install(release: Path) -> None:
    """And says nothing about the machine that made it."""
    text = (release / "bayesrace.cdx.json").read_text()
    listed = json.loads(text)
    versions = {one["purl"].partition("@")[0]: one["version"] for one in listed["components"]}
    known = {f"pkg:pypi/{name}": version for name, version in pins("constraints.txt").items()}
    assert versions.items() <= known.items()
    assert versions.keys() >= {f"pkg:pypi/{one}" for one in NEEDED | NOT_NEEDED | {"pyarrow"}}
    assert listed["metadata"]["component"]["name"] == "bayesrace"
    assert not [path for path in (ROOT, release, Path.home()) if str(path) in text]


def on_a_board(environment: Path) -> str:
    """The commands by which the unit's head installs a controller."""
    head, _, _ = UNIT.read_text().partition("[Unit]")
    words = "(?:sha256sum|grep|sed|python3 -m venv|/opt/bayesrace/bin/pip) .*"
    commands = "\n".join(re.findall(f"^#   ({words}?)(?:   .*)?$", head, re.MULTILINE))
    return commands.replace("python3", sys.executable).replace("/opt/bayesrace", str(environment))


@pytest.mark.check
def test_the_controller_drives_with_its_own_extra_alone(
    release: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file whose hash differs is not installed."""
    commands, python = on_a_board(tmp_path / "env"), str(tmp_path / "env" / "bin" / "python")
    subprocess.run(["sh", "-ec", commands], cwd=release, check=True)
    install = [python, "-m", "pip", "install", "--force-reinstall", "--require-hashes"]
    right = (release / "constraints.hashed.txt").read_text()
    cffi = re.search(r"^cffi==.*\n( .*\n)+", right, re.MULTILINE)
    assert cffi
    forged = re.sub("sha256:[0-9a-f]{4}", "sha256:0000", cffi[0])
    (release / "forged.txt").write_text(right.replace(cffi[0], forged))
    fails = subprocess.run(
        [*install, "-c", "forged.txt", "-r", "bayesrace.txt"], cwd=release, capture_output=True
    )
    assert b"DO NOT MATCH THE HASHES" in fails.stderr
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
