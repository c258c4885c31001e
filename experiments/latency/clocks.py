"""Clocks of several hosts brought together by exchanging timestamps.

In one exchange this process notes its clock, asks another for its own, and notes its clock again.
The other clock was read somewhere between, so half the round trip bounds the error of taking the
middle, however unequal the two ways were. Of the exchanges of a second the one with the smallest
round trip is kept; between those the map from one clock to the other is a straight line, and as
long as the other clock runs evenly from one to the next, so is the truth, which lies within the
bounds of both ends.
"""

from bisect import bisect_left
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Final, Literal, NamedTuple

__all__ = ["ClockPair", "Exchange", "Node", "OffsetEstimator"]

_WINDOW_NS: Final = 1_000_000_000
"""Of the exchanges within this time the best is kept."""

_MOST_NODES: Final = 4096
"""Kept; of more, the older half is let go. What is converted is a few seconds old."""

_OUTSIDE: Final = 200e-6
"""How far a clock may run off outside the nodes: quartz is within 100 ppm on either side."""

_OWN: Final = 0
_OTHER: Final = 1
"""Fields of :class:`Node` by number."""


class Exchange(NamedTuple):
    """One exchange of timestamps [ns]."""

    sent: int
    """Own clock before asking."""
    reading: int
    """The other's clock."""
    received: int
    """Own clock after the answer."""

    @property
    def round_trip(self) -> int:
        """How long it took."""
        return self.received - self.sent


class Node(NamedTuple):
    """The other clock at one time [ns]: ``other - own`` is the offset."""

    own: int
    other: int
    uncertainty: int
    """The true offset is within this of ``other - own``."""

    @property
    def offset(self) -> int:
        """Other clock minus own."""
        return self.other - self.own


@dataclass
class OffsetEstimator:
    """The map between the own clock and one other, from exchanges in order."""

    exchanges: int = 0
    failed: int = 0
    """Exchanges without an answer."""
    _nodes: list[Node] = field(default_factory=list)
    _best: Exchange | None = None
    _window_ends: int = 0
    _first: Node | None = None

    def add(self, exchange: Exchange) -> None:
        """Take an exchange into account, in the order in which they were made."""
        self.exchanges += 1
        if self._best is not None and exchange.received >= self._window_ends:
            self.flush()
        if self._best is None:
            self._window_ends = exchange.received + _WINDOW_NS
        if self._best is None or exchange.round_trip < self._best.round_trip:
            self._best = exchange

    def flush(self) -> None:
        """End the window: what came in it counts from now on."""
        if self._best is None:
            return
        sent, reading, received = self._best
        self._best = None
        # rounded up, and the own clock reads whole nanoseconds
        node = Node((sent + received) // 2, reading, (received - sent + 1) // 2 + 1)
        if self._nodes and not (
            node.own > self._nodes[-1].own and node.other > self._nodes[-1].other
        ):
            self.restart()  # the other clock began anew: another process, or a reboot
        self._nodes.append(node)
        self._first = self._first or node
        if len(self._nodes) > _MOST_NODES:
            del self._nodes[: _MOST_NODES // 2]

    def restart(self) -> None:
        """Forget everything: it was another clock."""
        self._nodes.clear()
        self._first = None

    @property
    def known(self) -> bool:
        """Whether anything is known of the other clock."""
        return bool(self._nodes)

    @property
    def last(self) -> Node:
        """The newest node."""
        return self._nodes[-1]

    @property
    def drift_ppm(self) -> tuple[float, float] | None:
        """How much faster the other clock runs, between the first and the last node, and the
        uncertainty of that; None with one node."""
        first, last = self._first or self.last, self.last
        elapsed = last.own - first.own
        if elapsed <= 0:
            return None
        bound = first.uncertainty + last.uncertainty
        return 1e6 * (last.offset - first.offset) / elapsed, 1e6 * bound / elapsed

    def to_own(self, other: int) -> tuple[int, int]:
        """A reading of the other clock in terms of the own one, and its uncertainty [ns]."""
        offset, uncertainty = self._offset_at(other, _OTHER)
        return other - offset, uncertainty

    def to_other(self, own: int) -> tuple[int, int]:
        """A reading of the own clock in terms of the other one, and its uncertainty [ns]."""
        offset, uncertainty = self._offset_at(own, _OWN)
        return own + offset, uncertainty

    def _offset_at(self, at: int, column: Literal[0, 1]) -> tuple[int, int]:
        """On the line through the nodes on both sides; outside, the nearest node's."""
        nodes = self._nodes
        if not nodes:
            raise ValueError("nothing is known of the other clock")
        i = bisect_left(nodes, at, key=itemgetter(column))
        if i in (0, len(nodes)):
            node = nodes[min(i, len(nodes) - 1)]
            return node.offset, node.uncertainty + round(abs(at - node[column]) * _OUTSIDE)
        before, after = nodes[i - 1], nodes[i]
        share = (at - before[column]) / (after[column] - before[column])
        offset = before.offset + round(share * (after.offset - before.offset))
        bound = before.uncertainty + share * (after.uncertainty - before.uncertainty)
        return offset, int(bound * (1 + _OUTSIDE)) + 2


class ClockPair:
    """Plant and controller: one clock, or two that are led over the own one."""

    def __init__(self) -> None:
        self.plant, self.controller = OffsetEstimator(), OffsetEstimator()
        self.hosts = {"plant": "", "controller": ""}
        self.shared = False
        self.uncertainty_ns = 0
        """The largest of all conversions so far."""

    def decide(self) -> None:
        """One clock if both processes name the same host and their clocks cannot be told apart."""
        self.shared = self.hosts["plant"] == self.hosts["controller"] and self.agree()

    def agree(self) -> bool:
        """Whether the newest readings of both clocks are the same within their uncertainty."""
        plant, controller = self.plant.last, self.controller.last
        apart = abs(plant.offset - controller.offset)
        # As much again for how far apart both clocks may have run between the two readings.
        ran = round(abs(plant.own - controller.own) * _OUTSIDE)
        return apart <= plant.uncertainty + controller.uncertainty + ran

    def to_plant(self, controller_ns: int) -> int:
        """A reading of the controller's clock in terms of the plant's."""
        if self.shared:
            return controller_ns
        own, first = self.controller.to_own(controller_ns)
        plant, second = self.plant.to_other(own)
        self.uncertainty_ns = max(self.uncertainty_ns, first + second)
        return plant
