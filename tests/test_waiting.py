"""Plant, controller and router wait for what may pass, as long as they run; each says so once."""

import os
import resource
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any, Final
from unittest.mock import Mock

import pytest

from bayesrace.errors import RestartError, TransientError
from bayesrace.messages import Role
from bayesrace.operation import certificates
from bayesrace.operation.certificates import add, init
from bayesrace.operation.cli import processes
from bayesrace.transport import Credentials, Endpoints, free_endpoint, open_sessions, session
from tests.network.cars import Course, Program, gentle_course
from tests.programs import PATIENCE_S, until
from tests.security.authority import Bundles, bundles, written

__all__ = ["bundles"]

pytestmark = pytest.mark.wall_clock

SERVICES: Final[tuple[Role, ...]] = ("plant", "controller", "router")
RUNNING: Final = {
    "plant": "plant of car", "controller": "controller of car", "router": "router on",
}  # fmt: skip
IN_USE: Final = "Address already in use"
CONNECTIONS: Final = 300


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory) -> Course:
    return gentle_course(tmp_path_factory.mktemp("course"))


def command(name: Role, course: Course, where: str) -> tuple[str | Path, ...]:
    """A process that listens there, and that nobody meets."""
    options: dict[Role, tuple[str | Path, ...]] = {
        "plant": ("--endpoint", where), "router": ("--listen", where),
        "controller": (*course.arguments, "--listen", where, "--endpoint", free_endpoint()),
    }  # fmt: skip
    return name, *options[name]


def check_running(program: Program, name: Role) -> None:
    """It runs now, and ends in order."""
    until(lambda: RUNNING[name] in program.said(), f"{name}: {program.said()}")
    program.end()


# Endpoints ---------------------------------------------------------------------------------------


@contextmanager
def taken() -> Iterator[str]:
    """An endpoint that something else listens at."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield f"tcp/127.0.0.1:{other.getsockname()[1]}"


@pytest.mark.parametrize("name", SERVICES)
def test_an_endpoint_in_use_is_waited_for(tmp_path: Path, course: Course, name: Role) -> None:
    """Such as one that a process of somebody else has taken before the start."""
    with ExitStack() as stack:
        with taken() as where:
            line = command(name, course, where)
            program = stack.enter_context(Program(tmp_path / "said.txt", *line))
            until(lambda: IN_USE in program.said(), "a line about the endpoint")
            assert RUNNING[name] not in program.said()
        check_running(program, name)
    (said,) = (line for line in program.said().splitlines() if IN_USE in line)
    assert where in said
    assert "choose another endpoint" in said


def test_a_unix_socket_in_use_is_waited_for(tmp_path: Path, course: Course) -> None:
    line = command("plant", course, f"unixsock-stream/{tmp_path / 'plant'}")
    with Program(tmp_path / "first.txt", *line) as first:
        until(lambda: RUNNING["plant"] in first.said(), "the first plant")
        with Program(tmp_path / "second.txt", *line) as second:
            until(lambda: "acquire lock" in second.said(), "a line about the endpoint")
            first.end()
            check_running(second, "plant")


@pytest.mark.parametrize("name", SERVICES)
def test_a_process_that_waits_for_an_endpoint_can_be_ended(
    tmp_path: Path, course: Course, name: Role
) -> None:
    with taken() as where, Program(tmp_path / "said.txt", *command(name, course, where)) as program:
        until(lambda: IN_USE in program.said(), "a line about the endpoint")
        program.process.send_signal(signal.SIGTERM)
        assert program.process.wait(PATIENCE_S) == -signal.SIGTERM


@pytest.mark.parametrize(
    ("where", "why"),
    [
        ("tcp/192.0.2.1:7447", "Cannot assign requested address"),
        ("tcp/nowhere.invalid:7447", "failed to lookup"),
    ],
)
def test_an_address_that_is_not_there_yet_is_waited_for(
    tmp_path: Path, where: str, why: str
) -> None:
    """As at the start of a board whose network comes later."""
    with Program(tmp_path / "said.txt", "plant", "--insecure", "--endpoint", where) as plant:
        until(lambda: f"cannot listen on {where}: {why}" in plant.said(), "a line about it")
        time.sleep(1.2)  # two more attempts
        assert plant.process.poll() is None
    assert plant.said().count(why) == 1


# Certificates ------------------------------------------------------------------------------------


def test_a_certificate_that_is_waited_for_is_mentioned_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Though the time by the clock is in the line."""
    monkeypatch.setattr(time, "sleep", lambda _: None)
    answers = [TransientError(f"certificate in x has expired: it is 12:0{k}") for k in range(9)]
    network: Any = Mock()
    network.endpoints.side_effect = [*answers, Endpoints()]
    assert processes._once_valid(network, "plant") == Endpoints()
    assert caplog.text.count("has expired") == 1


@pytest.mark.parametrize(
    ("name", "wrong"), [*((name, "has expired") for name in SERVICES), ("plant", "not valid yet")]
)
def test_a_certificate_that_is_not_valid_now_is_waited_for(
    tmp_path: Path, course: Course, monkeypatch: pytest.MonkeyPatch, name: Role, wrong: str
) -> None:
    """By the clock of a board without a battery, or until somebody copies a renewed one."""
    folder, where = tmp_path / "certs", free_endpoint("tls")
    init(folder)
    with monkeypatch.context() as patch:
        if wrong == "not valid yet":
            patch.setattr(certificates, "_CLOCKS", timedelta(hours=-1))
        add(folder, name, name, days=-0.5 if wrong == "has expired" else 1.0)
    config = written(tmp_path, Bundles(folder), where, free_endpoint("tls"))
    more: dict[Role, tuple[str | Path, ...]] = {
        "controller": course.arguments, "router": ("--listen", where)
    }  # fmt: skip
    options = more.get(name, ())
    with Program(tmp_path / "said.txt", name, *options, "--config", config) as program:
        until(lambda: wrong in program.said(), f"that it {wrong}")
        (folder / name / "certificate.pem").unlink()
        time.sleep(1.5)  # half copied
        add(folder, name, None, renew=True)
        check_running(program, name)
    assert program.said().count(wrong) == 1
    assert "Traceback" not in program.said()


@pytest.mark.parametrize("stays", [False, True])
def test_an_endpoint_that_is_gone_as_links_are_opened_anew_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stays: bool
) -> None:
    """For some seconds; then the process is to be started again."""
    init(tmp_path)
    folder, where = add(tmp_path, "plant", "plant"), free_endpoint("tls")
    endpoints = Endpoints(listen=(where,), credentials=Credentials.read(folder))
    monkeypatch.setattr(session, "_REOPEN_S", 0.1 if stays else 60.0)
    with open_sessions(endpoints, "plant") as sessions, socket.socket() as other:
        close, before = sessions.close, sessions.current

        def lose() -> None:
            close()
            other.bind(("127.0.0.1", int(where.rpartition(":")[2])))
            other.listen()
            if not stays:
                threading.Timer(1.2, other.close).start()

        monkeypatch.setattr(sessions, "close", lose)
        add(tmp_path, "plant", None, renew=True)
        sessions.links.look()
        if stays:
            with pytest.raises(RestartError, match=IN_USE):
                sessions.renewed()
        else:
            assert sessions.renewed() not in (None, before)
            assert sessions.links.used == Credentials.read(folder)
        monkeypatch.undo()


@pytest.mark.parametrize("stays", [False, True])
def test_a_certificate_that_is_being_copied_is_waited_for(
    tmp_path: Path, bundles: Bundles, stays: bool
) -> None:
    """Its key is there, and the old certificate; if it stays so, that is refused."""
    folder, where = tmp_path / "certs", free_endpoint("tls")
    shutil.copytree(bundles.path("plant"), folder / "plant")
    shutil.copy(bundles.path("controller") / "key.pem", folder / "plant" / "key.pem")
    config = written(tmp_path, Bundles(folder), where, free_endpoint("tls"))
    with Program(tmp_path / "said.txt", "plant", "--config", config) as program:
        until(lambda: "do not fit" in program.said(), "a line about it")
        if stays:
            assert program.process.wait(PATIENCE_S) == 2
        else:
            shutil.copytree(bundles.path("plant"), folder / "plant", dirs_exist_ok=True)
            check_running(program, "plant")
    assert program.said().count("do not fit") == 1 + stays


# The first process of a container -----------------------------------------------------------------

UNSHARE: Final = ("unshare", "--pid", "--fork", "--mount-proc", "--kill-child")


@pytest.mark.skipif(
    subprocess.run([*UNSHARE, "true"], capture_output=True).returncode != 0,
    reason="needs unshare and the right to make namespaces",
)
@pytest.mark.parametrize("name", SERVICES)
def test_the_first_process_of_a_container_ends_while_it_waits(
    tmp_path: Path, course: Course, name: Role
) -> None:
    """The system has no default action of signals for it."""
    said = tmp_path / "said.txt"
    with taken() as where, Program(said, *command(name, course, where), prefix=UNSHARE) as program:
        until(lambda: IN_USE in program.said(), "a line about the endpoint")
        outside = program.process.pid
        (first,) = Path(f"/proc/{outside}/task/{outside}/children").read_text().split()
        os.kill(int(first), signal.SIGTERM)
        assert program.process.wait(PATIENCE_S) == 128 + signal.SIGTERM


# Descriptors -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SERVICES)
def test_idle_connections_beyond_the_soft_limit_are_accepted(
    tmp_path: Path, course: Course, name: Role
) -> None:
    """The process raises its limit of descriptors at its start."""
    where, limited = free_endpoint(), ("sh", "-c", 'ulimit -Sn 100 && exec "$@"', "sh")
    line = command(name, course, where)
    host, port = where.removeprefix("tcp/").split(":")
    with ExitStack() as stack:
        program = stack.enter_context(Program(tmp_path / "said.txt", *line, prefix=limited))
        until(lambda: RUNNING[name] in program.said(), "it to run")
        pid = program.process.pid
        soft, hard = resource.prlimit(pid, resource.RLIMIT_NOFILE)
        assert soft == hard > CONNECTIONS
        for _ in range(CONNECTIONS):
            stack.enter_context(socket.create_connection((host, int(port)), timeout=5.0))
        descriptors = Path(f"/proc/{pid}/fd")
        until(lambda: len(list(descriptors.iterdir())) > CONNECTIONS, "all to be accepted")
    assert "panicked" not in program.said()
