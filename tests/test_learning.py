"""Learning: samples, residual, likelihood, training, validation."""

import numpy as np
import pytest
from msgspec.structs import replace
from sklearn.gaussian_process.kernels import RBF, Matern

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.expression import evaluate_mean
from bayesrace.gp.weights import FEATURES, KERNELS, OUTPUTS, zero_weights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.learning.dataset import ROUNDING, Dataset, concatenate, filter_dataset
from bayesrace.learning.drives import Estimates
from bayesrace.learning.gaussian_process import (
    Covariance,
    PairDistances,
    Posterior,
    likelihood,
    starts,
)
from bayesrace.learning.settings import TrainingSettings
from bayesrace.learning.subset import most_informative
from bayesrace.learning.training import train
from bayesrace.learning.validation import identity, predictive_sigma, residual, validate
from bayesrace.vehicles.models import dynamic, e_kinematic
from tests.conftest import discrete
from tests.driven import CAR, QUICK, STEP_S, dataset_of, drive, logged, telemetry
from tests.scikit import scikit_gp


@pytest.fixture(scope="module")
def driven() -> Dataset:
    return drive(dynamic(CAR), 160, seed=1)


def gp_problem(count: int, seed: int = 0) -> tuple[Floats, Floats]:
    random = np.random.default_rng(seed)
    z = random.normal(size=(count, 6))
    return z, np.sin(2 * z[:, 0]) + z[:, 1] * z[:, 3] + 0.1 * random.normal(size=count)


# --- samples ---------------------------------------------------------------------------------


def test_residual_of_the_nominal_model_with_itself_is_zero() -> None:
    data = drive(e_kinematic(CAR), 60, seed=0, substeps=PREDICTION.substeps)
    assert np.abs(residual(data, PREDICTION)).max() < 1e-12


def test_residual_of_another_scheme_is_not_zero() -> None:
    """Why there is one discretisation object: mixed integrators look like model mismatch."""
    data = drive(e_kinematic(CAR), 60, seed=0, substeps=1)
    euler = Discretisation(scheme="euler", step_s=STEP_S, substeps=1)
    assert np.abs(residual(data, euler)).max() > 1e-3
    assert identity(data, euler) != identity(data, PREDICTION)


def test_residual_needs_the_recorded_step(driven: Dataset) -> None:
    with pytest.raises(InputError, match="step"):
        residual(driven, Discretisation(scheme="rk4", step_s=0.01, substeps=1))


def test_filter_counts_what_it_leaves_out(driven: Dataset) -> None:
    assert len(filter_dataset(driven)) == len(driven)
    x, u, x_next = driven.x.copy(), driven.u.copy(), driven.x_next.copy()
    x[0, 3] = 0.01
    u[1, 0], u[2, 1], x[3, 6] = 1.2, 5.1, -0.36
    x_next[4, 6] += 0.01
    kept = filter_dataset(Dataset(CAR, STEP_S, x, u, x_next))
    assert len(kept) == len(driven) - 5
    assert dict(kept.dropped) == {
        "standstill": 1,
        "outside limits": 3,
        "steering does not match its rate": 1,
    }
    every = filter_dataset(Dataset(CAR, STEP_S, x, u, x_next), limits=False)
    assert dict(every.dropped) == {"standstill": 1, "steering does not match its rate": 3}


@pytest.mark.parametrize("share", [0.9, 1.1])
@pytest.mark.parametrize("signal", ["vx", "d", "delta_rate", "delta", "delta change"])
def test_a_sample_is_kept_within_the_tolerance_of_each_signal(signal: str, share: float) -> None:
    slack = CAR.tuning.gate.moving_mps if signal == "vx" else ROUNDING
    x, u = np.array([0, 0, 0, 1.0, 0, 0, 0]), np.array([0.5, 0.0])
    if signal == "vx":
        x[3] = slack / share
    elif signal == "d":
        u[0] = CAR.d_max + share * slack
    elif signal == "delta_rate":
        u[1] = -CAR.delta_rate_max_radps - share * slack
    elif signal == "delta":
        x[6] = CAR.delta_max_rad + share * slack
    x_next = x.copy()
    x_next[6] += STEP_S * u[1] + share * slack * (signal == "delta change")
    kept = filter_dataset(Dataset(CAR, STEP_S, x[None], u[None], x_next[None]))
    assert len(kept) == (share < 1)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_states_are_consecutive_within_the_tolerance_of_time(driven: Dataset, share: float) -> None:
    late_s = share * ROUNDING
    states = logged(driven, 0)
    states[-1] = replace(states[-1], time_s=states[-1].time_s + late_s)
    data = dataset_of(states)
    assert dict(data.dropped) == ({} if share < 1 else {"gap": 1})


def test_datasets_are_checked(driven: Dataset) -> None:
    with pytest.raises(InputError, match="shape"):
        Dataset(CAR, STEP_S, driven.x, driven.u[:-1], driven.x_next)
    broken = driven.u.copy()
    broken[3, 0] = np.nan
    with pytest.raises(InputError, match="row 3"):
        Dataset(CAR, STEP_S, driven.x, broken, driven.x_next)
    with pytest.raises(InputError, match="mixed"):
        concatenate([driven, Dataset(CAR, 0.01, driven.x, driven.u, driven.x_next)])
    with pytest.raises(InputError):
        concatenate([])
    both = concatenate([driven, driven])
    assert len(both) == 2 * len(driven)
    assert both.digest() != driven.digest()
    assert driven.select(slice(None)).digest() == driven.digest()
    assert driven.features.shape == (len(driven), len(FEATURES))


def test_gaps_fallback_and_other_runs_are_left_out(driven: Dataset) -> None:
    first, second = logged(driven, 0), logged(driven, 1)
    messages = first[:10] + first[11:] + second
    seen = [telemetry(0, 3, 1), telemetry(0, 4, 2), telemetry(1, 3, 0)]
    everything = dataset_of(messages, seen)
    assert dict(everything.dropped) == {"gap": 1, "fallback": 2}
    assert len(everything) == 2 * len(driven) - 2 - 2
    one = dataset_of(messages, seen, runs=(1,))
    assert len(one) == len(driven)
    with pytest.raises(InputError, match="driven"):
        dataset_of([])


# --- likelihood, cross-validation, choice of samples -------------------------------------------


@pytest.mark.parametrize("kind", KERNELS)
def test_likelihood_and_gradient_equal_scikit_learn(kind: str) -> None:
    z, y = gp_problem(50)
    for theta in starts(2, seed=3):
        ours, our_gradient = likelihood(kind, PairDistances(z), y, theta)
        gp = scikit_gp(kind, theta, z, y)
        theirs, their_gradient = gp.log_marginal_likelihood(theta, eval_gradient=True)
        assert ours == pytest.approx(theirs, rel=1e-9)
        assert our_gradient == pytest.approx(their_gradient, rel=1e-6, abs=1e-7)


def test_singular_covariance_is_minus_infinity_not_an_error() -> None:
    z, y = np.zeros((5, 6)), np.arange(5.0)
    theta = np.log([1.0] + [1.0] * 6 + [1e-30])
    value, gradient = likelihood("rbf", PairDistances(z), y, theta)
    assert value == -np.inf
    assert not gradient.any()


def test_block_errors_equal_training_without_the_block() -> None:
    z, y = gp_problem(30)
    theta = np.log([2.0] + [1.5] * 6 + [0.02])
    posterior = Posterior(Covariance.of("rbf", theta), z, y)
    folds = np.repeat([0, 1, 2], 10)
    mean_without, sigma_without = posterior.predict_without(folds, z, folds)
    without = scikit_gp("rbf", theta, z[10:], y[10:])
    mean, sigma = without.predict(z[:10], return_std=True)
    assert mean_without[:10] == pytest.approx(mean, abs=1e-9)
    assert sigma_without[:10] == pytest.approx(sigma, abs=1e-9)
    new, _ = gp_problem(15, seed=5)
    own = np.arange(15) % 3
    elsewhere = posterior.predict_without(folds, new, own)
    mean, sigma = without.predict(new[own == 0], return_std=True)
    assert elsewhere[0][own == 0] == pytest.approx(mean, abs=1e-9)
    assert elsewhere[1][own == 0] == pytest.approx(sigma, abs=1e-9)


def test_a_choice_that_needs_too_much_memory_is_refused() -> None:
    with pytest.raises(InputError, match=r"5000 of 110000 samples would take 4 GB.*fewer"):
        most_informative("rbf", np.zeros((110_000, 6)), np.ones(6), 0.1, 5000)


def test_greedy_choice_takes_the_largest_posterior_variance() -> None:
    z, _ = gp_problem(25)
    chosen = most_informative("matern25", z, np.ones(6), 0.1, 6).tolist()
    base, picked = Matern(np.ones(6), nu=2.5), [0]
    while len(picked) < 6:
        own = base(z[picked]) + 0.1 * np.eye(len(picked))
        cross = base(z, z[picked])
        variance = 1 - np.einsum("ij,jk,ik->i", cross, np.linalg.inv(own), cross)
        variance[picked] = -1
        picked.append(int(np.argmax(variance)))
    assert chosen == sorted(picked)
    assert len(most_informative("rbf", z, np.ones(6), 0.1, 500)) == len(z)


# --- training and validation -------------------------------------------------------------------


def test_training_corrects_the_model(driven: Dataset) -> None:
    seen: list[float] = []
    weights = train(driven, PREDICTION, QUICK, progress=lambda share, text: seen.append(share))
    checked = validate(weights, drive(dynamic(CAR), 100, seed=2), PREDICTION)
    for name in OUTPUTS:
        metrics = checked.metrics[name]
        assert metrics["rmse"] < 0.3 * metrics["uncorrected_rmse"]
        assert metrics["r2"] > 0.8
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(1.0)
    assert weights.dataset_digest == driven.digest()


def test_the_car_drives_a_mirror_image_as_it_drives(driven: Dataset) -> None:
    """The image of each sample follows it, and obeys the same equations."""
    both = driven.with_mirror_images()
    np.testing.assert_array_equal(both.x[::2], driven.x)
    np.testing.assert_array_equal(both.x_next[::2], driven.x_next)
    np.testing.assert_array_equal(both.x[1::2, [0, 3]], driven.x[:, [0, 3]])
    np.testing.assert_array_equal(both.u[1::2], driven.u * (1, -1))
    y = residual(both, PREDICTION)
    np.testing.assert_allclose(y[1::2], y[::2] * (1, -1, -1), atol=1e-12)
    plant = discrete(dynamic(CAR))
    for x, u, x_next in zip(both.x[1:40:2], both.u[1:40:2], both.x_next[1:40:2], strict=True):
        np.testing.assert_allclose(plant(x, u), x_next, atol=1e-6)  # of two step sizes


def test_trained_weights_evaluate_as_scikit_learn_predicts(driven: Dataset) -> None:
    """Scaling is done once and undone once (scikit-learn's normalize_y would do it again)."""
    weights = train(driven, PREDICTION, QUICK)
    driven = driven.with_mirror_images()
    z, y = driven.features, residual(driven, PREDICTION)
    for i, output in enumerate(weights.outputs):
        theta = np.log([output.signal_variance, *output.length_scales, output.noise_variance])
        gp = scikit_gp(output.kernel, theta, z, (y[:, i] - y[:, i].mean()) / y[:, i].std())
        mean, sigma = gp.predict(z[::7] * 1.1, return_std=True)
        ours = evaluate_mean(weights, z[::7] * 1.1)[:, i]
        theirs = y[:, i].mean() + y[:, i].std() * mean
        # Two factorisations of a matrix of condition 1e9 agree to that times 1e-16.
        assert np.abs(ours - theirs).max() < 1e-6 * y[:, i].std()
        our_sigma = predictive_sigma(weights, z[::7] * 1.1)[:, i]
        assert our_sigma == pytest.approx(sigma * y[:, i].std(), rel=1e-4)


@pytest.mark.parametrize("kind", KERNELS)
def test_the_posterior_equals_scikit_learn(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where predictions are made part by part, to save memory."""
    z, y = gp_problem(40)
    new, _ = gp_problem(15, seed=5)
    theta = np.log([2.0] + [1.5] * 6 + [0.02])
    mean, sigma = scikit_gp(kind, theta, z, y).predict(new, return_std=True)
    monkeypatch.setattr("bayesrace.learning.gaussian_process._AT_ONCE", 7)
    ours = Posterior(Covariance.of(kind, theta), z, y).predict(new)
    assert ours[0] == pytest.approx(mean, abs=1e-10)
    assert ours[1] == pytest.approx(sigma, abs=1e-10)


def test_coverage_is_nominal_where_the_gp_is_right() -> None:
    """Data drawn from a GP with noise: the 95 % interval holds 95 %."""
    random = np.random.default_rng(7)
    z = random.uniform(-1, 1, size=(500, 6)) * [1, 0.2, 3, 0.3, 0.5, 3] + [2, 0, 0, 0, 0.4, 0]
    scales = np.array([1.0, 0.4, 4.0, 0.4, 2.0, 8.0])
    cov = RBF(scales)(z) + 1e-10 * np.eye(500)
    noise = 0.05 * random.normal(size=(500, 3))
    error = np.linalg.cholesky(cov) @ random.normal(size=(500, 3)) + noise
    x = np.column_stack((np.zeros((500, 3)), z[:, :4]))
    step = PREDICTION.discretise(e_kinematic(CAR))
    x_next = np.array(step(x.T, z[:, 4:].T)).T
    x_next[:, 3:6] += error
    data = Dataset(CAR, STEP_S, x, z[:, 4:], x_next)
    settings = TrainingSettings(kernels=("rbf",), restarts=0, widen=1)
    weights = train(data.select(slice(250)), PREDICTION, settings)
    checked = validate(weights, data.select(slice(250, None)), PREDICTION)
    for name in OUTPUTS:
        assert 0.89 <= checked.metrics[name]["coverage"] <= 0.995


def test_update_with_new_driving_improves(driven: Dataset) -> None:
    fast, test = (drive(dynamic(CAR), 120, seed=s, vx=2.5) for s in (11, 12))
    before = train(driven.select(slice(80)), PREDICTION, QUICK)
    after = train(concatenate([driven, fast]), PREDICTION, QUICK, initial=before)
    old, new = (validate(weights, test, PREDICTION).metrics for weights in (before, after))
    assert all(new[name]["rmse"] < old[name]["rmse"] for name in OUTPUTS)
    assert after.kernels == before.kernels
    assert after.version != before.version


def test_what_is_not_known_of_a_state_is_no_error_of_the_weights(driven: Dataset) -> None:
    """The same samples exactly, and with noise of known deviations that are not alike."""
    weights = train(driven, PREDICTION, QUICK)
    exact = drive(dynamic(CAR), 2000, seed=2)
    true = validate(weights, exact, PREDICTION).metrics
    random = np.random.default_rng(3)
    deviation = np.zeros((len(exact), 4))
    for i, name in enumerate(OUTPUTS):
        deviation[:, i] = true[name]["rmse"] * random.uniform(0.2, 3, len(exact))
    x_next = exact.x_next.copy()
    x_next[:, 3:6] += random.normal(size=(len(exact), 3)) * deviation[:, :3]
    estimates = Estimates.settled(deviation)
    noisy = Dataset(CAR, STEP_S, exact.x, exact.u, x_next, estimates=estimates)
    blind = Dataset(CAR, STEP_S, exact.x, exact.u, x_next)
    found, taken = (validate(weights, one, PREDICTION).metrics for one in (noisy, blind))
    for name in OUTPUTS:
        for score in ("rmse", "uncorrected_rmse"):
            assert found[name][score] == pytest.approx(true[name][score], rel=0.12)
        assert taken[name]["rmse"] > 1.5 * true[name]["rmse"]
        assert found[name]["r2"] == pytest.approx(true[name]["r2"], abs=0.01)
        assert found[name]["coverage"] > max(taken[name]["coverage"], 0.9)


def test_zero_weights_validate_as_uncorrected(driven: Dataset) -> None:
    checked = validate(zero_weights("orca", identity(driven, PREDICTION)), driven, PREDICTION)
    for name in OUTPUTS:
        assert checked.metrics[name]["rmse"] == checked.metrics[name]["uncorrected_rmse"]


def test_wrong_use_is_refused(driven: Dataset) -> None:
    other = zero_weights("orca", "another model")
    with pytest.raises(InputError, match="another model"):
        train(driven, PREDICTION, QUICK, initial=other)
    with pytest.raises(InputError, match="another model"):
        validate(other, driven, PREDICTION)
    own = zero_weights("orca", identity(driven, PREDICTION))
    with pytest.raises(InputError, match="no samples"):
        validate(own, driven.select(slice(0)), PREDICTION)
