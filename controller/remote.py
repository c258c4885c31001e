"""A controller that decides elsewhere, as its messages show it: what :class:`.Service` serves."""

import socket
from collections import Counter
from typing import Any, Final

from bayesrace import clock
from bayesrace.controller.driver import Level, Phase
from bayesrace.controller.estimator import Belief
from bayesrace.controller.native_step import Status
from bayesrace.errors import InputError
from bayesrace.messages import (
    COMMAND,
    SENSOR_FAULTS,
    STATE,
    Actuation,
    Command,
    Message,
    State,
    Telemetry,
    from_datagram,
    head_of,
    to_datagram,
)

__all__ = ["RemoteController", "RemoteDriver", "RemoteLink"]

_LARGEST: Final = 1 << 16
_STATE: Final = head_of(STATE)
_REPEAT_NS: Final = 100_000_000
"""Between two commands that have had no effect yet: datagrams may be lost."""


class RemoteLink:
    """Datagrams to and from a controller (docs/host.md): ``udp:ADDRESS:PORT``, ``unix:PATH``."""

    def __init__(self, name: str, own: str = "") -> None:
        """``own``: path that a Unix socket gets, to which the answers come."""
        self.name = name
        kind, _, where = name.partition(":")
        address, _, port = where.rpartition(":")
        unix = kind == "unix"
        if not where or kind not in ("udp", "unix") or not (unix or (address and port.isdigit())):
            raise InputError(f"'{name}' is no link: use udp:ADDRESS:PORT or unix:PATH")
        self._socket = socket.socket(socket.AF_UNIX if unix else socket.AF_INET, socket.SOCK_DGRAM)
        if unix:
            self._socket.bind(own)
        self._there: Any = where if unix else (address, int(port))
        self.unsent = 0
        """Datagrams that could not be sent: nobody listens there, or it is held up."""

    def send(self, data: bytes) -> None:
        """Sends a datagram, or counts that it could not; from any thread."""
        try:
            self._socket.sendto(data, socket.MSG_DONTWAIT, self._there)
        except OSError:
            self.unsent += 1

    def receive(self, timeout_s: float) -> bytes | None:
        """The next datagram; None if there is none in time."""
        self._socket.settimeout(timeout_s)
        try:
            return self._socket.recv(_LARGEST)
        except OSError:
            return None

    def close(self) -> None:
        """No more datagrams."""
        self._socket.close()


class RemoteController:
    """What a status says of the controller itself."""

    port = None

    def __init__(self, track: str) -> None:
        """``track``: identity of the track that it drives."""
        self.track = track
        self.weights_version = ""


class RemoteDriver:
    """Forwards states and commands; knows of the driving what the answers say.

    :meth:`forward` and :meth:`note` are called by the transport's and by the link's thread, all
    else by the one that serves.
    """

    belief: Belief | None = None
    """What is estimated, the telemetry says."""

    def __init__(self, link: RemoteLink, track: str) -> None:
        self.controller = RemoteController(track)
        self.last_error, self.faulty, self.delay_s = "", "", 0.0
        self.newest: State | None = None
        """The newest state that was forwarded."""
        self.instruments: dict[str, Any] = {}
        self._link = link
        self._answer: Actuation | None = None
        self._report: Telemetry | None = None
        self._levels: Counter[int] = Counter()
        self._counts: Counter[str] = Counter()
        self._asked_ns = 0
        """Monotonic clock at the first state since the newest answer; 0: none has come."""
        self._wanted, self._said, self._said_ns = "", 0, 0

    def forward(self, state: State, payload: bytes) -> None:
        """A state, as it has come."""
        self.newest = state  # before its answer can come
        if not self._asked_ns and not state.final:
            self._asked_ns = clock.monotonic_ns()
        self._link.send(_STATE + payload)

    def note(self, data: bytes) -> Message | None:
        """What a datagram of the controller says; None: nothing that is known."""
        _, message = from_datagram(data)
        if isinstance(message, Actuation):
            self._answer, self._asked_ns = message, 0
            self.controller.weights_version = message.weights_version
        elif isinstance(message, Telemetry):
            self._report, self.delay_s = message, message.delay_s
            self._levels[message.fallback] += message.status != Status.HALTED
            self._counts[message.sensor_fault] += bool(message.sensor_fault)
            self._counts["second_starts"] += message.second_start > 0
            self._counts["creeping"] += message.second_start == 3
            self._counts["failed"] += message.status == Status.STEP_FAILED
        return message

    @property
    def phase(self) -> Phase:
        """Where in its life the controller is."""
        if self._answer is None or self._report is None:
            return Phase.WAITING
        if self._answer.status == Status.HALTED:
            return Phase.STOPPED
        return Phase.DRIVING if self._report.fallback == Level.SOLUTION else Phase.FALLBACK

    @property
    def unanswered_s(self) -> float:
        """For how long a state has had no answer; 0 before the first answer of all: the controller
        may start later."""
        asked_ns = self._asked_ns
        waits = asked_ns and self._answer is not None
        return (clock.monotonic_ns() - asked_ns) * 1e-9 if waits else 0.0

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
        self._command("go")

    def repeat(self) -> None:
        """The newest command, while it has had no effect."""
        stopped = self.phase is Phase.STOPPED
        driven = self.phase is not Phase.WAITING
        due = clock.monotonic_ns() - self._said_ns > _REPEAT_NS
        if driven and due and self._wanted and stopped != (self._wanted == "stop"):
            self._command(self._wanted)

    def _command(self, command: str) -> None:
        now_ns = clock.monotonic_ns()
        message = Command(seq=self._said, source_time_ns=now_ns, command=command, text="bridge")
        self._link.send(to_datagram(COMMAND, message))
        self._wanted, self._said, self._said_ns = command, self._said + 1, now_ns
