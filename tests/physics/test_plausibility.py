"""Every real quadrotor is plausible; a number in another unit is refused, and the unit is named."""

import dataclasses
import math
import re

import pytest
from tests.airframes import AIRFRAMES, airframe
from tests.layouts import LAYOUTS, with_layout

from flytune.config import document
from flytune.errors import BadInput
from flytune.physics.plausibility import figures, implausible, summary
from flytune.physics.vehicle import Vehicle, load_vehicle, vehicle_names, vehicle_table

RPM = 2 * math.pi / 60  # rad/s in one rpm
TABLES = {name: vehicle_table(name) for name in vehicle_names()} | AIRFRAMES
SLIPS = {  # the unit that is named -> the numbers as they are in that unit
    "Is it in mm? Then write arm": {"arm": 1e3},
    "Is it in cm? Then write arm": {"arm": 1e2},
    "Is it in mm? Then write propeller_radius": {"propeller_radius": 1e3},
    "Is it in inches? Then write propeller_radius": {"propeller_radius": 1 / 0.0254},
    "Is it the diameter in inches? Then write propeller_radius": {"propeller_radius": 2 / 0.0254},
    "Is it the diameter in mm? Then write propeller_radius": {"propeller_radius": 2e3},
    "Are they in mm?": {"arm": 1e3, "propeller_radius": 1e3},
    "Are they in cm?": {"arm": 1e2, "propeller_radius": 1e2},
    "Is it in g?": {"mass": 1e3},
    "Are they in g and g cm^2?": {"mass": 1e3, "inertia": 1e7},
    "Is it in g cm^2?": {"inertia": 1e7},
    "Is it in g mm^2?": {"inertia": 1e9},
    "Is it in rad/s? Then write maximum_rotor_speed_rpm": {"maximum_rotor_speed_rpm": RPM},
    "Is it in N/(rad/s)^2?": {"thrust_coefficient": RPM**-2},
    "Is it in N m/(rad/s)^2?": {"torque_coefficient": RPM**-2},
    "Are they in N/(rad/s)^2 and N m/(rad/s)^2?": {"thrust_coefficient": RPM**-2, "torque_coefficient": RPM**-2},
    "Are they in rad/s instead of rpm?": {
        "thrust_coefficient": RPM**-2, "torque_coefficient": RPM**-2, "maximum_rotor_speed_rpm": RPM,
    },
}  # fmt: skip
# the propeller radius of gym-pybullet-drones' racer is twice that of its propeller, so that inches look like cm
AMBIGUOUS = {("racer of ten inches", slip) for slip in SLIPS if "write propeller_radius" in slip}
FEW = ("crazyflie", "racer", "lifter")
CASES = [
    pytest.param(name, slip, marks=[pytest.mark.slow] * (name not in FEW))
    for name in TABLES
    for slip in SLIPS
    if (name, slip) not in AMBIGUOUS
]


def scaled(table, factors):
    """The table with some numbers in another unit."""
    changed = dict(table)
    for name, factor in factors.items():
        if name == "arm" and "rotors" in table:
            place = [[factor * part for part in each] for each in table["rotors"]["place"]]
            changed["rotors"] = table["rotors"] | {"place": place}
            continue
        value = table[name]
        changed[name] = [factor * each for each in value] if isinstance(value, list) else factor * value
    return changed


@pytest.mark.parametrize("name", TABLES)
def test_every_real_vehicle_is_plausible(name):
    vehicle = document.read(Vehicle, TABLES[name])
    assert implausible(vehicle) is None
    assert all(figure.plausible for figure in figures(vehicle))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_plausible(layout):
    assert implausible(with_layout(layout)) is None


@pytest.mark.parametrize(("name", "slip"), CASES)
def test_a_number_in_another_unit_is_refused_and_the_unit_is_named(name, slip):
    with pytest.raises(BadInput) as caught:
        document.read(Vehicle, scaled(TABLES[name], SLIPS[slip]))
    text = str(caught.value)
    if "rotors" in TABLES[name]:
        slip = slip.replace("write arm", "write rotors.place")
    assert slip in text or _also_named(slip, text)
    assert "Allowed: " in text and "\n" not in text


def _also_named(slip, text):
    """A diameter in inches may be a radius in cm: a factor of 1.27. Then both are named."""
    return "diameter in inches" in slip and re.search(
        r"Is it in cm\?.*, or [\d.]+ if it is the diameter in inches", text
    )


@pytest.mark.parametrize(("name", "slip"), CASES)
def test_what_the_message_says_to_write_is_accepted(name, slip):
    table = scaled(TABLES[name], SLIPS[slip])
    with pytest.raises(BadInput) as caught:
        document.read(Vehicle, table)
    written = str(caught.value).split("Then write ")[1].partition(", or ")[0].rstrip(".")
    # "a = 1, b = [1, 2]" as lines of TOML
    names = [each for each in (*TABLES["crazyflie"], "rotors.place") if f"{each} = " in written]
    for field in names:
        written = written.replace(f", {field} = ", f"\n{field} = ")
    edits = document.parse(written, "message")
    if "rotors" in edits:
        edits["rotors"] = table["rotors"] | edits["rotors"]
    vehicle = document.read(Vehicle, table | edits)
    assert vehicle.propeller_radius == pytest.approx(TABLES[name]["propeller_radius"], rel=0.3)  # cm or a diameter
    assert vehicle.mass == pytest.approx(TABLES[name]["mass"], rel=1e-5)
    assert vehicle.thrust_coefficient == pytest.approx(TABLES[name]["thrust_coefficient"], rel=1e-5)


def test_a_propeller_of_five_inches_is_found_by_its_diameter():
    with pytest.raises(BadInput, match=r"^propeller_radius: 5.0 .* Is it the diameter in inches\? Then write "
                       r"propeller_radius = 0\.0635, or 0\.05 if it is in cm\.$"):  # fmt: skip
        document.read(Vehicle, AIRFRAMES["five inches"] | {"propeller_radius": 5})


def test_places_of_rotors_in_mm_are_refused():
    deck = LAYOUTS["long deck"]
    place = [[1000 * x, 1000 * y] for x, y in deck.place]
    table = {name: value for name, value in vehicle_table("crazyflie").items() if name != "arm"}
    with pytest.raises(
        BadInput, match=r"^rotors\.place: \[\[70\.0.* Is it in mm\? Then write rotors\.place = \[\[0\.07, "
    ):
        document.read(Vehicle, table | {"rotors": {"place": place, "spin": list(deck.spin)}})


def test_a_heavy_load_is_not_taken_for_a_slip():
    # 0.1 kg on a Crazyflie: its motors give 74 g
    with pytest.raises(BadInput) as caught:
        document.read(Vehicle, vehicle_table("crazyflie") | {"mass": 0.1})
    assert str(caught.value).startswith("maximum_rotor_speed_rpm: 24006.0 cannot lift the vehicle. Allowed: above")


def test_an_action_that_lifts_nothing_is_refused():
    # (1 + 0.005)^2 = 1.01
    with pytest.raises(BadInput, match=r"^action_scale: 0\.005 cannot lift the vehicle: full action gives 1\.01 times"):
        document.read(Vehicle, vehicle_table("crazyflie") | {"action_scale": 0.005})


def test_the_figures_of_the_papers_vehicle_are_those_worked_out_by_hand():
    found = {figure.name: figure.value for figure in figures(load_vehicle("crazyflie"))}
    # sqrt(1.7108e-5 / 0.033) = 0.022769 m, over 0.03973 m
    assert found["smallest radius of gyration over arm"] == pytest.approx(0.5731, rel=1e-3)
    # 3.16e-10 * 3600 / (1.225 * 0.0462696^4) = 1.1376e-6 / 5.6146e-6
    assert found["thrust coefficient C_T"] == pytest.approx(0.2026, rel=1e-3)
    # 16,003.6 rpm = 1675.9 rad/s, times 23.1348 mm
    assert found["propeller tip speed at hover"] == pytest.approx(38.77, rel=1e-3)
    # 7.49e-12 / 3.16e-10 = 23.70 mm, over 23.1348 mm
    assert found["torque over thrust"] == pytest.approx(1.0245, rel=1e-3)
    assert summary(load_vehicle("crazyflie")) == (
        "hovers at 16004 rpm (propeller tips at 39 m/s); thrust to weight 2.25; torque over thrust 23.7 mm; radius of "
        "gyration over arm 0.573, 0.573, 0.713 (x, y, z); thrust coefficient C_T 0.203"
    )


def test_a_thrust_to_weight_of_12_is_allowed():
    assert airframe("five inches").full_thrust_to_weight == pytest.approx(3.46**2)


def test_rotor_drag_in_another_unit_is_refused():
    vehicle = load_vehicle("crazyflie")
    wrong = dataclasses.replace(vehicle, rotor_drag=tuple(1e3 * each for each in vehicle.optional_rotor_drag))
    assert "rotor drag at hover over mass is " in implausible(wrong)
