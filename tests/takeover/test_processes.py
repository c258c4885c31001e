"""New weights while processes come and go: those that check them, and controllers.

Promises guarded: the end of a check does not touch the drive; accepted weights survive a restart.
"""

import os
import signal
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from bayesrace.gp.weights import GpWeights, encode_weights
from bayesrace.transport import Director, Endpoints, free_endpoint, open_session, send_rollback
from tests.network.cars import Course, start_controller, start_plant
from tests.programs import until
from tests.takeover.rig import Rig, digest, judges

pytestmark = [pytest.mark.wall_clock, pytest.mark.unmeasured]


def test_a_check_that_is_killed_does_not_touch_the_drive(rig: Rig, good: GpWeights) -> None:
    """The request is refused, and the drive is the same, to the bit, as one undisturbed."""
    rig.drive(1, seconds=10.0)
    rig.start(2, seconds=600.0)
    pid = rig.controller.process.pid
    refused: list[str] = []
    request = threading.Thread(target=lambda: refused.append(rig.refusal(encode_weights(good))))
    request.start()
    until(lambda: judges(pid) != [], "a check")
    os.kill(judges(pid)[0], signal.SIGKILL)
    request.join()
    assert "ended with code -9" in refused[0]
    assert rig.send(replace(good, version="after"))["number"] == 1
    rig.director.stop("enough")
    rig.director.wait_for_end(2, 60.0)
    undisturbed, disturbed = ([one for one in rig.states(run) if not one.final] for run in (1, 2))
    count = min(len(undisturbed), len(disturbed))
    assert count > 100
    assert digest(disturbed[:count]) == digest(undisturbed[:count])
    assert rig.off_track_m(1) < 0.0


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
            assert send_rollback(session, "orca", "to see").data["version"] == "one"
            assert (
                director.send_weights(encode_weights(replace(good, version="x"))).data["number"]
                == 3
            )
            controller.end()
        director.wait_until_gone("controller", 20.0)
        with start_controller(*where) as controller:
            director.wait_for(("controller",), 20.0)
            assert director.status("controller").weights_version == "x"
            assert send_rollback(session, "orca", "to see").data["version"] == "one"
            assert send_rollback(session, "orca", "to the start").data["version"] == good.version
            controller.end()
