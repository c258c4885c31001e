"""One-step samples of a driven car, and the filter that leaves out unusable ones."""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from msgspec.msgpack import encode
from numpy.typing import ArrayLike

from bayesrace.arrays import Flags, Floats
from bayesrace.columns import Columns
from bayesrace.errors import InputError
from bayesrace.learning.drives import Estimates
from bayesrace.vehicles.parameters import Car

__all__ = ["MIRRORED_FEATURES", "MIRRORED_OUTPUTS", "ROUNDING", "SIGMAS", "Dataset", "concatenate"]
__all__ += ["consecutive", "dataset_from_arrays", "filter_dataset", "left_out"]

ROUNDING: Final = 1e-6
"""Permitted error of times, inputs and angles [SI units]; a plant in single precision errs by
2.4e-7 at 5 rad/s."""

SIGMAS: Final = 4.0
"""Standard deviations that an estimate may be off by."""

_MIRRORED_STATE: Final = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0, -1.0])
_MIRRORED_INPUT: Final = np.array([1.0, -1.0])
"""Signs of x, y, psi, vx, vy, omega, delta, and of d, delta_rate, in a mirror along the x axis."""
MIRRORED_FEATURES: Final = np.concatenate([_MIRRORED_STATE[3:], _MIRRORED_INPUT])
MIRRORED_OUTPUTS: Final = tuple(_MIRRORED_STATE[3:6].tolist())
"""The same signs of the features of a residual, and of its outputs."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Samples (x_k, u_k, x_{k+1}), each one sampling period apart; rows need not be consecutive.

    ``x``, ``x_next`` (n, 7) = [x, y, psi, vx, vy, omega, delta] and ``u`` (n, 2) =
    [d, delta_rate], SI units; ``u`` is the input that acted during the period, ``delta`` the angle
    at its start. ``dropped`` counts samples left out so far, by reason; ``estimates``, where states
    are estimated: how well they are known. Raises InputError for shapes that do not fit or numbers
    that are not finite.
    """

    car: Car
    step_s: float
    x: Floats
    u: Floats
    x_next: Floats
    dropped: Mapping[str, int] = field(default_factory=dict, kw_only=True)
    estimates: Estimates | None = field(default=None, kw_only=True)

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
        if self.estimates is not None:
            known = self.estimates.deviation
            if known.shape != (count, 4) or not (np.isfinite(known) & (known >= 0)).all():
                raise InputError(
                    f"dataset: deviation of shape {known.shape}, expected ({count}, 4), none of "
                    "them negative"
                )

    def __len__(self) -> int:
        return len(self.x)

    @property
    def deviation(self) -> Floats:
        """Standard deviations (n, 4) as in :class:`~.drives.Estimates`; zeros without."""
        return (self.estimates or Estimates.exact(len(self))).deviation

    @property
    def features(self) -> Floats:
        """z = [vx, vy, omega, delta, d, delta_rate], shape (n, 6)."""
        return np.column_stack((self.x[:, 3:7], self.u))

    def select(self, rows: slice | ArrayLike, reason: str = "") -> "Dataset":
        """The given rows (slice, mask or indices); others are counted under ``reason``, if any."""
        index = rows if isinstance(rows, slice) else np.asarray(rows)
        kept = replace(
            self,
            x=self.x[index],
            u=self.u[index],
            x_next=self.x_next[index],
            estimates=None if self.estimates is None else self.estimates.select(index),
        )
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
            estimates=self.estimates and self.estimates.select(np.repeat(np.arange(len(self)), 2)),
        )

    def settled(self) -> "Dataset":
        """The same samples without their drives: they stay as they are smoothed."""
        if self.estimates is None:
            return self
        return replace(self, estimates=Estimates.settled(self.deviation))

    def digest(self) -> str:
        """sha256 over car, step, samples, and what was read in their drives."""
        text = f"{self.car.name}/{self.car.digest()}/{self.step_s!r}/{len(self)}"
        total = hashlib.sha256(text.encode())
        known = [] if self.estimates is None else [self.deviation, self.estimates.origin]
        for drive in () if self.estimates is None else self.estimates.drives:
            total.update(encode(drive.readings))
        for array in (self.x, self.u, self.x_next, *known):
            total.update(array.astype("<f8", order="C").tobytes())
        return total.hexdigest()


def consecutive(states: Columns, step_s: float) -> Flags:
    """Which states (n - 1,) come a period after the one before them, in the same run, with none
    missing in between. ``states`` has run, seq and time_s."""
    now, after = states[:-1], states[1:]
    same_run, next_seq = now["run"] == after["run"], now["seq"] + 1 == after["seq"]
    on_time = np.abs(after["time_s"] - now["time_s"] - step_s) <= ROUNDING
    found: Flags = same_run & next_seq & on_time
    return found


def left_out(dropped: Mapping[str, int]) -> str:
    """Counts by reason as a text."""
    return ", ".join(f"{count} {reason}" for reason, count in dropped.items()) or "none"


def dataset_from_arrays(car: Car, step_s: float, states: ArrayLike, inputs: ArrayLike) -> Dataset:
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
        estimates=_joined(datasets),
        dropped=sum((Counter(dataset.dropped) for dataset in datasets), Counter[str]()),
    )


def _joined(datasets: Sequence[Dataset]) -> Estimates | None:
    if all(one.estimates is None for one in datasets):
        return None
    return Estimates.joined([one.estimates or Estimates.exact(len(one)) for one in datasets])


def filter_dataset(dataset: Dataset, *, limits: bool = True) -> Dataset:
    """Leaves out standstill, samples outside the car's limits, those of a spin, and steering that
    does not add up.

    Slower than ``moving_mps`` of its tuning the car stands; all else is up to :data:`ROUNDING`, and
    angles that are estimated up to :data:`SIGMAS` of their standard deviations. The last means
    delta_{k+1} != delta_k + step * delta_rate. Without ``limits``, samples outside the
    car's limits and those of a spin stay.
    """
    car = dataset.car
    kept = dataset.select(dataset.x[:, 3] >= car.tuning.gate.moving_mps, "standstill")
    d, rate = kept.u.T
    tolerance = ROUNDING + SIGMAS * kept.deviation[:, 3]
    angle = np.maximum(np.abs(kept.x[:, 6]), np.abs(kept.x_next[:, 6]))
    within = (
        (d >= car.d_min - ROUNDING)
        & (d <= car.d_max + ROUNDING)
        & (np.abs(rate) <= car.delta_rate_max_radps + ROUNDING)
        & (angle <= car.delta_max_rad + tolerance)
    )
    if limits:
        kept = kept.select(within, "outside limits")
        # No controller plans to spin, and samples far from all others would take their place.
        vx, vy = kept.x[:, 3:5].T
        kept = kept.select(np.abs(np.arctan2(vy, vx)) <= car.tuning.gate.spin_rad, "spinning")
    drift = kept.x_next[:, 6] - kept.x[:, 6] - kept.step_s * kept.u[:, 1]
    tolerance = ROUNDING + SIGMAS * kept.deviation[:, 3]
    return kept.select(np.abs(drift) <= tolerance, "steering does not match its rate")
