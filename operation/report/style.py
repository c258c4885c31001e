"""How the report's figures look, in one place."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

import matplotlib as mpl
from matplotlib.colors import Colormap, LinearSegmentedColormap, to_hex, to_rgb

__all__ = [
    "INK",
    "MUTED",
    "PICTURE_WIDTH",
    "SURFACE",
    "WARNING",
    "Look",
    "figure_style",
    "gain_map",
    "look",
    "speed_map",
]

INK: Final = "#1c1c1a"
MUTED: Final = "#75756f"
SURFACE: Final = "#e7e7e2"
WARNING: Final = "#c8102e"

PICTURE_WIDTH: Final = 11.2
"""Of a picture with several panels [inch]."""


class Look(NamedTuple):
    """How a controller appears everywhere."""

    name: str
    colour: str
    what: str


# Okabe and Ito's colours, which colour-blind readers can distinguish.
_LOOKS: Final[Mapping[str, Look]] = {
    "worstcase": Look("WorstCase", "#D55E00", "e-kinematic model, no correction"),
    "bayesrace": Look("BayesRace", "#0072B2", "corrected by GPs learned from pure pursuit"),
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
    "pure-pursuit": Look("Pure pursuit", "#CC79A7", "controller of the training laps"),
}


_SHADES: Final = (0.0, 0.3, 0.52, -0.35, -0.6)
"""Of the runs of one controller: shares of black in its colour, below zero of white."""


def look(controller: str, number: int | None = None) -> Look:
    """Name, colour and description of a controller, or of one of its runs, counted from 1."""
    own = _LOOKS.get(controller, Look(controller, "#56B4E9", ""))
    if number is None:
        return own
    share = _SHADES[(number - 1) % len(_SHADES)]
    towards = 1.0 if share < 0 else 0.0
    red, green, blue = ((1 - abs(share)) * one + abs(share) * towards for one in to_rgb(own.colour))
    return own._replace(name=f"{own.name}, {number}", colour=to_hex((red, green, blue)))


def speed_map() -> Colormap:
    """Perceptually uniform, and dark enough at its bright end for a light background."""
    plasma = mpl.colormaps["plasma"]
    shades = [plasma(share) for share in (i / 255 * 0.93 for i in range(256))]
    return LinearSegmentedColormap.from_list("speed", shades)


def gain_map() -> Colormap:
    """Gains in blue, losses in red, and what is neither dark enough for a light background."""
    return LinearSegmentedColormap.from_list("gain", ["#0072B2", "#8d8d86", "#C8321E"])


@contextmanager
def figure_style() -> Iterator[None]:
    """Figures made and drawn in this context look alike."""
    with mpl.rc_context(fname=Path(__file__).with_name("figures.mplstyle")):
        yield
