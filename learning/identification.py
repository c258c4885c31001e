"""What a car's file needs and a ruler does not measure, from logs of drives, with standard errors.

The drive is cut into windows. In each, a single-track car (:mod:`.single_track`) is driven by the
commands of the log from a state of its own, and the numbers of the car are those that bring it
nearest to all readings (:mod:`.window_fit`). The tyres are found along with all else, so that their
slip is not taken for the motor's or for a delay.

Only the sum of the delays of command and measurement can be seen. Times of the first instrument
count as right; those of others are compared with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import ValidationError

from bayesrace.arrays import Floats
from bayesrace.errors import faults_in
from bayesrace.learning.instruments import WHOLE, Drives
from bayesrace.learning.settings import Progress
from bayesrace.learning.single_track import TYRES, Cars, Numbers
from bayesrace.learning.window_fit import Fit, polynomials, states_of
from bayesrace.messages import QUANTITIES
from bayesrace.sensors import FIELDS, Sensors
from bayesrace.vehicles import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2, DcMotor, Pacejka

__all__ = ["Comparison", "Identified", "Value", "identify"]

_ROUNDS: Final = ((0.2, 1e-2), (0.5, 1e-3), (0.5, 1e-5))
"""Of the fit: length of the windows [s], as what is far from the truth goes far astray in long
ones, and change of the sum of squares, over it, at which it ends."""
_CHOICE: Final = 1
"""Round before which one model of tyres is left: that with the smaller misfit."""
_QUANTILE: Final = 0.98
"""Of the accelerations: the largest that the drive held."""
_HELD: Final = 0.7
"""Share of the steering range on the skid pad whose acceleration is the friction."""
_DRAWS: Final = 60
_UNSURE: Final = 0.1
"""Standard error over the value: a number that the drive does not show."""
_UNITS: Final = dict(zip(QUANTITIES, ("m", "m", "rad", "m/s", "m/s", "rad/s", "rad"), strict=True))
_OFFSETS: Final = {"omega": "gyro_radps", "delta": "angle_rad"}


class Value(NamedTuple):
    """One number that was found."""

    name: str
    value: float
    error: float
    """Standard error."""
    unit: str
    meaning: str
    instrument: str = ""
    """Whose number it is; empty: the car's."""

    def __str__(self) -> str:
        number = f"{self.value:.5g} ± {self.error:.2g} {self.unit}"
        return f"{self.name} = {number}: {self.meaning}"


@dataclass(frozen=True, eq=False)
class Comparison:
    """Accelerations in windows, of parabolas through measured poses and through modelled ones."""

    speed_mps: Floats
    command: Floats
    measured: Floats
    """Along the car and to its left, (n, 2) [m/s^2]."""
    modelled: Floats


@dataclass(frozen=True, eq=False)
class Identified:
    """The car with the numbers that were found, and what stands behind them."""

    car: Car
    values: tuple[Value, ...]
    unknown: tuple[str, ...]
    """What the drive does not show, each with the remedy."""
    used_s: float
    """Driving that was used, and that there was."""
    driven_s: float
    refused: int
    """Readings far from all others."""
    comparison: Comparison

    def remarks(self, logs: Sequence[str]) -> list[str]:
        """Lines that say where the car's numbers are from."""
        return [
            f"Identified by 'bayesrace identify' from {self.used_s:.0f} s of {', '.join(logs)};",
            "each number with its standard error:",
            *(f"    {one}" for one in self.values if not one.instrument),
            *self.unknown,
        ]

    def sensor_remarks(self) -> dict[str, list[str]]:
        """The same of each instrument."""
        found: dict[str, list[str]] = {}
        for one in self.values:
            if one.instrument:
                found.setdefault(one.instrument, []).append(str(one))
        return found


def identify(
    car: Car,
    drives: Drives,
    *,
    wheelbase: bool = False,
    tyres: bool = False,
    progress: Progress | None = None,
) -> Identified:
    """Finds the numbers of a car; ``car`` has its geometry and mass, and where to begin.

    ``wheelbase``: it is not known, either; then the steering's gain is 1. ``tyres``: the car found
    has tyres and yaw inertia, in place of those of ``car``, if any, so that it can be simulated.
    InputError if there is too little driving, if the commands hardly change, or if no such car
    drove.
    """
    fits = [
        Fit(car.model_copy(update={"tyres": model}), drives, wheelbase=wheelbase) for model in TYRES
    ]
    for number, (window_s, close) in enumerate(_ROUNDS):
        if number == _CHOICE:
            fits = [min(fits, key=lambda fit: fit.misfit)]
        for fit in fits:
            fit.improve(window_s, close)
        if progress is not None:
            progress((number + 1) / len(_ROUNDS), "")
    fits[0].check()
    return _Report(car, fits[0]).identified(tyres=tyres)


class _Report:
    """From the fit to the numbers of a car's file."""

    def __init__(self, car: Car, fit: Fit) -> None:
        self._car, self._fit, self._instruments = car, fit, fit.drives.instruments
        self._covariance = fit.covariance()
        pairs = zip(fit.theta, np.sqrt(np.diag(self._covariance)), strict=True)
        self._found = dict(zip(fit.names, pairs, strict=True))
        numbers, _ = fit.numbers(fit.theta[None])
        self._motion = fit.track.drive(numbers, fit.windows, fit.states[None])

    def identified(self, *, tyres: bool) -> Identified:
        """All of it."""
        fit, car = self._fit, self._car
        friction, unknown = self._friction()
        values = [*self._values(), friction]
        known = {one.name: one for one in values}
        if "cr2" in known and known["cr2"].error > _UNSURE * known["cr2"].value:
            unknown.append(_unsure(known["cr2"]))
        sensors, measured = self._sensors(unknown)
        changes: dict[str, object] = {"friction": round(friction.value, 4), "sensors": sensors}
        if isinstance(car.drive, DcMotor):
            numbers = {name: float(f"{known[name].value:.5g}") for name in car.drive.numbers()}
            changes["drive"] = car.drive.model_dump() | numbers
        if "wheelbase" in known:
            share = known["wheelbase"].value / car.wheelbase_m
            changes |= {one: float(f"{share * getattr(car, one):.5g}") for one in ("lf_m", "lr_m")}
        if tyres:
            changes |= self._tyres()
        return Identified(
            car=Car.model_validate(car.model_dump(exclude_unset=True) | changes),
            values=(*values, *measured),
            unknown=tuple(unknown),
            used_s=fit.used_s,
            driven_s=fit.driven_s,
            refused=fit.refused,
            comparison=self._comparison(),
        )

    def _value(self, key: str, name: str, unit: str, meaning: str, times: float = 1.0) -> Value:
        value, error = self._found[key]
        value = 0.0 if abs(value) < 1e-6 * error else value  # at a bound
        return Value(name, times * float(value), times * float(error), unit, meaning)

    def _values(self) -> list[Value]:
        """What was found of drive and steering."""
        mass = self._car.mass_kg
        drive = {
            "a1": ("drive gain", "1", "acceleration over that commanded"),
            "a3": ("resistance", "m/s²", "rolling resistance, which the GP learns"),
            "a4": ("drag", "1/m", "drag, which the GP learns"),
        }
        motor = {
            "a1": ("cm1", "N", "motor force per duty cycle at standstill", mass),
            "a2": ("cm2", "N s/m", "its loss with speed", mass),
            "a3": ("cr0", "N", "rolling resistance", mass),
            "a4": ("cr2", "N s²/m²", "drag", mass),
        }
        about = f"command to car, by the times of {self._instruments[0]}"
        rows = (motor if isinstance(self._car.drive, DcMotor) else drive) | {
            "delay_s": ("delay", "ms", about, 1e3),
            "lag_s": ("steering lag", "ms", "first order, behind the delay", 1e3),
            "offset_rad": ("steering offset", "rad", "angle at a commanded angle of 0"),
            "gain": ("steering gain", "1", "angle over that commanded"),
            "size": ("wheelbase", "m", "lf + lr", self._car.wheelbase_m),
        }
        return [self._value(key, *row) for key, row in rows.items() if key in self._found]

    def _tyres(self) -> dict[str, object]:
        """With the yaw inertia, of the model that was found."""
        found = Numbers(*self._fit.numbers(self._fit.theta[None])[0][0])
        numbers = {k: float(f"{v:.5g}") for k, v in found.equation_numbers(self._car).items()}
        numbers["height_m"] = max(numbers["height_m"], 0.0)
        tyres: dict[str, Any] = {}
        for name, part in self._fit.car.tyres or ():
            if isinstance(part, Pacejka):
                tyres[name] = {k: numbers[f"{name}_{k}"] for k, _ in part}
            else:
                tyres[name] = numbers.get(name, part)
        return {"tyres": tyres, "inertia_kgm2": numbers["inertia_kgm2"]}

    def _sensors(self, unknown: list[str]) -> tuple[Sensors, list[Value]]:
        """Those of the file, with what was found of those that were logged, if they will do."""
        values: list[Value] = []
        sensors = self._car.sensors.model_dump()
        for number, name in enumerate(self._instruments):
            found: dict[str, Any] = {}
            given = sensors.get(name, {})
            for of in np.flatnonzero(self._fit.counted[number]).tolist():
                field = FIELDS[QUANTITIES[of]]
                channel, of_channel = self._channel(number, of)
                found[field] = (given.get(field) or {}) | channel
                values += of_channel
            if name != WHOLE:  # which has no section
                timing, of_timing = self._timing(number)
                sensors[name] = given | found | timing
                values += of_timing
        try:
            return Sensors.model_validate(sensors), values
        except ValidationError as error:
            faults = faults_in(error, "[sensors]", Sensors)
            unknown.append(f"sensors are not written, as no car's file can have them: {faults}")
        return self._car.sensors, values

    def _channel(self, number: int, of: int) -> tuple[dict[str, float], list[Value]]:
        """Noise and offset of one quantity, by the names of a file."""
        fit, name, quantity = self._fit, self._instruments[number], QUANTITIES[of]
        times, one = fit.noise[number, of], fit.measured(number, of)
        value, stated = one["value"], one["deviation"]
        noise = float(times * np.median(stated))
        error, about = noise / np.sqrt(2 * fit.counted[number, of]), "deviation of the noise"
        unit = _UNITS[quantity]
        values = [Value(f"{name} {quantity}", noise, float(error), unit, about, name)]
        grown = stated > 1.001 * stated.min()
        share = np.median(stated[grown] / np.abs(value[grown])) if grown.any() else 0.0
        found = {"deviation": times * stated.min(), "relative": times * share}
        if (offset := _OFFSETS.get(quantity, "")) in self._found:
            constant = self._value(offset, f"{name} {quantity} offset", unit, "constant error")
            values.append(constant._replace(instrument=name))
            found["offset"] = constant.value
        return _rounded(found), values

    def _timing(self, number: int) -> tuple[dict[str, float], list[Value]]:
        """Rate, delay and jitter of an instrument, by the names of a file.

        A reading waits for the next state, half a period on the average where its moments are
        anywhere between states. Where they are always the same, the delay is known that much less.
        """
        drives = self._fit.drives
        name, period_s, readings = self._instruments[number], drives.step_s, drives.readings
        mine = readings[readings["instrument"] == number]
        between_s, age_s = np.diff(mine["time_s"]), mine["age_s"]
        rate_hz = 1 / float(np.median(between_s[between_s > 0]))
        moments = max(1.0, rate_hz * period_s)
        delay_s, error_s = float(age_s.mean()) - period_s / 2, period_s / np.sqrt(12) / moments
        values = []
        if number:
            about = f"its times, against those of {self._instruments[0]}"
            late = self._value(f"late {number}", f"{name} late", "ms", about, 1e3)
            values.append(late._replace(instrument=name))
            delay_s += late.value / 1e3
        delay_s = min(max(delay_s, 0.0), 1.0)
        waiting = period_s**2 / 12 * (1 - 1 / moments**2)
        jitter_s = min(float(np.sqrt(3 * max(0.0, round(age_s.var() - waiting, 9)))), delay_s)
        for what, span_s, about in (
            ("delay", delay_s, "measurement to report"), ("jitter", jitter_s, "of the delay")
        ):  # fmt: skip
            values.append(Value(f"{name} {what}", 1e3 * span_s, 1e3 * error_s, "ms", about, name))
        found = {"rate_hz": rate_hz, "delay_s": delay_s, "jitter_s": jitter_s}
        return {one: round(number, 5) for one, number in found.items()}, values

    def _accelerations(self) -> Floats:
        """Along the car and to its left in each period of each window, (periods, w, 2)."""
        x, rate = self._motion.begin[:, 0], self._motion.begin_rate[:, 0]
        turning = x[..., 5, None] * np.stack([-x[..., 4], x[..., 3]], axis=-1)
        return np.asarray(rate[..., 3:5] + turning)

    def _friction(self) -> tuple[Value, list[str]]:
        """What a skid pad gives with some steering left, or what the drive has held if that is
        less; and what is then unknown."""
        fit, random = self._fit, np.random.default_rng(0)
        total = np.abs(self._accelerations()[:, fit.used, 1]).T / GRAVITY_MPS2
        draws = random.integers(len(total), size=(_DRAWS, len(total)))
        held = float(np.quantile(total, _QUANTILE))
        spread = float(np.std([np.quantile(total[rows], _QUANTILE) for rows in draws]))
        thetas = random.multivariate_normal(fit.theta, self._covariance, _DRAWS)
        pad = _skid_pad(fit.car, fit.numbers(fit.clipped(np.vstack([fit.theta, thetas])))[0])
        about = f"acceleration over g on a skid pad at {_HELD:.0%} of the steering"
        if pad[0] <= held:
            return Value("friction", float(pad[0]), float(np.std(pad[1:])), "1", about), []
        about = "largest lateral acceleration of the drive over g; there may be more"
        remedy = "friction: this drive did not reach the limit of the tyres; drive faster for it"
        return Value("friction", held, spread, "1", about), [remedy]

    def _comparison(self) -> Comparison:
        fit, windows = self._fit, self._fit.windows
        one, said = windows.readings, windows.readings.copy()
        deviation = fit.noise[one["instrument"], one["of"]] / windows.weight.clip(1e-12)
        said["value"] -= fit.linearised(numbers=False)[0] * deviation
        length_s, both = fit.periods * fit.drives.step_s, []
        for readings in (one, said):
            curves, _ = polynomials(replace(windows, readings=readings), 2, length_s)
            x, (xx, yy) = states_of(curves, 0.5, length_s), 2 * curves[:2, :, 2] / length_s**2
            cos, sin = np.cos(x[:, 2]), np.sin(x[:, 2])
            both.append(np.column_stack([xx * cos + yy * sin, yy * cos - xx * sin])[fit.used])
        command = fit.track.commands(windows)[0].mean(axis=1)
        return Comparison(x[fit.used, 3], command[fit.used], *both)


def _rounded(found: dict[str, float]) -> dict[str, float]:
    """To as many digits as a file needs."""
    return {name: float(f"{one:.4g}") for name, one in found.items()}


def _unsure(drag: Value) -> str:
    return (
        f"{drag.name}: this drive hardly shows it ({drag.value:.2g} ± {drag.error:.2g} {drag.unit})"
        ", as cm2 and cr0 make up for it; add the log of half a minute that alternates full "
        "throttle, up to top speed, and coasting (drive command 0), down to walking pace"
    )


def _skid_pad(car: Car, numbers: Floats) -> Floats:
    """Largest lateral acceleration over g of cars (p, n) on rising throttle, their steering
    held."""
    delta, length_m = _HELD * car.delta_max_rad, car.wheelbase_m
    x = np.zeros((len(numbers), 1, 6))
    x[..., 3] = np.sqrt(0.3 * GRAVITY_MPS2 * length_m / delta)
    x[..., 5] = x[..., 3] * delta / length_m
    best, going = np.zeros((len(numbers), 1)), np.ones((len(numbers), 1), bool)
    cars, steps, h = Cars(car, numbers, 1), 1000, 0.1 * np.sqrt(length_m / GRAVITY_MPS2)
    for step in range(steps):
        d = np.array((0.1 + 0.9 * step / steps) * car.d_max)
        x = cars.step(x, h, d, np.array([delta] * 3))[1]
        vx, vy, omega = np.moveaxis(x[..., 3:], -1, 0)
        going &= (np.abs(vy) < 0.7 * np.abs(vx)) & (vx > 0)  # without a limit, it ends nowhere
        best = np.where(going, np.maximum(best, np.hypot(vx, vy) * omega), best)
    return best[:, 0] / GRAVITY_MPS2
