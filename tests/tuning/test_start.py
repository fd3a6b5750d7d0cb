"""The start of a tuning: the known policy that settles nearest, on a task with the user's fields."""

import math

import pytest

from flytune.errors import BadInput
from flytune.task.task import load_task
from flytune.tuning.requirement import make_requirement
from flytune.tuning.start import find_start


@pytest.mark.parametrize(
    ("time", "name"), [(2.0, "acrobatic-refined"), (3.0, "baseline-refined"), (9.0, "inspection-refined")]
)
def test_it_is_the_known_task_that_settles_nearest(time, name):
    start = find_start(make_requirement(time), None, {}, "apg")
    assert start.name == name
    nearness = {other: abs(math.log(seconds / time)) for other, seconds in start.times.items()}
    assert min(nearness, key=nearness.__getitem__) == name
    assert len(nearness) == 3
    assert start.judgement is not None
    assert start.judgement.trials == 100
    assert start.judgement.duration >= 2.5 * time


def test_a_known_task_without_the_users_field_is_left_out():
    start = find_start(make_requirement(9), None, {"termination.tilt.bound_deg": 20.0}, "apg")
    assert list(start.times) == ["inspection-refined"]
    assert start.task.termination["tilt"].bound_deg == 20.0


def test_a_field_that_no_known_task_has_is_refused():
    with pytest.raises(BadInput, match=r"Did you mean reward\.velocity\.weight"):
        find_start(make_requirement(3), None, {"reward.velocity.wieght": 0.2}, "apg")


def test_a_task_without_a_known_policy_is_trained_from_new_weights():
    start = find_start(make_requirement(3), "baseline", {}, "apg")
    assert (start.name, start.files) == ("baseline", None)
    # the first training uses the settings of the task, a warm start those of the tuning
    assert (start.first.apg.learning_rate, start.task.apg.learning_rate) == (0.005, 0.002)


def test_a_known_policy_with_other_layers_than_the_user_wants_is_not_used():
    assert find_start(make_requirement(3), "baseline-refined", {"apg.hidden": [32, 32]}, "apg").files is None


def test_ppo_starts_from_a_policy_that_ppo_has_trained():
    start = find_start(make_requirement(4), None, {}, "ppo")
    assert start.files is not None
    assert start.files[0].stem.endswith("@ppo")
    # the settings of the other trainer stay as they are
    assert start.task.apg == load_task(start.name).apg


def test_episodes_grow_by_doubling_and_what_the_user_has_set_stays():
    assert find_start(make_requirement(3), "baseline-refined", {}, "apg").task.horizon == 500
    for time in (3.5, 5.0, 6.5):
        assert find_start(make_requirement(time), "baseline-refined", {}, "apg").task.horizon == 1000
    fixed = find_start(make_requirement(5), "baseline-refined", {"horizon": 700, "apg.updates": 77}, "apg").task
    assert (fixed.horizon, fixed.apg.updates) == (700, 77)
    assert fixed.sources["apg.updates"] == "set by the user"
