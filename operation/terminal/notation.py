"""How tables and figures name what was learned, and where they call it uncertain."""

from typing import Final

__all__ = ["SMOOTHNESS", "SYMBOLS", "UNCERTAIN"]

SYMBOLS: Final = {"vx": "vx", "vy": "vy", "omega": "ω"}
"""Outputs in figures."""

SMOOTHNESS: Final = {"matern05": "1/2", "matern15": "3/2", "matern25": "5/2", "rbf": "∞"}
"""Kernels from rough to smooth, and their nu."""

UNCERTAIN: Final = 0.25
"""The paper marks where the largest of the three standard deviations is above this."""
