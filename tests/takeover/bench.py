"""An update manager with its validator, in this process: the test is the control thread.

So it decides when an offer is adopted, and what happens meanwhile. Requests go through a Zenoh
session that has no other peer.
"""

import json
import os
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bayesrace.gp.weights import GpWeights, encode_weights
from bayesrace.messages import ROLLBACK, WEIGHTS, Reply, RollbackRequest, State
from bayesrace.transport import Endpoints, ask, open_session
from bayesrace.vehicles import get_car
from controller.assembly import predictive_controller
from controller.mpc import PredictiveController
from controller.weights.manager import WeightUpdateManager
from controller.weights.settings import GateSettings
from tests.network.cars import Course
from tests.programs import until
from tests.takeover.rig import validators

__all__ = ["Bench", "a_state", "bench"]

CAR = "orca"


def a_state(seq: int) -> State:
    """Of a car that stands, at 50 Hz."""
    return State(
        seq=seq, source_time_ns=0, epoch=1, run=1, time_s=0.02 * seq, x=(0.0,) * 7,
        u_applied=(0.0, 0.0), lap=0, lockstep=False, actuation_delays=(), final=False,
    )  # fmt: skip


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
            session, CAR, controller.port, gate, adopt=controller.adopt_weights,
            announce=lambda kind, text, _: self.events.append((kind, text)),
        )  # fmt: skip
        self.adoption = self.manager.adoption
        self._seq = 0

    def cycle(self) -> None:
        """The time between two cycles."""
        self.adoption.between_cycles(self._seq)

    def drive(self, cycles: int, fallen_back: bool = False) -> None:
        """Records as many states; nothing is adopted."""
        for _ in range(cycles):
            self._seq += 1
            self.adoption.record(a_state(self._seq), fallen_back)

    def send(self, weights: GpWeights) -> "Future[Reply]":
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

    def accept(self, weights: GpWeights) -> Reply:
        """However often a validator is replaced on a machine that stalls."""
        for _ in range(20):
            self.ready()
            reply = self.reply(self.send(weights))
            if reply.accepted:
                return reply
            assert reply.data.get("again"), reply.text
        raise AssertionError(reply.text)

    @property
    def version(self) -> str:
        """In use."""
        return self.controller.weights_version

    @property
    def validator(self) -> int:
        """Its process number."""
        found: list[int] = []

        def alone() -> bool:
            found[:] = validators(os.getpid())
            return len(found) == 1

        until(alone, "one validator")  # after a stall it may be replaced at this moment
        return found[0]

    def status(self, name: str) -> Any:
        return self.manager.status()[name]

    def ready(self, starts: int = 1) -> None:
        """A validator works, at least this many have been started."""
        until(
            lambda: self.adoption.validator and self.status("validator_starts") >= starts,
            "a validator that works",
        )

    def offered(self) -> None:
        """Weights wait for the control thread."""
        until(lambda: self.adoption.offers, "an offer")

    def gone(self) -> None:
        """The end of the validator is noticed."""
        until(lambda: not self.adoption.validator, "the validator's end is noticed")

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
            made.ready()
            yield made
        finally:
            made.close()
