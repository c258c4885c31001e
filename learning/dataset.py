"""One-step samples of a driven car, the filter that leaves out unusable ones, and the residual:
what the discretised nominal model misses in them, which the GP learns."""

import hashlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.expression import evaluate_mean
from bayesrace.gp.weights import OUTPUTS, GpWeights
from bayesrace.integrators import Discretisation
from bayesrace.vehicles.models import STATES, e_kinematic
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["NOMINAL", "ROUNDING", "Dataset", "concatenate", "dataset_from_arrays"]
__all__ += ["discretisation_of", "filter_dataset", "identity", "left_out", "recalled", "residual"]

ROUNDING: Final = 1e-6
"""Permitted error of times, inputs and angles [SI units]; a plant in single precision errs by
2.4e-7 at 5 rad/s."""

_MIRRORED_STATE: Final = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0, -1.0])
_MIRRORED_INPUT: Final = np.array([1.0, -1.0])
"""Signs of x, y, psi, vx, vy, omega, delta, and of d, delta_rate, in a mirror along the x axis."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Samples (x_k, u_k, x_{k+1}), each one sampling period apart; rows need not be consecutive.

    ``x``, ``x_next`` (n, 7) = [x, y, psi, vx, vy, omega, delta] and ``u`` (n, 2) =
    [d, delta_rate], SI units; ``u`` is the input that acted during the period, ``delta`` the angle
    at its start. ``dropped`` counts samples left out so far, by reason. Raises InputError for
    shapes that do not fit or numbers that are not finite.
    """

    car: CarParameters
    step_s: float
    x: Floats
    u: Floats
    x_next: Floats
    dropped: Mapping[str, int] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        count = len(self.x) if np.ndim(self.x) else 0
        for name, width in (("x", 7), ("u", 2), ("x_next", 7)):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != (count, width):
                expected = f"(n, {width}) with n = {count}"
                raise InputError(f"dataset: {name} has shape {array.shape}, expected {expected}")
            if not np.isfinite(array).all():
                row = int(np.argmin(np.isfinite(array).all(axis=1)))
                raise InputError(f"dataset: {name} row {row} is not finite; leave it out")
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.x)

    @property
    def features(self) -> Floats:
        """z = [vx, vy, omega, delta, d, delta_rate], shape (n, 6)."""
        return np.column_stack((self.x[:, 3:7], self.u))

    def select(self, rows: slice | ArrayLike, reason: str = "") -> "Dataset":
        """The given rows (slice, mask or indices); others are counted under ``reason``, if any."""
        index = rows if isinstance(rows, slice) else np.asarray(rows)
        kept = replace(self, x=self.x[index], u=self.u[index], x_next=self.x_next[index])
        lost = len(self) - len(kept) if reason else 0
        return replace(kept, dropped=Counter(self.dropped) + Counter({reason: lost}))

    def with_mirror_images(self) -> "Dataset":
        """Each sample followed by its mirror image, in which the car turns the other way."""

        def both(values: Floats, signs: Floats) -> Floats:
            return np.stack((values, values * signs), axis=1).reshape(-1, values.shape[1])

        return replace(
            self,
            x=both(self.x, _MIRRORED_STATE),
            u=both(self.u, _MIRRORED_INPUT),
            x_next=both(self.x_next, _MIRRORED_STATE),
        )

    def digest(self) -> str:
        """sha256 over car, step and samples."""
        text = f"{self.car.name}/{self.car.digest()}/{self.step_s!r}/{len(self)}"
        total = hashlib.sha256(text.encode())
        for array in (self.x, self.u, self.x_next):
            total.update(array.astype("<f8", order="C").tobytes())
        return total.hexdigest()


def left_out(dropped: Mapping[str, int]) -> str:
    """Counts by reason as a text."""
    return ", ".join(f"{count} {reason}" for reason, count in dropped.items()) or "none"


def dataset_from_arrays(
    car: CarParameters, step_s: float, states: ArrayLike, inputs: ArrayLike
) -> Dataset:
    """Samples of one unbroken drive: ``states`` (n + 1, 7), ``inputs`` (n, 2)."""
    x, u = np.asarray(states, dtype=np.float64), np.asarray(inputs, dtype=np.float64)
    if x.ndim != 2 or u.ndim != 2 or len(x) != len(u) + 1:
        raise InputError(
            f"dataset: states of shape {x.shape} and inputs of shape {u.shape}, expected "
            "(n + 1, 7) and (n, 2)"
        )
    return Dataset(car, step_s, x[:-1], u, x[1:])


def concatenate(datasets: Sequence[Dataset]) -> Dataset:
    """All samples, in the order given; InputError if car or step differ."""
    if not datasets:
        raise InputError("no dataset given; name at least one log")
    first = datasets[0]
    for other in datasets[1:]:
        if other.car != first.car or other.step_s != first.step_s:
            raise InputError(
                f"datasets of different cars or steps cannot be mixed: {first.car.name} at "
                f"{first.step_s:g} s and {other.car.name} at {other.step_s:g} s"
            )
    return replace(
        first,
        x=np.concatenate([dataset.x for dataset in datasets]),
        u=np.concatenate([dataset.u for dataset in datasets]),
        x_next=np.concatenate([dataset.x_next for dataset in datasets]),
        dropped=sum((Counter(dataset.dropped) for dataset in datasets), Counter[str]()),
    )


def filter_dataset(dataset: Dataset, *, limits: bool = True) -> Dataset:
    """Leaves out standstill, samples outside the car's limits, those of a spin, and steering that
    does not add up.

    Slower than ``moving_mps`` of its tuning the car stands; all else is up to :data:`ROUNDING`. The
    last means delta_{k+1} != delta_k + step * delta_rate. Without ``limits``, samples outside the
    car's limits and those of a spin stay.
    """
    car = dataset.car
    kept = dataset.select(dataset.x[:, 3] >= car.tuning.gate.moving_mps, "standstill")
    d, rate = kept.u.T
    angle = np.maximum(np.abs(kept.x[:, 6]), np.abs(kept.x_next[:, 6]))
    within = (
        (d >= car.d_min - ROUNDING)
        & (d <= car.d_max + ROUNDING)
        & (np.abs(rate) <= car.delta_rate_max_radps + ROUNDING)
        & (angle <= car.delta_max_rad + ROUNDING)
    )
    if limits:
        kept = kept.select(within, "outside limits")
        # No controller plans to spin, and samples far from all others would take their place.
        vx, vy = kept.x[:, 3:5].T
        kept = kept.select(np.abs(np.arctan2(vy, vx)) <= car.tuning.gate.spin_rad, "spinning")
    drift = kept.x_next[:, 6] - kept.x[:, 6] - kept.step_s * kept.u[:, 1]
    return kept.select(np.abs(drift) <= ROUNDING, "steering does not match its rate")


# The residual ------------------------------------------------------------------------------------

NOMINAL = e_kinematic
"""The model that is corrected."""

_ROWS: Final = [STATES.index(name) for name in OUTPUTS]
_IDENTITY: Final = re.compile(
    r"[^/]+/(?P<scheme>\w+)x(?P<substeps>\d{1,4})-(?P<pose>\w+)/(?P<step_s>[\d.e-]{1,16})s/[^/]+"
)


def identity(dataset: Dataset, discretisation: Discretisation) -> str:
    """Identity of the discretised nominal model of the dataset's car."""
    return discretisation.identity(NOMINAL(dataset.car).name, dataset.car)


def discretisation_of(name: str, car: CarParameters) -> Discretisation:
    """The discretisation that an identity names, such as a manifest's or that of weights.

    InputError if it is not one of the nominal model of ``car``: other parameters, another model.
    """
    found = _IDENTITY.fullmatch(name)
    try:
        discretisation = Discretisation.model_validate_strings(found.groupdict() if found else name)
    except ValidationError:
        raise InputError(f"'{name}' names no discretised model; train again") from None
    if discretisation.identity(NOMINAL(car).name, car) != name:
        raise InputError(
            f"'{name}' is not the {NOMINAL(car).name} model of the car '{car.name}' as this "
            "program knows it; train again, or name its car"
        )
    return discretisation


def residual(dataset: Dataset, discretisation: Discretisation) -> Floats:
    """x_{k+1} - F(x_k, u_k) for vx [m/s], vy [m/s], omega [rad/s]; shape (n, 3).

    F is the nominal model under ``discretisation``, the same object that predicts in the
    controller. InputError if its step is not the dataset's.
    """
    if abs(discretisation.step_s - dataset.step_s) > 1e-9:
        raise InputError(
            f"the samples are {dataset.step_s:g} s apart, the discretisation steps "
            f"{discretisation.step_s:g} s; use the step that the log was recorded with"
        )
    if len(dataset) == 0:
        return np.zeros((0, len(OUTPUTS)))
    step = discretisation.discretise(NOMINAL(dataset.car))
    predicted = np.asarray(step(dataset.x.T, dataset.u.T), dtype=np.float64).T
    return dataset.x_next[:, _ROWS] - predicted[:, _ROWS]


def recalled(weights: GpWeights, car: CarParameters) -> Dataset:
    """What weights know at their own training inputs, as samples of ``car``, which is theirs.

    For where the drives that they were learned from are not at hand. Each sample is a step of the
    nominal model from the origin, plus the mean: learned from again they give nearly the same
    means. InputError if the model is not known here.
    """
    discretisation = discretisation_of(weights.discretisation, car)
    every = np.vstack([output.inputs for output in weights.outputs])
    _, first = np.unique(every, axis=0, return_index=True)
    z = every[np.sort(first)]
    x, u = np.hstack((np.zeros((len(z), 3)), z[:, :4])), z[:, 4:]
    x_next = np.zeros_like(x)
    if len(z):
        step = discretisation.discretise(NOMINAL(car))
        x_next[:] = np.asarray(step(x.T, u.T), dtype=np.float64).T
        x_next[:, 3:6] += evaluate_mean(weights, z)
    return Dataset(car, discretisation.step_s, x, u, x_next)
