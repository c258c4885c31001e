"""Numbers that depend on the size of a car, with defaults from its own scales.

Each number belongs to a reference car of wheelbase L0 = 0.062 m and friction 0.75. For a car of
wheelbase L and usable acceleration a = friction g it is scaled by dimensional analysis,

    value = reference (L / L0)^p (a / a0)^q c^r

with the exponents that its unit has: (p, q) = (1, 0) for lengths, (1/2, 1/2) for speeds,
(1/2, -1/2) for times. r counts the drive commands in the unit; c is 1 for a duty cycle, as the
reference car has it, and a in m/s^2 for a car whose command is an acceleration: full throttle of
the reference car is about its usable acceleration. A new car needs none of them in its file.
"""

from typing import Any, Final, NamedTuple

from pydantic import Field

from bayesrace.vehicles.parts import GRAVITY_MPS2, Part

__all__ = [
    "REFERENCE_ACCELERATION_MPS2",
    "REFERENCE_WHEELBASE_M",
    "CautionTuning",
    "PursuitTuning",
    "RacelineTuning",
    "Scales",
    "Tuning",
    "scaled",
]

REFERENCE_WHEELBASE_M: Final = 0.029 + 0.033
REFERENCE_ACCELERATION_MPS2: Final = 0.75 * GRAVITY_MPS2

_BASE_UNITS: Final = {"m": (1.0, 0.0, 0.0), "s": (0.5, -0.5, 0.0), "command": (0.0, 0.0, 1.0)}
"""Exponents of wheelbase, acceleration and command; all other units are plain numbers."""


class Scales(NamedTuple):
    """Of a car, as multiples of the reference car's."""

    wheelbase: float = 1.0
    acceleration: float = 1.0
    """Usable: friction g."""
    command: float = 1.0
    """Drive command."""


def scaled(reference: float, unit: str, scales: Scales) -> float:
    """The reference car's number for a car of these scales; exactly the same for ones.

    ``unit``: base units with exponents, such as ``rad s^2/m``.
    """
    exponents = [0.0, 0.0, 0.0]
    above, _, below = unit.partition("/")
    for factors, sign in ((above, 1), (below, -1)):
        for name, _, power in (factor.partition("^") for factor in factors.split()):
            for i, exponent in enumerate(_BASE_UNITS.get(name, ())):
                exponents[i] += sign * int(power or 1) * exponent
    value = reference
    for scale, exponent in zip(scales, exponents, strict=True):
        value *= scale**exponent
    return float(value)


def _number(reference: float, text: str, **bounds: float) -> Any:
    """A field; ``text`` ends with its unit in brackets."""
    limits: dict[str, Any] = {**bounds} or {"gt": 0}
    return Field(description=text, json_schema_extra={"reference": reference}, **limits)


class _Section(Part):
    @classmethod
    def defaults(cls, scales: Scales) -> dict[str, Any]:
        """Every number of the section for a car of these scales, by name."""
        values: dict[str, Any] = {}
        for name, field in cls.model_fields.items():
            extra: Any = field.json_schema_extra
            unit = str(field.description).rpartition("[")[2].removesuffix("]")
            values[name] = scaled(extra["reference"], unit, scales)
        return values


class RacelineTuning(_Section):
    """How the racing line is optimised and sampled."""

    step_m: float = _number(0.03, "length of an optimisation interval [m]")
    spacing_m: float = _number(0.01, "distance of the line's points [m]")
    smoothing_m: float = _number(0.03, "Gaussian smoothing of the frame, not of the track [m]")
    rate_weight: float = _number(1e-6, "cost of acceleration's squared slope over the way [s^5/m]")
    curvature_weight: float = _number(1e-6, "cost of curvature's squared slope [s m^3]")
    tolerance_m: float = _number(5e-4, "by which the line may pass the margin between stations [m]")
    room_m: float = _number(0.005, "least width that the margins must leave [m]")
    speed_min_mps: float = _number(0.2, "least speed of a flying lap [m/s]")
    speed_bound_mps: float = _number(30.0, "bound above any top speed [m/s]")
    acceleration_bound_mps2: float = _number(50.0, "bound above any acceleration [m/s^2]")


class PathTuning(_Section):
    """The table of racing line and track that the planner reads, and its search."""

    spacing_m: float = _number(0.005, "distance of rows; the planner interpolates linearly [m]")
    spacing_min_m: float = _number(1e-4, "least distance of rows [m]")
    spacing_max_m: float = _number(0.1, "largest distance; the window must hold several rows [m]")
    window_back_m: float = _number(0.3, "search window behind the last projection [m]")
    window_ahead_m: float = _number(0.5, "search window ahead of it [m]")
    far_m: float = _number(1e4, "largest coordinate of a row [m]")
    speed_max_mps: float = _number(100.0, "largest speed of a row [m/s]")


class TurnTuning(_Section):
    """Turning round, for a slow car that points away from its line."""

    slow_mps: float = _number(0.2, "a turn begins below this speed [m/s]")
    away_rad: float = _number(1.0, "and if the line is farther than this to one side [rad]")
    faced_rad: float = _number(0.3, "a turn ends within this angle [rad]")
    ahead_m: float = _number(0.5, "point of the line that the car turns to, ahead [m]")
    tangent_m: float = _number(0.05, "length of line that gives its direction at the car [m]")
    behind_rad: float = _number(2.0, "with the point farther behind, either side serves [rad]")
    wider_m: float = _number(2.0, "added to the track on either side, on the way [m]")
    pace_mps: float = _number(0.5, "speed of a turn [m/s]")
    stop_mps: float = _number(0.05, "a speed limit below this is a stop [m/s]")
    too_fast_mps: float = _number(1.0, "a faster car is not turning round [m/s]")
    throttle_spm: float = _number(2.0, "drive command per speed below the pace [command s/m]")


class BrakingTuning(_Section):
    """Steering along the line while braking to standstill, when something has failed."""

    lookahead_m: float = _number(0.16, "distance of the target at standstill [m]")
    lookahead_s: float = _number(0.05, "distance added per speed [s]")
    preview_s: float = _number(0.04, "how far ahead the line's curvature is taken [s]")
    understeer_s2pm: float = _number(0.008, "steering angle per lateral acceleration [rad s^2/m]")
    damping_s: float = _number(0.02, "steering angle per excess of the yaw rate [s]")
    slow_mps: float = _number(0.4, "slower, slip angles are those at this speed [m/s]")
    chord_m: float = _number(0.08, "chord that the line's direction is taken from [m]")
    centre: float = _number(0.5, "share of the way to mid-track, at standstill [-]", ge=0, le=1)


class MonitorTuning(_Section):
    """Largest contradictions in measured states that noise of motion capture and any driving cause.

    Measured: at most 12 mm, 0.06 rad, 0.002 rad, and with the velocities' noise 0.5 m/s and
    3.6 rad/s from one state to the next (1 mm, 0.5 degrees, 0.05 m/s, 0.2 rad/s; slides included).
    """

    position_m: float = _number(0.022, "between position and integrated velocities [m]")
    heading_rad: float = _number(0.12, "between heading and integrated yaw rate [rad]")
    steering_rad: float = _number(0.012, "between steering angle and integrated rate [rad]")
    memory_s: float = _number(0.2, "time over which they are integrated [s]")
    speed_mps: float = _number(0.5, "change of the velocity without acceleration [m/s]")
    acceleration_mps2: float = _number(12.0, "largest acceleration [m/s^2]")
    yaw_rate_radps: float = _number(2.5, "change of the yaw rate at once [rad/s]")
    yaw_acceleration_radps2: float = _number(250.0, "largest yaw acceleration [rad/s^2]")
    drift: float = _number(0.06, "error of the prediction of a braking car, per distance [-]")


class EstimatorTuning(_Section):
    """Where a state is estimated of what instruments report (controller/native/br_estimator.c).

    Standard deviations before anything has been measured, around 0, and random walks beyond what
    the model with its weights says of its own uncertainty. Without weights, as in training drives,
    accelerations are estimated in place of the model.
    """

    position_m: float = _number(1.0, "of a coordinate [m]")
    heading_rad: float = _number(3.0, "of the heading [rad]")
    speed_mps: float = _number(0.5, "of the speed [m/s]")
    lateral_mps: float = _number(0.2, "of the lateral velocity [m/s]")
    yaw_rate_radps: float = _number(1.0, "of the yaw rate [rad/s]")
    steering_rad: float = _number(0.05, "of the steering angle [rad]")
    gyro_offset_radps: float = _number(0.1, "of the gyro's offset [rad/s]", ge=0)
    steering_offset_rad: float = _number(0.02, "of the measured steering angle's [rad]", ge=0)
    drift_mps: float = _number(0.0025, "walk of the velocities in a second [m/s]")
    drift_radps: float = _number(0.025, "and of the yaw rate [rad/s]")
    acceleration_mps2: float = _number(6.0, "of accelerations without weights [m/s^2]", ge=0)
    acceleration_radps2: float = _number(120.0, "and of the yaw rate [rad/s^2]", ge=0)
    acceleration_s: float = _number(0.2, "time in which they are forgotten [s]")
    error_s: float = _number(0.05, "and what weights err by where they have not been trained [s]")
    yaw_lag_s: float = _number(0.08, "with which the yaw rate follows the steering angle then [s]")
    gate: float = _number(
        1.0, "times the squared distance that one of 1,000 exceeds, a reading is refused [-]", ge=0
    )


class PlausibleTuning(_Section):
    """Largest magnitudes of a state that a controller accepts."""

    position_m: float = _number(1e4, "coordinates [m]")
    heading_rad: float = _number(1e7, "heading, not wrapped [rad]")
    speed_mps: float = _number(100.0, "velocities [m/s]")
    yaw_rate_radps: float = _number(1e3, "yaw rate [rad/s]")
    steering_rad: float = _number(1.5, "steering angle [rad]")


class ScaleTuning(_Section):
    """Sizes of the states, by which the OCP's dynamics defects are measured."""

    position_m: float = _number(1.0, "coordinates [m]")
    heading_rad: float = _number(1.0, "heading [rad]")
    speed_mps: float = _number(1.0, "velocities [m/s]")
    yaw_rate_radps: float = _number(10.0, "yaw rate [rad/s]")
    steering_rad: float = _number(1.0, "steering angle [rad]")


class ObjectiveTuning(_Section):
    """Weights, margin and stages of the OCP, where its settings state none."""

    q_position: float = _number(1.0, "Q: squared position error [1/m^2]")
    r_duty: float = _number(0.002, "R: squared change of the drive command [1/command^2]")
    r_delta_rate: float = _number(3e-5, "R: squared steering rate [s^2/rad^2]")
    s_slack: float = _number(100.0, "S: squared track violation [1/m^2]")
    margin_m: float = _number(0.01, "distance kept from the track edges [m]")
    horizon: int = _number(20, "stages that the OCP looks ahead [-]", ge=2, le=100)


_COMPILED: Final = frozenset(
    {"horizon", "free_stages", "block_stages", "proximal_duty", "proximal_delta_rate"}
)
"""What of the tuning below shapes the generated code."""


class ProgressTuning(_Section):
    """The same for the OCP that maximises progress."""

    q_contour: float = _number(0.1, "squared distance to the line [1/m^2]")
    gain: float = _number(2.5, "reward of the time that the line takes for the progress [1/s]")
    r_duty: float = _number(2e-4, "R: squared change of the drive command [1/command^2]")
    r_delta_rate: float = _number(2e-4, "R: squared steering rate [s^2/rad^2]")
    proximal_duty: float = _number(0.02, "of the command's change in a QP [1/command^2]", ge=0)
    proximal_delta_rate: float = _number(1e-3, "of the rate's change in a QP [s^2/rad^2]", ge=0)
    s_slack: float = _number(1000.0, "S: squared track violation [1/m^2]")
    margin_m: float = _number(0.01, "distance kept from the track edges [m]")
    horizon: int = _number(40, "stages that the OCP looks ahead [-]", ge=2, le=100)
    free_stages: int = _number(10, "first stages: each changes by itself [-]", ge=1, le=100)
    block_stages: int = _number(
        5, "so many later ones change alike; 1: no blocks [-]", ge=1, le=100
    )

    @property
    def run_time(self) -> dict[str, float]:
        """The numbers that can change between two steps, by the names of the OCP's parameters."""
        return self.model_dump(exclude=set(_COMPILED))


class CautionTuning(_Section):
    """What the controller does about the uncertainty of its model: controller/native/br_caution.c.

    The sizes of deviations and efforts are those that the feedback about a plan weighs equally.
    """

    position_m: float = _number(0.1, "deviation of a coordinate [m]")
    heading_rad: float = _number(1.0, "deviation of the heading [rad]")
    speed_mps: float = _number(1.0, "deviation of a velocity [m/s]")
    yaw_rate_radps: float = _number(10.0, "deviation of the yaw rate [rad/s]")
    steering_rad: float = _number(1.0, "deviation of the steering angle [rad]")
    command: float = _number(1.0, "effort of the drive command [command]")
    steering_rate_radps: float = _number(3.0, "effort of the steering rate [rad/s]")
    share: float = _number(0.5, "of half the width: more uncertainty slows the car [-]", gt=0, le=1)
    slower_ps: float = _number(2.5, "speed of the reference then falls at this rate [1/s]")
    faster_ps: float = _number(0.5, "and rises again at this one [1/s]")
    least: float = _number(0.5, "share of the line's speed that is never undercut [-]", gt=0, le=1)
    notice_s: float = _number(0.2, "in which feedback notices what the model errs by [s]")

    @property
    def pace(self) -> list[tuple[str, float]]:
        """The numbers that the controller's planner is compiled with."""
        names = {
            "share": "share", "slower": "slower_ps", "faster": "faster_ps", "least": "least",
            "notice_s": "notice_s",
        }  # fmt: skip
        return [(key, getattr(self, name)) for key, name in names.items()]


class PursuitTuning(_Section):
    """Pure pursuit, which drives for training data."""

    lookahead_m: float = _number(0.16, "distance of the target at standstill [m]")
    lookahead_s: float = _number(0.05, "distance added per speed [s]")
    speed_gain_spm: float = _number(1.8, "drive command per speed error [command s/m]")
    excite_d: float = _number(0.1, "standard deviation of the command's disturbance [command]")
    sway_s: float = _number(3.7, "period in which the target speed rises and falls [s]")
    faster: float = _number(0.15, "share by which the target speed rises [-]", ge=0, lt=1)
    slower: float = _number(0.15, "share by which it falls [-]", ge=0, lt=1)
    speed_min_mps: float = _number(0.4, "target speed is never below [m/s]")
    keep_m: float = _number(0.12, "distance of the driven line from the track's edges [m]")
    preview_s: float = _number(0.12, "how far ahead the line's speed is taken [s]")
    steering_s: float = _number(0.04, "how far ahead the line's curvature is taken [s]")
    understeer_s2pm: float = _number(0.008, "steering angle per lateral acceleration [rad s^2/m]")
    damping_s: float = _number(0.01, "steering angle per excess of the yaw rate [s]")
    window_m: float = _number(0.4, "way ahead in which the nearest point is sought [m]")
    lost_m: float = _number(0.5, "farther from it, the whole line is searched [m]")
    drive_s: float = _number(12.0, "length of a training drive [s]")


class GateTuning(_Section):
    """What new weights are judged by, and which samples are learned from."""

    resolution_vx_mps2: float = _number(0.1, "longitudinal error that does not count [m/s^2]")
    resolution_vy_mps2: float = _number(0.2, "lateral error that does not count [m/s^2]")
    resolution_omega_radps2: float = _number(2.0, "yaw error that does not count [rad/s^2]")
    absurd_vx_mps2: float = _number(100.0, "largest longitudinal correction [m/s^2]")
    absurd_vy_mps2: float = _number(100.0, "largest lateral correction [m/s^2]")
    absurd_omega_radps2: float = _number(1000.0, "largest yaw correction [rad/s^2]")
    moving_mps: float = _number(0.05, "slower, a car stands, and its samples are left out [m/s]")
    spin_rad: float = _number(0.8, "beyond this slip angle a car spins: samples left out [rad]")

    @property
    def resolution(self) -> tuple[float, float, float]:
        """For vx, vy, omega."""
        return self.resolution_vx_mps2, self.resolution_vy_mps2, self.resolution_omega_radps2

    @property
    def absurd(self) -> tuple[float, float, float]:
        """For vx, vy, omega."""
        return self.absurd_vx_mps2, self.absurd_vy_mps2, self.absurd_omega_radps2


class DrivingTuning(_Section):
    """Stopping on command."""

    stop_mps2: float = _number(1.5, "deceleration along the line of a stop on command [m/s^2]")
    standing_mps: float = _number(0.1, "speed below which a stop ends in holding the brake [m/s]")


class Tuning(_Section):
    """All of them, complete; :meth:`completed` makes one from what a car's file states."""

    raceline: RacelineTuning
    path: PathTuning
    turn: TurnTuning
    braking: BrakingTuning
    monitor: MonitorTuning
    estimator: EstimatorTuning
    plausible: PlausibleTuning
    scale: ScaleTuning
    objective: ObjectiveTuning
    progress: ProgressTuning
    caution: CautionTuning
    pursuit: PursuitTuning
    gate: GateTuning
    driving: DrivingTuning

    def estimation(self, *, nominal: bool) -> dict[str, Any]:
        """The members of br_estimation by name; ``nominal``: for a model without weights, where the
        car understeers as for pure pursuit."""
        one = self.estimator
        along, about = one.acceleration_mps2, one.acceleration_radps2
        return {
            "start": (
                one.position_m, one.position_m, one.heading_rad, one.speed_mps,
                one.lateral_mps, one.yaw_rate_radps, one.steering_rad, one.gyro_offset_radps,
                one.steering_offset_rad,
            ),
            "drift": (
                0.0, 0.0, 0.0, one.drift_mps, one.drift_mps, one.drift_radps, 0.0, 0.0, 0.0,
            ),
            "acceleration": (along, along, about) if nominal else (0.0, 0.0, 0.0),
            "acceleration_s": one.acceleration_s if nominal else one.error_s,
            "yaw_lag_s": one.yaw_lag_s,
            "understeer": self.pursuit.understeer_s2pm,
            "gate": one.gate,
        }  # fmt: skip

    @classmethod
    def completed(cls, given: dict[str, Any], scales: Scales) -> dict[str, Any]:
        """``given`` with what it lacks, as data for this model; faults in it are left there."""
        values = dict(given)
        for name, field in cls.model_fields.items():
            section, stated = field.annotation, values.get(name, {})
            if isinstance(stated, dict) and section is not None:
                values[name] = section.defaults(scales) | stated
        return values
