"""A courier with its gatekeeper, in this process: the test is the control thread.

So it says when an offer is taken, and what happens meanwhile. Requests go through a Zenoh session
that is connected to nobody.
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
from controller.courier import Courier
from controller.gate.settings import GateSettings
from controller.mpc import PredictiveController
from tests.network.cars import Course
from tests.programs import until
from tests.takeover.rig import gatekeepers

__all__ = ["Bench", "bench"]

CAR = "orca"


class Bench:
    """What a controller process has to do with weights, and who asks it."""

    def __init__(
        self, session: Any, controller: PredictiveController, gate: GateSettings, store: Path | None
    ) -> None:
        assert controller.port is not None
        self._session, self._pool = session, ThreadPoolExecutor()
        self._store = store
        self.controller, self.port = controller, controller.port
        self.events: list[tuple[str, str]] = []
        """Kind and text."""
        self.courier = Courier(
            session, CAR, self.port, gate, controller.adopt_weights,
            lambda kind, text, _: self.events.append((kind, text)),
        )  # fmt: skip
        self.takeover = self.courier.takeover
        self._seq = 0

    # The control thread --------------------------------------------------------------------------

    def cycle(self) -> None:
        """The time between two cycles."""
        self.takeover.between_cycles(self._seq)

    def drive(self, cycles: int, fallen_back: bool = False) -> None:
        """Notes as many states; nothing is taken over."""
        for _ in range(cycles):
            self._seq += 1
            state = State(
                self._seq, 0, 1, 1, 0.02 * self._seq, (0.0,) * 7, (0.0, 0.0), 0, False, (), False
            )
            self.takeover.note(state, fallen_back)

    # Who asks ------------------------------------------------------------------------------------

    def send(self, weights: GpWeights) -> "Future[Reply]":
        return self._pool.submit(ask, self._session, WEIGHTS, CAR, encode_weights(weights))

    def roll_back(self) -> "Future[Reply]":
        request = RollbackRequest(0, 0, "the test says so")
        return self._pool.submit(ask, self._session, ROLLBACK, CAR, request)

    def settle(self, answer: "Future[Reply]") -> Reply:
        """The answer, with cycles going on meanwhile."""

        def answered() -> bool:
            self.cycle()
            return answer.done()

        until(answered, "an answer", 60.0)
        return answer.result()

    def accept(self, weights: GpWeights) -> Reply:
        """However often a gatekeeper is replaced on a machine that stalls."""
        for _ in range(20):
            self.ready()
            reply = self.settle(self.send(weights))
            if reply.accepted:
                return reply
            assert reply.data.get("again"), reply.text
        raise AssertionError(reply.text)

    # What is so ----------------------------------------------------------------------------------

    @property
    def version(self) -> str:
        """In use."""
        return self.controller.weights_version

    @property
    def gatekeeper(self) -> int:
        """Its process number."""
        found: list[int] = []

        def alone() -> bool:
            found[:] = gatekeepers(os.getpid())
            return len(found) == 1

        until(alone, "one gatekeeper")  # after a stall it may be replaced at this moment
        return found[0]

    def status(self, name: str) -> Any:
        return self.courier.status()[name]

    def ready(self, starts: int = 1) -> None:
        """A gatekeeper works, the so-manieth at least."""
        until(
            lambda: self.takeover.gatekeeper and self.status("gatekeeper_starts") >= starts,
            "a gatekeeper that works",
        )

    @property
    def asked(self) -> bool:
        """A request is under way."""
        return self.courier._job is not None

    @property
    def waiting(self) -> int:
        """Requests that have arrived, and are not under way yet."""
        return len(self.courier._requests)

    def offered(self, kind: str) -> None:
        """Something has come that the control thread could take over."""
        until(lambda: [one.kind for one in self.takeover.offers] == [kind], f"an offer: {kind}")

    def gone(self) -> None:
        """It is noticed that there is no gatekeeper."""
        until(lambda: not self.takeover.gatekeeper, "the gatekeeper's end is noticed")

    def said(self, kind: str) -> list[str]:
        return [text for one, text in self.events if one == kind]

    def kept(self) -> list[str]:
        """Versions in the store: what a controller that is started now finds."""
        assert self._store is not None
        index = json.loads((self._store / "index.json").read_text())
        return [entry["version"] for entry in index["entries"]]

    def close(self) -> None:
        self.courier.stop()
        self._pool.shutdown()


@contextmanager
def bench(
    course: Course,
    gate: GateSettings | None = None,
    store: Path | None = None,
    fresh: bool = False,
) -> Iterator[Bench]:
    """On that course, started with its weights; ``fresh``: with none, so that it asks others."""
    files = course.track_file, course.line_file
    weights = None if fresh else course.weights_file
    controller = predictive_controller(
        course.artefact, get_car(CAR), *files, weights=weights, store=store
    )
    with open_session(Endpoints()) as session:
        made = Bench(session, controller, gate or GateSettings(), store)
        made.courier.start()
        try:
            made.ready()
            yield made
        finally:
            made.close()
