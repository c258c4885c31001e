"""The page as one text: template, style, scripts and plots (uPlot), without anything to load."""

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import msgspec

__all__ = ["page_part", "whole_page"]

_SCRIPTS: Final = ("laps.js", "map.js", "charts.js", "tables.js", "view.js")


@cache
def _part(name: str) -> str:
    return (Path(__file__).parent / name).read_text()


_WHOLE: Final = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>BayesRace</title>
<link rel="icon" href="data:,">
<style>body { margin: 0; } body:has([data-theme=dark]) { background: #121211; }</style>
</head>
<body>
{}
</body>
</html>
"""


def whole_page(updates: Sequence[Any] | None = None) -> str:
    """The page; with ``updates`` it shows those, and needs no server."""
    return _WHOLE.replace("{}", page_part(updates))


def page_part(updates: Sequence[Any] | None, embedded: bool = False) -> str:
    """What a page has to hold to show them; ``embedded``: beside other content, which is light.

    They are in a script, so ``<`` is written as an escape of JSON.
    """
    data = "null" if updates is None else msgspec.json.encode(updates).decode()
    parts = {
        "STYLE": _part("uplot.min.css") + _part("view.css"),
        "PLOTS": _part("uplot.min.js"),
        "DATA": data.replace("<", "\\u003c"),
        "EMBEDDED": "true" if embedded else "false",
        "SCRIPT": "".join(map(_part, _SCRIPTS)),
    }
    return re.sub(r"/\*([A-Z]+)\*/", lambda found: parts[found[1]], _part("view.html"))
