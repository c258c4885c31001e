"""New weights while processes come and go: gatekeepers, restarts, controllers that join late.

Promises guarded: the end of the gatekeeper does not touch the drive, and it does not outlive its
controller; accepted weights survive a restart; who joins late takes over what has been accepted.
"""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from bayesrace.gp.weights import GpWeights, encode_weights, read_weights
from bayesrace.messages import (
    ACCEPTED,
)
from bayesrace.transport import (
    Director,
    Endpoints,
    fetch,
    free_endpoint,
    open_session,
)
from tests.network.cars import Course, Program, start_controller, start_plant
from tests.programs import until
from tests.takeover_rig import Rig, gatekeepers, make_course, rigged


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory) -> Course:
    return make_course(tmp_path_factory.mktemp("course"))


@pytest.fixture(scope="module")
def good(course: Course) -> GpWeights:
    """What the controllers are started with."""
    return read_weights(course.weights_file)


@pytest.fixture
def rig(tmp_path: Path, course: Course) -> Iterator[Rig]:
    with rigged(tmp_path, course) as made:
        yield made


def test_the_gatekeepers_end_does_not_touch_the_drive(rig: Rig, good: GpWeights) -> None:
    rig.ready()
    rig.send(replace(good, version="kept"))
    rig.start(1, lockstep=False, seconds=8.0)
    until(lambda: rig.counters()["ticks"] > 50, "a second of driving")
    (victim,) = gatekeepers(rig.controller.process.pid)
    before = rig.counters()
    os.kill(victim, signal.SIGKILL)
    until(lambda: not rig.counters()["gatekeeper"], "its end is noticed")
    assert "the gatekeeper ended" in rig.status().text
    until(lambda: rig.counters()["gatekeeper"], "another one")
    assert rig.counters()["gatekeeper_starts"] == 2
    assert "gatekeeper" not in rig.status().text
    assert rig.send(replace(good, version="after"))["number"] == 2
    assert rig.director.rollback("it knows").data["version"] == "kept"
    after = rig.counters()
    assert after["brake"] + after["stop"] <= before["brake"] + before["stop"]
    rig.director.wait_for_end(1, 30.0)
    assert rig.off_track_m(1) < 0.0
    assert rig.events("gatekeeper_ended")


def test_a_gatekeeper_that_dies_of_a_request_refuses_it(rig: Rig, good: GpWeights) -> None:
    rig.ready()
    (victim,) = gatekeepers(rig.controller.process.pid)
    os.kill(victim, signal.SIGSTOP)
    threading.Timer(0.5, os.kill, (victim, signal.SIGKILL)).start()
    assert "the gatekeeper ended" in rig.refusal(encode_weights(good))
    rig.ready()
    assert rig.send(good)["number"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("sign", [signal.SIGTERM, signal.SIGKILL])
def test_no_gatekeeper_outlives_its_controller(
    tmp_path: Path, course: Course, sign: signal.Signals
) -> None:
    at_plant = free_endpoint()
    with start_controller(tmp_path, course, at_plant, free_endpoint()) as controller:
        pid = controller.process.pid
        until(lambda: gatekeepers(pid) != [], "a gatekeeper")
        (child,) = gatekeepers(pid)
        controller.process.send_signal(sign)
        controller.process.wait(10)
        until(lambda: not Path(f"/proc/{child}").exists(), "its end")


def test_accepted_weights_survive_a_restart(
    tmp_path: Path, course: Course, good: GpWeights
) -> None:
    """Killed right after the answer; another --weights does not matter any more."""
    store = str(tmp_path / "store")
    at_plant, at_controller = free_endpoint(), free_endpoint()
    where = tmp_path, course, at_plant, at_controller, "--store", store
    with (
        start_plant(tmp_path, at_plant),
        open_session(Endpoints(connect=(at_plant, at_controller))) as session,
    ):
        director = Director(session, "orca")
        with start_controller(*where) as controller:
            director.wait_for(("controller",), 20.0)
            director.send_weights(encode_weights(replace(good, version="one")))
            director.send_weights(encode_weights(replace(good, version="two")))
            controller.kill()
        director.wait_until_gone("controller", 20.0)
        with start_controller(*where) as controller:
            director.wait_for(("controller",), 20.0)
            status = director.status("controller")
            assert (status.weights_version, status.counters["weights_number"]) == ("two", 2)
            assert director.rollback("to see").data["version"] == "one"
            assert (
                director.send_weights(encode_weights(replace(good, version="x"))).data["number"]
                == 3
            )
            controller.end()
        director.wait_until_gone("controller", 20.0)
        with start_controller(*where) as controller:
            director.wait_for(("controller",), 20.0)
            assert director.status("controller").weights_version == "x"
            assert director.rollback("to see").data["version"] == "one"
            assert director.rollback("to the start").data["version"] == good.version
            controller.end()


def test_a_late_controller_takes_what_another_has_accepted(
    tmp_path: Path, course: Course, good: GpWeights
) -> None:
    """Connected to each other; the late one is on hold, and has no weights of its own."""
    at_plant, first_at, late_at = (free_endpoint() for _ in range(3))
    bare = replace(course, weights_file=course.weights_file.with_name("none"))
    arguments = [str(word) for word in bare.arguments[:-2]]
    with ExitStack() as stack:
        stack.enter_context(start_plant(tmp_path, at_plant))
        first = stack.enter_context(start_controller(tmp_path, course, at_plant, first_at))
        session = stack.enter_context(open_session(Endpoints(connect=(at_plant, first_at))))
        director = Director(session, "orca")
        director.wait_for(("controller",), 20.0)
        assert fetch(session, ACCEPTED, "orca") == b""
        sent = encode_weights(replace(good, version="shared"))
        director.send_weights(sent)
        assert fetch(session, ACCEPTED, "orca") == sent
        late = stack.enter_context(
            Program(
                tmp_path / "late.txt", "controller", *arguments, "--endpoint", first_at,
                "--listen", late_at, "--hold", "--parent-pid", str(os.getpid()),
            )
        )  # fmt: skip
        other = stack.enter_context(open_session(Endpoints(connect=(late_at,))))
        follower = Director(other, "orca")
        follower.wait_for(("controller",), 20.0)
        until(lambda: follower.status("controller").weights_version == "shared", "its weights")
        first.end()
        late.end()
