"""Names that options have by default, bounds that several parts share, and what of an option does
not follow from its field of settings; a module of its own, so that ``--help`` needs no other.

An :class:`Option` stands beside the field, as ``delay_s: Annotated[float, Option(unit="ms",
per_unit=1000)]``; :mod:`bayesrace.operation.cli.declaration` makes options of fields.
"""

from dataclasses import dataclass
from typing import Final

__all__ = [
    "CONFIGURATION_VARIABLE", "DEFAULT_CAR", "HEARTBEAT_VARIABLE", "LEAST_LOSS_S", "MAX_POINTS",
    "MAX_WEIGHTS_BYTES", "PATH_ROWS", "POINTS", "Option",
]  # fmt: skip

CONFIGURATION_VARIABLE: Final = "BAYESRACE_CONFIG"
"""Environment variable that names the configuration."""

HEARTBEAT_VARIABLE: Final = "BAYESRACE_HEARTBEAT"
"""Environment variable that names the file of a process whose time each heartbeat renews."""

DEFAULT_CAR: Final = "orca"
"""Name of the car that is meant where none is named."""

MAX_POINTS: Final = 4096
"""Training points per output at most, so that weights with their samples are not too large."""

PATH_ROWS: Final = 8192
"""Rows of the racing line's table that a controller has room for."""

POINTS: Final = (400, 300, 200, 150, 100, 50)
"""Training points per output: by default, and what is tried where fewer may be enough."""

MAX_WEIGHTS_BYTES: Final = 1 << 20
"""Largest weights file, which is the largest message between processes."""

LEAST_LOSS_S: Final = 0.01
"""Least time a lap that is reported as lost where weights have learned too little."""


@dataclass(frozen=True)
class Option:
    """What of an option does not follow from its field."""

    flag: str = ""
    """Without: the field's name, without its unit."""
    metavar: str = ""
    """Without: the unit, or what kind of value it is."""
    unit: str = ""
    """Unit on the command line, if that is not the field's."""
    per_unit: float = 1
    """So many of :attr:`unit` are one of the field's."""
    default: str = ""
    """As it would be typed, where the field's own default cannot be."""
