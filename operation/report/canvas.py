"""Figures of one panel; figures to SVG to be embedded in a page, and to PNG."""

import io
import re
from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from bayesrace.files import replacing

__all__ = ["PANEL_WIDTH", "inline_svg", "panel", "write_png"]

PANEL_WIDTH: Final = 5.2
"""Of a panel [inch]: legible on a telephone, and two beside each other on a wide page."""

_PROLOGUE: Final = re.compile(r"^.*?(?=<svg )", re.DOTALL)
_METADATA: Final = re.compile(r"\s*<metadata>.*?</metadata>", re.DOTALL)
_SIZE: Final = re.compile(r'\s(?:width|height)="[^"]*"')
_GROUP_ID: Final = re.compile(r'<g id="[^"]*"')
_COMMENT: Final = re.compile(r"\s*<!--.*?-->", re.DOTALL)
_PATH: Final = re.compile(r' d="[^"]*"')
_LONG: Final = re.compile(r"(\d+\.\d{2})\d+")


def panel(height: float) -> tuple[Figure, Axes]:
    """A figure with a single panel of this height [inch]."""
    figure = Figure(figsize=(PANEL_WIDTH, height), layout="constrained")
    return figure, figure.subplots()


def inline_svg(figure: Figure) -> str:
    """The figure as an ``<svg>`` element that fills the width it is given.

    Two figures on one page share no ids but those of identical definitions.
    """
    buffer = io.StringIO()
    FigureCanvasSVG(figure)
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = _PROLOGUE.sub("", buffer.getvalue(), count=1)
    text = _METADATA.sub("", text)
    text = _COMMENT.sub("", text)
    tag, rest = text.split(">", 1)
    text = _GROUP_ID.sub("<g", f"{_SIZE.sub('', tag)}>{rest}")
    # A hundredth of a point is enough for lines; texts keep their digits.
    return _PATH.sub(lambda match: _LONG.sub(r"\1", match.group()), text)


def write_png(figure: Figure, path: Path, dpi: int = 120) -> None:
    """The figure as a PNG file, whole or not at all."""
    FigureCanvasAgg(figure)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=dpi, metadata={"Software": None})
