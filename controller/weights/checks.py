"""What new weights must pass before the controller adopts them, and what is watched after that."""

import time
from collections import deque
from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import OUTPUTS, UNITS, GpWeights, decode_weights
from bayesrace.messages import Scalar
from bayesrace.vehicles.parameters import CarParameters
from controller.native_step import pack_weights
from controller.weights.prediction import OneStepModel, Sample, plausible_samples
from controller.weights.settings import GateSettings

__all__ = ["Checks", "Comparison", "Ruling", "Verdict", "Watch"]

_CLOCKS_APART_S: Final = 3600.0
"""By which the clock of the training host may be ahead."""
_ONE_SIDED: Final = 0.5
"""Share of the nominal errors that the mean error on a file's own samples may have."""
_HOPELESS: Final = 0.8
"""Share of cycles without a solution from which on no car can drive."""


class Comparison(NamedTuple):
    """One-step errors (RMSE) of new weights and others over the same samples."""

    worse: str
    """Outputs for which the new weights are worse, by :class:`GateSettings`; empty: none."""
    text: str
    data: dict[str, Scalar]
    """The number of ``samples``, and errors such as ``error_new_vx``."""


class Ruling(NamedTuple):
    """What the watch has found."""

    action: Literal["back", "slow", "proven"]
    """Back to the proven weights; slow down, as those predict other outputs worse; or stay: the
    watch is over."""
    text: str
    data: dict[str, Scalar]


class Verdict(NamedTuple):
    """Whether weights may be adopted."""

    text: str
    data: dict[str, Scalar]
    packed: bytes = b""
    """Arrays of accepted weights, by :func:`controller.native_step.pack_weights`; else empty."""


class Checks:
    """The tests for one controller, with the weights that it has in use."""

    def __init__(self, settings: GateSettings, artefact: Path, car: CarParameters) -> None:
        self.settings, self._artefact, self._car = settings, artefact, car
        self._model = lru_cache(maxsize=4)(self._make_model)
        self.nominal = self.in_use = self.reference = self._model(b"")
        self._in_use_made_ns = 0
        self.step_s = self.nominal.step_s
        self._slack = np.array(car.tuning.gate.resolution) * self.step_s
        self._plausible = plausible_samples(car, self.step_s, settings.plausible_states)

    def use(self, in_use: bytes, accepted_utc_ns: int, reference: bytes) -> None:
        """Weights files to compare with: in use, and proven; empty: without correction.

        ``accepted_utc_ns``: of those in use, by the calendar; they count as made no later. 0: not
        known, as of those that the controller was started with.
        """
        self.in_use, self.reference = self._model(in_use), self._model(reference)
        made_ns = 0 if self.in_use.weights is None else self.in_use.weights.created_utc_ns
        self._in_use_made_ns = min(made_ns, accepted_utc_ns or time.time_ns())

    def judge(self, data: bytes, samples: Sequence[Sample]) -> Verdict:
        """Whether a weights file may be adopted, by recent ``samples`` among others."""
        samples = samples[-self.settings.recent_samples :]
        probation = len(samples) < self.settings.least_samples
        facts: dict[str, Scalar] = {}
        try:
            model = self._model(data)
            if model.weights is None:
                raise InputError("GP weights: 0 bytes is not the size of a weights file")
            facts["version"] = model.weights.version
            self._check_origin(model.weights)
            self._check_bounds(model, samples)
            self._check_own_samples(model)
            facts |= {"samples": len(samples), "probation": probation}
            text = f"on probation: {len(samples)} recent samples are too few to compare"
            if not probation:
                others = [one.errors(samples) for one in {self.in_use, self.reference}]
                nominal = self.nominal.errors(samples)
                worse, text, errors = self.compare(model.errors(samples), others, nominal)
                facts |= errors
                if worse:
                    raise InputError(
                        f"weights '{facts['version']}' predict {worse} worse than those in use: "
                        f"{text}; train again, on this car's own laps"
                    )
        except InputError as error:
            return Verdict(str(error), facts)
        return Verdict(text, facts, pack_weights(model.weights))

    def _make_model(self, data: bytes) -> OneStepModel:
        weights = decode_weights(data) if data else None
        return OneStepModel(self._artefact, self._car, weights)

    def _check_origin(self, weights: GpWeights) -> None:
        ahead_s = (weights.created_utc_ns - time.time_ns()) * 1e-9
        older_s = (self._in_use_made_ns - weights.created_utc_ns) * 1e-9
        in_use, why_not = self.in_use.weights, ""
        if weights.car != self._car.name:
            why_not = f"those of the car '{weights.car}', this is '{self._car.name}'"
        elif ahead_s > _CLOCKS_APART_S:
            why_not = f"dated {ahead_s:.3g} s ahead: set the clocks, and train again"
        elif in_use is not None and weights.created_utc_ns and older_s > 0:
            why_not = (
                f"stale: made {older_s:.3g} s before those in use, '{in_use.version}'; train "
                "again, or return to earlier ones with 'bayesrace rollback'"
            )
        if why_not:
            raise InputError(f"weights '{weights.version}' are {why_not}")

    def _check_bounds(self, model: OneStepModel, samples: Sequence[Sample]) -> None:
        limit = np.array(self._car.tuning.gate.absurd)
        places = {"over the car's range": self._plausible, "in its recent states": samples}
        for where, states in places.items():
            nominal = self.nominal.velocities(states)
            known = np.isfinite(nominal).all(axis=1)
            excess = np.abs(model.velocities(states)[known] - nominal[known]) / self.step_s
            if not (excess <= limit).all():  # NaN: the corrected model leaves all bounds
                worst = ", ".join(f"{value:.3g}" for value in excess.max(axis=0))
                most = ", ".join(f"{value:g}" for value in limit)
                raise InputError(
                    f"weights are absurd {where}: they correct accelerations (m/s^2, m/s^2, "
                    f"rad/s^2) by up to {worst}, and {most} is the most; train again"
                )

    def check_start(self, data: bytes) -> None:
        """InputError unless a weights file may drive from the start, before the car has moved."""
        weights = self._model(data).weights
        if weights is not None and any(weights.counts) and not len(weights.sample_features):
            raise InputError(
                f"weights '{weights.version}' hold no samples that they can be checked by; train "
                "again, or start without them and use 'bayesrace publish'"
            )
        verdict = self.judge(data, ())
        if not verdict.packed:
            raise InputError(verdict.text)

    def _check_own_samples(self, model: OneStepModel) -> None:
        """The weights must predict the samples that they were learned from."""
        weights = model.weights
        if weights is None or not len(weights.sample_features):
            return
        samples = self._driven(weights.sample_features, weights.sample_residuals)
        errors, nominal = model.errors(samples), self.nominal.errors(samples)
        without = np.sqrt((nominal**2).mean(axis=0))
        # A posterior mean fits its own samples: neither do errors grow, nor are they one-sided.
        better = np.sqrt((errors**2).mean(axis=0)) <= without + self._slack
        better &= np.abs(errors.mean(axis=0)) <= _ONE_SIDED * without + self._slack
        worse = " and ".join(name for name, good in zip(OUTPUTS, better, strict=True) if not good)
        if worse:
            raise InputError(
                f"weights '{weights.version}' predict {worse} worse than no correction does, on "
                "the samples that they were learned from: they are damaged; train again"
            )

    def _driven(self, features: Floats, residuals: Floats) -> list[Sample]:
        """Samples of driving, from features (n, 6) and residuals (n, 3) of the nominal model."""
        x = np.hstack([np.zeros((len(features), 3)), features[:, :4]])
        u = features[:, 4:]
        still = [Sample(0, self.step_s, *pair, pair[0]) for pair in zip(x, u, strict=True)]
        after = x.copy()
        after[:, 3:6] = self.nominal.velocities(still) + residuals
        return [one._replace(x_next=end) for one, end in zip(still, after, strict=True)]

    def compare(self, new: Floats, others: Sequence[Floats], nominal: Floats) -> Comparison:
        """Errors (n, 3) over the same samples; for each output the best of the others counts.

        Samples for which the nominal model has no error are left out.
        """
        usable = np.isfinite(nominal).all(axis=1)
        count = int(usable.sum())
        new_rmse, nominal_rmse, *old = (
            np.sqrt((errors[usable] ** 2).sum(axis=0) / max(count, 1))
            for errors in (new, nominal, *others)
        )
        rmse = {"new": new_rmse, "old": np.min(old, axis=0), "nominal": nominal_rmse}
        # The excess of a window is what counts: fewer samples must be worse by as much in all.
        few = max(self.settings.watch_window / max(count, 1), 1.0)
        slack = self.settings.worse_share * rmse["nominal"] + few * self._slack
        # Written so that infinity on both sides is worse, too.
        fine = rmse["new"] <= self.settings.worse_factor * np.minimum(rmse["old"], 1e12) + slack
        worse = " and ".join(name for name, good in zip(OUTPUTS, fine, strict=True) if not good)
        data: dict[str, Scalar] = {"samples": count}
        for (what, errors), (j, name) in product(rmse.items(), enumerate(OUTPUTS)):
            data[f"error_{what}_{name}"] = float(min(errors[j], 1e12))
        changes = ", ".join(
            f"{name} {rmse['old'][j]:.4g} to {rmse['new'][j]:.4g} {UNITS[name]}"
            for j, name in enumerate(OUTPUTS)
        )
        text = f"one-step errors over {count} samples go from {changes}"
        return Comparison(worse, text, data)


class Watch:
    """Compares adopted weights with proven ones, state by state, until they are worse or proven."""

    def __init__(self, checks: Checks, before: Sequence[Sample], slowed: bool = False) -> None:
        """Of the weights in use; ``before``: samples from before their adoption. ``slowed``: the
        car has been slowed down because of them."""
        self._checks, self._settings = checks, checks.settings
        self._models = (checks.in_use, checks.reference, checks.nominal)
        self._errors: deque[Floats] = deque(maxlen=self._settings.watch_window)
        self._slowed, self._fastest_mps = slowed, 0.0
        self._needed = round(self._settings.watch_s / checks.step_s)
        self._driven = self._cycles = self._fallen_back = 0
        for sample in before[-self._settings.watch_window :]:
            self._append(sample)

    @property
    def over(self) -> bool:
        """Whether the weights are proven; never, if the car has been slowed down because of
        them."""
        return self._driven >= self._needed and not self._slowed

    @property
    def data(self) -> dict[str, Scalar]:
        """Counts since the adoption: samples, cycles, and those without a solution."""
        counts = (self._driven, self._cycles, self._fallen_back)
        return dict(zip(("driven", "cycles", "fallen_back"), counts, strict=True))

    def add(self, fallen_back: bool | None, sample: Sample | None) -> Ruling | None:
        """A cycle, with the sample that its state completes; what is to be done, if anything.

        The car goes back only to weights that predict no output worse over the same samples. After
        a demand to slow down the watch goes on, with samples from then on, until other weights are
        in use.
        """
        settings = self._settings
        if fallen_back is not None:
            self._cycles += 1
            self._fallen_back += fallen_back
        hopeless = self._fallen_back > _HOPELESS * self._cycles
        if hopeless and self._cycles >= settings.watch_cycles:
            text = f"found no solution in {self._fallen_back} of {self._cycles} cycles"
            return Ruling("back", text, self.data)
        if sample is None:
            return None
        self._append(sample)
        self._driven += 1
        if len(self._errors) < settings.watch_least:
            return None
        new, reference, nominal = np.array(self._errors).transpose(1, 0, 2)
        found = self._checks.compare(new, [reference], nominal)
        if not found.worse:
            return None
        data = self.data | found.data
        if not (others := self._checks.compare(reference, [new], nominal).worse):
            return Ruling("back", f"predicted {found.worse} worse: {found.text}", data)
        if self._slowed:
            return None
        self._slowed = True
        self._errors.clear()
        data["fastest_mps"] = self._fastest_mps
        text = f"predicted {found.worse} worse, and the proven ones {others}: {found.text}"
        return Ruling("slow", text, data)

    def _append(self, sample: Sample) -> None:
        self._fastest_mps = max(self._fastest_mps, float(sample.x[3]))
        self._errors.append(np.array([model.errors([sample])[0] for model in self._models]))
