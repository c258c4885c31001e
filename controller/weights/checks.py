"""What new weights must pass before the controller adopts them, and the process that checks them.

Decoding and checking take some 0.1 s of the interpreter's lock, which the control thread must not
wait for; and a file that brings the checks down does not bring down the controller. So a process of
its own checks each file.
"""

import os
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgpack
import numpy as np

from bayesrace.arrays import Floats
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import WATCHED, GateSettings, MpcSettings
from bayesrace.errors import InputError
from bayesrace.gp.weights import FEATURES, OUTPUTS, UNITS, Weights, decode_weights, pack_weights
from bayesrace.messages import Scalar
from bayesrace.processes import RUN_MODULE, die_with_parent
from bayesrace.vehicles import described_car
from bayesrace.vehicles.parameters import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = [
    "NO_SAMPLES", "Checks", "Samples", "Verdict", "compare", "judged",
    "plausible_features", "slack_of",
]  # fmt: skip

_CLOCKS_APART_S: Final = 3600.0
"""By which the clock of the training host may be ahead."""
_ONE_SIDED: Final = 0.5
"""Share of the nominal errors that the mean error on a file's own samples may have."""
_MOST: Final = 15.0
"""Times its usable acceleration, no car corners: more than the 1:43 car at full lock and speed."""
_NICE: Final = 10
"""Of the process, below the controller."""
_LARGEST: Final = 1e12
"""Errors that are not finite count as this large."""


class Samples(NamedTuple):
    """What the car did: features (n, 6), the residuals (n, 3) of the nominal model, and the
    variances (n, 3) of these where states are estimated, else 0."""

    features: Floats
    residuals: Floats
    noise: Floats


NO_SAMPLES: Final = Samples(np.zeros((0, 6)), *np.zeros((2, 0, 3)))


def plausible_features(car: Car, count: int) -> Floats:
    """Features (count, 6) over the whole range of the car, always the same ones."""
    vx, slip, turn, steer, push, rate = np.random.default_rng(5).uniform(-1, 1, (count, 6)).T
    vx = 0.5 * (vx + 1) * car.drive.top_speed_mps(car.d_max)
    sharpest = vx * np.tan(car.delta_max_rad) / car.wheelbase_m
    with np.errstate(divide="ignore"):
        omega = turn * np.minimum(sharpest, _MOST * car.friction * GRAVITY_MPS2 / vx)
    delta = steer * car.delta_max_rad
    d = car.d_min + 0.5 * (push + 1) * (car.d_max - car.d_min)
    return np.column_stack([vx, 0.3 * slip * vx, omega, delta, d, rate * car.delta_rate_max_radps])


class Verdict(NamedTuple):
    """Whether weights may be adopted."""

    text: str
    data: dict[str, Scalar]
    packed: bytes = b""
    """Arrays of accepted weights, by :func:`bayesrace.gp.weights.pack_weights`; else empty."""


class Checks:
    """The tests for one controller."""

    def __init__(
        self,
        settings: GateSettings,
        artefact: Path,
        car: Car,
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        """``parameters``: as of :class:`.NativeStep`."""
        self._settings, self._car = settings, car
        self._step = NativeStep(artefact, car, MpcSettings(), parameters)
        self._step_s = self._step.manifest.step_s
        self._slack = slack_of(car, self._step_s)

    def judge(
        self,
        data: bytes,
        recent: Samples = NO_SAMPLES,
        in_use: bytes = b"",
        reference: bytes = b"",
        accepted_utc_ns: int = 0,
    ) -> Verdict:
        """Whether a weights file may be adopted.

        ``recent``: what the car did last. ``in_use``, ``reference``: files of the weights in use
        and of the newest proven ones; empty: no correction. ``accepted_utc_ns``: of those in use,
        by the calendar; they count as made no later. 0: not known.
        """
        facts: dict[str, Scalar] = {}
        try:
            new = decode_weights(data)
            self._step.set_weights(new)  # InputError if they are for another model, or too large
            facts["version"] = new.version
            self._check_origin(new, _decoded(in_use), accepted_utc_ns)
            self._check_bounds(new, recent)
            self._check_own_samples(new)
            probation = len(recent.features) < self._settings.least_samples
            facts |= {"samples": len(recent.features), "probation": probation}
            text = (
                f"on probation: {len(recent.features)} recent samples are too few to compare"
                if probation
                else self._compare(new, recent, map(_decoded, {in_use, reference}), facts)
            )
        except InputError as error:
            return Verdict(str(error), facts)
        return Verdict(text, facts, pack_weights(new))

    def check_start(self, data: bytes, recent: Samples = NO_SAMPLES) -> bytes:
        """Arrays of weights that may drive from the start, as ``packed`` of a verdict; InputError
        for others. ``recent``: what the car did last, if it has moved."""
        weights = decode_weights(data)
        if any(weights.counts) and not len(weights.sample_features):
            raise InputError(
                f"weights '{weights.version}' hold no samples that they can be checked by; train "
                "again, or start without them and use 'bayesrace publish'"
            )
        verdict = self.judge(data, recent)
        if not verdict.packed:
            raise InputError(verdict.text)
        return verdict.packed

    def _after(self, weights: Weights | None, features: Floats) -> Floats:
        """vx, vy, omega (n, 3) a step later, by the model that these weights correct; NaN where it
        has no value."""
        if weights is None:
            self._step.load_weights(b"")
        else:
            self._step.set_weights(weights)
        found = np.full((len(features), len(OUTPUTS)), np.nan)
        for row, one in zip(found, features, strict=True):
            x, u = np.concatenate([np.zeros(3), one[:4]]), one[4:]
            with suppress(InputError):  # a state that is absurd, or that the weights make absurd
                row[:] = self._step.predict(x, u, self._step_s)[3:6]
        return found

    def _mean(self, weights: Weights | None, features: Floats) -> Floats:
        """The correction (n, 3) per step; NaN where a model has no value."""
        return self._after(weights, features) - self._after(None, features)

    def _errors(self, weights: Weights | None, samples: Samples) -> Floats:
        """What is left of the residuals (n, 3); infinite where a model has no value."""
        left = samples.residuals - self._mean(weights, samples.features)
        return np.where(np.isfinite(left), left, np.inf)

    def _check_origin(self, weights: Weights, others: Weights | None, accepted_utc_ns: int) -> None:
        made_ns, why_not = 0 if others is None else others.created_utc_ns, ""
        older_s = (min(made_ns, accepted_utc_ns or time.time_ns()) - weights.created_utc_ns) * 1e-9
        ahead_s = (weights.created_utc_ns - time.time_ns()) * 1e-9
        if weights.car != self._car.name:
            why_not = f"those of the car '{weights.car}', this is '{self._car.name}'"
        elif ahead_s > _CLOCKS_APART_S:
            why_not = f"dated {ahead_s:.3g} s ahead: set the clocks, and train again"
        elif others is not None and weights.created_utc_ns and older_s > 0:
            why_not = (
                f"stale: made {older_s:.3g} s before those in use, '{others.version}'; train "
                "again, or return to earlier ones with 'bayesrace rollback'"
            )
        if why_not:
            raise InputError(f"weights '{weights.version}' are {why_not}")

    def _check_bounds(self, new: Weights, recent: Samples) -> None:
        limit = np.array(self._car.tuning.gate.absurd)
        places = {
            "over the car's range": plausible_features(self._car, self._settings.plausible_states),
            "in its recent states": recent.features,
        }
        for where, features in places.items():
            known = np.isfinite(self._after(None, features)).all(axis=1)
            excess = np.abs(self._mean(new, features)[known]) / self._step_s
            if not (excess <= limit).all():  # NaN: the corrected model leaves all bounds
                worst = ", ".join(f"{value:.3g}" for value in excess.max(axis=0))
                most = ", ".join(f"{value:g}" for value in limit)
                raise InputError(
                    f"weights are absurd {where}: they correct accelerations (m/s^2, m/s^2, "
                    f"rad/s^2) by up to {worst}, and {most} is the most; train again"
                )

    def _check_own_samples(self, weights: Weights) -> None:
        """The weights must predict the samples that they were learned from."""
        if not len(weights.sample_features):
            return
        # What smoothing has left unknown of these is small beside their residuals.
        exact = np.zeros_like(weights.sample_residuals)
        samples = Samples(weights.sample_features, weights.sample_residuals, exact)
        errors, without = self._errors(weights, samples), _rms(samples.residuals)
        # A posterior mean fits its own samples: neither do errors grow, nor are they one-sided.
        better = _rms(errors) <= without + self._slack
        better &= np.abs(errors.mean(axis=0)) <= _ONE_SIDED * without + self._slack
        worse = " and ".join(name for name, good in zip(OUTPUTS, better, strict=True) if not good)
        if worse:
            raise InputError(
                f"weights '{weights.version}' predict {worse} worse than no correction does, on "
                "the samples that they were learned from: they are damaged; train again"
            )

    def _compare(
        self,
        new: Weights,
        recent: Samples,
        others: Iterable[Weights | None],
        facts: dict[str, Scalar],
    ) -> str:
        """What speaks for the weights, on recent samples; InputError if they are worse."""
        usable = np.isfinite(self._errors(None, recent)).all(axis=1)

        def rms(errors: Floats) -> Floats:
            return _rms(errors[usable], recent.noise[usable], self._slack)

        rmse, *before = (rms(self._errors(one, recent)) for one in (new, *others))
        found = compare(
            self._settings, self._slack, int(usable.sum()), rmse, np.min(before, axis=0),
            rms(recent.residuals),
        )  # fmt: skip
        facts |= found.data
        if found.worse:
            raise InputError(
                f"weights '{facts['version']}' predict {found.worse} worse than those in use: "
                f"{found.text}; train again, on this car's own laps"
            )
        return found.text


def _decoded(data: bytes) -> Weights | None:
    return decode_weights(data) if data else None


def _rms(errors: Floats, noise: Floats | float = 0.0, resolution: Floats | float = 1.0) -> Floats:
    """Of each column, beyond what noise of these variances (n, 3) explains; 0 without rows.

    A sample counts less, the larger its noise beside the ``resolution`` (3,). The same as
    br_mpc_get_watch.
    """
    weights = 1 / (1 + np.broadcast_to(noise, errors.shape) / np.square(resolution))
    beyond = (weights * (errors**2 - noise)).sum(axis=0)
    squares: Floats = np.sqrt(np.maximum(beyond, 0) / np.maximum(weights.sum(axis=0), 1e-30))
    return squares


class Comparison(NamedTuple):
    """One-step errors of new weights and others over the same samples."""

    worse: str
    """Outputs for which the new weights are worse, by :class:`GateSettings`; empty: none."""
    text: str
    data: dict[str, Scalar]
    """The number of ``samples``, and errors such as ``error_new_vx``."""


def slack_of(car: Car, step_s: float) -> Floats:
    """What errors may differ by in any case (3,): the resolution of measurements."""
    return np.array(car.tuning.gate.resolution) * step_s


def compare(
    settings: GateSettings,
    slack: Floats,
    samples: int,
    new: Sequence[float] | Floats,
    old: Sequence[float] | Floats,
    nominal: Sequence[float] | Floats,
) -> Comparison:
    """New weights against old ones, and against none, by their errors (3,) on so many samples."""
    rmse = {
        what: np.minimum(np.asarray(errors, dtype=np.float64), _LARGEST)
        for what, errors in (("new", new), ("old", old), ("nominal", nominal))
    }
    # The excess over a whole window is what counts: fewer samples must be worse by as much in all.
    few = max(WATCHED / max(samples, 1), 1.0)
    allowed = settings.worse_factor * rmse["old"] + settings.worse_share * rmse["nominal"]
    # As large as can be on both sides is worse, too.
    fine = (rmse["new"] <= allowed + few * slack) & (rmse["new"] < _LARGEST)
    worse = " and ".join(name for name, good in zip(OUTPUTS, fine, strict=True) if not good)
    data: dict[str, Scalar] = {"samples": samples}
    for (what, errors), (j, name) in product(rmse.items(), enumerate(OUTPUTS)):
        data[f"error_{what}_{name}"] = float(errors[j])
    changes = ", ".join(
        f"{name} {rmse['old'][j]:.4g} to {rmse['new'][j]:.4g} {UNITS[name]}"
        for j, name in enumerate(OUTPUTS)
    )
    return Comparison(worse, f"one-step errors over {samples} samples go from {changes}", data)


# The process -------------------------------------------------------------------------------------


def judged(question: Mapping[str, Any], until_s: float) -> Any:
    """The fields of a :class:`Verdict` on the question, from another process.

    ``question``: artefact and car (texts), settings (JSON), the recent samples (bytes of each of
    their arrays), the files and the time of :meth:`Checks.judge` by name. ``until_s``: deadline on
    the monotonic clock, when the process is killed. InputError without a verdict.
    """
    line = [*RUN_MODULE, __name__, str(os.getpid())]
    asked, left_s = msgpack.packb(question), max(until_s - time.monotonic(), 0.0)
    try:
        ended = subprocess.run(line, input=asked, capture_output=True, timeout=left_s, check=False)
    except OSError as error:
        raise InputError(f"no process to check them: {error.strerror}") from None
    except subprocess.TimeoutExpired:
        raise InputError("the check of the weights did not end in time") from None
    if ended.returncode:
        last = ended.stderr.decode(errors="replace").strip().splitlines()[-1:]
        how = f"ended with code {ended.returncode}"
        raise InputError(f"the check of the weights {': '.join([how, *last])}")
    return msgpack.unpackb(ended.stdout)


def main() -> int:
    """The program: a question on standard input, the verdict on standard output."""
    die_with_parent(int(sys.argv[1]))
    os.nice(_NICE)
    question = msgpack.unpackb(sys.stdin.buffer.read())
    settings = GateSettings.model_validate_json(question.pop("settings"))
    car, artefact = described_car(question.pop("car")), Path(question.pop("artefact"))
    features, *others = (np.frombuffer(question.pop(name)) for name in Samples._fields)
    by_output = (one.reshape(-1, len(OUTPUTS)) for one in others)
    recent = Samples(features.reshape(-1, len(FEATURES)), *by_output)
    verdict = Checks(settings, artefact, car).judge(recent=recent, **question)
    sys.stdout.buffer.write(msgpack.packb(verdict._asdict()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
