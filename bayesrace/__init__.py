"""What all parts of BayesRace share: cars, integrators, tracks, racing line, residual, messages."""

from importlib.metadata import PackageNotFoundError, version

__all__ = ["__version__"]

try:
    __version__ = version("bayesrace")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
