"""What all parts of BayesRace share: cars, integrators, tracks, racing line, residual, messages."""

__all__ = ["__version__"]

__version__: str


def __getattr__(name: str) -> str:
    """The version, looked up when it is asked for: that takes longer than to print the help."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("bayesrace")
    except PackageNotFoundError:  # a source tree that was never installed
        return "0+unknown"
