"""Rotors: thrust and torque of any layout, layouts in files, and layouts that cannot hover."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from tests.layouts import LAYOUTS, with_layout

from flytune.config import document
from flytune.errors import BadInput
from flytune.physics.rotors import places, reach, spins, thrust_and_torque
from flytune.physics.vehicle import Rotors, Vehicle, load_vehicle, vehicle_table


@pytest.mark.parametrize("name", ["crazyflie", *LAYOUTS])
def test_the_torque_is_the_moment_of_the_thrusts_and_the_spins_drag(name):
    vehicle = load_vehicle(name) if name == "crazyflie" else with_layout(name)
    speeds = np.array([15000.0, 16000.0, 16500.0, 14000.0])
    lever = 39.73e-3 / 2**0.5
    place = [[lever, -lever], [-lever, -lever], [-lever, lever], [lever, lever]]
    spin = [-1, 1, -1, 1]
    if name in LAYOUTS:
        place, spin = LAYOUTS[name].place, LAYOUTS[name].spin
    forces = np.array([[0, 0, f] for f in 3.16e-10 * speeds**2])
    moment = np.cross(np.c_[np.array(place), np.zeros(4)], forces).sum(axis=0)
    moment[2] += 7.49e-12 * speeds**2 @ spin
    thrust, torque = thrust_and_torque(vehicle, tuple(map(jnp.float32, speeds)))
    np.testing.assert_allclose(thrust, forces[:, 2].sum(), rtol=1e-6)
    np.testing.assert_allclose(np.stack(torque), moment, atol=1e-6 * np.abs(moment).max())


def test_a_layout_with_the_places_of_the_x_configuration_is_the_x_configuration():
    vehicle = load_vehicle("crazyflie")
    again = Rotors(place=tuple(map(tuple, places(vehicle).tolist())), spin=spins(vehicle))
    other = dataclasses.replace(vehicle, arm=None, rotors=again)
    assert reach(other) == pytest.approx(vehicle.arm)
    speeds = tuple(map(jnp.float32, (15000.0, 16000.0, 16500.0, 14000.0)))
    for one, two in zip(thrust_and_torque(vehicle, speeds)[1], thrust_and_torque(other, speeds)[1], strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-5)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_vehicle_file_holds_a_layout_and_is_read_back_exactly(name, tmp_path):
    vehicle = with_layout(name)
    text = document.write(vehicle, vehicle.sources)
    (tmp_path / f"{name}.toml").write_text(text)
    assert "\n[rotors]\n" in text and "\narm = 0" not in text
    assert load_vehicle(str(tmp_path / f"{name}.toml")) == vehicle


X = [[0.03, -0.03], [-0.03, -0.03], [-0.03, 0.03], [0.03, 0.03]]


@pytest.mark.parametrize(
    ("place", "spin", "message"),
    [
        ([[0.05, -0.03], *X[1:]], [-1, 1, -1, 1], r"rotors\.place: the middle of the rotors, \(0\.005, 0\), is not"),
        (X, [-1, 1, -1, -1], r"rotors\.spin: \[-1, 1, -1, -1\] turns the vehicle at hover\. Allowed: two of 1 and"),
        (X, [1, 1, -1, -1], r"rotors\.spin: yaw torque cannot be given alone\. Allowed: neighbours that spin in opp"),
        (X, [2, 1, -1, -1], r"rotors\.spin\.0: 2 is not allowed\. Allowed: one of -1, 1\."),
        ([[0.04, 0], [0, 0], [-0.02, 0], [-0.02, 0]], [1, -1, 1, -1], r"rotors\.place: three rotors stand on one line"),
        (X[:3], [1, -1, 1, -1], r"rotors\.place\.3: missing|rotors\.place"),
    ],
)
def test_a_layout_that_cannot_hover_or_turn_is_refused(place, spin, message):
    table = vehicle_table("crazyflie") | {"rotors": {"place": place, "spin": spin}}
    del table["arm"]
    with pytest.raises(BadInput, match=f"^{message}"):
        document.read(Vehicle, table)


def test_an_arm_beside_a_layout_is_refused():
    table = vehicle_table("crazyflie") | {"rotors": {"place": X, "spin": [-1, 1, -1, 1]}}
    with pytest.raises(BadInput, match=r"^arm: stands beside \[rotors\]"):
        document.read(Vehicle, table)
