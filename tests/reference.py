"""Finds the published reference data, which is for comparison only and never part of the project.

The folder is ``../shared/reference`` beside the checkout, or what ``BAYESRACE_REFERENCE`` names.
"""

import os
from pathlib import Path

import pytest

__all__ = ["reference_file"]

_ROOT = Path(
    os.environ.get(
        "BAYESRACE_REFERENCE", Path(__file__).resolve().parents[2] / "shared" / "reference"
    )
)


def reference_file(relative: str) -> Path:
    """Path of a reference file; skips the calling test where the data is absent."""
    path = _ROOT / relative
    if not path.is_file():
        pytest.skip(f"published reference data not present: {relative}")
    return path
