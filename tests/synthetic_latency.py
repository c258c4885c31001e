"""Logs of a plant and a controller whose every delay is known."""

from dataclasses import dataclass, field
from pathlib import Path

from bayesrace.log import LogWriter
from bayesrace.messages import Actuation, Message, State, Status, Telemetry, Truth, encode
from studies.latency.analysis import Analysis, Beside, analyse
from studies.latency.settings import LatencySettings

__all__ = ["PERIOD_NS", "Loop", "report_of"]

PERIOD_NS = 20_000_000


def report_of(log: Path, name: str = "", **settings: object) -> Analysis:
    """The analysis of a recorded run."""
    given = {"log": log, "name": name, "track": "", "warm_up_s": 0.0, "duration_s": 1e9}
    return analyse(log, LatencySettings.model_validate(given | settings), None, Beside())


@dataclass
class Loop:
    """Writes the messages that a plant and a controller would send; 400 us from release to sent.

    The recorder writes each of them ``began_ns`` after the plant's clock has shown its time.
    """

    path: Path
    epoch: int = 5
    run: int = 1
    began_ns: int = 10**12
    """Of the plant's clock at state 0."""
    ahead_ns: int = 7_000_000_000
    """The controller's clock against the plant's."""
    drift: float = 0.0
    """Of the controller's clock."""
    state_seq: int = 0
    sent: int = 0
    ticks: int = 0
    beats: int = 0
    answers: list[float] = field(default_factory=list)
    lockstep: bool = False

    def __post_init__(self) -> None:
        self.log = LogWriter(self.path)

    def __enter__(self) -> "Loop":
        return self

    def __exit__(self, *_: object) -> None:
        self.log.close()

    def sampled_ns(self, seq: int) -> int:
        return self.began_ns + seq * PERIOD_NS

    def controller_ns(self, plant_ns: int) -> int:
        return plant_ns + self.ahead_ns + round((plant_ns - self.began_ns) * self.drift)

    def state(self, seen: bool = True) -> int:
        """The next state, with the answers noted since the one before."""
        seq, self.state_seq = self.state_seq, self.state_seq + 1
        answers, self.answers = tuple(self.answers), []
        now_ns = self.sampled_ns(seq)
        car = (now_ns, self.epoch, self.run, seq * PERIOD_NS * 1e-9, (0.0,) * 7, (0.0, 0.0))
        if seen:
            self._write("state", State(seq, *car, seq // 100, self.lockstep, answers, False), seq)
            self._write("truth", Truth(seq, *car, seq // 100), seq)
        return seq

    def tick(self, seq: int, released_ns: int = 700_000, seen: bool = True) -> None:
        """A cycle on state ``seq``, released that long after its sampling."""
        sampled_ns = self.sampled_ns(seq)
        released = self.controller_ns(sampled_ns + released_ns)
        sent = self.controller_ns(sampled_ns + released_ns + 400_000)
        received = self.controller_ns(sampled_ns + 600_000)
        telemetry = Telemetry(
            self.sent, sent, self.run, seq, 0, 0, 3, self.ticks, released, received, False, 31.0,
            42.0, 150.0, 250.0, 53.0, 0.0, (), (), 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0.0, 0.0,
        )  # fmt: skip
        actuation = Actuation(self.sent, sent, self.epoch, self.run, seq, 0.0, (0.0, 0.0), "", 0)
        self.sent, self.ticks = self.sent + 1, self.ticks + 1
        if seen:
            self._write("actuation", actuation, seq)
            self._write("telemetry", telemetry, seq)

    def answer(self, seq: int, arrival_s: float = 1.5e-3, acting_s: float = 2.5e-3) -> None:
        """The plant receives an actuation; the next state says so."""
        self.answers += [float(seq), arrival_s, acting_s]

    def cycle(self) -> int:
        """A state, a cycle on it, and its answer."""
        seq = self.state()
        self.tick(seq)
        self.answer(seq)
        return seq

    def heartbeats(self, lost: int = 0, overruns: int = 0) -> None:
        """Of both, 10 ms after the newest state; all messages but ``lost`` states were received."""
        at_ns = self.sampled_ns(self.state_seq - 1) + 10_000_000
        plant = {"actuations_received": self.sent, "actuations_lost": 0}
        controller = {"states_received": self.state_seq - lost, "overruns": overruns}
        for source, sent_ns, counters in (
            ("plant", at_ns, plant), ("controller", self.controller_ns(at_ns), controller)
        ):  # fmt: skip
            status = Status(self.beats, sent_ns, source, "running", self.epoch, self.run, "", "",
                            50.0, 0.0, 0.0, counters)  # fmt: skip
            self._write(f"status/{source}", status, self.state_seq - 1)
        self.beats += 1

    def _write(self, key: str, message: Message, seq: int) -> None:
        self.log.write(f"bayesrace/orca/{key}", encode(message), self.sampled_ns(seq), message.seq)
