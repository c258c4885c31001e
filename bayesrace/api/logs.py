"""A recording as tables."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bayesrace.api.values import optional
from bayesrace.columns import Columns, LogColumns
from bayesrace.errors import InputError
from bayesrace.integrators import PREDICTION
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.sources import dataset_from_log, log_facts
from bayesrace.log import LogReader
from bayesrace.messages import TOPICS, topic_of
from bayesrace.vehicles import Car

__all__ = ["Log"]


class Log:
    """A recording (MCAP) of a race, a drive or a real car; of one that is still written, what it
    has when it is opened and first read.

    ``log["state"]`` is a structured array with a row for each message: ``log["state"]["x"]`` has
    shape (n, 7). docs/architecture.md lists the topics, :mod:`bayesrace.messages` their fields.
    """

    def __init__(self, path: Path | str) -> None:
        """InputError if there is no recording."""
        self.path = Path(path)
        self._reader = LogReader(self.path)
        self._topics = {one.key.split("/")[2]: one for one in TOPICS}
        self._read: dict[str, Columns] = {}
        held = {topic_of(key) for key in self._reader.channels()}
        self.topics = tuple(name for name, one in self._topics.items() if one in held)
        """Names of those that it holds messages of."""

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """Settings and manifests by name, as texts."""
        return self._reader.metadata()

    @property
    def car(self) -> Car:
        """The car that was recorded; InputError if the recording does not say."""
        if (car := log_facts(self.path).car) is None:
            raise InputError(f"{self.path} does not say which car it is of: name the car")
        return car

    def __getitem__(self, topic: str) -> Columns:
        """All messages of a topic, in order; InputError for a name that there is not."""
        if topic not in self._topics:
            raise InputError(f"no topic '{topic}': there are {', '.join(self._topics)}")
        if topic not in self._read:
            wanted = self._topics[topic]
            names = " ".join(wanted.message.__struct_fields__)
            self._read[topic] = LogColumns(self.path, {wanted: names}).read()[wanted]
        return self._read[topic]

    def frame(self, topic: str) -> Any:
        """The same as a pandas DataFrame, vectors spread over columns such as ``x.0``; InputError
        if pandas is not installed."""
        return optional("pandas", "campaign").DataFrame(self._spread(topic))

    def table(self, topic: str) -> Any:
        """The same as a pyarrow Table; InputError if pyarrow is not installed."""
        return optional("pyarrow", "campaign").table(self._spread(topic))

    def _spread(self, topic: str) -> dict[str, Any]:
        """Columns of numbers and texts; maps and vectors of any length stay objects."""
        rows, spread = self[topic], {}
        for name in rows.dtype.names or ():
            column = rows[name]
            if column.ndim == 1:
                spread[name] = column
            else:
                spread |= {f"{name}.{i}": column[:, i] for i in range(column.shape[1])}
        return spread

    def samples(self, car: Car) -> Dataset:
        """What can be learned from it."""
        return dataset_from_log(self.path, car, PREDICTION.step_s)

    def __repr__(self) -> str:
        return f"<Log {self.path}: {', '.join(self.topics)}>"
