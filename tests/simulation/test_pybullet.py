"""PyBullet alone: what its file says, and what its options add."""

import dataclasses
import math

import numpy as np
import pytest

from flytune.errors import BadInput
from flytune.physics.vehicle import load_vehicle
from flytune.simulation.model_files import urdf
from flytune.simulation.simulator import VehicleStates
from flytune.simulation.simulators import make_simulator

bullet = pytest.importorskip("pybullet", reason="needs flytune[pybullet]")


@pytest.fixture(scope="module")
def paper():
    """The paper's Crazyflie."""
    return load_vehicle("crazyflie")


def fly(vehicle, steps, *, height=1.0, velocity=(0, 0, 0), body_rate=(0, 0, 0), action=0.0, **options):
    """Where a level vehicle is after some control periods under one action."""
    simulator = make_simulator("pybullet", vehicle, 1, options)
    simulator.place(
        VehicleStates(
            position=np.array([[0, 0, height]]),
            attitude=np.array([[0, 0, 0, 1.0]]),
            velocity=np.array([velocity], float),
            body_rate=np.array([body_rate], float),
            rotor_speed_rpm=np.full((1, 4), vehicle.hover_rotor_speed_rpm),
        )
    )
    for _ in range(steps):
        simulator.advance(np.full((1, 4), action))
    end = simulator.states()
    simulator.close()
    return end


def test_bullet_reads_the_vehicles_mass_and_inertia_from_the_urdf(paper, tmp_path):
    odd = dataclasses.replace(paper, name='a "quoted" <name>', inertia=(1.7e-5, 1.23456789e-5, 2.6e-5))
    (tmp_path / "vehicle.urdf").write_text(urdf(odd))
    client = bullet.connect(bullet.DIRECT)
    try:
        flags = bullet.URDF_USE_INERTIA_FROM_FILE
        body = bullet.loadURDF(str(tmp_path / "vehicle.urdf"), flags=flags, physicsClientId=client)
        mass, _, inertia, centre, *_ = bullet.getDynamicsInfo(body, -1, physicsClientId=client)
        assert not bullet.getCollisionShapeData(body, -1, physicsClientId=client)
        drawn = bullet.getVisualShapeData(body, physicsClientId=client)
    finally:
        bullet.disconnect(physicsClientId=client)
    assert (mass, inertia, centre) == (odd.mass, odd.inertia, (0, 0, 0))
    places = np.array([shape[5] for shape in drawn[1:]])
    lever = odd.arm / math.sqrt(2)
    np.testing.assert_allclose(places, lever * np.array([[1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]]), atol=1e-12)


def test_nothing_slows_a_vehicle_unless_damping_is_asked_for(paper):
    end = fly(paper, 100, velocity=(1, 0, 0), body_rate=(0, 0, 2.0))
    np.testing.assert_allclose([end.velocity[0, 0], end.body_rate[0, 2]], [1, 2], atol=1e-12)


def test_bullets_damping_grows_with_speed(paper):
    # v' = -d (1 + |v|) v has v / (1 + |v|) = v0 / (1 + v0) exp(-d t); a first-order step of 5 ms leaves d h / 2 = 1e-4
    end = fly(paper, 100, velocity=(1, 0, 0), body_rate=(0, 0, 2.0), damping=0.04)
    for left, first in ((end.velocity[0, 0], 1.0), (end.body_rate[0, 2], 2.0)):
        assert left / (1 + left) == pytest.approx(first / (1 + first) * math.exp(-0.04), rel=5e-4)


def test_ground_effect_lifts_more_the_nearer_the_floor(paper):
    climbs = [fly(paper, 10, height=height, ground_effect=True).velocity[0, 2] for height in (0.05, 0.1, 0.3, 1.0)]
    assert np.all(np.diff(climbs) < 0) and climbs[-1] > 0
    # at 1 m: g k (r / 4 h)^2 t = 9.81 * 3.803e-4 * 0.1 m/s
    assert climbs[-1] == pytest.approx(9.81 * 3.803e-4 * 0.1, rel=1e-3)
    assert abs(fly(paper, 10, height=0.05).velocity[0, 2]) < 1e-12


def test_rotor_drag_slows_a_flight_along_its_way(paper):
    end = fly(paper, 100, velocity=(1.0, 0, 0), rotor_drag=True)
    # at hover speed, 16,004 rpm: K = 9.1785e-7 * 4 * 1675.9 = 6.153e-3 kg/s
    rate = 9.1785e-7 * 4 * paper.hover_rotor_speed_rpm * 2 * math.pi / 60 / paper.mass
    assert end.velocity[0, 0] == pytest.approx(math.exp(-rate), rel=1e-3)
    assert np.abs(end.velocity[0, 1:]).max() < 1e-12


@pytest.mark.parametrize("effect", ["rotor_drag", "ground_effect"])
def test_an_effect_is_refused_for_a_vehicle_that_does_not_say_its_coefficient(paper, effect):
    other = dataclasses.replace(paper, name="hummingbird", optional_rotor_drag=None, ground_effect=None)
    with pytest.raises(
        BadInput, match=f"^world pybullet: {effect}=true is not possible, since the vehicle hummingbird"
    ):
        make_simulator("pybullet", other, 1, {effect: True})
    make_simulator("pybullet", other, 1).close()


def test_a_world_can_be_closed_twice_and_others_live_on(paper):
    first, second = make_simulator("pybullet", paper, 1), make_simulator("pybullet", paper, 1)
    first.close()
    first.close()
    second.advance(np.zeros((1, 4)))
    assert np.isfinite(second.states().position).all()
    second.close()
