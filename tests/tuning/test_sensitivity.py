"""The sensitivities: their arithmetic on made-up curves, and the data that ships."""

import itertools
import math

import pytest

from flytune.config import document
from flytune.task.files import load_task
from flytune.tuning.rules import number_at
from flytune.tuning.sensitivity import Curve, Point, SeedResult, Sensitivities, load_sensitivities


def result(seed, time):
    return SeedResult(
        seed=seed, settled=100, settling_time=time, overshoot=0.0, error=0.01, settling_time_axes={},
        overshoot_axes={}, yaw_error=0.01, violations={}, crashed=0,
    )  # fmt: skip


def sensitivities(values, times, spread=0.0):
    points = [
        Point(
            value=value, seeds=[result(0, time), result(1, time and time + spread), result(2, time and time - spread)]
        )
        for value, time in zip(values, times, strict=True)
    ]
    return Sensitivities(facts={}, parameters={"parameter": Curve(baseline=values[0], points=points)})


VALUES = (1.0, 2.0, 4.0, 8.0, 16.0)


@pytest.mark.parametrize("value", [0.5, 1.0, 3.0, 16.0, 100.0])
def test_a_power_law_has_its_exponent_everywhere_and_beyond_the_ends(value):
    known = sensitivities(VALUES, [3.0 * v**-0.7 for v in VALUES])
    assert known.slope("parameter", "settling_time", value) == pytest.approx(-0.7)


def test_a_slope_is_that_of_the_two_values_around():
    known = sensitivities(VALUES, [4.0, 4.0, 2.0, 2.0, 2.0])
    assert known.slope("parameter", "settling_time", 1.5) == 0
    assert known.slope("parameter", "settling_time", 2.0) == pytest.approx(-1)
    assert known.slope("parameter", "settling_time", 3.0) == pytest.approx(-1)


def test_downwards_from_a_measured_value_the_interval_below_is_used():
    known = sensitivities(VALUES, [4.0, 4.0, 2.0, 2.0, 2.0])
    assert known.slope("parameter", "settling_time", 2.0, up=False) == 0
    assert known.slope("parameter", "settling_time", 4.0, up=False) == pytest.approx(-1)
    assert known.slope("parameter", "settling_time", 0.5, up=False) == 0
    assert not known.is_significant("parameter", "settling_time", 2.0, up=False)


def test_an_axis_has_its_own_curve():
    known = load_sensitivities()
    rate = "termination.body_rate.bound_deg_per_s"
    assert known.slope(rate, "settling_time", 300, "yaw") < -1
    assert abs(known.slope(rate, "settling_time", 300, "z")) < 0.3
    assert known.is_significant("reward.vertical.sharpness", "settling_time", 4.0, "z")
    assert not known.is_significant("reward.vertical.sharpness", "settling_time", 4.0)
    assert known.slope("reward.attitude.weight", "error", 0.1, "yaw") < -0.5


def test_a_constant_reward_has_no_effect_and_the_speed_bound_has():
    known = load_sensitivities()
    assert not known.has_effect("reward.survival.reward")
    assert known.has_effect("termination.speed.bound")
    assert known.has_effect("never measured")


def test_a_value_of_0_has_no_logarithm_and_is_left_out():
    known = sensitivities((0.0, 1.0, 2.0), [9.0, 2.0, 1.0])
    assert known.slope("parameter", "settling_time", 0.5) == pytest.approx(-1)


def test_an_unmeasured_parameter_or_an_unsettled_value_has_no_slope():
    known = sensitivities(VALUES, [4.0, 2.0, None, None, None])
    assert known.slope("another", "settling_time", 1.0) is None
    assert known.slope("parameter", "settling_time", 3.0) is None
    assert known.slope("parameter", "settling_time", 1.5) == pytest.approx(-1)


def test_no_overshoot_at_all_counts_as_a_small_one():
    assert sensitivities(VALUES, [1.0] * 5).slope("parameter", "overshoot", 1.0) == 0


def test_a_change_is_significant_where_the_seeds_of_both_values_differ():
    assert sensitivities(VALUES, [4.0, 3.0, 2.0, 1.5, 1.2], spread=0.1).is_significant(
        "parameter", "settling_time", 1.5
    )
    assert not sensitivities(VALUES, [4.0, 3.9, 3.8, 3.7, 3.6], spread=0.1).is_significant(
        "parameter", "settling_time", 1.5
    )


@pytest.mark.parametrize(
    ("times", "spread", "outcome"),
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
def test_a_claim_that_raising_it_shortens_the_time_is_checked_on_the_whole_curve(times, spread, outcome):
    assert sensitivities(VALUES, times, spread).check_claim("parameter", "settling_time", "down") == outcome


def test_the_sensitivities_that_ship_are_complete_and_of_the_task_as_it_is():
    known = load_sensitivities()
    tables = document.plain(load_task(known.facts["base"]))
    assert len(known.parameters) >= 10
    for path, curve in known.parameters.items():
        assert number_at(tables, path) == curve.baseline, path
        assert len(curve.points) >= 5
        assert curve.baseline in [point.value for point in curve.points]
        assert [point.value for point in curve.points] == sorted(point.value for point in curve.points)
        for point in curve.points:
            assert [one.seed for one in point.seeds] == [0, 1, 2]


def test_a_higher_speed_bound_shortens_the_settling_time_in_every_interval_of_the_data_that_ships():
    known = load_sensitivities()
    points = known.parameters["termination.speed.bound"].points
    for low, high in itertools.pairwise(points):
        # every seed is faster; the slope is that between the medians, which with three seeds are the second numbers
        assert max(high.numbers("settling_time")) < min(low.numbers("settling_time"))
        first, second = (sorted(point.numbers("settling_time"))[1] for point in (low, high))
        slope = known.slope("termination.speed.bound", "settling_time", math.sqrt(low.value * high.value))
        assert slope == pytest.approx(math.log(second / first) / math.log(high.value / low.value), rel=1e-12)
        assert slope < 0
