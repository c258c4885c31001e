"""Another tool's FMU, in its own names, units and signs, is the same car through its map."""

import math
from pathlib import Path

import numpy as np
import pytest

from bayesrace.plant.fmu.simulator import open_fmu
from bayesrace.plant.simulator import Simulator
from bayesrace.vehicles import get_car
from bayesrace.vehicles.models import dynamic
from tests.foreign_fmu import FOREIGN_MAP, build_foreign_fmu

START = [1.0, 2.0, -math.pi / 4, 0.1, 0.0, 0.0, 0.1]


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_foreign_fmu(tmp_path_factory.mktemp("foreign"))


@pytest.mark.parametrize(
    "settings", ["", "step_s = 0.005", "step_s = 0.02"], ids=["any step", "5 ms", "a period"]
)
def test_it_drives_as_the_built_in_car(foreign: Path, tmp_path: Path, settings: str) -> None:
    """Turning left and right, several turns of heading, commands that change within a period."""
    car = get_car("orca")
    map_ = tmp_path / "map.toml"
    patient = f"[fmu]\ntimeout_s = 20\nstartup_s = 60\n{settings}"
    map_.write_text(FOREIGN_MAP.replace("[fmu]", patient))
    ours = Simulator(dynamic(car))
    with open_fmu(car, foreign, map_) as theirs:
        for run in range(2):  # the second one starts afresh
            ours.reset(START)
            theirs.reset(START)
            assert np.abs(theirs.x - ours.x).max() < 1e-12
            for k in range(200):
                u = (0.4 if k % 50 else -0.05, 5.0 if k < 4 else 0.3 * math.sin(0.05 * k))
                if k % 10 == 5 and theirs.substeps % 4 == 0:
                    part = theirs.substeps // 4
                    theirs.step_switched([(part, (0.2, -2.0)), (3 * part, u)])
                    ours.step_switched([(5, (0.2, -2.0)), (15, u)])
                else:
                    theirs.step(u)
                    ours.step(u)
                assert np.abs(theirs.x - ours.x).max() < 1e-9, (run, k)
                assert theirs.u_applied == pytest.approx(ours.u_applied, abs=1e-12)
            assert abs(ours.x[2] - START[2]) > 2 * math.pi
