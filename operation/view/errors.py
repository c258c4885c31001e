"""What the model that drives errs by in one step, and how much its Gaussian process expects.

Of the velocities that are corrected the yaw rate is shown: without a correction it errs the most.
The error is the residual that :mod:`bayesrace.learning.validation` judges by, less the mean of the
weights that answered the step's first state; the band is the 95 % interval, noise included.
"""

from collections.abc import Sequence
from contextlib import suppress
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from threadpoolctl import ThreadpoolController

from bayesrace.errors import InputError
from bayesrace.gp.weights import OUTPUTS, Weights, read_weights
from bayesrace.learning.dataset import ROUNDING, Dataset
from bayesrace.learning.target import NORMAL_95
from bayesrace.learning.validation import discretisation_of, posterior_of, residual
from bayesrace.vehicles import Car

__all__ = ["StepErrors"]

_OMEGA: Final = OUTPUTS.index("omega")
_Row = dict[str, Any]


class _Model:
    """The nominal model of weights, with their correction or without."""

    def __init__(self, weights: Weights, car: Car, corrected: bool) -> None:
        self._car, self._discretisation = car, discretisation_of(weights.discretisation, car)
        self._output = weights.outputs[_OMEGA]
        self._posterior = posterior_of(self._output) if corrected else None

    def leads(self, row: _Row, to: _Row) -> bool:
        """Whether a row is a step after another one, both true or both measured."""
        one: Any = row.get("sample")
        other: Any = to.get("sample")
        if one is None or type(one) is not type(other) or other.seq != one.seq + 1:
            return False
        return bool(abs(other.time_s - one.time_s - self._discretisation.step_s) <= ROUNDING)

    def judge(self, steps: Sequence[tuple[_Row, _Row]]) -> None:
        """Notes error and band in the rows that the steps end with."""
        x = np.array([row["sample"].x for row, _ in steps])
        u = np.array([row["sample"].u_applied for _, row in steps])
        x_next = np.array([row["sample"].x for _, row in steps])
        dataset = Dataset(self._car, self._discretisation.step_s, x, u, x_next)
        error, band = residual(dataset, self._discretisation)[:, _OMEGA], None
        if self._posterior is not None:
            mean, sigma = self._posterior.predict(dataset.features)
            error -= self._output.y_mean + self._output.y_scale * mean
            band = NORMAL_95 * self._output.y_scale * sigma
        for k, (_, row) in enumerate(steps):
            row["omega_error"] = float(error[k])
            row["omega_band"] = None if band is None else float(band[k])


class StepErrors:
    """Of the rows of a race, whose folder has the weights before they drive."""

    def __init__(self, folder: Path, car: Car) -> None:
        self._folder, self._car = folder, car
        self._models: dict[str | None, _Model | None] = {None: None}
        self._blas = ThreadpoolController()

    def note(self, rows: Sequence[_Row]) -> None:
        """Adds ``omega_error`` and, where there is a correction, ``omega_band`` [rad/s] to rows in
        their order, each of which may follow on one whose ``weights``, a version, are known."""
        # On a busy machine the threads of BLAS wait for each other longer than they work.
        with self._blas.limit(limits=1):
            for version, steps in groupby(pairwise(rows), lambda step: step[0].get("weights")):
                if version not in self._models:
                    self._models[version] = self._found(version)
                model = self._models[version]
                if model and (own := [step for step in steps if model.leads(*step)]):
                    model.judge(own)

    def _found(self, version: str) -> _Model | None:
        """The model with these weights, or ('') without any; None if it is not known here."""
        for path in sorted(self._folder.glob("weights-*.bin")):
            with suppress(InputError):
                weights = read_weights(path)
                if version in ("", weights.version):
                    return _Model(weights, self._car, corrected=bool(version))
        return None
