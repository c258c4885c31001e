"""An update manager, in this process: the test is the control thread.

So it decides when an offer is adopted, and what happens meanwhile. Requests go through a Zenoh
session that has no other peer.
"""

import json
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bayesrace.controller.assembly import PredictiveController, predictive_controller
from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.manager import WeightUpdateManager
from bayesrace.gp.weights import GpWeights, encode_weights
from bayesrace.messages import ROLLBACK, WEIGHTS, Reply, RollbackRequest
from bayesrace.transport import Endpoints, ask, open_session
from bayesrace.vehicles import get_car
from tests.network.cars import Course
from tests.programs import until

__all__ = ["Bench", "bench"]

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
            session, CAR, controller.port, gate,
            lambda kind, text, _: self.events.append((kind, text)),
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
            self.adoption.observe(0.0, fallen_back)

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
