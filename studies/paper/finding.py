"""A published result beside ours, and what a stated criterion says of the two."""

from collections.abc import Sequence
from typing import Final, NamedTuple

from matplotlib.figure import Figure

__all__ = ["ELSEWHERE", "Figures", "Finding", "Section", "at_most"]

ELSEWHERE: Final = "another track than the paper's, see --tracks"
"""Why a lap is not compared."""


class Finding(NamedTuple):
    """One published number or statement and its counterpart here.

    ``criterion``: a clause; the two agree if it ``holds`` (None: there is nothing to compare, and
    ``reason`` says why). ``reason``: why they differ, should they.
    """

    what: str
    published: str
    ours: str
    criterion: str
    holds: bool | None
    reason: str = ""

    @property
    def verdict(self) -> str:
        """In one word or two."""
        return {True: "agrees", False: "differs", None: "not compared"}[self.holds]

    @property
    def sentence(self) -> str:
        """The verdict with its criterion, and the reason of a difference."""
        if self.holds is None:
            return f"Not compared: {self.reason}."
        if self.holds:
            return f"Agrees: {self.criterion}."
        because = f"; {self.reason}" if self.reason else ""
        return f"Differs: it does not hold that {self.criterion}{because}."


def at_most(
    what: str, published: float, ours: float | None, unit: str = "", reason: str = "",
    comparable: bool = True,
) -> Finding:  # fmt: skip
    """Of a number of which less is better; None for ours: there is none."""
    form = ".3f" if unit == "s" else ".3g"
    left = f"{published:{form}} {unit}".strip()
    right = "none" if ours is None else f"{ours:{form}} {unit}".strip()
    if not comparable:
        return Finding(what, left, right, "", None, ELSEWHERE)
    holds = ours is not None and bool(ours <= published)
    return Finding(what, left, right, "ours is at most the published one", holds, reason)


Figures = dict[str, Figure]
"""By file name without suffix."""


class Section(NamedTuple):
    """Figures and findings of one part of the paper, its ``place``; ``text``: what is shown."""

    title: str
    place: str
    text: str
    figures: Figures
    findings: Sequence[Finding]
