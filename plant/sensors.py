"""The car's sensors: the one place where a measurement is made of the truth."""

from bayesrace.messages import State, Truth

__all__ = ["measure"]


def measure(
    truth: Truth, lockstep: bool, actuation_delays: tuple[float, ...], final: bool
) -> State:
    """What the sensors measure of ``truth``: without error.

    The other arguments are not measured: they concern the exchange of messages, see :class:`State`.
    """
    return State(
        seq=truth.seq,
        source_time_ns=truth.source_time_ns,
        epoch=truth.epoch,
        run=truth.run,
        time_s=truth.time_s,
        x=truth.x,
        u_applied=truth.u_applied,
        lap=truth.lap,
        lockstep=lockstep,
        actuation_delays=actuation_delays,
        final=final,
    )
