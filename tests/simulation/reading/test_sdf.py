"""SDF with the motor models of Gazebo."""

import math

import numpy as np
import pytest
from tests.simulation.reading import models

from flytune.errors import BadInput
from flytune.physics.found_vehicle import completed
from flytune.simulation.reading import read_model

PER_RPM = 2 * math.pi / 60


@pytest.fixture
def read(tmp_path):
    """What is found in the text of a file."""

    def found(text, name="own/model.sdf"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        return read_model(path)

    return found


def test_every_number_of_the_motor_models_is_read(read):
    found = read(models.sdf())
    table = found.table
    assert table["thrust_coefficient"] == pytest.approx(8e-6 * PER_RPM**2, rel=1e-14)
    assert table["torque_coefficient"] == pytest.approx(0.016 * 8e-6 * PER_RPM**2, rel=1e-14)
    assert table["maximum_rotor_speed_rpm"] == pytest.approx(1000 / PER_RPM, rel=1e-14)
    assert (table["motor_rise_time_constant"], table["motor_fall_time_constant"]) == (0.0125, 0.025)
    assert table["rotor_drag"] == [8e-5, 8e-5, 0.0] and table["propeller_radius"] == 0.1
    assert table["rotors"] == {"place": [list(place) for place in models.PLACES], "spin": [-1, -1, 1, 1]}
    assert found.name == "own/model.sdf" and completed(found).missing == {}


def test_masses_and_inertias_are_those_of_all_links_about_their_common_centre(read):
    # 1 kg at the origin and 4 x 10 g at z = 0.06: the centre at 0.04 * 0.06 / 1.04; reduced mass 0.04 / 1.04 about x, y
    table = read(models.sdf()).table
    up = 0.04 / 1.04 * 0.06**2
    assert table["mass"] == pytest.approx(1.04)
    expected = [
        0.005 + 4 * 1e-6 + up + 0.04 * 0.12**2,
        0.006 + 4 * 2e-6 + up + 0.04 * 0.1**2,
        0.009 + 4 * 3e-6 + 0.04 * (0.1**2 + 0.12**2),
    ]
    np.testing.assert_allclose(table["inertia"], expected, rtol=1e-12)
    assert "products_of_inertia" not in table


def test_an_included_model_is_looked_for_beside_the_folder_and_its_pose_counts(read, tmp_path):
    (tmp_path / "frame").mkdir()
    (tmp_path / "frame" / "model.sdf").write_text(
        models.sdf(f"<pose>0 0 0.24 0 0 0</pose>{models.links()}", name="frame", motors="")
    )
    (tmp_path / "camera").mkdir()
    (tmp_path / "camera" / "model.config").write_text("<model><sdf version='1.9'>camera.sdf</sdf></model>")
    (tmp_path / "camera" / "camera.sdf").write_text(
        "<sdf version='1.9'><model name='camera'><link name='lens'><inertial><mass>0.1</mass></inertial></link></model>"
        "</sdf>"
    )
    include = "<include merge='true'><uri>model://frame</uri></include>"
    alone, plain = read(models.sdf(include)).table, read(models.sdf()).table
    assert alone.keys() == plain.keys() and alone["rotors"] == plain["rotors"]
    np.testing.assert_allclose(alone["inertia"], plain["inertia"], rtol=1e-12)
    # 0.1 kg at 0.24 + 0.06 = 0.3 m, thus 0.06 m above the body; of 1.14 kg with the rotors' 40 g at the same height
    camera = "<include><uri>camera</uri><name>eye</name><pose relative_to='base_link'>0 0 0.06 0 0 0</pose></include>"
    found = read(models.sdf(include + camera))
    up = 0.14 * 1.0 / 1.14 * 0.06**2
    assert found.table["mass"] == pytest.approx(1.14)
    assert found.table["inertia"][0] == pytest.approx(0.005 + 4e-6 + up + 0.04 * 0.12**2)
    assert any("'eye::lens' gives no inertia" in note for note in found.notes)


def test_an_included_model_that_is_not_there_is_named(read):
    sensor = "<include><uri>model://gps</uri></include>"
    found = read(models.sdf(models.links() + sensor))
    assert any("'model://gps' is not there" in note and "not counted" in note for note in found.notes)
    with pytest.raises(BadInput, match=r"no link 'rotor_0'.*'model://frame' is not there"):
        read(models.sdf("<include merge='true'><uri>model://frame</uri></include>"))


def test_poses_in_degrees_as_quaternions_and_relative_to_frames_are_the_same_pose(read):
    plain = models.links()
    for pose in (
        '<pose degrees="true">0.1 -0.12 0.06 0 0 90</pose>',
        '<pose rotation_format="quat_xyzw">0.1 -0.12 0.06 0 0 0.7071067811865476 0.7071067811865476</pose>',
        '<pose relative_to="corner">0 0 0.06 0 0 1.5707963267948966</pose>',
    ):
        corner = '<frame name="corner"><pose>0.1 -0.12 0 0 0 0</pose></frame>'
        turned = read(models.sdf(corner + plain.replace("<pose>0.1 -0.12 0.06 0 0 0</pose>", pose))).table
        np.testing.assert_allclose(turned["rotors"]["place"], models.PLACES, atol=1e-12)
        # the rotor's own Ixx and Iyy change places
        assert turned["inertia"][0] - read(models.sdf()).table["inertia"][0] == pytest.approx(1e-6, rel=1e-6)


def test_a_heavy_part_on_one_side_moves_the_centre_and_is_named(read):
    side = (
        "<link name='arm'><pose>0.1 0 0 0 0 0</pose><inertial><mass>0.1</mass><inertia><ixx>0</ixx></inertia>"
        "</inertial></link>"
    )
    found = read(models.sdf(models.links() + side))
    assert any("(-8.77, 0) mm from the centre of mass" in note for note in found.notes)  # 0.1 * 0.1 / 1.14
    np.testing.assert_allclose(found.table["rotors"]["place"], models.PLACES, atol=1e-12)


def motors(**changes):
    """Four motors, the first with changes."""
    return models.motor(0, **changes) + "".join(models.motor(index) for index in range(1, 4))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (models.sdf(motors=""), "has no motors. Allowed: one model with motor models of Gazebo"),
        (models.sdf(motors=models.motor(0)), "has 1 motor models. Allowed: four"),
        (models.sdf(motors=motors() + models.motor(4, link="rotor_0")), "has 5 motor models"),
        (models.sdf(motors=motors(direction="left")), "turningDirection: 'left' is not allowed. Allowed: cw, ccw"),
        (models.sdf(motors=motors(link="none")), "there is no link 'none'"),
        (models.sdf(motors=motors(constant="9e-6")), "motorConstant: the motors differ"),
        (models.sdf(motors=motors(constant="8e-6 N")), "motor 0: motorConstant: '8e-6 N' is not allowed"),
        (models.sdf(motors=motors(more="<motorType>position</motorType>")), "motorType: 'position' is not allowed"),
        (models.sdf(motors=models.motor(1) + motors().replace("<motorNumber>2", "<motorNumber>1")), "twice"),
        (models.sdf(models.links(lean="0.17 0 0")), "leans by 9.74 deg"),
        (models.sdf(models.links(places=((1, 1), (1, 1.1), (1.1, 1), (1.1, 1.1)))), "from the centre of mass"),
        (models.sdf(models.links().replace("<mass>1.0", "<mass>-1")), "mass: -1 is not allowed"),
        (models.sdf(models.links().replace("<mass>1.0", "<mass>{{ m }}")), "mass: '{{ m }}' is not allowed"),
        (models.sdf(models.links().replace("<pose>0.1", "<pose relative_to='x'>0.1")), "'x' is no frame"),
        (models.sdf("{% for i in range(4) %}"), "is a template of jinja"),
        (models.sdf().replace("</sdf>", ""), "is not valid XML"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]>" + models.sdf().partition("?>")[2], "has a DOCTYPE or entities"),
        ("<html></html>", "begins with <html>. Allowed: robot (URDF), sdf (SDF), mujoco (MJCF)"),
        ("", "is not valid XML"),
    ],
)
def test_a_file_that_is_no_vehicle_is_refused_in_one_line(read, text, said):
    with pytest.raises(BadInput) as caught:
        read(text)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_model_that_includes_itself_is_refused(read):
    with pytest.raises(BadInput, match="more than 8 deep"):
        read(models.sdf("<include><uri>model://own</uri></include>"))


def test_a_file_that_is_too_large_or_no_text_is_refused(tmp_path):
    large = tmp_path / "large.sdf"
    large.write_text(models.sdf() + " " * (5 << 20))
    with pytest.raises(BadInput, match=r"bytes. Allowed: 4194304 or less"):
        read_model(large)
    (tmp_path / "bytes.urdf").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadInput, match="is not text in UTF-8"):
        read_model(tmp_path / "bytes.urdf")
    with pytest.raises(BadInput, match="cannot be read"):
        read_model(tmp_path / "none.urdf")
