"""Cars as TOML files, and the one way to any car: a built-in name or a file.

The file's sections are those of :data:`SECTIONS`, besides ``[tyres]`` and ``[drive]``, whose
``model`` says which values they hold (:mod:`.parts`), and ``[tuning.*]``, which a car needs none
of. Numbers are in SI units; their names, bounds and meanings are those of
:class:`~bayesrace.vehicles.parameters.CarParameters`.
"""

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BaseModel, BeforeValidator, Field, ValidationError

from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError, fault_in_words
from bayesrace.files import parse_toml, read_text, write_whole
from bayesrace.option import Option
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
        raise InputError(f"the car described there is unusable: {_faults(error)}") from None


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

    Raises InputError, one line that names file, field, value, unit and remedy of every fault.
    """
    path = Path(path)
    text = read_text(path, "the car's file", f"{_REMEDY}; built-in cars have no suffix")
    content = parse_toml(text, path, _REMEDY)
    try:
        return CarParameters.model_validate(_flat(content))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except ValidationError as error:
        raise InputError(f"{path}: {_faults(error)}") from None


def _flat(content: Mapping[str, Any]) -> dict[str, Any]:
    """The file's values by the names of CarParameters."""
    _only(content, ("name", *_ORDER, "tuning"), "")
    values = {name: content[name] for name in ("name", "tuning") if name in content}
    for section in _ORDER:
        given = content.get(section, {})
        if not isinstance(given, dict):
            raise InputError(f"{section} = {given!r} is no section; write [{section}]")
        if section in MODELS:
            _check_model(section, given)
            values[section] = given
        else:
            _only(given, SECTIONS[section], section)
            values |= given
    return values


def _check_model(section: str, given: Mapping[str, Any]) -> None:
    models, chosen = MODELS[section], given.get("model")
    if not isinstance(chosen, str) or chosen not in models:
        found = "is missing" if chosen is None else f"= {chosen!r} is unknown"
        raise InputError(
            f"{section}.model {found}; write model = "
            f"{' or '.join(repr(name) for name in models)} in [{section}]"
        )
    _only(given, tuple(models[chosen].model_fields), section)


def _only(given: Mapping[str, Any], names: tuple[str, ...], section: str) -> None:
    for name, value in given.items():
        if name not in names:
            place = f"{section}.{name}" if section else name
            where = f"[{section}]" if section else "a car's file"
            raise InputError(
                f"{place} = {str(value)[:40]} is unknown; {where} has {', '.join(names)}"
            )


def _faults(error: ValidationError) -> str:
    """All faults in one line, by the places of the file."""
    follow = "default_factory_not_called"  # values derived from those that have faults
    return "; ".join(_fault(one) for one in error.errors() if one["type"] != follow)


def _fault(one: Any) -> str:
    full = [str(part) for part in one["loc"]]
    loc = [full[0], *full[2:]] if full[0] in MODELS else full  # without the name of the model
    section = next((name for name, fields in SECTIONS.items() if loc[0] in fields), "")
    place = ".".join([*([section] if section else []), *loc])
    field = _field(full)
    text = (field.description or "") if field is not None else ""
    unit = re.search(r" \[([^]]*)\]$", text)
    meaning = text[: unit.start()] if unit else text
    units = "" if unit is None or unit[1] == "-" else f" {unit[1]}"
    table = ".".join([*([section] if section else []), *loc[:-1]])
    where = f"[{table}]" if table else "the first lines"
    if one["type"] == "missing":
        in_unit = f" in {units.strip()}" if units else ""
        return f"{place} is missing: {meaning}; add {loc[-1]} = NUMBER{in_unit} to {where}"
    if one["type"] == "extra_forbidden":
        known = _field(full[:-1]) if len(full) > 1 else None
        form: Any = known.annotation if known is not None else None
        names = ", ".join(form.model_fields) if _is_model(form) else ""
        return f"{place} = {str(one['input'])[:40]} is unknown; {where} has {names}"
    value = str(one["input"])[:40]
    return f"{place} = {value}{units}: {fault_in_words(one)}; correct it in {where} ({meaning})"


def _is_model(form: Any) -> bool:
    return isinstance(form, type) and issubclass(form, BaseModel)


def _field(loc: list[str]) -> Any:
    """The field of CarParameters, or below it, at a place; None for one that it does not have."""
    form: Any = CarParameters
    field = None
    if loc[0] in MODELS and len(loc) > 1:
        form, loc = MODELS[loc[0]].get(loc[1]), loc[2:]
    for part in loc:
        if not _is_model(form) or part not in form.model_fields:
            return None
        field = form.model_fields[part]
        form = field.annotation
    return field


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
