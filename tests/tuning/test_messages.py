"""What a tuning says: numbers with their units, an edit with its reason, and what it did."""

import dataclasses
import math

import pytest

from flytune.tuning.iteration import HALF_WAY, Edit, Step
from flytune.tuning.messages import describe, describe_edit, describe_miss, describe_step, describe_targets
from flytune.tuning.requirement import Measured, make_requirement

WANTED = make_requirement(6.0)
BEFORE = Measured(settling_time=10.6, overshoot=0.0, error=0.0008, settled=0.88, kept=1.0)
AFTER = Measured(settling_time=7.42, overshoot=0.012, error=0.0013, settled=1.0, kept=1.0)
SECOND = Edit(
    rule="H6 faster", source="paper H6", says="", condition="too slow", field="reward.velocity.weight", before=0.1,
    after=0.05, unit="", expects=10.31, slope=0.04, known_from="map",
    ends=(0.05, 0.1), gain=0.1,
)  # fmt: skip
EDIT = Edit(
    rule="H7 faster", source="paper H7", says="a higher speed bound shortens the cruise", condition="too slow",
    field="termination.speed.bound", before=0.2, after=0.304, unit="m/s", expects=5.99, slope=-1.36,
    known_from="map", ends=(0.3, 0.5), gain=1.0,
    second=SECOND,
)  # fmt: skip


def test_an_edit_says_what_is_missing_what_is_edited_what_is_expected_and_why():
    assert describe_edit(EDIT, WANTED) == (
        "too slow: termination.speed.bound 0.2 -> 0.304 m/s, expects settling time 5.99 s (settling time ~ bound^-1.4 "
        "between 0.3 and 0.5 of the effect map, extrapolated). H7 faster: a higher speed bound shortens the cruise. "
        "Next best: reward.velocity.weight 0.1 -> 0.05, expects settling time 10.31 s (H6 faster)"
    )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"known_from": "flown"}, "(settling time ~ bound^-1.4 in the steps at 0.3 and 0.5)"),
        ({"known_from": "rule", "ends": None}, "(settling time ~ bound^-1.4, the rule's own guess, not measured)"),
        ({"known_from": "between"}, "(false position between the steps at 0.3 and 0.5, one too slow and one too fast)"),
        ({"expects": None, "condition": "unsettled"}, "0.304 m/s (no number can be promised: the rule's largest step)"),
        ({"expects": None, "rule": HALF_WAY}, "too far: termination.speed.bound 0.2 -> 0.304 m/s (half-way back"),
        ({"before": 0.3}, "between 0.3 and 0.5 of the effect map). H7"),
        ({"unit": "1/unit(e)^2"}, "0.2 -> 0.304, expects"),
        ({"condition": "inexact", "expects": 0.002}, "expects error 2.00 mm (error ~ bound"),
        ({"source": "flytune: docs"}, "shortens the cruise (flytune: docs). Next"),
    ],
    ids=["flown", "rule", "between", "no-number", "half-way", "inside", "no-unit", "error", "source"],
)
def test_an_edit_says_where_its_size_comes_from(changes, said):
    assert said in describe_edit(dataclasses.replace(EDIT, **changes), WANTED)


def test_the_targets_on_the_tuning_starts_are_numbers():
    assert describe_targets(WANTED.narrowed(), 100, 15.0) == (
        "5.70 to 6.30 s, overshoot at most 4.0 %, error at most 8.00 mm in 100 trials of 15 s; settled is within 2 cm "
        "to the end, a trial that does not settle counts as infinitely slow"
    )
    assert describe_targets(make_requirement(2.0, at_most=True, axis="yaw"), 100, 10.0).startswith("at most 2.00 s, ")


def test_a_step_says_what_it_was_and_what_was_expected_beside_what_it_is():
    step = Step(number=1, values={}, reasons={}, edit=EDIT, origin=0, measured=AFTER, looks=1, seconds=1.0)
    assert describe_step(step, BEFORE, WANTED) == (
        "settles in 7.42 s (was 10.60 s, expected 5.99 s), overshoot 1.2 %, error 1.30 mm, 100.0 % settled; "
        "missing: 24 % too slow for 6 s"
    )


def test_bounds_the_user_has_set_are_always_told():
    assert describe(AFTER, WANTED, bounds=True).endswith("100.0 % settled, your bounds kept in 100.0 %")


def test_a_response_says_all_that_is_asked_of_it():
    lame = dataclasses.replace(BEFORE, settling_time=math.inf, error=math.radians(1), kept=0.9)
    assert describe(lame, make_requirement(1.0, axis="yaw")) == (
        "does not settle, overshoot 0.0 %, error 1.00 deg, 88.0 % settled, your bounds kept in 90.0 %"
    )


@pytest.mark.parametrize(
    ("measured", "said"),
    [
        ({"settling_time": 7.5}, "25 % too slow for 6 s"),
        ({"settling_time": 3.0}, "50 % too fast for 6 s"),
        ({"settling_time": math.inf}, "far too slow for 6 s"),
        ({"settled": 0.97}, "only 97.0 % settle"),
        ({"kept": 0.5}, "only 50.0 % keep the bounds you have set"),
        ({"overshoot": 0.06}, "overshoot above 5.0 %"),
        ({"error": 0.02}, "error above 10.00 mm"),
    ],
)
def test_what_is_missing_is_said_with_the_number_that_is_asked(measured, said):
    good = Measured(settling_time=6.0, overshoot=0.0, error=0.001, settled=1.0, kept=1.0)
    ((name, size),) = WANTED.misses(dataclasses.replace(good, **measured)).items()
    assert describe_miss(name, size, WANTED) == said
