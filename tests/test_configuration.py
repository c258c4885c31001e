"""One configuration file: validated, read by every command and its children, safe by default."""

import json
import os
import re
import stat
import textwrap
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from bayesrace.configuration import Configuration, as_toml, read_configuration
from bayesrace.defaults import CONFIGURATION_VARIABLE
from bayesrace.errors import InputError
from bayesrace.operation.cli.app import app
from bayesrace.operation.settings import RaceSettings
from bayesrace.operation.system import CONFIGURATION, started_system
from bayesrace.sensors import EXACT, get_sensors
from bayesrace.transport import (
    Credentials,
    Endpoints,
    Members,
    free_endpoint,
    open_session,
    private_endpoints,
)
from bayesrace.vehicles import get_car
from tests.command_line import Cli, refused
from tests.programs import ROOT, finish, start

BEYOND = "tcp/0.0.0.0:7447"


def config(folder: Path, text: str) -> Path:
    path = folder / "bayesrace.toml"
    path.write_text(text)
    return path


def test_the_example_holds_every_setting_with_its_meaning(cli: Cli, tmp_path: Path) -> None:
    assert cli("config", "example", "--out", "bayesrace.toml").code == 0
    assert read_configuration(tmp_path / "bayesrace.toml") == Configuration()
    text = (tmp_path / "bayesrace.toml").read_text()
    for name, field in Configuration.model_fields.items():
        assert f"[{name}]" in text
        for setting, one in getattr(field.annotation, "model_fields", {}).items():
            assert f"{setting} =" in text
            assert f"# {one.description}" in text
    settings = re.sub(r"^#(?! )(.*[^=\n])$", r"\1", text, flags=re.MULTILINE)
    assert tomllib.loads(settings) == tomllib.loads(as_toml(Configuration()))
    refused(cli("config", "example", "--out", "bayesrace.toml"), "exists")


def test_what_the_docs_show_can_be_written_below_the_example(cli: Cli, tmp_path: Path) -> None:
    path, page = tmp_path / "bayesrace.toml", (ROOT / "docs" / "security.md").read_text()
    shown = page.partition("In `bayesrace.toml`")[2].partition("\n\n")[2].partition("\n\n")[0]
    path.write_text(cli("config", "example").out + textwrap.dedent(shown))
    found = read_configuration(path)
    assert found.network.plant == ("tls/PLANT:7447",)
    assert found.tls.folder == tmp_path / "certs"


def test_what_is_written_is_read_back() -> None:
    content = {
        "network": {"plant": ["tls/10.0.0.1:1", "tls/[::1]:2"], "insecure": True},
        "tls": {"folder": "/certs", "use": {"plant": 'a "b" é 🏁'}}, "realtime": {"fifo": 7},
        "limits": {"lease_s": 0.5}, "zenoh": {"transport/link/rx/buffer_size": 1000},
    }  # fmt: skip
    made = Configuration.model_validate(content)
    assert Configuration.model_validate(tomllib.loads(as_toml(made))) == made


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[network]\nplant = ['tcp/nowhere']", ("network.plant.0", "protocol/address:port")),
        ("[network]\nplants = []", ("unknown setting 'network.plants'", "did you mean 'plant'")),
        ("[network]\nx = []", ("unknown setting 'network.x'", "there are mode, plant, ")),
        ("[network]\nmode = 'x'", ("network.mode = 'x': has to be 'direct' or 'router'",)),
        ("[network]\ninsecure = 'ja'", ("network.insecure = 'ja': has to be true or false",)),
        ("[network]\nplant = 3", ("network.plant = 3: has to be a list",)),
        ("limits = 3", ("limits = 3: has to be a table",)),
        ("[limits]\npending = 2.5", ("limits.pending = 2.5: has to be a whole number",)),
        ("[tls]\n[network]\nmode = 'x'\n[tls]\n", ("[tls] stands in line 1 and again in line 4",)),
        ("[tls]\nfolder = 'a'\nfolder = 'b'", ("folder stands in line 2 and again in line 3",)),
        ("[network]\nmode = 'router'", ("network", "mode 'router' needs an endpoint")),
        ("[limits]\nlease_s = -1", ("limits.lease_s = -1: has to be greater than 0 (silence",)),
        ("[limits]\nlease_s = nan", ("limits.lease_s",)),
        ("[tls]\nuse = { driver = 'x' }", ("tls.use.driver",)),
        ("[zenoh.access_control]\nenabled = false", ("zenoh", "access_control/enabled")),
        ("[zenoh]\n'scouting/multicast/enabled' = true", ("zenoh", "scouting/multicast")),
        ("[zenoh.transport.link.tls]\nenable_mtls = false", ("zenoh", "transport/link/tls")),
        ("[zenoh]\n'/listen//endpoints' = ['tcp/0.0.0.0:1']", ("zenoh", "listen/endpoints")),
        ("[network", ("no TOML",)),
    ],
)
def test_a_fault_is_named_with_file_and_field(
    cli: Cli, tmp_path: Path, text: str, words: tuple[str, ...]
) -> None:
    path = config(tmp_path, text)
    refused(cli("config", "check", path), str(path), *words)
    refused(cli("cars", "--config", path), str(path), *words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[network]\nplant = ['tcp/10.0.0.1:1']", ("tcp/10.0.0.1:1", "'bayesrace certs'")),
        ("[network]\ncontroller = ['tls/127.0.0.1:1']", ("needs a certificate",)),
        ("[zenoh]\nnonsense = 1", ("[zenoh] nonsense = 1",)),
        (
            "[network]\nplant = ['tcp/127.0.0.1:1']\ncontroller = ['tcp/localhost:1']",
            ("plant and controller both listen at tcp/127.0.0.1:1",),
        ),
        (
            "[network]\nmode = 'direct'\nrouter = ['tcp/127.0.0.1:7448']",
            ("controller and router both listen at tcp/127.0.0.1:7448",),
        ),
    ],
)
def test_what_no_process_would_start_with_is_found_by_the_check(
    cli: Cli, tmp_path: Path, text: str, words: tuple[str, ...]
) -> None:
    refused(cli("config", "check", config(tmp_path, text)), *words)


def test_flags_override_the_file_which_overrides_the_variable(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = (tmp_path / name for name in ("one.toml", "two.toml"))
    one.write_text("[network]\nplant = ['tcp/127.0.0.1:1001']\n")
    two.write_text("[network]\nplant = ['tcp/127.0.0.1:1002']\n[realtime]\nfifo = 5\n")
    monkeypatch.setenv(CONFIGURATION_VARIABLE, str(one))
    assert "127.0.0.1:1001" in cli("config", "show").out
    assert "127.0.0.1:1002" in cli("config", "show", "--config", two).out
    assert os.environ[CONFIGURATION_VARIABLE] == str(one)
    refused(cli("stop", "--config", two, "--timeout", "0.2"), "127.0.0.1:1002")
    where = free_endpoint()
    asked = cli("stop", "--config", two, "--timeout", "0.2", "--endpoint", where)
    refused(asked, where)
    assert "1002" not in asked.err


def test_a_router_in_the_file_is_what_all_connect_to() -> None:
    """Unless they are to connect directly."""
    router = {"router": ["tcp/127.0.0.1:9"]}
    found = Configuration.model_validate({"network": router})
    assert found.endpoints("router").listen == ("tcp/127.0.0.1:9",)
    for role in ("plant", "controller", "director"):
        ends = found.endpoints(role)
        assert (ends.listen, ends.connect) == ((), ("tcp/127.0.0.1:9",))
    direct = Configuration.model_validate({"network": {**router, "mode": "direct"}})
    assert direct.endpoints("plant") == Configuration().endpoints("plant")
    assert direct.endpoints("director") == Configuration().endpoints("director")


def test_every_command_reads_the_file(cli: Cli, tmp_path: Path) -> None:
    """Those of groups, too."""
    spoilt = config(tmp_path, "[limits]\nlease = 1\n")
    group: Any = get_command(app)
    for name in group.list_commands(None):
        command = group.resolve_command(None, [name])[1]
        for one in getattr(command, "commands", {name: command}).values():
            assert any("--config" in option.opts for option in one.params), one.name
    refused(cli("fmu", "inspect", "no.fmu", "--config", spoilt), "limits.lease")


@pytest.mark.wall_clock
def test_the_processes_of_a_system_read_the_file_that_it_leaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They meet where no other user may enter; beside that, they have what is configured."""
    monkeypatch.setenv(
        CONFIGURATION_VARIABLE,
        str(config(tmp_path, "[limits]\nlease_s = 3.5\n[realtime]\ncpu = 9999\n")),
    )
    folder = tmp_path / "run"
    folder.mkdir()
    with started_system("orca", folder) as system:
        system.director.wait_for(("plant",), 30.0)
        left = read_configuration(folder / CONFIGURATION)
        protocol, _, socket = left.network.plant[0].partition("/")
        assert protocol == "unixsock-stream"
        assert Path(socket).is_socket()
        assert stat.S_IMODE(Path(socket).parent.stat().st_mode) == 0o700
    assert not Path(socket).parent.exists()
    assert left.limits.lease_s == 3.5
    assert "not bound to CPU 9999" in (folder / "plant.log").read_text()


@pytest.mark.parametrize("name", ["x" * 100, "with blanks", "why?", "#1"])
def test_a_folder_that_can_hold_no_sockets_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """The sockets are in /tmp then."""
    (tmp_path / name).mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / name))
    with private_endpoints("plant") as (endpoint,), open_session(Endpoints(listen=(endpoint,))):
        assert not any((tmp_path / name).iterdir())


def test_settings_of_zenoh_reach_it_and_unknown_ones_are_named() -> None:
    with open_session(Endpoints(zenoh={"transport": {"link": {"tx": {"batch_size": 1000}}}})):
        pass
    with (
        pytest.raises(InputError, match=r"\[zenoh\] transport/link/tx/bath_size"),
        open_session(Endpoints(zenoh={"transport/link/tx/bath_size": 1000})),
    ):
        pass


# Safe by default ---------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["plant", "status", "stop", "go", "rollback", "router"])
def test_beyond_loopback_nothing_starts_without_certificates(cli: Cli, command: str) -> None:
    option = "--listen" if command == "router" else "--endpoint"
    refused(cli(command, option, BEYOND), BEYOND, "could drive the car", "--insecure", "certs")


@pytest.mark.parametrize(
    ("endpoint", "loopback"),
    [
        ("tcp/127.0.0.1:1", True), ("tcp/127.9.9.9:1", True), ("tcp/[::1]:1", True),
        ("tcp/localhost:1", True), ("unixsock-stream/x", True), ("tcp/0.0.0.0:1", False),
        ("tcp/[::]:1", False), ("tcp/10.0.0.1:1", False), ("tcp/127.0.0.1.example:1", False),
        ("ws/plant:1", False), ("tcp/localhost.example:1", False),
    ],
)  # fmt: skip
def test_only_loopback_counts_as_such(endpoint: str, loopback: bool) -> None:
    for ends in (Endpoints(listen=(endpoint,)), Endpoints(connect=(endpoint,))):
        assert (ends.exposed == []) == loopback


@pytest.mark.wall_clock
def test_insecure_is_possible_and_warns_each_time() -> None:
    where = free_endpoint().replace("127.0.0.1", "0.0.0.0")  # noqa: S104
    plant = start("plant", "--endpoint", where, "--insecure")
    assert plant.stderr is not None
    line = plant.stderr.readline()
    plant.terminate()
    finish(plant)
    assert "INSECURE" in line
    assert where in line


def test_an_encrypted_endpoint_has_no_settings_of_its_own() -> None:
    """With enable_mtls=false there, Zenoh lets everyone in."""
    own = Credentials(folder=Path("certs"), name="plant", ends_s=2e9, members=Members())
    where = "tls/127.0.0.1:7447"
    Endpoints(listen=(where,), credentials=own).check()
    with pytest.raises(InputError, match="settings of its own"):
        Endpoints(listen=(f"{where}#enable_mtls=false",), credentials=own).check()


# settings.json -----------------------------------------------------------------------------------


def test_a_race_repeats_the_settings_of_another(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Options that are given override them, all others stay; also of nested settings."""
    seen: list[RaceSettings] = []

    class StopError(RuntimeError):
        pass

    def record(settings: RaceSettings, *_: object) -> None:
        seen.append(settings)
        raise StopError

    StopError.__module__ = "bayesrace.operation.race"
    monkeypatch.setattr("bayesrace.operation.race.race", record)
    first = ("--laps", "5", "--seed", "3", "--style", "calm", "--no-constraints", "--delay", "20")
    line = ("--raceline", "line.csv", "--car", "f1tenth")
    cli("race", *first, *line, "--track", "paddock", "--sensors", "mocap")
    assert seen[0].line == Path("line.csv")
    assert (seen[0].delay_s, seen[0].mpc.constraints) == (0.02, False)
    assert seen[0].instruments == get_sensors("mocap") != EXACT
    path = tmp_path / "settings.json"
    path.write_text(seen[0].model_dump_json())
    cli("race", "--settings", path)
    assert seen[1] == seen[0]
    cli("race", "--settings", path, "--seed", "4", "--style", "weave")
    pursuit = seen[0].pursuit.model_copy(update={"style": "weave", "seed": 4})
    assert seen[2] == seen[0].model_copy(update={"seed": 4, "pursuit": pursuit})
    cli("race", "--settings", path, "--tyres", "pacejka")
    assert seen[3] == seen[0].model_copy(update={"car": get_car("f1tenth").on_tyres("pacejka")})
    path.write_text(json.dumps({"laps": 0}))
    refused(cli("race", "--settings", path), str(path), "laps")
