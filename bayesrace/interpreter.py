"""How this project starts its own Python programs."""

import sys
from typing import Final

__all__ = ["RUN_MODULE"]

RUN_MODULE: Final = (sys.executable, "-P", "-m")
"""Then the module and its arguments. -P: a file of the current folder that is called like a module
of ours, or of the standard library, is not imported."""
