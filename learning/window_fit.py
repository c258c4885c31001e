"""The fit of a car to its drives: windows, least squares, the noise of the instruments.

Multiple shooting: each window begins in a state of its own, and these states are eliminated from
each step of Levenberg and Marquardt. A window's states are those that its commands drive: it begins
by the delay later than they do.
"""

from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear
from threadpoolctl import threadpool_limits

from bayesrace.arrays import AnyArray, Flags, Floats
from bayesrace.columns import Columns
from bayesrace.errors import InputError
from bayesrace.learning.instruments import Drives, Windows, cut
from bayesrace.learning.single_track import Numbers, SingleTrack
from bayesrace.messages import QUANTITIES
from bayesrace.vehicles import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2, DcMotor, PacejkaTyres

__all__ = ["Fit", "polynomials", "states_of"]

_LEAST_S: Final = 4.0
"""Of driving."""
_SLOWEST: Final = 0.9
"""Times the root of gravity and wheelbase: slower, tyres are too stiff for the steps."""
_MOST_SLIP_RAD: Final = 0.35
_LONGEST_DELAY_S: Final = 0.25
"""Between a command and the car."""
_REFUSED: Final = 5.0
"""Standard deviations."""
_FAR: Final = 8.0
"""Times the middle distance of readings from a curve through all others."""
_WORSE: Final = 1.5
"""Times the error of the others: a window that does not count."""
_LOST: Final = 0.05
"""Of the wheelbase: a position that is so far off is not followed."""
_CLOSE: Final = 1e-6
"""Of the sum of squares: a step that takes off less is the last one of states alone."""
_MOST_STEPS: Final = {True: 40, False: 8}
"""With the numbers, and of states alone."""
_STUCK: Final = 1e4
"""Damping at which no step is tried any more."""
_STEPS: Final = 1e-5, 1e-6
"""Of differences: in the scale of each number, and in states."""


class _Number(NamedTuple):
    """Where a number begins, what it may be, its scale; ``prior``: its deviation from the start,
    for what a drive may not show."""

    start: float
    least: float
    most: float
    scale: float
    prior: float = np.inf


def _free(car: Car, wheelbase: bool, measured: set[str]) -> dict[str, _Number]:
    """What is to be found of :class:`Numbers`."""
    drive, size, gain = car.drive, car.friction * GRAVITY_MPS2, 1.0
    free = {"a3": _Number(0, -size, size, size), "a4": _Number(0, -np.inf, np.inf, 0.1)}
    if isinstance(drive, DcMotor):
        gain, *rest = (one / car.mass_kg for one in (drive.cm1, drive.cm2, drive.cr0, drive.cr2))
        free = {f"a{i}": _Number(one, 0, np.inf, gain) for i, one in enumerate(rest, 2)}
    free["a1"] = _Number(gain, 0.02 * gain, 50 * gain, gain)
    tyres = {"": _Number(5, 0.5, 100, 5, 20)}
    if isinstance(car.tyres, PacejkaTyres):
        tyres |= {"_curve": _Number(2, 0.05, 30, 2, 4), "_shape": _Number(1.4, 1, 2.2, 0.5, 0.4)}
    else:
        length_m = car.wheelbase_m
        free["height_m"] = _Number(0, -0.2 * length_m, length_m, length_m, 0.3 * length_m)
    free |= {f"{end}{name}": one for name, one in tyres.items() for end in ("front", "rear")}
    if "omega" in measured:
        free["gyro_radps"] = _Number(0, -5, 5, 0.1)
    if "delta" in measured:
        free["angle_rad"] = _Number(0, -1, 1, 0.1)
    return free | {
        "lag_s": _Number(0.01, 1e-5, 0.5, 0.02),
        "offset_rad": _Number(0, -0.5, 0.5, 0.1),
        "size" if wheelbase else "gain": _Number(1, 0.2, 5, 1),
        "inertia": _Number(0.7, 0.1, 5, 0.5, 0.5),
        "delay_s": _Number(0.02, 0, _LONGEST_DELAY_S, 0.02),
    }


class Fit:
    """The numbers of the car, the states of its windows, and the noise of the instruments."""

    def __init__(self, car: Car, drives: Drives, *, wheelbase: bool) -> None:
        """``car``: on tyres of the model that is to be found."""
        self.car, self.drives, instruments = car, drives, len(drives.instruments)
        measured = {QUANTITIES[of] for of in np.unique(drives.readings["of"])}
        if not measured >= {"x", "y", "psi"}:
            raise InputError(
                "no instrument measures x, y and psi: identification needs a pose, as of motion "
                "capture; log one beside the others"
            )
        free = _free(car, wheelbase, measured)
        free |= {f"late {i}": _Number(0, -0.1, 0.1, 0.02) for i in range(1, instruments)}
        self.names = tuple(free)
        start, least, most, self._scale, prior = np.array(list(free.values())).T
        self._bounds, self._prior = (least, most), 1 / prior
        self.theta = self._begun = self.clipped(start)
        self.noise = np.zeros((instruments, len(QUANTITIES)))
        """Over the deviation that readings state; 0: not found yet."""

    def clipped(self, theta: Floats) -> Floats:
        """Free numbers (p, m) within their bounds."""
        return np.clip(theta, *self._bounds)

    def numbers(self, theta: Floats) -> tuple[Floats, Floats]:
        """:class:`Numbers` of cars with these free ones (p, m), (p, n); and the delay from the
        command to what each instrument says of it, (p, instruments)."""
        free = dict(zip(self.names, theta.T, strict=True))
        known = {name: free[name] for name in free.keys() & set(Numbers._fields)}
        columns = [np.broadcast_to(one, len(theta)) for one in Numbers(**known)]
        late = [free.get(f"late {i}", 0.0) + free["delay_s"] for i in range(len(self.noise))]
        return np.column_stack(columns), np.column_stack(late)

    @property
    def used(self) -> Flags:
        """Which windows count, (w,)."""
        return np.asarray((self.windows.weight > 0).any(axis=1))

    @property
    def misfit(self) -> float:
        """Mean logarithm of the noise, over that which readings state."""
        found = self.noise > 0
        if not found.any():
            return np.inf
        return float(np.average(np.log(self.noise[found]), weights=self.counted[found]))

    @property
    def used_s(self) -> float:
        """Length of all of them."""
        return int(self.used.sum()) * self.periods * self.drives.step_s

    def improve(self, window_s: float, close: float) -> None:
        """Fits all numbers, until a step takes less than ``close`` off the sum of squares; then
        refuses what is far from the fit, and finds the noise."""
        self._cut(window_s)
        with threadpool_limits(1):  # several threads make it slower
            self._minimise(_CLOSE, numbers=False)
            self._refuse(windows=bool(self.noise.any()))
            self._minimise(close, numbers=True)
            self._refuse(windows=True)
            self._minimise(_CLOSE, numbers=False)
            self._find_noise()

    def _cut(self, window_s: float) -> None:
        """Cuts the drives, with the delays as they are known; leaves out what is of no use."""
        self.periods = max(4, round(window_s / self.drives.step_s))
        self.track = SingleTrack(self.car, self.drives, self.periods)
        length_s = self.periods * self.drives.step_s
        self._late_s = self.numbers(self.theta[None])[1][0]
        windows = cut(self.drives, self.periods, self._late_s)
        curves, good = polynomials(windows, 3, length_s)
        self.refused = int((~good & (windows.weight > 0)).sum())
        windows = windows.without(~good)
        begin, *inside = (states_of(curves, at, length_s) for at in (0.0, 0.1, 0.5, 0.9))
        slow = _SLOWEST * np.sqrt(GRAVITY_MPS2 * self.car.wheelbase_m)
        used = ((windows.weight > 0) & (windows.readings["of"] == 0)).sum(axis=1) >= 5
        for x in inside:
            used &= (x[:, 3] > slow) & (np.abs(np.arctan2(x[:, 4], x[:, 3])) < _MOST_SLIP_RAD)
        self.driven_s = len(used) * length_s
        if (used_s := used.sum() * length_s) < _LEAST_S:
            raise InputError(
                f"{used_s:.1f} s of driving faster than {slow:.2g} m/s without spinning; "
                f"{_LEAST_S:g} s are needed: drive longer or faster, as 'bayesrace collect "
                "--duration 30' does"
            )
        self.windows, self.states = windows.select(used), begin[used]
        self._check()

    def _check(self) -> None:
        """InputError if the commands do not excite the car."""
        d, commanded = self.track.commands(self.windows)
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

    def _errors(self, theta: Floats, states: AnyArray) -> AnyArray:
        """Readings less predictions, over their deviations; (p, w, r)."""
        numbers, late_s = self.numbers(theta)
        one, of = self.windows.readings, self.windows.readings["of"]
        since_s = self.windows.time_s - (late_s - self._late_s)[:, one["instrument"]]
        noise = np.where(self.noise > 0, self.noise, 1)[one["instrument"], of]
        with np.errstate(over="ignore", invalid="ignore"):  # far from the truth cars go astray
            path = self.track.drive(numbers, self.windows, states)
            error = one["value"] - self.track.measured(numbers, path, since_s, of)
            error = np.where(of == 2, np.remainder(error + np.pi, 2 * np.pi) - np.pi, error)
            error *= self.windows.weight / noise
            return np.asarray(np.clip(np.nan_to_num(error, nan=1e6), -1e6, 1e6))

    def linearised(self, *, numbers: bool = True) -> tuple[Floats, Floats, Floats]:
        """Errors (w, r), and slopes of predictions by the states (w, r, 6) and by the numbers
        (w, r, m), or none of these."""
        width, step = _STEPS
        steps = width * self._scale if numbers else np.zeros(0)
        moved = np.zeros((1 + len(steps) + 6, len(self.theta)))
        moved[1 : len(steps) + 1, : len(steps)] = np.diag(steps)
        states = np.zeros((len(moved), 1, 6))
        states[-6:, 0] = step * np.eye(6)
        errors = self._errors(self.theta + moved, self.states + states)
        slopes = np.moveaxis(errors[0] - errors[1:], 0, -1) / np.r_[steps, np.full(6, step)]
        return errors[0], slopes[..., len(steps) :], slopes[..., : len(steps)]

    def _minimise(self, close: float, *, numbers: bool) -> None:
        """Moves the states to where they fit best: with the numbers, or each window by itself."""
        damping = np.full(len(self.states), 1e-4)
        lines = self.linearised(numbers=numbers)
        for _ in range(_MOST_STEPS[numbers]):
            theta, states = self._moved(damping, *lines)
            squares = lines[0] ** 2
            less = (squares - self._errors(theta[None], states[None])[0] ** 2).sum(axis=1)
            doubt = self._doubt(self.theta) - self._doubt(theta)
            better = np.full(len(less), less.sum() + doubt >= 0) if numbers else less >= 0
            damping = np.where(better, damping / 10, damping * 10)
            if not better.any() and damping.min() < _STUCK:
                continue
            self.states = np.where(better[:, None], states, self.states)
            if better.all():
                self.theta = theta
            if less[better].sum() + doubt <= close * squares.sum():
                break
            lines = self.linearised(numbers=numbers)

    def _doubt(self, theta: Floats) -> float:
        """What the prior adds to the sum of squares."""
        return float(((self._prior * (theta - self._begun)) ** 2).sum())

    def _moved(
        self, damping: Floats, errors: Floats, by_state: Floats, by: Floats
    ) -> tuple[Floats, Floats]:
        """Numbers (m,), if there are slopes by them, and states (w, 6), after a step."""
        left, seen, r = _eliminated(by_state, np.dstack([by, errors]), damping)
        change = np.zeros(by.shape[-1])
        if len(change):
            slopes, (least, most) = left[:, :-1], self._bounds
            size = np.sqrt(damping[0]) * np.linalg.norm(slopes, axis=0)
            rows = np.vstack([slopes, np.diag(self._prior), np.diag(size)])
            doubt = self._prior * (self._begun - self.theta)
            aim = np.concatenate([left[:, -1], doubt, 0 * size])
            change = lsq_linear(rows, aim, (least - self.theta, most - self.theta)).x
        rest = seen[..., -1] - seen[..., :-1] @ change
        states = self.states + np.linalg.solve(r, rest[..., None])[..., 0]
        return self.clipped(self.theta + change) if len(change) else self.theta, states

    def _refuse(self, *, windows: bool) -> None:
        """Takes out readings that are far from the fit; and windows, in which the car does what no
        such car would, as where it slides."""
        left, used = np.abs(self.linearised(numbers=False)[0]), self.windows.weight > 0
        one = self.windows.readings
        channel = len(QUANTITIES) * one["instrument"] + one["of"]
        bad = np.zeros_like(used)
        for number in np.unique(channel[used]):
            rows = used & (channel == number)
            ordinary = np.median(left[rows]) / 0.67
            bad |= rows & (left > _REFUSED * max(1.0, ordinary))
        self.refused += int(bad.sum())
        if windows:
            kept = used & ~bad
            size = np.sqrt((np.where(kept, left, 0) ** 2).sum(axis=1) / kept.sum(axis=1).clip(1))
            bad |= (size > _WORSE * np.median(size[size > 0]))[:, None]
        self.windows = self.windows.without(bad)

    def _find_noise(self) -> None:
        errors, by_state, _ = self.linearised(numbers=False)
        left = 1 - (np.linalg.qr(by_state)[0] ** 2).sum(axis=2)
        where = self.windows.readings["instrument"], self.windows.readings["of"]
        known = np.where(self.noise > 0, self.noise, 1)[where]
        self.counted, squares = np.zeros_like(self.noise), np.zeros_like(self.noise)
        np.add.at(self.counted, where, left * (self.windows.weight > 0))
        np.add.at(squares, where, (errors * known) ** 2)
        self.noise = np.sqrt(squares / self.counted.clip(1)).clip(1e-3) * (squares > 0)

    def measured(self, instrument: int, of: int) -> Columns:
        """An instrument's readings of a quantity."""
        one = self.drives.readings
        rows = (one["instrument"] == instrument) & (one["of"] == of)
        return np.asarray(one[rows])

    def check(self) -> None:
        """InputError if positions are not followed."""
        for instrument, of in zip(*np.nonzero(self.noise[:, :2]), strict=True):
            stated_m = float(self.measured(instrument, of)["deviation"].max())
            off_m = self.noise[instrument, of] * stated_m
            if off_m > max(_LOST * self.car.wheelbase_m, 3 * stated_m):
                raise InputError(
                    f"no such car drove: its positions are off by {off_m:.2g} m from what the "
                    "commands do to it; give the file of the car that drove with --car, and logs "
                    "whose u_applied is what acted"
                )

    def covariance(self) -> Floats:
        """Of the numbers: of least squares, or by the scatter from window to window where this is
        more (Huber 1967, White 1980), as where the model is wrong."""
        errors, by_state, by = self.linearised()
        left, _, _ = _eliminated(by_state, by, np.zeros(len(by)))
        squares = left.T @ left + np.diag(self._prior**2)
        inverse = np.linalg.pinv(squares, hermitian=True)
        by_window = left.reshape(len(by), -1, by.shape[-1])[:, : by.shape[1]]
        pulls = np.einsum("wrm,wr->wm", by_window, errors)
        robust = inverse @ (pulls.T @ pulls) @ inverse
        grown = np.sqrt(np.maximum(np.diag(robust) / np.diag(inverse).clip(1e-300), 1))
        return np.asarray(inverse * np.outer(grown, grown))


def _eliminated(by_state: Floats, columns: Floats, damping: Floats) -> tuple[Floats, ...]:
    """What states do not explain of columns (w, r, m) of a least squares problem, ((r + 6) w, m),
    what they do (w, 6, m), and the triangle (w, 6, 6) to solve for them.

    ``damping`` (w,): of the step of the states, over the squares of their slopes.
    """
    size = np.sqrt(damping[:, None] * (by_state**2).sum(axis=1)) + 1e-6
    q, r = np.linalg.qr(np.concatenate([by_state, size[..., None] * np.eye(6)], axis=1))
    columns = np.pad(columns, ((0, 0), (0, 6), (0, 0)))
    seen = np.einsum("wrk,wrm->wkm", q, columns)
    return (columns - q @ seen).reshape(-1, columns.shape[-1]), seen, r


def polynomials(windows: Windows, degree: int, length_s: float) -> tuple[Floats, Flags]:
    """Through x, y and psi of windows, over time from 0 to 1; (3, w, degree + 1), lowest power
    first. And which readings are not far from them, (w, r)."""
    powers = (windows.time_s / length_s)[..., None] ** np.arange(degree + 1)
    good = np.ones(windows.weight.shape, bool)
    curves = np.zeros((3, len(good), degree + 1))
    for _ in range(4):
        for of in range(3):
            here = (windows.readings["of"] == of) & (windows.weight > 0)
            weighted = powers * (good & here)[..., None]
            squares = np.einsum("wri,wrj->wij", weighted, powers) + 1e-9 * np.eye(degree + 1)
            product = np.einsum("wri,wr->wi", weighted, windows.readings["value"])
            curves[of] = np.linalg.solve(squares, product[..., None])[..., 0]
            off = np.abs(np.einsum("wri,wi->wr", powers, curves[of]) - windows.readings["value"])
            # of a curve through all others, which a reading at the end bends to itself
            own = np.einsum("wri,wij,wrj->wr", weighted, np.linalg.inv(squares), powers)
            off /= (1 - own).clip(0.02)
            middle = np.where(here, off, np.nan)
            middle[~here.any(axis=1)] = 0
            middle = np.nanmedian(middle, axis=1, keepdims=True)
            least = np.maximum(middle, np.median(off[here & good]))
            far = off > _FAR * np.maximum(least, 1 / windows.weight.clip(1e-12))
            good = np.where(here, ~far, good)
    return curves, good


def states_of(curves: Floats, at: float, length_s: float) -> Floats:
    """x, y, psi, vx, vy, omega (w, 6) at a moment from 0 to 1."""
    count = np.arange(curves.shape[-1])
    pose = curves @ at**count
    x_rate, y_rate, omega = curves[..., 1:] @ (count[1:] * at ** (count[1:] - 1)) / length_s
    head, left = np.cos(pose[2]), np.sin(pose[2])
    velocity = x_rate * head + y_rate * left, y_rate * head - x_rate * left
    return np.stack([*pose, *velocity, omega], axis=-1)
