"""One run as its director plans it: what the plant is asked for, and what the log says of it."""

from dataclasses import dataclass

from bayesrace import clock
from bayesrace.messages import Event, RunRequest, Scalar
from bayesrace.tracks import StartLine, Track

__all__ = ["RunPlan", "announcement", "run_request"]


@dataclass(frozen=True)
class RunPlan:
    """One run: its number in all messages, its controller, its length."""

    run: int
    controller: str
    laps: int
    max_time_s: float
    lockstep: bool
    start_speed_mps: float = 0.1
    held: bool = False
    """The car stops unless the director is heard all the time; in real time only."""
    exact: bool = False
    """The state is known as it is, whatever the sensors."""
    pause_s: float = 0.0
    """In lockstep: after each such time the run waits, see :class:`.RunRequest`; 0: never."""


def run_request(track: Track, plan: RunPlan) -> RunRequest:
    """What the plant needs to know: the start state and the start line, not the track."""
    x, y, psi = track.start_pose()
    line = StartLine(track)
    return RunRequest(
        seq=0,
        source_time_ns=clock.monotonic_ns(),
        run=plan.run,
        lockstep=plan.lockstep,
        x0=(x, y, psi, plan.start_speed_mps, 0.0, 0.0, 0.0),
        line_x_m=x,
        line_y_m=y,
        line_heading_rad=psi,
        line_left_m=line.left_m,
        line_right_m=line.right_m,
        laps=plan.laps,
        max_time_s=plan.max_time_s,
        actuation_timeout_s=5.0 if plan.lockstep else 0.2,
        held=plan.held,
        exact=plan.exact,
        pause_s=plan.pause_s,
    )


def announcement(plan: RunPlan, seq: int, weights_version: str, refused: str = "") -> Event:
    """The event in the log before a run, which names its controller.

    ``refused``: why the controller refuses its weights, so that no run follows.
    """
    text = f"run {plan.run}: {plan.controller}" + (", weights refused" if refused else "")
    data: dict[str, Scalar] = {
        "run": plan.run,
        "controller": plan.controller,
        "weights_version": weights_version,
        "refused": refused,
    }
    return Event(
        seq=seq,
        source_time_ns=clock.monotonic_ns(),
        run=plan.run,
        source="race",
        kind="run",
        text=text,
        data=data,
    )
