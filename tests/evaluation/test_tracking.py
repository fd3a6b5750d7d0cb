"""Tracking errors of flights whose distance from the path is known, and steps judged one by one."""

import dataclasses
import math

import numpy as np
import pytest

from flytune.evaluation.evaluate import evaluate
from flytune.evaluation.flights import Flights
from flytune.evaluation.judge import judge
from flytune.evaluation.load_flights import load_flights
from flytune.task.files import load_task

TIME = np.arange(2001) * 0.01
SPEED = 0.5


def around(time):
    """A circle of 1 m at 0.5 m/s."""
    return np.stack([np.cos(SPEED * time), np.sin(SPEED * time), np.ones_like(time)], axis=-1)


def flights(position, target, yaw=0.0):
    """Two flights alike along positions [K, 3]."""
    number, samples = 2, len(TIME)
    still = np.zeros((number, samples, 3))
    return Flights(
        time=TIME,
        position=np.repeat(position[None], number, axis=0),
        attitude=np.broadcast_to([0.0, 0.0, 0.0, 1.0], (number, samples, 4)).copy(),
        velocity=still,
        body_rate=still,
        rotor_speed_rpm=np.zeros((number, samples, 4)),
        action=np.zeros((number, samples, 4)),
        crashed=np.zeros(number, bool),
        margins={},
        target_position=target,
        target_yaw=np.full(samples, yaw),
        speed_bound=0.8,
        name="known",
        task="circle",
        vehicle="none",
        simulator="none",
        seed=1,
        initial_conditions="clear",
    )


@pytest.mark.parametrize("lag", [-0.1234, 0.0, 0.0567, 0.5])
def test_a_flight_that_is_late_has_that_lag_and_an_error_along_the_path(lag):
    found = judge(flights(around(TIME - lag), around(TIME))).tracking
    chord = 2 * math.sin(abs(SPEED * lag) / 2)
    np.testing.assert_allclose(found.lag, lag, atol=1e-4)
    np.testing.assert_allclose(found.mean_error, chord, atol=1e-6)
    np.testing.assert_allclose(found.maximum_error, chord, atol=1e-6)
    np.testing.assert_allclose(found.along_error, abs(math.sin(SPEED * lag)), atol=1e-4)


def test_a_flight_on_a_wider_circle_has_its_error_across_the_path_and_no_lag():
    wide = around(TIME) * [1.05, 1.05, 1.0]
    found = judge(flights(wide, around(TIME))).tracking
    np.testing.assert_allclose(found.across_error, 0.05, atol=1e-5)
    np.testing.assert_allclose(found.along_error, 0.0, atol=1e-4)
    np.testing.assert_allclose(found.lag, 0.0, atol=1e-6)


def test_the_first_half_is_the_approach_and_does_not_count():
    position = around(TIME)
    position[:1000] += 5.0
    found = judge(flights(position, around(TIME))).tracking
    assert found.begin == pytest.approx(10.0)
    np.testing.assert_allclose(found.maximum_error, 0.0, atol=1e-9)


def test_a_crashed_flight_is_infinitely_far_and_stays_in():
    given = flights(around(TIME), around(TIME))
    found = judge(dataclasses.replace(given, crashed=np.array([True, False])))
    assert np.isposinf(found.tracking.mean_error[0])
    assert np.isfinite(found.tracking.mean_error[1])
    assert found.to_dict()["tracking"]["mean_error"]["p95"] is None


def test_a_flight_a_second_behind_does_not_follow():
    assert np.isposinf(judge(flights(around(TIME - 1.3), around(TIME))).tracking.lag).all()


def test_a_target_that_has_come_to_rest_shows_no_lag():
    target = around(np.minimum(TIME, 5.0))
    found = judge(flights(target, target)).tracking
    assert np.isnan(found.lag).all()
    assert found.to_dict()["lag"]["median"] is None


def test_what_does_not_apply_to_a_moving_target_is_null_and_the_rest_is_relative_to_it():
    judged = judge(flights(around(TIME), around(TIME))).to_dict()
    assert judged["axes"]["x"]["overshoot"] == {"median": None, "p75": None, "p95": None}
    assert judged["axes"]["x"]["rise_time"]["median"] is None
    assert judged["efficiency"]["median"] is None
    assert judged["position"]["settling_time"]["median"] == 0
    assert judged["position"]["settled"] == 2
    assert "steps" not in judged


def test_each_step_is_judged_as_a_trial_of_its_own():
    target = np.where(TIME[:, None] < 8.0, [0.0, 0.0, 1.0], [1.0, 0.0, 1.0])
    position = target.copy()
    position[:, 0] -= np.exp(-2 * (TIME - 8.0 * (TIME >= 8.0))) * np.where(
        TIME < 8.0, 0.5, 1.0
    )  # of 0.5 m, then of 1 m
    judgement = judge(flights(position[:], target))
    first, second = judgement.steps
    assert judgement.tracking is None
    assert (first.begin, second.begin) == (0.0, 8.0)
    assert second.target == (1.0, 0.0, 1.0, 0.0)
    for step, size in ((first, 0.5), (second, 1.0)):  # size exp(-2 t) = 0.02
        expected = math.log(size / 0.02) / 2
        np.testing.assert_allclose(step.judgement.settling_time["x"], expected, atol=0.01)
    assert [step["begin"] for step in judgement.to_dict()["steps"]] == [0.0, 8.0]


def test_a_trial_that_crashes_in_the_second_step_is_counted_there_only():
    target = np.where(TIME[:, None] < 8.0, [0.0, 0.0, 1.0], [1.0, 0.0, 1.0])
    given = flights(target + 1e-3 * np.sin(TIME)[:, None], target)
    position = given.position.copy()
    position[0, 1200:] = position[0, 1200]
    crashed = judge(dataclasses.replace(given, position=position, crashed=np.array([True, False])))
    assert [step.judgement.crashed.tolist() for step in crashed.steps] == [[False, False], [True, False]]


@pytest.fixture(scope="module")
def followed():
    """The shipped policy on the circle, few trials."""
    task = load_task("baseline-refined", {"target.kind": "circle", "duration": 12.0})
    return evaluate("baseline-refined", task, trials=8)


def test_the_shipped_policy_follows_a_circle_to_less_than_two_centimetres(followed):
    found = followed.judgement.tracking
    assert found.mean_error.max() < 0.02
    assert np.abs(found.lag).max() < 0.01
    assert followed.judgement.settled("position") == 8


def test_flights_along_a_path_are_read_again_and_judged_the_same(followed, tmp_path):
    followed.flights.save(tmp_path / "flights.npz")
    again = load_flights(tmp_path / "flights.npz")
    assert judge(again).to_dict() == followed.judgement.to_dict()
    twice = judge(load_flights(tmp_path / "flights.npz", tmp_path / "flights.npz"))
    assert twice.trials == 16
    np.testing.assert_array_equal(twice.tracking.mean_error[8:], followed.judgement.tracking.mean_error)


def test_the_table_tells_the_tracking_error(followed):
    text = followed.judgement.table()
    assert "tracking" in text
    assert "lag" in text
