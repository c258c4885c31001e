"""Any command as a process that ends with the one that started it, however that dies (Linux):

    python -m bayesrace.operation.command PID COMMAND [ARGUMENT ...]

PID is the starter's. The command takes the place of this process.
"""

import os
import sys

from bayesrace.processes import die_with_parent

if __name__ == "__main__":
    die_with_parent(int(sys.argv[1]))
    try:
        os.execvp(sys.argv[2], sys.argv[2:])  # noqa: S606 - it is the user's own command
    except OSError as error:
        sys.exit(f"{sys.argv[2]} cannot be started: {error.strerror}")
