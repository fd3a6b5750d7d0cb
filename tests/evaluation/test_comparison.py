"""Controllers side by side: paired differences by hand, failed trials on either side, and what is refused."""

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flytune.errors import BadInput
from flytune.evaluation.comparison import compare
from flytune.evaluation.difference import METRICS, median_and_interval, paired_difference
from flytune.evaluation.judge import judge
from flytune.evaluation.statistics import bootstrap_interval

INFINITE, NOT_APPLICABLE = math.inf, math.nan


@pytest.fixture
def make_judgement(make_flights):
    """Factory of judgements of hovering flights; `position` etc. give the settling times of a channel, by hand."""

    def make(name="pid", *, settling=None, overshoot=None, trials=None, **changes):
        trials = trials or len(next((given for given in (settling, overshoot) if given is not None), [0] * 5))
        flown = {
            "simulator": "flytune",
            "task": "baseline",
            "vehicle": "crazyflie",
            "seed": 1,
            "initial_conditions": "clear",
        }
        flown = {key: changes.pop(key, value) for key, value in flown.items()}
        judgement = judge(make_flights(trials=trials, name=name, **flown))
        for field, values in (("settling_time", settling), ("overshoot", overshoot)):
            if values is not None:
                changes[field] = {**getattr(judgement, field), "position": np.array(values, dtype=float)}
        return dataclasses.replace(judgement, **changes)

    return make


def difference(comparison, metric, name=None):
    """The one difference by a metric, of a controller or of the only one."""
    found = [one for one in comparison.differences if one.metric.name == metric and name in (None, one.name)]
    assert len(found) == 1
    return found[0]


# --- the difference of a pair ---


def test_a_difference_is_the_controller_less_the_reference_trial_by_trial(make_judgement):
    # 3.5 - 3, 4 - 4, 1 - 2, 6 - 5, 9.25 - 9 = 0.5, 0, -1, 1, 0.25: in order -1, 0, 0.25, 0.5, 1
    reference = make_judgement("apg", settling=[3, 4, 2, 5, 9])
    controller = make_judgement("pid", settling=[3.5, 4, 1, 6, 9.25])
    found = difference(compare([reference, controller]), "position.settling_time")
    assert found.median == 0.25
    assert (found.better, found.worse, found.tied, found.left_out) == (1, 3, 1, 0)


def test_the_median_of_differences_is_not_the_difference_of_medians(make_judgement):
    # medians 2 and 2, yet the controller is 1 s later in two trials of three: differences 1, 1, -2
    found = difference(
        compare([make_judgement(settling=[1, 2, 3]), make_judgement(settling=[2, 3, 1])]), "position.settling_time"
    )
    assert found.median == 1.0


def test_a_trial_that_failed_is_infinitely_worse_and_two_that_failed_are_a_tie():
    controller = np.array([INFINITE, 1.0, INFINITE, 2.0, NOT_APPLICABLE, 1.0])
    reference = np.array([1.0, INFINITE, INFINITE, 2.5, 1.0, NOT_APPLICABLE])
    expected = [INFINITE, -INFINITE, 0.0, -0.5, NOT_APPLICABLE, NOT_APPLICABLE]
    assert paired_difference(controller, reference) == pytest.approx(expected, nan_ok=True)


def test_a_crash_counts_even_where_the_metric_does_not_apply_to_the_other():
    # the overshoot of a small step is left out, but a crash on that trial is a crash, as the judge has it
    assert paired_difference(np.array([INFINITE, NOT_APPLICABLE]), np.array([NOT_APPLICABLE, INFINITE])).tolist() == [
        INFINITE,
        -INFINITE,
    ]


@given(st.lists(st.tuples(*[st.one_of(st.floats(0, 100), st.sampled_from([INFINITE, NOT_APPLICABLE]))] * 2)))
def test_exchanging_the_two_controllers_turns_every_sign(pairs):
    one, other = np.array(pairs, dtype=float).reshape(-1, 2).T
    np.testing.assert_array_equal(paired_difference(one, other), -paired_difference(other, one))


def test_no_trial_disappears(make_judgement):
    controller = make_judgement(overshoot=[0.1, NOT_APPLICABLE, INFINITE, INFINITE, 0.0])
    reference = make_judgement(overshoot=[0.0, 0.1, INFINITE, 0.1, 0.0])
    found = difference(compare([reference, controller]), "position.overshoot")
    assert (found.better, found.worse, found.tied, found.left_out) == (0, 2, 2, 1)
    assert found.compared == 4


@pytest.mark.parametrize("sign", [1, -1])
def test_a_median_of_failures_is_infinite_on_the_side_of_the_one_that_failed(make_judgement, sign):
    settled, lost = make_judgement("a", settling=[1, 1, 1, 1, 1]), make_judgement("b", settling=[INFINITE] * 4 + [2])
    found = difference(compare([settled, lost][::sign]), "position.settling_time")
    assert found.median == sign * INFINITE
    assert found.to_dict()["median"] is None
    assert (found.worse, found.better)[::sign] == (5, 0)


def test_speed_and_action_of_a_crashed_trial_are_left_out_and_counted(make_judgement):
    calm = make_judgement("calm", peak_speed=np.array([0.5, 0.5, 0.5, 0.5, 0.5]))
    crashed = np.array([True, False, False, False, True])
    lost = make_judgement("lost", peak_speed=np.array([0.0, 0.7, 0.75, 0.8, 0.0]), crashed=crashed)
    found = difference(compare([calm, lost]), "peak_speed")
    assert found.median == pytest.approx(0.25)
    assert (found.better, found.worse, found.left_out) == (0, 3, 2)


def test_a_metric_that_applies_to_no_trial_has_neither_median_nor_interval(make_judgement):
    controllers = [make_judgement(name, overshoot=[NOT_APPLICABLE] * 3) for name in ("a", "b")]
    comparison = compare(controllers)
    told = difference(comparison, "position.overshoot").to_dict()
    assert (told["median"], told["low"], told["high"], told["left_out"]) == (None, None, None, 3)
    assert "    has no trial whose position overshoot can be compared with that of a" in comparison.table()


# --- the interval ---


def test_the_interval_of_nine_values_is_that_of_the_binomial_distribution():
    # the median of a resample is at most the k-th of nine if at least 5 of 9 draws are, each with chance k / 9:
    # k = 2: sum over i >= 5 of C(9, i) (2/9)^i (7/9)^(9-i) = 0.0304; k = 1: 0.0014; so low is the 2nd, high the 8th
    chance = [sum(math.comb(9, i) * (k / 9) ** i * (1 - k / 9) ** (9 - i) for i in range(5, 10)) for k in (1, 2, 7, 8)]
    assert chance == pytest.approx([0.0014, 0.0304, 0.9696, 0.9986], abs=1e-4)
    values = np.array([90, 10, 50, 30, 70, 20, 80, 40, 60], dtype=float)
    assert median_and_interval(values) == (50, 20, 80)


@pytest.mark.parametrize("number", [1, 2, 7, 40, 100])
def test_the_interval_is_that_of_bootstrap_draws(number):
    # places rather than values: 4,000 draws put a percentile within 0.0025 (one standard error) of its chance, and
    # one place of 100 is 0.014 of chance or more there, so that drawn and exact ends differ by one place at most
    values = np.arange(number, dtype=float)
    _, low, high = median_and_interval(values)
    assert (low, high) == pytest.approx(bootstrap_interval([values], number=4000), abs=1)


def test_the_interval_holds_the_true_median_as_often_as_it_says():
    # 1000 experiments of 50 trials: the coverage of a 95 % interval has a standard error of 0.007, and the percentile
    # bootstrap of a median is known to lie a little beside it (exactly: between the binomial tails at 1 or 2 places)
    generator = np.random.default_rng(0)
    held = 0
    for _ in range(1000):
        _, low, high = median_and_interval(generator.exponential(size=50) - math.log(2))  # true median 0
        held += low <= 0 <= high
    assert 0.92 <= held / 1000 <= 0.98


def test_infinities_keep_their_sign_at_both_ends():
    # the interval of nine spans the 2nd to the 8th value
    values = np.array([-INFINITE, -INFINITE, 1, 2, 3, 4, 5, INFINITE, INFINITE])
    assert median_and_interval(values) == (3, -INFINITE, INFINITE)
    assert median_and_interval(np.full(9, -INFINITE)) == (-INFINITE, -INFINITE, -INFINITE)


@given(st.lists(st.one_of(st.floats(-100, 100), st.sampled_from([-INFINITE, INFINITE])), min_size=1, max_size=60))
def test_the_median_lies_in_its_interval_and_all_three_were_measured(values):
    middle, low, high = median_and_interval(np.array(values))
    assert low <= middle <= high
    assert {middle, low, high} <= set(values)


# --- the comparison ---


def test_every_controller_but_the_reference_differs_from_it_in_every_metric(make_judgement):
    controllers = [make_judgement(name, settling=[time, time]) for name, time in (("a", 1), ("b", 3), ("c", 7))]
    comparison = compare(controllers, reference=1)
    assert comparison.names == ("a", "b", "c")
    assert [(one.name, one.metric) for one in comparison.differences] == [(w, m) for w in "ac" for m in METRICS]
    assert difference(comparison, "position.settling_time", "a").median == -2.0
    assert difference(comparison, "position.settling_time", "c").median == 4.0


def test_the_metrics_are_those_of_the_judgement_by_the_keys_of_its_dictionary(make_judgement):
    told = make_judgement().to_dict()
    told |= told["axes"]
    for metric in METRICS:
        assert metric.values(make_judgement(trials=3)).shape == (3,)
        table = told
        for key in metric.name.split("."):
            assert key in table
            table = table[key]


def test_each_metric_is_compared_by_its_own_values(make_judgement):
    # the k-th metric of the controller is k + 1 larger than that of the reference
    base = make_judgement("a", trials=3)
    changes = {}
    for index, metric in enumerate(METRICS):
        values = np.full(3, index + 1.0)
        if metric.channel:
            changes.setdefault(metric.field, dict(getattr(base, metric.field)))[metric.channel] = values
            getattr(base, metric.field)[metric.channel] = np.zeros(3)
        else:
            changes[metric.field] = values
    comparison = compare([base, dataclasses.replace(base, name="b", **changes)])
    assert [one.median for one in comparison.differences] == list(range(1, len(METRICS) + 1))


def test_the_dictionary_has_the_published_keys_and_is_json(make_judgement):
    comparison = compare([make_judgement("a"), make_judgement("b", settling=[INFINITE] * 5)])
    told = json.loads(json.dumps(comparison.to_dict(), allow_nan=False))
    assert list(told) == ["schema", "reference", "controllers", "differences"]
    assert (told["schema"], told["reference"]) == (1, "a")
    assert [controller["who"] for controller in told["controllers"]] == ["a", "b"]
    assert told["controllers"][0] == make_judgement("a").to_dict()
    assert told["differences"][0] == {
        "who": "b", "metric": "position.settling_time", "unit": "s", "median": None, "low": None, "high": None,
        "better": 0, "worse": 5, "tied": 0, "left_out": 0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("flown", "names"),
    [
        ([{}, {}, {}], ("pid", "pid (2)", "pid (3)")),
        ([{"simulator": "flytune"}, {"simulator": "mujoco"}], ("pid (flytune)", "pid (mujoco)")),
        ([{"simulator": "mujoco"}, {"simulator": "mujoco"}, {"name": "apg"}], ("pid", "pid (2)", "apg")),
        ([{}, {}, {"name": "pid (2)"}], ("pid", "pid (2)", "pid (2) (2)")),
        ([{"name": ""}, {"name": ""}], ("controller", "controller (2)")),
    ],
)
def test_controllers_of_one_name_are_told_apart(make_judgement, flown, names):
    comparison = compare([make_judgement(**{"name": "pid", **changes}) for changes in flown])
    assert comparison.names == names
    assert {one.name for one in comparison.differences} == set(names[1:])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"trials": 6}, "trials: 5 for apg and 6 for pid is not allowed. Allowed: the same for every controller."),
        ({"seed": 2}, "seed: 1 for apg and 2 for pid"),
        ({"task": "acrobatic"}, "task: baseline for apg and acrobatic for pid"),
        ({"initial_conditions": "paper"}, "starts: clear for apg and paper for pid"),
        ({"duration": 20.0}, "duration: 10.0 s for apg and 20.0 s for pid"),
    ],
)
def test_trials_that_are_not_the_same_are_refused_in_one_line_that_says_what_differs(make_judgement, change, says):
    with pytest.raises(BadInput) as error:
        compare([make_judgement("apg"), make_judgement("lqr"), make_judgement("pid", **change)])
    assert says in str(error.value)
    assert f"--{says.partition(':')[0]}" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("number", [0, 1])
def test_fewer_than_two_controllers_are_refused(make_judgement, number):
    with pytest.raises(BadInput, match=r"^compare: .* Allowed: two or more"):
        compare([make_judgement()] * number)


@pytest.mark.parametrize("reference", [-1, 2])
def test_a_reference_that_is_no_controller_is_refused(make_judgement, reference):
    with pytest.raises(BadInput, match=r"^reference: -?\d is not allowed"):
        compare([make_judgement(), make_judgement()], reference=reference)


# --- the table ---


def test_the_table_says_the_difference_in_plain_words(make_judgement):
    # 20 trials, 17 of them 0.42 s later, 2 of them 0.1 s earlier, one equal
    times = np.full(20, 4.0)
    later = times + np.array([0.42] * 17 + [-0.1] * 2 + [0.0])
    table = compare([make_judgement("apg", settling=times), make_judgement("pid", settling=later)]).table()
    assert "pid settles 0.42 s later than apg (95 % interval 0.42 to 0.42), later in 17 of 20 trials, " in table
    assert "earlier in 2, equal in 1" in table
    back = compare([make_judgement("pid", settling=later), make_judgement("apg", settling=times)]).table()
    assert "apg settles 0.42 s earlier than pid (95 % interval 0.42 to 0.42), earlier in 17 of 20 trials, " in back


def test_an_interval_below_zero_is_told_from_its_smaller_to_its_larger_end(make_judgement):
    # differences -9 to -1: the median is -5, the ends are the 2nd and the 8th, -8 and -2
    controllers = [
        make_judgement("apg", settling=np.full(9, 10.0)),
        make_judgement("pid", settling=10 - np.arange(1.0, 10)),
    ]
    told = str(compare(controllers))
    assert "pid settles 5.00 s earlier than apg (95 % interval 2.00 to 8.00), earlier in 9 of 9 trials" in told


def test_an_interval_that_holds_zero_says_both_ways(make_judgement):
    # differences -4 to 4 in nine trials but for 0: the median is 0.5, the ends are the 2nd and the 8th
    late = np.array([-4, -3, -2, -1, 0.5, 1, 2, 3, 4])
    controllers = [make_judgement("apg", settling=np.full(9, 5.0)), make_judgement("pid", settling=5 + late)]
    assert "pid settles 0.50 s later than apg (95 % interval 3.00 earlier to 3.00 later), later in 5" in str(
        compare(controllers)
    )


def test_a_controller_that_leaves_unsettled_what_the_other_settles_is_said_not_to_settle(make_judgement):
    controllers = [make_judgement("apg", settling=[1.0] * 9), make_judgement("pid", settling=[INFINITE] * 9)]
    assert "pid does not settle where apg settles, later in 9 of 9 trials" in str(compare(controllers))
    assert "apg settles where pid does not settle, earlier in 9 of 9 trials" in str(compare(controllers[::-1]))


def test_an_interval_with_one_number_says_where_it_begins_or_ends(make_judgement):
    settled = np.full(9, 5.0)
    mostly = np.array([5.5, 6, 6.5, 7, 7.5, *[INFINITE] * 4])  # median 2.5 s later; interval from the second one on
    told = str(compare([make_judgement("apg", settling=settled), make_judgement("pid", settling=mostly)]))
    assert "pid settles 2.50 s later than apg (95 % interval from 1.00 on), later in 9 of 9 trials" in told
    hardly = np.array([4.5, 6, 6.5, 7, *[INFINITE] * 5])
    told = str(compare([make_judgement("apg", settling=settled), make_judgement("pid", settling=hardly)]))
    assert "pid does not settle where apg settles (95 % interval from 1.00 on), later in 8 of 9 trials, earlier" in told
    told = str(compare([make_judgement("pid", settling=hardly), make_judgement("apg", settling=settled)]))
    assert "apg settles where pid does not settle (95 % interval from 1.00 on), earlier in 8 of 9 trials, later" in told


def test_two_controllers_that_both_fail_are_not_said_to_be_equal(make_judgement):
    lost = [make_judgement(name, settling=[INFINITE] * 9) for name in ("apg", "pid")]
    assert "pid and apg: neither settles in 9 of 9 trials" in str(compare(lost))
    errors = dict.fromkeys(lost[0].steady_state_error, np.full(9, INFINITE))
    crashed = [dataclasses.replace(each, steady_state_error=errors) for each in lost]
    assert "    both crash in 9 of 9 trials" in str(compare(crashed))
    half = [make_judgement(name, settling=[INFINITE] * 4 + [time] * 5) for name, time in (("apg", 1.0), ("pid", 2.0))]
    assert "pid settles 1.00 s later than apg (95 % interval 0 to 1.00), later in 5 of 9 trials, neither in 4" in str(
        compare(half)
    )


def test_equal_controllers_are_said_to_be_equal(make_judgement):
    table = compare([make_judgement("apg"), make_judgement("pid")]).table()
    assert "pid settles as early as apg (95 % interval 0 to 0), later in 0 of 5 trials, equal in 5" in table


def test_the_table_has_a_row_per_controller_under_the_conditions_they_share(make_judgement):
    lost = np.array([True, False, False, False, False])
    long = "runs/" + "x" * 60
    table = compare([make_judgement("apg"), make_judgement(long, crashed=lost, violated={"speed": ~lost})]).table()
    lines = table.splitlines()
    assert lines[0] == (
        "2 controllers over the same 5 trials of 10 s, starts clear, seed 1; world flytune; task baseline; "
        "vehicle crazyflie"
    )
    assert lines[4].split() == [
        "apg",
        *["5"] * 5,
        "0.00",
        "0.00",
        "-",
        "0.0",
        "0.00",
        "0.00",
        "0.000",
        "0.0000",
        "0",
        "0",
    ]
    assert lines[5].split()[-2:] == ["4", "1"]
    assert lines[5].startswith("…x")
    assert len(lines[4]) == len(lines[5]) == len(lines[3])


def test_the_table_says_who_flew_where_if_that_differs(make_judgement):
    table = compare([make_judgement("a", simulator="flytune"), make_judgement("b", simulator="mujoco")]).table()
    assert "world flytune (a), mujoco (b); task baseline;" in table.splitlines()[0]


def test_another_vehicle_is_refused_with_the_option_that_gives_all_the_same(make_judgement):
    with pytest.raises(
        BadInput, match=r"^vehicle: crazyflie for a and big for b .* Fly all of them with one --task\.$"
    ):
        compare([make_judgement("a"), make_judgement("b", vehicle="big")])
