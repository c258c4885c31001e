"""The command line as a program: help that reads well, its start, its output on any terminal."""

import gc
import io
import logging
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.table import Table

from bayesrace.operation.system import child
from bayesrace.operation.terminal import PrintableFormatter
from bayesrace.operation.terminal.terminal import Terminal
from tests.command_line import Cli, refused
from tests.programs import ROOT, environment, finish, run, start

EVIL = "a\x1b[2Jb\x07c"
"""Of which a terminal would obey a part."""

SUBCOMMANDS = (
    "race", "drive", "report", "view", "bench", "tracks", "cars", "raceline", "collect", "identify",
    "import-drive", "train", "size", "build", "export", "limit",
    "plant", "controller", "bridge", "ros2", "shadow", "status", "stop", "go", "router", "latency",
    "timing",
    "fmu export", "fmu inspect", "fmu weights",
    "validate", "publish", "rollback", "learn",
    "campaign", "campaign-report", "campaign-scheduler", "campaign-worker", "tune", "paper",
    "replay", "scenario",
    "config show", "config check", "config example", "config firewall", "doctor",
    "certs init", "certs add", "certs list", "certs revoke",
)  # fmt: skip


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
        tasks = (
            "Race",
            "Prepare",
            "Drive",
            "Learn while driving",
            "Evidence",
            "Measure",
            "Export to other",
        )
        assert all(f"\n{task}" in outcome.out for task in tasks)
        assert "--install-completion" in outcome.out


def test_every_option_says_what_it_is(cli: Cli) -> None:
    import typer
    from typer.core import TyperGroup

    from bayesrace.operation.cli.app import app

    def leaves(command: Any, *names: str) -> dict[str, Any]:
        if not isinstance(command, TyperGroup):
            return {" ".join(names): command}
        context: Any = None
        names_ = command.list_commands(context)
        below = {one: command.resolve_command(context, [one])[1] for one in names_}
        return {k: v for name, one in below.items() for k, v in leaves(one, *names, name).items()}

    commands = leaves(typer.main.get_command(app))
    assert sorted(commands) == sorted(SUBCOMMANDS)
    for name, command in commands.items():
        assert command.help, name
        for parameter in command.params:
            text = getattr(parameter, "help", "")
            assert getattr(parameter, "hidden", False) or text, f"{name} {parameter.name}"


@pytest.mark.parametrize(
    ("command", "heavy"),
    [
        ((), {"numpy", "pydantic", "rich", "zenoh"}),
        (("race",), {"casadi", "scipy", "rich", "zenoh", "matplotlib"}),
        (("bench",), {"casadi", "scipy", "rich", "zenoh", "matplotlib"}),
        (("controller",), {"casadi", "scipy", "rich", "numpy", "mcap"}),
        (("stop",), {"numpy", "rich", "zenoh"}),
    ],
)
def test_help_imports_nothing_that_it_does_not_need(
    command: tuple[str, ...], heavy: set[str], tmp_path: Path
) -> None:
    """It would take four times as long: most modules are for the commands that run. Nor does it
    need another package than bayesrace, which is all that a wheel has."""
    (tmp_path / "bayesrace").symlink_to(ROOT / "bayesrace")
    program = (
        "import sys\n"
        f"elsewhere = [one for one in sys.path if one not in ('', {str(ROOT)!r})]\n"
        f"sys.path[:] = [{str(tmp_path)!r}, *elsewhere]\n"
        "from bayesrace.operation.cli import main\n"
        "try:\n"
        "    main()\n"
        "except SystemExit:\n"
        "    print(*sys.modules)\n"
    )
    line = [sys.executable, "-c", program, *command, "--help"]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    assert not heavy & set(done.stdout.splitlines()[-1].split())


def test_without_a_command_help_is_shown(cli: Cli) -> None:
    outcome = cli()
    assert "Usage: bayesrace" in outcome.out + outcome.err
    assert "bayesrace: \n" not in outcome.err


def test_a_call_from_python_leaves_its_objects_to_garbage_collection(cli: Cli) -> None:
    before = gc.get_freeze_count()
    cli("--version")
    assert gc.get_freeze_count() == before


def test_version(cli: Cli) -> None:
    outcome = cli("--version")
    assert outcome.code == 0
    assert re.fullmatch(r"bayesrace \d+\.\d+\.\d+\n", outcome.out)


def test_the_program_itself_fails_as_its_entry_point(tmp_path: Path) -> None:
    """Once as a real process: code, one line, nothing else."""
    done = run("tracks", tmp_path / "missing.csv")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("bayesrace: no track ")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("command", ["tracks", "train"])
def test_a_terminal_without_our_characters_gets_others(tmp_path: Path, command: str) -> None:
    more = {"tracks": (), "train": (tmp_path / "nö.mcap", "--out", tmp_path / "weights.bin")}
    around = {**environment(), "PYTHONIOENCODING": "ascii"}
    done = finish(start(command, *more[command], env=around))
    assert "Traceback" not in done.stderr
    assert done.returncode == {"tracks": 0, "train": 2}[command]


def test_names_do_not_command_the_terminal(cli: Cli) -> None:
    refused(cli("tracks", "evil\x1b[2Jname.csv"), "evil·[2Jname.csv")


def test_tables_hold_no_escape_sequences_but_their_own() -> None:
    text = io.StringIO()
    table = Table("track", title=EVIL)
    table.add_row(f"[bold]{EVIL}[/bold]")
    Terminal(file=text, force_terminal=True, width=60, color_system="truecolor").print(table)
    printed = text.getvalue()
    assert "\x1b[2J" not in printed
    assert "\x07" not in printed
    assert printed.count("a·[2Jb") == 2
    assert "\x1b[1m" in printed


def test_log_lines_hold_no_escape_sequences() -> None:
    record = logging.LogRecord("plant", logging.INFO, "", 0, "said %s\nand more", (EVIL,), None)
    assert PrintableFormatter("%(message)s").format(record) == "said a·[2Jb·c\nand more"


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
