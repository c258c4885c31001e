"""Car time on one line through all runs of a log: what viewers play."""

from typing import Final

from bayesrace.messages import Actuation, Message, State, Telemetry

__all__ = ["CarClock"]

_LONGEST_GAP_NS: Final = 10_000_000_000
"""Between two states of a run; a longer one is no driving."""


class CarClock:
    """Car time, from the calendar time of a log's first message.

    A run begins where the one before has ended, in real time at its own calendar time.
    """

    def __init__(self) -> None:
        self._run: tuple[int, int] | None = None
        self._begin_ns = self._newest_ns = 0
        self._decided_ns: dict[str, int] = {}

    def time_ns(self, message: Message | None, wall_ns: int, sender: str) -> int:
        """Of a state its own time, of actuation and telemetry that of the decision; of all else the
        newest state's. ``wall_ns``: calendar time of its arrival; ``sender``: what the keys of a
        controller, or of a shadow, have in common."""
        self._newest_ns = self._newest_ns or wall_ns
        if isinstance(message, Telemetry):  # follows its actuation, from the same process
            return self._decided_ns.get(sender, self._newest_ns)
        if not isinstance(message, State | Actuation):
            return self._newest_ns
        run = message.epoch, message.run
        own_s = message.time_s if isinstance(message, State) else message.decided_at_s
        own_ns = round(1e9 * own_s)
        time_ns = self._begin_ns + own_ns
        goes_on = run == self._run and abs(time_ns - self._newest_ns) <= _LONGEST_GAP_NS
        if isinstance(message, Actuation):  # it can overtake the first state of a run
            self._decided_ns[sender] = time_ns if goes_on else self._newest_ns
            return self._decided_ns[sender]
        if not goes_on:
            time_ns = self._newest_ns if message.lockstep else max(self._newest_ns, wall_ns)
            self._run, self._begin_ns = run, time_ns - own_ns
        self._newest_ns = max(self._newest_ns, time_ns)
        return time_ns
