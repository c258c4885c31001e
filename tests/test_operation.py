"""Operating running cars: stop and go, one of several, and real processes behind a router."""

import json
import os
from pathlib import Path

import pytest

from bayesrace.errors import InputError
from bayesrace.operation.lifecycle import find, pick
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.operation.terminal.status_table import COUNTERS_SHOWN
from bayesrace.raceline.line import write_raceline
from bayesrace.tracks import write_track
from bayesrace.transport import Director, Endpoints, free_endpoint, open_session
from tests.command_line import Cli, refused
from tests.conftest import Circuit
from tests.fake_processes import PATIENCE_S, Fakes, fakes, options, status_of, where
from tests.programs import finish, run, start, until

__all__ = ["fakes"]

pytestmark = pytest.mark.wall_clock


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
    done = cli("stop", "--all", "--timeout", "0.5", *options(*ones))
    refused(done, "'a' failed: no answer within 0.5 s", "'b' refused: no")
    assert done.out == "c: stop: as you say\n"
    assert len(ones[2].heard) == 1


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
