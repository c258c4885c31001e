"""Structures of the native library read and written at once: the same as field by field."""

import ctypes as ct
import struct
from typing import Any

import pytest

from controller.native_library import Layout

FIELDS: list[tuple[str, Any]] = [
    ("phase", ct.c_int),
    ("seq", ct.c_int64),
    ("x", ct.c_double * 3),
    ("lockstep", ct.c_int),
    ("delays", ct.c_double * 4),
]


class Structure(ct.Structure):
    """Types, paddings and arrays like those of the library."""

    _fields_ = FIELDS


def test_all_fields_are_read_by_name_arrays_number_by_number() -> None:
    structure = Structure(3, -(2**62), (0.1, -2.0, 5e-324), 1, (1.0, 2.0, 3.0, 4.0))
    values = Layout(Structure, "delays").read(structure)
    assert (values.phase, values.seq, values.lockstep) == (3, -(2**62), 1)
    assert [values.x0, values.x1, values.x2] == list(structure.x)
    assert values[-4:] == tuple(structure.delays)


def test_what_is_written_at_once_is_where_the_library_looks_and_the_rest_stays() -> None:
    structure = Structure(delays=(9.0, 8.0, 7.0, 6.0))
    Layout(Structure, "lockstep").write(structure, 0, 2, 2**62, 0.1, 0.2, 0.3, True)
    assert (structure.phase, structure.seq, structure.lockstep) == (2, 2**62, 1)
    assert list(structure.x) == [0.1, 0.2, 0.3]
    assert list(structure.delays) == [9.0, 8.0, 7.0, 6.0]


@pytest.mark.parametrize("values", [(1, 2, 0.1, 0.2, 1), (1, 2**63, 0.1, 0.2, 0.3, 1)])
def test_too_few_values_or_too_large_ones_are_an_error(values: tuple[Any, ...]) -> None:
    with pytest.raises(struct.error):
        Layout(Structure, "lockstep").write(Structure(), 0, *values)
