"""URDF, as gym-pybullet-drones and RotorS have it, and as flytune writes it."""

import dataclasses

import numpy as np
import pytest
from tests.layouts import LAYOUTS, with_layout
from tests.simulation.reading import models

from flytune.errors import BadInput
from flytune.physics.found_vehicle import completed
from flytune.physics.vehicle import load_vehicle
from flytune.simulation.model_files import urdf
from flytune.simulation.reading import read_model

XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


@pytest.fixture
def read(tmp_path):
    """What is found in the text of a file."""

    def found(text, name="own.urdf"):
        path = tmp_path / name
        path.write_text(text)
        return read_model(path)

    return found


def test_every_number_of_gym_pybullet_drones_is_read(read):
    text = models.urdf(
        properties='arm="0.15" kf="1e-8" km="2e-10" thrust2weight="3" prop_radius="0.06" gnd_eff_coeff="11" '
        'drag_coeff_xy="1e-6" drag_coeff_z="2e-6" max_speed_kmh="30"'
    )
    found = read(text)
    assert found.table == {
        "mass": 0.6, "inertia": [2e-3, 3e-3, 4e-3], "products_of_inertia": [1e-5, 0.0, 0.0],
        "thrust_coefficient": 1e-8, "torque_coefficient": 2e-10, "thrust_to_weight": 3.0, "propeller_radius": 0.06,
        "ground_effect": 11.0, "rotor_drag": [1e-6, 1e-6, 2e-6],
        "rotors": {"place": [list(place) for place in models.RING], "spin": [-1, 1, -1, 1]},
    }  # fmt: skip
    assert list(completed(found).missing) == ["motor_rise_time_constant", "motor_fall_time_constant"]
    assert any("max_speed_kmh" in note for note in found.notes)
    assert any("arm 0.15 m is not used" in note for note in found.notes)
    assert any("spins are not in the file" in note for note in found.notes)


def test_motors_in_the_order_of_the_x_configuration_give_an_arm(read):
    side = 0.1
    found = read(models.urdf(links=((side, -side), (-side, -side), (-side, side), (side, side))))
    assert found.table["arm"] == pytest.approx(side * np.sqrt(2), rel=1e-11) and "rotors" not in found.table


def test_a_file_that_xacro_made_is_read_though_it_still_names_xacro(read):
    assert read(models.urdf().replace("<robot", f"<robot {XACRO}")).table == read(models.urdf()).table


def test_a_racer_spins_the_other_way_as_gym_pybullet_drones_flies_it(read):
    square = ((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1))
    found = read(models.urdf(name="racer", links=square))
    assert found.table["rotors"]["spin"] == [1, -1, 1, -1]


def test_links_in_an_order_that_gym_pybullet_drones_does_not_fly_leave_the_spins_to_be_given(read):
    found = completed(read(models.urdf(links=models.PLACES)))
    assert "rotors.spin" in found.missing and "spin" not in found.table["rotors"]


def test_without_links_of_propellers_the_arm_says_where_they_are(read):
    found = read(models.urdf(links=(), properties='arm="0.1" kf="1e-8" km="2e-10"'))
    assert found.table["arm"] == pytest.approx(0.1) and "arm" in found.sources["arm"]


def test_joints_turn_and_move_what_hangs_on_them(read):
    # a battery of 0.2 kg, 0.1 m above the body: the centre rises to 0.2 * 0.1 / 0.8 = 0.025 m, and Ixx, Iyy grow by
    # m1 m2 / (m1 + m2) d^2 = 0.6 * 0.2 / 0.8 * 0.01 = 1.5e-3; its own moments 1, 2, 3e-4 turn by 90 deg about z
    battery = """<link name="battery"><inertial><mass value="0.2"/>
      <inertia ixx="1e-4" iyy="2e-4" izz="3e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="j" type="fixed"><parent link="base"/><child link="battery"/>
      <origin xyz="0 0 0.1" rpy="0 0 1.5707963267948966"/></joint>"""
    table = read(models.urdf(more=battery)).table
    assert table["mass"] == pytest.approx(0.8)
    np.testing.assert_allclose(table["inertia"], [2e-3 + 1.5e-3 + 2e-4, 3e-3 + 1.5e-3 + 1e-4, 4e-3 + 3e-4], rtol=1e-12)


def test_the_motor_models_of_gazebo_are_read_from_urdf_too(read):
    rotors = "".join(
        f"""<link name="rotor_{index}"><inertial><mass value="0.01"/>
        <inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="rotor_{index}_joint" type="continuous"><origin xyz="{x} {y} 0.02"/><parent link="base"/>
        <child link="rotor_{index}"/></joint>"""
        for index, (x, y) in enumerate(models.PLACES)
    )
    plugins = "".join(
        f"<gazebo>{models.motor(index, plugin='librotors_gazebo_motor_model.so')}</gazebo>" for index in range(4)
    )
    table = read(models.urdf(properties="", links=(), more=rotors + plugins)).table
    assert table["mass"] == pytest.approx(0.64) and table["rotors"]["spin"] == [-1, -1, 1, 1]
    assert table["motor_rise_time_constant"] == 0.0125


@pytest.mark.parametrize("name", ["crazyflie", "hummingbird", "racer", "x500", "crazyflie-l250"])
def test_what_flytune_writes_is_read_back(read, name):
    vehicle = load_vehicle(name)
    back = completed(read(urdf(vehicle))).table
    for field in ("mass", "thrust_coefficient", "thrust_linear", "torque_coefficient", "torque_linear",
                  "propeller_radius", "ground_effect"):  # fmt: skip
        assert back.get(field) == getattr(vehicle, field), field
    assert tuple(back["inertia"]) == vehicle.inertia
    assert back["thrust_to_weight"] == pytest.approx(
        vehicle.square_of_speed(vehicle.top_rotor_speed_rpm) / vehicle.hover_square, rel=1e-12
    )
    if vehicle.rotors is None:
        assert back["arm"] == pytest.approx(vehicle.arm, rel=1e-11)
    else:
        np.testing.assert_allclose(back["rotors"]["place"], vehicle.rotors.place, atol=1e-12)
        assert tuple(back["rotors"]["spin"]) == vehicle.rotors.spin


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_that_flytune_writes_is_read_back(read, name):
    vehicle = dataclasses.replace(with_layout(name), products_of_inertia=(1e-6, -2e-7, 3e-7))
    back = read(urdf(vehicle)).table
    np.testing.assert_allclose(back["rotors"]["place"], vehicle.rotors.place, atol=1e-12)
    assert tuple(back["rotors"]["spin"]) == vehicle.rotors.spin
    assert tuple(back["products_of_inertia"]) == vehicle.products_of_inertia


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (models.urdf(properties=""), "has no motors. Missing: a tag <properties"),
        (models.urdf(links=models.RING[:3]), "has 3 links named prop0"),
        (models.urdf(links=(*models.RING, (0.3, 0))), "has 5 links named prop0"),
        (models.urdf(properties='kf="one" km="2e-10"'), "properties kf: 'one' is not allowed"),
        (models.urdf(properties='kf="nan" km="2e-10"'), "properties kf: 'nan' is not allowed"),
        (models.urdf(properties='kf="1e-8" spin="1 2 1 1"'), "properties spin: '1 2 1 1' is not allowed"),
        (models.urdf().replace('mass value="0.6"', 'mass value="-1"'), "link 'base': mass: -1 is not allowed"),
        (models.urdf().replace('mass value="0.6"', 'mass value="0"'), "has no mass"),
        (models.urdf().replace('<child link="prop1_link"/>', '<child link="none"/>'), "joint 'prop1_joint'"),
        (models.urdf(more='<link name="loose"/>'), "links are no tree"),
        (models.urdf(links=((1.0, 0), (1.1, 0.1), (1, 0.1), (1.1, 0))), "from the centre of mass"),
        (models.urdf().replace('xyz="0.1 -0.12 0"', 'xyz="0.1 0"'), "origin xyz: '0.1 0' is not allowed"),
        (models.urdf(more=f"<xacro:arm {XACRO}/>"), "is a template of xacro"),
    ],
)
def test_a_file_that_is_no_vehicle_is_refused_in_one_line(read, text, said):
    with pytest.raises(BadInput) as caught:
        read(text)
    assert said in str(caught.value) and "\n" not in str(caught.value)
