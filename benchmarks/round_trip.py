"""Lockstep over Zenoh: how a process should wait for the other one's answer.

    python -m benchmarks.round_trip

Two processes on loopback play ping-pong with the states' size of message; one computes for
as long as a control step in between, the other as long as the plant. What is printed is the round
trip without that work. Variants: what takes the message from Zenoh (a callback that fills a queue,
or the waiting thread from Zenoh's own channel), whether the waiting thread polls before it sleeps,
and whether Zenoh sends in the calling thread (low latency).
docs/decisions/2026-11-21-lockstep-spin.md holds the conclusion.
"""

import argparse
import os
import queue
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import zenoh

from bayesrace.transport import Endpoints, free_endpoint, open_session

WAYS = ("callback and queue", "channel", "channel, polled", "channel, polled with sched_yield")
ROUNDS, WARM_UP = 4000, 500
CONTROL_US, PLANT_US = 180, 50
SPIN_S = 0.002
PAYLOAD = bytes(120)


def receiver(session: Any, key: str, way: str) -> tuple[Callable[[], bytes], Any]:
    """A function that waits for the next message, and what must be kept alive."""
    if way == "callback and queue":
        messages: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        handler: Any = zenoh.handlers.Callback(
            lambda sample: messages.put(sample.payload.to_bytes()), indirect=False
        )
        return messages.get, session.declare_subscriber(key, handler)
    subscriber = session.declare_subscriber(key, zenoh.handlers.FifoChannel(1000))

    def wait() -> bytes:
        if "polled" in way:
            until = time.perf_counter() + SPIN_S
            while time.perf_counter() < until:
                sample = subscriber.try_recv()
                if sample is not None:
                    return bytes(sample.payload.to_bytes())
                if "sched_yield" in way:
                    os.sched_yield()
        return bytes(subscriber.recv().payload.to_bytes())

    return wait, subscriber


def work(duration_us: float) -> None:
    """Keeps the CPU busy."""
    until = time.perf_counter_ns() + round(1e3 * duration_us)
    while time.perf_counter_ns() < until:
        pass


def answer(endpoint: str, way: str, low_latency: bool, work_us: float) -> None:
    """The controller's part; ends when an empty message comes."""
    with open_session(Endpoints(connect=(endpoint,), low_latency=low_latency)) as session:
        wait, _subscriber = receiver(session, "ping", way)
        publisher = publish(session, "pong")
        while wait():
            work(work_us)
            publisher.put(PAYLOAD)


def publish(session: Any, key: str) -> Any:
    """A publisher that sends at once and loses nothing."""
    control = zenoh.CongestionControl.BLOCK
    return session.declare_publisher(key, express=True, congestion_control=control)


def measure(way: str, low_latency: bool) -> list[float]:
    """Round trips one after another, less the work [us]; the plant's part."""
    endpoint = free_endpoint()
    with open_session(Endpoints(listen=(endpoint,), low_latency=low_latency)) as session:
        wait, _subscriber = receiver(session, "pong", way)
        publisher = publish(session, "ping")
        line = [sys.executable, "-m", "benchmarks.round_trip", "--answer", endpoint, "--way", way]
        line += ["--work", str(CONTROL_US)]
        with subprocess.Popen(line + ["--low-latency"] * low_latency) as other:
            while not publisher.matching_status.matching:
                time.sleep(0.01)
            time.sleep(0.2)
            times = []
            for _ in range(ROUNDS):
                begin_ns = time.perf_counter_ns()
                publisher.put(PAYLOAD)
                wait()
                times.append((time.perf_counter_ns() - begin_ns) * 1e-3 - CONTROL_US)
                work(PLANT_US)
            publisher.put(b"")
            other.wait(10)
    return times[WARM_UP:]


def main() -> None:
    """Prints a row per variant; about half a minute."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--answer", default="", help=argparse.SUPPRESS)
    parser.add_argument("--way", default="", help=argparse.SUPPRESS)
    parser.add_argument("--work", type=float, default=0.0, help=argparse.SUPPRESS)
    parser.add_argument("--low-latency", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.answer:
        answer(arguments.answer, arguments.way, arguments.low_latency, arguments.work)
        return
    print(f"{'what waits':<34} {'sends in':<16} p50 us  p90 us  p99 us")
    for low_latency in (False, True):
        for way in WAYS:
            p50, p90, p99 = np.percentile(measure(way, low_latency), [50, 90, 99])
            sends = "calling thread" if low_latency else "own thread"
            print(f"{way:<34} {sends:<16} {p50:6.0f}  {p90:6.0f}  {p99:6.0f}", flush=True)


if __name__ == "__main__":
    main()
