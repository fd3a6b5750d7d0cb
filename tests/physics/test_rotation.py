"""Quaternion algebra against SciPy's rotations, and the gradients where a square root would give NaN."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flytune.physics import rotation

FUNCTIONS = {
    name: jax.jit(getattr(rotation, name))
    for name in (
        "multiply", "conjugate", "normalise", "exponential", "vertical_axis", "shortest", "from_euler", "angle",
        "roll_pitch", "safe_norm",
    )
}  # fmt: skip

component = st.floats(-1, 1, width=32)
quaternions = (
    st.tuples(component, component, component, component)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(lambda q: tuple(part / math.hypot(*q) for part in q))
)
quick = settings(max_examples=50)


def compiled(name, *arguments):
    """The result of one function of the module, on arrays of one type so that it compiles once."""
    return np.array(FUNCTIONS[name](*jax.tree.map(lambda part: jnp.asarray(part, jnp.float32), arguments)))


def same_rotation(ours, theirs):
    """The angle in rad between a quaternion of ours and a SciPy rotation; q and -q are the same."""
    return (Rotation.from_quat(ours).inv() * theirs).magnitude()


@quick
@given(quaternions, quaternions)
def test_the_product_is_the_composition_of_rotations(first, second):
    expected = Rotation.from_quat(first) * Rotation.from_quat(second)
    assert same_rotation(compiled("multiply", first, second), expected) < 1e-5


@quick
@given(quaternions, quaternions)
def test_the_product_of_unit_quaternions_is_a_unit_quaternion(first, second):
    assert np.linalg.norm(compiled("multiply", first, second)) == pytest.approx(1, abs=1e-6)


def test_the_units_multiply_as_hamilton_carved_them():
    # i j = k, j k = i, k i = j, i i = -1; the other convention (JPL) has i j = -k
    i, j, k = (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)
    assert compiled("multiply", i, j).tolist() == [0, 0, 1, 0]
    assert compiled("multiply", j, k).tolist() == [1, 0, 0, 0]
    assert compiled("multiply", k, i).tolist() == [0, 1, 0, 0]
    assert compiled("multiply", i, i).tolist() == [0, 0, 0, -1]


@quick
@given(quaternions)
def test_the_conjugate_undoes_a_rotation(quaternion):
    undone = compiled("multiply", tuple(compiled("conjugate", quaternion)), quaternion)
    np.testing.assert_allclose(undone, [0, 0, 0, 1], atol=1e-6)


@quick
@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_euler_angles_turn_about_z_then_y_then_x(roll, pitch, yaw):
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    assert same_rotation(compiled("from_euler", roll, pitch, yaw), expected) < 1e-5


@quick
@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_roll_and_pitch_are_read_back_whatever_the_yaw(roll, pitch, yaw):
    # near pitch = 90 deg the arcsine loses digits: d(pitch) = d(sin) / cos(1.5) = 14 d(sin)
    found = compiled("roll_pitch", tuple(compiled("from_euler", roll, pitch, yaw)))
    np.testing.assert_allclose(found, [roll, pitch], atol=1e-4)


@quick
@given(st.tuples(component, component, component).filter(lambda r: math.hypot(*r) <= 1))
def test_the_exponential_is_the_rotation_by_its_vector_up_to_one_radian(vector):
    found, expected = compiled("exponential", vector), Rotation.from_rotvec(vector)
    assert same_rotation(found, expected) < 1e-6
    assert np.linalg.norm(found) == pytest.approx(1, abs=3e-7)


def test_the_exponential_of_nothing_is_the_identity_and_its_gradient_is_half():
    # q(r) = (sin(r/2), cos(r/2)), so dq/dr = (1/2, 0) at r = 0
    assert compiled("exponential", (0, 0, 0)).tolist() == [0, 0, 0, 1]
    slope = jax.jacobian(lambda x: jnp.stack(rotation.exponential((x, 0.0, 0.0))))(0.0)
    np.testing.assert_allclose(slope, [0.5, 0, 0, 0])


@quick
@given(quaternions)
def test_the_vertical_axis_is_the_third_column_of_the_rotation_matrix(quaternion):
    expected = Rotation.from_quat(quaternion).as_matrix()[:, 2]
    np.testing.assert_allclose(compiled("vertical_axis", quaternion), expected, atol=1e-6)


@quick
@given(quaternions)
def test_the_angle_lies_between_zero_and_pi_and_is_that_of_the_rotation(quaternion):
    found = compiled("angle", quaternion)
    assert 0 <= found <= np.float32(math.pi)
    assert found == pytest.approx(Rotation.from_quat(quaternion).magnitude(), abs=1e-5)


def test_a_quaternion_and_its_negative_have_the_same_angle():
    # 240 deg one way is 120 deg the other: half angle 120 deg has w = cos 120 = -1/2
    over = (0.0, 0.0, math.sin(math.radians(120)), math.cos(math.radians(120)))
    assert compiled("angle", over) == pytest.approx(math.radians(120), abs=1e-6)
    assert compiled("angle", tuple(-part for part in over)) == pytest.approx(math.radians(120), abs=1e-6)


def test_the_angle_has_a_finite_gradient_at_no_rotation():
    gradient = jax.grad(rotation.angle)((0.0, 0.0, 0.0, 1.0))
    assert np.array(gradient).tolist() == [0, 0, 0, 0]


def test_the_norm_has_gradient_zero_at_the_origin_and_the_unit_vector_elsewhere():
    assert np.array(jax.grad(rotation.safe_norm)((0.0, 0.0, 0.0))).tolist() == [0, 0, 0]
    assert compiled("safe_norm", (0, 0, 0)) == 0
    # |(3, 4, 0)| = 5, and its gradient is (3, 4, 0) / 5
    assert compiled("safe_norm", (3, 4, 0)) == pytest.approx(5)
    np.testing.assert_allclose(jax.grad(rotation.safe_norm)((3.0, 4.0, 0.0)), [0.6, 0.8, 0], rtol=1e-6)


@quick
@given(quaternions)
def test_the_shortest_quaternion_is_the_same_rotation_with_a_real_part_of_at_least_zero(quaternion):
    found = compiled("shortest", quaternion)
    assert found[3] >= 0
    assert same_rotation(found, Rotation.from_quat(quaternion)) < 1e-5


def test_half_a_turn_is_left_as_it_is():
    assert compiled("shortest", (1, 0, 0, 0)).tolist() == [1, 0, 0, 0]


def test_normalising_keeps_the_direction():
    np.testing.assert_allclose(compiled("normalise", (0, 0, 3, 4)), [0, 0, 0.6, 0.8], rtol=1e-6)


def test_the_norm_of_what_is_not_a_number_is_not_a_number():
    # a norm of 0 would let a state that diverged pass for one at rest
    assert math.isnan(compiled("safe_norm", (math.nan, 0, 0)))
    assert math.isinf(compiled("safe_norm", (math.inf, 0, 0)))
