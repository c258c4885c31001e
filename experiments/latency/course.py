"""Where the car was: laps, and samples off the track."""

from bayesrace.messages import Truth
from bayesrace.tracks import Track

__all__ = ["Course"]

_BATCH = 256


class Course:
    """Follows the truth of a run; projected in batches, so that little is kept."""

    def __init__(self, track: Track | None) -> None:
        self._track = track
        self._waiting: list[tuple[float, float]] = []
        self._off_track = 0
        self._first_lap: int | None = None
        self._last_lap = 0
        self.states = 0

    def truth(self, message: Truth) -> None:
        """The next sample."""
        self.states += 1
        if self._first_lap is None:
            self._first_lap = message.lap
        self._last_lap = message.lap
        if self._track is not None:
            self._waiting.append((message.x[0], message.x[1]))
            if len(self._waiting) >= _BATCH:
                self._project()

    @property
    def laps(self) -> int | None:
        """Crossings of the start line since the first state; None without any."""
        return None if self._first_lap is None else self._last_lap - self._first_lap

    @property
    def off_track_samples(self) -> int | None:
        """States with the centre of gravity off the track; None if the track is not known."""
        if self._track is None:
            return None
        self._project()
        return self._off_track

    def _project(self) -> None:
        if self._track is not None and self._waiting:
            projection = self._track.project_path(self._waiting)
            self._off_track += int((projection.off_track_m > 0).sum())
            self._waiting.clear()
