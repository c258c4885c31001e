"""The dead man's switch of a held run: what notices that its director is missing."""

from typing import Any, Final

from bayesrace import clock
from bayesrace.messages import HOLD, Decoder, car_key
from bayesrace.transport.requests import in_transport_thread

__all__ = ["HOLD_MISSING", "HOLD_PERIOD_S", "HoldWatch"]

HOLD_PERIOD_S: Final = 0.05
"""Between two messages of the director."""
_HOLD_S: Final = 0.5
_DRIFT_NS: Final = 10_000
"""The clocks of two machines may differ by so much more with each message (200 ppm)."""

HOLD_MISSING: Final = f"the director that holds the run was missing for {_HOLD_S:g} s (hold-to-run)"
"""Why a car is stopped."""


class HoldWatch:
    """When the director of the current run was heard last; the transport's thread notes that.

    What counts is when the director sent, by the shortest way so far: a link that holds up each
    message longer than the one before must not keep a car driving whose director has gone.
    """

    def __init__(self, session: Any, car: str) -> None:
        self.decoder = Decoder(HOLD.message)
        self._delay_ns = 0
        self.follow((0, 0))
        self._key = car_key(HOLD.key, car)
        self.bind(session)

    def bind(self, session: Any) -> None:
        """Listen on this session from now on."""
        handler = in_transport_thread(self._note)
        self._subscriber = session.declare_subscriber(self._key, handler)

    def follow(self, run: tuple[int, int], required: bool = False) -> None:
        """Watch another run, given by epoch and number. It is held from its first message on, or,
        ``required``, from now on."""
        self.run, self._since_ns = run, clock.monotonic_ns() if required else 0
        self._heard = (0, 0), 0

    @property
    def missing(self) -> bool:
        """Whether the run is held, and its director has not been heard for half a second."""
        run, heard_ns = self._heard
        newest_ns = heard_ns if run == self.run else self._since_ns
        return newest_ns > 0 and clock.monotonic_ns() - newest_ns > _HOLD_S * 1e9

    def _note(self, sample: Any) -> None:
        now_ns, run = clock.monotonic_ns(), self.run
        hold = self.decoder(sample.payload.to_bytes())
        if hold is None or (hold.epoch, hold.run) != run:
            return
        delay_ns = now_ns - hold.source_time_ns  # with the difference of the clocks
        if self._heard[0] == run:
            delay_ns = min(delay_ns, self._delay_ns + _DRIFT_NS)
        self._delay_ns, self._heard = delay_ns, (run, hold.source_time_ns + delay_ns)
