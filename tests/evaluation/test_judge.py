"""The judge on flights made by hand: every definition, every key, and that no trial disappears."""

import json
import math
import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flytune.evaluation.judge import AXES, CHANNELS, judge

TIME = np.arange(1001) / 100
DECAY = np.exp(-TIME / 0.5)


def along(axis, *courses):
    """Position errors [N, K, 3] that move along one axis only."""
    error = np.zeros((len(courses), TIME.size, 3))
    error[..., "xyz".index(axis)] = courses
    return error


# --- the object and its keys ---


TIMES = ["median", "p25", "p75", "p95"]
OVERSHOOTS = ["median", "p75", "p95"]
ERRORS = ["median", "p75", "p95", "max"]


def shape(judged):
    """Each key with the keys below it, or with the type of its value."""
    return {key: list(value) if isinstance(value, dict) else type(value) for key, value in judged.items()}


def test_the_dictionary_has_the_published_keys_and_is_json(make_flights):
    flights = make_flights(along("x", DECAY, 5 + DECAY), margins={"speed": np.ones((2, 1001))})
    judged = json.loads(json.dumps(judge(flights).to_dict(), allow_nan=False))
    assert list(judged) == [
        "schema", "who", "task", "vehicle", "world", "trials", "seed", "starts", "duration", "axes", "position",
        "secondary", "infeasible", "crashed", "violations", "peak_speed", "action", "efficiency",
        "dial", "conditions",
    ]  # fmt: skip
    assert list(judged["axes"]) == ["x", "y", "z", "yaw"]
    of_axis = {"settling_time": TIMES, "rise_time": TIMES, "overshoot": OVERSHOOTS, "overshoot_raw": OVERSHOOTS,
               "steady_state_error": ERRORS, "rms_error": ERRORS, "itae": ERRORS}  # fmt: skip
    of_position = {key: levels for key, levels in of_axis.items() if key not in ("rise_time", "itae")}
    for axis in judged["axes"].values():
        assert shape(axis) == {"settled": int, "small_steps": int, **of_axis}
    assert shape(judged["position"]) == {"settled": int, **of_position}
    assert list(judged["secondary"]) == ["2%", "5%"]
    for channels in judged["secondary"].values():
        assert list(channels) == ["x", "y", "z", "yaw", "position"]
        assert all(list(channel) == ["settled", "settling_time"] for channel in channels.values())
        assert all(list(channel["settling_time"]) == TIMES for channel in channels.values())
    assert list(judged["peak_speed"]) == ["median", "p95"]
    assert list(judged["action"]) == ["rms", "total_variation"]
    assert list(judged["efficiency"]) == ["median"]


def test_the_dictionary_says_who_flew_what_and_where(make_flights):
    flights = make_flights(trials=3, name="lqr", task="acrobatic", vehicle="cf2", simulator="mujoco", seed=7)
    judged = judge(flights).to_dict()
    expected = {"schema": 1, "who": "lqr", "task": "acrobatic", "vehicle": "cf2", "world": "mujoco", "trials": 3,
                "seed": 7, "starts": "clear", "duration": 10.0}  # fmt: skip
    assert {key: judged[key] for key in expected} == expected


# --- a trial that is known in closed form ---


def test_a_first_order_flight_is_judged_as_its_closed_form(make_flights):
    # e_x = -1.6 exp(-t / 0.5): into 0.02 m after 0.5 ln 80 = 2.191 s; from 90 % at 0.0527 s to 10 % at 1.1513 s
    judgement = judge(make_flights(along("x", -1.6 * DECAY)))
    assert judgement.settling_time["x"][0] == pytest.approx(2.20)
    assert judgement.settling_time["position"][0] == pytest.approx(2.20)
    assert judgement.rise_time["x"][0] == pytest.approx(1.16 - 0.06)
    assert judgement.overshoot_raw["x"][0] == 0.0
    # bound (1.6 - 0.02) / 0.8 = 1.975 s
    assert judgement.efficiency[0] == pytest.approx(1.975 / 2.20)
    # 2 % and 5 % of the step: 0.5 ln 50 = 1.956 s, 0.5 ln 20 = 1.498 s
    assert judgement.secondary_settling_time["2%"]["x"][0] == pytest.approx(1.96)
    assert judgement.secondary_settling_time["5%"]["position"][0] == pytest.approx(1.50)


def test_each_axis_is_judged_by_its_own_error(make_flights):
    error = np.stack([1.0 * DECAY, 0.5 * DECAY, -0.25 * DECAY], axis=-1)[None]
    judgement = judge(make_flights(error, yaw=2 * DECAY[None]))
    # 0.5 ln(1 / 0.02) = 1.956, 0.5 ln 25 = 1.609, 0.5 ln 12.5 = 1.263, 0.5 ln(2 / (pi / 50)) = 1.730;
    # |e_p| = sqrt(1.3125) exp: 0.5 ln(1.1456 / 0.02) = 2.024
    settled = [judgement.settling_time[channel][0] for channel in CHANNELS]
    np.testing.assert_allclose(settled, [1.96, 1.61, 1.27, 1.74, 2.03])
    assert judgement.efficiency[0] == pytest.approx((math.sqrt(1.3125) - 0.02) / 0.8 / 2.03)  # of the position


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])  # the factory keeps no state
@given(right=st.integers(-4096, 4096), up=st.integers(-4096, 4096))
def test_moving_the_target_and_the_flight_together_changes_nothing(make_flights, right, up):
    # multiples of 1/1024 m, so that no rounding happens
    error = np.round(along("x", 1.5 * DECAY * np.cos(3 * TIME)) * 1024) / 1024
    here = make_flights(error, target_position=np.zeros(3))
    there = make_flights(error, target_position=np.array([right, 0, up]) / 1024)
    assert judge(here).to_dict() == judge(there).to_dict()


# --- small steps ---


def test_small_steps_are_counted_and_left_out_of_overshoot_and_rise_only(make_flights):
    swing = DECAY * np.cos(4 * TIME)
    judgement = judge(make_flights(along("x", 0.099 * swing, 0.1 * swing, 1.0 * swing)))
    judged = judgement.to_dict()["axes"]["x"]
    assert judged["small_steps"] == 1  # 0.1 m itself is not under 0.1 m
    assert np.isnan(judgement.overshoot_raw["x"]).tolist() == [True, False, False]
    assert np.isnan(judgement.rise_time["x"]).tolist() == [True, False, False]
    assert judged["settled"] == 3
    assert np.isfinite(judgement.itae["x"]).all()


def test_a_yaw_step_under_eighteen_degrees_is_small(make_flights):
    yaw = np.radians([[17.9], [18.1], [-17.9]]) * DECAY
    assert judge(make_flights(yaw=yaw)).small_step["yaw"].tolist() == [True, False, True]


def test_where_all_steps_are_small_there_is_no_overshoot_to_report(make_flights):
    judged = judge(make_flights(trials=2)).to_dict()["axes"]["y"]
    assert judged["small_steps"] == 2
    assert judged["overshoot"]["median"] is None
    assert judged["settling_time"]["p95"] == 0.0


def test_in_the_secondary_bands_a_tiny_step_counts_with_its_own_tiny_band(make_flights):
    # 1 cm step held at 5 mm: inside 0.02 m from the start, but outside 2 % and 5 % of 1 cm for good
    course = np.full(1001, 0.005)
    course[0] = 0.01
    judged = judge(make_flights(along("z", course))).to_dict()
    assert judged["axes"]["z"]["settled"] == 1
    assert judged["secondary"]["5%"]["z"]["settled"] == 0


# --- overshoot ---


def test_overshoot_inside_the_band_counts_zero_but_stays_in_the_raw_value(make_flights):
    course = np.where(TIME < 2, 0.5, -0.015)
    judgement = judge(make_flights(along("y", course)))
    for channel in ("y", "position"):
        assert judgement.overshoot[channel][0] == 0.0
        assert judgement.overshoot_raw[channel][0] == pytest.approx(0.03)


def test_the_yaw_band_for_overshoot_is_in_degrees_of_yaw(make_flights):
    # 3.5 deg past the target is inside 3.6 deg, 3.7 deg is not; steps of 100 deg
    yaw = np.radians([np.where(TIME < 1, 100.0, -3.5), np.where(TIME < 1, 100.0, -3.7)])
    judgement = judge(make_flights(yaw=yaw))
    np.testing.assert_allclose(judgement.overshoot["yaw"], [0.0, 0.037], atol=1e-9)
    assert np.isfinite(judgement.settling_time["yaw"]).tolist() == [True, False]


def test_position_overshoot_is_against_the_direction_of_the_start(make_flights):
    # from (0.6, 0.8, 0) to the target, then for a second 0.1 m beyond it on that line, or 0.1 m beside it
    start = np.array([0.6, 0.8, 0.0])
    error = np.where(TIME[:, None] < 1, start, np.zeros(3))[None].repeat(2, axis=0)
    error[0, 500:600] = -0.1 * start
    error[1, 500:600] = 0.1 * np.array([-0.8, 0.6, 0.0])
    judgement = judge(make_flights(error))
    np.testing.assert_allclose(judgement.overshoot["position"], [0.1, 0.0], atol=1e-12)
    assert judgement.overshoot["x"][1] == pytest.approx(0.08 / 0.6)  # which a single axis cannot tell apart


# --- yaw ---


def test_a_yaw_that_turns_past_180_degrees_settles_by_its_wrapped_error(make_flights):
    # target 0: from 90 deg the long way round to 360 deg; the wrapped error is -270 deg exp(-t / 0.5) from 270 deg on.
    # 270 exp(-t / 0.5) = 3.6  =>  t = 0.5 ln 75 = 2.159 s
    yaw = np.radians(360 - 270 * DECAY)[None]
    judgement = judge(make_flights(yaw=yaw))
    assert judgement.settling_time["yaw"][0] == pytest.approx(2.16)
    assert judgement.overshoot["yaw"][0] == 0.0
    assert not judgement.small_step["yaw"][0]


def test_the_secondary_band_of_yaw_is_a_share_of_the_wrapped_start(make_flights):
    # wrapped start 90 deg: 5 % is 4.5 deg, reached after 0.5 ln(270 / 4.5) = 2.047 s
    judgement = judge(make_flights(yaw=np.radians(360 - 270 * DECAY)[None]))
    assert judgement.secondary_settling_time["5%"]["yaw"][0] == pytest.approx(2.05)


def test_yaw_is_judged_against_a_target_near_180_degrees(make_flights):
    # held 2 deg to either side of a target of 180 deg: never outside, mean error 0, RMS 2 deg
    yaw = np.radians(180 + 2 * np.where(np.arange(1001) % 2, 1.0, -1.0))[None]
    judgement = judge(make_flights(yaw=yaw, target_yaw=math.pi))
    assert judgement.settling_time["yaw"][0] == 0.0
    assert judgement.steady_state_error["yaw"][0] == pytest.approx(0, abs=1e-9)
    assert judgement.rms_error["yaw"][0] == pytest.approx(math.radians(2))


# --- errors ---


def test_an_oscillation_has_no_mean_error_but_an_rms_error(make_flights):
    wave = 0.1 * np.sin(2 * math.pi * TIME)
    judged = judge(make_flights(along("z", wave))).to_dict()
    for channel in (judged["axes"]["z"], judged["position"]):
        assert channel["steady_state_error"]["max"] == pytest.approx(0, abs=1e-12)
        assert channel["rms_error"]["max"] == pytest.approx(0.1 / math.sqrt(2))
    assert judged["axes"]["z"]["settled"] == 0


# --- failures stay visible ---


def test_an_unsettled_trial_is_at_infinity_but_keeps_its_measured_overshoot_and_error(make_flights):
    course = np.where(TIME < 1, 1.0, -0.5)
    judgement = judge(make_flights(along("x", course)))
    assert judgement.settling_time["x"][0] == math.inf
    assert judgement.overshoot["x"][0] == 0.5
    assert judgement.steady_state_error["x"][0] == 0.5
    assert judgement.efficiency[0] == 0.0


def test_a_crashed_trial_is_at_infinity_in_every_metric_of_the_response(make_flights):
    # it would be perfect, and its step is small: neither may hide it
    judgement = judge(make_flights(crashed=np.array([True])))
    for metric in ("settling_time", "overshoot", "overshoot_raw", "steady_state_error", "rms_error"):
        assert [getattr(judgement, metric)[channel][0] for channel in CHANNELS] == [math.inf] * 5, metric
    for metric in ("rise_time", "itae"):
        assert [getattr(judgement, metric)[axis][0] for axis in AXES] == [math.inf] * 4, metric
    assert all(times[0] == math.inf for band in judgement.secondary_settling_time.values() for times in band.values())
    judged = judgement.to_dict()
    assert judged["crashed"] == 1
    assert judged["axes"]["x"]["small_steps"] == 0
    assert judged["axes"]["x"]["overshoot"]["median"] is None


def test_crashed_trials_shift_the_quantiles_of_the_others(make_flights):
    # settling times 0.5 ln(step / 0.02) of 20 trials; with one crash p95 is the slowest left, with two it is infinite
    error = along("x", *(step * DECAY for step in np.linspace(0.5, 2.4, 20)))
    crashed = np.zeros(20, dtype=bool)
    crashed[0] = True
    judged = judge(make_flights(error, crashed=crashed)).to_dict()["axes"]["x"]
    assert judged["settling_time"]["p95"] == pytest.approx(2.40)  # 0.5 ln 120 = 2.394
    crashed[1] = True
    judged = judge(make_flights(error, crashed=crashed)).to_dict()["axes"]["x"]
    assert judged["settling_time"]["p95"] is None
    assert judged["settled"] == 18


def test_a_flight_that_is_not_finite_or_leaves_the_ball_is_a_crash_even_if_nobody_said_so(make_flights):
    error = along("x", DECAY, DECAY, DECAY, np.minimum(10.01, 2 * TIME))
    attitude = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (4, 1001, 4)).copy()
    error[0, 300:] = np.nan
    error[1, 300:, 2] = np.inf
    attitude[2, 1000] = np.nan
    judgement = judge(make_flights(error, attitude=attitude))
    assert judgement.crashed.tolist() == [True, True, True, True]
    json.dumps(judgement.to_dict(), allow_nan=False)


def test_a_flight_that_stays_within_ten_metres_of_the_target_is_no_crash(make_flights):
    assert judge(make_flights(along("z", np.minimum(10.0, 2 * TIME)))).crashed.tolist() == [False]


# --- counts ---


def test_each_termination_counts_the_trials_that_crossed_it_once(make_flights):
    speed, height = np.ones((3, 1001)), np.ones((3, 1001))
    speed[0, [10, 20, 30]] = -0.1
    speed[1, 500] = -1e-9
    height[1, 5] = -0.2
    height[2, 5] = 0.0  # on the bound is not beyond it
    judgement = judge(make_flights(trials=3, margins={"speed": speed, "height": height}))
    assert judgement.to_dict()["violations"] == {"speed": 2, "height": 1}
    assert judgement.violated["speed"].tolist() == [True, True, False]


def test_infeasible_counts_far_starts_and_starts_in_violation_once_each(make_flights):
    # at 0.2 m/s, 9.5 s reach 1.9 + 0.02 m; trial 1 is too far, trial 2 starts in violation, trial 3 is both
    height = np.ones((4, 1001))
    height[2:, 0] = -0.5
    error = along("x", 1.91 * DECAY, 1.93 * DECAY, 1.0 * DECAY, 1.93 * DECAY)
    judgement = judge(make_flights(error, margins={"height": height}, speed_bound=0.2))
    assert judgement.infeasible.tolist() == [False, True, True, True]
    assert judgement.to_dict()["infeasible"] == 3


def test_a_trial_that_was_infeasible_stays_so_when_it_crashes(make_flights):
    judgement = judge(make_flights(along("x", 3 * DECAY), crashed=np.array([True]), speed_bound=0.2))
    assert judgement.infeasible.tolist() == [True]
    assert judgement.efficiency[0] == 0.0


def test_without_a_speed_bound_there_is_no_efficiency(make_flights):
    judged = judge(make_flights(along("x", DECAY), speed_bound=None)).to_dict()
    assert judged["efficiency"] == {"median": None}
    assert judged["infeasible"] == 0


def test_peak_speed_covers_crashed_trials_as_observed(make_flights):
    velocity = np.zeros((3, 1001, 3))
    velocity[:, 7, 1] = [0.5, 0.7, 4.0]
    judged = judge(make_flights(trials=3, velocity=velocity, crashed=np.array([False, False, True]))).to_dict()
    assert judged["peak_speed"] == {"median": 0.7, "p95": 4.0}


def test_actions_are_pooled_over_trials_steps_and_motors(make_flights):
    action = np.zeros((2, 1001, 4))
    action[0, 1:] = 0.1  # one change of 0.1 in 1000 steps
    action[1, 1:, 0] = np.where(
        np.arange(1000) % 2, -0.4, 0.4
    )  # 0.4 at first, then 999 changes of 0.8 on one of 4 motors
    judged = judge(make_flights(trials=2, action=action)).to_dict()["action"]
    assert judged["rms"] == pytest.approx(math.sqrt((0.1**2 + 0.4**2 / 4) / 2))
    assert judged["total_variation"] == pytest.approx((0.1 / 1000 + (0.4 + 999 * 0.8) / 4000) / 2)


def test_flights_in_single_precision_are_judged_alike(make_flights):
    flights = make_flights(along("x", 1.6 * DECAY), yaw=2 * DECAY[None])
    fields = {
        name: getattr(flights, name) for name in ("time", "position", "attitude", "velocity", "body_rate", "action")
    }
    single = make_flights(trials=1, **{name: field.astype(np.float32) for name, field in fields.items()})
    for channel in CHANNELS:
        assert judge(single).settling_time[channel] == pytest.approx(judge(flights).settling_time[channel], abs=1e-5)
    odd = make_flights(time=np.arange(731, dtype=np.float32) * np.float32(0.01))
    assert judge(odd).to_dict()["duration"] == 7.3  # and not 7.299999713897705


# --- the table ---


def test_the_table_shows_every_channel_under_aligned_headings(make_flights):
    error = np.stack([1.6 * DECAY, -0.8 * DECAY * np.cos(3 * TIME), 0.4 * DECAY], axis=-1)[None].repeat(2, axis=0)
    error[1, :, 1] += 0.5
    table = str(judge(make_flights(error, yaw=np.array([[1.0], [2.0]]) * DECAY, margins={"speed": np.ones((2, 1001))})))
    lines = table.splitlines()
    assert lines[0] == "pid on baseline (crazyflie, world flytune): 2 trials of 10 s, starts clear, seed 1"
    rows = [line for line in lines if line.split()[:1] and line.split()[0] in CHANNELS]
    assert [row.split()[0] for row in rows] == list(CHANNELS)
    edges = {match.end() for match in re.finditer("median|p95", lines[3])}
    for row in rows:
        values = [match.end() for match in re.finditer(r"\S+", row)][2:-1]  # without the name, n/N and the unit
        assert set(values) <= edges, row
    assert max(map(len, lines)) <= 120
    assert "\x1b" not in table


def test_the_table_gives_lengths_in_millimetres_yaw_in_degrees_and_a_dash_for_infinity(make_flights):
    yaw = np.radians(np.where(TIME < 1, 90.0, 1.5))[None].repeat(2, axis=0)
    error = along("x", np.where(TIME < 1, 1.0, -0.0123), np.ones(1001))
    speed = np.ones((2, 1001))
    speed[1, 3] = -1
    lines = str(judge(make_flights(error, yaw=yaw, margins={"speed": speed}))).splitlines()
    row = {line.split()[0]: line.split()[1:] for line in lines if line}
    assert row["x"] == ["1/2", "1.00", "-", "0.00", "0.0", "0.0", "12.3", "1000.0", "mm"]
    assert row["yaw"][-3:] == ["1.50", "1.50", "deg"]
    text = "\n".join(lines)
    assert "crashed 0   infeasible 0   trials that crossed a bound: speed 1" in text
    assert "steps too small for overshoot and rise: x 0, y 2, z 2, yaw 0" in text
    moving = make_flights(np.linspace(1, 0, 1001)[None, :, None] * np.ones(3), yaw=np.linspace(1, 0, 1001)[None])
    assert "steps too small" not in str(judge(moving))
