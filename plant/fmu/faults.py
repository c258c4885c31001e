"""What goes wrong with an FMU while it is the car."""

__all__ = ["CallFailed", "FmuFault"]


class FmuFault(RuntimeError):  # noqa: N818 - what befell the car, not an error of ours
    """The FMU crashed, hung, refused a step, gave an unusable value or ended the simulation.

    The message says which FMU, what happened, when (plant time) and the FMU's last words. It is
    no bad input: the run ends, the plant lives on.
    """


class CallFailed(Exception):  # noqa: N818
    """Within the FMU's process: it did not do what it was asked; the message says what."""
