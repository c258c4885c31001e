"""Kernels that the training chooses from."""

from typing import Final, Literal

__all__ = ["DEFAULT_KERNELS", "Kernel"]

Kernel = Literal["rbf", "matern05", "matern15", "matern25"]
"""As in :data:`bayesrace.gp.weights.KERNELS`."""

DEFAULT_KERNELS: Final[tuple[Kernel, ...]] = ("rbf", "matern25")
"""Candidates of which held-out errors choose one for each output."""
