"""The one exception type for bad input.

Every reader of files, messages, options and numbers raises :class:`InputError`; the command line
turns it into one line on stderr and exit code 2, so its message must name the thing and the remedy.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError

__all__ = ["InputError", "faults_in"]


class InputError(ValueError):
    """Something given from outside is unusable; the message names it and says what would help."""


def faults_in(error: "ValidationError", whole: str = "the content") -> str:
    """What is wrong with data that do not fit a pydantic model: field and fault of each, one line.

    ``whole``: the name of what has no field of its own, such as text that is no JSON.
    """
    return "; ".join(
        f"{'.'.join(str(part) for part in one['loc']) or whole}: "
        + one["msg"].removeprefix("Value error, ")  # what pydantic puts before our own words
        for one in error.errors()
    )
