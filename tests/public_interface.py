"""What is public, as text: each name with its parameters, and those of its methods.

``python -m tests.public_interface`` writes the list that a test compares.
"""

import inspect
import re
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Final

import bayesrace as br

__all__ = ["LISTED", "described"]

_CALLED: Final = (FunctionType, classmethod, staticmethod)

_ATTRIBUTES: Final = re.compile(r"self\.([a-z]\w*)")

LISTED: Final = Path(__file__).with_name("public_interface.txt")


def described() -> str:
    """All names in order, a line each."""
    lines = []
    for name in sorted({*br.__all__, "gym", "testing"}):
        found = getattr(br, name)
        if isinstance(found, ModuleType):
            inner = {one: getattr(found, one) for one in sorted(found.__all__)}
            lines += [line for one in inner for line in _lines(f"{name}.{one}", inner[one])]
        else:
            lines += _lines(name, found)
    return "\n".join(lines) + "\n"


def _lines(name: str, found: Any) -> list[str]:
    if isinstance(found, type):
        return [f"{name}{_parameters(found)}", *_members(name, found)]
    return [f"{name}{_parameters(found)}" if callable(found) else name]


def _members(name: str, kind: type) -> list[str]:
    """Attributes that are defined in this package."""
    lines = []
    for one in kind.__mro__:
        if one.__module__.split(".")[0] == "bayesrace":
            set_by_init = dict.fromkeys(_ATTRIBUTES.findall(_source(one)))
            own = {**set_by_init, **getattr(one, "__annotations__", {}), **vars(one)}
            lines += [
                f"{name}.{key}{_parameters(value) if isinstance(value, _CALLED) else ''}"
                for key, value in own.items()
                if not key.startswith("_") and not key.startswith("model_")
            ]
    return sorted(set(lines))


def _source(kind: type) -> str:
    """Of its ``__init__``, what is left of each assignment."""
    init = vars(kind).get("__init__")
    if not inspect.isfunction(init):
        return ""
    try:
        lines = inspect.getsource(init).splitlines()
    except OSError:  # made by a decorator
        return ""
    return "\n".join(line.partition(" = ")[0] for line in lines if " = " in line)


def _parameters(found: Any) -> str:
    try:
        known = inspect.signature(getattr(found, "__func__", found)).parameters.values()
    except ValueError:
        return ""
    return f"({', '.join(one.name for one in known if one.name not in ('self', 'cls'))})"


if __name__ == "__main__":
    LISTED.write_text(described())
