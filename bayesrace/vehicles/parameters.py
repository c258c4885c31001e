"""Cars as data: geometry, mass, drive, tyres, actuator limits and tuning, SI units.

What a driver can measure (geometry, mass, motor, one friction number) and what only system
identification gives (tyre curves, yaw inertia) live in one object but are used by different models:
the e-kinematic model and the racing line read the former only, the dynamic model reads all. A car
that is not simulated needs no more than the former.

A car is a TOML file. Its sections are those of :data:`SECTIONS`, besides ``[tyres]`` and
``[drive]``, whose ``model`` says which values they hold (:mod:`.parts`), ``[sensors.*]``
(:mod:`bayesrace.sensors`), and ``[tuning.*]``, which a car needs none of. Numbers are in SI units.
"""

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Final

from pydantic import (
    BaseModel,
    BeforeValidator,
    Field,
    ValidationError,
    ValidationInfo,
    create_model,
    field_validator,
)
from pydantic_core import to_json

from bayesrace.defaults import DEFAULT_CAR, Option
from bayesrace.errors import InputError, faults_in
from bayesrace.files import parse_toml, read_text, write_whole
from bayesrace.sensors import EXACT, Sensors, sensor_lines
from bayesrace.vehicles.parts import (
    GRAVITY_MPS2,
    AccelerationDrive,
    DcMotor,
    Drive,
    LinearTyres,
    PacejkaTyres,
    Part,
    Tyres,
)
from bayesrace.vehicles.tuning import (
    REFERENCE_ACCELERATION_MPS2,
    REFERENCE_WHEELBASE_M,
    Scales,
    Tuning,
    scaled,
)

__all__ = [
    "ACTUATORS",
    "BODY",
    "DEFAULT_CAR",
    "Car",
    "CarSetting",
    "builtin_cars",
    "car_text",
    "default_car",
    "described_car",
    "get_car",
    "read_car",
    "write_car",
]

BODY: Final = ("lf_m", "lr_m", "mass_kg", "inertia_kgm2")
ACTUATORS: Final = ("d_min", "d_max", "delta_max_rad", "delta_rate_max_radps")
"""Limits of the inputs and of the steering angle."""

_BRAKE_FADE_MPS: Final = 0.1
"""Of the reference car."""
_UNKNOWN_BRAKING: Final = 0.5
"""Share of the friction that a car on unknown tyres brakes with while its steering is held."""


def _scales(known: Mapping[str, Any]) -> Scales:
    """Of a car whose valid fields these are; those of the reference car if it has faults."""
    try:
        wheelbase_m = known["lf_m"] + known["lr_m"]
        acceleration_mps2 = known["friction"] * GRAVITY_MPS2
        command = known["drive"].command_size(acceleration_mps2)
    except KeyError:
        return Scales()
    return Scales(
        wheelbase_m / REFERENCE_WHEELBASE_M,
        acceleration_mps2 / REFERENCE_ACCELERATION_MPS2,
        command,
    )


class Car(Part):
    """One car; symbols as in docs/equations.md."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9_-]{1,40}$",
        description="name, part of message keys: letters, digits, '-', '_'",
    )
    lf_m: float = Field(gt=0, description="centre of gravity to front axle [m]")
    lr_m: float = Field(gt=0, description="centre of gravity to rear axle [m]")
    mass_kg: float = Field(gt=0, description="mass [kg]")
    inertia_kgm2: float | None = Field(
        None, gt=0, description="yaw moment of inertia Iz, for simulations of the car [kg m^2]"
    )
    tyres: Tyres | None = Field(
        None, description="the tyres, by their model, for simulations of the car"
    )
    drive: Drive = Field(description="the drive, by its model")
    d_min: float = Field(lt=0, description="lowest drive command, which brakes [command]")
    d_max: float = Field(gt=0, description="highest drive command [command]")
    delta_max_rad: float = Field(gt=0, description="steering angle limit, both sides [rad]")
    delta_rate_max_radps: float = Field(gt=0, description="steering rate limit, both sides [rad/s]")
    friction: float = Field(
        gt=0,
        le=5,
        description="one measured number: usable horizontal acceleration over gravity [-]",
    )
    width_m: float = Field(gt=0, description="width of the outline [m]")
    length_m: float = Field(gt=0, description="length of the outline [m]")
    mirrored_samples: bool = Field(
        False,
        strict=True,
        description="whether the mirror image of each sample is learned from, too, and the car is "
        "expected to err to both sides alike: for a car that turns left as it turns right and "
        "whose whole state is measured [-]",
    )
    brake_fade_mps: float = Field(
        default_factory=lambda known: scaled(_BRAKE_FADE_MPS, "m/s", _scales(known)),
        gt=0,
        description="below this speed braking fades linearly to none, so that a car stops and "
        "stays: brakes do not drive a car back [m/s]",
    )
    train_track: str = Field(
        "paddock", min_length=1, description="track of training drives where none is named [-]"
    )
    race_track: str = Field(
        "harbour", min_length=1, description="track of races where none is named [-]"
    )
    sensors: Sensors = Field(EXACT, description="what measures it; none: exactly, as a whole")
    tuning: Tuning = Field(
        default_factory=dict,
        validate_default=True,
        description="numbers that depend on the car's size, derived where they are not given",
    )

    @field_validator("tuning", mode="before")
    @classmethod
    def _complete(cls, value: Any, info: ValidationInfo) -> Any:
        return Tuning.completed(value, _scales(info.data)) if isinstance(value, dict) else value

    @classmethod
    def load(cls, source: "str | Path | Car") -> "Car":
        """The built-in car of that name, or the car in that TOML file (docs/extending.md).

        InputError names the built-in cars, or field, value, unit and remedy of each fault.
        """
        return get_car(source)

    def changed(self, **values: Any) -> "Car":
        """The same car with other numbers, such as ``mass_kg``; what follows from them is derived
        anew. InputError names field, value and remedy."""
        try:
            return type(self).model_validate(self.model_dump(exclude_unset=True) | values)
        except ValidationError as error:
            raise InputError(f"car '{self.name}': {faults_in(error, 'the car', Car)}") from None

    @property
    def wheelbase_m(self) -> float:
        """Distance between the axles, lf + lr."""
        return self.lf_m + self.lr_m

    @property
    def identified(self) -> bool:
        """Whether the dynamic model is known: tyres and inertia."""
        return self.tyres is not None and self.inertia_kgm2 is not None

    @property
    def has_limit(self) -> bool:
        """Whether its tyres slide at some force: linear ones never do."""
        return not isinstance(self.tyres, LinearTyres)

    @property
    def true_tyres(self) -> PacejkaTyres | LinearTyres:
        """The tyres of a car that is :attr:`identified`; InputError for another one."""
        if self.tyres is None or self.inertia_kgm2 is None:
            raise InputError(
                f"the car '{self.name}' has no {'tyres' if self.tyres is None else 'inertia_kgm2'} "
                "in its file, which the simulator, BestCase and the limit need: add them, or drive "
                "a real car, or an FMU of it"
            )
        return self.tyres

    @property
    def equation_numbers(self) -> dict[str, float]:
        """What the dynamic model depends on, by flat name; ``front_b`` is ``tyres.front.b``.

        InputError for a car that is not :attr:`identified`.
        """
        tyres = self.true_tyres.numbers()
        drive = {} if self.drive.guarded else self.drive.numbers()
        return {name: float(getattr(self, name)) for name in BODY} | tyres | drive

    @property
    def guard_numbers(self) -> dict[str, float]:
        """What the plant's guard depends on, by name."""
        drive = self.drive.numbers() if self.drive.guarded else {}
        return {name: float(getattr(self, name)) for name in ACTUATORS} | drive

    @property
    def brake_numbers(self) -> dict[str, float]:
        """How a car is braked without a controller, its steering held.

        Drive command: -(brake_d + brake_slow / vx^2), but not below d_min, and fading to none below
        brake_fade_mps. The tyres give the first two: a car that brakes harder may spin. Where they
        are not known, half of the friction is left for the bend.
        """
        command = self.drive.command_for(1.0, self.mass_kg)
        steady, slow = _UNKNOWN_BRAKING * self.friction * GRAVITY_MPS2, 0.0
        if self.tyres is not None:
            hardest_mps2 = -self.d_min / command
            steady, slow = self.tyres.steady_braking(self.lf_m, self.lr_m, hardest_mps2)
        return {
            "brake_fade_mps": self.brake_fade_mps,
            "brake_d": steady * command,
            "brake_slow": slow * command,
        }

    def on_tyres(self, model: str) -> "Car":
        """The same car on tyres of this model: its own, or saturating ones in place of linear ones.

        InputError for linear tyres in place of others.
        """
        tyres = self.true_tyres
        if tyres.model == model:
            return self
        if not isinstance(tyres, LinearTyres):
            raise InputError(
                f"the car '{self.name}' has {tyres.model} tyres: write a car's file with the "
                f"numbers of {model} ones"
            )
        saturating = tyres.saturating(self.lf_m, self.lr_m, self.mass_kg)
        return self.model_copy(update={"tyres": saturating})

    def digest(self) -> str:
        """Short identity of the values that shape the models (not name, outline, grip, tuning)."""
        shape: dict[str, Any] = {name: getattr(self, name) for name in BODY}
        for part in (self.tyres, self.drive):
            shape |= {} if part is None else part.model_dump(exclude={"model"})
        shape |= {name: getattr(self, name) for name in ACTUATORS}
        return hashlib.sha256(to_json(shape)).hexdigest()[:12]

    @property
    def identity(self) -> str:
        """Name and digest, as weights, manifests and racing lines name a car."""
        return f"{self.name}-{self.digest()}"


SECTIONS: Final[dict[str, tuple[str, ...]]] = {
    "geometry": ("lf_m", "lr_m", "mass_kg", "inertia_kgm2", "width_m", "length_m"),
    "limits": (
        *("d_min", "d_max", "delta_max_rad", "delta_rate_max_radps"),
        *("friction", "brake_fade_mps"),
    ),
    "tracks": ("train_track", "race_track"),
    "learning": ("mirrored_samples",),
}
"""Section of a car's file to the fields of Car in it."""

MODELS: Final[dict[str, dict[str, type[Part]]]] = {
    "tyres": {"pacejka": PacejkaTyres, "linear": LinearTyres},
    "drive": {"dc_motor": DcMotor, "acceleration": AccelerationDrive},
}
"""Section with a ``model``, a field of Car as a whole, to what each model holds; a car on
unknown tyres lacks theirs."""

_ORDER: Final = ("geometry", "tyres", "drive", "limits", "tracks", "learning")

_TAGS: Final = frozenset(model for models in MODELS.values() for model in models)

_FOLDER: Final = Path(__file__).resolve().parents[1] / "cars"

_SUFFIX: Final = ".toml"

_REMEDY: Final = f"'bayesrace cars {DEFAULT_CAR} --out FILE.toml' writes one to start from"


@cache
def builtin_cars() -> dict[str, Car]:
    """The cars in ``bayesrace/cars``, by name."""
    cars = [read_car(path) for path in sorted(_FOLDER.glob(f"*{_SUFFIX}"))]
    return {car.name: car for car in cars}


def default_car() -> Car:
    """The car that is meant where none is named."""
    return get_car(DEFAULT_CAR)


def get_car(car: str | Path | Car) -> Car:
    """The built-in car of that name, or the car in that TOML file; a car is returned as it is.

    Raises InputError naming the built-in cars, or what is wrong with the file.
    """
    if isinstance(car, Car):
        return car
    if isinstance(car, Path) or car.endswith(_SUFFIX):
        return read_car(Path(car))
    return _builtin(car)


def _builtin(name: str) -> Car:
    cars = builtin_cars()
    if name in cars:
        return cars[name]
    raise InputError(
        f"unknown car '{name[:60]}'; built in: {', '.join(cars)}; name the file (*{_SUFFIX}) of "
        "any other car"
    )


def described_car(description: object) -> Car:
    """The car that settings, logs or samples describe: a built-in name, or all its values.

    ``description``: a name, or the values as mapping or as JSON text. It never names a file.
    Raises InputError for anything else.
    """
    try:
        if isinstance(description, str):
            if not description.startswith("{"):
                return _builtin(description)
            return Car.model_validate_json(description)
        return Car.model_validate(description)
    except ValidationError as error:
        faults = faults_in(error, "the car", Car, _TAGS)
    raise InputError(f"the car described there is unusable: {faults}")


def car_text(car: Car) -> str:
    """What :func:`described_car` reads: the name of a built-in car, else all values as JSON."""
    return car.name if builtin_cars().get(car.name) == car else car.model_dump_json()


CarSetting = Annotated[
    Car,
    BeforeValidator(lambda value: get_car(value) if isinstance(value, str | Path) else value),
    Field(description="car: built-in name or TOML file"),
    Option(default=DEFAULT_CAR),
]
"""Field of settings that accepts a name or a file and holds the whole car, as JSON does, too."""


def read_car(path: Path | str) -> Car:
    """The car in a TOML file.

    Raises InputError, one line that names file, field, value and meaning of every fault.
    """
    path = Path(path)
    text = read_text(path, "the car's file", f"{_REMEDY}; built-in cars have no suffix")
    content = parse_toml(text, path, _REMEDY)
    form: Any = _form()
    try:
        for section, models in MODELS.items():
            _check_model(section, models, content.get(section))
        values = form.model_validate(content).model_dump(exclude_unset=True)
        for section in SECTIONS:
            values |= values.pop(section, {})
        form = Car
        return Car.model_validate(values)
    except ValidationError as error:
        faults = faults_in(error, "the file", form, _TAGS)
    except InputError as error:
        faults = str(error)
    raise InputError(f"{path}: {faults}")


@cache
def _form() -> type[Part]:
    """A car's file; its tuning is checked with the whole car, whose size it depends on."""
    fields: dict[str, Any] = {
        name: (field.annotation, field) for name, field in Car.model_fields.items()
    }
    form = {name: fields[name] for name in ("name", *MODELS, "sensors")}
    for section, names in SECTIONS.items():
        model = create_model(section, __base__=Part, **{name: fields[name] for name in names})
        form[section] = model, Field({}, validate_default=True)
    return create_model("car", __base__=Part, tuning=(dict[str, Any], {}), **form)


def _check_model(section: str, models: Collection[str], given: Any) -> None:
    if given is None and section == "tyres":  # they are not known
        return
    chosen = given.get("model") if isinstance(given, dict) else None
    if chosen not in list(models):
        found = "is missing" if chosen is None else f"= {chosen!r} is unknown"
        raise InputError(
            f"{section}.model {found}; write model = {' or '.join(map(repr, models))} in "
            f"[{section}]"
        )


def write_car(
    path: Path | str,
    car: Car,
    remarks: Sequence[str] = (),
    sensor_remarks: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> None:
    """Writes remarks, and the car with all its values and their meaning, for :func:`read_car`.

    ``sensor_remarks``: what is said of each instrument, by its name.
    """
    parts = [(section, getattr(car, section, car)) for section in _ORDER]
    parts += [(f"tuning.{name}", part) for name, part in car.tuning]
    lines = [*(f"# {one}" for one in remarks), f'name = "{car.name}"']
    for section, part in parts:
        if part is None:  # tyres that are not known
            continue
        names = SECTIONS.get(section) or type(part).model_fields
        given = [name for name in names if getattr(part, name) is not None]
        lines += ["", f"[{section}]", *(_line(part, name) for name in given)]
    lines += sensor_lines(car.sensors, sensor_remarks)
    write_whole(Path(path), "\n".join(lines) + "\n")


def _line(model: BaseModel, name: str) -> str:
    value, about = getattr(model, name), type(model).model_fields[name].description
    if isinstance(value, BaseModel):
        text = ", ".join(f"{key} = {number!r}" for key, number in value)
        text = f"{{ {text} }}"
    else:
        text = json.dumps(value, ensure_ascii=False)
    return f"{name} = {text}" + (f"  # {about}" if about else "")
