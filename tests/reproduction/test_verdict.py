"""The arithmetic of verdicts."""

import numpy as np
import pytest

from flytune.reproduction.verdict import Measure, decide, median_of_trials, share_of_trials

YES, NO, INFORMS = (Measure(what="", value=1.0, agrees=agrees) for agrees in (True, False, None))


def test_a_share_counts_every_trial_of_every_seed():
    measure = share_of_trials("", [np.array([True, True, False, True]), np.array([True] * 4)])
    assert measure.value == 7 / 8
    assert measure.low is not None and measure.high is not None
    assert measure.low <= 7 / 8 <= measure.high


def test_a_share_agrees_only_where_its_whole_interval_reaches_the_threshold():
    all_of_them = share_of_trials("", [np.ones(100, bool)] * 3)
    assert (all_of_them.low, all_of_them.agrees) == (1.0, True)
    # 96 of 100: the estimate is above 95 %, the lower end of its interval is not
    nearly = share_of_trials("", [np.arange(100) < 96])
    assert nearly.value == 0.96
    assert nearly.low is not None and nearly.low < 0.95
    assert nearly.agrees is False
    assert share_of_trials("", [np.ones(3, bool)], None).agrees is None


def test_seeds_that_differ_widen_the_interval():
    alike = share_of_trials("", [np.arange(100) % 2 == 0] * 4)
    apart = share_of_trials("", [np.ones(100, bool), np.zeros(100, bool)] * 2)
    assert alike.value == apart.value == 0.5
    assert apart.high - apart.low > 3 * (alike.high - alike.low)


def test_a_median_in_which_most_trials_failed_is_no_number():
    measure = median_of_trials("", [np.array([1.0, np.inf, np.inf])], "s")
    assert measure.value is None and measure.text().startswith("- s")
    assert median_of_trials("", [np.array([1.0, 2.0, np.inf])], "s").value == 2.0


@pytest.mark.parametrize(
    ("printed", "reading", "verdict"),
    [
        ([YES, YES], [NO], "holds"),
        ([YES, NO], [YES], "holds under a reading"),
        ([], [YES], "holds under a reading"),
        ([NO], [YES, NO], "does not hold"),
        ([NO], [], "does not hold"),
        ([NO], [YES, INFORMS], "cannot be tested with this study"),
        ([NO], [NO, INFORMS], "does not hold"),
        ([], [], "cannot be tested with this study"),
        ([], [INFORMS], "cannot be tested with this study"),
    ],
)
def test_a_claim_holds_as_printed_or_under_a_reading_or_not_or_was_not_measured(printed, reading, verdict):
    assert decide(printed, reading) == verdict


@pytest.mark.parametrize(
    ("measure", "text"),
    [
        (Measure(what="", value=0.876, low=0.8, high=0.9, unit="share"), "87.6 % [80.0 %, 90.0 %]"),
        (Measure(what="", value=3.14159, unit="s"), "3.142 s"),
        (Measure(what="", value=None, low=2.0, high=None, unit="s"), "- s [2, -]"),
    ],
)
def test_a_number_is_written_with_its_unit_and_interval(measure, text):
    assert measure.text() == text
