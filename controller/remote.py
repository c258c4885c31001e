"""A controller that decides elsewhere, as its messages show it: what :class:`.Service` serves."""

import threading
from collections import Counter
from typing import Any, Final

import numpy as np

from bayesrace import clock
from bayesrace.controller.driver import Level, Phase
from bayesrace.controller.estimator import Belief
from bayesrace.controller.native_step import Status
from bayesrace.controller.ports import SerialPort, open_port
from bayesrace.controller.weights.adoption import WeightsPort
from bayesrace.messages import (
    COMMAND,
    SENSOR_FAULTS,
    STATE,
    Actuation,
    Command,
    Message,
    Numbering,
    Scalar,
    Seal,
    State,
    Telemetry,
    from_datagram,
    head_of,
    to_datagram,
)

__all__ = ["RemoteController", "RemoteDriver", "RemoteLink"]

_STATE: Final = head_of(STATE)
_REPEAT_NS: Final = 100_000_000
"""Between two commands that have had no effect yet: datagrams may be lost."""
_AGAIN: Final = 5
"""Times that a go is sent again to a car that does not stand, which cannot show its effect."""
_FARTHEST: Final = 256
"""From one state of a run to the next that is driven on; as ``controller/native/br_state.c``."""
_SILENT_NS: Final = 1_000_000_000
"""Without a state for so long the controller waits for a plant."""


class RemoteLink:
    """Datagrams to and from a controller, by a link of docs/host.md but standard input.

    What others send is not received.
    """

    def __init__(self, name: str, own: str = "", seal: Seal | None = None) -> None:
        """``own``: path that a Unix socket gets, to which the answers come; ``seal``: of a
        controller with a key. InputError for what is no link."""
        self.name, self._seal, self._sending = name, seal, threading.Lock()
        self._port = open_port(name, own)
        self.unsent = 0
        """Datagrams that could not be sent: no process listens there, or it is held up."""
        self.refused = False
        """No process listens there: so the system has said since the newest datagram came."""

    def send(self, data: bytes) -> None:
        """Sends a datagram, or counts that it could not; never waits; from any thread."""
        with self._sending:  # in the order of the counters
            sealed = data if self._seal is None else self._seal.sealed(data)
            try:
                self._port.send(sealed)
            except OSError as error:
                self._note(error)

    def _note(self, error: OSError) -> None:
        self.unsent += 1
        self.refused = isinstance(error, ConnectionRefusedError | FileNotFoundError)

    def receive(self, timeout_s: float) -> bytes | None:
        """The next datagram; None if there is none in time. RestartError where none can come."""
        try:
            data = self._port.receive(timeout_s)
        except OSError as error:  # of a datagram that was sent before
            self._note(error)
            return None
        if data is not None:
            self.refused = False
            if self._seal is not None:
                return self._seal.opened(data)
        return data

    def counters(self) -> dict[str, Scalar]:
        """What did not get through."""
        counts: dict[str, Scalar] = {"unsent": self.unsent}
        if isinstance(self._port, SerialPort):
            counts["bad_frames"] = self._port.frames.bad
        if self._seal is not None:
            counts |= {"forged": self._seal.forged, "replayed": self._seal.replayed}
        return counts

    def close(self) -> None:
        """No more datagrams."""
        self._port.close()


class RemoteController:
    """What a status says of the controller itself."""

    def __init__(self, track: str, port: WeightsPort | None) -> None:
        """``track``: identity of the track that it drives; ``port``: None if it takes no weights
        while it drives."""
        self.track, self.port = track, port
        self.weights_version = ""


class RemoteDriver:
    """Forwards states and commands; knows of the driving what the answers say.

    :meth:`take` and :meth:`forward` are called by the transport's thread, :meth:`note` by the
    link's, all else by the one that serves.
    """

    def __init__(self, link: RemoteLink, track: str, port: WeightsPort | None = None) -> None:
        """As :class:`RemoteController`."""
        self.controller = RemoteController(track, port)
        self.last_error, self.faulty, self.delay_s = "is not reported", "", 0.0
        self.newest: State | None = None
        """The newest state that has come of the run that is driven."""
        self.numbering, self.foreign = Numbering(), 0
        """Of these states; how many were of other runs or plants."""
        self.belief: Belief | None = None
        """What the controller estimates the car's state to be; None: it is measured."""
        self.instruments: dict[str, Any] = {}
        self.answers = self.reports = self.misses = 0
        """Actuations and telemetry so far; of those, sent after their deadline."""
        self._link = link
        self._answer: Actuation | None = None
        self._report: Telemetry | None = None
        self._levels: Counter[int] = Counter()
        self._counts: Counter[str] = Counter()
        self._unanswered_since_ns = self._arrived_ns = 0
        """Monotonic clock at the first state since the newest answer, 0 if none has come since; at
        the newest state."""
        self._wanted, self._commands, self._commanded_ns = "", 0, 0
        self._stood, self._again = False, 0
        """Whether the car stood when the newest command came, and how often a go that came while it
        did not is still to be sent."""

    def take(self, state: State) -> bool:
        """A state has come, to be forwarded next; whether it is of the run that is driven."""
        if not self._continues(state):
            self.foreign += 1
            return False
        if self.newest is not None and self.newest.epoch != state.epoch:
            self.numbering.restart()
        self.numbering.note(state.seq)
        self.newest, self._arrived_ns = state, clock.monotonic_ns()
        if state.final:
            self._unanswered_since_ns = 0  # it gets no answer, nor may those before it
        elif not self._unanswered_since_ns:
            self._unanswered_since_ns = self._arrived_ns
        return True

    def _continues(self, state: State) -> bool:
        """Whether it goes on from the newest, or from what the controller has answered: it decides
        which run it drives."""
        newest, answer = self.newest, self._answer
        if newest is None or answer is None or newest.final or self.silent:
            return True
        return any(
            (state.epoch, state.run) == (epoch, run) and abs(state.seq - seq) <= _FARTHEST
            for epoch, run, seq in (
                (newest.epoch, newest.run, newest.seq),
                (answer.epoch, answer.run, answer.state_seq),
            )
        )

    def excuse(self) -> None:
        """Forgets for how long a state has had no answer: this process did not run meanwhile."""
        self._unanswered_since_ns = 0

    def forward(self, payload: bytes) -> None:
        """The state that was taken, as it has come."""
        self._link.send(_STATE + payload)

    def note(self, data: bytes) -> tuple[str, Message]:
        """Topic and message of a datagram of the controller; InputError if it is none."""
        topic, message = from_datagram(data)
        if isinstance(message, Actuation):
            self._answer, self._unanswered_since_ns = message, 0
            self.controller.weights_version = message.weights_version
            self.answers += 1
        elif isinstance(message, Telemetry):
            self._note_report(message)
        return topic.name, message

    def _note_report(self, report: Telemetry) -> None:
        self._report, self.delay_s = report, report.delay_s
        self.reports += 1
        self.misses += report.missed
        self._levels[report.fallback] += report.status != Status.HALTED
        self._counts[report.sensor_fault] += bool(report.sensor_fault)
        self._counts["second_starts"] += report.second_start > 0
        self._counts["creeping"] += report.second_start == 3
        self._counts["failed"] += report.status == Status.STEP_FAILED
        self.belief = None
        if report.estimate:
            covariance = np.diag(np.square(report.deviation))
            self.belief = Belief(0.0, np.array(report.estimate), covariance)

    @property
    def phase(self) -> Phase:
        """Where in its life the controller is."""
        answer, newest, report = self._answer, self.newest, self._report
        if answer is None or newest is None or newest.final or self.silent:
            return Phase.WAITING
        if (answer.epoch, answer.run) != (newest.epoch, newest.run):
            return Phase.WAITING
        if answer.status == Status.HALTED:
            return Phase.STOPPED
        fallen_back = report is not None and report.fallback != Level.SOLUTION
        return Phase.FALLBACK if fallen_back else Phase.DRIVING

    @property
    def silent(self) -> bool:
        """Whether no state has come for long."""
        return clock.monotonic_ns() - self._arrived_ns > _SILENT_NS

    @property
    def unanswered_s(self) -> float:
        """For how long a state has had no answer."""
        since_ns = self._unanswered_since_ns
        return (clock.monotonic_ns() - since_ns) * 1e-9 if since_ns else 0.0

    @property
    def ticks(self) -> int:
        """Cycles so far: the ``seq`` of the next telemetry."""
        return 0 if self._report is None else self._report.seq + 1

    @property
    def levels(self) -> list[int]:
        """Cycles so far by level of the fallback; those on command are not among them."""
        return [self._levels[level] for level in Level]

    @property
    def faults(self) -> dict[str, int]:
        """Cycles by what spoke against their states."""
        return {name: self._counts[name] for name in SENSOR_FAULTS[1:]}

    @property
    def fault(self) -> str:
        """What speaks against the newest state; empty: nothing."""
        return "" if self._report is None else self._report.sensor_fault

    @property
    def fault_text(self) -> str:
        """The same as a sentence."""
        return "the controller does not believe its sensors"

    def count(self, name: str) -> int:
        """A count by name, as of :meth:`.Driver.count`; 0 of what messages do not say."""
        return self._counts[name]

    def stop(self) -> None:
        """Slow down along the line to standstill, and stay."""
        self._command("stop")

    def go(self) -> None:
        """Drive."""
        self._stood, self._again = self.phase is Phase.STOPPED, _AGAIN
        self._command("go")

    def repeat(self) -> None:
        """The newest command, while the car is driven: a stop until it stands; a go to one that
        stood until it drives, to another one a few times. Then the go is over: who else stops the
        car afterwards has stopped it."""
        phase, now_ns = self.phase, clock.monotonic_ns()
        if phase is Phase.WAITING or now_ns - self._commanded_ns <= _REPEAT_NS:
            return
        stands = phase is Phase.STOPPED
        if self._wanted == "stop":
            if not stands:
                self._command("stop")
        elif self._wanted == "go":
            self._again -= not self._stood
            if stands if self._stood else self._again >= 0:
                self._command("go")
            else:
                self._wanted = ""

    def _command(self, command: str) -> None:
        now_ns = clock.monotonic_ns()
        message = Command(seq=self._commands, source_time_ns=now_ns, command=command, text="bridge")
        self._wanted, self._commanded_ns = command, now_ns
        self._commands += 1
        self._link.send(to_datagram(COMMAND, message))
