"""A vehicle as far as a file tells it."""

import pytest

from flytune.config import document
from flytune.errors import BadInput
from flytune.physics.found_vehicle import FoundVehicle, completed, from_table, text
from flytune.physics.vehicle import Vehicle, vehicle_names, vehicle_table

WHOLE = {name: vehicle_table(name) for name in vehicle_names()}


def without(name, *fields):
    """A vehicle that ships, without some of its numbers."""
    return from_table({key: value for key, value in WHOLE[name].items() if key not in fields})


@pytest.mark.parametrize("name", WHOLE)
def test_a_whole_vehicle_misses_nothing_and_is_not_changed(name):
    found = completed(from_table(WHOLE[name]))
    assert found.missing == {}
    assert document.plain(found.vehicle) == document.plain(
        document.read(Vehicle, {key: value for key, value in WHOLE[name].items() if key != "sources"})
    )


@pytest.mark.parametrize("name", ["crazyflie", "crazyflie-l250", "hummingbird", "racer", "x500"])
@pytest.mark.parametrize(
    "field",
    ["mass", "inertia", "thrust_coefficient", "torque_coefficient", "propeller_radius", "motor_rise_time_constant"],
)
def test_a_number_that_lacks_is_named_and_the_others_are_still_checked(name, field):
    found = without(name, field)
    assert set(found.missing) == {field} and found.missing[field]
    assert f"# {field} =  # " in text(found)
    assert all(field not in figure.of.split(", ") for figure in found.figures())
    with pytest.raises(BadInput, match="gravity: 0"):
        _ = from_table({**found.table, "gravity": 0.0}).vehicle


def test_without_a_layout_the_file_says_how_one_is_written():
    found = without("hummingbird", "rotors")
    assert list(found.missing) == ["rotors"] and "# [rotors]" in text(found)
    spinless = without("hummingbird", "rotors")
    spinless.table["rotors"] = {"place": WHOLE["hummingbird"]["rotors"]["place"]}
    assert list(spinless.missing) == ["rotors.spin"] and "\n# spin = [-1, 1, -1, 1]" in text(spinless)
    assert spinless.figures()


def test_the_action_scale_that_is_full_thrust_is_found():
    found = completed(without("x500", "action_scale", "drag", "gravity", "action_latency_steps"))
    # sqrt(3) times the hover speed where thrust to weight is 3
    assert found.table["action_scale"] == pytest.approx(WHOLE["x500"]["action_scale"], rel=1e-4)
    by_lift = FoundVehicle("x", {**found.table, "thrust_to_weight": 3.0}, {})
    del by_lift.table["maximum_rotor_speed_rpm"], by_lift.table["action_scale"]
    assert completed(by_lift).table["action_scale"] == pytest.approx(3**0.5 - 1, rel=1e-5)
    assert set(found.assumed) == {"drag", "action_latency_steps"} and found.table["gravity"] == 9.81


def test_another_action_convention_needs_no_action_scale():
    found = completed(FoundVehicle("x", {**without("x500", "action_scale").table, "action_convention": "thrust"}, {}))
    assert found.missing == {} and "action_scale" not in found.table
    assert 'action_convention = "thrust"' in text(found)
