"""New weights while processes come and go: validators and controllers.

Promises guarded: the end of the validator does not touch the drive, and it does not outlive its
controller; accepted weights survive a restart.
"""

import os
import signal
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from bayesrace.gp.weights import GpWeights, encode_weights
from bayesrace.transport import Director, Endpoints, free_endpoint, open_session
from tests.network.cars import Course, start_controller, start_plant
from tests.programs import until
from tests.takeover.rig import Rig, digest, validators

pytestmark = [pytest.mark.wall_clock, pytest.mark.unmeasured]


def test_the_end_of_the_validator_does_not_touch_the_drive(rig: Rig, good: GpWeights) -> None:
    """It is the same, to the bit, as one that nothing disturbs."""
    rig.ready()
    rig.drive(1, seconds=10.0)
    rig.send(replace(good, version="kept"))
    begin = rig.counters()["ticks"]
    rig.start(2, seconds=600.0)
    until(lambda: rig.counters()["ticks"] > begin + 50, "a second of driving")
    (victim,) = validators(rig.controller.process.pid)
    os.kill(victim, signal.SIGKILL)
    until(lambda: not rig.counters()["validator"], "its end is noticed")
    assert "the validator ended" in rig.status().text
    until(lambda: rig.counters()["validator"], "another one")
    assert rig.counters()["validator_starts"] == 2
    assert "validator" not in rig.status().text
    assert rig.send(replace(good, version="after"))["number"] == 2
    assert rig.director.rollback("it knows").data["version"] == "kept"
    rig.director.stop("enough")
    rig.director.wait_for_end(2, 60.0)
    undisturbed, disturbed = ([one for one in rig.states(run) if not one.final] for run in (1, 2))
    count = min(len(undisturbed), len(disturbed))
    assert count > 100
    assert digest(disturbed[:count]) == digest(undisturbed[:count])
    assert rig.off_track_m(1) < 0.0
    assert rig.events("validator_ended")


def test_a_request_that_the_validator_dies_of_is_refused(rig: Rig, good: GpWeights) -> None:
    rig.ready()
    (victim,) = validators(rig.controller.process.pid)
    os.kill(victim, signal.SIGSTOP)
    threading.Timer(0.5, os.kill, (victim, signal.SIGKILL)).start()
    assert "the validator ended" in rig.refusal(encode_weights(good))
    rig.ready()
    assert rig.send(good)["number"] == 1


@pytest.mark.check
@pytest.mark.parametrize("sign", [signal.SIGTERM, signal.SIGKILL])
def test_no_validator_outlives_its_controller(
    tmp_path: Path, course: Course, sign: signal.Signals
) -> None:
    at_plant = free_endpoint()
    with start_controller(tmp_path, course, at_plant, free_endpoint()) as controller:
        pid = controller.process.pid
        until(lambda: validators(pid) != [], "a validator")
        (child,) = validators(pid)
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
