"""A map turns what a foreign model says into the car's state: conventions in use, to rounding."""

import math
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given as those
from hypothesis import strategies as st

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from plant.fmu.map import wire
from plant.fmu.map_file import parse_map
from plant.fmu.package import read_description
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
    values,
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
    wiring = wire(own_fmu(), parse_map('[parameters]\nmass_kg = "50 g"'))
    assert wiring.start_values(STATE)["mass_kg"] == pytest.approx(0.05, rel=1e-12)
    assert (read(wiring, our_names, STATE) == STATE).all()


# -- headings -------------------------------------------------------------------------------------

COMPASS = 'psi = { variable = "hdg", unit = "deg", sign = -1, offset = "90 deg" }'

HEADINGS: dict[str, tuple[str, Callable[[dict[str, float]], float]]] = {
    "degrees": ('psi = { variable = "hdg", unit = "deg" }', lambda s: math.degrees(s["psi"])),
    "wrapped at ±180": (
        'psi = { variable = "hdg", unit = "deg" }',
        lambda s: (math.degrees(s["psi"]) + 180) % 360 - 180,
    ),
    "compass, 0 to 360": (COMPASS, lambda s: (90 - math.degrees(s["psi"])) % 360),
    "wrapped at ±pi": (
        'psi = "hdg"',
        lambda s: math.atan2(math.sin(s["psi"]), math.cos(s["psi"])),
    ),
    "turns": ('psi = { variable = "hdg", unit = "turn" }', lambda s: s["psi"] / (2 * math.pi)),
    "scaled by hand": (
        "psi = { variable = 'hdg', scale = -1e-3, offset = 1.0 }",
        lambda s: (1.0 - s["psi"]) * 1e3,
    ),
}


@pytest.mark.parametrize("name", HEADINGS)
@those(
    psi=st.floats(-40, 40),
    steps=st.lists(st.floats(-math.pi + 1e-6, math.pi - 1e-6), max_size=20),
)
def test_heading_of_any_convention_stays_continuous(
    name: str, psi: float, steps: list[float]
) -> None:
    """Over several turns, and with changes of almost half a turn a step."""
    text, theirs = HEADINGS[name]
    wiring = wire(own_fmu(given("hdg"), without=("psi",)), parse_map(f"[outputs]\n{text}"))
    say = replacing("psi", hdg=theirs)
    state = STATE.copy()
    state[2] = psi
    assert_same(wiring.begin(values(wiring, say(state)), state), state)
    for step in steps:
        state[2] += step
        assert_same(wiring.state(values(wiring, say(state)), U, 0.02), state)


@those(psi=st.floats(-40, 40), length=st.floats(0.5, 2.0), half=st.sampled_from([1.0, -1.0]))
def test_heading_from_a_quaternion_of_either_sign_and_any_length(
    psi: float, length: float, half: float
) -> None:
    rule = 'psi = { quaternion = { w = "q[3]", x = "q[0]", y = "q[1]", z = "q[2]" } }'
    parts = [given(f"q[{i}]") for i in range(4)]
    wiring = wire(own_fmu(*parts, without=("psi",)), parse_map(f"[derive]\n{rule}"))
    factor = length * half

    def say(state: Floats) -> dict[str, float]:
        angle = state[2] / 2
        q = {"q[0]": 0.0, "q[1]": 0.0, "q[2]": math.sin(angle), "q[3]": math.cos(angle)}
        return our_names(state) | {name: factor * value for name, value in q.items()}

    state = STATE.copy()
    state[2] = psi
    assert_same(read(wiring, say, state), state)


def test_heading_from_a_quaternion_of_a_car_that_pitches_and_rolls() -> None:
    """North-east-down: y to the right, yaw clockwise; x of ours is north."""
    rule = 'psi = { quaternion = { w = "w", x = "i", y = "j", z = "k" }, sign = -1 }'
    fmu = own_fmu(*(given(name) for name in "wijk"), without=("psi",))
    wiring = wire(fmu, parse_map(f"[derive]\n{rule}"))

    def say(state: Floats) -> dict[str, float]:
        roll, pitch, yaw = 0.1, -0.2, -state[2]
        (cr, cp, cy), (sr, sp, sy) = (
            [f(angle / 2) for angle in (roll, pitch, yaw)] for f in (math.cos, math.sin)
        )
        return our_names(state) | {
            "w": cr * cp * cy + sr * sp * sy,
            "i": sr * cp * cy - cr * sp * sy,
            "j": cr * sp * cy + sr * cp * sy,
            "k": cr * cp * sy - sr * sp * cy,
        }

    assert_same(read(wiring, say, STATE), STATE)


def test_heading_from_cosine_and_sine() -> None:
    fmu = own_fmu(given("c"), given("s"), without=("psi",))
    wiring = wire(fmu, parse_map('[derive]\npsi = { cos = "c", sin = "s", offset = "-90 deg" }'))
    say = replacing("psi", c=lambda s: -math.sin(s["psi"]), s=lambda s: math.cos(s["psi"]))
    assert_same(read(wiring, say, STATE), STATE)


# -- velocities and rates -------------------------------------------------------------------------


@those(psi=st.floats(-10, 10), vx=st.floats(-3, 3), vy=st.floats(-1, 1))
def test_velocity_from_the_world(psi: float, vx: float, vy: float) -> None:
    """East and south, in km/h."""
    rule = 'velocity = { world_x = { variable = "ve", unit = "km/h" }, world_y = { variable = "vs"'
    rule += ', unit = "km/h", sign = -1 } }'
    fmu = own_fmu(given("ve"), given("vs"), without=("vx", "vy"))
    wiring = wire(fmu, parse_map(f"[derive]\n{rule}"))
    say = replacing(
        *("vx", "vy"),
        ve=lambda s: 3.6 * (math.cos(s["psi"]) * s["vx"] - math.sin(s["psi"]) * s["vy"]),
        vs=lambda s: -3.6 * (math.sin(s["psi"]) * s["vx"] + math.cos(s["psi"]) * s["vy"]),
    )
    state = STATE.copy()
    state[2:5] = psi, vx, vy
    assert_same(read(wiring, say, state), state)


def test_velocity_from_speed_and_slip_angle() -> None:
    fmu = own_fmu(given("v", "km/h"), given("beta", "deg"), without=("vx", "vy"))
    wiring = wire(fmu, parse_map('[derive]\nvelocity = { speed = "v", slip = "beta" }'))
    say = replacing(
        *("vx", "vy"),
        v=lambda s: 3.6 * math.hypot(s["vx"], s["vy"]),
        beta=lambda s: math.degrees(math.atan2(s["vy"], s["vx"])),
    )
    assert_same(read(wiring, say, STATE), STATE)


def test_velocity_of_a_model_without_side_slip() -> None:
    wiring = wire(
        own_fmu(given("v"), without=("vx", "vy")), parse_map('[derive]\nvelocity = { speed = "v" }')
    )
    state = STATE.copy()
    state[4] = 0.0
    assert_same(read(wiring, replacing("vx", "vy", v=lambda s: s["vx"]), state), state)


def test_yaw_rate_from_the_heading_across_the_wrap() -> None:
    fmu = own_fmu(given("hdg", "deg"), without=("psi", "omega"))
    wiring = wire(fmu, parse_map(f'[outputs]\n{COMPASS}\n[derive]\nomega = "psi"'))
    say = replacing("psi", "omega", hdg=HEADINGS["compass, 0 to 360"][1])
    state = STATE.copy()
    state[2] = math.pi / 2 - 0.01
    first = wiring.begin(values(wiring, say(state)), state)
    assert first[5] == state[5]  # there is no difference yet
    state[2] += 0.04
    assert wiring.state(values(wiring, say(state)), U, 0.02)[5] == pytest.approx(2.0, rel=1e-9)


def test_steering_angle_from_the_rate_that_acted_and_afresh_each_run() -> None:
    wiring = wire(own_fmu(without=("delta",)), parse_map('[derive]\ndelta = "delta_rate"'))
    for _ in range(2):
        wiring.begin(values(wiring, our_names(STATE)), STATE)
        deltas = [wiring.state(values(wiring, our_names(STATE)), U, 0.01)[6] for _ in range(3)]
        assert deltas == pytest.approx([0.18, 0.16, 0.14], abs=TOLERANCE)


def test_a_description_beyond_measure_is_refused_before_it_is_read(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "huge.fmu", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", " " * 20_000_000)
    with pytest.raises(InputError, match=r"huge\.fmu: its modelDescription\.xml has 20 MB"):
        read_description(tmp_path / "huge.fmu")
