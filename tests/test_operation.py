"""Operating running cars: finding them, their status, stop and go, and the router."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.messages import (
    COMMAND,
    HEARTBEAT,
    STATE,
    STATUS,
    Command,
    Reply,
    Role,
    State,
    Status,
)
from bayesrace.raceline.line import write_raceline
from bayesrace.tracks import write_track
from bayesrace.transport import (
    Director,
    Endpoints,
    Inbox,
    Item,
    Kind,
    Publisher,
    decode_request,
    free_endpoint,
    open_session,
)
from operation.analysis.network_status import NetworkStatus, ProcessStatus
from operation.drive import RunPlan, run_request
from operation.lifecycle import ask_statuses, command, find, follow, pick
from operation.terminal.status_table import COUNTERS_SHOWN, StatusTable
from tests.command_line import Cli, refused
from tests.conftest import Circuit
from tests.programs import ROOT, environment, finish, run, start, until
from tests.test_transport import take

pytestmark = pytest.mark.wall_clock

PATIENCE_S = 5.0
COUNTERS = {"deadline_misses": 3, "shifted_plan": 4, "brake": 5, "stop": 6, "refused": 7,
            "states_lost": 8, "states_stale": 9}  # fmt: skip
FIELDS = {
    "answering", "fault", "processes", "status_age_s", "phase", "epoch", "run", "text",
    "weights_version", "track", "rate_hz", "state_age_s", "delay_s", "counters",
}  # fmt: skip


@dataclass
class Fake:
    """A plant or a controller as far as operation sees it; in a thread of this process."""

    car: str
    source: str
    endpoints: Endpoints
    mute: bool = False
    """It is present and does not answer."""
    refuses: str = ""
    beats: bool = True
    text: str = "all is well"
    heard: list[Command] = field(default_factory=list)

    def status(self, seq: int) -> Status:
        rate, age = (50.0, 0.012) if self.source == "controller" else (0.0, -1.0)
        phase = "driving" if self.source == "controller" else "idle"
        return Status(
            seq=seq,
            source_time_ns=0,
            source=self.source,
            phase=phase,
            epoch=7,
            run=2,
            text=self.text,
            weights_version="v3",
            track="",
            rate_hz=rate,
            state_age_s=age,
            delay_s=0.034,
            counters=COUNTERS,
        )

    def serve(self, ready: threading.Event, over: threading.Event) -> None:
        role: Role = "plant" if self.source == "plant" else "controller"
        with open_session(self.endpoints, role) as session:
            inbox = Inbox(session, self.car)
            inbox.serve(STATUS, self.source)
            if self.source == "controller":
                inbox.serve(COMMAND)
            beats = Publisher(session, HEARTBEAT, self.car, self.source)
            inbox.announce(self.source)
            ready.set()
            while not over.is_set():
                item = inbox.get(0.05)
                if item is not None and item.kind is Kind.REQUEST and not self.mute:
                    self._answer(item)
                if self.beats:
                    beats.put(self.status(beats.next_seq), lockstep=False)

    def _answer(self, item: Item) -> None:
        if item.value.service is STATUS:
            item.value.answer(self.status(0))
            return
        self.heard.append(decode_request(item.value)[0])
        text = self.refuses or f"{self.heard[-1].command}: as you say"
        item.value.answer(
            Reply(seq=0, source_time_ns=0, accepted=not self.refuses, text=text, data={})
        )


Fakes = Callable[..., Fake]


@pytest.fixture
def fakes() -> Iterator[Fakes]:
    """Starts fakes, each listening on an endpoint of its own by default."""
    over = threading.Event()
    threads = []

    def begin(car: str, source: str, **settings: Any) -> Fake:
        settings.setdefault("endpoints", Endpoints(listen=(free_endpoint(),)))
        fake, ready = Fake(car, source, **settings), threading.Event()
        thread = threading.Thread(target=fake.serve, args=(ready, over))
        thread.start()
        threads.append(thread)
        assert ready.wait(PATIENCE_S)
        return fake

    yield begin
    over.set()
    for thread in threads:
        thread.join()


def where(*fakes: Fake) -> Endpoints:
    """What to connect to."""
    return Endpoints(connect=tuple(fake.endpoints.listen[0] for fake in fakes))


def options(*fakes: Fake) -> list[str]:
    """The same for the command line."""
    return [word for endpoint in where(*fakes).connect for word in ("--endpoint", endpoint)]


def status_of(
    endpoints: Endpoints, name: str = "", patience_s: float = PATIENCE_S
) -> NetworkStatus:
    with open_session(endpoints) as session:
        found = find(session, endpoints, patience_s, name)
        return ask_statuses(session, found, 1.0)


def rendered(network: NetworkStatus, width: int = 160) -> str:
    console = Console(width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(StatusTable(network))
    return capture.get()


# status --------------------------------------------------------------------------------------


def test_every_car_is_found_and_json_has_the_documented_form(fakes: Fakes) -> None:
    ones = fakes("a", "plant"), fakes("a", "controller"), fakes("b-2", "plant")
    content = json.loads(json.dumps(status_of(where(*ones)).as_json()))
    assert set(content) == {"cars"}
    assert set(content["cars"]) == {"a", "b-2"}
    assert content["cars"]["b-2"]["controller"] is None
    plant, controller = content["cars"]["a"]["plant"], content["cars"]["a"]["controller"]
    assert set(plant) == set(controller) == FIELDS
    assert (plant["answering"], plant["fault"], plant["processes"]) == (True, None, 1)
    assert (plant["phase"], plant["rate_hz"], plant["state_age_s"]) == ("idle", None, None)
    assert (controller["rate_hz"], controller["state_age_s"]) == (50.0, 0.012)
    assert controller["counters"] == COUNTERS


def test_a_named_car_is_found_without_waiting_for_the_absent(fakes: Fakes) -> None:
    """An endpoint without a listener costs no time if the named car is found."""
    one, two = fakes("a", "plant"), fakes("a", "controller")
    endpoints = Endpoints(connect=(free_endpoint(), *where(one, two).connect))
    assert set(status_of(endpoints, "a", patience_s=600.0).cars) == {"a"}


def test_a_present_process_that_hangs_is_shown_as_such(fakes: Fakes) -> None:
    one, two = fakes("a", "plant", mute=True), fakes("a", "controller")
    network = status_of(where(one, two))
    content = network.as_json()["cars"]["a"]
    assert content["plant"]["answering"] is False
    assert "no answer within 1 s" in content["plant"]["fault"]
    assert content["plant"]["phase"] is None
    assert content["controller"]["answering"] is True
    assert "a plant: no answer within 1 s" in " ".join(rendered(network).split())


def test_two_processes_under_one_name_are_noticed(fakes: Fakes) -> None:
    """Two controllers that command one car are the worst mistake that names allow."""
    ones = fakes("a", "controller"), fakes("a", "controller")
    network = status_of(where(*ones))
    assert network.as_json()["cars"]["a"]["controller"]["processes"] == 2
    assert "2 processes answer under this name" in rendered(network)


def test_absence_is_an_error_that_says_what_to_do(fakes: Fakes) -> None:
    nowhere = Endpoints(connect=(free_endpoint(),))
    with pytest.raises(InputError, match=f"no connection to {nowhere.connect[0]} .*--endpoint"):
        status_of(nowhere, patience_s=0.3)
    one, two = fakes("a", "plant"), fakes("b", "plant")
    with pytest.raises(InputError, match=r"no car 'c' at .*; cars found: a, b"):
        status_of(where(one, two), "c", patience_s=1.0)


def test_the_table_shows_phase_rate_misses_and_counters(fakes: Fakes) -> None:
    one, two = fakes("a", "plant"), fakes("a", "controller", text="\x1b[2Jgone \x07")
    text = rendered(status_of(where(one, two)))
    row = next(line for line in text.splitlines() if "controller" in line).split()
    assert row == ["a", "controller", "driving", "50", "12", "v3", "3", "4/5/6", "34.0", "7/8/9"]
    assert "lockstep" in text
    assert "\x1b" not in text
    assert "\x07" not in text
    assert "a controller: ·[2Jgone ·" in text


def test_a_narrow_terminal_shows_the_same(fakes: Fakes) -> None:
    one, two = fakes("a", "plant", mute=True), fakes("a", "controller")
    lines = [line.split() for line in rendered(status_of(where(one, two)), 60).splitlines()]
    assert ["a", "plant", "controller"] in lines
    assert ["state", "no", "answer", "driving"] in lines
    assert ["messages", "refused/lost/stale", "7/8/9"] in lines


def test_a_heartbeat_that_stops_is_no_answer_any_more() -> None:
    status = Status(
        seq=0,
        source_time_ns=0,
        source="plant",
        phase="idle",
        epoch=1,
        run=0,
        text="",
        weights_version="",
        track="",
        rate_hz=50.0,
        state_age_s=-1.0,
        delay_s=0.0,
        counters={},
    )
    network = NetworkStatus({"a": {"plant": ProcessStatus(status, "", 1, arrived_s=100.0)}})
    answering = []
    for now_s in (100.5, 102.0):
        network.expire(now_s)
        answering.append(network.answering)
    assert answering == [True, False]
    assert network.as_json()["cars"]["a"]["plant"]["fault"] == "no heartbeat for 1 s"


def test_status_on_the_command_line(fakes: Fakes, cli: Cli) -> None:
    one, two = fakes("a", "plant"), fakes("a", "controller")
    done = cli("status", *options(one, two))
    assert (done.code, done.err) == (0, "")
    assert "4/5/6" in done.out
    content = json.loads(cli("status", "--json", "--name", "a", *options(one, two)).out)
    assert set(content["cars"]["a"]["plant"]) == FIELDS
    one.mute = two.mute = True
    done = cli("status", "--json", "--timeout", "0.5", *options(one, two))
    refused(done, "no answer within 0.5 s from the processes found")
    assert json.loads(done.out)["cars"]["a"]["plant"]["answering"] is False
    done = cli("status", "--timeout", "0.3", "--endpoint", free_endpoint())
    refused(done, "no connection to")


def test_watching_prints_a_line_for_each_heartbeat_until_interrupted(fakes: Fakes) -> None:
    one, two = fakes("a", "plant"), fakes("a", "controller")
    watching = start("status", "--watch", "--json", *options(one, two))
    assert watching.stdout is not None
    lines = [json.loads(watching.stdout.readline()) for _ in range(20)]
    assert all(set(line["cars"]) == {"a"} for line in lines)
    assert all(line["cars"]["a"]["controller"]["phase"] == "driving" for line in lines)
    watching.send_signal(signal.SIGINT)
    done = finish(watching)
    assert (done.returncode, done.stderr) == (0, "")


def test_messages_on_keys_of_no_car_do_not_end_the_watch(fakes: Fakes) -> None:
    with open_session(where(fakes("a", "plant"))) as session:
        updates = follow(session, NetworkStatus({}), "", 60.0)
        assert next(updates) is None
        for key in ("bayesrace/**", "bayesrace/*/status/*", "bayesrace/a b/status/plant"):
            session.put(key, b"junk")
        assert next(updates) == "a"


def test_a_closed_pipe_ends_the_watch_without_an_error(fakes: Fakes) -> None:
    one = fakes("a", "plant")
    watching = start("status", "--watch", "--json", *options(one))
    assert watching.stdout is not None
    watching.stdout.readline()
    watching.stdout.close()
    assert watching.wait(PATIENCE_S * 4) == 0
    assert watching.stderr is not None
    assert watching.stderr.read() == ""
    watching.stderr.close()


@pytest.mark.check
def test_watching_on_a_terminal_redraws_and_sees_coming_and_going(fakes: Fakes) -> None:
    one = fakes("a", "plant")
    controlling, terminal = os.openpty()
    env = {**environment(), "TERM": "xterm", "COLUMNS": "150", "LINES": "40"}
    process = subprocess.Popen(
        [sys.executable, "-m", "operation.cli", "status", "--watch", *options(one)],
        stdin=terminal, stdout=terminal, stderr=terminal, env=env, cwd=ROOT,
    )  # fmt: skip
    os.close(terminal)
    seen = bytearray()

    def shows(words: bytes) -> bool:
        seen.extend(os.read(controlling, 65536))
        return words in seen

    until(lambda: shows(b"all is well"), "the plant")
    one.text = "something new"
    until(lambda: shows(b"something new"), "what it says now")
    one.beats = False
    until(lambda: shows(b"no answer"), "silence")
    one.beats = True
    seen.clear()
    until(lambda: shows(b"idle"), "its return")
    process.send_signal(signal.SIGINT)
    try:
        until(lambda: shows(b"\x1b[?25h"), "the cursor again")
    finally:
        os.close(controlling)
        assert process.wait(PATIENCE_S * 4) == 0


# stop and go -----------------------------------------------------------------------------------


def test_stop_and_go_reach_the_controller_with_a_reason(fakes: Fakes, cli: Cli) -> None:
    one, two = fakes("a", "plant"), fakes("a", "controller")
    done = cli("stop", "--reason", "a cat on the track", *options(one, two))
    assert (done.code, done.out) == (0, "a: stop: as you say\n")
    assert cli("go", "--name", "a", *options(two)).code == 0
    assert [(one.command, one.text) for one in two.heard] == [
        ("stop", "a cat on the track"),
        ("go", "bayesrace go"),
    ]
    two.refuses = "no state so far"
    done = cli("go", *options(one, two))
    refused(done, "go of car 'a' refused: no state so far")
    assert done.out == ""
    two.mute = True
    refused(
        cli("stop", "--timeout", "0.5", *options(one, two)),
        "stop of car 'a' failed: no answer within 0.5 s",
    )


def test_of_several_cars_one_must_be_named(fakes: Fakes) -> None:
    ones = fakes("a", "controller"), fakes("b", "controller"), fakes("c", "plant")
    endpoints = where(*ones)
    with open_session(endpoints) as session:
        found = find(session, endpoints, PATIENCE_S)
        with pytest.raises(InputError, match="several cars found: a, b; choose one with"):
            pick(found, "", all_cars=False)
        assert pick(found, "", all_cars=True) == ["a", "b"]
        assert pick(find(session, endpoints, PATIENCE_S, "b"), "b", all_cars=False) == ["b"]
        with pytest.raises(InputError, match="only the plant of c; start 'bayesrace controller'"):
            pick(find(session, endpoints, 0.3, "c"), "c", all_cars=False)


def test_all_are_stopped_though_one_hangs_and_one_refuses(fakes: Fakes, cli: Cli) -> None:
    ones = (
        fakes("a", "controller", mute=True),
        fakes("b", "controller", refuses="no"),
        fakes("c", "controller"),
    )
    endpoints = where(*ones)
    with open_session(endpoints) as session:
        cars = pick(find(session, endpoints, PATIENCE_S), "", all_cars=True)
        answers = command(session, cars, "stop", "", 0.5)
    assert answers["a"] == "no answer within 0.5 s"
    assert isinstance(answers["b"], Reply)
    assert not answers["b"].accepted
    assert isinstance(answers["c"], Reply)
    assert answers["c"].accepted
    done = cli("stop", "--all", "--timeout", "0.5", *options(*ones))
    refused(done, "'a' failed: no answer", "'b' refused: no")
    assert "c: stop: as you say" in done.out
    assert len(ones[2].heard) == 2


# router ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_a_router_forwards_between_plant_controller_and_observer_and_a_peer_does_not(
    mode: str,
) -> None:
    """Tokens, messages and requests: all that know only the router."""
    endpoint = free_endpoint()
    middle = Endpoints.model_validate({"listen": (endpoint,), "mode": mode})
    roles: tuple[Role, ...] = ("plant", "controller", "viewer")
    with ExitStack() as stack:
        stack.enter_context(open_session(middle))
        plant, controller, observer = (
            stack.enter_context(open_session(Endpoints(connect=(endpoint,)), role))
            for role in roles
        )
        theirs = Inbox(plant, "a")
        theirs.announce("plant")
        receivers = [Inbox(controller, "a"), Inbox(observer, "a")]
        for inbox in receivers:
            inbox.subscribe(STATE)
            inbox.watch("plant")
        if mode == "peer":
            assert [inbox.get(0.5) for inbox in receivers] == [None, None]
            return
        receivers[0].announce("controller")
        theirs.watch("controller")
        for inbox in (theirs, *receivers):
            take(inbox, Kind.ALIVE)
        state = State(
            seq=0,
            source_time_ns=0,
            epoch=0,
            run=1,
            time_s=0.0,
            x=(0.0,) * 7,
            u_applied=(0.0, 0.0),
            lap=0,
            lockstep=True,
            actuation_delays=(),
            final=False,
        )
        Publisher(plant, STATE, "a").put(state, lockstep=True)
        for inbox in receivers:
            take(inbox, Kind.MESSAGE)


@pytest.mark.check
def test_the_router_command_forwards_and_ends_on_sigterm(fakes: Fakes) -> None:
    endpoint = free_endpoint()
    router = start("router", "--listen", endpoint)
    through = Endpoints(connect=(endpoint,))
    try:
        fakes("a", "plant", endpoints=through)
        two = fakes("a", "controller", endpoints=through)

        def both_answer() -> bool:
            """The router hears of one before it hears of the other."""
            content = status_of(through, "a", patience_s=60.0).as_json()["cars"]["a"]
            return all(one is not None and one["answering"] for one in content.values())

        until(both_answer, "answers of both through the router")
        assert run("stop", "--endpoint", endpoint).returncode == 0
        assert [one.command for one in two.heard] == ["stop"]
    finally:
        router.send_signal(signal.SIGTERM)
        done = finish(router)
    assert done.returncode == 0
    assert done.stderr == f"bayesrace.router: router on {endpoint}\n"


def test_a_router_that_cannot_listen_says_so(cli: Cli) -> None:
    refused(cli("router", "--listen", "tcp/localhost"), "is not of the form protocol/address:port")


# With the real processes -------------------------------------------------------------------------


@pytest.mark.check
def test_real_processes_that_know_only_the_router_are_watched_stopped_and_restarted(
    circuit: Circuit, kinematic_artefact: Path, tmp_path: Path
) -> None:
    endpoint, anywhere = free_endpoint(), "tcp/127.0.0.1:0"
    track, line = tmp_path / "track.csv", tmp_path / "line.csv"
    write_track(track, circuit.track)
    write_raceline(line, circuit.line)
    controller = (
        "controller", "--artefact", kinematic_artefact, "--track", track, "--raceline", line,
        "--name", "one", "--listen", anywhere, "--endpoint", endpoint,
    )  # fmt: skip
    through = Endpoints(connect=(endpoint,))
    here = ("--parent-pid", str(os.getpid()))
    started = [
        start("router", "--listen", endpoint, *here),
        start("plant", "--name", "one", "--endpoint", anywhere, "--connect", endpoint, *here),
        start(*controller, *here),
    ]

    def phase(source: str) -> str | None:
        try:
            network = status_of(through, "one", 2.0)
        except InputError:
            return None
        process = network.cars["one"].get(source)
        return None if process is None or process.status is None else process.status.phase

    try:
        until(lambda: phase("plant") == "idle" and phase("controller") == "waiting", "both")
        with open_session(through) as session:
            director = Director(session, "one")
            director.wait_for(("plant", "controller"), PATIENCE_S)
            plan = RunPlan(1, "test", laps=0, max_time_s=600.0, lockstep=False)
            director.start(run_request(circuit.track, plan))
            until(lambda: phase("controller") == "driving", "driving")
            done = run("status", "--name", "one", "--json", "--endpoint", endpoint)
            controller_status = json.loads(done.stdout)["cars"]["one"]["controller"]
            assert controller_status["rate_hz"] == 50.0
            assert controller_status["state_age_s"] is not None
            for source, process in json.loads(done.stdout)["cars"]["one"].items():
                shown = {name for names in COUNTERS_SHOWN[source] for name in names if name}
                assert shown <= set(process["counters"])
            done = run("stop", "--reason", "a cat", "--endpoint", endpoint)
            assert done.returncode == 0, done.stderr
            until(lambda: phase("controller") == "stopped", "stopped")
            assert run("go", "--endpoint", endpoint).returncode == 0
            until(lambda: phase("controller") == "driving", "driving again")
            started[2].kill()
            until(lambda: phase("controller") is None, "the controller gone")
            done = run("stop", "--timeout", "0.5", "--endpoint", endpoint)
            assert done.returncode == 2
            assert "no controller found, only the plant of one" in done.stderr
            started.append(start(*controller, *here))
            until(lambda: phase("controller") == "driving", "another controller driving")
    finally:
        for process in reversed(started):
            process.terminate()
            finish(process)
