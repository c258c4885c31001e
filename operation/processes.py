"""Starting plant and controller as the processes a person would start, and ending them surely."""

import contextlib
import signal
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path

from bayesrace.interpreter import RUN_MODULE

__all__ = ["Child", "child", "endings"]

_PATIENCE_S = 3.0


class Child:
    """A running ``bayesrace`` subcommand, or other module, whose output goes to a file."""

    def __init__(self, arguments: list[str], output: Path, module: str = "operation.cli") -> None:
        self.output = output
        self._file = output.open("ab")
        self._process = subprocess.Popen(
            [*RUN_MODULE, module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=self._file,
            stderr=subprocess.STDOUT,
            # Ctrl-C at the terminal is for the starter, which ends its children in order
            start_new_session=True,
        )

    @property
    def pid(self) -> int:
        """Process number."""
        return self._process.pid

    def ended(self) -> str:
        """Why the process is not running any more, with its last message; "" while it runs."""
        code = self._process.poll()
        if code is None:
            return ""
        words = self.output.read_text(errors="replace").strip().splitlines()
        # A killed process had no time for a last message: that of its start would mislead.
        said = f": {words[-1]}" if words and code != -signal.SIGKILL else ""
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        return f"{how}{said}"

    def wait(self, timeout_s: float) -> bool:
        """Whether it ends by itself in that time."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def stop(self) -> None:
        """SIGTERM, and SIGKILL if it does not end."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._process.wait()
        self._file.close()


@contextlib.contextmanager
def child(arguments: list[str], output: Path, module: str = "operation.cli") -> Iterator[Child]:
    """A child process that does not outlive the block, however the block ends.

    With ``--parent-pid`` among the arguments it does not outlive this process either.
    """
    process = Child(arguments, output, module)
    try:
        yield process
    finally:
        process.stop()


def endings(children: Iterable[Child]) -> list[str]:
    """Of those that have ended, how."""
    return [f"{one.output.stem} {why}" for one in children if (why := one.ended())]
