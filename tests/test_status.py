"""``bayesrace status``: every process found, in a table and as JSON, once and watched."""

import json
import os
import signal
import subprocess
import sys

import pytest
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.operation.lifecycle import NetworkStatus, ProcessStatus, follow
from bayesrace.operation.terminal.status_table import status_table
from bayesrace.transport import Endpoints, free_endpoint, open_session
from tests import sample_messages as messages
from tests.command_line import Cli, refused
from tests.fake_processes import COUNTERS, PATIENCE_S, Fakes, fakes, options, status_of, where
from tests.programs import ROOT, environment, finish, start, until

__all__ = ["fakes"]

pytestmark = pytest.mark.wall_clock

FIELDS = {
    "answering", "fault", "processes", "status_age_s", "phase", "epoch", "run", "text",
    "weights_version", "track", "rate_hz", "state_age_s", "delay_s", "counters",
}  # fmt: skip


def rendered(network: NetworkStatus) -> str:
    console = Console(width=60, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(status_table(network))
    return capture.get()


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
    lines = [line.split() for line in text.splitlines()]
    assert ["a", "plant", "controller"] in lines
    shown = [line[-1] for line in lines[lines.index(["a", "plant", "controller"]) + 2 :][:8]]
    assert shown == ["driving", "50", "12", "v3", "3", "4/5/6", "34.0", "7/8/9"]
    assert "lockstep" in text
    assert "\x1b" not in text
    assert "\x07" not in text
    assert "a controller: ·[2Jgone ·" in text


def test_a_process_that_does_not_answer_has_a_column(fakes: Fakes) -> None:
    one, two = fakes("a", "plant", mute=True), fakes("a", "controller")
    lines = [line.split() for line in rendered(status_of(where(one, two))).splitlines()]
    assert ["state", "no", "answer", "driving"] in lines
    assert ["messages", "refused/lost/stale", "7/8/9"] in lines


def test_a_heartbeat_that_stops_is_no_answer_any_more() -> None:
    status = messages.status(epoch=1, rate_hz=50.0)
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
        [sys.executable, "-m", "bayesrace.operation.cli", "status", "--watch", *options(one)],
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
