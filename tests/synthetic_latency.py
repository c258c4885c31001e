"""Logs of a plant and a controller whose every delay is known."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bayesrace.log import LogWriter
from bayesrace.messages import Actuation, Message, State, Status, Telemetry, Truth, encode
from bayesrace.studies.latency.analysis import Analysis, Beside, analyse
from bayesrace.studies.latency.settings import LatencySettings
from tests.driven import blank

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
    delays: list[float] = field(default_factory=list)
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
        """The next state, with the delays noted since the one before."""
        seq, self.state_seq = self.state_seq, self.state_seq + 1
        delays, self.delays = tuple(self.delays), []
        now_ns = self.sampled_ns(seq)
        car: dict[str, Any] = {
            "seq": seq, "source_time_ns": now_ns, "epoch": self.epoch, "run": self.run,
            "time_s": seq * PERIOD_NS * 1e-9, "x": (0.0,) * 7, "u_applied": (0.0, 0.0),
            "lap": seq // 100,
        }  # fmt: skip
        if seen:
            self._write(
                "state",
                State(
                    **car,
                    lockstep=self.lockstep,
                    actuation_delays=delays,
                    final=False,
                    estimated=False,
                    readings=(),
                ),
                seq,
            )
            self._write("truth", Truth(**car), seq)
        return seq

    def tick(
        self, seq: int, released_ns: int = 700_000, seen: bool = True, late: bool = False
    ) -> None:
        """A cycle on state ``seq``, released that long after its sampling; ``late``: a further one
        after a release, as soon as the state is there."""
        sampled_ns = self.sampled_ns(seq)
        released = self.controller_ns(sampled_ns + released_ns)
        sent = self.controller_ns(sampled_ns + released_ns + 400_000)
        received = self.controller_ns(sampled_ns + (released_ns - 40_000 if late else 600_000))
        both = {"seq": self.sent, "source_time_ns": sent, "run": self.run, "state_seq": seq}
        telemetry = blank(
            Telemetry, **both, tick=self.ticks - late, released_ns=released, received_ns=received,
            wake_us=0.0 if late else 31.0, decode_us=42.0, prepare_us=0.0 if late else 150.0,
            solve_us=250.0, encode_us=53.0,
        )  # fmt: skip
        actuation = blank(Actuation, **both, epoch=self.epoch, u=(0.0, 0.0))
        self.sent, self.ticks = self.sent + 1, self.ticks + (not late)
        if seen:
            self._write("actuation", actuation, seq)
            self._write("telemetry", telemetry, seq)

    def answer(self, seq: int, arrival_s: float = 1.5e-3, acting_s: float = 2.5e-3) -> None:
        """The plant receives an actuation; the next state says so."""
        self.delays += [float(seq), arrival_s, acting_s]

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
            status = blank(
                Status, seq=self.beats, source_time_ns=sent_ns, source=source, phase="running",
                epoch=self.epoch, run=self.run, rate_hz=50.0, counters=counters,
            )  # fmt: skip
            self._write(f"status/{source}", status, self.state_seq - 1)
        self.beats += 1

    def _write(self, key: str, message: Message, seq: int) -> None:
        self.log.write(f"bayesrace/orca/{key}", encode(message), self.sampled_ns(seq))
