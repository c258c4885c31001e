"""Messages for programs in C: a structure and a table of fields for each, from the message types.

The header goes with a controller's files (``host/br_messages.h``); ``controller/host/br_wire.h``
says what its tables mean. A type that it has no form for is a programming error.
"""

from typing import Any, Final, cast

from msgspec import Struct, inspect

from bayesrace.messages import (
    ACTUATION,
    BRAKING,
    QUANTITIES,
    SENSOR_FAULTS,
    STATE,
    TELEMETRY,
    Reading,
    Topic,
    schema_version,
)

__all__ = ["TOPICS_IN_C", "messages_header"]

TOPICS_IN_C: Final[tuple[Topic[Any], ...]] = (STATE, ACTUATION, BRAKING, TELEMETRY)
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
    names, faults = (", ".join(f'"{one}"' for one in of) for of in (QUANTITIES, SENSOR_FAULTS))
    low, high = _range(_plain(_fields(Reading)["values"].value_type.item_types[1])[0])
    parts = [
        _HEAD,
        f"#define BR_QUANTITY_NAMES {names}\n#define BR_SENSOR_FAULTS {faults}",
        f"#define BR_DEVIATION_LOW {low}\n#define BR_DEVIATION_HIGH {high}\n",
        _structure(Reading, "reading", 0),
    ]
    parts += [
        _structure(topic.message, topic.name, schema_version(topic.message))
        for topic in TOPICS_IN_C
    ]
    return "\n".join([*parts, "#endif\n"])


def _fields(kind: type[Struct]) -> dict[str, Any]:
    """Types of the fields by name, without their limits."""
    described = cast(inspect.StructType, inspect.type_info(kind))
    return {one.encode_name: _plain(one.type)[0] for one in described.fields}


def _plain(of: Any) -> tuple[Any, Any]:
    """A type without, and with, what is noted beside it."""
    return (of.type, of) if isinstance(of, inspect.Metadata) else (of, of)


def _range(number: Any) -> tuple[str, str]:
    low = number.ge if number.ge is not None else -1e300
    high = number.le if number.le is not None else 1e300
    return repr(float(low)), repr(float(high))


def _structure(kind: type[Struct], name: str, schema: int) -> str:
    """A structure br_NAME and its table BR_NAME."""
    structure = f"br_{name}_message"
    members, rows = [], []
    if len(_fields(kind)) > _MOST_FIELDS:
        raise ValueError(f"{name} has more than {_MOST_FIELDS} fields")
    for field, of in _fields(kind).items():
        declared, row = _field(field, of, structure)
        members += declared
        rows.append(row)
    table = f"br_{name}_fields"
    return "\n".join(
        [
            "typedef struct {",
            *(f"    {one};" for one in members),
            f"}} {structure};\n",
            f"static const br_wire_field {table}[] = {{",
            *(f"    {row}," for row in rows),
            "};",
            f"static const br_wire_table BR_{name.upper()}_TABLE __attribute__((unused)) = {{",
            f'    "{name}", {schema}, {len(rows)}, {table}, sizeof({structure})}};\n',
        ]
    )


_NUMBERS: Final = {inspect.IntType: ("int64_t", "WHOLE"), inspect.FloatType: ("double", "REAL")}


def _field(name: str, of: Any, structure: str) -> tuple[list[str], str]:
    """Its members of the structure, and its row of the table."""
    at, fixed = f"offsetof({structure}, {name})", "BR_FIXED"

    def row(kind: str, least: int, most: int, number: Any = None, counted: str = fixed) -> str:
        low, high = ("0", "0") if number is None else _range(number)
        records = "&BR_READING_TABLE" if kind == "RECORDS" else "NULL"
        return (
            f'{{"{name}", BR_{kind}, {at}, {counted}, {least}, {most}, {low}, {high}, {records}}}'
        )

    if isinstance(of, inspect.BoolType):
        return [f"int {name}"], row("FLAG", 1, 1)
    if isinstance(of, inspect.StrType):
        most = of.max_length or max(len(word) for word in _words(of.pattern or ""))
        return [f"char {name}[{4 * most + 1}]"], row("TEXT", 0, most)
    if isinstance(of, inspect.DictType):
        pair = cast(inspect.TupleType, of.value_type)
        value = _plain(pair.item_types[0])[0]
        return [f"br_measures {name}"], row("MEASURES", 1, len(QUANTITIES), value)
    if type(of) in _NUMBERS:
        declared, kind = _NUMBERS[type(of)]
        return [f"{declared} {name}"], row(kind, 1, 1, of)
    item = _plain(of.item_type)[0]
    least, most = of.min_length or 0, of.max_length
    counts = [] if least == most else [f"int {name}_count"]
    counted = f"offsetof({structure}, {name}_count)" if counts else fixed
    if isinstance(item, inspect.StructType):
        members = [*counts, f"br_reading_message {name}[{most}]"]
        return members, row("RECORDS", least, most, counted=counted)
    declared, kind = _NUMBERS[type(item)]
    members = [*counts, f"{declared} {name}[{most}]"]
    return members, row(f"{kind}S", least, most, item, counted)


def _words(pattern: str) -> list[str]:
    """The words that a text is limited to."""
    return pattern.removeprefix("^(?:").partition(")(?!")[0].split("|")
