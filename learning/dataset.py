"""One-step samples of a driven car: what the residual is made of, and what is left out and why."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesrace.errors import InputError
from bayesrace.vehicles.parameters import CarParameters

__all__ = [
    "Dataset",
    "Tolerance",
    "concatenate",
    "dataset_from_arrays",
    "filter_dataset",
    "left_out",
    "tolerances",
]

Floats = NDArray[np.float64]

_STATES, _INPUTS = 7, 2


@dataclass(frozen=True, eq=False)
class Dataset:
    """Samples (x_k, u_k, x_{k+1}), each one sampling period apart; rows need not be consecutive.

    ``x``, ``x_next`` (n, 7) = [x, y, psi, vx, vy, omega, delta] and ``u`` (n, 2) =
    [d, delta_rate], SI units; ``u`` is what really acted during the period, ``delta`` the angle at
    its start. ``dropped`` counts samples left out so far, by reason. Raises InputError for shapes
    that do not fit or numbers that are not finite.
    """

    car: CarParameters
    step_s: float
    x: Floats
    u: Floats
    x_next: Floats
    dropped: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if np.ndim(self.x) != 2:
            raise InputError(f"dataset: x has shape {np.shape(self.x)}, expected (n, {_STATES})")
        count = len(self.x)
        shapes = {"x": (count, _STATES), "u": (count, _INPUTS), "x_next": (count, _STATES)}
        for name, shape in shapes.items():
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != shape:
                raise InputError(f"dataset: {name} has shape {array.shape}, expected {shape}")
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
        lost = len(self) - len(kept)
        if not reason or not lost:
            return kept
        return replace(kept, dropped=_add(self.dropped, {reason: lost}))

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


def _add(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, int]:
    return {reason: a.get(reason, 0) + b.get(reason, 0) for reason in {**a, **b}}


def dataset_from_arrays(
    car: CarParameters, step_s: float, states: ArrayLike, inputs: ArrayLike
) -> Dataset:
    """Samples of one unbroken drive: ``states`` (n + 1, 7), ``inputs`` (n, 2)."""
    x, u = np.asarray(states, dtype=np.float64), np.asarray(inputs, dtype=np.float64)
    if x.ndim != 2 or u.ndim != 2 or len(x) != len(u) + 1:
        raise InputError(
            f"dataset: states of shape {x.shape} and inputs of shape {u.shape}, expected (n + 1, "
            f"{_STATES}) and (n, {_INPUTS})"
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
    dropped: dict[str, int] = {}
    for dataset in datasets:
        dropped = _add(dropped, dataset.dropped)
    x, u, x_next = (
        np.concatenate([getattr(dataset, name) for dataset in datasets])
        for name in ("x", "u", "x_next")
    )
    return Dataset(first.car, first.step_s, x, u, x_next, dropped)


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far a measured signal may be from what it must be for its sample to be kept."""

    value: float
    unit: str
    why: str


_ROUNDING: Final = 1e-6
"""Beyond what a plant errs that computes or sends in single precision: 2.4e-7 at 5 rad/s."""


def tolerances(car: CarParameters) -> dict[str, Tolerance]:
    """The tolerance of each signal that samples are filtered by."""
    return {
        "time": Tolerance(
            _ROUNDING, "s", "two states are one step apart, up to rounding; else there is a gap"
        ),
        "vx": Tolerance(
            car.tuning.gate.moving_mps,
            "m/s",
            "least speed, by the car's tuning: slower, the car stands",
        ),
        "d": Tolerance(_ROUNDING, "-", "beyond a limit of the car by rounding only"),
        "delta_rate": Tolerance(_ROUNDING, "rad/s", "beyond its limit by rounding only"),
        "delta": Tolerance(
            _ROUNDING, "rad", "beyond its limit by rounding only, before and after the step"
        ),
        "delta change": Tolerance(
            _ROUNDING,
            "rad",
            "step times delta_rate, up to rounding; else it is not the input that acted",
        ),
    }


def filter_dataset(dataset: Dataset) -> Dataset:
    """Leaves out standstill, samples outside the car's limits, and steering that does not add up.

    Each within its tolerance, :func:`tolerances`. The last means delta_{k+1} != delta_k + step *
    delta_rate.
    """
    car = dataset.car
    slack = {signal: tolerance.value for signal, tolerance in tolerances(car).items()}
    kept = dataset.select(dataset.x[:, 3] >= slack["vx"], "standstill")
    d, rate = kept.u.T
    angle = np.maximum(np.abs(kept.x[:, 6]), np.abs(kept.x_next[:, 6]))
    within = (
        (d >= car.d_min - slack["d"])
        & (d <= car.d_max + slack["d"])
        & (np.abs(rate) <= car.delta_rate_max_radps + slack["delta_rate"])
        & (angle <= car.delta_max_rad + slack["delta"])
    )
    kept = kept.select(within, "outside limits")
    drift = kept.x_next[:, 6] - kept.x[:, 6] - kept.step_s * kept.u[:, 1]
    return kept.select(np.abs(drift) <= slack["delta change"], "steering does not match its rate")
