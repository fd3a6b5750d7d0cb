"""Terminations: their margins, their causes, and the paper's table of bounds (paper R14)."""

import math

import jax
import jax.numpy as jnp
import pytest

from flytune.task.termination import (
    SAFE,
    MaximumAttitudeError,
    MaximumBodyRate,
    MaximumDistance,
    MaximumSpeed,
    MaximumTilt,
    MinimumAltitude,
    cause,
    causes,
    margins,
)

# a condition, and what to change in a situation to bring it to `share` of its bound
CONDITIONS = {
    "altitude": (MinimumAltitude(bound=0.1), lambda share: {"altitude": 0.1 * (2 - share)}),
    "distance": (MaximumDistance(bound=3.0), lambda share: {"position_error": (1.8 * share, 0.0, -2.4 * share)}),
    "attitude": (
        MaximumAttitudeError(bound=1.0),
        lambda share: {"attitude_error": (math.sin(share / 2), 0.0, 0.0, math.cos(share / 2))},
    ),
    "roll": (MaximumTilt(bound_deg=15.0), lambda share: {"roll": -share * math.radians(15)}),
    "pitch": (MaximumTilt(bound_deg=15.0), lambda share: {"pitch": share * math.radians(15)}),
    "speed": (MaximumSpeed(bound=0.8), lambda share: {"velocity": (0.48 * share, -0.64 * share, 0.0)}),
    "body_rate": (
        MaximumBodyRate(bound_deg_per_s=530.0),
        lambda share: {"body_rate": (0.0, 0.0, share * math.radians(530))},
    ),
}


@pytest.mark.parametrize("name", CONDITIONS)
def test_a_margin_is_the_share_of_the_bound_that_is_left(name, situation):
    condition, at = CONDITIONS[name]
    for share in (0.0, 0.25, 0.9, 1.0, 1.5):
        assert condition.margin(situation(**at(share))) == pytest.approx(1 - share, abs=2e-6)


@pytest.mark.parametrize("bound", [0.0, -2.0])
def test_the_margin_of_a_floor_at_zero_or_below_is_the_height_above_it_in_metres(bound, situation):
    condition = MinimumAltitude(bound=bound)
    for height in (-0.5, 0.0, 0.3):
        assert condition.margin(situation(altitude=bound + height)) == pytest.approx(height, abs=1e-6)
    slope = jax.grad(lambda each, bound: MinimumAltitude(bound=bound).margin(situation(altitude=each)))(1.0, bound)
    assert slope == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "quantity", "limit"),
    [("altitude", "altitude", 0.1), ("distance", "distance", 3.0), ("attitude", "attitude_error", 1.0),
     ("roll", "tilt", math.pi / 12), ("speed", "speed", 0.8), ("body_rate", "body_rate", 530 / 180 * math.pi)],
)  # fmt: skip
def test_a_limit_is_the_bound_in_si_units_and_names_its_quantity(name, quantity, limit):
    condition = CONDITIONS[name][0]
    assert (condition.quantity, condition.limit) == (quantity, pytest.approx(limit))
    assert getattr(condition, condition.key) is not None


@pytest.mark.parametrize("name", CONDITIONS)
def test_a_margin_is_negative_just_beyond_the_bound_and_positive_just_within(name, situation):
    condition, at = CONDITIONS[name]
    assert condition.margin(situation(**at(1.001))) < 0 < condition.margin(situation(**at(0.999)))


@pytest.mark.parametrize("name", CONDITIONS)
def test_a_margin_has_a_finite_gradient_at_the_target(name, situation):
    gradient = jax.grad(CONDITIONS[name][0].margin)(situation())
    assert all(jnp.isfinite(leaf) for leaf in jax.tree.leaves(gradient))


def test_the_tilt_is_the_larger_of_roll_and_pitch(situation):
    margin = MaximumTilt(bound_deg=20.0).margin(situation(roll=math.radians(5), pitch=math.radians(-10)))
    assert margin == pytest.approx(0.5)


# --- causes ---

TWO = {"speed": MaximumSpeed(bound=1.0), "altitude": MinimumAltitude(bound=0.1)}


def why(conditions, here):
    """The name of the cause, or None where the episode goes on."""
    code = int(cause(margins(conditions, here)))
    return None if code == SAFE else causes(conditions)[code]


def test_causes_are_the_conditions_in_alphabetical_order_and_then_divergence():
    assert causes(TWO) == ["altitude", "speed", "diverged"]


def test_an_episode_within_its_bounds_goes_on(situation):
    assert why(TWO, situation()) is None


def test_an_episode_exactly_at_a_bound_goes_on(situation):
    assert why(TWO, situation(velocity=(1, 0, 0))) is None


def test_the_cause_is_the_condition_that_is_broken(situation):
    assert why(TWO, situation(altitude=0.05)) == "altitude"
    assert why(TWO, situation(velocity=(0, 0, 1.1))) == "speed"


def test_of_two_broken_conditions_the_one_with_the_smallest_margin_is_the_cause(situation):
    # altitude 0.05 m: margin -0.5; speed 1.2 m/s: margin -0.2; speed 1.8 m/s: margin -0.8
    assert why(TWO, situation(altitude=0.05, velocity=(1.2, 0, 0))) == "altitude"
    assert why(TWO, situation(altitude=0.05, velocity=(1.8, 0, 0))) == "speed"


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_numbers_that_are_not_finite_mean_divergence_whatever_else_is_broken(situation, broken):
    assert why(TWO, situation(velocity=(broken, 0, 0))) == "diverged"
    assert why(TWO, situation(velocity=(broken, 0, 0), altitude=-1)) == "diverged"


def test_a_task_without_conditions_never_fails(situation):
    assert why({}, situation(altitude=-100)) is None
    assert causes({}) == ["diverged"]


# --- the paper's table ---

TABLE = {  # R14: z, |e_p|, theta, roll and pitch, speed, body rate
    "acrobatic": (0.1, 3.0, math.pi, None, 1.0, 530),
    "baseline": (0.1, 3.0, math.pi, None, 0.8, 530),
    "inspection": (0.1, 3.0, None, 15, 0.2, 115),
}


@pytest.mark.parametrize("preset", TABLE)
def test_a_preset_ends_where_the_paper_says(tasks, preset):
    z, distance, theta, tilt, speed, rate = TABLE[preset]
    wanted = {
        "altitude": MinimumAltitude(bound=z),
        "distance": MaximumDistance(bound=distance),
        "speed": MaximumSpeed(bound=speed),
        "body_rate": MaximumBodyRate(bound_deg_per_s=float(rate)),
    }
    if theta is not None:
        wanted["attitude"] = MaximumAttitudeError(bound=theta)
    if tilt is not None:
        wanted["tilt"] = MaximumTilt(bound_deg=float(tilt))
    assert tasks[preset].termination == wanted


@pytest.mark.parametrize("preset", TABLE)
def test_a_preset_fails_just_beyond_each_of_its_bounds_and_not_before(tasks, preset, situation):
    z, distance, _, tilt, speed, rate = TABLE[preset]
    conditions = tasks[preset].termination
    cases = {
        "altitude": lambda share: {"altitude": z * (2 - share)},
        "distance": lambda share: {"position_error": (0, distance * share, 0)},
        "speed": lambda share: {"velocity": (0, 0, -speed * share)},
        "body_rate": lambda share: {"body_rate": (math.radians(rate) * share, 0, 0)},
    }
    if tilt is not None:
        cases["tilt"] = lambda share: {"pitch": -math.radians(tilt) * share}
    for name, at in cases.items():
        assert why(conditions, situation(**at(0.99))) is None
        assert why(conditions, situation(**at(1.01))) == name


@pytest.mark.parametrize("preset", ["acrobatic", "baseline"])
def test_the_geodesic_bound_of_pi_never_binds(tasks, preset, situation):
    # C9: theta lies in [0, pi], so theta > pi is never true, not even upside down
    for attitude in [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0.6, 0.8, 0, 0)]:
        assert tasks[preset].termination["attitude"].margin(situation(attitude_error=attitude)) >= 0
