"""What happens to weights when the gatekeeper ends, or hangs, at the worst of moments.

Promises guarded: who is told that weights are accepted finds them in use and in the store; whoever
asks is answered; there is always a way back; the gatekeeper's trouble is not the car's.
"""

import os
import resource
import signal
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from bayesrace.gp.weights import GpWeights, encode_weights
from controller.gate.settings import GateSettings
from controller.gate.store import Accepted
from controller.latecomer import encode_answer
from experiments.learn.publishing import in_words
from tests.network.cars import Course
from tests.programs import until
from tests.takeover.bench import bench

pytestmark = pytest.mark.wall_clock


@pytest.mark.parametrize("keeps", [True, False])
def test_a_gatekeeper_killed_between_offer_and_takeover(
    tmp_path: Path, course: Course, good: GpWeights, again: GpWeights, keeps: bool
) -> None:
    """What is offered is taken over all the same, and the next gatekeeper knows and keeps it."""
    with bench(course, store=tmp_path / "store" if keeps else None) as made:
        answer = made.send(again)
        made.offered("weights")
        os.kill(made.gatekeeper, signal.SIGKILL)
        made.gone()
        assert not answer.done()
        assert made.version == good.version
        made.cycle()
        assert made.version == again.version
        reply = made.settle(answer)
        assert (reply.accepted, reply.data["version"]) == (True, again.version)
        assert "not kept" not in reply.text
        if keeps:
            assert made.kept() == [again.version]
            assert made.status("gatekeeper_starts") == 2
        made.ready(2)
        assert made.accept(replace(good, version="next")).data["number"] == 2
        assert made.settle(made.roll_back()).data["version"] == again.version


def test_a_gatekeeper_killed_between_takeover_and_keeping(
    tmp_path: Path, course: Course, again: GpWeights
) -> None:
    """Nobody is told that weights are accepted before a restart would find them."""
    with bench(course, store=tmp_path / "store") as made:
        answer = made.send(again)
        made.offered("weights")
        victim = made.gatekeeper
        os.kill(victim, signal.SIGSTOP)
        made.cycle()
        until(lambda: made.status("weights_number") == 1, "the takeover is noted")
        assert made.version == again.version
        assert (made.kept(), answer.done()) == ([], False)
        os.kill(victim, signal.SIGKILL)
        reply = made.settle(answer)
        assert (reply.accepted, made.kept()) == (True, [again.version])
        assert "not kept" not in reply.text
        assert made.said("weights_accepted") == [reply.text]


@pytest.mark.check
def test_a_gatekeeper_that_hangs_is_replaced(
    course: Course, good: GpWeights, again: GpWeights
) -> None:
    """Whoever has asked is told; what is in use stays, and is soon watched again."""
    with bench(course, GateSettings(hang_s=1.0)) as made:
        made.accept(again)
        os.kill(made.gatekeeper, signal.SIGSTOP)
        reply = made.settle(made.send(replace(good, version="next")))
        assert not reply.accepted
        assert "the gatekeeper hung, without a sign of life for 1 s" in reply.text
        assert "send them again in a moment" in reply.text
        assert reply.data == {"again": True}
        assert made.said("gatekeeper_ended")
        assert made.version == again.version
        made.ready(2)
        until(lambda: made.courier.text == "", "all is well")

        def goes_back() -> bool:
            made.drive(1, fallen_back=True)
            return bool(made.takeover.offers)

        until(goes_back, "the watch gives them up")
        made.cycle()
        assert made.version == good.version


def test_an_offer_that_the_control_loop_does_not_take_is_withdrawn(
    course: Course, good: GpWeights, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("controller.courier._TAKE_S", 0.1)
    with bench(course) as made:
        refusal = made.send(again).result(60.0)
        assert not refusal.accepted
        assert "the control loop did not take over within" in refusal.text
        assert refusal.data == {"again": True}
        made.cycle()
        assert made.version == good.version
        monkeypatch.undo()
        assert made.accept(again).data["number"] == 1


def test_whoever_comes_when_too_many_wait_may_come_again(
    course: Course, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench(course) as made:
        monkeypatch.setattr("controller.requests._MOST", 0)
        reply = made.send(again).result(60.0)
        assert (reply.accepted, reply.data) == (False, {"again": True})
        assert "try later" in reply.text
        monkeypatch.undo()
        assert made.accept(again).data["number"] == 1


def test_whoever_waits_when_the_controller_ends_is_told(course: Course, again: GpWeights) -> None:
    with bench(course) as made:
        answers = [made.send(again)]
        made.offered("weights")
        answers.append(made.roll_back())
        until(lambda: made.waiting == 1, "the request to go back waits")
        made.courier.stop()
        replies = [answer.result(60.0) for answer in answers]
        assert [(one.accepted, one.text) for one in replies] == [(False, "the controller ends")] * 2
        assert [one.data for one in replies] == [{"again": True}] * 2


def test_who_asks_after_the_end_is_told(course: Course, again: GpWeights) -> None:
    with bench(course) as made:
        made.courier.stop()
        refusal = made.send(again).result(60.0)
        assert (refusal.text, refusal.data) == ("the controller ends", {"again": True})


def test_an_event_that_cannot_be_published_is_nobodys_trouble(
    course: Course, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench(course) as made:

        def fails(*_: object) -> None:
            raise RuntimeError("no network")

        monkeypatch.setattr(made.courier, "_publish", fails)
        os.kill(made.gatekeeper, signal.SIGKILL)
        made.gone()
        assert made.accept(again).data["number"] == 1


# In time -------------------------------------------------------------------------------------


def test_who_asks_is_answered_however_long_a_gatekeeper_may_be_silent(
    course: Course, good: GpWeights, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what is found too late is not taken over, nor taken for the answer to the next."""
    with bench(course, GateSettings(hang_s=3600)) as made:
        made.accept(again)
        monkeypatch.setattr("controller.requests._RETURN_S", 14.0)  # a second for the verdict
        victim = made.gatekeeper
        os.kill(victim, signal.SIGSTOP)
        try:
            answers = [made.send(replace(good, version="next")), made.roll_back()]
            replies = [answer.result(60.0) for answer in answers]
        finally:
            os.kill(victim, signal.SIGCONT)
        assert [(one.accepted, one.data) for one in replies] == [(False, {"again": True})] * 2
        monkeypatch.undo()
        assert made.accept(replace(good, version="last")).data["number"] == 2
        assert made.version == "last"
        assert made.gatekeeper == victim


@pytest.mark.check
def test_who_asks_is_answered_however_long_keeping_takes(
    tmp_path: Path, course: Course, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("controller.requests._RETURN_S", 12.0)
    monkeypatch.setattr("controller.courier._KEEP_S", 1.0)
    with bench(course, GateSettings(hang_s=3600), tmp_path / "store") as made:
        answer = made.send(again)
        made.offered("weights")
        victim = made.gatekeeper
        os.kill(victim, signal.SIGSTOP)
        try:
            reply = made.settle(answer)
        finally:
            os.kill(victim, signal.SIGCONT)
        assert (reply.accepted, made.version) == (True, again.version)
        assert "; not kept: the gatekeeper did not do so in time" in reply.text
        until(lambda: made.kept() == [again.version], "they are kept after all")


# Others, who are asked -----------------------------------------------------------------------


def test_a_controller_that_is_silent_holds_nobody_up(
    course: Course, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, enough = threading.Event(), threading.Event()

    def fetch(*_: object) -> list[bytes]:
        asked.set()
        enough.wait(120.0)
        return []

    monkeypatch.setattr("controller.courier.fetch_all", fetch)
    with bench(course, fresh=True) as made:
        assert asked.wait(60.0)
        try:
            assert made.accept(again).data["number"] == 1
            made.drive(25, fallen_back=True)
            made.offered("give_up")
            assert not enough.is_set()
        finally:
            enough.set()
    assert not [one for one in threading.enumerate() if one.name in ("question", "courier")]


def test_a_gatekeeper_killed_at_what_others_have_accepted_is_no_verdict(
    course: Course, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = encode_answer(Accepted(1, again.version, encode_weights(again), True, 1), [])
    stopped = threading.Event()

    def fetch(*_: object) -> list[bytes]:
        stopped.wait(60.0)
        return [theirs]

    monkeypatch.setattr("controller.courier.fetch_all", fetch)
    with bench(course, fresh=True) as made:
        victim = made.gatekeeper
        os.kill(victim, signal.SIGSTOP)
        stopped.set()
        until(lambda: made.asked, "they are checked")
        os.kill(victim, signal.SIGKILL)
        made.gone()

        def taken() -> bool:
            made.cycle()
            return made.version == again.version

        until(taken, "they are taken over")
        assert (made.status("weights_refused"), made.said("weights_refused")) == (0, [])


# The watch, and requests at the same time ----------------------------------------------------


def test_a_request_to_go_back_while_the_watch_does(
    course: Course, good: GpWeights, again: GpWeights
) -> None:
    """The watch has said so first; who asks is told, and one step back is made, not two."""
    with bench(course) as made:
        made.accept(again)
        made.accept(replace(again, version="bad"))
        made.drive(25, fallen_back=True)
        made.offered("give_up")
        answer = made.roll_back()
        until(lambda: made.asked, "the request has come")
        third = made.send(replace(again, version="third"))
        made.cycle()
        assert made.version == good.version
        reply = made.settle(answer)
        assert (reply.accepted, reply.text) == (False, "the watch has gone back meanwhile")
        reply = made.settle(third)
        assert (reply.accepted, made.version) == (True, "third")
        assert [len(made.said("weights_rolled_back")), made.status("weights_rolled_back")] == [1, 1]
        refused = made.settle(made.send(again))
        assert "given up before" in refused.text


def test_the_watch_wants_to_go_back_while_a_request_does(
    course: Course, good: GpWeights, again: GpWeights
) -> None:
    with bench(course) as made:
        made.accept(again)
        answer = made.roll_back()
        made.offered("previous")
        made.drive(50, fallen_back=True)
        reply = made.settle(answer)
        assert (reply.accepted, reply.data["by"]) == (True, "request")
        assert made.version == good.version
        assert made.accept(again).data["number"] == 2  # not given up
        assert made.status("weights_rolled_back") == 1


# The store -----------------------------------------------------------------------------------


def test_a_full_disk_does_not_stop_a_takeover(
    tmp_path: Path, course: Course, good: GpWeights, again: GpWeights
) -> None:
    """It is said that weights are not kept; they are as soon as there is room."""
    with bench(course, store=tmp_path / "store") as made:
        hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
        resource.prlimit(made.gatekeeper, resource.RLIMIT_FSIZE, (1000, hard))
        reply = made.accept(again)
        assert "; not kept: store" in reply.text
        assert ", but not kept: store" in in_words(reply)
        assert "File too large" in reply.text
        assert (made.version, made.kept()) == (again.version, [])
        assert "File too large" in made.courier.text
        assert made.said("weights_not_kept")
        resource.prlimit(made.gatekeeper, resource.RLIMIT_FSIZE, (hard, hard))
        reply = made.accept(replace(good, version="next"))
        assert "not kept" not in reply.text
        assert (made.kept(), made.courier.text) == ([again.version, "next"], "")


def test_a_store_that_has_vanished_does_not_keep_a_gatekeeper_from_its_work(
    tmp_path: Path, course: Course, good: GpWeights, again: GpWeights
) -> None:
    store = tmp_path / "store"
    with bench(course, store=store) as made:
        store.rename(tmp_path / "away")  # at once, whatever the gatekeeper is writing there
        store.write_text("in the way")
        os.kill(made.gatekeeper, signal.SIGKILL)
        made.ready(2)
        assert "; not kept: store" in made.accept(again).text
        made.drive(25, fallen_back=True)
        made.offered("give_up")
        made.cycle()
        assert made.version == good.version
