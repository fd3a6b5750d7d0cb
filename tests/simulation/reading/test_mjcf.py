"""MJCF, through MuJoCo's own compiler."""

import sys

import numpy as np
import pytest
from tests.layouts import LAYOUTS, with_layout
from tests.simulation.reading import models

from flytune.errors import BadInput
from flytune.physics.found_vehicle import completed
from flytune.physics.vehicle import load_vehicle
from flytune.simulation.model_files import mjcf
from flytune.simulation.reading import read_model

pytest.importorskip("mujoco", reason="needs flytune[mujoco]")


@pytest.fixture
def read(tmp_path):
    """What is found in the text of a file."""

    def found(text, name="own.xml"):
        path = tmp_path / name
        path.write_text(text)
        return read_model(path)

    return found


def test_what_a_file_of_mujoco_tells_is_read_and_the_rest_named(read):
    found = completed(read(models.mjcf(option='<option gravity="0 0 -9.8"/>')))
    assert found.table["mass"] == 1 and found.table["gravity"] == 9.8
    np.testing.assert_allclose(found.table["inertia"], [0.005, 0.006, 0.009], rtol=1e-12)
    assert found.table["rotors"] == {"place": [list(place) for place in models.PLACES], "spin": [-1, -1, 1, 1]}
    assert found.table["thrust_to_weight"] == pytest.approx(4 * 5 / 9.8)
    assert found.table["action_scale"] == pytest.approx(np.sqrt(20 / 9.8) - 1, rel=1e-5)
    assert sorted(found.missing) == [
        "motor_fall_time_constant", "motor_rise_time_constant", "propeller_radius", "thrust_coefficient",
        "torque_coefficient",
    ]  # fmt: skip
    assert found.missing["torque_coefficient"] == "0.02 m times thrust_coefficient (own.xml, gear)"


def test_flat_shapes_at_the_rotors_tell_the_propellers_radius_and_a_filter_their_lag(read):
    discs = "".join(f'<geom type="cylinder" size="0.07 0.002" pos="{x} {y} 0.05" mass="0"/>' for x, y in models.PLACES)
    lagging = "".join(
        f'<general name="m{i}" site="s{i}" gear="0 0 1 0 0 {spin}" dyntype="filterexact" dynprm="0.04" gainprm="2" '
        'ctrllimited="true" ctrlrange="0 2.5"/>'
        for i, spin in enumerate((-0.02, -0.02, 0.02, 0.02))
    )
    table = completed(read(models.mjcf(lagging, geoms=discs))).table
    assert table["propeller_radius"] == 0.07
    assert (table["motor_rise_time_constant"], table["motor_fall_time_constant"]) == (0.04, 0.04)
    assert table["thrust_to_weight"] == pytest.approx(4 * 5 / 9.81)


def test_force_and_torque_apart_leave_the_spins_to_be_given(read):
    apart = "".join(
        f'<motor name="f{i}" site="s{i}" gear="0 0 1 0 0 0"/><motor name="t{i}" site="s{i}" gear="0 0 0 0 0 1"/>'
        for i in range(4)
    )
    found = completed(read(models.mjcf(apart)))
    assert "rotors.spin" in found.missing and "maximum_rotor_speed_rpm" in found.missing
    assert "action_scale" in found.missing and "spin" not in found.table["rotors"]
    assert found.figures()  # those of mass, inertia and places can be had all the same


@pytest.mark.parametrize("name", ["crazyflie", "crazyflie-l250", "hummingbird", "racer"])
def test_what_flytune_writes_is_read_back(read, name):
    vehicle = load_vehicle(name)
    back = completed(read(mjcf(vehicle))).table
    assert back["mass"] == vehicle.mass and back["gravity"] == vehicle.gravity
    np.testing.assert_allclose(back["inertia"], vehicle.inertia, rtol=1e-12)
    assert back["propeller_radius"] == vehicle.propeller_radius
    lift = vehicle.square_of_speed(vehicle.top_rotor_speed_rpm) / vehicle.hover_square
    assert back["thrust_to_weight"] == pytest.approx(lift, rel=1e-9)
    if vehicle.rotors is None:
        assert back["arm"] == pytest.approx(vehicle.arm, rel=1e-11)
    else:
        np.testing.assert_allclose(back["rotors"]["place"], vehicle.rotors.place, atol=1e-12)
        assert tuple(back["rotors"]["spin"]) == vehicle.rotors.spin


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_that_flytune_writes_is_read_back(read, name):
    vehicle = with_layout(name)
    back = read(mjcf(vehicle)).table
    np.testing.assert_allclose(back["rotors"]["place"], vehicle.rotors.place, atol=1e-12)
    assert tuple(back["rotors"]["spin"]) == vehicle.rotors.spin


WRENCH = (
    '<motor name="thrust" site="centre" gear="0 0 1 0 0 0"/><motor name="x" site="centre" gear="0 0 0 1 0 0"/>'
    '<motor name="y" site="centre" gear="0 0 0 0 1 0"/><motor name="z" site="centre" gear="0 0 0 0 0 1"/>'
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (models.mjcf(WRENCH), "has thrust and torques of the whole body (thrust, x, y, z) in place of rotors. Missing"),
        (models.mjcf(""), "has no motors: 0 actuators, none on a site"),
        (models.mjcf('<motor site="centre" gear="0 0 0 0 0 1"/>'), "no actuator pushes along z"),
        (models.mjcf(sites=models.PLACES[:3]), "has 3 actuators that push along z"),
        (models.mjcf().replace('gear="0 0 1 0 0 0.02"', 'gear="0.5 0 1 0 0 0.02"'), "leans by 26.6 deg"),
        (models.mjcf().replace('gear="0 0 1 0 0 0.02"', 'gear="0 0 -1 0 0 0.02"'), "leans by 180 deg"),
        (
            models.mjcf().replace('gear="0 0 1 0 0 0.02"', 'gear="0 0 1 0 0 0.03"', 1),
            "torque over thrust in m: the rot",
        ),
        (models.mjcf().replace("</actuator>", ""), "is not valid XML"),
        (models.mjcf().replace('mass="1"', 'mass="heavy"'), "MuJoCo cannot compile it"),
        (models.mjcf().replace('site="s3"', 'site="s2"'), "two actuators push on one site"),
    ],
)
def test_a_file_that_is_no_vehicle_is_refused_in_one_line(read, text, said):
    with pytest.raises(BadInput) as caught:
        read(text)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_frame_that_cannot_be_controlled_is_refused(read):
    swapped = models.mjcf(sites=(models.PLACES[0], models.PLACES[3], models.PLACES[1], models.PLACES[2]))
    with pytest.raises(BadInput, match="yaw torque cannot be given alone"):
        _ = completed(read(swapped)).vehicle


def test_without_mujoco_the_line_says_how_to_install_it(read, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(BadInput, match=r'pip install "flytune\[mujoco\]"'):
        read(models.mjcf())
