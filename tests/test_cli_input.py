"""Input that cannot be used is refused before the work, in a line that names it and the remedy."""

import errno
import os
import resource
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NoReturn

import pytest

from bayesrace.gp.weights import write_weights, zero_weights
from bayesrace.integrators import Discretisation
from bayesrace.raceline import RaceLineSettings, write_raceline
from bayesrace.raceline.line import line_identity
from bayesrace.tracks import write_track
from bayesrace.transport import Director, free_endpoint
from bayesrace.vehicles import get_car, write_car
from tests.command_line import Cli, course_files, refused
from tests.conftest import Circuit
from tests.programs import finish, start


@pytest.fixture
def course(circuit: Circuit, tmp_path: Path) -> tuple[str | Path, ...]:
    """Options that name a track and its line, as files."""
    return course_files(tmp_path, circuit.track, circuit.line)


def test_an_unknown_command_or_option_is_refused(cli: Cli) -> None:
    refused(cli("drift"), "drift")
    refused(cli("rase"), "Did you mean 'race'")
    refused(cli("race", "--lap", "3"), "--lap")
    refused(cli("race", "--mode", "slow"), "lockstep", "realtime")
    refused(cli("race", "--laps", "0"), "--laps")
    refused(cli("race", "--laps", "101"), "--laps")
    refused(cli("race", "--caution", "1"), "--caution = 1.0: has to be less than 1 (probability")
    refused(cli("race", "--caution", "0.3"), "--caution: is a probability from 0.5 on")
    refused(cli("raceline", "paddock", "--friction", "-1"), "friction")


def test_an_unknown_track_or_car_is_refused_with_those_there_are(cli: Cli, tmp_path: Path) -> None:
    refused(cli("tracks", "nowhere"), "nowhere", "harbour", "paddock", "random:")
    refused(cli("tracks", "random:x"), "random:x", "random:7")
    refused(cli("raceline", "missing.csv"), "missing.csv", "harbour")
    refused(cli("race", "--track", "nowhere", "--out", "out"), "nowhere", "harbour")
    refused(cli("race", "--train-track", "nowhere", "--out", "out"), "nowhere")
    assert not (tmp_path / "out").exists()
    for command in ("race", "plant", "build"):
        refused(cli(command, "--car", "lorry"), "lorry", "orca")
    refused(cli("raceline", "paddock", "--car", "lorry"), "lorry", "orca")
    refused(cli("plant", "--car", "lorry.toml"), "lorry.toml", "bayesrace cars")


def test_cars_are_listed_checked_and_written(cli: Cli, tmp_path: Path) -> None:
    listed = cli("cars")
    assert listed.code == 0
    assert {"orca", "f1tenth"} <= set(listed.out.split())
    written = cli("cars", "orca", "--out", "mine.toml")
    checked = cli("cars", "mine.toml")
    assert (written.code, checked.code, checked.out) == (0, 0, written.out)
    saturating = cli("cars", "f1tenth", "--tyres", "pacejka", "--out", "saturating.toml")
    assert saturating.code == 0
    assert 'model = "pacejka"' in (tmp_path / "saturating.toml").read_text()
    refused(cli("cars", "orca", "--tyres", "linear"), "orca", "has pacejka tyres")
    refused(cli("cars", "--out", "x.toml"), "--out", "name")
    text = (tmp_path / "mine.toml").read_text()
    (tmp_path / "mine.toml").write_text(text.replace("mass_kg = 0.041", "mass_kg = -1"))
    refused(
        cli("cars", "mine.toml"), "mine.toml", "geometry.mass_kg = -1:", "greater than 0", "[kg]"
    )


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("0,0,.2,.2\n1,0,.2\n1,1,.2,.2\n", ("row 2", "3 columns")),
        ("0,0,.2,.2\n1,nan,.2,.2\n1,1,.2,.2\n", ("row 2", "not finite")),
        ("0,0,.2,.2\n1,x,.2,.2\n1,1,.2,.2\n", ("row 2", "not a number")),
        ("0,0,.2,.2\n1,1,.2,.2\n", ("points",)),
        ("", ("points",)),
    ],
)
def test_a_broken_track_file_is_refused_with_its_row(
    cli: Cli, tmp_path: Path, content: str, words: tuple[str, ...]
) -> None:
    path = tmp_path / "broken.csv"
    path.write_text(content)
    refused(cli("tracks", path), "broken.csv", *words)


def test_missing_and_wrong_input_files_are_refused(
    cli: Cli, course: tuple[str | Path, ...], kinematic_artefact: Path, tmp_path: Path
) -> None:
    (tmp_path / "junk").write_text("this is not what anybody expects here\n" * 9)
    (tmp_path / "empty").mkdir()
    track = course[:2]
    for argument in ("missing.csv", "junk"):
        refused(cli("collect", *track, "--raceline", argument), argument)
    for argument in ("missing.mcap", "junk", "empty"):
        refused(cli("train", argument), argument)
    for argument in ("missing", "junk", "empty"):
        refused(cli("report", argument), argument, "directory of a race")
        refused(cli("controller", "--artefact", argument, *course), argument, "bayesrace build")
    for argument in ("missing.bin", "junk"):
        outcome = cli(
            "controller", "--artefact", kinematic_artefact, *course, "--weights", argument
        )
        refused(outcome, argument)
    for argument in ("missing.json", "junk"):
        outcome = cli(
            "controller", "--artefact", kinematic_artefact, *course, "--settings", argument
        )
        refused(outcome, argument)


def test_a_line_for_another_car_is_refused_wherever_it_would_be_driven(
    cli: Cli, circuit: Circuit, kinematic_artefact: Path, tmp_path: Path
) -> None:
    car = get_car("orca").model_copy(update={"friction": 0.5})
    made = line_identity(circuit.track, car, RaceLineSettings())
    write_track(tmp_path / "track.csv", circuit.track)
    write_raceline(tmp_path / "line.csv", replace(circuit.line, made_for=made))
    course = ("--track", "track.csv", "--raceline", "line.csv")
    export = ("fmu", "export", "--controller", "--artefact", kinematic_artefact, "--out", "x.fmu")
    race = ("race", "--out", "run", "--no-limit")
    for command in (("controller", "--artefact", kinematic_artefact), ("collect",), export, race):
        refused(cli(*command, *course), "line.csv", "friction of 0.5", "has 0.75")
    write_car(tmp_path / "wet.toml", car)
    assert cli("collect", *course, "--duration", "1", "--car", "wet.toml").code == 0


def test_more_points_than_the_controller_holds_are_refused(
    cli: Cli, kinematic_artefact: Path
) -> None:
    """Before anything is learned for it."""
    for command in ("train", "learn"):
        outcome = cli(command, "--artefact", kinematic_artefact, "--points", "2000")
        refused(outcome, "--points 2000", "room for (1024)", "--gp-capacity")


def test_weights_of_another_discretisation_are_refused(
    cli: Cli, course: tuple[str | Path, ...], kinematic_artefact: Path, tmp_path: Path
) -> None:
    car = get_car("orca")
    euler = Discretisation(scheme="euler", step_s=0.02).identity("e_kinematic", car)
    write_weights(tmp_path / "euler.bin", zero_weights(car.name, euler))
    outcome = cli("controller", "--artefact", kinematic_artefact, *course, "--weights", "euler.bin")
    refused(outcome, "euler", "rk4")


def test_endpoints_that_cannot_be_used_are_refused(
    cli: Cli, course: tuple[str | Path, ...], kinematic_artefact: Path
) -> None:
    for command in (
        ("plant",),
        ("drive", "--log", "drive.mcap"),
        ("controller", "--artefact", kinematic_artefact, *course),
    ):
        refused(cli(*command, "--endpoint", "nonsense"), "nonsense", "tcp/127.0.0.1:")
        refused(cli(*command, "--endpoint", "tcp/127.0.0.1:99999"), "99999", "port")


def test_drive_without_plant_is_refused(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    patient = Director.wait_for
    monkeypatch.setattr(Director, "wait_for", lambda self, whom, _: patient(self, whom, 0.3))
    endpoints = ("--endpoint", free_endpoint(), "--endpoint", free_endpoint())
    refused(cli("drive", *endpoints), "no controller and no plant", "start it", "endpoints")


@pytest.mark.parametrize(
    "command",
    [
        ("tracks", "paddock", "--out"),
        ("raceline", "paddock", "--out"),
        ("collect", "--track", "paddock", "--raceline", "line.csv", "--out"),
        ("train", "log.mcap", "--out"),
        ("bench", "--json"),
        ("drive", "--log"),
    ],
    ids=lambda command: command[0],
)
def test_a_file_that_cannot_be_written_is_refused_before_the_work(
    cli: Cli, command: tuple[str, ...]
) -> None:
    refused(cli(*command, "nowhere/file"), "nowhere/file", "make it")
    refused(cli(*command, "."), "folder")


def test_an_output_folder_that_cannot_be_written_is_refused(
    cli: Cli, kinematic_artefact: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    refused(cli("race", "--out", "file"), "file")
    refused(cli("race", "--out", "file/race"), "file/race")
    refused(cli("build", "--out", "file/artefact"), "file/artefact")
    (tmp_path / "sources").mkdir()
    (tmp_path / "sources" / "br_step.c").write_text("of the user")
    refused(cli("build", "--out", "sources"), "sources", "new folder")
    if os.geteuid():
        (tmp_path / "locked").mkdir(mode=0o500)
        refused(cli("race", "--out", "locked/race"), "locked/race")


def test_settings_that_are_nested_without_end_are_refused(
    cli: Cli, course: tuple[str | Path, ...], kinematic_artefact: Path, tmp_path: Path
) -> None:
    settings = tmp_path / "mpc.json"
    settings.write_text("[" * 100_000)
    arguments = ("controller", "--artefact", kinematic_artefact, *course)
    refused(cli(*arguments, "--settings", settings), "mpc.json")


@pytest.mark.parametrize(
    ("command", "limits", "said"),
    [
        (("status", "--timeout", "0.1"), (16, 16), "may open 16 files and connections at once"),
        (("race",), (16, 16), "may open 16 files and connections at once"),
        (("status", "--timeout", "0.1"), (16, 64), "no connection to"),  # the limit can be raised
    ],
)
def test_too_few_descriptors_are_said_before_the_work(
    command: tuple[str, ...], limits: tuple[int, int], said: str
) -> None:
    limited = partial(resource.setrlimit, resource.RLIMIT_NOFILE, limits)
    end = ("--endpoint", free_endpoint()) if command[0] == "status" else ()
    done = finish(start(*command, *end, preexec_fn=limited))
    assert done.returncode == 2
    assert said in done.stderr.splitlines()[-1]
    assert "panicked" not in done.stderr


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENOSPC, errno.EACCES])
def test_what_the_system_is_short_of_does_not_end_a_service_for_good(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """Exit code 2 is not restarted."""
    where, code = Path("settings.toml"), 2 if number == errno.EACCES else 75

    def fails(*_: object) -> NoReturn:
        raise OSError(number, os.strerror(number), str(where))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", fails)
        outcome = cli("plant", "--config", where)
    refused(outcome, "settings.toml", os.strerror(number), code=code)
    monkeypatch.setattr("bayesrace.plant.process.main", fails)
    refused(cli("plant"), "settings.toml", os.strerror(number), code=code)


def test_devices_are_not_read_without_end(cli: Cli, tmp_path: Path) -> None:
    refused(cli("publish", "/dev/zero"), "weights file /dev/zero is longer than 1 MB")
    refused(cli("fmu", "inspect", "/dev/zero"), "no FMU at /dev/zero")
    refused(cli("train", "/dev/zero", "--out", tmp_path / "weights.bin"), "no log at /dev/zero")
