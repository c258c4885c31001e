"""How controllers appear in every picture, page and table: name and colour."""

from collections.abc import Mapping
from typing import Final, NamedTuple

__all__ = ["Look", "look"]


class Look(NamedTuple):
    """How a controller appears everywhere."""

    name: str
    colour: str
    what: str


# Okabe and Ito's colours, which colour-blind readers can distinguish.
_LOOKS: Final[Mapping[str, Look]] = {
    "worstcase": Look("WorstCase", "#D55E00", "e-kinematic model, no correction"),
    "bayesrace": Look("BayesRace", "#0072B2", "corrected by GPs learned before the race"),
    "bayesrace-updated": Look(
        "BayesRace updated", "#009E73", "GPs updated with BayesRace's own laps"
    ),
    "bayesrace-updated-twice": Look(
        "BayesRace updated twice", "#56B4E9", "GPs updated with the laps of the update, too"
    ),
    "bayesrace-limit": Look(
        "BayesRace at the limit", "#E69F00", "maximises progress, GPs updated after each run"
    ),
    "bestcase": Look("BestCase", "#3d3d3a", "the true model, for comparison"),
    "practice": Look("Practice", "#56B4E9", "BayesRace on the training track, learned from"),
    "pure-pursuit": Look("Pure pursuit", "#CC79A7", "controller of the training laps"),
}


_SHADES: Final = (0.0, 0.3, 0.52, -0.35, -0.6)
"""Of the runs of one controller: shares of black in its colour, below zero of white."""


_CARS: Final = ("#D55E00", "#009E73", "#E69F00", "#CC79A7", "#0072B2")
"""Of the second car and later ones, where several drive."""


def look(controller: str, number: int | None = None, car: int = 0) -> Look:
    """Name, colour and description of a controller, or of one of its runs, counted from 1.

    ``car``: its number, from 0. Each but the first has one colour for all of its controllers.
    """
    own = _LOOKS.get(controller, Look(controller, "#56B4E9", ""))
    if car:
        own = own._replace(colour=_CARS[(car - 1) % len(_CARS)])
    if number is None:
        return own
    share = _SHADES[(number - 1) % len(_SHADES)]
    towards = 255 if share < 0 else 0
    parts = (int(own.colour[at : at + 2], 16) for at in (1, 3, 5))
    mixed = (round((1 - abs(share)) * one + abs(share) * towards) for one in parts)
    colour = "#" + "".join(f"{one:02x}" for one in mixed)
    return own._replace(name=f"{own.name}, {number}", colour=colour)
