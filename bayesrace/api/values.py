"""States and inputs of a car as small objects with named fields, and what is refused as one."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from importlib import import_module
from math import isfinite
from operator import le
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from bayesrace.arrays import Floats
from bayesrace.errors import InputError, faults_in
from bayesrace.tracks import Track, wide_enough
from bayesrace.vehicles import Car

__all__ = ["Input", "Range", "State", "car_of", "finite_input", "number", "numbers", "optional"]
__all__ += ["track_of", "validated"]


def numbers(values: ArrayLike, name: str) -> Floats:
    """An array of them; InputError if they are none."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} = {values!r:.60}: give numbers") from None


def number(value: float, name: str, low: float, high: float, remedy: str) -> float:
    """The number; InputError unless it is one from ``low`` to ``high``."""
    if isinstance(value, int | float | np.number) and low <= value <= high:
        return float(value)
    raise InputError(f"{name} = {value!r:.60}: give {remedy}")


def validated(form: Any, values: dict[str, Any], names: Mapping[str, str] | None = None) -> Any:
    """Settings of this form; InputError names what is wrong with the values. ``names``: of fields
    that the caller knows by others."""
    try:
        return form.model_validate({k: v for k, v in values.items() if v is not None})
    except ValidationError as error:
        raise InputError(faults_in(error, "the settings", form, names=names)) from None


def car_of(car: "Car | Path | str") -> Car:
    """A car, by its name, or from its file."""
    if not isinstance(car, Car | Path | str):
        raise InputError(f"car = {type(car).__name__}: give a bayesrace.Car, a name, or a file")
    return Car.load(car)


def track_of(track: "Track | Path | str", car: Car) -> Track:
    """A track, by its name, or from its file; InputError if the car does not fit on it."""
    if isinstance(track, Path | str):
        return Track.load(track, car)
    if not isinstance(track, Track):
        raise InputError(f"track = {type(track).__name__}: give a bayesrace.Track, or a name")
    return wide_enough(track, car.width_m)


class _Numbers:
    """What states and inputs have in common: they are arrays, too."""

    def to_numpy(self) -> Floats:
        """The numbers in the order of the fields, shape (7,) of a state, (2,) of an input."""
        return np.array(tuple(self))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Floats:
        return np.array(tuple(self), dtype=dtype)

    def __iter__(self) -> Iterator[float]:
        return iter(astuple(self))  # type: ignore[call-overload]

    @classmethod
    def of(cls, values: ArrayLike) -> Self:
        """From numbers in the order of the fields; InputError for another count of them."""
        if isinstance(values, cls):
            return values
        names = cls.__dataclass_fields__  # type: ignore[attr-defined]
        given = numbers(values, cls.__name__.lower())
        if given.shape != (len(names),):
            raise InputError(
                f"{cls.__name__.lower()}: an array of shape {given.shape}, expected "
                f"({len(names)},): {', '.join(names)}"
            )
        return cls(*given.tolist())


@dataclass(frozen=True, slots=True)
class State(_Numbers):
    """State of a car, SI units; NumPy takes it as an array of shape (7,)."""

    x: float
    """Position of the centre of gravity [m]."""
    y: float
    """Position [m]."""
    psi: float
    """Heading from the x axis, not wrapped [rad]."""
    vx: float
    """Velocity along the car's axis [m/s]."""
    vy: float
    """Velocity to the left [m/s]."""
    omega: float
    """Yaw rate [rad/s]."""
    delta: float
    """Steering angle, positive to the left [rad]."""

    def __iter__(self) -> Iterator[float]:  # three times as fast as that of any dataclass
        x = (self.x, self.y, self.psi, self.vx, self.vy, self.omega, self.delta)
        return iter(x)


@dataclass(frozen=True, slots=True)
class Input(_Numbers):
    """Input of a car; NumPy takes it as an array of shape (2,)."""

    d: float
    """Drive command: duty cycle [-], or acceleration [m/s2], as the car's file says."""
    delta_rate: float
    """Steering rate, positive to the left [rad/s]."""

    def __iter__(self) -> Iterator[float]:
        return iter((self.d, self.delta_rate))


def finite_input(values: ArrayLike, name: str) -> tuple[float, float]:
    """The two numbers of an input; InputError, which names it, if one is not finite."""
    u = Input.of(values)
    if not (isfinite(u.d) and isfinite(u.delta_rate)):
        raise InputError(f"{name} = {u.d, u.delta_rate}: give finite numbers")
    return u.d, u.delta_rate


class Range:
    """The states that a car on a track can be in: what is far outside has other units."""

    _FIELDS = tuple(State.__dataclass_fields__)
    _FAR = 10.0
    """Sizes of the track, from its middle."""
    _METRES = "give metres, in the track's own coordinates"
    _REMEDY = (
        _METRES, _METRES,
        "give radians", "give metres per second, not km/h", "give metres per second, not km/h",
        "give radians per second, not degrees", "give radians, not degrees",
    )  # fmt: skip

    def __init__(self, car: Car, track: Track) -> None:
        top_mps = 2 * car.drive.top_speed_mps(car.d_max)
        xy = np.column_stack([track.x_m, track.y_m])
        middle, size = (xy.max(axis=0) + xy.min(axis=0)) / 2, float(np.ptp(xy, axis=0).max())
        far = self._FAR * size
        most = car.tuning.plausible
        self._high = (
            middle[0] + far, middle[1] + far, most.heading_rad, top_mps, top_mps,
            most.yaw_rate_radps, 2 * car.delta_max_rad,
        )  # fmt: skip
        self._low = (middle[0] - far, middle[1] - far, *(-one for one in self._high[2:]))

    def checked(self, state: "State | ArrayLike | Sequence[float]") -> tuple[float, ...]:
        """The seven numbers; InputError for other shapes, NaN, and what no state of this car can
        be."""
        x = tuple(State.of(state))
        if not all(map(le, self._low, x)) or not all(map(le, x, self._high)):  # NaN is neither
            self._refuse(x)
        return x

    def _refuse(self, x: tuple[float, ...]) -> None:
        for name, value, low, high, remedy in zip(
            self._FIELDS, x, self._low, self._high, self._REMEDY, strict=True
        ):
            if value != value:
                raise InputError(
                    f"state.{name} = nan: give a number, or None in place of a state that was not "
                    "measured"
                )
            if not low <= value <= high:
                raise InputError(
                    f"state.{name} = {value:.4g} is outside {low:.4g} to {high:.4g}: {remedy}"
                )


def optional(package: str, extra: str) -> Any:
    """The package; InputError with the way to install it if it is not there."""
    try:
        return import_module(package)
    except ImportError:
        raise InputError(
            f"{package} is not installed: pip install 'bayesrace[{extra}]', or {package} alone"
        ) from None
