"""What a car's file needs and a ruler does not measure, from logs of drives, with standard errors.

The drive is cut into windows. In each, a single-track car (:mod:`.single_track`) is driven by the
commands of the log from a state of its own, and the numbers of the car are those that bring it
nearest to all readings (:mod:`.window_fit`). The tyres are found along with all else, so that their
slip is not taken for the motor's or for a delay.

Only the sum of the delays of command and measurement can be seen. Times of the first instrument
count as right; those of others are compared with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from bayesrace.arrays import AnyArray, Floats
from bayesrace.learning.instruments import Recorded, cut
from bayesrace.learning.settings import Progress
from bayesrace.learning.single_track import Numbers, rates
from bayesrace.learning.window_fit import MOST_SLIP_RAD, Fit, polynomials, states_of
from bayesrace.messages import QUANTITIES
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2, DcMotor

__all__ = ["Comparison", "Identified", "Value", "identify"]

_ROUNDS: Final = ((0.2, 1e-3), (0.5, 1e-4), (0.5, 1e-5))
"""Of the fit: length of the windows [s], as what is far from the truth goes far astray in long
ones, and change of the sum of squares, over it, at which it ends."""
_SHORT_S: Final = 0.16
"""Of windows in which a parabola follows the car, to compare with."""
_QUANTILE: Final = 0.98
"""Of the accelerations: the largest that the drive held."""
_HELD: Final = 0.7
"""Share of the steering range on the skid pad whose acceleration is the friction."""
_DRAWS: Final = 60


class Value(NamedTuple):
    """One number that was found."""

    name: str
    value: float
    error: float
    """Standard error."""
    unit: str
    meaning: str


@dataclass(frozen=True, eq=False)
class Comparison:
    """Accelerations as parabolas through the poses of short windows have them, and as modelled."""

    speed_mps: Floats
    command: Floats
    measured: Floats
    """Along the car and to its left, (n, 2) [m/s^2]."""
    modelled: Floats


@dataclass(frozen=True, eq=False)
class Identified:
    """The car with the numbers that were found, and what stands behind them."""

    car: CarParameters
    values: tuple[Value, ...]
    used_s: float
    """Driving that was used, and that there was."""
    driven_s: float
    refused: int
    """Readings far from all others."""
    limit: bool
    """Whether the drive has reached the limit of the tyres, which friction is then of."""
    comparison: Comparison

    def remarks(self, logs: Sequence[str]) -> list[str]:
        """Lines that say where the numbers are from."""
        found = [
            f"{v.name} = {v.value:.5g} ± {v.error:.2g} {v.unit}: {v.meaning}" for v in self.values
        ]
        return [
            f"Identified by 'bayesrace identify' from {self.used_s:.0f} s of {', '.join(logs)};",
            "each number with its standard error:",
            *(f"    {one}" for one in found),
        ]


def identify(
    car: CarParameters,
    runs: Sequence[Recorded],
    instruments: Sequence[str],
    *,
    wheelbase: bool = False,
    progress: Progress | None = None,
) -> Identified:
    """Finds the numbers of a car; ``car`` has its geometry and mass, and where to begin.

    ``wheelbase``: it is not known, either; then the steering's gain is 1. InputError if there is
    too little driving, if the commands hardly change, or if no such car drove.
    """
    fit = Fit(car, list(runs), len(instruments), wheelbase)
    for number, (window_s, close) in enumerate(_ROUNDS):
        if progress is not None:
            progress(number / len(_ROUNDS), "")
        fit.improve(window_s, close)
    return _Report(fit, instruments).identified()


class _Report:
    """From the fit to the numbers of a car's file."""

    def __init__(self, fit: Fit, instruments: Sequence[str]) -> None:
        self._fit, self._instruments = fit, instruments
        self._covariance = fit.covariance()
        self._names = [*Numbers._fields, *(f"late {one}" for one in instruments[1:])]
        errors = np.sqrt(np.diag(self._covariance))
        free = [self._names[i] for i in fit.free]
        self._found = dict(zip(free, zip(fit.theta, errors, strict=True), strict=True))

    def identified(self) -> Identified:
        """All of it."""
        fit, car = self._fit, self._fit.car
        friction, limit = self._friction()
        values = [*self._drive(), *self._actuators(), friction, *self._sensors()]
        known = {one.name: one.value for one in values}
        changes: dict[str, object] = {"friction": round(friction.value, 4)}
        if isinstance(car.drive, DcMotor):
            numbers = {name: float(f"{known[name]:.5g}") for name in ("cm1", "cm2", "cr0", "cr2")}
            changes["drive"] = car.drive.model_dump() | numbers
        if "wheelbase" in known:
            share = known["wheelbase"] / car.wheelbase_m
            changes |= {one: float(f"{share * getattr(car, one):.5g}") for one in ("lf_m", "lr_m")}
        values_of_file = car.model_dump(exclude_unset=True) | changes
        return Identified(
            car=CarParameters.model_validate(values_of_file),
            values=tuple(values),
            used_s=int(fit.used.sum()) * fit.periods * fit.step_s,
            driven_s=fit.driven_s,
            refused=fit.refused,
            limit=limit,
            comparison=self._comparison(),
        )

    def _value(self, key: str, name: str, unit: str, meaning: str, times: float = 1.0) -> Value:
        value, error = self._found[key]
        return Value(name, times * float(value), times * float(error), unit, meaning)

    def _drive(self) -> list[Value]:
        car, mass = self._fit.car, self._fit.car.mass_kg
        if isinstance(car.drive, DcMotor):
            return [
                self._value("a1", "cm1", "N", "motor force per duty cycle at standstill", mass),
                self._value("a2", "cm2", "N s/m", "its loss with speed", mass),
                self._value("a3", "cr0", "N", "rolling resistance", mass),
                self._value("a4", "cr2", "N s²/m²", "drag", mass),
            ]
        return [
            self._value("a1", "drive gain", "1", "acceleration over that commanded"),
            self._value("a3", "resistance", "m/s²", "rolling resistance, which the GP learns"),
            self._value("a4", "drag", "1/m", "drag, which the GP learns"),
        ]

    def _actuators(self) -> list[Value]:
        first = self._instruments[0]
        values = [
            self._value("delay_s", "delay", "ms", f"command to car, by the times of {first}", 1e3),
            self._value("lag_s", "steering lag", "ms", "first order, behind the delay", 1e3),
            self._value("offset_rad", "steering offset", "rad", "angle at a commanded angle of 0"),
        ]
        if "gain" in self._found:
            values.append(self._value("gain", "steering gain", "1", "angle over that commanded"))
        if "size" in self._found:
            length_m = self._fit.car.wheelbase_m
            values.append(self._value("size", "wheelbase", "m", "lf + lr", length_m))
        return values

    def _sensors(self) -> list[Value]:
        fit, values = self._fit, []
        for number, name in enumerate(self._instruments):
            ages = np.concatenate([
                run.readings.age_s[run.readings.instrument == number] for run in fit.runs
            ])  # fmt: skip
            spread = float(ages.std() / np.sqrt(len(ages)))
            about = f"{name}: measurement to report"
            values.append(
                Value(f"{name} reported", 1e3 * float(ages.mean()), 1e3 * spread, "ms", about)
            )
            if number:
                about = f"{name}: its times, against those of {self._instruments[0]}"
                values.append(self._value(f"late {name}", f"{name} late", "ms", about, 1e3))
            for of, quantity in enumerate(QUANTITIES):
                if (count := fit.counted[number, of]) > 0:
                    noise = float(fit.deviation[number, of])
                    unit = ["m", "m", "rad", "m/s", "m/s", "rad/s", "rad"][of]
                    values.append(
                        Value(f"{name} {quantity}", noise, noise / float(np.sqrt(2 * count)), unit,
                              f"{name}: standard deviation of the noise")
                    )  # fmt: skip
        for key, name, unit in (
            ("gyro_radps", "yaw rate offset", "rad/s"), ("angle_rad", "angle offset", "rad")
        ):  # fmt: skip
            if key in self._found:
                values.append(self._value(key, name, unit, "of what is measured"))
        return values

    def _friction(self) -> tuple[Value, bool]:
        """What a skid pad gives with some steering left, or what the drive has held if that is
        less; and whether it was the former."""
        fit, random = self._fit, np.random.default_rng(0)
        numbers, _ = fit.numbers(fit.theta[None])
        path = fit.track.drive(numbers, fit.base, fit.states[:, None])
        rate, x = (np.moveaxis(one[:, 1, :, 0], 0, -1) for one in (path.begin_rate, path.begin))
        along, across = rate[3] - x[4] * x[5], rate[4] + x[3] * x[5]
        way = np.abs(x[3] * across - x[4] * along) / np.hypot(x[3], x[4])
        total = way[fit.used] / GRAVITY_MPS2
        draws = random.integers(len(total), size=(_DRAWS, len(total)))
        held = float(np.quantile(total, _QUANTILE))
        spread = float(np.std([np.quantile(total[rows], _QUANTILE) for rows in draws]))
        thetas = random.multivariate_normal(fit.theta, self._covariance, _DRAWS)
        with np.errstate(over="ignore", invalid="ignore"):  # without a limit, it ends nowhere
            pad = _skid_pad(fit.car, fit.numbers(fit.clipped(np.vstack([fit.theta, thetas])))[0])
        about = f"acceleration over g on a skid pad at {_HELD:.0%} of the steering"
        if pad[0] <= held:
            return Value("friction", float(pad[0]), float(np.std(pad[1:])), "1", about), True
        about = "largest lateral acceleration of the drive over g; there may be more"
        return Value("friction", held, spread, "1", about), False

    def _comparison(self) -> Comparison:
        fit = self._fit
        periods = max(4, round(_SHORT_S / fit.step_s))
        length_s = periods * fit.step_s
        late_s = fit.numbers(fit.theta[None])[1][0]
        windows = cut(fit.runs, periods, late_s)
        curves, good = polynomials(windows, 2, length_s, alone=True)
        x = states_of(curves, 0.5, length_s)
        numbers, _ = fit.numbers(fit.theta[None])
        poses = ((windows.weight > 0) & (windows.of == 0)).sum(axis=1)
        base = fit.track.base(windows)
        used = (poses > 4) & (x[3] > 0.2) & (np.abs(np.arctan2(x[4], x[3])) < MOST_SLIP_RAD)
        used &= (good | (windows.weight <= 0)).all(axis=1)
        index = base[:, None] + np.arange(periods) - round(numbers.delay_s.item() / fit.step_s)
        d, angle = (one.mean(axis=1) for one in fit.track.commands(np.maximum(index, 0)))
        delta = numbers.gain * angle + numbers.offset_rad
        rate = rates(fit.car, numbers, x[:, None], d[None], delta)[:, 0]
        modelled = np.column_stack([rate[3] - x[4] * x[5], rate[4] + x[3] * x[5]])
        head, left = np.cos(x[2]), np.sin(x[2])
        xx, yy = 2 * curves[:2, :, 2] / length_s**2
        measured = np.column_stack([xx * head + yy * left, yy * head - xx * left])
        return Comparison(x[3, used], d[used], measured[used], modelled[used])


def _skid_pad(car: CarParameters, numbers: Numbers) -> Floats:
    """Largest lateral acceleration over g of cars (p,) on rising throttle, their steering held."""
    delta = np.full_like(numbers.a1, _HELD * car.delta_max_rad)
    length_m, unit_s = car.wheelbase_m, np.sqrt(car.wheelbase_m / GRAVITY_MPS2)
    x = np.zeros((6, len(delta), 1))
    x[3] = np.sqrt(0.3 * GRAVITY_MPS2 * length_m / delta)
    x[5] = x[3] * delta / length_m
    best, going = np.zeros(len(delta)), np.ones(len(delta), bool)
    steps, h = 1000, 0.1 * unit_s
    for step in range(steps):
        d = np.full_like(delta, (0.1 + 0.9 * step / steps) * car.d_max)

        def rate(x: AnyArray, d: AnyArray = d) -> AnyArray:
            return rates(car, numbers, x, d, delta)

        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))
        going &= (np.abs(x[4, :, 0]) < 0.7 * np.abs(x[3, :, 0])) & (x[3, :, 0] > 0)
        best = np.where(going, np.maximum(best, np.hypot(x[3], x[4])[:, 0] * x[5, :, 0]), best)
    return best / GRAVITY_MPS2
