"""The effect map: its arithmetic on curves made up for it, and the data that ships."""

import math

import pytest

from flytune.config import document
from flytune.task.task import load_task
from flytune.tuning.rules import field_of
from flytune.tuning.sensitivity import Curve, Effects, Flown, Point, load_effects


def flown(seed, time):
    return Flown(seed=seed, settled=100, settling_time=time, overshoot=0.0, error=0.01, details={})


def effects(values, times, spread=0.0):
    points = [
        Point(value=value, seeds=[flown(0, time), flown(1, time and time + spread), flown(2, time and time - spread)])
        for value, time in zip(values, times, strict=True)
    ]
    return Effects(facts={}, parameters={"parameter": Curve(baseline=values[0], points=points)})


VALUES = (1.0, 2.0, 4.0, 8.0, 16.0)


@pytest.mark.parametrize("value", [0.5, 1.0, 3.0, 16.0, 100.0])
def test_a_power_law_has_its_exponent_everywhere_and_beyond_the_ends(value):
    known = effects(VALUES, [3.0 * v**-0.7 for v in VALUES])
    assert known.elasticity("parameter", "settling_time", value) == pytest.approx(-0.7)


def test_a_slope_is_that_of_the_two_values_around():
    known = effects(VALUES, [4.0, 4.0, 2.0, 2.0, 2.0])
    assert known.elasticity("parameter", "settling_time", 1.5) == 0
    assert known.elasticity("parameter", "settling_time", 2.0) == pytest.approx(-1)
    assert known.elasticity("parameter", "settling_time", 3.0) == pytest.approx(-1)


def test_downwards_from_a_measured_value_the_interval_below_counts():
    known = effects(VALUES, [4.0, 4.0, 2.0, 2.0, 2.0])
    assert known.elasticity("parameter", "settling_time", 2.0, up=False) == 0
    assert known.elasticity("parameter", "settling_time", 4.0, up=False) == pytest.approx(-1)
    assert known.elasticity("parameter", "settling_time", 0.5, up=False) == 0
    assert not known.matters("parameter", "settling_time", 2.0, up=False)


def test_an_axis_has_its_own_curve():
    known = load_effects()
    rate = "termination.body_rate.bound_deg_per_s"
    assert known.elasticity(rate, "settling_time", 300, "yaw") < -1
    assert abs(known.elasticity(rate, "settling_time", 300, "z")) < 0.3
    assert known.matters("reward.vertical.sharpness", "settling_time", 4.0, "z")
    assert not known.matters("reward.vertical.sharpness", "settling_time", 4.0)
    assert known.elasticity("reward.attitude.weight", "error", 0.1, "yaw") < -0.5


def test_a_constant_reward_moves_nothing_and_the_speed_bound_does():
    known = load_effects()
    assert not known.moves("reward.survival.reward")
    assert known.moves("termination.speed.bound")
    assert known.moves("never measured")


def test_a_knob_at_0_has_no_logarithm_and_is_left_out():
    known = effects((0.0, 1.0, 2.0), [9.0, 2.0, 1.0])
    assert known.elasticity("parameter", "settling_time", 0.5) == pytest.approx(-1)


def test_what_was_not_measured_or_does_not_settle_has_no_slope():
    known = effects(VALUES, [4.0, 2.0, None, None, None])
    assert known.elasticity("another", "settling_time", 1.0) is None
    assert known.elasticity("parameter", "settling_time", 3.0) is None
    assert known.elasticity("parameter", "settling_time", 1.5) == pytest.approx(-1)


def test_no_overshoot_at_all_counts_as_a_little():
    assert effects(VALUES, [1.0] * 5).elasticity("parameter", "overshoot", 1.0) == 0


def test_a_change_matters_where_the_seeds_of_both_values_are_apart():
    assert effects(VALUES, [4.0, 3.0, 2.0, 1.5, 1.2], spread=0.1).matters("parameter", "settling_time", 1.5)
    assert not effects(VALUES, [4.0, 3.9, 3.8, 3.7, 3.6], spread=0.1).matters("parameter", "settling_time", 1.5)


@pytest.mark.parametrize(
    ("times", "spread", "verdict"),
    [
        ((4.0, 3.5, 3.0, 2.5, 2.0), 0.0, "confirmed"),
        ((2.0, 2.5, 3.0, 3.5, 4.0), 0.0, "wrong sign"),
        ((2.0, 2.05, 2.0, 2.0, 1.9), 0.0, "no effect"),
        ((4.0, 3.5, 3.0, 2.5, 2.0), 1.5, "no effect"),
        ((4.0, 4.0, 4.0, 4.0, 2.0), 0.0, "only beyond a threshold"),
        ((4.0, 3.5, 3.0, 2.5, 2.0), 0.9, "confirmed"),
        ((None, None, None, None, 2.0), 0.0, "no effect"),
        ((None, 4.0, 3.0, 2.5, 2.0), 0.0, "confirmed"),
    ],
)
def test_a_claim_that_raising_it_shortens_the_time_is_judged_by_the_whole_curve(times, spread, verdict):
    assert effects(VALUES, times, spread).verdict("parameter", "settling_time", "down") == verdict


def test_the_map_that_ships_is_whole_and_of_the_task_as_it_is():
    known = load_effects()
    tables = document.plain(load_task(known.facts["base"]))
    assert len(known.parameters) >= 10
    for path, curve in known.parameters.items():
        assert field_of(tables, path) == curve.baseline, path
        assert len(curve.points) >= 5
        assert curve.baseline in [point.value for point in curve.points]
        assert [point.value for point in curve.points] == sorted(point.value for point in curve.points)
        for point in curve.points:
            assert [one.seed for one in point.seeds] == [0, 1, 2]


def test_the_map_that_ships_knows_that_a_higher_speed_bound_is_faster():
    slope = load_effects().elasticity("termination.speed.bound", "settling_time", 0.6)
    assert slope is not None
    assert -1.3 < slope < -0.3
    assert math.isfinite(slope)
