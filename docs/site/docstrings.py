"""Extension of griffe: docstrings with roles of reStructuredText as Markdown with links.

``:class:`.Name`` becomes a link to what the name means where the docstring stands, or plain code if
the reference does not have it. A field of pydantic has its description as a docstring.
"""

import ast
import re
from contextlib import suppress
from functools import partial
from html import escape
from typing import Any, Final

import griffe

__all__ = ["Roles"]

_ROLE: Final = re.compile(r":(?:class|func|meth|attr|data|mod|exc):`([^`]+)`")
_PAGE: Final = re.compile(r"\bdocs/(\w+)\.md\b")


class Roles(griffe.Extension):
    """Rewrites all docstrings of the package."""

    def on_attribute(
        self, *, attr: griffe.Attribute, loader: griffe.GriffeLoader, **_: Any
    ) -> None:
        """Takes the description of a pydantic field from its call; hides what __init__ computes."""
        field = attr.value
        if attr.labels == {"instance-attribute"}:
            attr.value = None
        if not isinstance(field, griffe.ExprCall) or field.canonical_name not in ("Field", "field"):
            return
        attr.value = None
        for one in field.arguments:
            if isinstance(one, griffe.ExprKeyword) and one.name == "description":
                with suppress(ValueError):  # an f-string
                    text = ast.literal_eval(str(one.value))
                    attr.docstring = griffe.Docstring(f"{text[0].upper()}{text[1:]}.", parent=attr)

    def on_package(self, *, pkg: griffe.Module, loader: griffe.GriffeLoader, **_: Any) -> None:
        """Rewrites roles, now that names can be resolved, and names of pages."""
        for module in loader.modules_collection.members.values():
            _rewrite(module)


def _rewrite(obj: griffe.Object) -> None:
    if obj.docstring is not None:
        text = _ROLE.sub(partial(_link, obj), obj.docstring.value)
        obj.docstring.value = _PAGE.sub(r'<a href="../\1.html">docs/\1.md</a>', text)
    for member in obj.members.values():
        if isinstance(member, griffe.Object):
            _rewrite(member)


def _link(obj: griffe.Object, match: re.Match[str]) -> str:
    first, *rest = match[1].lstrip(".").split(".")
    try:
        found = ".".join([obj.resolve(first), *rest])
    except griffe.NameResolutionError:
        found = match[1]
    name = match[1].lstrip(".")
    return f'<autoref identifier="{escape(found)}" optional><code>{name}</code></autoref>'
