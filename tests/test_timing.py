"""``bayesrace timing``: its extrapolation against laws that are known, and what it measures."""

import numpy as np
import pytest
from scipy.stats import genpareto

from bayesrace.studies.evidence.timing.tail import fit_tail

COUNT, RARE = 600, 1e-6


def drawn(seed: int, shape: float = -0.2) -> np.ndarray:
    """Times that are 1 and an excess by the law, whose tail is of the same law."""
    random = np.random.default_rng(seed)
    return 1 + np.asarray(genpareto.rvs(shape, scale=0.3, size=COUNT, random_state=random))


@pytest.mark.parametrize("shape", [-0.3, -0.1, 0.0])
def test_the_upper_limit_is_above_the_true_level_as_often_as_it_says(shape: float) -> None:
    true, runs = 1 + genpareto.isf(RARE, shape, scale=0.3), 60
    fits = [fit_tail(drawn(seed, shape), RARE, samples=19) for seed in range(runs)]
    assert all(fits)
    covered = sum(fit.upper >= true for fit in fits if fit)
    assert covered >= 0.95 * runs - 4  # two standard deviations and a bit
    assert np.median([fit.level for fit in fits if fit]) == pytest.approx(true, rel=0.25)


def test_the_fit_is_that_of_scipy() -> None:
    values = drawn(3)
    fit = fit_tail(values, RARE)
    assert fit
    y = values[values > fit.threshold] - fit.threshold
    shape, _, scale = genpareto.fit(y, floc=0)
    assert (fit.shape, fit.scale) == pytest.approx((shape, scale), rel=2e-3, abs=2e-3)


def test_stalls_among_the_times_are_flagged() -> None:
    """One in fifty takes longer by a Cauchy-like law: no bounded work does that."""
    flagged = 0
    for seed in range(20):
        random = np.random.default_rng(seed)
        values = drawn(seed)
        late = random.random(COUNT) < 0.02
        values[late] += np.asarray(genpareto.rvs(1.0, size=late.sum(), random_state=random)) * 3
        fit = fit_tail(values, RARE)
        flagged += bool(fit and fit.rejected)
    assert flagged >= 18


def test_too_few_or_equal_times_have_no_tail() -> None:
    assert fit_tail(drawn(0)[:60], RARE) is None
    assert fit_tail(np.repeat([1.0, 2.0, 3.0], 200), RARE) is None
