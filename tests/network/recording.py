"""A recorder of a car in a process of its own.

    python -m tests.network.recording LOG ENDPOINT...

records, prints a line once something has come, and waits to be stopped or killed.
"""

import sys
import time
from pathlib import Path

from bayesrace.recorder import Recorder
from bayesrace.transport import Endpoints, open_session

if __name__ == "__main__":
    log, *where = sys.argv[1:]
    with (
        open_session(Endpoints(connect=tuple(where)), "viewer", peers_follow=True) as session,
        Recorder(session, "orca", Path(log)) as recorder,
    ):
        while not recorder.counters.written:
            time.sleep(0.05)
        sys.stdout.write("recording\n")
        sys.stdout.flush()
        time.sleep(1e4)
