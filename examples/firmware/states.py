"""Writes the states of a recorded drive (an MCAP log) as numbers, for main.c to drive over again.

python examples/firmware/states.py run.mcap > data/drive.txt
"""

import sys
from pathlib import Path

from bayesrace.log import LogReader
from bayesrace.messages import STATE, State


def line(state: State) -> str:
    """Time, state, inputs that acted, number of measured delays, these."""
    delays = state.actuation_delays[2::3]
    return " ".join(map(repr, (state.time_s, *state.x, *state.u_applied, len(delays), *delays)))


if __name__ == "__main__":
    states = LogReader(Path(sys.argv[1])).select(STATE)
    sys.stdout.writelines(f"{line(one)}\n" for one in states if not one.final)
