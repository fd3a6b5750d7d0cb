"""Messages of a tuning: numbers with their units, an edit with its reason, and its result."""

import dataclasses
import math

import pytest

from flytune.tuning.asked import make_requirement
from flytune.tuning.iteration import HALF_WAY, Edit, Iteration
from flytune.tuning.messages import describe, describe_edit, describe_iteration, describe_miss, describe_target
from flytune.tuning.requirement import ResponseSummary

WANTED = make_requirement(6.0)
BEFORE = ResponseSummary(settling_time=10.6, overshoot=0.0, error=0.0008, settled=0.88, constraints_satisfied=1.0)
AFTER = ResponseSummary(settling_time=7.42, overshoot=0.012, error=0.0013, settled=1.0, constraints_satisfied=1.0)
SECOND = Edit(
    rule="H6 faster", source="paper H6", reason="", symptom="too slow", field="reward.velocity.weight", before=0.1,
    after=0.05, unit="", expected=10.31, slope=0.04, known_from="sensitivity",
    between=(0.05, 0.1), gain=0.1,
)  # fmt: skip
EDIT = Edit(
    rule="H7 faster", source="paper H7", reason="a higher speed bound lets the vehicle fly faster", symptom="too slow",
    field="termination.speed.bound", before=0.2, after=0.304, unit="m/s", expected=5.99, slope=-1.36,
    known_from="sensitivity", between=(0.3, 0.5), gain=1.0,
    next_best=SECOND,
)  # fmt: skip


def test_an_edit_names_its_symptom_its_size_its_prediction_and_its_reason():
    assert describe_edit(EDIT) == (
        "too slow: termination.speed.bound 0.2 -> 0.304 m/s, expected settling time 5.99 s (settling time ~ "
        "bound^-1.4, sensitivity measured from 0.3 to 0.5, extrapolated). H7 faster: a higher speed bound lets the "
        "vehicle fly faster. Next best: reward.velocity.weight 0.1 -> 0.05, expected settling time 10.31 s (H6 faster)"
    )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"known_from": "iterations"}, "(settling time ~ bound^-1.4, from the iterations at 0.3 and 0.5)"),
        ({"known_from": "rule", "between": None}, "(settling time ~ bound^-1.4, assumed by the rule, not measured)"),
        (
            {"known_from": "interpolation"},
            "(interpolated between the iterations at 0.3 and 0.5, of which one is too slow",
        ),
        ({"expected": None, "symptom": "unsettled"}, "0.304 m/s (the effect cannot be predicted; this is the largest"),
        (
            {"expected": None, "rule": HALF_WAY},
            "the last edit was too large: termination.speed.bound 0.2 -> 0.304 m/s (half",
        ),
        ({"before": 0.3}, "sensitivity measured from 0.3 to 0.5). H7"),
        ({"unit": "1/unit(e)^2"}, "0.2 -> 0.304, expected"),
        ({"symptom": "inaccurate", "expected": 0.002}, "expected error 2.00 mm (error ~ bound"),
        ({"source": "flytune: docs"}, "fly faster (flytune: docs). Next"),
    ],
    ids=["iterations", "rule", "interpolation", "no-number", "half-way", "inside", "no-unit", "error", "source"],
)
def test_an_edit_names_the_origin_of_its_size(changes, said):
    assert said in describe_edit(dataclasses.replace(EDIT, **changes))


def test_the_requirement_on_the_training_set_is_told_in_numbers():
    assert describe_target(WANTED.tightened(), 100, 15.0) == (
        "100 trials of 15 s; required there: 5.70 to 6.30 s, overshoot at most 4.0 %, error at most 8.00 mm. A trial "
        "has settled if it stays within 2 cm until its end; a trial that has not counts as infinitely slow"
    )
    assert "required there: at most 2.00 s, " in describe_target(
        make_requirement(2.0, at_most=True, axis="yaw"), 100, 10.0
    )


def test_an_iteration_is_told_beside_the_one_before_and_the_prediction():
    iteration = Iteration(number=1, values={}, reasons={}, edit=EDIT, parent=0, response=AFTER, trials=100, seconds=1.0)
    assert describe_iteration(iteration, BEFORE, WANTED) == (
        "settles in 7.42 s (was 10.60 s, expected 5.99 s), overshoot 1.2 %, error 1.30 mm, 100.0 % settled; "
        "not met: 24 % too slow for 6 s"
    )


def test_every_axis_that_is_asked_for_is_told_and_the_note_stands_behind_the_one_that_counts():
    wanted = make_requirement(6.0, axis=["position", "yaw"])
    each = {
        "settling_time": {"position": 5.9, "yaw": 7.42},
        "overshoot": {"position": 0.01, "yaw": 0.0},
        "error": {"position": 0.0013, "yaw": math.radians(0.5)},
    }
    response = dataclasses.replace(AFTER, axes={"settling_time": "yaw"}, each=each)
    assert describe(response, wanted, {"settling_time": " (was 8.00 s)"}) == (
        "settles in 5.90 s (position), 7.42 s (yaw) (was 8.00 s), overshoot 1.0 % (position), 0.0 % (yaw), error "
        "1.30 mm (position), 0.50 deg (yaw), 100.0 % settled"
    )
    never = {"position": 5.9, "yaw": math.inf}
    response = dataclasses.replace(response, settling_time=math.inf, each={**each, "settling_time": never})
    assert describe(response, wanted).startswith("settles in 5.90 s (position), never (yaw), ")
    never = {"position": math.inf, "yaw": math.inf}
    response = dataclasses.replace(response, each={**each, "settling_time": never})
    assert describe(response, wanted).startswith("does not settle, ")


def test_constraints_of_the_user_are_always_told():
    assert describe(AFTER, WANTED, bounds=True).endswith("100.0 % settled, your constraints are satisfied in 100.0 %")


def test_a_response_is_told_with_every_measure():
    lame = dataclasses.replace(BEFORE, settling_time=math.inf, error=math.radians(1), constraints_satisfied=0.9)
    assert describe(lame, make_requirement(1.0, axis="yaw")) == (
        "does not settle, overshoot 0.0 %, error 1.00 deg, 88.0 % settled, your constraints are satisfied in 90.0 %"
    )


@pytest.mark.parametrize(
    ("response", "said"),
    [
        ({"settling_time": 7.5}, "25 % too slow for 6 s"),
        ({"settling_time": 3.0}, "50 % too fast for 6 s"),
        ({"settling_time": math.inf}, "far too slow for 6 s"),
        ({"settled": 0.97}, "only 97.0 % of the trials settle"),
        ({"constraints_satisfied": 0.5}, "only 50.0 % of the trials satisfy your constraints"),
        ({"overshoot": 0.06}, "overshoot above 5.0 %"),
        ({"error": 0.02}, "error above 10.00 mm"),
    ],
)
def test_a_miss_is_told_with_the_required_number(response, said):
    good = ResponseSummary(settling_time=6.0, overshoot=0.0, error=0.001, settled=1.0, constraints_satisfied=1.0)
    ((name, size),) = WANTED.misses(dataclasses.replace(good, **response)).items()
    assert describe_miss(name, size, WANTED) == said
