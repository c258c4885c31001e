"""A plant and a controller that drive, and what can be done to them: in simulated time, or as
processes in real time."""

from abc import ABC, abstractmethod
from typing import Any, Literal, TypeVar

from bayesrace import clock
from bayesrace.messages import (
    COMMAND,
    ROLLBACK,
    STATUS,
    WEIGHTS,
    Command,
    Message,
    Reply,
    RollbackRequest,
    Service,
    Status,
    StatusRequest,
)
from bayesrace.transport.relay import Link

__all__ = ["DrivingSystem", "Part"]

A = TypeVar("A", bound=Message)

Part = Literal["plant", "controller"]

_REASON = "asked for"


class DrivingSystem(ABC):
    """See the module; directions of the link between the two go by who receives."""

    @abstractmethod
    def set_link(self, to: Part, link: Link) -> None:
        """What happens to messages for that process."""

    @abstractmethod
    def hold(self, to: Part) -> None:
        """No message gets there any more."""

    @abstractmethod
    def release(self, to: Part) -> None:
        """The end of that."""

    @abstractmethod
    def pause(self, part: Part, seconds: float) -> None:
        """The process does not run for so long (SIGSTOP)."""

    @abstractmethod
    def kill(self) -> None:
        """The controller ends at once (SIGKILL)."""

    @abstractmethod
    def start(self) -> None:
        """A new controller is started."""

    @abstractmethod
    def ask(self, service: Service[Any, A], request: Message | bytes, source: str = "") -> A:
        """A request and its answer. InputError without any."""

    def status(self, part: Part) -> Status:
        """Of a process, as it answers."""
        return self.ask(STATUS, StatusRequest(seq=0, source_time_ns=clock.monotonic_ns()), part)

    def stop(self) -> Reply:
        """The controller slows the car down to standstill."""
        return self._command("stop")

    def go(self) -> Reply:
        """The controller drives again."""
        return self._command("go")

    def _command(self, command: str) -> Reply:
        now_ns = clock.monotonic_ns()
        request = Command(seq=0, source_time_ns=now_ns, command=command, text=_REASON)
        return self.ask(COMMAND, request)

    def publish(self, weights: bytes) -> Reply:
        """New weights for the controller: its answer, when they are in use or refused."""
        return self.ask(WEIGHTS, weights)

    def roll_back(self) -> Reply:
        """Back to the weights before."""
        request = RollbackRequest(seq=0, source_time_ns=clock.monotonic_ns(), text=_REASON)
        return self.ask(ROLLBACK, request)
