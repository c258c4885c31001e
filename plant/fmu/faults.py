"""The failure of an FMU, or of another simulator, while it is the car."""

__all__ = ["FmuFault"]


class FmuFault(RuntimeError):  # noqa: N818 - the car failed, not this program
    """The simulated car crashed, hung, refused a step, gave an unusable value or ended the run.

    The message names it, what happened, when (plant time), and its last message. The input
    was not bad: the run ends, the plant process goes on.
    """
