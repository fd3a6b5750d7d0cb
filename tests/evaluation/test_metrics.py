"""Metrics against closed-form responses to the sample, and every definition on a trajectory made by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from flytune.evaluation import metrics

TIME = np.arange(1001) / 100  # ten seconds at 100 Hz
SAMPLE = 1e-9  # s; "to the sample" leaves room for rounding only


def next_sample(instant):
    """The first sampling instant that is not before the given one."""
    return math.ceil(100 * instant) / 100


def rows(*trials):
    return np.array(trials, dtype=float)


# --- closed forms: first order, e(t) = step exp(-t / tau) ---


@pytest.mark.parametrize("tau", [0.11, 0.37, 0.5, 1.03])
@pytest.mark.parametrize("step", [1.7, -0.43])
def test_a_first_order_response_settles_after_tau_times_the_logarithm_of_step_over_band(tau, step):
    # |step| exp(-t / tau) = band  =>  t = tau ln(|step| / band)
    settled = metrics.settling_time(rows(step * np.exp(-TIME / tau)), TIME, 0.02)
    assert settled[0] == pytest.approx(next_sample(tau * math.log(abs(step) / 0.02)), abs=SAMPLE)


@pytest.mark.parametrize("tau", [0.11, 0.37, 0.5, 1.03])
def test_a_first_order_response_rises_in_tau_times_the_logarithm_of_nine(tau):
    # from exp(-t / tau) = 0.9 to exp(-t / tau) = 0.1: tau (ln 10 - ln(10 / 9)) = tau ln 9, each end on its next sample
    risen = metrics.rise_time(rows(-2 * np.exp(-TIME / tau)), TIME)
    expected = next_sample(tau * math.log(10)) - next_sample(tau * math.log(10 / 9))
    assert risen[0] == pytest.approx(expected, abs=SAMPLE)
    assert risen[0] == pytest.approx(tau * math.log(9), abs=0.01)


def test_a_first_order_response_never_overshoots():
    assert metrics.overshoot(rows(1.3 * np.exp(-TIME / 0.4)))[0] == 0.0


def test_the_itae_of_a_first_order_response_is_the_integral_by_parts():
    # integral from 0 to T of t exp(-t / tau) dt = tau^2 (1 - (1 + T / tau) exp(-T / tau))
    tau, step = 0.8, -1.5
    expected = 1.5 * tau**2 * (1 - (1 + 10 / tau) * math.exp(-10 / tau))
    assert metrics.itae(rows(step * np.exp(-TIME / tau)), TIME)[0] == pytest.approx(expected, rel=1e-4)


# --- closed forms: second order, e(t) = exp(-zeta w t) (cos wd t + zeta / sqrt(1 - zeta^2) sin wd t) ---


def second_order(damping, damped_frequency):
    ratio = damping / math.sqrt(1 - damping**2)

    def error(t):
        return np.exp(-ratio * damped_frequency * t) * (
            np.cos(damped_frequency * t) + ratio * np.sin(damped_frequency * t)
        )

    return error


@pytest.mark.parametrize("damping", [0.2, 0.4, 0.591, 0.7])
def test_a_second_order_response_overshoots_by_its_damping_alone(damping):
    # the first peak lies at t = pi / wd = 1.5 s, a sample, and is exp(-pi zeta / sqrt(1 - zeta^2)) past the target
    error = second_order(damping, math.pi / 1.5)
    for step in (2.0, -0.3):
        past = metrics.overshoot(rows(step * error(TIME)))[0]
        assert past == pytest.approx(math.exp(-math.pi * damping / math.sqrt(1 - damping**2)), rel=1e-9)


@pytest.mark.parametrize("damping", [0.2, 0.4, 0.591, 0.7])
@pytest.mark.parametrize("damped_frequency", [2.3, 4.0, 7.1])
def test_a_second_order_response_settles_at_the_last_band_crossing(damping, damped_frequency):
    error, half_period = second_order(damping, damped_frequency), math.pi / damped_frequency
    # de/dt = 0 only at t_k = k pi / wd, where |e| falls from one extreme to the next; so the last crossing lies between
    # the last extreme outside the band and the zero of e that follows it
    extreme = max(k for k in range(200) if abs(error(k * half_period)) > 0.02) * half_period
    zero = brentq(error, extreme, extreme + half_period)
    crossing = brentq(lambda t: abs(error(t)) - 0.02, extreme, zero)
    settled = metrics.settling_time(rows(error(TIME)), TIME, 0.02)
    assert settled[0] == pytest.approx(next_sample(crossing), abs=SAMPLE)


@pytest.mark.parametrize("damping", [0.2, 0.5, 0.7])
def test_a_second_order_response_rises_between_its_first_crossings(damping):
    error = second_order(damping, 3.0)
    # e falls monotonically from 1 to its first extreme at pi / wd
    crossings = [brentq(lambda t, level=level: error(t) - level, 0, math.pi / 3.0) for level in (0.9, 0.1)]
    expected = next_sample(crossings[1]) - next_sample(crossings[0])
    assert metrics.rise_time(rows(0.5 * error(TIME)), TIME)[0] == pytest.approx(expected, abs=SAMPLE)


# --- settling, by hand ---


def test_a_trial_that_never_leaves_the_band_settles_at_zero():
    assert metrics.settling_time(rows(np.full(1001, -0.02)), TIME, 0.02)[0] == 0.0  # on the edge is inside


def test_a_trial_that_starts_inside_leaves_and_returns_settles_at_its_return():
    error = np.zeros(1001)
    error[200:300] = 0.03
    assert metrics.settling_time(rows(error), TIME, 0.02)[0] == 3.0


def test_a_trial_that_never_enters_the_band_settles_at_infinity():
    assert metrics.settling_time(rows(np.full(1001, 0.021)), TIME, 0.02)[0] == math.inf


def test_a_trial_that_leaves_at_the_last_sample_is_unsettled():
    error = np.zeros(1001)
    error[-1] = 0.021
    assert metrics.settling_time(rows(error), TIME, 0.02)[0] == math.inf


def test_entering_exactly_half_a_second_before_the_end_settles_and_one_sample_later_does_not():
    error = np.ones((2, 1001))
    error[0, 950:] = 0.0
    error[1, 951:] = 0.0
    np.testing.assert_array_equal(metrics.settling_time(error, TIME, 0.02), [9.5, math.inf])


def test_half_a_second_before_the_end_survives_a_time_axis_in_single_precision():
    for samples in range(700, 1100):  # for some of these, the instant is rounded to just after the limit
        time = np.float32(0.01) * np.arange(samples, dtype=np.float32)
        error = np.ones((2, samples))
        error[0, samples - 51 :] = 0.0
        error[1, samples - 50 :] = 0.0
        assert np.isfinite(metrics.settling_time(error, time, 0.02)).tolist() == [True, False], samples


def test_a_sample_that_is_not_a_number_is_outside_the_band():
    error = np.zeros(1001)
    error[400] = np.nan
    assert metrics.settling_time(rows(error), TIME, 0.02)[0] == pytest.approx(4.01)


def test_each_trial_may_have_a_band_of_its_own():
    error = np.repeat(rows(2 * np.exp(-TIME / 0.5)), 2, axis=0)
    settled = metrics.settling_time(error, TIME, np.array([0.04, 0.1]))
    # tau ln(2 / 0.04) = 1.956 s and tau ln(2 / 0.1) = 1.498 s
    np.testing.assert_allclose(settled, [1.96, 1.50])


DYADIC = st.integers(-2048, 2048).map(lambda k: k / 1024)  # sums and differences of these are exact
ERRORS = hnp.arrays(np.int64, (2, 70), elements=st.integers(-2048, 2048)).map(lambda k: k / 1024)
SHORT_TIME = np.arange(70) / 100


@given(ERRORS)
def test_settling_rise_and_overshoot_do_not_see_the_sign_of_the_error(error):
    for mirrored, original in (
        (metrics.settling_time(-error, SHORT_TIME, 0.25), metrics.settling_time(error, SHORT_TIME, 0.25)),
        (metrics.rise_time(-error, SHORT_TIME), metrics.rise_time(error, SHORT_TIME)),
        (metrics.overshoot(-error), metrics.overshoot(error)),
    ):
        np.testing.assert_array_equal(mirrored, original)


@given(ERRORS, DYADIC, DYADIC)
def test_a_wider_band_never_settles_later(error, one, other):
    narrow, wide = sorted((abs(one), abs(other)))
    assert np.all(metrics.settling_time(error, SHORT_TIME, wide) <= metrics.settling_time(error, SHORT_TIME, narrow))


@given(ERRORS, DYADIC)
def test_a_finite_settling_time_is_the_first_instant_of_the_last_stay_in_the_band(error, band):
    for trial, settled in zip(error, metrics.settling_time(error, SHORT_TIME, abs(band)), strict=True):
        inside = np.abs(trial) <= abs(band)
        candidates = [t for k, t in enumerate(SHORT_TIME) if inside[k:].all() and k <= 69 - 50]
        assert settled == min(candidates, default=math.inf)


@given(ERRORS)
def test_the_mean_error_never_exceeds_the_rms_error(error):
    mean, rms = metrics.steady_state_error(error, SHORT_TIME), metrics.rms_error(error, SHORT_TIME)
    assert np.all(mean <= rms + 1e-12)


# --- rise, by hand ---


def test_rise_runs_from_the_first_error_of_nine_tenths_to_the_first_of_one_tenth():
    error = np.full(1001, -2.0)
    error[100:] = -1.8  # exactly 90 % of the step is left
    error[250:] = -1.0
    error[400:] = -0.2  # exactly 10 %
    error[500:] = -1.0  # what happens afterwards is no longer the rise
    assert metrics.rise_time(rows(error), TIME)[0] == 3.0


def test_a_trial_that_stays_short_of_ninety_percent_rises_at_infinity():
    assert metrics.rise_time(rows(np.linspace(1, 0.11, 1001)), TIME)[0] == math.inf


def test_jumping_across_the_target_between_two_samples_ends_the_rise():
    assert metrics.rise_time(rows(np.where(TIME < 2, 1.0, -1.0)), TIME)[0] == 0.0  # 90 % and 10 % in the same sample


def test_moving_away_from_the_target_is_no_rise():
    assert metrics.rise_time(rows(1 + TIME), TIME)[0] == math.inf


def test_without_a_step_there_is_neither_rise_nor_overshoot():
    error = rows(np.concatenate([[0.0], np.ones(1000)]))
    assert np.isnan(metrics.rise_time(error, TIME)[0])
    assert np.isnan(metrics.overshoot(error)[0])


# --- overshoot, by hand ---


def test_overshoot_is_the_largest_excursion_past_the_target_over_the_step():
    error = np.array([[-2.0, -3.0, 0.1, 0.5, -0.2, 0.3]])  # further away than the start (-3) is not past the target
    assert metrics.overshoot(error)[0] == 0.25


def test_an_excursion_inside_the_band_counts_zero_and_one_beyond_it_counts_in_full():
    error = np.array([[0.5, -0.02, 0.0], [0.5, -0.025, 0.0]])
    np.testing.assert_allclose(metrics.overshoot(error, 0.02), [0.0, 0.05])
    np.testing.assert_allclose(metrics.overshoot(error), [0.04, 0.05])


def test_position_error_along_the_start_keeps_what_points_back_and_forgets_what_lies_across():
    # start (3, 4, 0): direction (0.6, 0.8, 0); (-0.6, -0.8, 0) is 1 m past the target, (-4, 3, 7) lies across
    error = np.array([[[3.0, 4.0, 0.0], [-0.6, -0.8, 0.0], [-4.0, 3.0, 7.0]]])
    np.testing.assert_allclose(metrics.error_along_start(error), [[5.0, -1.0, 0.0]], atol=1e-12)
    assert metrics.overshoot(metrics.error_along_start(error))[0] == pytest.approx(0.2)


def test_a_start_on_the_target_has_no_direction():
    error = np.array([[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]])
    np.testing.assert_array_equal(metrics.error_along_start(error), [[0.0, 0.0]])


# --- steady state, by hand ---


def test_the_steady_state_is_the_last_two_seconds_and_nothing_before():
    error = np.full(1001, 5.0)
    error[801:] = -0.25  # samples 801 to 1000: 200 of them, 2 s
    assert metrics.steady_samples(TIME).sum() == 200
    assert metrics.steady_state_error(rows(error), TIME)[0] == 0.25
    assert metrics.rms_error(rows(error), TIME)[0] == 0.25


def test_a_trial_shorter_than_two_seconds_is_averaged_whole():
    time = np.array([0.0, 0.5, 1.0])
    assert metrics.steady_state_error(np.array([[3.0, 2.0, 1.0]]), time)[0] == 2.0


def test_a_mean_hides_an_oscillation_that_the_rms_shows():
    error = rows(0.1 * np.sin(2 * math.pi * TIME))  # two whole periods in two seconds
    assert metrics.steady_state_error(error, TIME)[0] == pytest.approx(0.0, abs=1e-12)
    assert metrics.rms_error(error, TIME)[0] == pytest.approx(0.1 / math.sqrt(2), rel=1e-9)


def test_the_position_error_is_the_norm_of_the_mean_and_not_the_mean_of_the_norm():
    turn = 2 * math.pi * TIME
    circle = np.stack([0.3 + 0.1 * np.cos(turn), -0.4 + 0.1 * np.sin(turn), 0 * TIME], axis=-1)[None]
    assert metrics.steady_state_position_error(circle, TIME)[0] == pytest.approx(0.5, rel=1e-9)
    assert metrics.steady_state_position_error(circle - [0.3, -0.4, 0], TIME)[0] == pytest.approx(0, abs=1e-12)


def test_yaw_errors_on_both_sides_of_180_degrees_average_to_180_and_not_to_zero():
    error = np.where(np.arange(1001) % 2, 1.0, -1.0) * (math.pi - 0.1)
    assert metrics.steady_state_yaw_error(rows(error), TIME)[0] == pytest.approx(math.pi)


# --- yaw ---


def test_yaw_is_the_first_angle_of_the_zyx_sequence_whatever_pitch_and_roll():
    yaw, pitch, roll = np.meshgrid([-3.0, -1.2, 0.0, 0.4, 2.9], [-1.4, 0.0, 0.7], [-2.5, 0.0, 1.0])
    angles = np.stack([yaw.ravel(), pitch.ravel(), roll.ravel()], axis=-1)
    attitude = Rotation.from_euler("ZYX", angles).as_quat()  # (x, y, z, w)
    np.testing.assert_allclose(metrics.yaw_angle(attitude), angles[:, 0], atol=1e-12)
    np.testing.assert_allclose(metrics.yaw_angle(-1.01 * attitude), angles[:, 0], atol=1e-12)  # -q turns the same


@given(st.floats(-50, 50), st.integers(-5, 5))
def test_wrapping_keeps_the_direction_and_stays_within_180_degrees(angle, turns):
    wrapped = metrics.wrap_angle(np.array([angle + 2 * math.pi * turns]))[0]
    assert abs(wrapped) <= math.pi + 1e-12
    assert math.cos(wrapped - angle) == pytest.approx(1, abs=1e-12)


def test_an_angle_within_180_degrees_is_wrapped_to_itself_to_the_bit():
    angle = np.array([-3.14, -metrics.YAW_BAND, 0.0, metrics.YAW_BAND, 3.14])
    np.testing.assert_array_equal(metrics.wrap_angle(angle), angle)


def test_the_circular_mean_is_a_direction():
    # 350 and 20 degrees average to 5 degrees, not to 185
    assert metrics.circular_mean(np.radians([[350.0, 20.0]]))[0] == pytest.approx(math.radians(5))


def test_a_yaw_that_crosses_180_degrees_is_one_step_without_a_jump():
    # from 170 deg up through 180 deg to a target at -150 deg (210 deg): the step is 40 deg
    yaw = np.radians(170 + 40 * (1 - np.exp(-TIME / 0.3)))
    error = metrics.unwrapped_yaw_error(metrics.wrap_angle(rows(yaw)), math.radians(-150))
    assert math.degrees(error[0, 0]) == pytest.approx(-40, abs=1e-6)
    assert metrics.overshoot(error, metrics.YAW_BAND)[0] == 0.0
    # tau ln 9 = 0.659 s: 90 % left after 0.0316 s, 10 % after 0.6908 s
    assert metrics.rise_time(error, TIME)[0] == pytest.approx(0.70 - 0.04)


def test_a_yaw_that_turns_the_long_way_round_has_the_long_way_as_its_step():
    # target 0, start 90 deg, flown up through 180 deg to 360 deg: a step of -270 deg, and no overshoot
    yaw = metrics.wrap_angle(rows(np.radians(360 - 270 * np.exp(-TIME / 0.5))))
    error = metrics.unwrapped_yaw_error(yaw, 0.0)
    assert math.degrees(error[0, 0]) == pytest.approx(-270, abs=1e-6)
    assert metrics.overshoot(error, metrics.YAW_BAND)[0] == 0.0


def test_a_full_turn_from_the_target_to_the_target_is_a_step_of_360_degrees():
    yaw = metrics.wrap_angle(rows(np.radians(np.minimum(360, 180 * TIME))))
    error = metrics.unwrapped_yaw_error(yaw, 0.0)
    assert math.degrees(error[0, 0]) == pytest.approx(-360, abs=1e-6)
    # 180 deg/s: from 36 deg at 0.2 s to 324 deg at 1.8 s; rounding may move either end by a sample
    assert metrics.rise_time(error, TIME)[0] == pytest.approx(1.6, abs=0.011)


# --- speed and action ---


def test_the_peak_speed_is_the_largest_norm_and_infinite_once_it_is_not_finite():
    velocity = np.zeros((3, 4, 3))
    velocity[0, 2] = [0.3, -0.4, 1.2]  # norm 1.3
    velocity[1, 1] = [np.nan, 0, 0]
    velocity[2, 3] = [1e300, 1e300, 0]  # its square overflows
    np.testing.assert_allclose(metrics.peak_speed(velocity), [1.3, math.inf, math.inf])


def test_action_metrics_count_the_first_step_from_hover_and_not_the_hover_itself():
    action = np.zeros((1, 3, 4))
    action[0, 1] = [0.5, 0.0, 0.0, 0.0]
    action[0, 2] = [0.5, -1.0, 0.0, 0.0]
    # two steps, four motors: squares 0.25 + 0.25 + 1 over 8; changes 0.5 + 1.0 over 8
    assert metrics.action_rms(action)[0] == pytest.approx(math.sqrt(1.5 / 8))
    assert metrics.action_total_variation(action)[0] == pytest.approx(1.5 / 8)
