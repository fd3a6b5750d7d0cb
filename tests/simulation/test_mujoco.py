"""MuJoCo alone: what its file says, and what its integrators do."""

import dataclasses
import math

import numpy as np
import pytest

from flytune.physics.vehicle import load_vehicle
from flytune.simulation.model_files import mjcf

mujoco = pytest.importorskip("mujoco", reason="needs flytune[mujoco]")


@pytest.fixture(scope="module")
def odd():
    """A vehicle with three different moments, and a name XML could trip over."""
    inertia = (1.7e-5, 1.23456789e-5, 2.6e-5)
    return dataclasses.replace(load_vehicle("crazyflie"), name='a "quoted" <name> & more', inertia=inertia)


@pytest.fixture(scope="module")
def model(odd):
    """Its MJCF, compiled."""
    return mujoco.MjModel.from_xml_string(mjcf(odd, timestep=0.002, integrator="Euler"))


def test_mujoco_reads_the_vehicles_numbers_from_the_mjcf(model, odd):
    assert model.body_mass[1] == odd.mass
    np.testing.assert_array_equal(model.body_inertia[1], odd.inertia)
    np.testing.assert_array_equal(model.body_iquat[1], [1, 0, 0, 0])
    np.testing.assert_array_equal(model.opt.gravity, [0, 0, -odd.gravity])
    lever = odd.arm / math.sqrt(2)
    np.testing.assert_array_equal(model.site("centre").pos, [0, 0, 0])
    np.testing.assert_allclose(model.site_pos[1:], lever * np.array([[1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]]))


def test_the_file_says_how_it_is_stepped(model):
    assert model.opt.timestep == 0.002 and model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert model.opt.density == 0 and model.opt.viscosity == 0


def test_a_control_is_the_thrust_of_one_motor_in_newtons_within_its_limit(model, odd):
    most = odd.thrust_coefficient * odd.maximum_rotor_speed_rpm**2
    np.testing.assert_allclose(model.actuator_ctrlrange, [[0, most]] * 4, rtol=1e-12)
    data = mujoco.MjData(model)
    thrust = np.array([0.05, 0.06, 0.07, 0.09])
    data.ctrl[:] = thrust
    mujoco.mj_forward(model, data)
    # R4: torques about x and y by the lever, about z by km / kf
    lever, ratio = odd.arm / math.sqrt(2), odd.torque_coefficient / odd.thrust_coefficient
    signs = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]])
    expected = [lever, lever, ratio] * (signs @ thrust)
    np.testing.assert_allclose(data.qfrc_actuator, [0, 0, thrust.sum(), *expected], atol=1e-15)


def test_a_user_can_hover_with_the_file_alone(model, odd):
    data = mujoco.MjData(model)
    data.ctrl[:] = odd.mass * odd.gravity / 4
    mujoco.mj_step(model, data, 500)
    assert np.abs(data.qpos[:3]).max() < 1e-12


def test_nothing_in_the_file_can_touch(model):
    assert model.ngeom > 0 and not model.geom_contype.any() and not model.geom_conaffinity.any()
