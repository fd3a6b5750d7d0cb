"""The start of a tuning: the known policy that settles nearest, on a task with the user's fields."""

import math

import pytest

from flytune.errors import BadInput
from flytune.task.files import load_task
from flytune.tuning.asked import make_requirement
from flytune.tuning.start import find_start

BOUND = {"termination.altitude.bound": 0.09}  # a field that all known tasks have


@pytest.mark.parametrize("time", [2.3, 4.0, 9.0])
def test_a_requirement_that_the_dial_covers_starts_with_a_policy_that_meets_it(time):
    start = find_start(make_requirement(time), None, {}, "apg")
    assert (start.name, list(start.times)) == ("dial", ["dial"])
    assert start.times["dial"] == pytest.approx(time, rel=0.05)  # the training set allows half of the tolerance
    assert start.policy is not None
    assert start.policy.actor.sizes == (17, 64, 64, 4)  # without its dial
    assert not start.task.dial
    assert start.task.speed_bound == pytest.approx(start.setting["speed"])
    assert start.judgement is not None
    assert (start.judgement.trials, start.judgement.duration >= 2.5 * time) == (100, True)


@pytest.mark.slow
@pytest.mark.parametrize(("time", "name"), [(1.5, "dial"), (14.0, "dial"), (3.0, "baseline-refined")])
def test_elsewhere_it_is_the_known_task_that_settles_nearest(time, name):
    # a bound on speed cannot be set in the task with a dial, which the bound follows
    edits = {} if name == "dial" else {"termination.speed.bound": 0.8}
    start = find_start(make_requirement(time), None, edits, "apg")
    assert start.name == name
    nearness = {other: abs(math.log(seconds / time)) for other, seconds in start.times.items()}
    assert min(nearness, key=nearness.__getitem__) == name
    assert len(nearness) == (4 if name == "dial" else 3)


def test_a_field_of_the_user_that_does_not_follow_the_dial_is_kept():
    start = find_start(make_requirement(4), None, BOUND, "apg")
    assert start.name == "dial"
    assert start.task.termination["altitude"].bound == 0.09


def test_a_known_task_without_the_users_field_is_left_out():
    start = find_start(make_requirement(9), None, {"termination.tilt.bound_deg": 20.0}, "apg")
    assert "baseline-refined" not in start.times
    assert start.task.termination["tilt"].bound_deg == 20.0


def test_a_field_that_no_known_task_has_is_refused():
    with pytest.raises(BadInput, match=r"Did you mean reward\.velocity\.weight"):
        find_start(make_requirement(3), None, {"reward.velocity.wieght": 0.2}, "apg")


def test_a_task_without_a_known_policy_is_trained_from_new_weights():
    start = find_start(make_requirement(3), "baseline", {}, "apg")
    assert (start.name, start.policy) == ("baseline", None)
    # the first training uses the settings of the task, a warm start those of the tuning
    assert (start.first.apg.learning_rate, start.task.apg.learning_rate) == (0.005, 0.002)


def test_a_known_policy_with_other_layers_than_the_user_wants_is_not_used():
    assert find_start(make_requirement(3), "baseline-refined", {"apg.hidden": [32, 32]}, "apg").policy is None


def test_ppo_starts_from_a_policy_that_ppo_has_trained():
    start = find_start(make_requirement(4), None, {}, "ppo")
    assert start.record is not None
    assert start.record.stem.endswith("@ppo")
    # the settings of the other trainer stay as they are
    assert start.task.apg == load_task(start.name).apg


def test_episodes_grow_by_doubling_and_what_the_user_has_set_stays():
    assert find_start(make_requirement(3), "baseline-refined", {}, "apg").task.horizon == 500
    for time in (3.5, 5.0, 6.5):
        assert find_start(make_requirement(time), "baseline-refined", {}, "apg").task.horizon == 1000
    fixed = find_start(make_requirement(5), "baseline-refined", {"horizon": 700, "apg.updates": 77}, "apg").task
    assert (fixed.horizon, fixed.apg.updates) == (700, 77)
    assert fixed.sources["apg.updates"] == "set by the user"


def test_the_task_with_a_dial_is_tuned_by_its_dial_and_another_with_a_dial_is_refused(tmp_path):
    assert find_start(make_requirement(4), "dial", {}, "apg").name == "dial"
    (tmp_path / "mine.toml").write_text('based_on = "dial"\n[dial.speed]\nhighest = 1.2\n')
    with pytest.raises(BadInput, match=r"mine\.toml has a dial"):
        find_start(make_requirement(4), str(tmp_path / "mine.toml"), {}, "apg")


def test_a_requirement_that_a_bound_of_the_user_forbids_is_refused_though_the_dial_would_meet_it():
    # the dial turns the yaw in 0.27 s, but at 100 deg/s the median trial takes longer
    edits = {"termination.body_rate.bound_deg_per_s": 100.0}
    with pytest.raises(BadInput, match="the body rate bound of 100 deg/s you have set"):
        find_start(make_requirement(0.4, axis="yaw", at_most=True), None, edits, "apg")
    assert find_start(make_requirement(0.4, axis="yaw", at_most=True), None, {}, "apg").name == "dial"


def test_a_bound_of_the_user_that_the_dial_breaks_lets_the_other_policies_be_tried():
    edits = {"termination.body_rate.bound_deg_per_s": 150.0}
    assert len(find_start(make_requirement(4), None, edits, "apg").times) > 1


def test_the_dial_is_set_within_the_range_that_the_user_gives():
    start = find_start(make_requirement(2.2), None, {"dial.speed.highest": 1.0}, "apg")
    assert start.setting["speed"] <= 1.0


@pytest.mark.parametrize(
    ("edits", "field", "weights"),
    [
        # the known policies fly another vehicle
        ({"vehicle": "crazyflie-measured"}, "vehicle.", "new"),
        ({"vehicle.mass": 0.04, "reward.velocity.weight": 0.2}, "vehicle.mass", "new"),
        # a policy that meets the requirement, but was not trained with the reward that is wanted
        ({"reward.velocity.weight": 0.2}, "reward.velocity.weight", "known"),
        # a bound that the known policies break
        ({"termination.body_rate.bound_deg_per_s": 150.0}, "termination.body_rate", "known"),
    ],
)
def test_a_policy_of_another_task_is_not_edited_but_the_task_is_trained_first(edits, field, weights):
    start = find_start(make_requirement(3), None, edits, "apg")
    assert start.policy is None
    assert start.trained_for.startswith(field)
    assert (start.initial is None) == (weights == "new")


def test_a_policy_of_another_vehicle_is_used_where_it_meets_the_requirement_there():
    start = find_start(make_requirement(3), None, {"vehicle": "crazyflie-km794"}, "apg")
    assert start.policy is not None
    assert start.task.vehicle.name == "crazyflie-km794"
