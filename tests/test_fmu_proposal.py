"""Inspection proposes a map from names, units and descriptions; it parses, whatever they are."""

import contextlib
import math
import tomllib
from typing import Any

from hypothesis import example
from hypothesis import given as those
from hypothesis import strategies as st

from bayesrace.errors import InputError
from plant.fmu.inspection import Variable
from plant.fmu.map import wire
from plant.fmu.map_file import parse_map
from plant.fmu.proposal import starting_map
from tests.fmu_variables import description, given, own_fmu, taken, variable
from tests.foreign_fmu import FOREIGN_MAP


def test_the_map_of_our_own_fmu_works_unchanged() -> None:
    text = starting_map(own_fmu())
    assert "TO FILL IN" not in text
    wiring, plain = wire(own_fmu(), parse_map(text)), wire(own_fmu())
    assert (wiring.inputs, wiring.outputs) == (plain.inputs, plain.outputs)
    x0 = [0.1 * i for i in range(7)]
    assert wiring.start_values(x0) == plain.start_values(x0)
    assert (wiring.begin(x0, x0) == x0).all()
    assert "# mass_kg = 0.041  # [kg] mass" in text


def proposal_for(*variables: Variable) -> dict[str, Any]:
    """The map proposed for these variables."""
    return tomllib.loads(starting_map(description(*variables)))


def test_common_names_are_guessed() -> None:
    proposed = proposal_for(
        *(taken("throttle_pct"), taken("brakePedal"), taken("steeringAngleCmd", "deg")),
        *(given("pos_x_cm"), given("pos_y_cm"), given("vehicle.yaw", "deg")),
        *(
            given("vehicle.v_lon", "km/h"),
            given("vehicle.v_lat", "km/h"),
            given("yawRate", "deg/s"),
        ),
        *(given("steeringAngle"), variable("x_init", "parameter"), variable("yaw0", "parameter")),
    )
    assert proposed["inputs"] == {
        "throttle_pct": {"from": "throttle", "unit": "%"},
        "brakePedal": {"from": "brake"},
        "steeringAngleCmd": {"from": "delta"},
    }
    assert proposed["outputs"] == {
        "x": {"variable": "pos_x_cm", "unit": "cm"},
        "y": {"variable": "pos_y_cm", "unit": "cm"},
        "psi": "vehicle.yaw",
        "vx": "vehicle.v_lon",
        "vy": "vehicle.v_lat",
        "omega": "yawRate",
        "delta": "steeringAngle",
    }
    assert proposed["start"] == {"x_init": {"from": "x"}, "yaw0": {"from": "psi"}}


def test_what_can_be_derived_is() -> None:
    proposed = proposal_for(
        *(given("x"), given("y"), given("v"), given("beta", "deg"), given("rate", "deg/s")),
        *(given(f"q{i}") for i in range(4)),
        *(taken("steer"), taken("gas")),
    )
    assert proposed["derive"] == {
        "psi": {"quaternion": {"w": "q0", "x": "q1", "y": "q2", "z": "q3"}},
        "velocity": {"speed": "v", "slip": "beta"},
        "omega": "psi",
        "delta": "delta_rate",
    }


def test_a_unit_forbids_a_guess() -> None:
    assert "x" not in proposal_for(given("x", "km/h"))["outputs"]


def test_the_map_of_the_foreign_model_follows_from_its_descriptions() -> None:
    """Declared as that tool does it: no units, all in words."""
    fmu = description(
        taken("PedalPercent", description="drive command in percent, negative brakes"),
        taken("SteerAngleCmd", description="wheel angle in deg, positive to the right"),
        *(given("posEast", description="in cm"), given("posNorth", description="in cm")),
        given("compass", description="heading in deg, clockwise from north"),
        *(given("velEast", description="in km/h"), given("velNorth", description="[km/h]")),
        given("turnRate", description="yaw rate in deg/s, clockwise"),
        *(variable(f"start{name}", "parameter", description=f"in {unit}")
          for name, unit in (("East", "cm"), ("North", "cm"), ("Speed", "km/h"))),
        variable("startCompass", "parameter", description="heading in deg, clockwise from north"),
    )  # fmt: skip
    proposed, right = wire(fmu, parse_map(starting_map(fmu))), wire(fmu, parse_map(FOREIGN_MAP))
    x0 = [1.0, 2.0, 0.5, 0.8, 0.0, 0.3, 0.1]
    assert proposed.start_values(x0) == right.start_values(x0)
    said = dict(zip(right.outputs, (100.0, 200.0, 61.4, 2.4, 1.6, -17.2), strict=True))
    states = []
    for wiring in (proposed, right):
        outputs = [said[name] for name in wiring.outputs]
        wiring.begin(outputs, [1.0, 2.0, math.radians(90 - 61.4), 0, 0, 0, 0.1])
        states.append(wiring.state(outputs, (0.5, 1.0), 0.02))
    assert (states[0] == states[1]).all()


names = st.text(st.characters(codec="utf-8"), min_size=1, max_size=30)


@those(
    name=names,
    text=names,
    start=st.sampled_from(["0", "nan", "1e999", "true", "a\nb", "", "1 2 3"]) | names,
    kind=st.sampled_from(["real", "integer", "boolean", "string", "enumeration", "binary"]),
    causality=st.sampled_from(["input", "output", "parameter", "local"]),
    unit=st.none() | names,
)
@example("x", "in m\n[inputs]", "\x7f", "string", "parameter", "\n[")
@example("steer\x7f'\"\\", "\u2028", "0", "real", "input", "deg")
def test_the_proposal_always_parses(
    name: str, text: str, start: str, kind: Any, causality: str, unit: str | None
) -> None:
    one = variable(
        name, causality, unit, kind=kind, fmi_type=kind, start=start, description=text,
        initial="exact",
    )  # fmt: skip
    others = [given("x"), taken("d", description=text)]
    proposal = starting_map(description(one, *others, model_name=text))
    map_ = parse_map(proposal)
    with contextlib.suppress(InputError):
        wire(description(one, *others), map_)
