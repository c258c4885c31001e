"""A plan that has gone into a bad local minimum is left again: laps stay on the track."""

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.native_step import Status
from bayesrace.operation.closed_loop import ClosedLoop, Driven
from bayesrace.operation.preparation import prepare, updated_weights
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.vehicles import default_car


@pytest.mark.check
def test_with_a_model_that_is_right_the_laps_stay_on_the_track() -> None:
    """Before there were second starts, the updated laps left this track, 5 % slower."""
    settings, car = PreparationSettings(train_track="random:3"), default_car()
    with stages_on(Console(quiet=True)) as stages:
        prepared = prepare(settings, ("random:11",), stages, ("e_kinematic", "dynamic"))
    assert prepared.training is not None
    nominal, true = prepared.artefacts
    on = prepared.first.track, prepared.first.line

    def driven(artefact: Path, weights: Path | None = None) -> Driven:
        controller = compiled_controller(artefact, car, *on, weights)
        return ClosedLoop(car, *on, controller).drive()

    laps = driven(nominal, prepared.weights).samples()
    samples = [prepared.training.samples, laps]
    updated = driven(nominal, updated_weights(samples, settings, prepared.weights)[0])
    perfect = driven(true)
    assert updated.off_track_m.max() <= 0
    assert perfect.off_track_m.max() <= 0
    for mine, best in zip(updated.laps_s, perfect.laps_s, strict=True):
        assert mine <= 1.02 * best  # random:11 keeps one such minimum, of 1.7 %


@pytest.mark.check
@pytest.mark.parametrize("track", ["random:3", "random:7"])
def test_from_rest_a_plan_is_found_anywhere_on_the_line(track: str) -> None:
    """Without a start that leaves the track's edges out, none is at 7 and 5 of these places."""
    with stages_on(Console(quiet=True)) as stages:
        prepared = prepare(PreparationSettings(), (track,), stages)
    on, car = prepared.first, default_car()
    native = compiled_controller(prepared.artefacts[0], car, on.track, on.line, None).native
    line = on.line
    for k in range(0, len(line.x_m), 3):
        for speed_mps in (0.1, 0.0):
            native.reset()
            pose = (line.x_m[k], line.y_m[k], line.psi_rad[k])
            native.step(np.array([*pose, speed_mps, 0.0, 0.0, 0.0]), np.zeros(2))
            assert Status(native.info.status).usable, (k, speed_mps)
