"""What a tuning says: numbers with their units, an edit with its reason, and what it did."""

import dataclasses
import math

import pytest

from flytune.tune.requirement import Measured, make_requirement
from flytune.tune.step import HALF_WAY, Edit, Step
from flytune.tune.words import describe, describe_edit, describe_miss, describe_step

WANTED = make_requirement(6.0)
BEFORE = Measured(settling_time=10.6, overshoot=0.0, error=0.0008, settled=0.88, kept=1.0)
AFTER = Measured(settling_time=7.42, overshoot=0.012, error=0.0013, settled=1.0, kept=1.0)
SECOND = Edit(
    rule="H6 faster", source="paper H6", says="", condition="too slow", field="reward.velocity.weight", before=0.1,
    after=0.05, unit="", expects=10.31, slope=0.04, known_from="map", gain=0.1,
)  # fmt: skip
EDIT = Edit(
    rule="H7 faster", source="paper H7", says="a higher speed bound shortens the cruise", condition="too slow",
    field="termination.speed.bound", before=0.2, after=0.304, unit="m/s", expects=5.99, slope=-1.36,
    known_from="map", gain=1.0,
    second=SECOND,
)  # fmt: skip


def test_an_edit_says_what_is_missing_what_is_edited_what_is_expected_and_why():
    assert describe_edit(EDIT, WANTED) == (
        "too slow: termination.speed.bound 0.2 -> 0.304 m/s, expects settling time 5.99 s (effect map: settling time "
        "goes as the field to the power -1.4). H7 faster: a higher speed bound shortens the cruise (paper H7). "
        "Next best: H6 faster, reward.velocity.weight 0.1 -> 0.05, expects settling time 10.31 s"
    )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"known_from": "flown"}, "(steps so far: settling time goes as the field to the power -1.4)"),
        ({"known_from": "rule"}, "(the rule's own guess: settling time goes"),
        ({"known_from": "between"}, "(between the steps on both sides)"),
        ({"expects": None, "condition": "unsettled"}, "0.304 m/s (the rule's largest step)."),
        ({"expects": None, "rule": HALF_WAY}, "too far: termination.speed.bound 0.2 -> 0.304 m/s (half of the last"),
        ({"unit": "1/unit(e)^2"}, "0.2 -> 0.304, expects"),
        ({"condition": "inexact", "expects": 0.002}, "expects error 2.0 mm (effect map: error goes"),
    ],
)
def test_an_edit_says_where_its_size_comes_from(changes, said):
    assert said in describe_edit(dataclasses.replace(EDIT, **changes), WANTED)


def test_a_step_says_what_it_was_and_what_was_expected_beside_what_it_is():
    step = Step(number=1, values={}, reasons={}, edit=EDIT, origin=0, measured=AFTER, looks=1, seconds=1.0)
    assert describe_step(step, BEFORE, WANTED) == (
        "settles in 7.42 s (was 10.60 s, expected 5.99 s), overshoot 1.2 %, error 1.3 mm, 100.0 % settled; "
        "missing: 24 % too slow for 6 s"
    )


def test_a_response_says_all_that_is_asked_of_it():
    lame = dataclasses.replace(BEFORE, settling_time=math.inf, error=math.radians(1), kept=0.9)
    assert describe(lame, make_requirement(1.0, axis="yaw")) == (
        "does not settle, overshoot 0.0 %, error 1.00 deg, 88.0 % settled, own bounds kept in 90.0 %"
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
        ({"error": 0.02}, "error above 10.0 mm"),
    ],
)
def test_what_is_missing_is_said_with_the_number_that_is_asked(measured, said):
    good = Measured(settling_time=6.0, overshoot=0.0, error=0.001, settled=1.0, kept=1.0)
    ((name, size),) = WANTED.misses(dataclasses.replace(good, **measured)).items()
    assert describe_miss(name, size, WANTED) == said


def test_on_the_tuning_starts_the_bound_is_that_of_the_tuning_starts():
    assert describe_miss("error", 0.1, WANTED, 0.5) == "error above 5.0 mm"
