"""The car as an FMU beside the built-in equations: the time of a period.

    python -m benchmarks.fmu [--rounds 20] [--periods 1000]

A period is what the plant does every 20 ms: two inputs set, one step (20 sub-steps of RK4), seven
outputs read. The ways: the built-in car; its FMU called by fmpy in this process, and in a worker
process, as ``bayesrace plant --fmu`` has it.
"""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, Literal

from bayesrace.codegen.fmu import car_fmu, pack
from bayesrace.plant.fmu.simulator import open_fmu
from bayesrace.plant.simulator import PLANT, Simulator
from bayesrace.vehicles import default_car
from bayesrace.vehicles.models import STATES, dynamic
from benchmarks.harness import Row, arguments, in_turn, percentiles, report
from tests.fmu_master import Slave

_VERSIONS: Final[tuple[Literal[2, 3], ...]] = (2, 3)
_START: Final = (0.0, 0.0, 0.0, 1.5, 0.0, 0.0, 0.0)


def times_us(step: Callable[[Sequence[float]], object], periods: int) -> list[float]:
    """Of so many periods under changing inputs."""
    taken = []
    for u in ((0.4, 4.0 * math.sin(0.1 * k)) for k in range(periods)):
        begin_s = time.perf_counter()
        step(u)
        taken.append(1e6 * (time.perf_counter() - begin_s))
    return taken


def by_fmpy(one: Slave, u: Sequence[float]) -> object:
    """A period of the FMU, in one call of fmpy each for inputs, step and outputs."""
    kind, names = "Real" if one.two else "Float64", one.references
    getattr(one.fmu, f"set{kind}")([names["d"], names["delta_rate"]], list(u))
    one.step(PLANT.step_s)
    return getattr(one.fmu, f"get{kind}")([names[name] for name in STATES])


def main() -> None:
    """Times all ways in turn."""
    given, car = arguments(__doc__, rounds=20, periods=1000), default_car()
    simulator = Simulator(dynamic(car))
    simulator.reset(_START)
    ways = {"built-in car": partial(times_us, simulator.step, given.periods)}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        for n in _VERSIONS:
            fmu = pack(car_fmu(car, n), folder / f"car{n}.fmu")
            one = Slave(fmu, folder / f"{n}")
            one.initialise(dict(zip(STATES, _START, strict=True)))
            ways[f"FMI {n}.0, fmpy"] = partial(times_us, partial(by_fmpy, one), given.periods)
            vehicle = stack.enter_context(open_fmu(car, fmu))
            vehicle.reset(_START)
            ways[f"FMI {n}.0, worker"] = partial(times_us, vehicle.step, given.periods)
        in_turn(ways, 1)  # warms up
        found = in_turn(ways, given.rounds)
    rows: list[Row] = [{"us": name, **percentiles(us)} for name, us in found.items()]
    report(given, "a period of 20 ms", rows)


if __name__ == "__main__":
    main()
