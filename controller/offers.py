"""Offers on their way to the control thread, which takes them over when it has time."""

from contextlib import suppress

from bayesrace.errors import InputError
from controller.gate.memory import Memory
from controller.takeover import Offer, Takeover, WeightsPort

__all__ = ["Offers"]


class Offers:
    """For the courier's thread."""

    def __init__(self, port: WeightsPort, memory: Memory, takeover: Takeover) -> None:
        """``memory``: where the gatekeeper lays weights down."""
        self._port, self._memory, self._takeover = port, memory, takeover
        self.under_way = 0
        """Of which it is not known yet what has become."""

    def put(self, offer: Offer) -> str:
        """Copies what is laid down beside the weights in use, and offers it; "" or why not."""
        try:
            self._port.step.stage_weights(self._memory.outputs())
        except InputError as error:
            return str(error)
        self.under_way += 1
        self._takeover.offers.append(offer)
        return ""

    def withdraw(self, offer: Offer) -> bool:
        """False if it is being taken at this moment: then it counts."""
        with suppress(ValueError):
            self._takeover.offers.remove(offer)
            self.under_way -= 1
            return True
        return False

    def taken(self) -> Offer | None:
        """The next one that has been taken over, or could not be."""
        if not self._takeover.taken:
            return None
        self.under_way -= 1
        return self._takeover.taken.popleft()
