"""The samples that learning keeps from lap to lap: bounded, whatever is driven.

Old samples are kept where the GPs would know least without them; what has been driven last comes
in as well, for the car may have changed. And what weights know can be had back as samples, where
the drives that they were learned from are not at hand.
"""

from typing import Final

import numpy as np

from bayesrace.gp.expression import evaluate_mean
from bayesrace.gp.weights import OUTPUTS, GpWeights
from bayesrace.integrators import Discretisation
from bayesrace.vehicles import CarParameters
from learning.dataset import Dataset
from learning.residual import NOMINAL, discretisation_of
from learning.subset import evenly, most_informative

__all__ = ["MOST_NEW", "bounded", "recalled"]

MOST_NEW: Final = 20_000
"""Samples that may come at once; of more, evenly spread ones are looked at."""

_NEWEST: Final = 0.25
"""Share of the kept samples that are the last ones driven."""


def bounded(dataset: Dataset, wanted: int, weights: GpWeights | None = None) -> Dataset:
    """At most ``wanted`` of the samples, in their order: the newest, and the most informative.

    A quarter are the last ones; an equal part of the others is chosen for each output by its
    kernel in ``weights`` (:func:`~learning.subset.most_informative`), evenly without them. Memory:
    8 bytes times the samples (at most :data:`MOST_NEW` and ``wanted`` are looked at) times a
    quarter of ``wanted``.
    """
    if len(dataset) <= wanted:
        return dataset
    looked_at = dataset.select(evenly(len(dataset), max(MOST_NEW, wanted)))
    count = len(looked_at)
    chosen = np.zeros(count, dtype=bool)
    chosen[count - max(1, int(_NEWEST * wanted)) :] = True
    share = (wanted - int(chosen.sum())) // len(OUTPUTS)
    if weights is not None and all(weights.counts) and share:
        z = looked_at.features
        for output in weights.outputs:
            noise = output.noise_variance / output.signal_variance
            rest = np.flatnonzero(~chosen)
            if len(rest):
                rows = most_informative(output.kernel, z[rest], output.length_scales, noise, share)
                chosen[rest[rows]] = True
    rest = np.flatnonzero(~chosen)
    chosen[rest[evenly(len(rest), wanted - int(chosen.sum()))]] = True
    return looked_at.select(chosen)


def recalled(weights: GpWeights, car: CarParameters) -> Dataset:
    """What weights know at their own training inputs, as samples of ``car``, which is theirs.

    Each is a step of the nominal model from the origin, plus the mean: learned from again they
    give nearly the same means. InputError if the model is not known here.
    """
    discretisation: Discretisation = discretisation_of(weights.discretisation, car)
    every = np.vstack([output.inputs for output in weights.outputs])
    _, first = np.unique(every, axis=0, return_index=True)
    z = every[np.sort(first)]
    if len(z) == 0:
        nothing = np.zeros((0, 7))
        return Dataset(car, discretisation.step_s, nothing, np.zeros((0, 2)), nothing)
    x = np.hstack((np.zeros((len(z), 3)), z[:, :4]))
    u = z[:, 4:]
    step = discretisation.discretise(NOMINAL(car))
    x_next = np.asarray(step(x.T, u.T), dtype=np.float64).T
    x_next[:, 3:6] += evaluate_mean(weights, z)
    return Dataset(car, discretisation.step_s, x, u, x_next)
