"""What happens to weights when their check ends, or hangs, or the disk is full, at bad moments.

Promises guarded: accepted weights are in use and in the store; each request is answered truly, each
refusal counted; a rollback is always possible; a failing check or disk does not disturb the car.

The update manager is in this process, and the test is the control thread: it decides when an offer
is adopted, and what happens meanwhile. Requests go through a Zenoh session without another peer.
"""

import json
import resource
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bayesrace.controller.assembly import PredictiveController, predictive_controller
from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.adoption import Adoption, AgainError, Ruling
from bayesrace.controller.weights.manager import WeightUpdateManager
from bayesrace.gp.weights import Weights, encode_weights
from bayesrace.messages import ROLLBACK, WEIGHTS, Reply, RollbackRequest
from bayesrace.operation.learn.publishing import in_words
from bayesrace.transport import Endpoints, ask, open_session
from bayesrace.vehicles import get_car
from tests.network.cars import Course
from tests.programs import until

pytestmark = pytest.mark.wall_clock

CAR = "orca"


class Bench:
    """A controller's part in new weights, and a client that sends requests."""

    def __init__(
        self, session: Any, controller: PredictiveController, gate: GateSettings, store: Path | None
    ) -> None:
        assert controller.port is not None
        self._session, self._pool = session, ThreadPoolExecutor()
        self._store = store
        self.controller = controller
        self.events: list[tuple[str, str]] = []
        """Kind and text."""
        self.manager = WeightUpdateManager(
            session, CAR, controller.port, Adoption(controller.port, gate), gate,
            lambda kind, text, _: self.events.append((kind, text)),
        )  # fmt: skip
        assert isinstance(self.manager.adoption, Adoption)
        self.adoption = self.manager.adoption
        self._seq = 0

    def cycle(self) -> None:
        """The time between two cycles."""
        self.adoption.between_cycles(self._seq)

    def drive(self, cycles: int, fallen_back: bool = False) -> None:
        """Records as many states; nothing is adopted."""
        for _ in range(cycles):
            self._seq += 1
            self.adoption.observe(0.0, fallen_back)

    def send(self, weights: Weights) -> "Future[Reply]":
        return self._pool.submit(ask, self._session, WEIGHTS, CAR, encode_weights(weights))

    def roll_back(self) -> "Future[Reply]":
        request = RollbackRequest(seq=0, source_time_ns=0, text="test")
        return self._pool.submit(ask, self._session, ROLLBACK, CAR, request)

    def reply(self, answer: "Future[Reply]") -> Reply:
        """The answer, with cycles going on meanwhile."""

        def answered() -> bool:
            self.cycle()
            return answer.done()

        until(answered, "an answer", 60.0)
        return answer.result()

    def accept(self, weights: Weights) -> Reply:
        reply = self.reply(self.send(weights))
        assert reply.accepted, reply.text
        return reply

    @property
    def version(self) -> str:
        """In use."""
        return self.controller.weights_version

    def status(self, name: str) -> Any:
        return self.manager.status()[name]

    def offered(self) -> None:
        """Weights wait for the control thread, which has copied its samples for their check."""
        until(lambda: self.adoption.tasks, "a check")
        self.cycle()
        until(lambda: self.adoption.tasks, "an offer")

    def published(self, kind: str) -> list[str]:
        """Texts of the events of a kind."""
        return [text for one, text in self.events if one == kind]

    def kept(self) -> list[str]:
        """Versions in the store: what a controller that is started now finds."""
        assert self._store is not None
        index = json.loads((self._store / "index.json").read_text())
        return [entry["version"] for entry in index["entries"]]

    def close(self) -> None:
        if not self.manager._stopping:
            self.manager.stop()
        self._pool.shutdown()


@contextmanager
def bench(
    course: Course, gate: GateSettings | None = None, store: Path | None = None
) -> Iterator[Bench]:
    """On that course, started with its weights."""
    files = course.track_file, course.line_file
    controller = predictive_controller(
        course.artefact, get_car(CAR), *files, weights=course.weights_file, store=store
    )
    with open_session(Endpoints()) as session:
        made = Bench(session, controller, gate or GateSettings(), store)
        made.manager.start()
        try:
            yield made
        finally:
            made.close()


def test_an_offer_that_the_control_loop_does_not_adopt_is_withdrawn(
    course: Course, good: Weights, again: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bayesrace.controller.weights.adoption._TASK_S", 0.1)
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
    course: Course, again: Weights, monkeypatch: pytest.MonkeyPatch
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
    course: Course, again: Weights, monkeypatch: pytest.MonkeyPatch
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
    course: Course, good: Weights, again: Weights, monkeypatch: pytest.MonkeyPatch
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


def test_requests_while_the_watch_goes_back(course: Course, good: Weights, again: Weights) -> None:
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
    course: Course, good: Weights, again: Weights, proven: bool
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


def test_where_going_back_fails_half_the_way_the_history_knows(
    course: Course, good: Weights, again: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench(course, GateSettings(watch_s=10.0)) as made:
        made.accept(replace(again, version="one"))
        made.accept(replace(again, version="two"))
        adopt = made.adoption.adopt

        def lost(packed: bytes, version: str, watched: bool, reverted: int) -> int:
            if version == "one":
                raise AgainError("a piece was lost")
            return adopt(packed, version, watched, reverted)

        monkeypatch.setattr(made.adoption, "adopt", lost)
        reply = made.reply(made.roll_back())
        assert (reply.accepted, made.version) == (False, good.version)
        assert made.manager._history.in_use.version == good.version
        assert f"back to {good.version}" in made.published("weights_rolled_back")[0]


# The store -----------------------------------------------------------------------------------


def test_a_full_disk_does_not_stop_an_adoption(
    tmp_path: Path, course: Course, good: Weights, again: Weights
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
    tmp_path: Path, course: Course, good: Weights, again: Weights
) -> None:
    store = tmp_path / "store"
    with bench(course, store=store) as made:
        store.rename(tmp_path / "away")
        store.write_text("in the way")
        assert "; not kept: store" in made.accept(again).text
        made.drive(25, fallen_back=True)
        made.cycle()
        assert made.version == good.version
