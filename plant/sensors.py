"""The car's sensors: the one place where a measurement is made of the truth."""

from bayesrace.messages import State, Truth

__all__ = ["measure"]


def measure(truth: Truth, lockstep: bool, answers: tuple[float, ...], final: bool) -> State:
    """What the sensors measure of ``truth``: without error.

    The other arguments are not measured: they concern the exchange of messages, see :class:`State`.
    """
    return State(
        truth.seq,
        truth.source_time_ns,
        truth.epoch,
        truth.run,
        truth.time_s,
        truth.x,
        truth.u_applied,
        truth.lap,
        lockstep,
        answers,
        final,
    )
