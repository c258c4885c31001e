"""How figures look, in one place; panels; and figures as SVG for a page, as PDF and as PNG."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure

from bayesrace.files import replacing, write_whole

__all__ = ["INK", "MUTED", "PANEL_WIDTH", "PICTURE_WIDTH", "SURFACE", "WARNING"]
__all__ += ["figure_style", "inline_svg", "panel", "png", "speed_map"]
__all__ += ["write_pdf", "write_png"]

INK: Final = "#1c1c1a"
MUTED: Final = "#75756f"
SURFACE: Final = "#e7e7e2"
WARNING: Final = "#c8102e"

PICTURE_WIDTH: Final = 11.2
"""Of a picture with several panels [inch]."""

PANEL_WIDTH: Final = 5.2
"""Of a panel [inch]: legible on a telephone, and two beside each other on a wide page."""

_MARGINS: Final = 0.82, 0.1, 0.42, 0.3
"""Of a panel: left, right, bottom, top [inch]."""

_NO_METADATA: Final = dict.fromkeys(("Date", "Creator", "Format", "Type"))
_DROPPED: Final = re.compile(r'\A.*?(?=<svg )|\s*<!--.*?-->|(?<=<g) id="[^"]*"', re.DOTALL)
"""The prologue, comments, and ids of groups, which would be the same in several figures."""
_SIZE: Final = re.compile(r'\s(?:width|height)="[^"]*"')
_PATH: Final = re.compile(r' d="[^"]*"')
_LONG: Final = re.compile(r"(\d+\.\d{2})\d+")


def speed_map() -> Colormap:
    """Perceptually uniform, and dark enough at its bright end for a light background."""
    plasma = mpl.colormaps["plasma"]
    shades = [plasma(share) for share in (i / 255 * 0.93 for i in range(256))]
    return LinearSegmentedColormap.from_list("speed", shades)


@contextmanager
def figure_style() -> Iterator[None]:
    """Figures made and drawn in this context look alike."""
    with mpl.rc_context(fname=Path(__file__).with_name("figures.mplstyle")):
        yield


def panel(height: float) -> tuple[Figure, Axes]:
    """A figure with a single panel of this height [inch], with room for title and labels.

    Its margins are fixed: a layout by what is drawn would draw everything twice.
    """
    figure = Figure(figsize=(PANEL_WIDTH, height))
    left, right, bottom, top = (inches / PANEL_WIDTH for inches in _MARGINS)
    tall = PANEL_WIDTH / height
    return figure, figure.add_axes(
        (left, bottom * tall, 1 - left - right, 1 - (bottom + top) * tall)
    )


def inline_svg(figure: Figure) -> str:
    """The figure as an ``<svg>`` element that fills the width it is given.

    Two figures on one page share no ids but those of identical definitions.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata=_NO_METADATA)
    text = _SIZE.sub("", _DROPPED.sub("", buffer.getvalue()), count=2)
    # A hundredth of a point is enough for lines; texts keep their digits.
    return _PATH.sub(lambda match: _LONG.sub(r"\1", match.group()), text)


def write_pdf(figure: Figure, path: Path) -> None:
    """Writes the figure as a PDF file, whole or not at all; the same figure gives the same file."""
    with replacing(path) as partial:
        figure.savefig(partial, format="pdf", metadata={"CreationDate": None})


def png(figure: Figure, dpi: int = 120) -> bytes:
    """The content of a PNG file with the figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def write_png(figure: Figure, path: Path, dpi: int = 120) -> None:
    """Writes the figure as a PNG file, whole or not at all."""
    write_whole(path, png(figure, dpi))
