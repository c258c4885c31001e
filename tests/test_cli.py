"""The command line: help that reads well, errors in one line, and the chain of files by hand."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from bayesrace.gp.weights import write_weights, zero_weights
from bayesrace.integrators import Discretisation
from bayesrace.log import LogReader
from bayesrace.messages import ACTUATION, EVENT, STATE, TELEMETRY
from bayesrace.raceline import RaceLineSettings, write_raceline
from bayesrace.raceline.identity import line_identity
from bayesrace.tracks import write_track
from bayesrace.transport import Director, free_endpoint
from bayesrace.vehicles import get_car, write_car
from operation.processes import child
from tests.command_line import Cli, refused
from tests.conftest import Circuit
from tests.programs import environment, finish, peanut, run, start, until

SUBCOMMANDS = (
    "race", "drive", "report", "bench", "tracks", "cars", "raceline", "collect", "train", "build",
    "export", "limit",
    "plant", "controller", "status", "stop", "go", "router", "latency",
    "fmu export", "fmu inspect", "fmu weights",
    "validate", "publish", "rollback", "learn",
    "campaign", "campaign-report", "campaign-worker", "tune", "paper",
    "config show", "config check", "config example", "doctor",
    "certs init", "certs add", "certs list", "certs revoke",
)  # fmt: skip


@pytest.fixture
def course(circuit: Circuit, tmp_path: Path) -> tuple[str | Path, ...]:
    """Arguments that name a track and its line, as files."""
    track, line = tmp_path / "track.csv", tmp_path / "line.csv"
    write_track(track, circuit.track)
    write_raceline(line, circuit.line)
    return "--track", track, "--raceline", line


# Help ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["", *SUBCOMMANDS])
def test_help_reads_well(cli: Cli, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal of 80 columns nothing is cut, neither texts nor defaults."""
    monkeypatch.setenv("COLUMNS", "80")
    outcome = cli(*name.split(), "-h")
    assert outcome.code == 0
    assert "…" not in outcome.out
    assert max(map(len, outcome.out.splitlines())) <= 80
    assert "Usage: bayesrace" in outcome.out
    # what only our own processes say to each other, and Python's own words
    for internal in ("parent-pid", "parent_pid", "None", "typer", "Traceback", "TODO"):
        assert internal not in outcome.out
    assert "--help" in outcome.out
    if not name:
        assert all(command.split()[0] in outcome.out for command in SUBCOMMANDS)
        tasks = ("Race", "Prepare", "Drive", "Learn while driving", "Measure", "Export to other")
        assert all(f"\n{task}" in outcome.out for task in tasks)
        assert "--install-completion" in outcome.out


def test_every_option_says_what_it_is(cli: Cli) -> None:
    import typer
    from typer.core import TyperGroup

    from operation.cli.app import app

    def leaves(command: Any, *names: str) -> dict[str, Any]:
        if not isinstance(command, TyperGroup):
            return {" ".join(names): command}
        context: Any = None
        below = {one: command.get_command(context, one) for one in command.list_commands(context)}
        return {k: v for name, one in below.items() for k, v in leaves(one, *names, name).items()}

    commands = leaves(typer.main.get_command(app))
    assert sorted(commands) == sorted(SUBCOMMANDS)
    for name, command in commands.items():
        assert command.help, name
        for parameter in command.params:
            text = getattr(parameter, "help", "")
            assert getattr(parameter, "hidden", False) or text, f"{name} {parameter.name}"


def test_help_and_version_import_nothing_that_they_do_not_need() -> None:
    """They would take four times as long: numpy, pydantic and Rich are for the commands."""
    program = (
        "import sys\n"
        "from operation.cli import main\n"
        "try:\n"
        "    main()\n"
        "except SystemExit:\n"
        "    print(sorted({'numpy', 'pydantic', 'rich', 'zenoh'} & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, "--help"], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_without_a_command_help_is_shown(cli: Cli) -> None:
    outcome = cli()
    assert "Usage: bayesrace" in outcome.out + outcome.err
    assert "bayesrace: \n" not in outcome.err


def test_version(cli: Cli) -> None:
    outcome = cli("--version")
    assert outcome.code == 0
    assert re.fullmatch(r"bayesrace \d+\.\d+\.\d+\n", outcome.out)


# Bad input -------------------------------------------------------------------------------------


def test_an_unknown_command_or_option_is_refused(cli: Cli) -> None:
    refused(cli("drift"), "drift")
    refused(cli("rase"), "Did you mean 'race'")
    refused(cli("race", "--lap", "3"), "--lap")
    refused(cli("race", "--mode", "slow"), "lockstep", "realtime")
    refused(cli("race", "--laps", "0"), "--laps")
    refused(cli("race", "--laps", "101"), "--laps")
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
    refused(cli("cars", "mine.toml"), "mine.toml", "geometry.mass_kg = -1 kg", "greater than 0")


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
    for command in (("controller", "--artefact", kinematic_artefact), ("collect",), export):
        refused(cli(*command, *course), "line.csv", "friction of 0.5", "has 0.75")
    write_car(tmp_path / "wet.toml", car)
    assert cli("collect", *course, "--duration", "1", "--car", "wet.toml").code == 0


def test_more_points_than_the_controller_holds_are_refused(
    cli: Cli, kinematic_artefact: Path
) -> None:
    """Before anything is learned for it."""
    for command in ("train", "learn"):
        outcome = cli(command, "--artefact", kinematic_artefact, "--points", "20000")
        refused(outcome, "--points 20000", "room for (1024)", "--gp-capacity")


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
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        refused(cli("plant", "--endpoint", endpoint), endpoint, "in use", "another endpoint")
        artefact = ("--artefact", kinematic_artefact)
        outcome = cli("controller", *artefact, *course, "--listen", endpoint)
        refused(outcome, endpoint, "in use", "another endpoint")


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
    if os.geteuid():
        (tmp_path / "locked").mkdir(mode=0o500)
        refused(cli("race", "--out", "locked/race"), "locked/race")


def test_the_program_itself_fails_as_its_entry_point(tmp_path: Path) -> None:
    """Once as a real process: code, one line, nothing else."""
    done = run("tracks", tmp_path / "missing.csv")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("bayesrace: no track ")
    assert len(done.stderr.splitlines()) == 1


# The chain, by files ---------------------------------------------------------------------------


def _succeed(*arguments: str | Path) -> str:
    done = run(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def ended() -> Iterator[list[subprocess.Popen[str]]]:
    """Processes that must not outlive the test."""
    processes: list[subprocess.Popen[str]] = []
    yield processes
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.mark.check
def test_the_chain_by_files_in_four_terminals(
    tmp_path: Path, ended: list[subprocess.Popen[str]]
) -> None:
    track, line, log = (tmp_path / name for name in ("track.csv", "line.csv", "collect.mcap"))
    weights, artefact, drive_log = (tmp_path / name for name in ("w.bin", "mpc", "drive.mcap"))
    quick = ("--kernel", "rbf", "--restarts", "0")
    assert "peanut" in _succeed("tracks", peanut(tmp_path / "peanut.csv"), "--out", track)
    assert str(line) in _succeed("raceline", track, "--out", line)
    assert "600 samples" in _succeed("collect", "--track", track, "--raceline", line, "--out", log)
    assert "samples" in _succeed("train", log, "--out", weights, "--points", "60", *quick)
    assert _succeed("build", "--out", artefact).strip() == str(artefact)

    plant_at, controller_at = free_endpoint(), free_endpoint()
    files = ("--artefact", artefact, "--track", track, "--raceline", line, "--weights", weights)
    plant = start("plant", "--endpoint", plant_at)
    controller = start("controller", *files, "--endpoint", plant_at, "--listen", controller_at)
    ended += [plant, controller]
    where = ("--endpoint", plant_at, "--endpoint", controller_at)
    # Twice: a plant waits for the next run.
    for _ in range(2):
        said = _succeed("drive", "--track", track, "--laps", "1", *where, "--log", drive_log)
    assert "1 lap(s) done" in said
    assert str(drive_log) in said
    controller.send_signal(signal.SIGINT)
    plant.send_signal(signal.SIGTERM)
    assert finish(controller).returncode == 0
    assert finish(plant).returncode == 0

    reader = LogReader(drive_log)
    states, actuations = reader.select(STATE), reader.select(ACTUATION)
    assert not reader.truncated
    assert reader.refused == 0
    assert len(states) > 100
    assert {state.run for state in states} == {2}
    # the last state of a run needs no answer
    assert states[-1].final
    assert [a.state_seq for a in actuations] == [s.seq for s in states[:-1]]
    assert {a.weights_version for a in actuations} == {actuations[0].weights_version} != {""}
    assert len(reader.select(TELEMETRY)) == len(actuations)
    kinds = [event.kind for event in reader.select(EVENT)]
    assert kinds == ["run", "run_started", "run_ended"]
    # what was driven can be learned from
    assert "samples" in _succeed(
        "train", log, drive_log, "--out", weights, "--points", "60", *quick
    )


@dataclass
class Waiting:
    """A plant and a controller that wait for a run."""

    plant: subprocess.Popen[str]
    controller: subprocess.Popen[str]
    plant_at: str
    where: tuple[str, ...]
    """Endpoints of both, as options."""


@pytest.fixture
def waiting(
    course: tuple[str | Path, ...], kinematic_artefact: Path, ended: list[subprocess.Popen[str]]
) -> Waiting:
    plant_at, controller_at = free_endpoint(), free_endpoint()
    plant = start("plant", "--endpoint", plant_at)
    files = ("--artefact", kinematic_artefact, *course)
    controller = start("controller", *files, "--endpoint", plant_at, "--listen", controller_at)
    ended += [plant, controller]
    where = ("--endpoint", plant_at, "--endpoint", controller_at)
    return Waiting(plant, controller, plant_at, where)


def test_drive_refuses_another_track_than_the_controllers(cli: Cli, waiting: Waiting) -> None:
    outcome = cli("drive", "--track", "paddock", *waiting.where)
    refused(outcome, "the controller drives the track '", "this run is on 'paddock-", "--track")


@pytest.mark.check
def test_drive_says_when_the_controller_is_lost(
    tmp_path: Path,
    course: tuple[str | Path, ...],
    waiting: Waiting,
    ended: list[subprocess.Popen[str]],
) -> None:
    """The run breaks off, so drive fails; the plant is ready for the next controller."""
    log = tmp_path / "drive.mcap"
    many = ("--laps", "10000", "--max-time", "3600")
    drive = start("drive", *course[:2], *many, *waiting.where, "--log", log)
    ended.append(drive)
    until(lambda: log.exists() and log.stat().st_size > 100_000, "a lap in progress")
    waiting.controller.kill()
    done = finish(drive)
    assert done.returncode not in (0, None)
    assert "Traceback" not in done.stderr
    assert "controller vanished" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert LogReader(log).select(STATE)
    assert waiting.plant.poll() is None


@pytest.mark.check
@pytest.mark.wall_clock
def test_a_run_whose_director_is_gone_ends_by_itself_or_by_a_command(
    tmp_path: Path,
    course: tuple[str | Path, ...],
    waiting: Waiting,
    ended: list[subprocess.Popen[str]],
) -> None:
    """Nothing watches or records it any more; until then a new one is refused with the remedy."""
    long = ("drive", *course[:2], "--laps", "10000", "--max-time", "3600", "--mode", "realtime")

    def words() -> str:
        state = json.loads(run("status", "--json", *waiting.where).stdout)["cars"]["orca"]["plant"]
        return f"{state['phase']}: {state['text']}"

    def killed(log: Path) -> None:
        drive = start(*long, *waiting.where, "--log", log)
        ended.append(drive)
        until(lambda: log.exists() and log.stat().st_size > 50_000, "a run in progress")
        drive.kill()

    killed(tmp_path / "one.mcap")
    busy = run(*long, *waiting.where, "--log", tmp_path / "two.mcap")
    assert busy.returncode == 2
    assert "'bayesrace stop --run' ends it" in busy.stderr
    done = run("stop", "--run", "--endpoint", waiting.plant_at)
    assert (done.returncode, "stops" in done.stdout) == (0, True), done.stderr
    until(lambda: words().startswith("idle"), "the end of the run")
    killed(tmp_path / "three.mcap")
    until(lambda: "has been gone for 10 s" in words(), "the end of another")
    assert words().startswith("idle")


@pytest.mark.check
@pytest.mark.wall_clock
def test_a_run_in_which_the_car_was_not_driven_is_no_success(
    tmp_path: Path,
    course: tuple[str | Path, ...],
    waiting: Waiting,
    ended: list[subprocess.Popen[str]],
) -> None:
    log = tmp_path / "drive.mcap"
    drive = start(
        "drive", *course[:2], "--laps", "1000", "--max-time", "4", "--mode", "realtime",
        *waiting.where, "--log", log,
    )  # fmt: skip
    ended.append(drive)
    until(lambda: log.exists() and log.stat().st_size > 20_000, "a run in progress")
    waiting.controller.send_signal(signal.SIGSTOP)
    try:
        done = finish(drive)
    finally:
        waiting.controller.send_signal(signal.SIGCONT)
    assert done.returncode == 2
    assert "the car was not driven in" in done.stderr


@pytest.mark.parametrize("command", ["tracks", "train"])
def test_a_terminal_without_our_characters_gets_others(tmp_path: Path, command: str) -> None:
    more = {"tracks": (), "train": (tmp_path / "nö.mcap", "--out", tmp_path / "weights.bin")}
    around = {**environment(), "PYTHONIOENCODING": "ascii"}
    done = finish(start(command, *more[command], env=around))
    assert "Traceback" not in done.stderr
    assert done.returncode == {"tracks": 0, "train": 2}[command]


def test_names_do_not_command_the_terminal(cli: Cli) -> None:
    refused(cli("tracks", "evil\x1b[2Jname.csv"), "evil·[2Jname.csv")


def test_programs_that_are_started_import_nothing_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user's random.py, or another user's zenoh.py in a shared folder."""
    for name in ("random", "zenoh", "json"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('imported from the folder')")
    monkeypatch.chdir(tmp_path)
    with child(["plant", "--help"], tmp_path / "child.log") as process:
        assert process.wait(60.0)
    assert "imported from the folder" not in (tmp_path / "child.log").read_text()


def test_settings_that_are_nested_without_end_are_refused(
    cli: Cli, course: tuple[str | Path, ...], kinematic_artefact: Path, tmp_path: Path
) -> None:
    settings = tmp_path / "mpc.json"
    settings.write_text("[" * 100_000)
    arguments = ("controller", "--artefact", kinematic_artefact, *course)
    refused(cli(*arguments, "--settings", settings), "mpc.json")


def test_devices_are_not_read_without_end(cli: Cli, tmp_path: Path) -> None:
    refused(cli("publish", "/dev/zero"), "weights file /dev/zero is longer than 16 MB")
    refused(cli("fmu", "inspect", "/dev/zero"), "no FMU at /dev/zero")
    refused(cli("train", "/dev/zero", "--out", tmp_path / "weights.bin"), "no log at /dev/zero")
