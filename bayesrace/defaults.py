"""Names that options have by default; a module of its own, so that ``--help`` needs no other."""

from typing import Final

__all__ = ["CONFIGURATION_VARIABLE", "DEFAULT_CAR"]

CONFIGURATION_VARIABLE: Final = "BAYESRACE_CONFIG"
"""Environment variable that names the configuration."""

DEFAULT_CAR: Final = "orca"
"""Name of the car that is meant where none is named."""
