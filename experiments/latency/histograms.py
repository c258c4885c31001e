"""Histograms of the legs: bounded memory, a log that HdrHistogram's tools read, medians over time.

A leg's values go into the histogram of the current interval. At the interval's end that is written
to the leg's log, added to the total, and its median noted for the plot.
"""

from pathlib import Path
from typing import Any, Final

from hdrh.histogram import HdrHistogram
from hdrh.log import HistogramLogWriter

from experiments.latency.results import Distribution

__all__ = ["LegHistogram", "curve", "distribution", "new_histogram"]

_LARGEST_NS: Final = 60_000_000_000
_DIGITS: Final = 3
PERCENTILES: Final = (50.0, 90.0, 99.0, 99.9)


def new_histogram() -> Any:
    """1 ns to 60 s to three digits; some 200 kB."""
    return HdrHistogram(1, _LARGEST_NS, _DIGITS)


class LegHistogram:
    """One leg's values [ns]."""

    def __init__(self, path: Path, title: str, epoch_s: float) -> None:
        """``epoch_s``: calendar time at the beginning, for the log at ``path``."""
        self.total = new_histogram()
        self.below_zero = 0
        """Values below 0: counted as 0; the clocks they cross differ by less than is known."""
        self.lowest_ns: int | None = None
        self.medians: list[tuple[float, float]] = []
        """End of the interval since the beginning [s], and its median [us]."""
        self._interval = new_histogram()
        self._begin_s = 0.0
        self._file = path.open("w", encoding="ascii")
        self._log = HistogramLogWriter(self._file)
        self._log.output_comment(f"[bayesrace latency: {title.replace('→', 'to')}; values in ns]")
        self._log.output_log_format_version()
        # The library's own output_start_time raises.
        self._log.output_comment(f"[StartTime: {epoch_s:.3f} (seconds since epoch)]")
        self._log.output_legend()

    def record(self, value_ns: int) -> None:
        """Takes one value; one above 60 s counts as 60 s."""
        if self.lowest_ns is None or value_ns < self.lowest_ns:
            self.lowest_ns = value_ns
        if value_ns < 0:
            self.below_zero += 1
            value_ns = 0
        self._interval.record_value(min(value_ns, _LARGEST_NS))

    def roll(self, end_s: float) -> None:
        """Ends the interval, if anything is in it."""
        interval = self._interval
        if interval.get_total_count():
            self._log.output_interval_histogram(interval, max(self._begin_s, 1e-6), end_s, 1e3)
            self.total.add(interval)
            self.medians.append((end_s, interval.get_value_at_percentile(50.0) * 1e-3))
            # Emptied, not replaced: only the cyclic collector frees one, as it refers to itself.
            interval.reset()
        self._begin_s = end_s

    def close(self) -> None:
        """No more values."""
        self._file.close()


def distribution(histogram: Any) -> Distribution | None:
    """Percentiles in us; None without a value."""
    if not histogram.get_total_count():
        return None
    at = histogram.get_percentile_to_value_dict(PERCENTILES)
    largest = histogram.get_max_value()
    # A bucket's upper end may lie above the largest value in it.
    p50, p90, p99, p999 = (min(at[p], largest) * 1e-3 for p in PERCENTILES)
    return Distribution(
        p50=p50, p90=p90, p99=p99, p999=p999, max=largest * 1e-3,
        count=histogram.get_total_count(),
    )  # fmt: skip


def curve(histogram: Any) -> tuple[list[float], list[float]]:
    """The percentile plot: 1 / (1 - share of smaller values), and the value [us]."""
    total = histogram.get_total_count()
    x, y = [], []
    for step in histogram.get_recorded_iterator():
        # one step object for all: it must not be kept
        smaller = step.total_count_to_this_value - step.count_at_value_iterated_to
        x.append(total / (total - smaller))
        y.append(step.value_iterated_to * 1e-3)
    return x, y
