"""A question to all others of a car, without waiting for those who are silent."""

import logging
import threading
from collections.abc import Callable, Sequence

__all__ = ["Questions"]

_log = logging.getLogger("bayesrace.controller")


class Questions:
    """One at a time, in a thread of its own; for one thread, which does not wait."""

    def __init__(self, fetch: Callable[[], Sequence[bytes]], told: Callable[[], None]) -> None:
        """``fetch``: waits for the answers of all. ``told``: called after each."""
        self._fetch, self._told = fetch, told
        self._thread: threading.Thread | None = None

    def ask(self, tell: Callable[[Sequence[bytes]], None]) -> None:
        """Asks; ``tell`` is called with the answers, once, in the other thread."""
        self.close()
        self._thread = threading.Thread(target=self._run, args=(tell,), name="question")
        self._thread.start()

    def close(self) -> None:
        """Waits for the answers under way: as long as the service allows at most."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self, tell: Callable[[Sequence[bytes]], None]) -> None:
        answers: Sequence[bytes] = ()
        try:
            answers = self._fetch()
        except Exception:  # whoever asks waits for an end of it
            _log.exception("the others of this car cannot be asked")
        tell(answers)
        self._told()
