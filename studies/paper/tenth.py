"""The F1TENTH car with and without correction (paper, appendix B)."""

from typing import Final

from bayesrace.vehicles.parts import GRAVITY_MPS2
from studies.paper.experiment import Experiment
from studies.paper.finding import Finding, Section, at_most
from studies.paper.loop import YAW, lap_figures, lap_text

__all__ = ["tenth_section"]

_PUBLISHED_S: Final = 4.949
_PLAIN_S: Final = 8.351
"""Without correction, at this share of the line's speed."""
_SLOWED: Final = 0.6
_MAP2_M: Final = 27.44


def tenth_section(one: Experiment) -> Section:
    """Laps with correction, without, and without at the published share of the speed."""
    corrected = one.drive("bayesrace", one.weights, constraints=False)
    plain = one.drive("worstcase", constraints=False)
    slowed = one.drive("worstcase", constraints=False, speed=_SLOWED)
    own, slow_s = corrected.result(), slowed.result().lap_time_s
    same = abs(one.track.length_m - _MAP2_M) < 0.1
    without = "without correction, at"
    what, ours, fails = f"{without} the line's speed", lap_text(plain), "it finishes no lap"
    findings = [
        at_most("lap with correction", _PUBLISHED_S, own.lap_time_s, "s", "", same),
        Finding(what, "fails", ours, fails, not plain.finished),
        at_most(f"{without} {_SLOWED:g} of it", _PLAIN_S, slow_s, "s", YAW, same),
    ]
    text = (
        f"Lap from standstill on {one.track.name}, trained on {one.train_track.name}, track "
        f"constraints off as in the published code. WorstCase is shown at {_SLOWED:g} of the "
        "racing line's speed, as published. "
        f"Tyres that never saturate gave up to {(own.lateral_max_mps2 or 0) / GRAVITY_MPS2:.2f} g "
        "to the corrected lap. Unlike the published plant, the car has limited actuators here."
    )
    figures = lap_figures("tenth", [corrected, slowed], one)
    return Section("The F1TENTH car", "appendix B", text, figures, findings)
