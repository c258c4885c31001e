"""Published numbers for comparison, and when ours may be compared with them.

A. Jain, M. O'Kelly, P. Chaudhari, M. Morari, "BayesRace: Learning to race autonomously using prior
experience", CoRL 2020: its published code run again on the paper's ETHZ track (standing start at
.1 m/s, 50 Hz, horizon 20), and its data evaluated again.
"""

from typing import Final, NamedTuple

from bayesrace.operation.analysis.results import RaceResult

__all__ = ["GP", "LAPS_OFF", "LAPS_ON", "LIMIT", "SOURCE", "Lap", "compare_gp", "compare_laps"]

SOURCE: Final = (
    "A. Jain, M. O'Kelly, P. Chaudhari, M. Morari: BayesRace: Learning to race autonomously using "
    "prior experience. Conference on Robot Learning, 2020"
)

LIMIT: Final = (
    "What the car can do on ETHZ (minimum-time optimal control with the true model, centre of "
    "gravity on the track, as 'bayesrace limit' finds it): 7.08 s from standstill, 6.90 s flying."
)

_TRACK: Final = "ethz"


class Lap(NamedTuple):
    """From standstill on ETHZ; None where no lap was finished."""

    time_s: float | None
    off_samples: int | None
    off_max_m: float | None


LAPS_ON: Final = {  # track constraints on
    "worstcase": Lap(None, None, None),
    "bayesrace": Lap(7.988, 9, 0.015),
    "bayesrace-updated": Lap(7.932, 11, 0.015),
    "bestcase": Lap(7.797, 12, 0.010),
}
LAPS_OFF: Final = {  # … and off
    "worstcase": Lap(8.694, 24, 0.110),
    "bayesrace": Lap(7.792, 17, 0.024),
    "bayesrace-updated": Lap(7.692, 17, 0.028),
    "bestcase": Lap(7.681, 14, 0.028),
}
_SOLVE_MS: Final = {
    "worstcase": (8.4, 19.0, 21.0),
    "bayesrace": (148.0, 229.0, 251.0),
    "bayesrace-updated": (280.0, 401.0, 493.0),
    "bestcase": (7.9, 13.6, 17.0),
}
GP: Final = {  # RMSE without the GP, RMSE and R² before, RMSE and R² after the update
    "vx": (0.0570, 0.00555, 0.932, 0.00065, 0.999),
    "vy": (0.0519, 0.0219, 0.820, 0.00039, 0.9999),
    "omega": (0.384, 0.176, 0.790, 0.142, 0.864),
}


def compare_laps(result: RaceResult) -> list[dict[str, str]]:
    """A row for each controller that drove, the paper's numbers as ``paper_*`` and these as
    ``our_*``, ready to print; none on any other track than the paper's."""
    published = LAPS_ON if result.settings.constraints else LAPS_OFF
    rows = []
    for lap in result.laps if result.settings.track.lower() == _TRACK else ():
        if (paper := published.get(lap.controller)) is None:
            continue
        solve, ours = _SOLVE_MS[lap.controller], lap.solve_us
        row = {
            "controller": lap.controller,
            "paper_lap": _time(paper.time_s),
            "our_lap": _time(lap.lap_time_s),
            "paper_off": _off(paper.off_samples, paper.off_max_m),
            "our_off": _off(lap.off_track_samples, lap.off_track_max_m),
            "paper_solve": " / ".join(f"{one:g}" for one in solve),
            "our_solve": "–",
            "faster": "–",
        }
        if ours is not None:
            own = (ours.p50, ours.p99, ours.max)
            row["our_solve"] = " / ".join(f"{one / 1e3:.2f}" for one in own)
        if ours is not None and ours.p50 > 0:
            row["faster"] = f"{solve[0] * 1e3 / ours.p50:.0f} ×"
        rows.append(row)
    return rows


def compare_gp(result: RaceResult) -> list[dict[str, str]]:
    """A row for each output, as for laps; none on any other track, or without GPs."""
    rows = []
    for output, (plain, before, r2_before, after, r2_after) in GP.items():
        ours, updated = result.gp.get(output), result.gp_updated.get(output)
        if ours is None or result.settings.track.lower() != _TRACK:
            continue
        row = {
            "output": output,
            "paper": f"{before:g} ({plain:g}) · {r2_before:g}",
            "ours": f"{ours.rmse:.3g} ({ours.uncorrected_rmse:.3g}) · {ours.r2:.4f}",
            "paper_updated": f"{after:g} · {r2_after:g}",
            "ours_updated": "–" if updated is None else f"{updated.rmse:.3g} · {updated.r2:.4f}",
        }
        rows.append(row)
    return rows


def _time(value: float | None) -> str:
    return "DNF" if value is None else f"{value:.3f}"


def _off(samples: int | None, depth_m: float | None) -> str:
    if samples is None or depth_m is None:
        return "–"
    return f"{samples} / {depth_m:.3f}" if samples else "0"
