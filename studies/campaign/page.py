"""The report of a campaign, made from its Parquet files alone: ``report.html``."""

from pathlib import Path
from typing import Final

from bayesrace.files import write_whole
from operation.report.canvas import inline_svg
from operation.report.render import template
from operation.report.style import figure_style, look
from studies.campaign.figures import factor_figures, pair_figures
from studies.campaign.summary import read_laps

__all__ = ["REPORT", "render_campaign"]

REPORT: Final = "report.html"
_TEMPLATE: Final = "campaign.html.j2"


def render_campaign(folder: Path) -> Path:
    """Writes the page into the folder of a campaign's results; returns its path.

    InputError if there are no results.
    """
    laps, others = read_laps(folder)
    with figure_style():
        by_factor = {
            name: [inline_svg(one) for one in factor_figures(laps, name)] for name in laps.varied()
        }
        by_pair = [
            (
                first.name,
                second.name,
                [inline_svg(one) for one in pair_figures(laps, first, second)],
            )
            for first, second in laps.pairs()
        ]
    page = template(_TEMPLATE, Path(__file__).parent).render(
        title=folder.resolve().name,
        facts=laps.facts(),
        summaries=laps.summaries(),
        look=look,
        by_factor=by_factor,
        by_pair=by_pair,
        shown=laps.shown,
        failures=laps.failures(),
        worst=laps.worst(),
        others=others,
    )
    path = folder / REPORT
    write_whole(path, page)
    return path
