"""The one exception type for bad input.

Every reader of files, messages, options and numbers raises :class:`InputError`; the command line
turns it into one line on stderr and exit code 2, so its message must name the thing and the remedy.
"""

import errno
import re
from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final, get_args

if TYPE_CHECKING:
    from pydantic import ValidationError

__all__ = ["PASSING", "InputError", "RestartError", "TransientError", "faults_in"]

_KINDS: Final = {
    "int": "a whole number", "float": "a number", "finite": "a finite number",
    "bool": "true or false", "string_type": "a text", "list": "a list", "tuple": "a list",
    "dict": "a table", "model": "a table", "path": "a path",
}  # fmt: skip
"""What pydantic's kinds of faults ask for, by the beginnings of their names."""


PASSING: Final = (
    errno.EAGAIN, errno.EDQUOT, errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM,
    errno.ENOSPC,
)  # fmt: skip
"""Errors of the system that is short of something now, and may not be later."""


class InputError(ValueError):
    """Something given from outside is unusable; the message names it and says what would help."""


class TransientError(InputError):
    """The same of something that may become usable without this process: an endpoint in use, a
    certificate that has expired or is not valid yet."""


class RestartError(InputError):
    """Ends a process that waits for such a thing when it is started again: exit code 75, temporary
    failure in ``sysexits.h``."""


def faults_in(
    error: "ValidationError",
    whole: str = "the content",
    form: Any = None,
    tags: Collection[str] = (),
    names: Mapping[str, str] | None = None,
) -> str:
    """What is wrong with data that do not fit a pydantic model: field, value and remedy, one line.

    ``whole``: the name of what has no field of its own, such as text that is no JSON. ``form``: the
    model, whose fields are named and explained. ``tags``: of unions, which are no part of a place.
    ``names``: of places that the user knows by others, such as options.
    """
    follow = "default_factory_not_called"  # values derived from those that have faults
    faults = (one for one in error.errors() if one["type"] != follow)
    return "; ".join(_fault(one, whole, form, tags, names or {}) for one in faults)


def _fault(one: Any, whole: str, form: Any, tags: Collection[str], names: Mapping[str, str]) -> str:
    loc = [part for part in one["loc"] if part not in ("[key]", *tags)]
    place, fields = ".".join(map(str, loc)) or whole, _fields(form, loc[:-1])
    for known, name in names.items():
        if f"{place}.".startswith(f"{known}."):
            place = f"{name}{place[len(known) :].replace('.', ' ')}"
    meaning = getattr(fields.get(loc[-1]) if loc else None, "description", None)
    about = f" ({meaning})" if meaning else ""
    if one["type"] == "value_error":  # our own words
        return f"{place}: {_in_words(one)}"
    if one["type"] == "missing":
        return f"{place} is missing: add it{about}"
    if one["type"] == "extra_forbidden":
        return f"unknown setting '{place}': {_instead(str(loc[-1]), fields)}"
    value = repr(one["input"])
    value = value if len(value) <= 40 else f"{value[:39]}…"
    return f"{place}{f' = {value}' if loc else ''}: {_in_words(one)}{about}"


def _in_words(one: Any) -> str:
    """The fault that one of pydantic's errors describes, in our words."""
    kind = next((words for kind, words in _KINDS.items() if one["type"].startswith(kind)), None)
    if kind is not None:
        return f"has to be {kind}"
    text = one["msg"].removeprefix("Value error, ").replace(" after validation", "")
    text = text.replace("Invalid JSON", "no JSON")
    return re.sub("^[A-Z][a-z]+ should ", "has to ", text)


def _instead(name: str, known: Iterable[str]) -> str:
    from difflib import get_close_matches

    if near := get_close_matches(name, known, 1):
        return f"did you mean '{near[0]}'?"
    return f"there are {', '.join(known)}" if known else "leave it out"


def _fields(form: Any, place: Iterable[Any]) -> Mapping[str, Any]:
    """The fields of a model's part, by their names."""
    models = _models(form)
    for part in place:
        inner = [one.model_fields[part] for one in models if part in one.model_fields]
        if inner:  # else it is a number in a list or a key
            models = [model for field in inner for model in _models(field.annotation)]
    return {
        field.alias or name: field for one in models for name, field in one.model_fields.items()
    }


def _models(form: Any) -> list[Any]:
    """Those that a type is made of."""
    if root := getattr(form, "model_fields", {}).get("root"):  # a table with any names
        return _models(root.annotation)
    if hasattr(form, "model_fields"):
        return [form]
    return [model for one in get_args(form) for model in _models(one)]
