"""Bayesian optimisation of the racing line under the published objective.

    python -m benchmarks.line_search TRACKS [--trials 3] [--evaluations 110]

TRACKS: folder with ethz.csv and ethzmobil.csv, the paper's tracks. The objective is that of Jain
and Morari (2020) as tests/published_line.py states it. Prints the best lap after so many
evaluations, mean and best of the trials. PUBLISHED in that module has the published laps.
"""

from pathlib import Path

import numpy as np

from bayesrace.learning.search import search
from bayesrace.learning.settings import SearchSettings
from bayesrace.raceline.nodes import roughness
from benchmarks.harness import Row, arguments, report
from tests.published_line import PUBLISHED, objective

_COUNTS = (20, 30, 40, 50, 110)


def main() -> None:
    """Searches each track in each way."""
    given, rows = arguments(__doc__, "tracks", trials=3, evaluations=110), list[Row]()
    for name, published in PUBLISHED.items():
        function, count = objective(Path(given.tracks), name), len(published.nodes)
        for way, initial in (("random", given.evaluations), ("expected improvement", 10)):
            trials = []
            for seed in range(given.trials):
                how = {"evaluations": given.evaluations, "initial": initial, "seed": seed}
                settings = SearchSettings.model_validate(how)
                trials.append(search(function, count, settings, roughness(count)).best)
            for k in (k for k in _COUNTS if k <= given.evaluations):
                after = {"evaluations": k, "mean [s]": float(np.mean(trials, axis=0)[k - 1])}
                best = {"best [s]": float(np.min(trials, axis=0)[k - 1])}
                rows.append({"track": name, "way": way, **after, **best})
    report(given, f"{given.trials} trials", rows)


if __name__ == "__main__":
    main()
