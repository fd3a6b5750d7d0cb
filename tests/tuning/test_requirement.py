"""Requirements: numbers that are refused, measures of a judgement, and misses."""

import dataclasses
import json
import math

import numpy as np
import pytest

from flytune.errors import BadInput
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import judge
from flytune.task.files import load_task
from flytune.tuning.asked import make_requirement
from flytune.tuning.requirement import ResponseSummary

GOOD = ResponseSummary(settling_time=2.5, overshoot=0.0, error=0.001, settled=1.0, constraints_satisfied=1.0)


def but(**changes):
    return dataclasses.replace(GOOD, **changes)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"settling_time": 2500}, r"settling-time: 2500 .*0\.2 to 60 s.*Did you mean 2\.5 "),
        ({"settling_time": -1}, r"settling-time: -1 is not allowed\. Allowed: 0\.2 to 60 s"),
        ({"settling_time": math.nan}, r"settling-time: nan is not allowed"),
        ({"settling_time": math.inf}, r"settling-time: inf is not allowed"),
        ({"settling_time": 2, "overshoot": 0.05}, r"overshoot: 0\.05 .*Did you mean 5 \(percent"),
        ({"settling_time": 2, "overshoot": -3}, r"overshoot: -3 is not allowed\. Allowed: 0 to 100 %"),
        ({"settling_time": 2, "overshoot": math.nan}, r"overshoot: nan is not allowed"),
        ({"settling_time": 2, "error": 5}, r"error: 5 .*Did you mean 0\.005 \(metres"),
        ({"settling_time": 2, "error": 0}, r"error: 0 is not allowed"),
        ({"settling_time": 2, "error": 0.03}, r"error: 0\.03 .*does not count as settled"),
        ({"settling_time": 2, "tolerance": 0.1}, r"tolerance: 0\.1 .*Did you mean 10\?"),
        ({"settling_time": 2, "percentile": 0.5}, r"percentile: 0\.5 .*Did you mean 50\?"),
        ({"settling_time": 2, "percentile": 100}, r"percentile: 100 is not allowed"),
        ({"settling_time": 2, "axis": "w"}, r"axis: 'w' is not allowed\. Allowed: position, x, y, z, yaw"),
        ({"settling_time": 2, "axis": ["x", "w"]}, r"axis: 'w' is not allowed"),
        ({"settling_time": 2, "axis": ["x", "x"]}, r"axis: x, x is not allowed\. .* each once"),
        ({"settling_time": 2, "axis": []}, r"axis: none is not allowed"),
        ({"settling_time": 2, "overshoot": {"yaw": 5}}, r"overshoot: 'yaw' is not asked for\. .* add it with --axis"),
        ({"settling_time": 2, "axis": ["x", "yaw"], "error": {"yaw": 9}}, r"error: 9 .*0\.02 to 3\.6 deg"),
    ],
)
def test_numbers_that_cannot_be_meant_are_refused_with_what_is_allowed(arguments, said):
    with pytest.raises(BadInput, match=said):
        make_requirement(**arguments)


def test_units_of_the_command_line_become_those_of_the_judge():
    wanted = make_requirement(3, overshoot=4, error=2, axis="yaw", tolerance=20)
    assert wanted.overshoot == pytest.approx(0.04)
    assert wanted.error == pytest.approx(math.radians(2))
    assert wanted.tolerance == pytest.approx(0.2)


def test_each_axis_has_its_own_bounds_and_its_own_units():
    wanted = make_requirement(3, {"": 4, "yaw": 2}, {"z": 0.005}, axis=["position", "z", "yaw"], percentile={"yaw": 90})
    assert (wanted.axis, wanted.overshoot, wanted.error, wanted.percentile) == ("position", 0.04, 0.01, 50)
    height, heading = wanted.others
    assert (height.axis, height.overshoot, height.error, height.percentile) == ("z", 0.04, 0.005, 50)
    assert (heading.overshoot, heading.error, heading.percentile) == (0.02, pytest.approx(math.radians(1)), 90)
    # one number is in the unit of the first axis
    assert make_requirement(3, error=0.004, axis=["x", "y", "yaw"]).others[0].error == 0.004
    assert make_requirement(3, error=0.004, axis=["x", "yaw"]).others[0].error == pytest.approx(math.radians(1))
    assert make_requirement(3, error=2, axis=["yaw", "x"]).others[0].error == 0.01


def test_of_several_axes_the_one_that_misses_its_bound_most_is_measured(pid_flights):
    judged = judge(pid_flights)
    alone = {axis: make_requirement(3, axis=axis).measure(judged) for axis in ("position", "yaw")}
    both = make_requirement(3, axis=["position", "yaw"])
    response = both.measure(judged)
    assert (response.settling_time, response.axes) == (alone["position"].settling_time, {})
    told = {axis: each.settling_time for axis, each in alone.items()}  # of each axis, whatever the worst one is
    assert response.each["settling_time"] == told and set(response.each) == {"settling_time", "overshoot", "error"}
    assert alone["yaw"].each == {}
    # the yaw turns past its target, and the bound of it is what is missed
    turning = dataclasses.replace(judged, overshoot={**judged.overshoot, "yaw": np.full(40, 0.2)})
    response = both.measure(turning)
    assert (response.overshoot, response.axes) == (0.2, {"overshoot": "yaw"})
    assert both.misses(response)["overshoot"] == pytest.approx(0.15)
    assert "overshoot" not in make_requirement(3, {"yaw": 25}, axis=["position", "yaw"]).misses(response)
    # the yaw settles later than allowed
    late = dataclasses.replace(judged, settling_time={**judged.settling_time, "yaw": np.full(40, 3.4)})
    response = both.measure(late)
    assert (response.settling_time, response.axes) == (3.4, {"settling_time": "yaw"})
    assert both.misses(response)["settling_time"] > 0
    # a trial has settled where all axes have
    never = np.where(np.arange(40) < 10, np.inf, judged.settling_time["yaw"])
    lost = dataclasses.replace(judged, settling_time={**judged.settling_time, "yaw": never})
    assert both.measure(lost).settled == pytest.approx(0.75)
    nobody = dataclasses.replace(judged, settling_time={**judged.settling_time, "yaw": np.full(40, np.inf)})
    response = both.measure(nobody)
    assert response.to_dict()["each"]["settling_time"]["yaw"] is None
    assert ResponseSummary.from_dict(json.loads(json.dumps(response.to_dict()))) == response


@pytest.mark.parametrize(
    ("response", "missing"),
    [
        (GOOD, {}),
        (but(settling_time=2.76), {"settling_time"}),
        (but(settling_time=2.74), set()),
        (but(settling_time=2.24), {"settling_time"}),
        (but(settling_time=math.inf, settled=0.4), {"settling_time", "settled"}),
        (but(overshoot=0.051), {"overshoot"}),
        (but(error=0.0101), {"error"}),
        (but(settled=0.985), {"settled"}),
        (but(constraints_satisfied=0.98), {"constraints_satisfied"}),
    ],
)
def test_what_is_missing_of_a_target(response, missing):
    assert set(make_requirement(2.5).misses(response)) == set(missing)


def test_an_upper_bound_has_no_lower_side_and_no_tolerance():
    wanted = make_requirement(2.5, at_most=True)
    assert not wanted.misses(but(settling_time=0.5))
    assert not wanted.misses(but(settling_time=2.5))
    assert set(wanted.misses(but(settling_time=2.51))) == {"settling_time"}


def test_the_tuning_starts_are_asked_for_more_of_everything_but_the_shares():
    wanted = make_requirement(2.5)
    barely = but(settling_time=2.7, overshoot=0.045, error=0.009, settled=0.99)
    assert not wanted.misses(barely)
    assert set(wanted.tightened().misses(barely)) == {"settling_time", "overshoot", "error"}
    early = make_requirement(2.5, at_most=True).tightened()
    assert early.maximum_settling_time() == pytest.approx(2.375)
    assert early.aim() < early.maximum_settling_time()


def test_a_miss_is_finite_and_of_the_right_sign_whatever_was_measured():
    for at_most in (False, True):
        wanted = make_requirement(3.4, at_most=at_most).tightened()
        for time in (0.0, 1.0, wanted.aim(), wanted.maximum_settling_time() + 1e-9, 50.0, math.inf):
            miss = wanted.misses(but(settling_time=time, error=math.inf, overshoot=math.inf)).get("settling_time")
            assert miss is None or (math.isfinite(miss) and miss * (time - wanted.aim()) > 0)
    assert set(make_requirement(2).misses(but(settling_time=0.0))) == {"settling_time"}


def test_too_slow_is_positive_and_too_fast_negative():
    wanted = make_requirement(2.0)
    assert wanted.misses(but(settling_time=4.0))["settling_time"] == pytest.approx(math.log(2))
    assert wanted.misses(but(settling_time=1.0))["settling_time"] == pytest.approx(-math.log(2))


def test_the_nearest_response_is_the_one_that_settles_before_the_one_in_time():
    wanted = make_requirement(2.0)
    late, lame = but(settling_time=3.0), but(settling_time=2.0, settled=0.9)
    assert 0 < wanted.distance(late) < wanted.distance(lame)
    assert wanted.distance(but(settling_time=2.0)) == 0


def test_a_flight_is_measured_as_the_judge_measures_it(pid_flights):
    judged = judge(pid_flights)
    told = judged.to_dict()
    position = make_requirement(3).measure(judged)
    assert position.settling_time == told["position"]["settling_time"]["median"]
    assert position.error == told["position"]["steady_state_error"]["median"]
    assert position.settled == told["position"]["settled"] / 40
    late = make_requirement(3, percentile=95, axis="yaw").measure(judged)
    assert late.settling_time == told["axes"]["yaw"]["settling_time"]["p95"]


def test_only_bounds_the_user_has_set_are_constraints(pid_flights):
    judged = judge(pid_flights)
    broken = np.zeros(40, bool)
    broken[:10] = True
    judged = dataclasses.replace(judged, violated={**judged.violated, "speed": broken})
    wanted = make_requirement(3)
    assert wanted.measure(judged).constraints_satisfied == 1
    assert wanted.measure(judged, constraints=("speed",)).constraints_satisfied == pytest.approx(0.75)


def test_trials_of_two_judgements_count_as_one_set(pid_flights):
    first = judge(pid_flights)
    late = {**first.settling_time, "position": first.settling_time["position"] + 100.0}
    second = dataclasses.replace(first, settling_time=late)
    both = make_requirement(3, percentile=60).measure(first, second)
    # 60 % of 80 trials are the 40 early ones and the first 8 of the late ones: the 8th of 40 is percentile 20 of them
    assert both.settling_time == make_requirement(3, percentile=20).measure(second).settling_time
    lost = dataclasses.replace(first, settling_time={**late, "position": np.full(40, np.inf)})
    assert make_requirement(3).measure(first, lost).settled == pytest.approx(0.5)


@pytest.fixture(scope="module")
def pid_flights():
    from flytune.control.classical import classical_controller

    task = load_task("baseline")
    return fly(classical_controller("pid", task, "tuned"), task, trials=40, seed=5)
