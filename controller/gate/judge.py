"""The checks: before weights are taken over, and while they are watched. No input or output."""

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from bayesrace.errors import InputError
from bayesrace.gp.weights import OUTPUTS, UNITS, GpWeights
from bayesrace.messages import Scalar
from bayesrace.vehicles.parameters import CarParameters
from controller.gate.model import OneStepModel, plausible_samples
from controller.gate.samples import Sample
from controller.gate.settings import GateSettings

__all__ = ["Comparison", "Gate", "Incumbent", "Verdict", "Watch"]

_Floats = npt.NDArray[np.float64]

_HOPELESS: Final = 0.8
"""Share of cycles without a solution with which nobody can drive."""

_CLOCKS_APART_S: Final = 3600.0
"""By which the clock of who trains may be ahead."""


@dataclass(frozen=True)
class Comparison:
    """One-step errors (RMSE) per output over the same samples."""

    samples: int
    new: _Floats
    old: _Floats
    nominal: _Floats
    worse: tuple[str, ...]
    """Outputs for which the new weights are worse, by :class:`GateSettings`."""

    @property
    def text(self) -> str:
        """For people."""
        pairs = zip(OUTPUTS, self.old, self.new, strict=True)
        errors = ", ".join(
            f"{name} {old:.4g} to {new:.4g} {UNITS[name]}" for name, old, new in pairs
        )
        return f"one-step errors over {self.samples} samples go from {errors}"

    @property
    def data(self) -> dict[str, Scalar]:
        """For programs."""
        data: dict[str, Scalar] = {"samples": self.samples}
        for what, errors in (("new", self.new), ("old", self.old), ("nominal", self.nominal)):
            for name, error in zip(OUTPUTS, errors, strict=True):
                data[f"error_{what}_{name}"] = float(min(error, 1e12))
        return data


def compare(
    settings: GateSettings, slack: _Floats, new: _Floats, old: _Floats, nominal: _Floats
) -> Comparison:
    """Errors (n, 3) of the three; samples that the nominal model cannot follow do not count.

    ``slack``: errors (3,) that do not count.
    """
    usable = np.isfinite(nominal).all(axis=1)
    new, old, nominal = (_rmse(errors[usable]) for errors in (new, old, nominal))
    slack = settings.worse_share * nominal + slack
    # Written so that infinity on both sides is worse, too.
    fine = new <= settings.worse_factor * np.minimum(old, 1e12) + slack
    worse = tuple(name for name, good in zip(OUTPUTS, fine, strict=True) if not good)
    return Comparison(int(usable.sum()), new, old, nominal, worse)


def _rmse(errors: _Floats) -> _Floats:
    if not len(errors):
        return np.zeros(3)
    result: _Floats = np.sqrt(np.mean(errors**2, axis=0))
    return result


@dataclass
class Incumbent:
    """Weights that the controller has, or had, in use."""

    number: int
    """Of acceptance; 0: what it was started with."""
    version: str
    weights: GpWeights | None
    """None: without correction."""
    proven: bool
    """Watched to the end, or from the start."""
    accepted_utc_ns: int
    """By this host's calendar."""
    _model: OneStepModel | None = field(default=None, repr=False)

    @property
    def made_utc_ns(self) -> int:
        """No later than they were accepted, whatever they say: else all others would be stale."""
        if self.weights is None:
            return 0
        return min(self.weights.created_utc_ns, self.accepted_utc_ns)

    def model(self, gate: "Gate") -> OneStepModel:
        """Predicts with them."""
        if self._model is None:
            self._model = gate.model(self.weights)
        return self._model


@dataclass(frozen=True)
class Verdict:
    """On weights that were sent."""

    accepted: bool
    text: str
    data: dict[str, Scalar]
    model: OneStepModel | None = None


class Gate:
    """Checks weights for one controller."""

    def __init__(self, settings: GateSettings, artefact: Path, car: CarParameters) -> None:
        self.settings, self._artefact, self._car = settings, artefact, car
        self.nominal = OneStepModel(artefact, car, None)
        self.step_s = self.nominal.step_s
        self.slack = np.array(car.tuning.gate.resolution) * self.step_s
        self._plausible = plausible_samples(car, self.step_s, settings.plausible_states)
        self._plausible_nominal = self.nominal.velocities(self._plausible)

    def model(self, weights: GpWeights | None) -> OneStepModel:
        """A model that predicts with these; InputError if it cannot."""
        return OneStepModel(self._artefact, self._car, weights)

    def check(
        self, weights: GpWeights, against: Sequence[Incumbent], samples: Sequence[Sample]
    ) -> Verdict:
        """``against``: those in use first. ``samples``: recent ones, of any age below the limit."""
        data: dict[str, Scalar] = {"version": weights.version}
        try:
            model = self._usable(weights)
            self._check_age(weights, against[0])
            self._check_bounds(model, samples)
        except InputError as error:
            return Verdict(False, str(error), data)
        samples = samples[-self.settings.recent_samples :]
        enough = len(samples) >= self.settings.least_samples
        data |= {"samples": len(samples), "probation": not enough}
        if not enough:
            text = (
                f"on probation: {len(samples)} recent samples, {self.settings.least_samples} "
                "needed to compare"
            )
            return Verdict(True, text, data, model)
        comparison = self._compare(model, against, samples)
        data |= comparison.data
        if comparison.worse:
            text = (
                f"weights '{weights.version}' predict {' and '.join(comparison.worse)} worse than "
                f"those in use: {comparison.text}; train again, on this car's own laps"
            )
            return Verdict(False, text, data)
        return Verdict(True, comparison.text, data, model)

    def _compare(
        self, model: OneStepModel, against: Sequence[Incumbent], samples: Sequence[Sample]
    ) -> Comparison:
        """With those in use, unless the new weights are worse than others that count."""
        new, nominal = model.errors(samples), self.nominal.errors(samples)
        results = [
            compare(self.settings, self.slack, new, one.model(self).errors(samples), nominal)
            for one in against
        ]
        return next((result for result in results if result.worse), results[0])

    def _usable(self, weights: GpWeights) -> OneStepModel:
        if weights.car != self._car.name:
            raise InputError(
                f"weights '{weights.version}' are those of the car '{weights.car}', this is "
                f"'{self._car.name}': send them to its controller"
            )
        return self.model(weights)

    def _check_age(self, weights: GpWeights, in_use: Incumbent) -> None:
        ahead_s = (weights.created_utc_ns - time.time_ns()) * 1e-9
        if ahead_s > _CLOCKS_APART_S:
            raise InputError(
                f"weights '{weights.version}' were made {ahead_s:.3g} s from now, and all others "
                "would be stale beside them; set the clocks, and train again"
            )
        if in_use.weights is None or not weights.created_utc_ns:
            return
        older_s = (in_use.made_utc_ns - weights.created_utc_ns) * 1e-9
        if older_s > 0:
            raise InputError(
                f"weights '{weights.version}' are stale: made {older_s:.3g} s before those in use, "
                f"'{in_use.version}'; train again, or go back with 'bayesrace rollback'"
            )

    def _check_bounds(self, model: OneStepModel, samples: Sequence[Sample]) -> None:
        recent = samples[-self.settings.recent_samples :]
        for where, states, nominal in (
            ("all over the car's range", self._plausible, self._plausible_nominal),
            ("in its recent states", recent, self.nominal.velocities(recent)),
        ):
            known = np.isfinite(nominal).all(axis=1)
            corrected = model.velocities(states)[known]
            excess = np.abs(corrected - nominal[known]) / self.step_s
            limit = np.array(self._car.tuning.gate.absurd)
            if not (excess <= limit).all():  # NaN: the corrected model leaves all bounds
                worst = excess.max(axis=0)
                raise InputError(
                    f"weights are absurd {where}: they correct accelerations by up to "
                    f"{worst[0]:.3g} m/s^2, {worst[1]:.3g} m/s^2, {worst[2]:.3g} rad/s^2, and "
                    f"{limit[0]:g}, {limit[1]:g}, {limit[2]:g} is the most; train again"
                )


class Watch:
    """Compares weights that have been taken over with those to go back to, sample by sample."""

    def __init__(
        self, gate: Gate, new: Incumbent, old: Incumbent, before: Sequence[Sample] = ()
    ) -> None:
        """``before``: samples of the time before the takeover."""
        self.new, self.old = new, old
        self._gate = gate
        self._models = (new.model(gate), old.model(gate), gate.nominal)
        self._errors: deque[_Floats] = deque(maxlen=gate.settings.watch_window)
        self._needed = round(gate.settings.watch_s / gate.step_s)
        self.seen = 0
        """Samples since."""
        self.cycles = self.fallen_back = 0
        """Since: those in which the car was driven, and those without a solution."""
        for sample in before[-gate.settings.watch_window :]:
            self._note(sample)

    @property
    def over(self) -> bool:
        """Whether the new weights have proved good."""
        return self.seen >= self._needed

    def count(self, fallen_back: bool | None) -> bool:
        """Takes note of a cycle; True if with these weights there are no solutions."""
        if fallen_back is not None:
            self.cycles += 1
            self.fallen_back += fallen_back
        enough = self.cycles >= self._gate.settings.watch_cycles
        return enough and self.fallen_back > _HOPELESS * self.cycles

    def add(self, sample: Sample) -> Comparison | None:
        """The comparison, if the new weights are to be given up."""
        gate = self._gate
        self._note(sample)
        self.seen += 1
        if len(self._errors) < gate.settings.watch_least:
            return None
        new, old, nominal = np.array(self._errors).transpose(1, 0, 2)
        comparison = compare(gate.settings, gate.slack, new, old, nominal)
        return comparison if comparison.worse else None

    def _note(self, sample: Sample) -> None:
        self._errors.append(np.array([model.errors([sample])[0] for model in self._models]))
