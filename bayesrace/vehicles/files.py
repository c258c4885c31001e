"""Cars as TOML files, and the one way to any car: a built-in name or a file.

The file's sections are those of :data:`SECTIONS`, besides ``[tyres]`` and ``[drive]``, whose
``model`` says which values they hold (:mod:`.parts`), and ``[tuning.*]``, which a car needs none
of. Numbers are in SI units; their names, bounds and meanings are those of
:class:`~bayesrace.vehicles.parameters.CarParameters`.
"""

from collections.abc import Collection
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BaseModel, BeforeValidator, Field, ValidationError, create_model

from bayesrace.defaults import DEFAULT_CAR, Option
from bayesrace.errors import InputError, faults_in
from bayesrace.files import parse_toml, read_text, write_whole
from bayesrace.vehicles.parameters import CarParameters
from bayesrace.vehicles.parts import AccelerationDrive, DcMotor, LinearTyres, PacejkaTyres, Part
from bayesrace.vehicles.tuning import Tuning

__all__ = [
    "DEFAULT_CAR",
    "CarSetting",
    "builtin_cars",
    "car_text",
    "default_car",
    "described_car",
    "get_car",
    "read_car",
    "write_car",
]

SECTIONS: Final[dict[str, tuple[str, ...]]] = {
    "geometry": ("lf_m", "lr_m", "mass_kg", "inertia_kgm2", "width_m", "length_m"),
    "limits": (
        *("d_min", "d_max", "delta_max_rad", "delta_rate_max_radps"),
        *("friction", "brake_fade_mps"),
    ),
    "tracks": ("train_track", "race_track"),
    "learning": ("mirrored_samples",),
}
"""Section of a car's file to the fields of CarParameters in it."""

MODELS: Final[dict[str, dict[str, type[Part]]]] = {
    "tyres": {"pacejka": PacejkaTyres, "linear": LinearTyres},
    "drive": {"dc_motor": DcMotor, "acceleration": AccelerationDrive},
}
"""Section with a ``model``, a field of CarParameters as a whole, to what each model holds."""

_ORDER: Final = ("geometry", "tyres", "drive", "limits", "tracks", "learning")

_TAGS: Final = frozenset(model for models in MODELS.values() for model in models)

_FOLDER: Final = Path(__file__).resolve().parents[1] / "cars"

_SUFFIX: Final = ".toml"

_REMEDY: Final = f"'bayesrace cars {DEFAULT_CAR} --out FILE.toml' writes one to start from"


@cache
def builtin_cars() -> dict[str, CarParameters]:
    """The cars in ``bayesrace/cars``, by name."""
    cars = [read_car(path) for path in sorted(_FOLDER.glob(f"*{_SUFFIX}"))]
    return {car.name: car for car in cars}


def default_car() -> CarParameters:
    """The car that is meant where none is named."""
    return get_car(DEFAULT_CAR)


def get_car(car: str | Path | CarParameters) -> CarParameters:
    """The built-in car of that name, or the car in that TOML file; a car is returned as it is.

    Raises InputError naming the built-in cars, or what is wrong with the file.
    """
    if isinstance(car, CarParameters):
        return car
    if isinstance(car, Path) or car.endswith(_SUFFIX):
        return read_car(Path(car))
    return _builtin(car)


def _builtin(name: str) -> CarParameters:
    cars = builtin_cars()
    if name in cars:
        return cars[name]
    raise InputError(
        f"unknown car '{name[:60]}'; built in: {', '.join(cars)}; name the file (*{_SUFFIX}) of "
        "any other car"
    )


def described_car(description: object) -> CarParameters:
    """The car that settings, logs or samples describe: a built-in name, or all its values.

    ``description``: a name, or the values as mapping or as JSON text. It never names a file.
    Raises InputError for anything else.
    """
    try:
        if isinstance(description, str):
            if not description.startswith("{"):
                return _builtin(description)
            return CarParameters.model_validate_json(description)
        return CarParameters.model_validate(description)
    except ValidationError as error:
        faults = faults_in(error, "the car", CarParameters, _TAGS)
    raise InputError(f"the car described there is unusable: {faults}")


def car_text(car: CarParameters) -> str:
    """What :func:`described_car` reads: the name of a built-in car, else all values as JSON."""
    return car.name if builtin_cars().get(car.name) == car else car.model_dump_json()


def _setting(value: Any) -> Any:
    return get_car(value) if isinstance(value, str | Path) else value


CarSetting = Annotated[
    CarParameters,
    BeforeValidator(_setting),
    Field(description="car: built-in name or TOML file"),
    Option(default=DEFAULT_CAR),
]
"""Field of settings that accepts a name or a file and holds the whole car, as JSON does, too."""


def read_car(path: Path | str) -> CarParameters:
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
        form = CarParameters
        return CarParameters.model_validate(values)
    except ValidationError as error:
        faults = faults_in(error, "the file", form, _TAGS)
    except InputError as error:
        faults = str(error)
    raise InputError(f"{path}: {faults}")


@cache
def _form() -> type[Part]:
    """A car's file; its tuning is checked with the whole car, whose size it depends on."""
    fields: dict[str, Any] = {
        name: (field.annotation, field) for name, field in CarParameters.model_fields.items()
    }
    form = {name: fields[name] for name in ("name", *MODELS)}
    for section, names in SECTIONS.items():
        model = create_model(section, __base__=Part, **{name: fields[name] for name in names})
        form[section] = model, Field({}, validate_default=True)
    return create_model("car", __base__=Part, tuning=(dict[str, Any], {}), **form)


def _check_model(section: str, models: Collection[str], given: Any) -> None:
    chosen = given.get("model") if isinstance(given, dict) else None
    if chosen not in list(models):
        found = "is missing" if chosen is None else f"= {chosen!r} is unknown"
        raise InputError(
            f"{section}.model {found}; write model = {' or '.join(map(repr, models))} in "
            f"[{section}]"
        )


def write_car(path: Path | str, car: CarParameters) -> None:
    """Writes the car with all its values, each with its meaning; :func:`read_car` reads it."""
    lines = [f'name = "{car.name}"']
    for section in _ORDER:
        lines += ["", f"[{section}]"]
        if section in MODELS:
            part = getattr(car, section)
            lines.append(f'model = "{part.model}"')
            lines += [_line(part, name) for name in type(part).model_fields if name != "model"]
        else:
            lines += [_line(car, name) for name in SECTIONS[section]]
    for name in Tuning.model_fields:
        part = getattr(car.tuning, name)
        lines += ["", f"[tuning.{name}]"]
        lines += [_line(part, field) for field in type(part).model_fields]
    write_whole(Path(path), "\n".join(lines) + "\n")


def _line(model: BaseModel, name: str) -> str:
    value = getattr(model, name)
    if isinstance(value, BaseModel):
        text = ", ".join(f"{key} = {number!r}" for key, number in value)
        text = f"{{ {text} }}"
    elif isinstance(value, str):
        text = f'"{value}"'
    elif isinstance(value, bool):
        text = str(value).lower()
    else:
        text = repr(value)
    return f"{name} = {text}  # {type(model).model_fields[name].description}"
