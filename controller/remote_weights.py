"""New weights for a controller that decides elsewhere, by datagrams (controller/host/br_update.c).

The controller stages, adopts and watches them by itself, and goes back by itself; this side carries
the files and reports to the update manager what the watch has found.
"""

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from bayesrace import clock
from bayesrace.controller.interface import Environment
from bayesrace.controller.remote import RemoteLink
from bayesrace.controller.settings import SAMPLES, GateSettings
from bayesrace.controller.weights.adoption import (
    RULINGS,
    AgainError,
    Ruling,
    WeightsPort,
    ruling_of,
)
from bayesrace.controller.weights.checks import NO_SAMPLES, Samples, slack_of
from bayesrace.errors import InputError, RestartError
from bayesrace.manifest import read_manifest
from bayesrace.messages import PIECE_BYTES, UPDATE, Update, Updated, to_datagram

__all__ = ["RemoteAdoption"]

_PATIENCE_S: Final = 2.0
"""For the answer to a request, which is repeated meanwhile; the controller answers within a
cycle."""
_BEGIN_S: Final = 10.0
"""The same at first: the controller may be starting."""
_REPEAT_S: Final = 0.1
_STAGING_S: Final = 5.0
_LOOK_S: Final = 0.2
"""Between two questions about weights on trial, ..."""
_REST_S: Final = 1.0
"""... and whether the controller is still the same."""


class UnansweredError(AgainError):
    """Whether a request has been carried out is not known."""


class RemoteAdoption:
    """See :class:`.Adopter`. For the update manager's thread, but for :meth:`note`."""

    def __init__(
        self, link: RemoteLink, port: WeightsPort, settings: GateSettings,
        file_of: Callable[[bytes, str], bytes],
    ) -> None:  # fmt: skip
        """``file_of``: the controller's file of packed weights and their version."""
        self.ruled: Callable[[int, Ruling], None] = lambda cycle, ruling: None
        self.reverted = 0
        self.slow: Environment | None = None
        self.us = self.longest_us = self.unknown_s = 0.0
        self.restarted = False
        """The controller counts anew: it is another one, with the weights of its start; or it has
        not said whether it has adopted others. The history may not be what drives."""
        self._link, self._history, self._file_of = link, port.history, file_of
        self._settings = settings
        self._slack = slack_of(port.car, read_manifest(port.artefact).step_s)
        self._seq = clock.monotonic_ns()  # far from the numbers of a bridge before
        self._answer: Updated | None = None
        self._arrived = threading.Condition()
        self._rulings = self._cycle = 0
        self._on_trial, self._looked_s = False, 0.0

    def note(self, answer: Updated) -> None:
        """An answer has come; by the link's thread."""
        with self._arrived:
            self._answer = answer
            self._arrived.notify()

    def begin(self) -> None:
        """Brings the controller up to the history: it may have begun anew, or gone on.

        RestartError without an answer, InputError where its weights are not in the history.
        """
        try:
            self._meet(self._ask("look", patience_s=_BEGIN_S, take=False))
        except AgainError as error:
            raise RestartError(f"{error}: start it first, and the bridge again") from None

    def _meet(self, first: Updated) -> None:
        """``first``: the controller's answer before any weights are sent to it."""
        self._rulings, self.reverted, self._cycle = first.rulings, first.reverted, first.cycle
        in_use, proven = self._history.in_use, self._history.reference
        if first.version == in_use.version and in_use.proven:
            return
        if first.version not in {one.version for one in self._history.entries}:
            raise InputError(
                f"the controller at {self._link.name} drives by weights '{first.version}': give "
                "their file by --weights"
            )
        gone_back = first.ruling and RULINGS[first.ruling - 1] == "back"
        if first.version == proven.version and gone_back and in_use is not proven:
            self._rulings -= 1  # the ruling was made while no bridge asked
            self._take(first)
            return
        for one in (proven, in_use) if in_use is not proven else (proven,):
            self.adopt(one.packed, one.version, not one.proven, self.reverted)

    def follow(self) -> None:
        """Asks what the watch has found."""
        every_s = _LOOK_S if self._on_trial else _REST_S
        if time.monotonic() - self._looked_s > every_s:
            self._looked_s = time.monotonic()
            try:
                self._ask("look", patience_s=_REPEAT_S)
            except AgainError:  # it is asked again
                return

    def samples(self, reverted: int) -> Samples:
        """See :class:`.Adopter`."""
        count = self._ask("sample", reverted=reverted).size
        found, begin = [], 0
        for empty in NO_SAMPLES:
            width = empty.shape[1]
            data = self._read(begin, 8 * count * width)
            found.append(np.frombuffer(data, dtype="<f8").reshape(count, width))
            begin += 8 * SAMPLES * width
        return Samples(*found)

    def adopt(self, packed: bytes, version: str, watched: bool, reverted: int) -> int:
        """See :class:`.Adopter`."""
        data = self._file_of(packed, version)
        for at in range(0, len(data), PIECE_BYTES):
            self._ask("write", at=at, data=data[at : at + PIECE_BYTES])
        until_s = time.monotonic() + _STAGING_S
        while self._ask("stage", at=len(data)).busy:
            if time.monotonic() > until_s:
                raise AgainError("the controller has not staged them in time")
            time.sleep(_REPEAT_S)
        try:
            answer = self._ask("adopt", reverted=reverted, watched=watched)
        except UnansweredError:
            self.restarted = True
            raise
        self._on_trial, self.slow = watched, None
        self.us, self.unknown_s = answer.adoption_us, answer.unknown_s
        self.longest_us = max(self.longest_us, self.us)
        return answer.cycle

    def _read(self, begin: int, size: int) -> bytes:
        pieces = [self._ask("read", at=begin + at).data for at in range(0, size, PIECE_BYTES)]
        return b"".join(pieces)[:size]

    def _ask(
        self, action: str, *, at: int = 0, reverted: int = 0, watched: bool = False,
        data: bytes = b"", patience_s: float | None = None, take: bool = True,
    ) -> Updated:  # fmt: skip
        """The answer to a request; AgainError without, or if it is refused, but InputError for a
        file that cannot be staged."""
        self._seq += 1
        request = Update(
            seq=self._seq, source_time_ns=clock.monotonic_ns(), action=action, at=at,
            reverted=reverted, watched=watched, data=data,
        )  # fmt: skip
        answer = self._answered(to_datagram(UPDATE, request), patience_s or _PATIENCE_S)
        if take:
            self._take(answer)
        if answer.error:
            refusal = InputError if action == "stage" else AgainError
            raise refusal(f"the controller refuses them: {answer.error}")
        return answer

    def _answered(self, datagram: bytes, patience_s: float) -> Updated:
        until_s = time.monotonic() + patience_s
        with self._arrived:
            while time.monotonic() < until_s:
                self._link.send(datagram)
                self._arrived.wait_for(self._is_answered, _REPEAT_S)
                if self._answer is not None and self._is_answered():
                    return self._answer
        raise UnansweredError(f"the controller at {self._link.name} does not answer")

    def _is_answered(self) -> bool:
        return self._answer is not None and self._answer.seq == self._seq

    def _take(self, answer: Updated) -> None:
        """What the watch has found since."""
        self.restarted |= answer.rulings < self._rulings or answer.cycle < self._cycle
        self._cycle = answer.cycle
        if answer.rulings <= self._rulings or not answer.ruling:
            return
        self._rulings, self.reverted = answer.rulings, answer.reverted
        ruling = ruling_of(answer.ruling, _trial(answer), self._settings, self._slack)
        self._on_trial = ruling.action == "slow"
        if self._on_trial:
            self.slow = Environment(ruling.limit_mps, 0.0)
        self.ruled(answer.ruled_at, ruling)


def _trial(answer: Updated) -> Any:
    """The answer's br_mpc_trial."""
    errors = np.reshape(answer.errors, (3, -1)).tolist()
    found = SimpleNamespace(
        samples=answer.samples, fresh=answer.fresh,
        in_use=errors[0], proven=errors[1], nominal=errors[2],
    )  # fmt: skip
    return SimpleNamespace(
        found=found, cycles=answer.cycles, fallen_back=answer.fallen_back,
        fastest_mps=answer.fastest_mps, limit_mps=answer.limit_mps,
    )  # fmt: skip
