"""A director that links anew for each line of stdin, and prints how many seconds that took.

BAYESRACE_CONFIG=FILE python -m tests.security.newcomer ENDPOINT
"""

import sys
import time
from typing import Final

from bayesrace.configuration import configured
from bayesrace.transport import open_session

__all__: list[str] = []

_MOST_S: Final = 10.0
"""So long it waits for a link."""


def main(endpoint: str) -> None:
    """Links until the end of stdin."""
    endpoints = configured().endpoints("director", connect=(endpoint,))
    print("ready", flush=True)  # noqa: T201
    for _ in sys.stdin:
        begin_s = time.monotonic()
        with open_session(endpoints, "director", reports_absence=False) as session:
            while not session.info.links() and time.monotonic() - begin_s < _MOST_S:
                time.sleep(0.005)
            print(time.monotonic() - begin_s, flush=True)  # noqa: T201


if __name__ == "__main__":
    main(*sys.argv[1:])
