"""Types of NumPy arrays, named by what they hold; shapes and units are in the docstrings."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["AnyArray", "Flags", "Floats", "Rows"]

Floats = NDArray[np.float64]
"""Real numbers in double precision."""

Rows = NDArray[np.int64]
"""Indices of samples, or the number of the group that each sample belongs to."""

Flags = NDArray[np.bool_]
"""A mask, one flag for each sample."""

AnyArray = NDArray[Any]
"""Unchecked content, such as that of a file."""
