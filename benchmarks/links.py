"""What certificates cost a message: round trips over plain and over secured links, in turn.

    python -m benchmarks.links [--blocks 50] [--messages 100]

A state's size there and an actuation's back between two processes, in blocks. Both links are open
all the time and take turns; the ratio is that of blocks in turn.
"""

import time
from contextlib import ExitStack
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from zenoh.handlers import FifoChannel

from bayesrace.configuration import Configuration, NetworkSettings, TlsSettings
from bayesrace.messages import ACTUATION, STATE
from bayesrace.operation.certificates import add, init
from bayesrace.transport import free_endpoint, open_session
from benchmarks.harness import arguments, in_turn, ratio, report

_THERE, _BACK = STATE.key.format(car="orca"), ACTUATION.key.format(car="orca")
_STATE, _ANSWER, _PAUSE_S = bytes(250), bytes(120), 0.002


def secured(folder: Path) -> Configuration:
    """Plant and controller on loopback with a certificate each."""
    init(folder)
    add(folder, "plant", "plant")
    add(folder, "controller", "controller")
    network = NetworkSettings(plant=(free_endpoint("tls"),), controller=(free_endpoint("tls"),))
    return Configuration(network=network, tls=TlsSettings(folder=folder))


def echo(network: Configuration) -> None:
    """Answers each message, until an empty one comes."""
    silent = network.endpoints("controller").model_copy(update={"listen": ()})
    with open_session(silent, "controller") as session:
        states = session.declare_subscriber(_THERE, FifoChannel(100))
        answers = session.declare_publisher(_BACK, express=True)
        while states.recv().payload.to_bytes():
            answers.put(_ANSWER)


def block(messages: int, states: Any, answers: Any) -> list[float]:
    """Round trips one after the other [us]."""
    times = []
    for _ in range(messages):
        time.sleep(_PAUSE_S)
        begin_ns = time.perf_counter_ns()
        states.put(_STATE)
        answers.recv()
        times.append((time.perf_counter_ns() - begin_ns) * 1e-3)
    return times


def main() -> None:
    """The plant's part: measures and prints percentiles."""
    given = arguments(__doc__, blocks=50, messages=100)
    ways, ends = {}, []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        plain = Configuration().plain(free_endpoint(), free_endpoint())
        for name, network in {"plain": plain, "secured": secured(folder / "certs")}.items():
            session = stack.enter_context(open_session(network.endpoints("plant"), "plant"))
            answers = session.declare_subscriber(_BACK, FifoChannel(100))
            ends.append(session.declare_publisher(_THERE, express=True))
            ways[name] = partial(block, given.messages, ends[-1], answers)
            get_context("spawn").Process(target=echo, args=(network,), daemon=True).start()
        while not all(states.matching_status.matching for states in ends):
            time.sleep(0.01)
        in_turn(ways, 1)  # warms up
        found = in_turn(ways, given.blocks)
        for states in ends:
            states.put(b"")
    rows = []
    for share in (10, 50, 90, 99):
        plain_us, secured_us = (np.percentile(us, share, axis=1) for us in found.values())
        both = {"plain [us]": np.median(plain_us), "secured [us]": np.median(secured_us)}
        rows.append({"round trip": f"p{share}", **both, **ratio(secured_us, plain_us)})
    report(given, f"{given.blocks} blocks of {given.messages} messages", rows)


if __name__ == "__main__":
    main()
