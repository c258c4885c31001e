"""The fit of a car to its drives: windows, least squares, the noise of the instruments.

Multiple shooting: each window begins in a state of its own, and these states are eliminated (Golub
and Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems", 1973).
"""

from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from bayesrace.arrays import AnyArray, Flags, Floats
from bayesrace.errors import InputError
from bayesrace.learning.instruments import Recorded, Windows, cut
from bayesrace.learning.single_track import LONGEST_DELAY_S, Numbers, SingleTrack
from bayesrace.messages import QUANTITIES
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2, DcMotor

__all__ = ["MOST_SLIP_RAD", "Fit", "polynomials", "states_of"]

_LEAST_S: Final = 4.0
"""Of driving."""
_SLOWEST: Final = 0.9
"""Times the root of gravity and wheelbase: slower, tyres are too stiff for the steps."""
MOST_SLIP_RAD: Final = 0.35
_REFUSED: Final = 5.0
"""Standard deviations."""
_FAR: Final = 8.0
"""Times the middle distance of readings from a curve through all others."""
_WORSE: Final = 1.5
"""Times the error of the others: a window that does not count."""
_LOST: Final = 0.05
"""Of the wheelbase: a position that is so far off is not followed."""
_CLOSE: Final = 1e-6
"""Of the sum of squares: what other states would take off it, when they are settled."""
_MOST_STEPS: Final = 8
"""Of the states of a window, with the numbers of the car as they are."""
_STEP: Final = 1e-5
"""Of differences, in the scale of each number."""


class _Number(NamedTuple):
    """Where a number begins, what it may be, its scale; ``prior``: its deviation from the start,
    for what a drive may not show."""

    start: float
    least: float
    most: float
    scale: float
    prior: float = np.inf


def _numbers(car: CarParameters, wheelbase: bool, measured: set[int]) -> dict[str, _Number]:
    """All of :class:`Numbers`; those that stay as they are have a scale of 0."""
    drive, mass, soft = car.drive, car.mass_kg, 1 / car.friction
    if isinstance(drive, DcMotor):
        a1, a2, a3, a4 = (one / mass for one in (drive.cm1, drive.cm2, drive.cr0, drive.cr2))
        found = {
            "a1": _Number(a1, 0.02 * a1, 50 * a1, a1),
            "a2": _Number(a2, 0, np.inf, a1),
            "a3": _Number(a3, 0, np.inf, a1),
            "a4": _Number(a4, 0, np.inf, a1),
        }
    else:
        size = car.friction * GRAVITY_MPS2
        found = {
            "a1": _Number(1.0, 0.02, 50, 1.0),
            "a2": _Number(0, 0, 0, 0),
            "a3": _Number(0, -size, size, size),
            "a4": _Number(0, -np.inf, np.inf, 0.1),
        }
    fixed = _Number(0, 0, 0, 0)
    offsets = {
        "gyro_radps": _Number(0, -5, 5, 0.1) if QUANTITIES.index("omega") in measured else fixed,
        "angle_rad": _Number(0, -1, 1, 0.1) if QUANTITIES.index("delta") in measured else fixed,
    }
    one = _Number(1, 1, 1, 0)
    return found | {
        "delay_s": _Number(0.02, 0, LONGEST_DELAY_S, 0.02),
        "lag_s": _Number(0.01, 1e-5, 0.5, 0.02),
        "offset_rad": _Number(0, -0.5, 0.5, 0.1),
        "gain": one if wheelbase else _Number(1, 0.2, 5, 1),
        "size": _Number(1, 0.2, 5, 1) if wheelbase else one,
        "front": _Number(5, 0.5, 100, 5, 20),
        "rear": _Number(5, 0.5, 100, 5, 20),
        "front_soft": _Number(0.5 * soft, 0.01, 10 * soft, soft, soft),
        "rear_soft": _Number(0.5 * soft, 0.01, 10 * soft, soft, soft),
        "front_shape": _Number(1.4, 1.0, 2.2, 0.5, 0.4),
        "rear_shape": _Number(1.4, 1.0, 2.2, 0.5, 0.4),
        "inertia": _Number(0.7, 0.1, 5, 0.5, 0.5),
        "bend": _Number(1, -1, 3, 0.5, 1),
        "turned": _Number(0, -1, 2, 0.5, 0.5),
        "height_m": _Number(0, -0.2 * car.wheelbase_m, car.wheelbase_m, 0.1, 0.3 * car.wheelbase_m),
        **offsets,
    }


class Fit:
    """The numbers of the car, the states of its windows, and the noise of the instruments."""

    def __init__(
        self, car: CarParameters, runs: list[Recorded], instruments: int, wheelbase: bool
    ) -> None:
        self.car, self.runs, self.instruments = car, runs, instruments
        self.step_s = runs[0].step_s
        measured = {int(of) for run in runs for of in np.unique(run.readings.of)}
        if not measured >= {0, 1, 2}:
            raise InputError(
                "no instrument measures x, y and psi: identification needs a pose, as of motion "
                "capture; log one beside the others"
            )
        table = _numbers(car, wheelbase, measured)
        ordered = [table[name] for name in Numbers._fields]
        ordered += [_Number(0, -0.1, 0.1, 0.02)] * (instruments - 1)
        self._start = np.array([one.start for one in ordered])
        self.free = np.flatnonzero([one.scale > 0 for one in ordered])
        chosen = [ordered[i] for i in self.free]
        self.scale = np.array([one.scale for one in chosen])
        self._bounds = [one.least for one in chosen], [one.most for one in chosen]
        self._prior = 1 / np.array([one.prior for one in chosen])
        self.theta = np.clip(self._start[self.free], *self._bounds)
        self._begun = self.theta.copy()
        self.deviation: Floats = np.zeros((instruments, len(QUANTITIES)))
        """Of the noise as it was found; 0: as the readings say."""

    def numbers(self, theta: Floats) -> tuple[Numbers, Floats]:
        """Of cars with these free numbers (p, m); and by how much their instruments are late,
        (p, instruments)."""
        whole = np.tile(self._start, (len(theta), 1))
        whole[:, self.free] = theta
        count = len(Numbers._fields)
        late_s = np.column_stack([np.zeros(len(theta)), whole[:, count:]])
        return Numbers(*whole[:, :count].T[..., None]), late_s

    @property
    def used(self) -> Flags:
        """Which windows count, (w,)."""
        return np.asarray((self.windows.weight > 0).any(axis=1))

    def clipped(self, theta: Floats) -> Floats:
        """Free numbers (p, m) within their bounds."""
        return np.clip(theta, *self._bounds)

    def _cut(self, window_s: float) -> None:
        """Cuts the drives, with the delays as they are known; leaves out what is of no use."""
        self.periods = max(4, round(window_s / self.step_s))
        self.track = SingleTrack(self.car, self.runs, self.periods)
        length_s = self.periods * self.step_s
        windows = cut(self.runs, self.periods, self.numbers(self.theta[None])[1][0])
        curves, good = polynomials(windows, 3, length_s)
        self.refused = int((~good & (windows.weight > 0)).sum())
        windows = windows.without(~good)
        self.states = states_of(curves, 0.0, length_s)
        ends = np.stack([states_of(curves, at, length_s) for at in (0.1, 0.5, 0.9)])
        slow = _SLOWEST * np.sqrt(GRAVITY_MPS2 * self.car.wheelbase_m)
        slip = np.abs(np.arctan2(ends[:, 4], ends[:, 3])).max(axis=0)
        poses = ((windows.weight > 0) & (windows.of == 0)).sum(axis=1)
        used = (ends[:, 3].min(axis=0) > slow) & (slip < MOST_SLIP_RAD) & (poses >= 5)
        self.driven_s = len(used) * length_s
        if (used_s := used.sum() * length_s) < _LEAST_S:
            raise InputError(
                f"{used_s:.1f} s of driving faster than {slow:.2g} m/s without spinning; "
                f"{_LEAST_S:g} s are needed: drive longer or faster, as 'bayesrace collect "
                "--duration 30' does"
            )
        self.windows, self.states = windows.select(used), self.states[:, used]
        self.base = self.track.base(self.windows)
        self._check()

    def _check(self) -> None:
        """InputError if the commands do not excite the car."""
        index = (self.base[:, None] + np.arange(self.periods)).ravel()
        d, commanded = self.track.commands(index)
        least = 0.02 * (self.car.d_max - self.car.d_min), 0.02 * self.car.delta_max_rad
        for what, spread, enough in zip(
            ("drive command", "commanded steering angle"), (d.std(), commanded.std()), least,
            strict=True,
        ):  # fmt: skip
            if spread < enough:
                raise InputError(
                    f"the {what} hardly changes (by {spread:.2g}, {enough:.2g} are needed): drive "
                    "with both inputs disturbed, as 'bayesrace collect' does"
                )

    def _weights(self) -> Floats:
        known = self.deviation[self.windows.instrument, self.windows.of]
        weight = self.windows.weight
        return np.where((weight > 0) & (known > 0), 1 / np.where(known > 0, known, 1), weight)

    def _errors(self, theta: Floats, states: AnyArray) -> AnyArray:
        """Readings less predictions, over their deviations; (p, w, r)."""
        numbers, late_s = self.numbers(theta)
        windows = self.windows
        time_s = windows.time_s - late_s[:, windows.instrument]
        with np.errstate(over="ignore", invalid="ignore"):  # far from the truth cars go astray
            path = self.track.drive(numbers, self.base, states)
            said = self.track.measured(numbers, self.base, path, time_s, windows.of)
            error = windows.value - said
            error = np.where(windows.of == 2, np.remainder(error + np.pi, 2 * np.pi) - np.pi, error)
            return np.clip(np.nan_to_num(error * self._weights(), nan=1e6), -1e6, 1e6)

    def _linearised(self, theta: Floats, *, numbers: bool) -> tuple[Floats, Floats, Floats, Floats]:
        """Errors (w, r) about the states, an orthonormal basis of what states explain and its
        triangle, and the derivatives by the numbers (w, r, m)."""
        steps = _STEP * self.scale if numbers else np.zeros(0)
        by_state = 1e-6 * np.eye(6)
        moved = theta + np.diag(steps) if numbers else np.zeros((0, len(theta)))
        thetas = np.vstack([theta, moved, np.tile(theta, (6, 1))])
        still = np.zeros((6, 1 + len(steps)))
        states = self.states[:, None] + np.hstack([still, by_state])[..., None]
        errors = self._errors(thetas, states)
        slopes = np.moveaxis(errors[0] - errors[1:], 0, -1)
        q, r = np.linalg.qr(slopes[..., len(steps) :] / 1e-6)
        return errors[0], q, r, slopes[..., : len(steps)] / steps

    def settle(self, theta: Floats) -> tuple[Floats, Floats]:
        """Moves the states to where they fit best; what remains (w, r), and the basis of slopes."""
        errors, q, r, _ = self._linearised(theta, numbers=False)
        states, damping = self.states, np.full(len(self.base), 1e-6)
        for _ in range(_MOST_STEPS):
            explained = np.einsum("wrk,wr->wk", q, errors)
            if (explained**2).sum() <= _CLOSE * (errors**2).sum():
                break
            squares = np.einsum("wki,wkj->wij", r, r)
            squares += np.einsum("w,wij,ij->wij", damping, squares, np.eye(6)) + 1e-9 * np.eye(6)
            pull = np.einsum("wki,wk->wi", r, explained)
            step = np.linalg.solve(squares, pull[..., None])[..., 0]
            before, self.states = (errors**2).sum(axis=1), states + step.T
            errors_, q_, r_, _ = self._linearised(theta, numbers=False)
            after = (errors_**2).sum(axis=1)
            better = after <= before
            damping = np.where(better, damping / 10, np.maximum(damping, 1e-4) * 10)
            states = np.where(better, self.states, states)
            errors, q, r = (
                np.where(better.reshape(-1, *[1] * (old.ndim - 1)), new, old)
                for new, old in ((errors_, errors), (q_, q), (r_, r))
            )
        self.states = states
        explained = np.einsum("wrk,wk->wr", q, np.einsum("wrk,wr->wk", q, errors))
        return np.asarray(errors - explained), q

    def _remaining(self, theta: Floats) -> Floats:
        begun, states, by = self._accepted
        self.states = states + np.einsum("wkm,m->kw", by, theta - begun)
        left, _ = self.settle(theta)
        return np.concatenate([left.ravel(), self._prior * (theta - self._begun)])

    def slopes(self, theta: Floats) -> Floats:
        """Derivatives of what remains by the numbers, (w, r, m), the states being settled."""
        _, q, r, by = self._linearised(theta, numbers=True)
        explained = np.einsum("wrk,wrm->wkm", q, by)
        self._accepted = theta.copy(), self.states, -_solved(r, explained)
        return np.asarray(np.einsum("wrk,wkm->wrm", q, explained) - by)

    def _slopes(self, theta: Floats) -> Floats:
        by = self.slopes(theta)
        return np.vstack([by.reshape(-1, by.shape[-1]), np.diag(self._prior)])

    def improve(self, window_s: float, close: float) -> None:
        """Fits all numbers; then refuses what is far from the fit, and finds the noise."""
        self._cut(window_s)
        self._refuse(windows=bool(self.deviation.any()))
        self._accepted = self.theta, self.states, np.zeros((len(self.base), 6, len(self.theta)))
        with threadpool_limits(1):  # several threads make it slower
            found = least_squares(
                self._remaining, self.theta, self._slopes, self._bounds, x_scale=self.scale,
                max_nfev=40, ftol=close, xtol=1e-6,
            )  # fmt: skip
        self.theta = found.x
        self._refuse(windows=True)
        self._find_noise(*self.settle(self.theta))
        self._check_fit()

    def _refuse(self, *, windows: bool) -> None:
        """Takes out readings that are far from the fit; and windows, in which the car does what no
        such car would, as where it slides."""
        left, _ = self.settle(self.theta)
        used = self.windows.weight > 0
        ordinary = float(np.median(np.abs(left[used]))) / 0.67
        bad = (np.abs(left) > _REFUSED * max(1.0, ordinary)) & used
        self.refused += int(bad.sum())
        if windows:
            kept = used & ~bad
            size = np.sqrt((np.where(kept, left, 0) ** 2).sum(axis=1) / kept.sum(axis=1).clip(1))
            bad |= (size > _WORSE * np.median(size[size > 0]))[:, None]
        self.windows = self.windows.without(bad)

    def _find_noise(self, left: Floats, q: Floats) -> None:
        free = (1 - (q**2).sum(axis=2)) * (self.windows.weight > 0)
        squared = (left / self._weights().clip(1e-12)) ** 2 * (self.windows.weight > 0)
        self.counted = np.zeros_like(self.deviation)
        deviation = np.zeros_like(self.deviation)
        where = self.windows.instrument, self.windows.of
        np.add.at(self.counted, where, free)
        np.add.at(deviation, where, squared)
        self.deviation = np.sqrt(deviation / self.counted.clip(1)).clip(1e-6) * (deviation > 0)

    def _check_fit(self) -> None:
        """InputError if positions are not followed."""
        stated_m = max(
            float(run.readings.deviation[run.readings.of < 2].max()) for run in self.runs
        )
        far_m = max(_LOST * self.car.wheelbase_m, 3 * stated_m)
        if (off_m := float(self.deviation[:, :2].max())) > far_m:
            raise InputError(
                f"no such car drove: its positions are off by {off_m:.2g} m from what the commands "
                "do to it; give the file of the car that drove with --car, and logs whose "
                "u_applied is what acted"
            )

    def covariance(self) -> Floats:
        """Of the numbers: of least squares, or by the scatter from window to window where this is
        more (Huber 1967, White 1980), as where the model is wrong."""
        by = self.slopes(self.theta)
        left, _ = self.settle(self.theta)
        squares = np.einsum("wrm,wrn->mn", by, by) + np.diag(self._prior**2)
        inverse = np.linalg.pinv(squares, hermitian=True)
        pulls = np.einsum("wrm,wr->wm", by, left)
        robust = inverse @ (pulls.T @ pulls) @ inverse
        grown = np.sqrt(np.maximum(np.diag(robust) / np.diag(inverse).clip(1e-300), 1))
        return inverse * np.outer(grown, grown)


def _solved(r: Floats, right: Floats) -> Floats:
    """Of triangles (w, 6, 6), which may be singular where readings are missing."""
    solved = np.linalg.solve(r + 1e-9 * np.eye(6), right)
    return np.asarray(np.nan_to_num(solved))


def polynomials(
    windows: Windows, degree: int, length_s: float, *, alone: bool = False
) -> tuple[Floats, Flags]:
    """Through x, y and psi of windows, over time from 0 to 1; (3, w, degree + 1), lowest power
    first. And which readings are not far from them, (w, r); ``alone``: by the median of all
    windows, where a curve is near to all that it should be."""
    powers = (windows.time_s / length_s)[..., None] ** np.arange(degree + 1)
    good = np.ones(windows.of.shape, bool)
    curves = np.zeros((3, len(good), degree + 1))
    for _ in range(4):
        for of in range(3):
            here = (windows.of == of) & (windows.weight > 0)
            weighted = powers * (good & here)[..., None]
            squares = np.einsum("wri,wrj->wij", weighted, powers) + 1e-9 * np.eye(degree + 1)
            product = np.einsum("wri,wr->wi", weighted, windows.value)
            curves[of] = np.linalg.solve(squares, product[..., None])[..., 0]
            off = np.abs(np.einsum("wri,wi->wr", powers, curves[of]) - windows.value)
            # of a curve through all others, which a reading at the end bends to itself
            own = np.einsum("wri,wij,wrj->wr", weighted, np.linalg.inv(squares), powers)
            off /= (1 - own).clip(0.02)
            ordinary = np.median(off[here & good])
            middle = np.where(here, off, np.nan)
            middle[~here.any(axis=1)] = 0
            middle = np.nanmedian(middle, axis=1, keepdims=True)
            far = off > _FAR * np.maximum(
                np.maximum(middle, ordinary), 1 / windows.weight.clip(1e-12)
            )
            if alone:
                least = np.maximum(ordinary, 1 / windows.weight.clip(1e-12))
                far = here & good & (off > _FAR * least)
                good &= ~(far & (off == np.where(far, off, 0).max(axis=1, keepdims=True)))
            else:
                good = np.where(here, ~far, good)
    return curves, good


def states_of(curves: Floats, at: float, length_s: float) -> Floats:
    """x, y, psi, vx, vy, omega (6, w) at a moment from 0 to 1."""
    count = np.arange(curves.shape[-1])
    pose = curves @ at**count
    x_rate, y_rate, omega = curves[..., 1:] @ (count[1:] * at ** (count[1:] - 1)) / length_s
    head, left = np.cos(pose[2]), np.sin(pose[2])
    return np.stack([*pose, x_rate * head + y_rate * left, y_rate * head - x_rate * left, omega])
