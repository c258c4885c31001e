"""Values of one leg over time: percentiles, intervals, and a log for HdrHistogram's tools."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from hdrh.histogram import HdrHistogram
from hdrh.log import HistogramLogWriter

from bayesrace.arrays import Floats
from bayesrace.files import replacing
from studies.latency.results import Distribution

__all__ = ["Series", "new_histogram"]


_LARGEST_NS: Final = 60_000_000_000
_PERCENTILES: Final = (50.0, 90.0, 99.0, 99.9, 100.0)


def new_histogram() -> Any:
    """A histogram of 1 ns to 60 s to three digits."""
    return HdrHistogram(1, _LARGEST_NS, 3)


@dataclass(frozen=True, eq=False)
class Series:
    """Durations and the times at which they were measured, at least one of them.

    A duration below zero counts as zero: it is shorter than its clocks are uncertain.
    """

    at_s: Floats
    """Since the beginning, rising."""
    ns: Floats

    def distribution(self) -> Distribution:
        """Percentiles."""
        values = np.percentile(self.ns, _PERCENTILES, method="inverted_cdf").clip(0) * 1e-3
        numbers = dict(zip(("p50", "p90", "p99", "p999", "max"), values.tolist(), strict=True))
        return Distribution(**numbers, count=len(self.ns))

    def intervals(self, edges_s: Floats) -> list[Floats]:
        """The values of each interval; the outer ones take what is beyond."""
        return np.split(self.ns, np.searchsorted(self.at_s, edges_s[1:-1]))

    def write_log(self, path: Path, title: str, epoch_s: float, edges_s: Floats) -> None:
        """An HdrHistogram log in ns, a line for each interval with values; calendar time at the
        beginning is ``epoch_s``."""
        with replacing(path) as partial, partial.open("w", encoding="ascii") as file:
            log = HistogramLogWriter(file)
            log.output_comment(f"[bayesrace latency: {title.replace('→', 'to')}; values in ns]")
            log.output_log_format_version()
            # The library's own output_start_time raises.
            log.output_comment(f"[StartTime: {epoch_s:.3f} (seconds since epoch)]")
            log.output_legend()
            for k, values in enumerate(self.intervals(edges_s)):
                histogram = new_histogram()
                for value in np.rint(values).clip(0, _LARGEST_NS).astype(np.int64).tolist():
                    histogram.record_value(value)
                if len(values):
                    begin_s = max(float(edges_s[k]), 1e-6)  # 0 means the histogram's own
                    log.output_interval_histogram(histogram, begin_s, float(edges_s[k + 1]), 1e3)
