"""Racing as a Gymnasium environment: learned policies drive the same cars on the same tracks, and
are timed by the same rule, as the controller. docs/gym.md shows its use."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesrace.api.place import Centreline, LapTimer, curvature_table
from bayesrace.api.simulator import Simulator
from bayesrace.api.values import Input, State, car_of, optional, track_of
from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.operation.analysis.laps import SHORT_CUT
from bayesrace.plant.world import World
from bayesrace.tracks import Track
from bayesrace.vehicles import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2

if TYPE_CHECKING:
    import gymnasium

    from bayesrace.api.picture import CarPicture
else:
    gymnasium = optional("gymnasium", "gym")

__all__ = ["ENV_ID", "OBSERVED", "RaceEnv"]

ENV_ID: Final = "bayesrace/Race-v0"
"""By which ``gymnasium.make`` knows the environment once this module is imported."""

OBSERVED: Final = (
    "vx", "vy", "omega", "delta", "offset", "heading", "width_right", "width_left",
)  # fmt: skip
"""The first numbers of an observation; curvatures ahead follow."""

Observation = NDArray[np.float32]
Action = NDArray[np.float64]
OffTrack = Literal["end", "continue"]
Start = Literal["line", "random"]

_AHEAD: Final = tuple(range(0, 48, 4))
"""Places at which curvature is seen [wheelbases]."""
_WIDEST: Final = 20.0
"""Largest width of a track in an observation [wheelbases]."""
_FARTHEST: Final = 2.0
"""Largest offset in an observation [widths on that side]."""
_FASTEST: Final = 4.0
"""Largest yaw rate in an observation, over that of the tightest bend at the limit of friction; it
clips that of a car that spins."""
_SLOW: Final = 0.1
"""Share of the top speed at which an episode without ``max_time_s`` ends after its laps ..."""
_SLOW_S: Final = 2.0
"""... and so much more."""
_WALKING_MPS: Final = 0.1
_START_SHARE: Final = 0.5
"""Random starts: share of the width on each side, and of the speed that friction allows."""
_ASKEW_RAD: Final = 0.2
"""Random starts: heading from the track's, to both sides."""


class RaceEnv(gymnasium.Env[Observation, Action]):
    """One car alone on a track, by the built-in equations with its actuators' limits.

    **Action**, float64 of shape (2,), each in [-1, 1]; what lies outside is clipped. The first is
    the drive command: 1 is the car's ``d_max``, 0 is 0, -1 is ``d_min``, linear in between. The
    second is the steering rate: 1 is ``delta_rate_max_radps`` to the left.

    **Observation**, float32 of shape (8 + m,), relative to the track: vx [m/s], vy [m/s], omega
    [rad/s], delta [rad]; the offset from the centreline over the width on that side, 1 at the left
    edge and -1 at the right one; the heading from the centreline's [rad]; the width to the right
    and to the left [m]; the centreline's curvature at the m places of :attr:`ahead_m` [rad/m],
    positive in a left-hand bend. Values beyond the bounds of the space are clipped; the bounds
    follow from the car alone.

    **Reward**: the metres along the centreline that the car has advanced in the step, negative
    backwards, and less ``off_track_penalty`` where the step ended off the track. A step that leaves
    out a piece of the track (:data:`.SHORT_CUT`) advances by nothing.

    **Terminated** when the car's centre is off the track, or with ``off_track="continue"`` farther
    off than the track is wide; when it has left out a piece of the track; and when the laps are
    done. **Truncated** at ``max_time_s``.

    **info**: ``state`` (7,) in the order of :class:`.State`; ``u_applied`` (2,), what acted in the
    step; ``time_s`` since the reset; ``s_m`` along the centreline; ``off_track_m``, how far off the
    track, negative on it; ``progress_m`` since the reset; ``lap_times_s``, a tuple, as
    :func:`bayesrace.drive` would time the same trajectory: the first lap begins with the episode,
    wherever that is; ``end``: ``"off_track"``, ``"short_cut"``, ``"laps"``, ``"max_time"``, or
    empty while the episode goes on.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        car: Car | Path | str,
        track: Track | Path | str,
        *,
        laps: int = 1,
        max_time_s: float | None = None,
        off_track: OffTrack = "end",
        off_track_penalty: float = 0.0,
        start: Start = "line",
        ahead_m: Sequence[float] | None = None,
        step_s: float = 0.02,
        world: World | Path | str | None = None,
        render_mode: str | None = None,
    ) -> None:
        """``car``, ``track``: objects, or what their ``load`` takes. ``laps``: crossings of the
        start line after which an episode ends; 0: none, ``max_time_s`` ends it. ``max_time_s``
        without: the time for the laps at a tenth of the car's top speed, and 2 s.
        ``off_track_penalty`` [m] counts in each step that ends off the track. ``start``: the start
        line at walking pace, or anywhere on the track (:meth:`reset`). ``ahead_m``: distances at
        which curvature is seen, 0 to 44 wheelbases in steps of 4 without. ``step_s``, ``world``: as
        of :class:`bayesrace.Simulator`.

        InputError names what cannot be used.
        """
        self.car = car_of(car)
        self.track = track_of(track, self.car)
        if ahead_m is None:
            ahead_m = [one * self.car.wheelbase_m for one in _AHEAD]
        self.ahead_m: Floats = np.asarray(ahead_m, dtype=np.float64)
        """Distances at which curvature is seen [m], shape (m,)."""
        self.laps, self.off_track, self.start, self.render_mode = (
            laps,
            off_track,
            start,
            render_mode,
        )
        self.off_track_penalty = off_track_penalty
        self._check()
        self.max_time_s = self._time_limit(max_time_s)
        self.simulator = Simulator(self.car, self.track, step_s=step_s, world=world)
        """What plays the car."""
        self.metadata = self.metadata | {"render_fps": round(1 / step_s)}
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float64)
        self.observation_space = self._observation_space()
        self._centreline = Centreline(self.track)
        self._curvatures = curvature_table(self.track, float(self.ahead_m.max()))
        self._timing = LapTimer(self.track)
        self._picture: CarPicture | None = None
        width_m = float(np.max(self.track.width_right_m + self.track.width_left_m))
        self._farthest_m = 0.0 if off_track == "end" else width_m
        self._end: str | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode; observation and info.

        ``options``: ``{"x0": state}``, where the car starts (7,), whatever ``start`` is. A random
        start is within half of the width on each side, within 0.2 rad of the track's heading, from
        walking pace to half the speed that friction allows in the sharpest bend in sight, and
        steered as the bend is; ``seed`` settles which. InputError for other options, and a state
        that the car cannot be in or that is off the track.
        """
        super().reset(seed=seed)
        self._end = None  # whatever fails now, no episode goes on
        x0 = _start_state(options)
        if x0 is None and self.start == "random":
            x0 = self._random_start()
        state = self.simulator.reset(x0)
        self._place = self._centreline.locate(state.x, state.y)
        if self._place.off_track_m > self._farthest_m:
            raise InputError(
                f"x0 is {self._place.off_track_m:.3g} m off the track '{self.track.name}': give a "
                "place on it"
            )
        self._progress_m, self._end = 0.0, ""
        self._timing.begin(state)
        return self._observation(state), self._info(state)

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Holds an action (2,) for one period: observation, reward, terminated, truncated, info.

        InputError for an action that is no two finite numbers, and where no episode goes on.
        """
        if self._end != "":
            raise InputError(
                "step: the episode has ended, or none has begun; call reset() before it"
            )
        state = self.simulator.step(self._input(action))
        before, self._place = self._place, self._centreline.locate(state.x, state.y, self._place)
        advance_m = math.remainder(self._place.s_m - before.s_m, self.track.length_m)
        cut = abs(advance_m) > SHORT_CUT * self.track.length_m
        if cut:
            advance_m = 0.0
        else:  # after it no lap counts
            self._timing.move(state, self.simulator.time_s, self.simulator.step_s)
        self._progress_m += advance_m
        self._end = self._ends(cut)
        off = self._place.off_track_m > 0
        reward = advance_m - (self.off_track_penalty if off else 0.0)
        truncated = self._end == "max_time"
        terminated = self._end != "" and not truncated
        return self._observation(state), reward, terminated, truncated, self._info(state)

    def action_for(self, u: Input | ArrayLike) -> Action:
        """The action (2,) of an input (2,), drive command and steering rate [rad/s], such as that
        of :meth:`bayesrace.Controller.step`; clipped to [-1, 1]."""
        d, delta_rate = Input.of(u)
        car = self.car
        drive = d / (car.d_max if d >= 0 else -car.d_min)
        return np.array([_clipped(drive), _clipped(delta_rate / car.delta_rate_max_radps)])

    def render(self) -> NDArray[np.uint8] | None:
        """The track and the car from above, shape (height, width, 3); None without a
        ``render_mode``. InputError if matplotlib is not installed."""
        if self.render_mode is None:
            return None
        if self._picture is None:
            from bayesrace.api.picture import CarPicture

            self._picture = CarPicture(self.car, self.track)
        return self._picture.of(self.simulator.state)

    def close(self) -> None:
        """Ends what the simulator has opened."""
        self.simulator.close()

    def _check(self) -> None:
        """InputError for what no episode can be made of."""
        for name, words in (("off_track", get_args(OffTrack)), ("start", get_args(Start))):
            if (given := getattr(self, name)) not in words:
                raise InputError(f"{name} = {given!r}: give one of {', '.join(words)}")
        modes = self.metadata["render_modes"]
        if self.render_mode is not None and self.render_mode not in modes:
            raise InputError(f"render_mode = {self.render_mode!r}: give {modes[0]!r} or None")
        if not isinstance(self.laps, int) or self.laps < 0:
            raise InputError(f"laps = {self.laps!r}: give a whole number from 1 on, or 0: no limit")
        if not 0 <= self.off_track_penalty < math.inf:
            raise InputError(
                f"off_track_penalty = {self.off_track_penalty}: give metres, 0 or more; they are "
                "subtracted"
            )
        ahead = self.ahead_m
        if ahead.ndim != 1 or not len(ahead) or not ((ahead >= 0) & (ahead < math.inf)).all():
            raise InputError(
                f"ahead_m = {ahead.tolist()}: give a list of distances ahead of the car, 0 or more "
                "metres"
            )

    def _time_limit(self, max_time_s: float | None) -> float:
        if max_time_s is not None:
            if not max_time_s > 0:
                raise InputError(f"max_time_s = {max_time_s}: give seconds, more than 0, or None")
            return max_time_s
        if self.laps == 0:
            raise InputError("laps = 0: no lap ends the episode; give max_time_s")
        slow_mps = _SLOW * self.car.drive.top_speed_mps(self.car.d_max)
        return self.laps * self.track.length_m / slow_mps + _SLOW_S

    def _observation_space(self) -> Any:
        """Its bounds are of the car, not of the track: a policy sees all tracks to one scale."""
        car = self.car
        top_mps = 2 * car.drive.top_speed_mps(car.d_max)
        widest_m = _WIDEST * car.wheelbase_m
        tightest = math.tan(car.delta_max_rad) / car.wheelbase_m
        turning_radps = math.sqrt(car.friction * GRAVITY_MPS2 * tightest)
        high = np.array([
            top_mps, top_mps, _FASTEST * turning_radps, car.delta_max_rad, _FARTHEST,
            math.pi, widest_m, widest_m, *[1 / car.wheelbase_m] * len(self.ahead_m),
        ], dtype=np.float32)  # fmt: skip
        low = -high
        low[6:8] = 0.0
        self._low, self._high = low, high
        return gymnasium.spaces.Box(low, high, dtype=np.float32)

    def _input(self, action: ArrayLike) -> Input:
        """What an action asks of the car."""
        given = np.asarray(action, dtype=np.float64)
        if given.shape != (2,):
            raise InputError(
                f"action: an array of shape {given.shape}, expected (2,): drive command and "
                "steering rate, each from -1 to 1"
            )
        drive, steering = given.tolist()
        if not (math.isfinite(drive) and math.isfinite(steering)):
            raise InputError(f"action = {[drive, steering]}: give two finite numbers from -1 to 1")
        car, drive, steering = self.car, _clipped(drive), _clipped(steering)
        d = drive * (car.d_max if drive >= 0 else -car.d_min)
        return Input(d, steering * car.delta_rate_max_radps)

    def _ends(self, cut: bool) -> str:
        """Why the episode is over in the state that was reached; empty: it is not."""
        if self._place.off_track_m > self._farthest_m:
            return "off_track"
        if cut:
            return "short_cut"
        if 0 < self.laps <= len(self._timing.times_s):
            return "laps"
        return "max_time" if self.simulator.time_s >= self.max_time_s else ""

    def _observation(self, state: State) -> Observation:
        place, seen = self._place, np.empty(len(self._high), dtype=np.float32)
        side_m = place.left_m if place.n_m >= 0 else place.right_m
        seen[: len(OBSERVED)] = (
            state.vx, state.vy, state.omega, state.delta, place.n_m / side_m,
            math.remainder(state.psi - place.heading_rad, math.tau), place.right_m, place.left_m,
        )  # fmt: skip
        seen[len(OBSERVED) :] = np.interp(place.s_m + self.ahead_m, *self._curvatures)
        np.maximum(seen, self._low, out=seen)
        np.minimum(seen, self._high, out=seen)
        return seen

    def _info(self, state: State) -> dict[str, Any]:
        return {
            "state": state.to_numpy(),
            "u_applied": self.simulator.u_applied.to_numpy(),
            "time_s": self.simulator.time_s,
            "s_m": self._place.s_m,
            "off_track_m": self._place.off_track_m,
            "progress_m": self._progress_m,
            "lap_times_s": self._timing.times_s,
            "end": self._end,
        }

    def _random_start(self) -> State:
        car, track, random = self.car, self.track, self.np_random
        s_m = random.uniform(0.0, track.length_m)
        right_m, left_m = (float(one) for one in track.widths(s_m))
        n_m = random.uniform(-_START_SHARE * right_m, _START_SHARE * left_m)
        x, y = track.position(s_m) + n_m * track.normal(s_m)
        psi = float(track.heading(s_m)) + random.uniform(-_ASKEW_RAD, _ASKEW_RAD)
        sharpest = float(np.max(np.abs(track.curvature(s_m + self.ahead_m)), initial=1e-3))
        fast_mps = min(
            math.sqrt(car.friction * GRAVITY_MPS2 / sharpest), car.drive.top_speed_mps(car.d_max)
        )
        vx = random.uniform(_WALKING_MPS, max(_START_SHARE * fast_mps, _WALKING_MPS))
        bend = float(track.curvature(s_m))
        delta = math.atan(bend * car.wheelbase_m)
        delta = min(max(delta, -car.delta_max_rad), car.delta_max_rad)
        return State(float(x), float(y), psi, vx, 0.0, vx * bend, delta)


def _clipped(value: float) -> float:
    return min(max(value, -1.0), 1.0)


def _start_state(options: Mapping[str, Any] | None) -> State | None:
    """That of the options of a reset, if they have one."""
    unknown = set(options or ()) - {"x0"}
    if unknown:
        raise InputError(f"options: {', '.join(sorted(unknown))}: the one option is x0, a state")
    x0 = None if options is None else options.get("x0")
    return None if x0 is None else State.of(x0)


if ENV_ID not in gymnasium.registry:
    gymnasium.register(ENV_ID, entry_point="bayesrace.gym:RaceEnv")
