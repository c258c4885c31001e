"""What the laps of a campaign come to: tables made of its Parquet files alone, and ``report.html``.

:func:`read_laps` makes one table, a row a lap. :func:`summarised` is a row for each value of any of
its columns: controllers, a factor and controllers, two factors. The figures show lap time and
off-track rate by each factor, and by pairs of settings.
"""

import re
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.operation.look import look
from bayesrace.operation.report.render import template
from bayesrace.operation.report.style import INK, PANEL_WIDTH, figure_style, inline_svg, panel
from bayesrace.studies.campaign.case import CONTROLLERS, FAILED, factors
from bayesrace.studies.campaign.results import read_results

__all__ = ["render_campaign"]

_LEVELS: Final = 10  # values of a factor that are shown each on its own
_BINS: Final = 6  # of a number with more values: spans that hold equally many laps
_PAIRS: Final = 6
_WORST: Final = 20
_NUMBERS: Final = re.compile(r"-?\d+(\.\d+)?")
_MOST: Final = 16  # values in one figure; of more, those with the most laps off the track
_TEXT: Final = 14  # characters of a value that are shown
_SLANTED: Final[dict[str, Any]] = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"}


def read_laps(folder: Path) -> tuple[pd.DataFrame, int]:
    """The rows of a campaign's folder, and how many rows of other software were left out.

    Beside the columns of the file, in ``driven`` rows, which did not fail: ``first`` and
    ``unfinished`` laps, and those that are ``bad``: off the track or unfinished. Times of
    ``standing`` and ``flying`` laps, and ``compared``: those of flying laps, or of all where no run
    has a second lap; ``relative`` to the median on the same track [%].

    InputError if there are no rows.
    """
    table = read_results(folder).to_pandas()
    if table.empty:
        raise InputError(f"{folder} holds no results; 'bayesrace campaign PLAN.toml' makes some")
    laps = table[table.software == table.software.iloc[-1]].reset_index(drop=True)
    texts = laps.select_dtypes("str").columns
    laps[texts] = laps[texts].fillna("")
    driven, time_s, lap = laps.ended != FAILED, laps.lap_time_s, laps.lap
    unfinished = driven & time_s.isna()
    compared = time_s.where(lap > min(1.0, lap.max() - 1))
    laps = laps.assign(
        driven=driven, failed=~driven, first=driven & (lap == 1), unfinished=unfinished,
        bad=unfinished | (laps.off_track_samples > 0), standing=time_s.where(lap == 1),
        flying=time_s.where(lap > 1), compared=compared,
        relative=100 * (compared / compared.groupby(laps.track).transform("median") - 1),
    )  # fmt: skip
    return laps, len(table) - len(laps)


def summarised(laps: pd.DataFrame, by: list[str], of: str = "relative") -> pd.DataFrame:
    """A row for each combination of the values of ``by``.

    Sums, medians of the times, the share of bad laps with its 95 % interval [%] by Wilson's score
    ("Probable inference …", JASA 1927; good for rare events), and the 10th, 50th and 90th
    percentile of the column ``of``.
    """
    groups = laps.groupby(by)
    table = groups.agg(
        laps=("driven", "sum"), runs=("first", "sum"), unfinished=("unfinished", "sum"),
        failed=("failed", "sum"), bad=("bad", "sum"), deepest_m=("off_track_max_m", "max"),
        fallbacks=("fallbacks", "sum"), standing_s=("standing", "median"),
        flying_s=("flying", "median"),
    )  # fmt: skip
    table[["low", "median", "high"]] = groups[of].quantile([0.1, 0.5, 0.9]).unstack()
    n, z2 = table.laps.where(table.laps > 0), 1.96**2
    share = table.bad / n
    centre = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = np.sqrt(z2 * (share * (1 - share) / n + z2 / (4 * n * n))) / (1 + z2 / n)
    return table.assign(
        share=100 * share,
        share_low=100 * (centre - half).clip(lower=0.0),
        share_high=100 * (centre + half).clip(upper=1.0),
    )


def by_controller(laps: pd.DataFrame) -> pd.DataFrame:
    """:func:`summarised`, and how far each is behind BestCase's best flying lap in the same case
    [s]: 5 %, median and 95 % of the cases, not a number without BestCase."""
    best = laps.groupby(["key", "controller"]).compared.min().unstack()
    behind = best.sub(best.get("bestcase", np.nan), axis=0).quantile([0.05, 0.5, 0.95]).T
    behind.columns = ["behind_low", "behind", "behind_high"]
    return summarised(laps, ["controller"]).loc[in_order(laps)].join(behind)


def in_order(laps: pd.DataFrame) -> list[str]:
    """The controllers that drove, in the order of the paper."""
    return [name for name in CONTROLLERS if name in set(laps.controller)]


def shown(laps: pd.DataFrame) -> str:
    """The controller that pairs of settings are shown of."""
    found = [*in_order(laps), ""]
    return next(one for one in ("bayesrace-updated", "bayesrace", *found) if one in found)


@dataclass(frozen=True)
class Levels:
    """A factor's values, or spans of them, and which one each row has."""

    name: str
    labels: list[str]
    index: "pd.Series[int]"


def varied(laps: pd.DataFrame) -> list[str]:
    """Factors with more than one value."""
    return [name for name in factors() if name in laps and laps[name].nunique(dropna=False) > 1]


def levels(laps: pd.DataFrame, name: str) -> Levels:
    """The values of a factor, or spans of them where there are many."""
    values = laps[name]
    index, distinct = pd.factorize(values, sort=True, use_na_sentinel=False)
    labels = [_label(one) for one in distinct]
    if pd.api.types.is_numeric_dtype(values) and len(distinct) > _LEVELS:
        edges = values.quantile(np.linspace(0, 1, _BINS + 1)).unique()
        index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
        labels = [f"{low:.3g}–{high:.3g}" for low, high in pairwise(edges)]
    return Levels(name, labels, pd.Series(index, laps.index))


def pairs(laps: pd.DataFrame) -> list[tuple[Levels, Levels]]:
    """Pairs of varied settings, without tracks and seeds."""
    names = [name for name in varied(laps) if name not in ("track", "train_track", "seed")]
    found = [levels(laps, name) for name in names]
    return list(combinations([one for one in found if len(one.labels) <= _LEVELS], 2))[:_PAIRS]


def failures(laps: pd.DataFrame) -> list[dict[str, Any]]:
    """Runs that failed or ended early, by reason; numbers in reasons do not distinguish."""
    told, names, found = laps[laps.reason != ""], varied(laps), []
    for _, own in told.groupby(told.reason.str.replace(_NUMBERS, "#", regex=True), sort=False):
        counts = own.controller.replace("", "all").value_counts().items()
        named = ", ".join(f"{count} × {one}" for one, count in counts)
        example = {"reason": own.reason.iloc[0], "example": _setting(laps, own.index[0], names)}
        found.append(example | {"controllers": named, "runs": len(own)})
    return sorted(found, key=lambda one: -one["runs"])


def worst(laps: pd.DataFrame) -> list[dict[str, str]]:
    """The laps that left the track farthest, with their settings."""
    names = varied(laps)
    return [
        {
            "controller": one.controller, "lap": f"{one.lap:.0f}",
            "time s": f"{one.lap_time_s:.3f}" if one.lap_time_s > 0 else "–",
            "deepest m": f"{one.off_track_max_m:.3f}", "settings": _setting(laps, one.Index, names),
        }
        for one in laps[laps.off_track_max_m > 0].nlargest(_WORST, "off_track_max_m").itertuples()
    ]  # fmt: skip


def _setting(laps: pd.DataFrame, row: int, names: list[str]) -> str:
    return " · ".join(f"{name} {_label(laps.at[row, name])}" for name in names)


def facts(laps: pd.DataFrame) -> dict[str, str]:
    """About the whole campaign."""
    cases, runs = laps.drop_duplicates("key"), laps[laps["first"]]
    simulated_s, drive_s, case_s = runs.simulated_s.sum(), runs.drive_s.sum(), cases.case_s.sum()
    found = {
        "cases": f"{len(cases)}", "laps": f"{laps.lap_time_s.count()}",
        "failed runs": f"{laps.failed.sum()}", "simulated": f"{simulated_s / 3600:.2f} h",
        "computers": f"{laps.host.nunique()}",
    }  # fmt: skip
    if drive_s and case_s:
        found["drives, a core"] = f"{simulated_s / drive_s:.0f} × real time"
        found["all in all, a core"] = f"{simulated_s / case_s:.1f} × real time"
    return found | {"software": laps.software[0]}


def _label(value: Any) -> str:
    if pd.isna(value):
        return "–"
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return Path(text).stem if text.endswith(".csv") else text


# The page ----------------------------------------------------------------------------------------


def _factor_figures(laps: pd.DataFrame, name: str) -> list[Figure]:
    """Lap time and off-track rate of each controller over the values of a factor.

    Times are medians with a bar from the 10th to the 90th percentile, rates have their 95 %
    interval.
    """
    found, note, by_track = levels(laps, name), "", name == "track"
    laps, order = laps.assign(level=found.index), np.arange(len(found.labels))
    if len(order) > _MOST:
        share = summarised(laps, ["level"]).share.reindex(order).fillna(0.0)
        order = np.argsort(-share.to_numpy(), kind="stable")[:_MOST]
        note = f": {_MOST} of {len(found.labels)}, most off track first"
    times = "flying lap [s]" if by_track else "flying lap against\nits track's median [%]"
    table = summarised(laps, ["controller", "level"], "compared" if by_track else "relative")
    figures, drivers = [], in_order(laps)
    for title, middle, low, high in (
        (times, "median", "low", "high"),
        ("laps off track or unfinished [%]", "share", "share_low", "share_high"),
    ):
        figure, axes = panel(2.5)
        for number, controller in enumerate(drivers):
            own = table.loc[controller].reindex(order).assign(place=np.arange(len(order)))
            own = own[own[middle].notna()]
            axes.errorbar(
                own.place + 0.12 * (number - (len(drivers) - 1) / 2), own[middle],
                yerr=np.maximum([own[middle] - own[low], own[high] - own[middle]], 0.0), fmt="o",
                markersize=3.5, linewidth=1.1, color=look(controller).colour,
            )  # fmt: skip
        labels = [_short(found.labels[level]) for level in order]
        form = _SLANTED if sum(map(len, labels)) > 48 else {}
        axes.set_xticks(range(len(order)), labels, **form)
        axes.set(title=name + note, ylabel=title, xlim=(-0.6, len(order) - 0.4))
        figures.append(figure)
    axes.set_ylim(bottom=0)
    return figures


def _short(text: str) -> str:
    return text if len(text) <= _TEXT else f"{text[: _TEXT - 1]}…"


def _pair_figures(laps: pd.DataFrame, first: Levels, second: Levels) -> list[Figure]:
    """Median flying lap and off-track rate over two settings, of one controller."""
    both = laps.assign(row=second.index, column=first.index)
    table = summarised(both[laps.controller == shown(laps)], ["row", "column"])
    rows, columns = range(len(second.labels)), range(len(first.labels))
    times, rates = (
        table[name].unstack().reindex(index=rows, columns=columns).to_numpy()
        for name in ("median", "share")
    )
    return [
        _heat(times, first, second, "flying lap against its track's median [%]", "{:+.2f}"),
        _heat(rates, first, second, "laps off track or unfinished [%]", "{:.1f}"),
    ]


def _heat(values: Floats, first: Levels, second: Levels, title: str, form: str) -> Figure:
    rows, columns = values.shape
    figure = Figure(figsize=(PANEL_WIDTH, 0.34 * rows + 1.1), layout="constrained")
    axes = figure.subplots()
    axes.imshow(values, cmap="YlOrRd", aspect="auto", origin="lower")
    middle = np.nanmean(values) if np.isfinite(values).any() else 0.0
    for i, j in np.ndindex(values.shape):
        if np.isfinite(values[i, j]):
            dark = values[i, j] > middle + 0.3 * (np.nanmax(values) - np.nanmin(values))
            colour = "white" if dark else INK
            axes.text(j, i, form.format(values[i, j]), ha="center", va="center", color=colour)
    axes.set_xticks(range(columns), [_short(one) for one in first.labels], **_SLANTED)
    axes.set_yticks(range(rows), [_short(one) for one in second.labels])
    axes.set(xlabel=first.name, ylabel=second.name, title=title)
    axes.grid(visible=False)
    return figure


def render_campaign(folder: Path) -> Path:
    """Writes the page into the folder of a campaign's results; returns its path.

    InputError if there are no results.
    """
    laps, others = read_laps(folder)
    with figure_style():
        drawn = {name: _factor_figures(laps, name) for name in varied(laps)}
        drawn |= {
            f"{first.name} × {second.name}": _pair_figures(laps, first, second)
            for first, second in pairs(laps)
        }
        figures = {name: [inline_svg(one) for one in own] for name, own in drawn.items()}
    page = template("campaign.html.j2", Path(__file__).parent).render(
        title=folder.resolve().name, facts=facts(laps), look=look, figures=figures,
        controllers=list(by_controller(laps).itertuples()), shown=shown(laps),
        failures=failures(laps), worst=worst(laps), others=others,
    )  # fmt: skip
    path = folder / "report.html"
    write_whole(path, page)
    return path
