"""What the controller makes of published weights."""

from dataclasses import dataclass

from bayesrace.messages import Reply, Scalar

__all__ = ["Answer", "NotTakenOverError"]


class NotTakenOverError(RuntimeError):
    """The controller was asked and said no; the message is its reason."""


@dataclass(frozen=True)
class Answer:
    """What a controller said to new weights, or to going back."""

    accepted: bool
    text: str
    """Its words: what now, or why not."""
    version: str = ""
    """In use from now on, or refused."""
    before: str = ""
    """Of the weights given up, after going back."""
    cycle: int | None = None
    """Cycle of the controller from which on; None if it does not say."""
    acceptance: int | None = None
    """Number of this takeover among all of the car's."""
    again: bool = False
    """Not accepted for a reason that passes: the same may be accepted later."""
    not_kept: str = ""
    """Why the controller would not have them after a restart; empty if it has them or no store."""

    @classmethod
    def of(cls, reply: Reply) -> "Answer":
        """What is in the data of a reply; what is missing there, or of another type, is not."""
        return cls(
            reply.accepted,
            reply.text,
            str(reply.data.get("version", "")),
            str(reply.data.get("from_version", "")),
            _count(reply.data.get("cycle")),
            _count(reply.data.get("number")),
            not reply.accepted and reply.data.get("again") is True,
            str(reply.data.get("not_kept", "")),
        )

    @property
    def words(self) -> str:
        """For people."""
        if not self.accepted:
            return f"refused{' for now, try again' if self.again else ''}: {self.text}"
        if self.cycle is None:
            return f"taken over: {self.text}"
        which = "" if self.acceptance is None else f" (acceptance {self.acceptance})"
        kept = f", but not kept: {self.not_kept}" if self.not_kept else ""
        return f"taken over at cycle {self.cycle}{which}{kept}"


def _count(value: Scalar | None) -> int | None:
    return value if type(value) is int else None
