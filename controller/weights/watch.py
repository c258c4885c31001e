"""Compares weights that have been adopted with proven ones, state by state."""

from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.messages import Scalar
from controller.weights.checks import Checks, Comparison
from controller.weights.prediction import Sample

__all__ = ["Watch"]

_HOPELESS: Final = 0.8
"""Share of cycles without a solution from which on no car can drive."""


class Watch:
    """Ends with a reason to roll back, or when the weights have been driven for long enough."""

    def __init__(self, checks: Checks, before: Sequence[Sample]) -> None:
        """Of the weights in use; ``before``: samples from before their adoption."""
        self._checks, self._settings = checks, checks.settings
        self._models = (checks.in_use, checks.reference, checks.nominal)
        self._errors: deque[Floats] = deque(maxlen=self._settings.watch_window)
        self._needed = round(self._settings.watch_s / checks.step_s)
        self._driven = self._cycles = self._fallen_back = 0
        for sample in before[-self._settings.watch_window :]:
            self._append(sample)

    @property
    def over(self) -> bool:
        """Whether the weights are proven."""
        return self._driven >= self._needed

    @property
    def data(self) -> dict[str, Scalar]:
        """Counts since the adoption: samples, cycles, and those without a solution."""
        counts = (self._driven, self._cycles, self._fallen_back)
        return dict(zip(("driven", "cycles", "fallen_back"), counts, strict=True))

    def add(self, fallen_back: bool | None, sample: Sample | None) -> Comparison | None:
        """A cycle, with the sample that its state completes; the reason to roll back, if any."""
        settings = self._settings
        if fallen_back is not None:
            self._cycles += 1
            self._fallen_back += fallen_back
        hopeless = self._fallen_back > _HOPELESS * self._cycles
        if hopeless and self._cycles >= settings.watch_cycles:
            text = f"found no solution in {self._fallen_back} of {self._cycles} cycles"
            return Comparison("all", text, self.data)
        if sample is None:
            return None
        self._append(sample)
        self._driven += 1
        if len(self._errors) < settings.watch_least:
            return None
        new, reference, nominal = np.array(self._errors).transpose(1, 0, 2)
        found = self._checks.compare(new, [reference], nominal)
        text = f"predicted {found.worse} worse: {found.text}"
        return Comparison(found.worse, text, self.data | found.data) if found.worse else None

    def _append(self, sample: Sample) -> None:
        self._errors.append(np.array([model.errors([sample])[0] for model in self._models]))
