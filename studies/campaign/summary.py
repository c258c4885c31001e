"""What the laps of a campaign come to: by controller, factor and pair; failures, worst laps."""

import re
from collections import Counter
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from studies.campaign.case import CONTROLLERS, factors
from studies.campaign.execute import FAILED
from studies.campaign.results import read_results

__all__ = ["ControllerSummary", "Failure", "Laps", "Levels", "Rate", "read_laps"]

_LEVELS: Final = 10
"""Values of a factor that are shown each on its own."""
_BINS: Final = 6
"""Of a number with more values: spans that hold equally many laps."""
_PAIRS: Final = 6
_WORST: Final = 20
_NUMBERS: Final = re.compile(r"-?\d+(\.\d+)?")


@dataclass(frozen=True)
class Rate:
    """How often something happened, with its 95 % interval."""

    count: int
    total: int

    @property
    def share(self) -> float:
        """Not a number without any."""
        return self.count / self.total if self.total else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's score interval ("Probable inference …", JASA 1927); good for rare events."""
        if not self.total:
            return 0.0, 1.0
        z2, n, p = 1.96**2, self.total, self.share
        centre = (p + z2 / (2 * n)) / (1 + z2 / n)
        half = 1.96 / (1 + z2 / n) * float(np.sqrt(p * (1 - p) / n + z2 / (4 * n * n)))
        return max(centre - half, 0.0), min(centre + half, 1.0)

    def __str__(self) -> str:
        if not self.total:
            return "–"
        low, high = self.interval
        return f"{100 * self.share:.1f} % ({100 * low:.1f}–{100 * high:.1f})"


@dataclass(frozen=True)
class Levels:
    """A factor's values, or spans of them, and which one each row has."""

    name: str
    labels: list[str]
    index: NDArray[np.int64]
    """Shape (rows,)."""


@dataclass(frozen=True)
class ControllerSummary:
    """One controller's laps."""

    controller: str
    runs: int
    unfinished: int
    failed: int
    standing_s: float
    flying_s: float
    behind_s: tuple[float, float, float] | None
    """Behind BestCase on the flying laps of the same case: 5 %, median, 95 %."""
    off_track: Rate
    deepest_m: float
    fallbacks: int


@dataclass(frozen=True)
class Failure:
    """A reason for runs without a result, or without all of their laps."""

    reason: str
    controllers: str
    runs: int
    example: str
    """Settings of one such run."""


class Laps:
    """The rows of a campaign as columns."""

    def __init__(self, table: pa.Table) -> None:
        self._table = table
        self.driven = np.asarray(pc.not_equal(table["ended"], FAILED))
        """Rows of runs, as opposed to failures."""
        self.lap_time_s = self.numbers("lap_time_s")
        self.off_track = self.numbers("off_track_samples") > 0
        self.lap = self.numbers("lap")
        self.controller = self.texts("controller")
        self.key = self.texts("key")
        self.flying = self.driven & (self.lap > min(1, np.nanmax(self.lap, initial=1) - 1))
        """Rows of laps after the first; all where no run has a second."""

    def __len__(self) -> int:
        return len(self._table)

    def numbers(self, name: str) -> Floats:
        """A column; not a number where there is none."""
        column = pc.cast(self._table[name], pa.float64())
        return np.array(pc.fill_null(column, float("nan")), dtype=np.float64)

    def texts(self, name: str) -> NDArray[np.object_]:
        """A column; empty where there is nothing."""
        values = ["" if one is None else str(one) for one in self._table[name].to_pylist()]
        return np.array(values, dtype=object)

    @property
    def controllers(self) -> list[str]:
        """Those that drove, in the order of the paper."""
        found = set(self.controller)
        return [name for name in CONTROLLERS if name in found]

    @property
    def shown(self) -> str:
        """The controller that pairs of settings are shown of."""
        best = ("bayesrace-updated", "bayesrace", *self.controllers)
        return next((one for one in best if one in self.controllers), "")

    # Factors -----------------------------------------------------------------------------------

    def varied(self) -> list[str]:
        """Factors with more than one value."""
        return [
            name
            for name in factors()
            if name in self._table.column_names and pc.count_distinct(self._table[name]).as_py() > 1
        ]

    def levels(self, name: str) -> Levels:
        """The values of a factor, or spans of them where there are many."""
        column = self._table[name]
        number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
        values: NDArray[Any] = self.numbers(name) if number else self.texts(name)
        distinct, index = np.unique(values, return_inverse=True)
        if not number or len(distinct) <= _LEVELS:
            labels = [_label(one) for one in distinct.tolist()]
            return Levels(name, labels, index.astype(np.int64))
        edges = np.unique(np.nanquantile(values, np.linspace(0, 1, _BINS + 1)))
        index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
        labels = [f"{low:.3g}–{high:.3g}" for low, high in pairwise(edges)]
        return Levels(name, labels, index.astype(np.int64))

    def relative(self) -> Floats:
        """Lap time over the median of the same track, car and kind of lap, less 1 [%]."""
        ratio = np.full(len(self), np.nan)
        kind = np.array([f"{a}/{b}" for a, b in zip(self.texts("track"), self.flying, strict=True)])
        for one in np.unique(kind):
            rows = kind == one
            if np.isfinite(self.lap_time_s[rows]).any():
                ratio[rows] = self.lap_time_s[rows] / np.nanmedian(self.lap_time_s[rows]) - 1
        return 100 * ratio

    def pairs(self) -> list[tuple[Levels, Levels]]:
        """Pairs of varied settings, without tracks and seeds."""
        names = [name for name in self.varied() if name not in ("track", "train_track", "seed")]
        found = [self.levels(name) for name in names]
        return list(combinations([one for one in found if len(one.labels) <= _LEVELS], 2))[:_PAIRS]

    def rate(self, rows: NDArray[np.bool_]) -> Rate:
        """How many of these laps leave the track, or end before the line."""
        rows = rows & self.driven
        bad = self.off_track | ~np.isfinite(self.lap_time_s)
        return Rate(int((rows & bad).sum()), int(rows.sum()))

    # Tables ------------------------------------------------------------------------------------

    def summaries(self) -> list[ControllerSummary]:
        """A row for each controller."""
        best = self._flying_of("bestcase")
        return [self._summary(name, best) for name in self.controllers]

    def _flying_of(self, controller: str) -> dict[str, float]:
        """Key of a case to the best flying lap in it."""
        times: dict[str, float] = {}
        rows = (self.controller == controller) & self.flying & np.isfinite(self.lap_time_s)
        for key, time_s in zip(self.key[rows], self.lap_time_s[rows].tolist(), strict=True):
            times[key] = min(time_s, times.get(key, time_s))
        return times

    def _summary(self, controller: str, best: dict[str, float]) -> ControllerSummary:
        own = self.controller == controller
        laps = own & self.driven
        times = self._flying_of(controller)
        behind = [times[key] - best[key] for key in times if key in best]
        low, middle, high = np.percentile(behind, [5, 50, 95]) if behind else (0.0, 0.0, 0.0)
        return ControllerSummary(
            controller,
            runs=int((laps & (self.lap == 1)).sum()),
            unfinished=int((laps & ~np.isfinite(self.lap_time_s)).sum()),
            failed=int((own & ~self.driven).sum()),
            standing_s=_median(self.lap_time_s[laps & (self.lap == 1)]),
            flying_s=_median(self.lap_time_s[laps & (self.lap > 1)]),
            behind_s=(float(low), float(middle), float(high))
            if behind and controller != "bestcase"
            else None,
            off_track=self.rate(own),
            deepest_m=float(np.nanmax(self.numbers("off_track_max_m")[laps], initial=0.0)),
            fallbacks=int(np.nansum(self.numbers("fallbacks")[laps])),
        )

    def failures(self) -> list[Failure]:
        """Runs that failed or ended early, by reason; numbers in reasons do not distinguish."""
        reasons = self.texts("reason")
        rows = np.flatnonzero(reasons != "")
        groups: dict[str, list[int]] = {}
        for row in rows.tolist():
            groups.setdefault(_NUMBERS.sub("#", reasons[row]), []).append(row)
        found = []
        for members in sorted(groups.values(), key=len, reverse=True):
            counts = Counter(self.controller[members])
            named = ", ".join(f"{count} × {one or 'all'}" for one, count in counts.most_common())
            found.append(
                Failure(reasons[members[0]], named, len(members), self.setting(members[0]))
            )
        return found

    def worst(self) -> list[dict[str, str]]:
        """The laps that left the track farthest, with their settings."""
        depth = np.where(self.driven, np.nan_to_num(self.numbers("off_track_max_m")), 0.0)
        order = np.argsort(-depth, kind="stable")[:_WORST]
        return [
            {
                "controller": self.controller[row],
                "lap": f"{self.lap[row]:.0f}",
                "time s": _seconds(float(self.lap_time_s[row])),
                "deepest m": f"{depth[row]:.3f}",
                "settings": self.setting(row),
            }
            for row in order.tolist()
            if depth[row] > 0
        ]

    def setting(self, row: int) -> str:
        """The varied settings of a row."""
        values = [f"{name} {_label(self._table[name][row].as_py())}" for name in self.varied()]
        return " · ".join(values)

    def facts(self) -> list[tuple[str, str]]:
        """About the whole campaign."""
        first = self.driven & (self.lap == 1)
        simulated_s = float(np.nansum(self.numbers("simulated_s")[first]))
        drive_s = float(np.nansum(self.numbers("drive_s")[first]))
        _, rows = np.unique(self.key, return_index=True)
        case_s = float(np.nansum(self.numbers("case_s")[rows]))
        facts = [
            ("cases", str(len(rows))),
            ("laps", str(int(np.isfinite(self.lap_time_s).sum()))),
            ("failed runs", str(int((~self.driven).sum()))),
            ("simulated", f"{simulated_s / 3600:.2f} h"),
            ("computers", str(len(np.unique(self.texts("host"))))),
        ]
        if drive_s and case_s:
            facts.append(("drives, a core", f"{simulated_s / drive_s:.0f} × real time"))
            facts.append(("all in all, a core", f"{simulated_s / case_s:.1f} × real time"))
        return [*facts, ("software", self.texts("software")[0])]


def _label(value: Any) -> str:
    if isinstance(value, float):
        return "–" if np.isnan(value) else f"{value:g}"
    text = str(value)
    return Path(text).stem if text.endswith(".csv") else text


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _seconds(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "–"


def read_laps(folder: Path) -> tuple[Laps, int]:
    """The rows of a campaign's folder, and how many rows of other software were left out.

    InputError if there are none.
    """
    table = read_results(folder)
    if not len(table):
        raise InputError(f"{folder} holds no results; 'bayesrace campaign PLAN.toml' makes some")
    newest = table.filter(pc.equal(table["software"], table["software"][-1]))
    return Laps(newest), len(table) - len(newest)
