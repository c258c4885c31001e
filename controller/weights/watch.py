"""The watch over adopted weights: better or worse than the proven ones, while the car drives."""

from typing import Any, Final, Literal, NamedTuple

from bayesrace.messages import Scalar
from bayesrace.vehicles.parameters import CarParameters
from controller.weights.comparison import compare, slack_of
from controller.weights.settings import WATCHED, GateSettings

__all__ = ["Ruling", "Watch"]

_HOPELESS: Final = 0.8
"""Share of cycles without a solution from which on no car can drive."""


class Ruling(NamedTuple):
    """What the watch has found."""

    action: Literal["back", "slow", "proven"]
    """Back to the proven weights; slow down, as those predict other outputs worse; or stay: the
    watch is over."""
    text: str
    data: dict[str, Scalar]


class Watch:
    """Looks between two cycles at what the compiled controller has found; see br_mpc_get_watch."""

    def __init__(self, settings: GateSettings, car: CarParameters, step_s: float) -> None:
        self._settings, self._slack = settings, slack_of(car, step_s)
        self._needed = settings.watch_s / step_s
        self._driven = self._judged = 0.0
        self._cycles = self._fallen_back = 0
        self._fastest_mps, self._slowed_after = 0.0, -1.0

    @property
    def data(self) -> dict[str, Scalar]:
        """Counts since the adoption: samples, cycles, and those without a solution."""
        return {
            "driven": round(self._driven), "cycles": self._cycles,
            "fallen_back": self._fallen_back, "fastest_mps": self._fastest_mps,
        }  # fmt: skip

    def observe(self, vx_mps: float, fallen_back: bool | None) -> None:
        """A state, and whether the fallback drove the cycle before; None: the car was not."""
        self._fastest_mps = max(self._fastest_mps, vx_mps)
        if fallen_back is not None:
            self._cycles += 1
            self._fallen_back += fallen_back

    def look(self, found: Any) -> Ruling | None:
        """What is to be done, if anything, by the compiled controller's report.

        The car goes back only to weights that predict no output worse over the same samples. After
        a demand to slow down the watch goes on, on samples from then on, until other weights are in
        use: the probation does not end.
        """
        settings = self._settings
        if self._cycles >= settings.watch_cycles and self._fallen_back > _HOPELESS * self._cycles:
            text = f"found no solution in {self._fallen_back} of {self._cycles} cycles"
            return Ruling("back", text, self.data)
        slowed = self._slowed_after >= 0
        judged = found.fresh + found.samples  # rises with each sample that is judged
        if judged == self._judged or found.samples < settings.watch_least:
            return None
        self._driven, self._judged = found.fresh, judged
        if slowed and self._driven - self._slowed_after < WATCHED:
            return None
        errors = list(found.in_use), list(found.proven), list(found.nominal)
        new, proven, nominal = errors
        one = compare(settings, self._slack, found.samples, new, proven, nominal)
        if not one.worse:
            done = self._driven >= self._needed and not slowed
            return Ruling("proven", "", {}) if done else None
        data = self.data | one.data
        others = compare(settings, self._slack, found.samples, proven, new, nominal).worse
        if not others:
            return Ruling("back", f"predicted {one.worse} worse: {one.text}", data)
        if slowed:
            return None
        self._slowed_after = self._driven
        text = f"predicted {one.worse} worse, and the proven ones {others}: {one.text}"
        return Ruling("slow", text, data)
