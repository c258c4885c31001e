"""How commands are declared: by the fields of their settings model, which give options their name,
type, bounds, default and help, and by what they have of the configuration.

:func:`options_of` names model and fields; the command then takes ``settings``, a :class:`Given`.
The model is imported when the command is called or explained, not for the list of all commands.
"""

import functools
import inspect
import operator
import os
import re
from collections.abc import Callable, Mapping
from importlib import import_module
from inspect import Parameter
from pathlib import Path
from types import NoneType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Final,
    Generic,
    NamedTuple,
    TypeVar,
    get_args,
    get_origin,
)

import typer
from typer.models import OptionInfo

from bayesrace.defaults import CONFIGURATION_VARIABLE, Option
from bayesrace.errors import InputError, faults_in
from bayesrace.operation.cli.options import ENDPOINT, flag, value

if TYPE_CHECKING:
    from pydantic import BaseModel

    from bayesrace.configuration import Configuration
    from bayesrace.messages import Role

__all__ = ["Given", "Group", "configured", "options_of"]

Command = TypeVar("Command", bound=Callable[..., None])
Settings = TypeVar("Settings", bound="BaseModel")

_INSECURE: Final = flag(
    "--insecure",
    "Allow endpoints beyond loopback without certificates, where anyone could drive the car.",
)
_CONFIG: Final = value(
    "Configuration, as 'bayesrace config example' writes it.",
    None,
    "--config",
    metavar="FILE",
    shown=f"that of {CONFIGURATION_VARIABLE}, if any",
)
_SETTINGS: Final = value(
    "Settings of an earlier run (its settings.json); options that are given override it.",
    None,
    "--settings",
    metavar="FILE",
)
_ROLES: "Final[tuple[Role, ...]]" = ("director", "learning", "viewer")
_UNITS: Final = {"s": "s", "m": "m", "hz": "Hz", "mps": "m/s"}
_UNIT: Final = re.compile(f"(.+?)(?:_({'|'.join(_UNITS)}))?$")
"""Name of a field, without its unit, and the unit."""
_marked: Final[dict[Callable[..., None], tuple[str, str, bool]]] = {}


class Group(NamedTuple):
    """Commands below one name, as ``bayesrace certs add``."""

    help: str
    commands: Mapping[str, Callable[..., None]]


def options_of(model: str, fields: str, *, file: bool = False) -> Callable[[Command], Command]:
    """Marks a command whose ``settings`` are of a model, ``module.Class``.

    ``fields``: those that are options, in the order of the help: ``field``, ``inner.field``, or
    ``field=--flag`` where the flag is this command's own. ``file``: with ``--settings``.
    """

    def marked(command: Command) -> Command:
        _marked[command] = model, fields, file
        return command

    return marked


def configured(command: Callable[..., None]) -> Callable[..., None]:
    """The command as Typer calls it, with ``--config``, which the processes that it starts read.

    It may take ``settings``, if it is marked; ``configuration``; ``network``, the same with
    ``--insecure``; and, by the name of its role, the endpoints that it connects to.
    """
    model, fields, places = _settings_of(command)
    own = dict(inspect.signature(command).parameters)
    taken = [name for name in ("configuration", "network") if own.pop(name, None)]
    role = next((name for name in _ROLES if own.pop(name, None)), None)
    parameters = [
        one
        for name, parameter in own.items()
        for one in (places if model and name == "settings" else [_with_metavar(parameter)])
    ]
    parameters += [_keyword("endpoint", list[str], ENDPOINT)] if role else []
    parameters += [_keyword("insecure", bool, _INSECURE)] if role or "network" in taken else []
    parameters += [_keyword("config", Path | None, _CONFIG)]

    @functools.wraps(command)
    def run(config: Path | None, insecure: bool = False, **options: Any) -> None:
        from bayesrace.configuration import configured as configuration_of_process

        if config is not None:
            os.environ[CONFIGURATION_VARIABLE] = str(config.absolute())
        found = configuration_of_process()
        if insecure:
            network = found.network.model_copy(update={"insecure": True})
            found = found.model_copy(update={"network": network})
        if model is not None:
            sources = options.pop("context").get_parameter_source
            file = options.pop("settings_file", None)
            all_ = {one: options.pop(one.name) for one in fields}
            typed = {one: all_[one] for one in all_ if sources(one.name).name == "COMMANDLINE"}
            options["settings"] = Given(model, found, file, typed)
        if role is not None:
            options[role] = found.endpoints(role, connect=options.pop("endpoint"))
        command(**options, **dict.fromkeys(taken, found))

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in parameters}
    return run


def _settings_of(command: Callable[..., None]) -> "tuple[Any, list[_FieldOption], list[Parameter]]":
    """Model and options of a command that is marked, and how Typer reads them."""
    if command not in _marked:
        return None, [], []
    place, names, file = _marked[command]
    module, _, name = place.rpartition(".")
    model = getattr(import_module(module), name)
    fields = [_FieldOption(model, one) for one in names.split()]
    places = [*(one.parameter for one in fields), _keyword("context", typer.Context)]
    if file:
        places.append(_keyword("settings_file", Path | None, _SETTINGS))
    return model, fields, places


def _keyword(name: str, kind: Any, default: Any = Parameter.empty) -> Parameter:
    """A parameter of the function that Typer calls."""
    return Parameter(name, Parameter.KEYWORD_ONLY, annotation=kind, default=default)


def _with_metavar(parameter: Parameter) -> Parameter:
    """Of a command's own option, which may lack one."""
    option = parameter.default
    if isinstance(option, OptionInfo) and option.metavar is None:
        option.metavar = _metavar(_inner_type(parameter.annotation), parameter.name)
    return parameter.replace(kind=Parameter.KEYWORD_ONLY)


def _metavar(kind: Any, flag: str) -> str | None:
    """By the type of a value, or the last word of the flag; None for switches."""
    known = {Path: "FILE", int: "N", float: "X", bool: None}
    return known.get(kind, re.split("[-_]", flag)[-1].upper())


def _inner_type(kind: Any) -> Any:
    """Of an optional value or a list."""
    several = NoneType in get_args(kind) or get_origin(kind) in (list, tuple)
    return _inner_type(get_args(kind)[0]) if several else kind


class _FieldOption:
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
        kind, default = _inner_type(field.annotation), own.default or field.get_default()
        text, *words = re.split("; (?:None|empty): ", field.description or "")
        flag = flag or own.flag or f"--{stem.replace('_', '-')}"
        self.value: Callable[[Any], Any] = lambda given: given
        several = get_origin(field.annotation) is tuple
        if kind is bool and default:
            flag, text, default = flag.replace("--", "--no-"), f"do not {text}", False
            self.value = operator.not_
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
        shown = own.metavar or unit.upper() or _metavar(kind, flag)
        option = typer.Option(
            flag, metavar=shown, show_default=words[0] if words else True, help=text, **bounds
        )
        listed: Any = list[kind] if several else kind  # type: ignore[valid-type]
        kind = kind if kind is bool else listed | None
        self.flag, self.name = flag, "_".join(self.path)
        self.parameter = _keyword(self.name, Annotated[kind, option], None if words else default)


class Given(Generic[Settings]):
    """Makes the settings of a command when it is called. Later sources override earlier ones: the
    configuration, the file of ``--settings``, the options, and the arguments of the call."""

    def __init__(
        self,
        model: type[Settings],
        configuration: "Configuration",
        file: Path | None,
        typed: Mapping[_FieldOption, Any],
    ) -> None:
        self._model, self._configuration = model, configuration
        self._file, self._typed = file, typed

    @property
    def flags(self) -> list[str]:
        """What was typed of them."""
        return [one.flag for one in self._typed]

    def __call__(self, **above: Any) -> Settings:
        """The settings; InputError names what is wrong by the option that gives it."""
        from pydantic import ValidationError

        content: dict[str, Any] = {}
        if "realtime" in self._model.model_fields:
            content["realtime"] = self._configuration.realtime.model_dump()
        content |= self._content_of_file()
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
