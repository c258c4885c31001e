"""Options of a command made of fields of its settings model: name, type, bounds, default, help.

:func:`options_of` names model and fields; the command then takes ``settings``, a :class:`Given`.
The model is imported when the command is called or explained, not for the list of all commands.
"""

import operator
import re
from collections.abc import Callable, Mapping
from importlib import import_module
from inspect import Parameter
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, Final, Generic, TypeVar, get_args, get_origin

import typer

from bayesrace.errors import InputError, faults_in
from bayesrace.option import Option

if TYPE_CHECKING:
    from pydantic import BaseModel

__all__ = ["Given", "SettingsOptions", "inner_type", "keyword", "metavar", "options_of"]

Command = TypeVar("Command", bound=Callable[..., None])
Settings = TypeVar("Settings", bound="BaseModel")

SettingsFile = Annotated[
    Path | None,
    typer.Option(
        "--settings",
        metavar="FILE",
        help="Settings of an earlier run (its settings.json); options that are given override it.",
    ),
]
_UNITS: Final = {"s": "s", "m": "m", "hz": "Hz", "mps": "m/s"}
_UNIT: Final = re.compile(f"(.+?)(?:_({'|'.join(_UNITS)}))?$")
"""Name of a field, without its unit, and the unit."""
_marked: Final[dict[Callable[..., None], tuple[str, str, bool]]] = {}


def options_of(model: str, fields: str, *, file: bool = False) -> Callable[[Command], Command]:
    """Marks a command whose ``settings`` are of a model, ``module.Class``.

    ``fields``: those that are options, in the order of the help: ``field``, ``inner.field``, or
    ``field=--flag`` where the flag is this command's own. ``file``: with ``--settings``.
    """

    def marked(command: Command) -> Command:
        _marked[command] = model, fields, file
        return command

    return marked


def keyword(name: str, kind: Any, default: Any = Parameter.empty) -> Parameter:
    """A parameter of the function that Typer calls."""
    return Parameter(name, Parameter.KEYWORD_ONLY, annotation=kind, default=default)


def metavar(kind: Any, flag: str) -> str | None:
    """By the type of a value, or the last word of the flag; None for switches."""
    known = {Path: "FILE", int: "N", float: "X", bool: None}
    return known.get(kind, re.split("[-_]", flag)[-1].upper())


def inner_type(kind: Any) -> Any:
    """Of an optional value or a list."""
    several = NoneType in get_args(kind) or get_origin(kind) in (list, tuple)
    return inner_type(get_args(kind)[0]) if several else kind


class FieldOption:
    """One field as an option; what does not follow from the field is its :class:`Option`.

    The end of a description, "; None: …" or "; empty: …", is the default in words. A field that is
    true by default is switched off, so its description is an infinitive.
    """

    def __init__(self, model: Any, place: str) -> None:
        default: Any
        where, _, flag = place.partition("=")
        *outer, name = self.path = where.split(".")
        for one in outer:
            model = model.model_fields[one].annotation
        field, (stem, unit) = model.model_fields[name], _UNIT.findall(name)[0]
        own = next((one for one in field.metadata if isinstance(one, Option)), Option())
        kind, default = inner_type(field.annotation), own.default or field.get_default()
        text, *words = re.split("; (?:None|empty): ", field.description or "")
        flag = flag or own.flag or f"--{stem.replace('_', '-')}"
        self.value: Callable[[Any], Any] = lambda given: given
        several = get_origin(field.annotation) is tuple
        if kind is bool and default:
            flag, text, default = flag.replace("--", "--no-"), f"do not {text}", False
            self.value = operator.not_
        elif "=" in own.metavar:
            several, text, kind = True, f"{text}: {', '.join(kind.model_fields)}", str
            self.value = lambda given: _pairs(given, f"{flag}: give {own.metavar}")
        elif hasattr(kind, "model_fields"):
            kind = str
        elif own.unit:
            default *= own.per_unit
            self.value = lambda given: given / own.per_unit
        bounds = {
            limit: own.per_unit * getattr(one, bound)
            for limit, bound in (("min", "ge"), ("max", "le"), ("above", "gt"), ("below", "lt"))
            for one in field.metadata
            if hasattr(one, bound)
        }
        unit = own.unit or _UNITS.get(unit, "")
        text = f"{text[0].upper()}{text[1:]}"
        text += f" [{unit}]" if unit and f"[{unit}]" not in text else ""
        # Typer has no bounds that are themselves excluded.
        text += "".join(f" ({at} {bounds.pop(at):g})" for at in ("above", "below") if at in bounds)
        text += "; repeatable." if several else "."
        shown = own.metavar or unit.upper() or metavar(kind, flag)
        option = typer.Option(
            flag, metavar=shown, show_default=words[0] if words else True, help=text, **bounds
        )
        listed: Any = list[kind] if several else kind  # type: ignore[valid-type]
        kind = kind if kind is bool else listed | None
        self.flag, self.name = flag, "_".join(self.path)
        self.parameter = keyword(self.name, Annotated[kind, option], None if words else default)


def _pairs(given: list[str], remedy: str) -> dict[str, str]:
    if wrong := [one for one in given if "=" not in one]:
        raise InputError(f"{remedy}, not {wrong[0]}")
    return dict(one.split("=", 1) for one in given)


class SettingsOptions:
    """The options of a command's settings."""

    def __init__(self, model: str, fields: str, file: bool) -> None:
        module, _, name = model.rpartition(".")
        self._model = getattr(import_module(module), name)
        self._fields = [FieldOption(self._model, one) for one in fields.split()]
        self.parameters = [one.parameter for one in self._fields]
        """Of the function that Typer calls."""
        self.parameters += [keyword("context", typer.Context)]
        self.parameters += [keyword("settings_file", SettingsFile, None)] if file else []

    @classmethod
    def of(cls, command: Callable[..., None]) -> "SettingsOptions | None":
        """Those of a command that :func:`options_of` marks."""
        return cls(*_marked[command]) if command in _marked else None

    def given(self, values: dict[str, Any]) -> "Given[Any]":
        """What was typed of them, taken out of the values of all options."""
        file, context = values.pop("settings_file", None), values.pop("context")
        sources = {one: context.get_parameter_source(one.name) for one in self._fields}
        all_ = {one: values.pop(one.name) for one in self._fields}
        typed = {one: all_[one] for one, how in sources.items() if how.name == "COMMANDLINE"}
        return Given(self._model, file, typed)


class Given(Generic[Settings]):
    """What the command line says of settings; called with what the command says, it makes them."""

    def __init__(
        self, model: type[Settings], file: Path | None, typed: Mapping[FieldOption, Any]
    ) -> None:
        self._model, self._file, self._typed = model, file, typed

    @property
    def flags(self) -> list[str]:
        """What was typed of them."""
        return [one.flag for one in self._typed]

    def __call__(self, beneath: Mapping[str, Any] | None = None, **above: Any) -> Settings:
        """The settings: ``beneath``, overridden by the file, by the options, and by ``above``."""
        from pydantic import ValidationError

        content = {**(beneath or {}), **self._content_of_file()}
        for option, given in self._typed.items():
            inner = content
            for name in option.path[:-1]:
                inner = inner.setdefault(name, {})
            inner[option.path[-1]] = option.value(given)
        try:
            return self._model.model_validate({**content, **above})
        except ValidationError as error:
            flags = {".".join(one.path): one.flag for one in self._typed}
            raise InputError(faults_in(error, "settings", self._model, names=flags)) from None

    def _content_of_file(self) -> dict[str, Any]:
        from pydantic import ValidationError

        from bayesrace.files import read_text

        if self._file is None:
            return {}
        text = read_text(self._file, "settings", "give the settings.json of a run")
        try:
            return self._model.model_validate_json(text).model_dump()
        except ValidationError as error:
            raise InputError(f"{self._file}: {faults_in(error, 'the file', self._model)}") from None
