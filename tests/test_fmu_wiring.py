"""A map turns what a foreign model says into the car's state, and the car's commands into what the
model takes: conventions in use, to rounding."""

import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import given as those
from hypothesis import settings
from hypothesis import strategies as st

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.plant.fmu.map import parse_map, wire
from bayesrace.plant.fmu.wiring import Wiring
from tests.fmu_variables import (
    STATE,
    TOLERANCE,
    U,
    assert_same,
    given,
    our_names,
    own_fmu,
    read,
    replacing,
    taken,
    values,
    variable,
)

# -- our own FMU ----------------------------------------------------------------------------------


def test_our_own_names_pass_to_the_bit_without_a_map() -> None:
    wiring = wire(own_fmu())
    state = STATE + np.array([0, 0, 700.1, 0, 0, 0, 0])  # turns are the FMU's to count
    assert (read(wiring, our_names, state) == state).all()
    assert wiring.inputs == ("d", "delta_rate")
    assert wiring.to_inputs(U, 0.2, (0.02,)) == list(U)


def test_outputs_that_can_be_started_are() -> None:
    start = wire(own_fmu()).start_values(STATE)
    assert start == our_names(STATE) | {"d": 0.0, "delta_rate": 0.0}


def test_a_map_of_parameters_leaves_the_rest_as_without_one() -> None:
    wiring = wire(own_fmu(), parse_map("[parameters]\nmass_kg = 0.05"))
    assert wiring.start_values(STATE)["mass_kg"] == 0.05
    assert (read(wiring, our_names, STATE) == STATE).all()


# -- what it says ---------------------------------------------------------------------------------

State = dict[str, float]
Rule = tuple[str, dict[str, Callable[[State], float]]]


def east(s: State) -> float:
    """World velocity [m/s] along x."""
    return math.cos(s["psi"]) * s["vx"] - math.sin(s["psi"]) * s["vy"]


def north(s: State) -> float:
    """World velocity [m/s] along y."""
    return math.sin(s["psi"]) * s["vx"] + math.cos(s["psi"]) * s["vy"]


QUARTER: Final = math.pi / 2
COMPASS: Final = f'psi = {{ variable = "hdg", unit = "deg", sign = -1, offset = {QUARTER!r} }}'

HEADINGS: Final[dict[str, Rule]] = {
    "degrees": (
        '[outputs]\npsi = { variable = "hdg", unit = "deg" }',
        {"hdg": lambda s: math.degrees(s["psi"])},
    ),
    "wrapped at ±180": (
        '[outputs]\npsi = { variable = "hdg", unit = "deg" }',
        {"hdg": lambda s: (math.degrees(s["psi"]) + 180) % 360 - 180},
    ),
    "compass, 0 to 360": (
        f"[outputs]\n{COMPASS}",
        {"hdg": lambda s: (90 - math.degrees(s["psi"])) % 360},
    ),
    "wrapped at ±pi": (
        '[outputs]\npsi = "hdg"',
        {"hdg": lambda s: math.atan2(math.sin(s["psi"]), math.cos(s["psi"]))},
    ),
    "turns": (
        '[outputs]\npsi = { variable = "hdg", unit = "turn" }',
        {"hdg": lambda s: s["psi"] / (2 * math.pi)},
    ),
    "scaled by hand": (
        '[outputs]\npsi = { variable = "hdg", scale = -1e-3, offset = 1.0 }',
        {"hdg": lambda s: (1.0 - s["psi"]) * 1e3},
    ),
}
VELOCITIES: Final[dict[str, Rule]] = {
    "east and south in km/h": (
        """[outputs]
        world_vx = { variable = "ve", unit = "km/h" }
        world_vy = { variable = "vs", unit = "km/h", sign = -1 }""",
        {"ve": lambda s: 3.6 * east(s), "vs": lambda s: -3.6 * north(s)},
    ),
    "speed and slip angle": (
        """[outputs]
        speed = { variable = "v", unit = "km/h" }
        slip = { variable = "beta", unit = "deg" }""",
        {
            "v": lambda s: 3.6 * math.hypot(s["vx"], s["vy"]),
            "beta": lambda s: math.degrees(math.atan2(s["vy"], s["vx"])),
        },
    ),
}


@pytest.mark.parametrize("name", [*HEADINGS, *VELOCITIES])
@settings(deadline=None)
@those(
    body=st.tuples(st.floats(-40, 40), st.floats(-3, 3), st.floats(-1, 1)),
    steps=st.lists(st.floats(-math.pi + 1e-6, math.pi - 1e-6), max_size=20),
)
def test_what_other_models_say_is_the_cars_state(
    name: str, body: tuple[float, float, float], steps: list[float]
) -> None:
    """Headings are continued over several turns, and changes of almost half a turn a step."""
    text, theirs = (HEADINGS | VELOCITIES)[name]
    ours = ("psi",) if name in HEADINGS else ("vx", "vy")
    wiring = wire(own_fmu(*map(given, theirs), without=ours), parse_map(text))
    say = replacing(*ours, **theirs)
    state = STATE.copy()
    state[2:5] = body
    assert_same(wiring.begin(values(wiring, say(state)), state), state)
    for step in steps:
        state[2] += step
        assert_same(wiring.state(values(wiring, say(state)), U, 0.02), state)


def test_velocity_of_a_model_without_side_slip() -> None:
    fmu = own_fmu(given("v"), without=("vx", "vy"))
    wiring = wire(fmu, parse_map('[outputs]\nspeed = "v"'))
    state = STATE.copy()
    state[4] = 0.0
    assert_same(read(wiring, replacing("vx", "vy", v=lambda s: s["vx"]), state), state)


def test_yaw_rate_from_the_heading_across_the_wrap() -> None:
    fmu = own_fmu(given("hdg", "deg"), without=("psi", "omega"))
    wiring = wire(fmu, parse_map(f"[fmu]\nderived = ['omega']\n[outputs]\n{COMPASS}"))
    say = replacing("psi", "omega", **HEADINGS["compass, 0 to 360"][1])
    state = STATE.copy()
    state[2] = math.pi / 2 - 0.01
    first = wiring.begin(values(wiring, say(state)), state)
    assert first[5] == state[5]  # there is no difference yet
    state[2] += 0.04
    assert wiring.state(values(wiring, say(state)), U, 0.02)[5] == pytest.approx(2.0, rel=1e-9)


def test_steering_angle_from_the_rate_that_acted_and_afresh_each_run() -> None:
    wiring = wire(own_fmu(without=("delta",)), parse_map("[fmu]\nderived = ['delta']"))
    for _ in range(2):
        wiring.begin(values(wiring, our_names(STATE)), STATE)
        deltas = [wiring.state(values(wiring, our_names(STATE)), U, 0.01)[6] for _ in range(3)]
        assert deltas == pytest.approx([0.18, 0.16, 0.14], abs=TOLERANCE)


# -- inputs ---------------------------------------------------------------------------------------


def inputs(text: str, *theirs: Any, without: tuple[str, ...] = ("d", "delta_rate")) -> Wiring:
    return wire(own_fmu(*theirs, without=without), parse_map(text))


def test_throttle_in_percent_and_a_separate_brake_pedal() -> None:
    wiring = inputs(
        '[inputs]\ngas = { from = "throttle", unit = "%" }\nbrk = { from = "brake", scale = 10 }',
        *(taken("gas", max="100.0"), taken("brk")),
        without=("d",),
    )
    assert wiring.to_inputs((0.4, 0), 0, (0.02,)) == pytest.approx([40.0, 0.0, 0.0])
    assert wiring.to_inputs((-0.1, 0), 0, (0.02,)) == pytest.approx([0.0, 1.0, 0.0])


def test_an_input_stays_within_its_declared_range() -> None:
    wiring = inputs('[inputs]\ngas = "d"', taken("gas", min="0.0", max="0.8"), without=("d",))
    sent = [wiring.to_inputs((d, 0), 0, (0.02,))[0] for d in (-0.1, 0.5, 1)]
    assert sent == [0.0, 0.5, 0.8]


def test_steering_angle_at_the_end_of_the_hold_in_degrees_to_the_right() -> None:
    wiring = inputs(
        '[inputs]\nsteer = { from = "delta", sign = -1 }',
        *(taken("steer", "deg"), taken("d")),
        without=("d", "delta_rate"),
    )
    assert wiring.to_inputs(U, 0.2, (0.02,))[0] == pytest.approx(
        -math.degrees(0.2 - 0.04), rel=1e-14
    )
    assert wiring.start_values(STATE)["steer"] == pytest.approx(-math.degrees(0.2), rel=1e-14)


def test_steering_wheel_with_a_ratio() -> None:
    """16 degrees of the wheel are one of the road wheels; it comes back the same way."""
    ratio = 16 * 180 / math.pi
    text = f'[inputs]\nswa = {{ from = "delta", scale = {ratio!r}, offset = 0.5 }}\n'
    text += f"[outputs]\ndelta = {{ variable = 'wheel', scale = {1 / ratio!r} }}"
    fmu = own_fmu(taken("swa", "deg"), given("wheel", "deg"), without=("delta_rate", "delta"))
    wiring = wire(fmu, parse_map(text))
    sent = dict(zip(wiring.inputs, wiring.to_inputs((0, 1.0), 0.1, (0.02,)), strict=True))
    assert sent["swa"] == pytest.approx(16 * math.degrees(0.12) + 0.5, rel=1e-14)
    say = replacing("delta", wheel=lambda s: 16 * math.degrees(s["delta"]))
    assert_same(read(wiring, say, STATE), STATE)


def test_constant_inputs_are_set_once_in_their_own_type() -> None:
    enable = taken("enable", type="Boolean", start="false")
    also = taken("abs", type="Boolean", start=None)
    gear = taken("gear", type="Int32", start=None)
    mode = taken("mode", type="Enumeration", items={"Eco": 1, "Race": 2})
    wind = taken("wind", "m/s", start=None)
    text = '[inputs]\nenable = true\nabs = 1.0\ngear = 1.0\nmode = "Race"\nwind = 10'
    wiring = inputs(text, enable, also, gear, mode, wind, without=())
    start = wiring.start_values(STATE)
    chosen = {name: start[name] for name in ("enable", "abs", "gear", "mode", "wind")}
    assert chosen == {"enable": True, "abs": True, "gear": 1, "mode": 2, "wind": 10.0}
    assert [type(value) for value in chosen.values()] == [bool, bool, int, int, float]
    assert wiring.inputs == ("d", "delta_rate")


# -- where it starts ------------------------------------------------------------------------------


def test_start_values_in_the_models_own_terms() -> None:
    names = {"x0": "cm", "hdg0": "deg", "v0": "km/h", "beta0": "deg"}
    parameters = [variable(name, "parameter", unit) for name, unit in names.items()]
    parameters.append(variable("vn0", "parameter"))
    text = (
        '[start]\nx0 = "x"\nhdg0 = { from = "psi", sign = -1, offset = 90 }\n'
        'v0 = "speed"\nbeta0 = "slip"\nvn0 = "world_vy"'
    )
    start = wire(own_fmu(*parameters), parse_map(text)).start_values(STATE)
    _, _, psi, vx, vy, _, _ = STATE
    assert [start[one.name] for one in parameters] == pytest.approx(
        [
            *(150.0, 90 - math.degrees(psi), 3.6 * math.hypot(vx, vy)),
            math.degrees(math.atan2(vy, vx)),
            math.sin(psi) * vx + math.cos(psi) * vy,
        ],
        rel=1e-14,
    )


@those(psi=st.floats(-20, 20))
def test_a_start_heading_is_turned_into_the_declared_range(psi: float) -> None:
    hdg0 = variable("hdg0", "parameter", "deg", min="0.0", max="360.0")
    text = '[start]\nhdg0 = { from = "psi", sign = -1, offset = 90 }'
    x0 = STATE.copy()
    x0[2] = psi
    start = wire(own_fmu(hdg0), parse_map(text)).start_values(x0)["hdg0"]
    assert isinstance(start, float)
    assert 0.0 <= start <= 360.0
    assert math.remainder(start - (90 - math.degrees(psi)), 360.0) == pytest.approx(0, abs=1e-11)


def test_a_start_value_out_of_range_is_refused() -> None:
    v0 = variable("v0", "parameter", "m/s", max="1.0")
    wiring = wire(own_fmu(v0), parse_map('[start]\nv0 = "vx"'))
    with pytest.raises(InputError, match=r"cannot start with v0 = 1\.8"):
        wiring.start_values(STATE)


def test_an_fmu_that_starts_elsewhere_is_refused_unless_placed() -> None:
    wiring = wire(own_fmu())
    with pytest.raises(InputError, match="placed = true"):
        wiring.begin(values(wiring, our_names(np.zeros(7))), STATE)


@those(
    pose=st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-10, 10)),
    asked=st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-10, 10)),
    distance=st.floats(0, 5),
)
def test_a_placed_fmu_drives_the_same_way_from_the_asked_pose(
    pose: tuple[float, float, float], asked: tuple[float, float, float], distance: float
) -> None:
    """Ahead of its own start is ahead of the asked one; velocities are the car's, unchanged."""
    text = '[fmu]\nplaced = true\n[outputs]\nworld_vx = "ve"\nworld_vy = "vn"'
    fmu = own_fmu(given("ve"), given("vn"), without=("vx", "vy"))
    wiring = wire(fmu, parse_map(text))
    say = replacing("vx", "vy", ve=east, vn=north)

    def after(start: tuple[float, float, float]) -> tuple[Floats, Floats]:
        """The state there and the one ``distance`` ahead and a quarter turn to the left."""
        first, later = STATE.copy(), STATE.copy()
        x, y, psi = start
        first[:3] = start
        later[:3] = x + distance * math.cos(psi), y + distance * math.sin(psi), psi + math.pi / 2
        return first, later

    (theirs, theirs_later), (ours, ours_later) = after(pose), after(asked)
    assert_same(wiring.begin(values(wiring, say(theirs)), ours), ours)
    got = wiring.state(values(wiring, say(theirs_later)), U, 0.02)
    assert np.abs(got - ours_later).max() < 1e-11


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_comes_through_as_such(bad: float) -> None:
    """It must be visible in the state; nothing on the way may raise."""
    for text, without, theirs in (
        ("", (), ()),
        ('[outputs]\nworld_vx = "a"\nworld_vy = "b"', ("vx", "vy"), ("a", "b")),
        ('[outputs]\nspeed = "a"\nslip = "b"', ("vx", "vy"), ("a", "b")),
    ):
        fmu = own_fmu(*map(given, theirs), without=without)
        wiring = wire(fmu, parse_map(text))
        wiring.begin([bad] * len(wiring.outputs), STATE)
        assert not np.isfinite(wiring.state([bad] * len(wiring.outputs), U, 0.02)).all()
