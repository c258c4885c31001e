"""Published numbers that ours are compared with.

A. Jain, M. O'Kelly, P. Chaudhari, M. Morari, "BayesRace: Learning to race autonomously using prior
experience", CoRL 2020: its published code run again on the paper's ETHZ track (standing start at
.1 m/s, 50 Hz, horizon 20), and its data evaluated again.
"""

from typing import Final, NamedTuple

__all__ = ["GP", "LAPS_OFF", "LAPS_ON", "SOURCE", "Lap"]

SOURCE: Final = (
    "A. Jain, M. O'Kelly, P. Chaudhari, M. Morari: BayesRace: Learning to race autonomously using "
    "prior experience. Conference on Robot Learning, 2020"
)


class Lap(NamedTuple):
    """From standstill on ETHZ; None where no lap was finished."""

    time_s: float | None
    off_samples: int | None


LAPS_ON: Final = {  # track constraints on
    "worstcase": Lap(None, None),
    "bayesrace": Lap(7.988, 9),
    "bayesrace-updated": Lap(7.932, 11),
    "bestcase": Lap(7.797, 12),
}
LAPS_OFF: Final = {  # … and off
    "worstcase": Lap(8.694, 24),
    "bayesrace": Lap(7.792, 17),
    "bayesrace-updated": Lap(7.692, 17),
    "bestcase": Lap(7.681, 14),
}
GP: Final = {  # RMSE without the GP, RMSE and R² before, RMSE and R² after the update
    "vx": (0.0570, 0.00555, 0.932, 0.00065, 0.999),
    "vy": (0.0519, 0.0219, 0.820, 0.00039, 0.9999),
    "omega": (0.384, 0.176, 0.790, 0.142, 0.864),
}
