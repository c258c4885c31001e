"""The one exception type for bad input.

Every reader of files, messages, options and numbers raises :class:`InputError`; the command line
turns it into one line on stderr and exit code 2, so its message must name the thing and the remedy.
"""

__all__ = ["InputError"]


class InputError(ValueError):
    """Something given from outside is unusable; the message names it and says what would help."""
