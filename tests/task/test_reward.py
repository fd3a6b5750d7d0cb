"""Rewards by hand arithmetic (paper R10 to R13)."""

import math
from math import exp

import jax
import jax.numpy as jnp
import pytest

from flytune.task.reward import DualExponential, Exponential, Smoothness, Survival, rewards, squared_error


@pytest.fixture(scope="module")
def total():
    """The reward of a task's terms together."""
    return jax.jit(lambda terms, here: sum(rewards(terms, here).values()))


def about_z(angle):
    """The attitude error of a yaw alone."""
    return (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))


# xy^2 = 0.3^2 + 0.4^2 = 0.25, z^2 = 0.2^2 = 0.04, v^2 = 0.5^2 = 0.25, theta = 0.6, th^2 = 0.36,
# |da|^2 = 4 * 0.25^2 = 0.25
AWAY = {
    "position_error": (0.3, -0.4, 0.2),
    "velocity": (0.0, 0.3, -0.4),
    "attitude_error": about_z(0.6),
    "action_change": (0.25, -0.25, 0.25, -0.25),
}


def test_the_baseline_at_its_target_earns_the_sum_of_its_weights(tasks, situation, total):
    # 0.05 + 0.25 + 0.25 + 0.1 + 0.15 (R11)
    assert total(tasks["baseline"].reward, situation()) == pytest.approx(0.80, abs=1e-6)


def test_the_acrobatic_pilot_at_its_target_earns_the_sum_of_its_weights(tasks, situation, total):
    # 0.05 + 0.25 + 0.25 + 0.08 + 0.15 (R12)
    assert total(tasks["acrobatic"].reward, situation()) == pytest.approx(0.78, abs=1e-6)


def test_the_inspection_pilot_at_its_target_earns_the_sum_of_its_weights(tasks, situation, total):
    # 0.01 + 0.25 + 0.25 + 0.15 + 0.2 (R13)
    assert total(tasks["inspection"].reward, situation()) == pytest.approx(0.86, abs=1e-6)


def test_the_baseline_off_its_target_earns_what_r11_says(tasks, situation, total):
    # 0.05 + 0.25 (0.6 e^-0.125 + 0.4 e^-5) + 0.25 e^-0.16 + 0.1 e^-0.25 + 0.15 e^-0.18 - 0.1 * 0.25
    #   = 0.05 + 0.133048 + 0.213036 + 0.077880 + 0.125291 - 0.025 = 0.574255
    by_hand = 0.05 + 0.25 * (0.6 * exp(-0.125) + 0.4 * exp(-5)) + 0.25 * exp(-0.16)
    by_hand += 0.1 * exp(-0.25) + 0.15 * exp(-0.18) - 0.1 * 0.25
    assert by_hand == pytest.approx(0.574255, abs=2e-6)
    assert total(tasks["baseline"].reward, situation(**AWAY)) == pytest.approx(by_hand, abs=1e-6)


def test_the_acrobatic_pilot_off_its_target_earns_what_r12_says(tasks, situation, total):
    # 0.05 + 0.25 (0.6 e^-1 + 0.4 e^-5) + 0.25 e^-0.16 + 0.08 e^-0.125 + 0.15 e^-0.18 - 0.1 * 0.25
    #   = 0.05 + 0.055856 + 0.213036 + 0.070600 + 0.125291 - 0.025 = 0.489782
    by_hand = 0.05 + 0.25 * (0.6 * exp(-1) + 0.4 * exp(-5)) + 0.25 * exp(-0.16)
    by_hand += 0.08 * exp(-0.125) + 0.15 * exp(-0.18) - 0.1 * 0.25
    assert by_hand == pytest.approx(0.489782, abs=2e-6)
    assert total(tasks["acrobatic"].reward, situation(**AWAY)) == pytest.approx(by_hand, abs=1e-6)


def test_the_inspection_pilot_off_its_target_earns_what_r13_says(tasks, situation, total):
    # 0.01 + 0.25 (0.6 e^-1 + 0.4 e^-37.5) + 0.25 (0.6 e^-0.16 + 0.4 e^-6) + 0.15 e^-0.375
    #   + 0.2 (0.6 e^-0.18 + 0.4 e^-54) - 0.02 * 0.25
    #   = 0.01 + 0.055182 + 0.128069 + 0.103093 + 0.100232 - 0.005 = 0.391577
    by_hand = 0.01 + 0.25 * 0.6 * exp(-1) + 0.25 * (0.6 * exp(-0.16) + 0.4 * exp(-6)) + 0.15 * exp(-0.375)
    by_hand += 0.2 * 0.6 * exp(-0.18) - 0.02 * 0.25
    assert by_hand == pytest.approx(0.391577, abs=2e-6)
    assert total(tasks["inspection"].reward, situation(**AWAY)) == pytest.approx(by_hand, abs=1e-6)


def test_every_term_has_its_own_entry(tasks, situation):
    terms = rewards(tasks["baseline"].reward, situation(**AWAY))
    assert {name: float(value) for name, value in terms.items()} == pytest.approx(
        {
            "survival": 0.05,
            "horizontal": 0.133048,
            "vertical": 0.213036,
            "velocity": 0.077880,
            "attitude": 0.125291,
            "smoothness": -0.025,
        },
        abs=1e-6,
    )


def test_the_pull_of_the_wide_exponential_is_strongest_at_one_over_root_two_wide(situation):
    # d/de exp(-k e^2) = -2 k e exp(-k e^2); its derivative vanishes where 1 - 2 k e^2 = 0, so e = 1 / sqrt(2 k) = 1
    term = DualExponential(of="horizontal", weight=1.0, share=1.0, wide=0.5, narrow=20.0)
    here = situation()
    zero = here.position_error[0]

    def reward(error):
        return term(type(here)(**(vars(here) | {"position_error": (error, zero, zero)})))

    errors = jnp.linspace(0.05, 3.0, 600)
    strongest = errors[jnp.argmin(jax.vmap(jax.grad(reward))(errors))]
    assert strongest == pytest.approx(1 / math.sqrt(2 * 0.5), abs=0.005)


def test_a_dual_exponential_of_equal_widths_is_a_single_one(situation):
    dual = DualExponential(of="velocity", weight=0.3, share=0.7, wide=2.0, narrow=2.0)
    single = Exponential(of="velocity", weight=0.3, sharpness=2.0)
    assert dual(situation(**AWAY)) == pytest.approx(float(single(situation(**AWAY))), rel=1e-6)


def test_survival_pays_the_same_anywhere(situation):
    assert Survival(reward=0.07)(situation()) == Survival(reward=0.07)(situation(**AWAY)) == jnp.float32(0.07)


def test_smoothness_looks_at_the_change_of_the_action_alone(situation):
    # -0.1 (0.25^2 * 4) = -0.025
    assert Smoothness(weight=0.1)(situation(action_change=AWAY["action_change"])) == pytest.approx(-0.025)
    assert Smoothness(weight=0.1)(situation(position_error=(1.0, 1.0, 1.0))) == 0


@pytest.mark.parametrize(
    ("of", "expected"),
    [
        ("horizontal", 0.25),  # 0.3^2 + 0.4^2
        ("vertical", 0.04),
        ("position", 0.29),
        ("velocity", 0.25),
        ("attitude", 0.36),
        ("body_rate", 14.0),  # 1 + 4 + 9
    ],
)
def test_each_error_is_the_one_it_names(situation, of, expected):
    assert squared_error(situation(**AWAY, body_rate=(1, -2, 3)), of) == pytest.approx(expected, rel=1e-5)


def test_the_gradient_of_every_preset_is_finite_at_its_target(tasks, situation, total):
    # the square root in theta = 2 atan2(|vec q|, w) must not give NaN where the controller wants to be
    for task in tasks.values():
        gradient = jax.grad(total, argnums=1)(task.reward, situation())
        assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
