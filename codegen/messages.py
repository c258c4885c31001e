"""Messages for programs in C: a structure and a table of fields for each, from the message types.

The header goes with a controller's files (``host/br_messages.h``); ``controller/host/br_wire.h``
says what its tables mean. A type that it has no form for is a programming error.
"""

from dataclasses import dataclass, field
from typing import Any, Final, cast

from msgspec import Struct, inspect

from bayesrace.messages import (
    ACTUATION,
    BRAKING,
    COMMAND,
    QUANTITIES,
    STATE,
    TELEMETRY,
    UPDATE,
    UPDATED,
    LinkTopic,
    Reading,
    Service,
    Topic,
    message_of,
    schema_version,
)

__all__ = ["TOPICS_IN_C", "messages_header"]

TOPICS_IN_C: Final[tuple[Topic[Any] | Service[Any, Any] | LinkTopic, ...]] = (
    STATE, COMMAND, UPDATE, ACTUATION, BRAKING, TELEMETRY, UPDATED,
)  # fmt: skip
"""What a controller in C receives and sends."""

_HEAD: Final = """/* generated from bayesrace/messages: what a controller in C receives and sends */
#ifndef BR_MESSAGES_H
#define BR_MESSAGES_H

#include "br_wire.h"
"""


_MOST_FIELDS: Final = 64
"""Of a message, which the reader in C notes as bits."""


def messages_header() -> str:
    """The text of br_messages.h."""
    names = ", ".join(f'"{name}"' for name in QUANTITIES)
    low, high = _range(_plain(_fields(Reading)["values"].value_type.item_types[1]))
    parts = [
        _HEAD,
        f"#define BR_QUANTITY_NAMES {names}",
        f"#define BR_DEVIATION_LOW {low}\n#define BR_DEVIATION_HIGH {high}\n",
        _structure(Reading, "reading", 0),
    ]
    parts += [
        _structure(message_of(topic), topic.name, schema_version(message_of(topic)))
        for topic in TOPICS_IN_C
    ]
    return "\n".join([*parts, "#endif\n"])


def _fields(kind: type[Struct]) -> dict[str, Any]:
    """Types of the fields by name, without their limits."""
    described = cast(inspect.StructType, inspect.type_info(kind))
    return {one.encode_name: _plain(one.type) for one in described.fields}


def _plain(of: Any) -> Any:
    """A type without what is noted beside it."""
    return of.type if isinstance(of, inspect.Metadata) else of


def _range(number: Any) -> tuple[str, str]:
    low = number.ge if number.ge is not None else -1e300
    high = number.le if number.le is not None else 1e300
    return repr(float(low)), repr(float(high))


def _structure(kind: type[Struct], name: str, schema: int) -> str:
    """A structure br_NAME_message and its table BR_NAME_TABLE; the words of its field FIELD, which
    is one of them, are br_NAME_FIELD."""
    fields = {field: _field(field, of) for field, of in _fields(kind).items()}
    if len(fields) > _MOST_FIELDS:
        raise ValueError(f"{name} has more than {_MOST_FIELDS} fields")
    structure, table = f"br_{name}_message", f"br_{name}_fields"
    members = [f"    {member};" for one in fields.values() for member in one.members]
    rows = [f"    {one.row(field, name)}," for field, one in fields.items()]
    return "\n".join(
        [
            "typedef struct {", *members, f"}} {structure};\n",
            *(_words_in_c(f"br_{name}_{field}", one.words) for field, one in fields.items()),
            f"static const br_wire_field {table}[] = {{", *rows, "};",
            f"static const br_wire_table BR_{name.upper()}_TABLE __attribute__((unused)) = {{",
            f'    "{name}", {schema}, {len(rows)}, {table}, sizeof({structure})}};\n',
        ]
    )  # fmt: skip


def _words_in_c(name: str, words: list[str]) -> str:
    listed = "".join(f'"{word}", ' for word in words)
    return f"static const char *const {name}[] = {{{listed}NULL}};\n" if words else ""


@dataclass(frozen=True)
class _Field:
    """``members`` of the structure, and what its row of the table says (br_wire.h)."""

    members: list[str]
    kind: str
    least: int = 1
    most: int = 1
    number: Any = None
    words: list[str] = field(default_factory=list)

    def row(self, name: str, message: str) -> str:
        """The row of the field of this name."""
        structure = f"br_{message}_message"
        low, high = ("0", "0") if self.number is None else _range(self.number)
        counted = f"offsetof({structure}, {name}_count)" if len(self.members) > 1 else "BR_FIXED"
        records = "&BR_READING_TABLE" if self.kind == "RECORDS" else "NULL"
        words = f"br_{message}_{name}" if self.words else "NULL"
        at = f"offsetof({structure}, {name})"
        limits = f"{self.least}, {self.most}, {low}, {high}"
        return f'{{"{name}", BR_{self.kind}, {at}, {counted}, {limits}, {records}, {words}}}'


_NUMBERS: Final = {inspect.IntType: ("int64_t", "WHOLE"), inspect.FloatType: ("double", "REAL")}


def _field(name: str, of: Any) -> _Field:
    if isinstance(of, inspect.BoolType):
        return _Field([f"int {name}"], "FLAG")
    if isinstance(of, inspect.StrType):
        words = _words(of.pattern) if of.pattern else []
        most = of.max_length or max(map(len, words))
        return _Field([f"char {name}[{4 * most + 1}]"], "TEXT", 0, most, words=words)
    if isinstance(of, inspect.BytesType):
        members = [f"int {name}_count", f"uint8_t {name}[{of.max_length}]"]
        return _Field(members, "BYTES", 0, of.max_length or 0)
    if isinstance(of, inspect.DictType):
        pair = cast(inspect.TupleType, of.value_type)
        value = _plain(pair.item_types[0])
        return _Field([f"br_measures {name}"], "MEASURES", 1, len(QUANTITIES), value)
    if type(of) in _NUMBERS:
        declared, kind = _NUMBERS[type(of)]
        return _Field([f"{declared} {name}"], kind, number=of)
    item, least, most = _plain(of.item_type), of.min_length or 0, of.max_length
    counts = [] if least == most else [f"int {name}_count"]
    if isinstance(item, inspect.StructType):
        return _Field([*counts, f"br_reading_message {name}[{most}]"], "RECORDS", least, most)
    declared, kind = _NUMBERS[type(item)]
    return _Field([*counts, f"{declared} {name}[{most}]"], f"{kind}S", least, most, item)


def _words(pattern: str) -> list[str]:
    """The words that a text is limited to."""
    return pattern.removeprefix("^(?:").partition(")(?!")[0].split("|")
