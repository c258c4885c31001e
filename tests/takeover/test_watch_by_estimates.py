"""New weights where the car's state is not measured but estimated from late and noisy poses.

Promises guarded: what an estimate differs by from the car is no error of weights, so honest updates
are accepted and stay; spoilt ones are refused by the gate, and rolled back by the watch before the
car leaves the track, because the states are estimated by the proven weights meanwhile.
"""

from functools import cache

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.checks import Checks, Samples
from bayesrace.gp.weights import Weights, encode_weights, read_weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.validation import residual
from bayesrace.messages import State
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.preparation import updated_weights
from bayesrace.operation.settings import PreparationSettings
from bayesrace.sensors import Sensors
from tests.instruments import mocap
from tests.racing import Racing, prepared, racing
from tests.takeover.spoilt_weights import SPOILT, spoilt
from tests.takeover.watched import Course

TS = 0.02
LIMIT_CYCLES = 40
"""Within which spoilt weights are rolled back; the car starts from rest."""
NOISES = pytest.mark.parametrize("noise", [(0.5, 0.2), (1.0, 0.5)], ids=["0.5 mm", "1 mm"])


@cache
def updated() -> Weights:
    """Learned from the training drive and a drive of the first weights, whose states are known."""
    files = prepared()
    assert files.training is not None
    samples = [files.training.samples, racing().driven.samples()]
    return read_weights(updated_weights(samples, PreparationSettings(), files.weights)[0])


class Sampled(ClosedLoop):
    """Keeps the samples that its compiled controller makes of estimates, and the true residuals."""

    def __init__(self, race: Racing, sensors: Sensors, seed: int, *, learned: bool = True) -> None:
        weights = race.weights if learned else None
        driven_by = race.artefact, race.car, race.track, race.line, weights
        self.controller = compiled_controller(*driven_by)
        super().__init__(
            race.car, race.track, race.line, self.controller, sensors=sensors, seed=seed
        )
        self.estimated: dict[bytes, int] = {}
        """Numbers of the states by what was estimated of them."""

    def _limits(self, state: State) -> None:
        belief = self._cycle.driver.belief
        if belief is not None:
            self.estimated[belief.x[3:7].tobytes()] = len(self._states) - 1

    def samples(self) -> tuple[Samples, Floats]:
        """Newest samples of a drive of two laps; the residuals of the car's true states."""
        driven = self.drive(2)
        found = Samples(*self.controller.native.samples())
        rows = [self.estimated[one[:4].tobytes()] for one in found.features]
        u = driven.moments["u_applied"]
        every = Dataset(driven.car, TS, driven.x[:-1], u[1:], driven.x[1:])
        return found, residual(every, PREDICTION)[rows]


@NOISES
@pytest.mark.parametrize("learned", [True, False])
def test_the_noise_of_a_sample_is_what_its_residual_differs_by_from_the_true_one(
    noise: tuple[float, float], learned: bool
) -> None:
    """Its mean square over three seeds, of samples that are known well and of the others: those of
    a gap of poses have most of it."""
    seen = (Sampled(racing(), mocap(noise), k, learned=learned) for k in range(3))
    samples, true = zip(*(one.samples() for one in seen), strict=True)
    stated = np.concatenate([one.noise for one in samples])
    off = np.concatenate([one.residuals for one in samples]) - np.concatenate(true)
    assert (stated >= 0).all()
    usual = stated <= np.median(stated, axis=0)
    for rows in (usual, ~usual):
        ratio = np.where(rows, off**2, 0).sum(axis=0) / np.where(rows, stated, 0).sum(axis=0)
        assert ((ratio > 0.2) & (ratio < 1.5)).all(), ratio


@NOISES
@pytest.mark.parametrize("seed", range(3))
def test_honest_updates_are_accepted_and_stay(noise: tuple[float, float], seed: int) -> None:
    race, sensors = racing(), mocap(noise)
    checks = Checks(GateSettings(), race.artefact, race.car)
    recent, _ = Sampled(race, sensors, seed).samples()
    first, new = encode_weights(race.weights), encode_weights(updated())
    assert checks.judge(new, recent, first, first).packed
    assert checks.judge(first, recent).packed
    became, off_m = Course(race.car, "harbour", 14.0, sensors).drive(updated(), race.weights, seed)
    assert became == "kept"
    assert off_m < 0


@NOISES
def test_spoilt_weights_are_refused(noise: tuple[float, float]) -> None:
    race = racing()
    checks = Checks(GateSettings(), race.artefact, race.car)
    recent, _ = Sampled(race, mocap(noise), 0).samples()
    first = encode_weights(race.weights)
    for what in SPOILT:
        bad = encode_weights(spoilt(updated(), what))
        assert not checks.judge(bad, recent, first, first).packed, what


@NOISES
@pytest.mark.parametrize("what", SPOILT)
def test_spoilt_weights_are_rolled_back_while_the_state_is_known(
    noise: tuple[float, float], what: str
) -> None:
    race = racing()
    course = Course(race.car, "harbour", 4.0, mocap(noise))
    became, off_m = course.drive(spoilt(updated(), what), race.weights)
    if became != "refused as absurd":
        assert became.startswith("back at "), became
        assert int(became.split()[2].rstrip(",")) <= LIMIT_CYCLES
    assert off_m < 0
