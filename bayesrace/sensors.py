"""The instruments that measure a car, as a car's file or a file of ``--sensors`` states them, in
sections ``[sensors.NAME]``; without any the whole state is measured, exactly.

An instrument measures some of the states at a rate of its own, and reports each reading late. What
it says of its errors is their standard deviation; offset, outliers and steps it does not say.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    RootModel,
    model_validator,
)

from bayesrace.defaults import Option
from bayesrace.errors import InputError
from bayesrace.files import read_form, write_whole
from bayesrace.messages import MOST_INSTRUMENTS, MOST_READINGS
from bayesrace.strict import StrictModel

__all__ = [
    "BUILT_IN", "EXACT", "FIELDS", "Channel", "Instrument", "Sensors", "SensorsSetting",
    "get_sensors", "sensor_lines", "write_sensors",
]  # fmt: skip

FIELDS: Final = {
    "x": "x_m", "y": "y_m", "psi": "heading_rad", "vx": "speed_mps", "vy": "lateral_mps",
    "omega": "yaw_rate_radps", "delta": "steering_rad",
}  # fmt: skip
"""What can be measured (``bayesrace.messages.QUANTITIES``) to its name in a file."""

_EVENTS: Final = 60
"""A few less than BR_EVENTS in controller/native/bayesrace_estimator.h."""


class Channel(StrictModel):
    """How one quantity is measured; all in its unit, but for ``relative``."""

    deviation: float = Field(ge=1e-12, le=1e3, description="standard deviation of white noise")
    relative: float = Field(
        0.0, ge=0, le=1, description="the same as a share of the value, where that is more [-]"
    )
    offset: float = Field(0.0, ge=-1e3, le=1e3, description="constant error")
    step: float = Field(0.0, ge=0, le=1e3, description="values are multiples of it; 0: any")
    outlier: float = Field(
        0.0, ge=0, le=1e5, description="standard deviation of what outliers add to the error"
    )

    def deviation_at(self, value: float) -> float:
        """Standard deviation of the noise where this is the value."""
        return max(self.deviation, self.relative * abs(value))


Measured = Annotated[
    Channel | None,
    BeforeValidator(lambda one: {"deviation": one} if isinstance(one, int | float) else one),
]
"""A number is the deviation alone."""


class Instrument(StrictModel):
    """One sensor, or several that measure at the same moments."""

    rate_hz: float = Field(ge=0.1, le=1e4, description="measurements in a second [Hz]")
    delay_s: float = Field(0.0, ge=0, le=1, description="from measurement to report [s]")
    jitter_s: float = Field(
        0.0, ge=0, le=1, description="the delay is up to so much more or less, evenly drawn [s]"
    )
    lost: float = Field(0.0, ge=0, lt=1, description="share of readings that never come [-]")
    gap_s: float = Field(0.0, ge=0, le=60, description="how long no reading is made [s] ...")
    gap_every_s: float = Field(0.0, ge=0, le=3600, description="... at the end of each such time")
    outliers: float = Field(0.0, ge=0, lt=1, description="share of readings that are wrong [-]")
    x_m: Measured = Field(None, description="x [m]: deviation, or a table")
    y_m: Measured = Field(None, description="y [m]")
    heading_rad: Measured = Field(None, description="heading [rad]")
    speed_mps: Measured = Field(None, description="speed along the car [m/s]")
    lateral_mps: Measured = Field(None, description="velocity across the car, to the left [m/s]")
    yaw_rate_radps: Measured = Field(None, description="yaw rate [rad/s]")
    steering_rad: Measured = Field(None, description="steering angle [rad]")

    @property
    def channels(self) -> dict[str, Channel]:
        """What is measured, by quantity."""
        given = ((name, getattr(self, field)) for name, field in FIELDS.items())
        return {name: channel for name, channel in given if channel is not None}

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not self.channels:
            raise ValueError(f"measures nothing: give some of {', '.join(FIELDS.values())}")
        if self.jitter_s > self.delay_s:
            raise ValueError(
                f"jitter_s {self.jitter_s:g} is more than delay_s {self.delay_s:g}: nothing is "
                "reported before it is measured; raise the delay or lower the jitter"
            )
        if (self.gap_s > 0) != (self.gap_every_s > 0) or self.gap_s > 0.9 * self.gap_every_s:
            raise ValueError(
                f"gap_s {self.gap_s:g}, gap_every_s {self.gap_every_s:g}: give both, gaps of at "
                "most 0.9 of the time, or neither"
            )
        if (self.outliers > 0) != any(one.outlier > 0 for one in self.channels.values()):
            raise ValueError(
                "outliers need a share, outliers = 0.01, and a size, as in x_m = { deviation = "
                "0.001, outlier = 0.3 }: give both or neither"
            )
        return self


_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]


class Sensors(RootModel[dict[_Name, Instrument]]):
    """All instruments of a car by their names; none: the state is measured exactly."""

    model_config = ConfigDict(frozen=True)

    root: dict[_Name, Instrument] = Field({}, max_length=MOST_INSTRUMENTS)

    def __hash__(self) -> int:
        return hash(tuple(self.root.items()))

    @model_validator(mode="after")
    def _begins(self) -> Self:
        poses = (one for one in self.root.values() if {"x", "y", "psi"} <= one.channels.keys())
        if self.root and not any(poses):
            raise ValueError(
                "no instrument measures x_m, y_m and heading_rad together, without which no "
                "estimate begins: add them to one"
            )
        return self

    @property
    def label(self) -> str:
        """The name of a built-in set, or what there is with a digest of all values."""
        rates = ", ".join(f"{name} {one.rate_hz:g} Hz" for name, one in self.root.items())
        other = f"{rates} ({hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:6]})"
        return next((k for k, v in BUILT_IN.items() if v == self), other)

    def check_rate(self, states_hz: float) -> None:
        """InputError if more readings are made than states can hold."""
        if (rate_hz := sum(one.rate_hz for one in self.root.values())) > MOST_READINGS * states_hz:
            raise InputError(
                f"sensors make {rate_hz:g} readings in a second, and {states_hz:g} states hold "
                f"{MOST_READINGS} each: lower rate_hz of {', '.join(self.root)} to "
                f"{MOST_READINGS * states_hz:g} Hz together"
            )
        kept_s = _EVENTS / (rate_hz + states_hz)
        for name, one in self.root.items():
            if (late_s := one.delay_s + one.jitter_s) > kept_s:
                raise InputError(
                    f"sensors.{name} is {late_s:g} s late, and an estimator that gets so many "
                    f"readings looks back {kept_s:.2g} s: lower delay_s, or rates"
                )


EXACT: Final = Sensors({})

_POSE: Final = {
    "delay_s": 0.02, "jitter_s": 0.005, "x_m": 0.0005, "y_m": 0.0005, "heading_rad": 0.0035,
}  # fmt: skip
BUILT_IN: Final = {
    "exact": EXACT,
    "mocap": Sensors.model_validate({"pose": {"rate_hz": 50, **_POSE}}),
    "odometry": Sensors.model_validate(
        {
            "pose": {"rate_hz": 25, **_POSE},
            "wheel": {"rate_hz": 200, "speed_mps": {"deviation": 0.005, "relative": 0.01}},
            "gyro": {"rate_hz": 200, "yaw_rate_radps": {"deviation": 0.02, "offset": 0.05}},
        }
    ),
}
"""Sets that have a name: poses of motion capture; fewer of them with wheel speed and gyro."""


class _File(StrictModel):
    sensors: Sensors


def get_sensors(given: str | Path) -> Sensors:
    """The built-in set of that name, or those in that TOML file; InputError if there are none."""
    if (name := str(given)) in BUILT_IN:
        return BUILT_IN[name]
    if Path(given).suffix != ".toml":
        raise InputError(f"unknown '{name[:60]}': give {', '.join(BUILT_IN)}, or a file (*.toml)")
    return read_form(Path(given), "the sensors", "docs/sensors.md shows one", _File).sensors


SensorsSetting = Annotated[
    Sensors | None,
    BeforeValidator(lambda one: get_sensors(one) if isinstance(one, str | Path) else one),
    Option(metavar="SENSORS"),
    Field(
        description="what measures the car: exact, mocap (poses), odometry (poses, wheel speed, "
        "gyro) or a TOML file (docs/sensors.md); None: the car's own, or exact"
    ),
]
"""Field of settings that accepts a name or a file and holds all instruments."""


def sensor_lines(sensors: Sensors, remarks: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """The sections of a TOML file, from what is not by default, each after its remarks."""
    for name, instrument in sensors.root.items():
        yield from ("", *(f"# {one}" for one in remarks.get(name, ())), f"[sensors.{name}]")
        for field, value in instrument.model_dump(exclude_defaults=True).items():
            about = Instrument.model_fields[field].description
            yield f"{field} = {_value(value)}  # {about}"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {_value(one)}' for key, one in value.items())} }}"
    return json.dumps(value)


def write_sensors(path: Path, sensors: Sensors) -> None:
    """Writes what :func:`get_sensors` reads; not for none."""
    write_whole(path, "\n".join(sensor_lines(sensors, {})).lstrip() + "\n")
