"""What happens to weights when their check ends, or hangs, or the disk is full, at bad moments.

Promises guarded: accepted weights are in use and in the store; each request is answered truly, each
refusal counted; a rollback is always possible; a failing check or disk does not disturb the car.
"""

import resource
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.adoption import Ruling
from bayesrace.gp.weights import GpWeights
from bayesrace.operation.learn.publishing import in_words
from tests.network.cars import Course
from tests.programs import until
from tests.takeover.bench import bench

pytestmark = pytest.mark.wall_clock


def test_an_offer_that_the_control_loop_does_not_adopt_is_withdrawn(
    course: Course, good: GpWeights, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bayesrace.controller.weights.manager._TASK_S", 0.1)
    with bench(course) as made:
        refusal = made.send(again).result(60.0)
        assert not refusal.accepted
        assert "the control loop did not take them over within" in refusal.text
        assert refusal.data == {"again": True}
        made.cycle()
        assert made.version == good.version
        monkeypatch.undo()
        assert made.accept(again).data["number"] == 1


def test_a_request_when_too_many_wait_is_refused_for_now(
    course: Course, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bayesrace.controller.weights.manager._MOST_WAITING", 1)
    with bench(course) as made:
        answers = [made.send(again)]
        made.offered()
        answers += [made.roll_back(), made.roll_back()]
        until(lambda: any(one.done() for one in answers), "one is refused")
        (refused,) = (one.result() for one in answers if one.done())
        assert (refused.accepted, refused.data) == (False, {"again": True})
        assert "try later" in refused.text
        assert sum(made.reply(one).accepted for one in answers) == 2


def test_every_refusal_is_counted(
    course: Course, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a full queue, and by a fault of the controller's own."""
    monkeypatch.setattr("bayesrace.controller.weights.manager._MOST_WAITING", 1)
    with bench(course) as made:

        def fails(*_: object) -> None:
            raise RuntimeError("a fault")

        with monkeypatch.context() as patched:
            patched.setattr(made.manager, "_judge", fails)
            reply = made.reply(made.send(again))
        assert (reply.accepted, reply.data) == (False, {"again": True})
        assert "a fault of the controller's own" in reply.text
        assert made.status("weights_refused") == 1
        answers = [made.send(again)]
        made.offered()
        answers += [made.send(again), made.send(again)]
        until(lambda: any(one.done() for one in answers), "one is refused")
        assert made.status("weights_refused") == 2


def test_a_check_that_hangs_is_killed_by_its_deadline(
    course: Course, good: GpWeights, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The request is refused for now, what is in use stays, and the next one is served."""
    with bench(course) as made:
        monkeypatch.setattr(
            "bayesrace.controller.weights.manager._RETURN_S", 14.0
        )  # leaves a second
        monkeypatch.setattr(
            "bayesrace.controller.weights.checks.RUN_MODULE", (sys.executable, "-c", SLEEP)
        )
        reply = made.reply(made.send(again))
        assert (reply.accepted, reply.data) == (False, {"again": True})
        assert "did not end in time" in reply.text
        assert made.version == good.version
        monkeypatch.setattr(
            "bayesrace.controller.weights.checks.RUN_MODULE", (sys.executable, "-c", FAIL)
        )
        assert "ended with code 3: no memory" in made.reply(made.send(again)).text
        monkeypatch.undo()
        assert made.accept(again).data["number"] == 1


SLEEP = "import time; time.sleep(60)"
FAIL = "import sys; sys.stdin.buffer.read(); print('no memory', file=sys.stderr); sys.exit(3)"


# Requests and the watch ----------------------------------------------------------------------


def test_requests_while_the_watch_goes_back(
    course: Course, good: GpWeights, again: GpWeights
) -> None:
    """One step back is made, not two; weights that have been judged beside those that are rolled
    back are not adopted; and what the watch has rolled back is not accepted again."""
    with bench(course) as made:
        made.accept(again)
        made.accept(replace(again, version="bad"))
        third = replace(again, version="third")
        answers = [made.send(third)]
        made.offered()
        answers.append(made.roll_back())
        until(lambda: made.manager._waiting.qsize() == 1, "the second request waits")
        made.drive(25, fallen_back=True)
        made.cycle()
        assert made.version == good.version
        replies = [made.reply(one) for one in answers]
        assert [one.accepted for one in replies] == [False, False]
        assert all("the watch has rolled back meanwhile" in one.text for one in replies)
        assert replies[0].data == {"again": True}
        assert len(made.published("weights_rolled_back")) == 1
        assert made.status("weights_rolled_back") == 1
        assert made.accept(third).data["number"] == 3
        assert "rolled back before" in made.reply(made.send(again)).text


@pytest.mark.parametrize("proven", [True, False])
def test_back_to_weights_that_were_never_proven(
    course: Course, good: GpWeights, again: GpWeights, proven: bool
) -> None:
    """The watch over them goes back to what was proven before them."""
    gate = GateSettings(watch_s=10.0)
    with bench(course, gate) as made:
        made.accept(replace(again, version="one"))
        made.accept(replace(again, version="two"))
        if proven:
            made.controller.native.prove_weights()
            made.adoption.done.append((0, Ruling("proven", "", {})))
            until(lambda: made.published("weights_proven"), "the event")
        assert made.reply(made.roll_back()).data["version"] == "one"
        made.drive(25, fallen_back=True)
        made.cycle()
        assert made.version == good.version


# The store -----------------------------------------------------------------------------------


def test_a_full_disk_does_not_stop_an_adoption(
    tmp_path: Path, course: Course, good: GpWeights, again: GpWeights
) -> None:
    """The answer says that weights are not kept; they are as soon as there is room."""
    with bench(course, store=tmp_path / "store") as made:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
        try:
            reply = made.accept(again)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert "; not kept: store" in reply.text
        assert ", but not kept: store" in in_words(reply)
        assert "File too large" in reply.text
        assert (made.version, made.kept()) == (again.version, [])
        assert "File too large" in made.manager.text
        assert made.published("weights_not_kept")
        reply = made.accept(replace(good, version="next"))
        assert "not kept" not in reply.text
        assert (made.kept(), made.manager.text) == ([again.version, "next"], "")


def test_a_store_that_has_vanished_does_not_stop_the_watch(
    tmp_path: Path, course: Course, good: GpWeights, again: GpWeights
) -> None:
    store = tmp_path / "store"
    with bench(course, store=store) as made:
        store.rename(tmp_path / "away")
        store.write_text("in the way")
        assert "; not kept: store" in made.accept(again).text
        made.drive(25, fallen_back=True)
        made.cycle()
        assert made.version == good.version
