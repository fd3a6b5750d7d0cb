"""Quantiles by hand, with the failed trials in them, and the bootstrap where its answer is known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flytune.errors import BadInput
from flytune.evaluation.statistics import bootstrap_interval, finite, median, quantile, summary

INFINITE = math.inf


def test_the_inverted_cdf_takes_the_value_of_rank_q_n_rounded_up():
    values = np.array([50.0, 10.0, 40.0, 20.0, 30.0])
    # N = 5: ranks ceil(0.5 * 5) = 3, ceil(0.25 * 5) = 2, ceil(0.75 * 5) = 4, ceil(0.95 * 5) = 5
    assert [quantile(values, q) for q in (0.5, 0.25, 0.75, 0.95, 1.0, 0.0)] == [30, 20, 40, 50, 50, 10]


def test_the_median_of_an_even_number_is_the_lower_middle_value_and_never_between():
    assert median(np.array([1.0, 2.0, 3.0, 4.0])) == 2.0  # rank ceil(0.5 * 4) = 2


@pytest.mark.parametrize(("q", "rank"), [(0.07, 7), (0.14, 14), (0.28, 28), (0.29, 29), (0.55, 55), (0.56, 56)])
def test_rounding_of_q_times_n_moves_no_rank(q, rank):
    # 0.07 * 100 is 7.000000000000001 in floating point; its ceiling would be 8
    assert quantile(np.arange(1.0, 101.0), q) == rank


def test_unsettled_trials_stay_in_at_infinity():
    # 95 of 100 settled: rank 95 is still the slowest of them; with one less it is infinite
    settled = np.arange(1.0, 101.0)
    settled[95:] = INFINITE
    assert quantile(settled, 0.95) == 95.0
    settled[94] = INFINITE
    assert quantile(settled, 0.95) is None
    assert quantile(settled, 0.5) == 50.0


def test_the_median_is_infinite_once_more_than_half_failed():
    assert median(np.array([1.0, 2.0, INFINITE, INFINITE])) == 2.0
    assert median(np.array([1.0, INFINITE, INFINITE])) is None


def test_a_trial_without_a_value_is_left_out_of_the_ranks():
    assert quantile(np.array([np.nan, 3.0, 1.0, np.nan, 2.0]), 0.5) == 2.0
    assert quantile(np.array([np.nan, np.nan]), 0.5) is None


def test_a_summary_names_its_quantiles_in_the_order_asked():
    values = np.append(np.arange(1.0, 20.0), INFINITE)  # N = 20: ranks 5, 10, 15, 19, 20
    assert list(summary(values, ("median", "p25", "p75", "p95", "max")).items()) == [
        ("median", 10.0), ("p25", 5.0), ("p75", 15.0), ("p95", 19.0), ("max", None),
    ]  # fmt: skip


def test_what_json_cannot_say_becomes_none():
    assert [finite(value) for value in (1.5, INFINITE, -INFINITE, math.nan)] == [1.5, None, None, None]
    assert type(finite(np.float32(0.5))) is float


@given(st.lists(st.one_of(st.floats(0, 100), st.just(INFINITE)), min_size=1, max_size=60), st.integers(1, 100))
def test_at_least_the_share_q_lies_at_or_below_the_quantile_and_less_lies_strictly_below(values, percent):
    found = quantile(np.array(values), percent / 100)
    found = INFINITE if found is None else found
    needed = math.ceil(len(values) * percent / 100 - 1e-9)
    assert sum(value <= found for value in values) >= needed
    assert sum(value < found for value in values) < needed


@given(st.lists(st.floats(0, 100), min_size=1, max_size=60), st.sampled_from([0.25, 0.5, 0.75, 1.0]))
def test_finite_values_agree_with_the_inverted_cdf_of_numpy(values, q):
    # q N is exact for these q, so that NumPy's own rounding does not matter
    assert quantile(np.array(values), q) == np.quantile(values, q, method="inverted_cdf")


def test_the_interval_of_equal_values_is_that_value():
    assert bootstrap_interval([[2.0, 2.0], [2.0, 2.0, 2.0]], number=50) == (2.0, 2.0)


def test_the_same_seed_gives_the_same_interval_and_another_one_another():
    values = np.random.default_rng(3).normal(size=(5, 20))
    intervals = [bootstrap_interval(values, np.mean, number=200, seed=seed) for seed in (7, 7, 8)]
    assert intervals[0] == intervals[1]
    assert intervals[0] != intervals[2]


def test_the_interval_of_a_mean_over_independent_trials_has_the_width_of_theory():
    # one seed, 400 trials of variance 1: the mean has a standard error of 1 / 20, so 95 % is +-1.96 / 20 around it
    values = np.random.default_rng(0).normal(size=400)
    values = (values - values.mean()) / values.std()
    low, high = bootstrap_interval([values], np.mean, number=4000)
    assert low == pytest.approx(-1.96 / 20, abs=0.006)
    assert high == pytest.approx(1.96 / 20, abs=0.006)


def test_trials_of_one_seed_do_not_count_as_independent():
    # two seeds, each always the same value: a draw is (0, 0), (0, 1), (1, 0) or (1, 1), so the mean is 0 in a quarter
    # of them however many trials were flown; pooled as 2000 independent trials the interval would be 0.5 +- 0.022
    assert bootstrap_interval([np.zeros(1000), np.ones(1000)], np.mean, number=400) == (0.0, 1.0)


def test_draws_that_failed_make_the_upper_end_infinite():
    # the median of (1, 1, 1, inf, inf) drawn again is infinite with probability P(Bin(5, 0.4) >= 3) = 0.317
    low, high = bootstrap_interval([[1.0, 1.0, 1.0, INFINITE, INFINITE]], number=500)
    assert (low, high) == (1.0, None)
    assert bootstrap_interval([[INFINITE]], number=10) == (None, None)


@pytest.mark.parametrize("values", [[], [[1.0], []]])
def test_an_interval_of_nothing_is_refused(values):
    with pytest.raises(BadInput, match=r"^values: "):
        bootstrap_interval(values)
