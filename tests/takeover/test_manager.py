"""What happens to weights when the validator ends, or hangs, or the disk is full, at bad moments.

Promises guarded: accepted weights are in use and in the store; each request is answered in time and
truly, each refusal counted; a rollback is always possible; a failing validator or disk does not
disturb the car, and does not keep the process from ending.
"""

import os
import resource
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from msgspec import structs

from bayesrace.gp.weights import GpWeights
from controller.weights.adoption import RECORDED, Adoption
from controller.weights.prediction import StateRecord
from controller.weights.settings import GateSettings
from controller.weights.store import History, Store
from operation.learn.publishing import in_words
from tests.network.cars import Course
from tests.programs import until
from tests.takeover.bench import a_state, bench

pytestmark = pytest.mark.wall_clock


@pytest.mark.parametrize("keeps", [True, False])
def test_a_validator_killed_between_verdict_and_adoption(
    tmp_path: Path, course: Course, good: GpWeights, again: GpWeights, keeps: bool
) -> None:
    """The offer is adopted all the same, and the next validator knows what is in use."""
    with bench(course, store=tmp_path / "store" if keeps else None) as made:
        answer = made.send(again)
        made.offered()
        os.kill(made.validator, signal.SIGKILL)
        assert not answer.done()
        assert made.version == good.version
        made.cycle()
        assert made.version == again.version
        reply = made.reply(answer)
        assert (reply.accepted, reply.data["version"]) == (True, again.version)
        assert "not kept" not in reply.text
        until(lambda: made.published("weights_accepted") == [reply.text], "the event")
        if keeps:
            assert made.kept() == [again.version]
        made.ready(2)
        assert made.accept(replace(good, version="next")).data["number"] == 2
        assert made.reply(made.roll_back()).data["version"] == again.version


@pytest.mark.check
def test_a_validator_that_hangs_is_replaced(
    course: Course, good: GpWeights, again: GpWeights
) -> None:
    """The request is refused for now; what is in use stays, and is soon watched again."""
    with bench(course, GateSettings(hang_s=1.0)) as made:
        made.accept(again)
        os.kill(made.validator, signal.SIGSTOP)
        reply = made.reply(made.send(replace(good, version="next")))
        assert not reply.accepted
        assert "the validator hung, without an answer for 1 s" in reply.text
        assert "send them again in a moment" in reply.text
        assert reply.data == {"again": True}
        assert made.published("validator_ended")
        assert made.version == again.version
        made.ready(2)
        until(lambda: made.manager.text == "", "all is well")

        def rolls_back() -> bool:
            made.drive(1, fallen_back=True)
            return bool(made.adoption.offers)

        until(rolls_back, "a rollback")
        made.cycle()
        assert made.version == good.version


def test_a_validator_that_is_replaced_watches_from_the_adoption_on(
    course: Course, good: GpWeights, again: GpWeights
) -> None:
    """The next validator gets all recent states, message by message: the result is the same."""
    with bench(course) as made:
        made.drive(200)
        made.accept(again)
        os.kill(made.validator, signal.SIGKILL)
        made.gone()
        made.drive(25, fallen_back=True)
        made.offered()
        made.cycle()
        assert made.version == good.version


def test_the_newest_states_are_kept_for_the_validator() -> None:
    adoption = Adoption(lambda _: None)
    for seq in range(RECORDED + 1000):
        adoption.record(a_state(seq), seq % 2 == 0)
    oldest = adoption.states(0, 64)
    assert [one.number for one in oldest] == list(range(1000, 1064))
    newest = adoption.states(RECORDED + 998, 64)
    assert [(one.seq, one.fallen_back) for one in newest] == [
        (RECORDED + 998, True), (RECORDED + 999, False)
    ]  # fmt: skip
    assert adoption.states(RECORDED + 1000, 64) == []


@pytest.mark.parametrize("fallen_back", [None, False, True])
def test_a_state_is_kept_as_it_was(fallen_back: bool | None) -> None:
    adoption, state = Adoption(lambda _: None), a_state(5)
    odd = structs.replace(
        state, epoch=2**62 + 1, run=3, time_s=0.1 + 0.2, x=(1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 0.1),
        u_applied=(7.5, 8.5), lockstep=not state.lockstep,
    )  # fmt: skip
    adoption.record(state, None)
    before_ns = time.monotonic_ns()
    adoption.record(odd, fallen_back)
    (kept,) = adoption.states(1, 64)
    assert before_ns <= kept.recorded_ns <= time.monotonic_ns()
    assert kept == StateRecord(
        1, odd.epoch, odd.run, odd.seq, odd.time_s, kept.recorded_ns, odd.x, odd.u_applied,
        odd.lockstep, fallen_back,
    )  # fmt: skip
    assert type(kept.lockstep) is bool


def test_a_rollback_needs_no_validator(course: Course, good: GpWeights, again: GpWeights) -> None:
    with bench(course) as made:
        made.accept(again)
        os.kill(made.validator, signal.SIGKILL)
        made.gone()
        assert made.reply(made.roll_back()).data["version"] == good.version


def test_an_offer_that_the_control_loop_does_not_adopt_is_withdrawn(
    course: Course, good: GpWeights, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("controller.weights.manager._ADOPT_S", 0.1)
    with bench(course) as made:
        refusal = made.send(again).result(60.0)
        assert not refusal.accepted
        assert "the control loop did not adopt them within" in refusal.text
        assert refusal.data == {"again": True}
        made.cycle()
        assert made.version == good.version
        monkeypatch.undo()
        assert made.accept(again).data["number"] == 1


def test_a_request_when_too_many_wait_is_refused_for_now(
    course: Course, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("controller.weights.manager._MOST_WAITING", 1)
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
    """By a full queue, by a fault of the controller's own, and at its end."""
    monkeypatch.setattr("controller.weights.manager._MOST_WAITING", 1)
    with bench(course) as made:

        def fails(*_: object) -> None:
            raise RuntimeError("a fault")

        with monkeypatch.context() as patched:
            patched.setattr(made.manager, "_judge", fails)
            reply = made.reply(made.send(again))
        assert (reply.accepted, reply.data) == (False, {"again": True})
        assert "a fault of the controller's own" in reply.text
        assert made.status("weights_refused") == 1
        made.ready(2)
        answers = [made.send(again)]
        made.offered()
        answers += [made.send(again), made.send(again)]
        until(lambda: any(one.done() for one in answers), "one is refused")
        assert made.status("weights_refused") == 2
        made.manager.stop()
        assert not any(one.result(60.0).accepted for one in answers)
        assert made.status("weights_refused") == 4


def test_requests_are_answered_when_the_controller_ends(course: Course, again: GpWeights) -> None:
    """One whose weights are offered, one that waits, and one that comes later."""
    with bench(course) as made:
        answers = [made.send(again)]
        made.offered()
        answers.append(made.roll_back())
        until(lambda: made.manager._waiting.qsize() == 1, "the second request waits")
        made.manager.stop()
        answers.append(made.send(again))
        replies = [answer.result(60.0) for answer in answers]
        assert [(one.accepted, one.text) for one in replies] == [(False, "the controller ends")] * 3
        assert [one.data for one in replies] == [{"again": True}] * 3


def test_an_event_that_cannot_be_published_stops_nothing(
    course: Course, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench(course) as made:

        def fails(*_: object) -> None:
            raise RuntimeError("no network")

        monkeypatch.setattr(made.manager, "_publish", fails)
        os.kill(made.validator, signal.SIGKILL)
        made.gone()
        assert made.accept(again).data["number"] == 1


def test_requests_are_answered_in_time_while_the_validator_is_silent(
    course: Course, good: GpWeights, again: GpWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A verdict that comes too late is ignored, and not taken for the answer to the next."""
    with bench(course, GateSettings(hang_s=3600)) as made:
        made.accept(again)
        monkeypatch.setattr("controller.weights.manager._RETURN_S", 14.0)  # leaves a second
        victim = made.validator
        os.kill(victim, signal.SIGSTOP)
        try:
            reply = made.send(replace(good, version="next")).result(60.0)
        finally:
            os.kill(victim, signal.SIGCONT)
        assert (reply.accepted, reply.data) == (False, {"again": True})
        monkeypatch.undo()
        assert made.accept(replace(good, version="last")).data["number"] == 2
        assert made.version == "last"
        assert made.validator == victim


# Requests and the watch ----------------------------------------------------------------------


def test_a_request_to_roll_back_while_the_watch_does(
    course: Course, good: GpWeights, again: GpWeights
) -> None:
    """One step back is made, not two; and what the watch has rolled back is not accepted again."""
    with bench(course) as made:
        made.accept(again)
        made.accept(replace(again, version="bad"))
        made.drive(25, fallen_back=True)
        made.offered()
        answer = made.roll_back()
        until(lambda: made.manager._waiting.qsize() == 1, "the request has come")
        third = made.send(replace(again, version="third"))
        made.cycle()
        assert made.version == good.version
        reply = made.reply(answer)
        assert (reply.accepted, reply.text) == (False, "the watch has rolled back meanwhile")
        reply = made.reply(third)
        assert (reply.accepted, made.version) == (True, "third")
        until(lambda: len(made.published("weights_rolled_back")) == 1, "the event")
        assert made.status("weights_rolled_back") == 1
        refused = made.reply(made.send(again))
        assert "rolled back before" in refused.text


def test_the_watch_ends_while_a_request_rolls_back(
    course: Course, good: GpWeights, again: GpWeights
) -> None:
    with bench(course) as made:
        made.accept(again)
        answer = made.roll_back()
        made.offered()
        made.drive(50, fallen_back=True)
        reply = made.reply(answer)
        assert (reply.accepted, reply.data["by"]) == (True, "request")
        assert made.version == good.version
        assert made.accept(again).data["number"] == 2  # not withdrawn
        assert made.status("weights_rolled_back") == 1


# The store -----------------------------------------------------------------------------------


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """A disk that hangs until this is set; requests wait a second for it."""
    monkeypatch.setattr("controller.weights.manager._RETURN_S", 12.0)
    monkeypatch.setattr("controller.weights.manager._STORE_S", 1.0)
    free, keep = threading.Event(), Store.keep

    def hangs(store: Store, history: History) -> None:
        free.wait(60.0)
        keep(store, history)

    monkeypatch.setattr(Store, "keep", hangs)
    return free


def test_a_disk_that_hangs_delays_no_answer(
    tmp_path: Path, course: Course, again: GpWeights, disk: threading.Event
) -> None:
    with bench(course, store=tmp_path / "store") as made:
        reply = made.reply(made.send(again))
        assert "; not kept: the store has not been written in time" in reply.text
        assert (reply.accepted, made.version, made.kept()) == (True, again.version, [])
        disk.set()
        until(lambda: made.kept() == [again.version], "it is kept after all")


def test_weights_rolled_back_while_the_store_is_written_are_not_called_accepted(
    tmp_path: Path, course: Course, good: GpWeights, again: GpWeights, disk: threading.Event
) -> None:
    """A disk that hangs delays no rollback; the answer is true when it is sent."""
    store = tmp_path / "store"
    with bench(course, store=store) as made:
        answer = made.send(again)
        made.offered()
        made.cycle()
        assert made.version == again.version
        made.drive(25, fallen_back=True)
        made.offered()
        assert not answer.done()
        reply = made.reply(answer)
        assert (reply.accepted, made.version, made.kept()) == (False, good.version, [])
        assert f"rolled back meanwhile: {good.version} are in use again" in reply.text
        assert not reply.data.get("again")
        events = [kind for kind, _ in made.events]
        assert events == ["weights_accepted", "weights_rolled_back", "weights_refused"]
        disk.set()
    assert len(History.model_validate_json((store / "index.json").read_text()).withdrawn) == 1


def test_a_disk_that_hangs_does_not_keep_the_process_from_ending(tmp_path: Path) -> None:
    program = """
import sys, threading
from pathlib import Path
from controller.weights.store import History, Store, StoreWriter
begun = threading.Event()
Store.keep = lambda *_: begun.set() or threading.Event().wait()
StoreWriter(Store(Path(sys.argv[1]), "d"), History(), print).write()
begun.wait()
"""
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=True, timeout=60)


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
        made.offered()
        made.cycle()
        assert made.version == good.version
