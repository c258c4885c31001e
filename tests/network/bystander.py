"""Observers that hear everything of a car, as ``learn --watch`` does, and then stop reading.

    python -m tests.network.bystander COUNT BUNDLE ENDPOINT...

links COUNT sessions, each with a subscriber, prints a line and waits to be killed. BUNDLE: folder
of the certificate of secured links, or ``-``.
"""

import sys
import time
from contextlib import ExitStack
from pathlib import Path

import zenoh

from bayesrace.transport import Endpoints, open_session
from bayesrace.transport.credentials import Credentials

if __name__ == "__main__":
    count, bundle, *where = sys.argv[1:]
    credentials = None if bundle == "-" else Credentials.read(Path(bundle))
    endpoints = Endpoints(connect=tuple(where), credentials=credentials)
    with ExitStack() as sessions:
        heard = []
        for _ in range(int(count)):
            session = sessions.enter_context(open_session(endpoints, "viewer", peers_follow=True))
            heard.append(
                session.declare_subscriber("bayesrace/orca/**", zenoh.handlers.RingChannel(9))
            )
        while not all(one.handler.try_recv() for one in heard):
            time.sleep(0.05)
        sys.stdout.write("linked\n")
        sys.stdout.flush()
        time.sleep(1e4)
