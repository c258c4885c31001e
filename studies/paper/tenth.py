"""The F1TENTH car with and without correction (paper, appendix B)."""

from typing import Final

from bayesrace.vehicles.parts import GRAVITY_MPS2
from studies.paper.experiment import Experiment
from studies.paper.finding import Finding, Section, at_most
from studies.paper.loop import lap_figures, lap_text

__all__ = ["tenth_section"]

_PUBLISHED_S: Final = 4.949
_SLOWED: Final = 0.6, 0.3
"""Shares of the line's speed: the published one, and another if that gives no lap."""
_PAPER: Final = "over 2.5 s shorter (8.351 s without, at 0.6 of the line's speed)"
_FASTER_S: Final = 2.5
_MAP2_M: Final = 27.44


def tenth_section(one: Experiment) -> Section:
    """Laps with correction, without, and without at the largest share of the speed that laps."""
    corrected = one.drive("bayesrace", one.weights, constraints=False)
    plain = one.drive("worstcase", constraints=False)
    for speed in _SLOWED:
        slowed = one.drive("worstcase", constraints=False, speed=speed)
        if slowed.finished:
            break
    own, failed = corrected.result(), plain.result()
    same = abs(one.track.length_m - _MAP2_M) < 0.1
    fast, slow = own.lap_time_s, slowed.result().lap_time_s
    what = "without correction, at the full speed of the racing line"
    criterion = "it leaves the track, or finishes no lap"
    holds = failed.off_track_samples > 0 or not plain.finished
    gain = f"it is more than {_FASTER_S:g} s shorter, or the only one"
    ours = f"{lap_text(corrected)}; at {speed:g} of the speed: {lap_text(slowed)}"
    shorter = fast is not None and (slow is None or slow - fast > _FASTER_S)
    findings = [
        at_most("lap with correction", _PUBLISHED_S, fast, "s", "", same),
        Finding(what, "fails", lap_text(plain), criterion, holds),
        Finding("lap with correction and without", _PAPER, ours, gain, shorter),
    ]
    text = (
        f"Lap from standstill on {one.track.name}, trained on {one.train_track.name}, track "
        f"constraints off as in the published code. WorstCase is shown at {speed:g} of the racing "
        f"line's speed (published: {_SLOWED[0]:g}), so a part of the gain is that of the speed. "
        f"Tyres that never saturate gave up to {(own.lateral_max_mps2 or 0) / GRAVITY_MPS2:.2f} g "
        "to the corrected lap. Unlike the published plant, the car has limited actuators here."
    )
    figures = lap_figures("tenth", [corrected, slowed], one)
    return Section("The F1TENTH car", "appendix B", text, figures, findings)
