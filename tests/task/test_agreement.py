"""Tasks whose episodes would all end as they begin are refused with the numbers, before a training."""

import dataclasses
import math

import pytest

from flytune.errors import BadInput
from flytune.task.agreement import check_starts
from flytune.task.files import load_task, preset_names
from flytune.task.initial_state import EVALUATION_INITIAL_STATES
from flytune.training.loop import train
from flytune.training.trainer import TRAINERS, find_trainer
from flytune.tuning.tune import tune

TILT = {"kind": "maximum_tilt"}


def refusal(edits, trainer="ppo"):
    """The line that a trainer refuses the edited baseline with."""
    with pytest.raises(BadInput) as caught:
        find_trainer(trainer).check(load_task("baseline", edits))
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize("preset", preset_names())
@pytest.mark.parametrize("trainer", ["apg", "ppo"])
def test_every_preset_can_be_trained(preset, trainer):
    find_trainer(trainer).check(load_task(preset))


@pytest.mark.parametrize("trainer", ["apg", "ppo"])
@pytest.mark.parametrize(
    "position", [[20.0, 0.0, 1.0], [0.0, 0.0, 0.3], [-400.0, 100.0, 120.0], [0.0, 0.0, 0.11]], ids=str
)
def test_a_target_anywhere_above_its_altitude_bound_can_be_trained(position, trainer):
    find_trainer(trainer).check(load_task("baseline", {"target.position": position}))


@pytest.mark.parametrize(
    ("edits", "start", "numbers"),
    [
        # the corners of the box are 1 m, 1 m and 1 m away: 1.73 m
        ({"termination.distance.bound": 0.05}, "termination.distance.bound: 0.05 m ends every episode", "1.6"),
        ({"termination.attitude.bound": 0.02}, "termination.attitude.bound: 0.02 rad ends ", "3.14 rad"),
        # 0.2 rad are 11.5 deg, 0.26 rad are 14.9 deg
        ({"termination.tilt": TILT | {"bound_deg": 0.26}}, "termination.tilt.bound_deg: 0.26 deg", "rad, write 14.9"),
        ({"termination.altitude.bound": 1.5}, "termination.altitude.bound: 1.5 m is not below the target", "1 m high"),
        ({"target.position": [0.0, 0.0, 0.05]}, "termination.altitude.bound: 0.1 m is not below", "0.05 m high"),
        # g sin(0.2) 0.01 s = 0.02 m/s after the first control period
        ({"termination.speed.bound": 0.0005}, "termination.speed.bound: 0.0005 m/s ends ", "m/s before the vehicle"),
        # 200 ms without an answer: g sin(0.2) 0.21 s = 0.4 m/s
        ({"termination.speed.bound": 0.05, "vehicle.action_latency_steps": 20}, "termination.speed.bound: 0.05", ""),
        ({"initial_state.lowest_position": [5.0, 5.0, 1.0], "initial_state.highest_position": [6.0, 6.0, 1.0]},
         "termination.distance.bound: 3 m ends every episode", "lie 7.09 to 8.45 m"),
        ({"initial_state.lowest_altitude": 7.0}, "initial_state.lowest_altitude: 7 m lies above all starts", "2 m"),
    ],
)  # fmt: skip
def test_a_task_whose_episodes_all_end_at_once_is_refused_with_the_numbers(edits, start, numbers):
    text = refusal(edits)
    assert text.startswith(start) and numbers in text


def test_the_remedy_of_a_refusal_works():
    text = refusal({"termination.distance.bound": 0.05})
    bound = float(text.split("Give a bound of at least ")[1].split()[0])
    find_trainer("ppo").check(load_task("baseline", {"termination.distance.bound": bound}))


def test_a_trainer_with_starts_of_its_own_is_judged_by_them():
    far = {"apg.initial_state.lowest_position": [5.0, 5.0, 1.0], "apg.initial_state.highest_position": [6.0, 6.0, 1.0]}
    find_trainer("ppo").check(load_task("baseline", far))
    assert "[apg.initial_state] lie 7.0" in refusal(far, "apg")
    find_trainer("apg").check(load_task("baseline", far | {"apg.termination_slack": 2.0}))  # 3 m and 6 m more


def test_a_task_with_a_dial_is_refused_where_one_of_its_settings_cannot_be_learned():
    edits = {"follow.termination.speed.bound": "0.0001 * speed"}
    with pytest.raises(BadInput, match=r"^at speed 0\.1\d*: termination\.speed\.bound: 1\.\d+e-05 m/s ends "):
        find_trainer("apg").check(load_task("dial", edits))


def test_a_task_made_in_python_is_refused_too_before_anything_is_written(tasks, tmp_path):
    end = dataclasses.replace(tasks["baseline"].termination["distance"], bound=0.01)
    task = dataclasses.replace(tasks["baseline"], termination={"distance": end})
    with pytest.raises(BadInput, match=r"^termination\.distance\.bound: 0\.01 m ends every episode"):
        train(task, "apg", out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_tuning_is_refused_too_before_anything_is_written(tmp_path):
    with pytest.raises(BadInput, match=r"^termination\.altitude\.bound: 0\.1 m is not below the target"):
        tune(settling_time=3.0, task="baseline", edits={"target.position": [0.0, 0.0, 0.05]}, out=tmp_path / "tuned")
    assert not (tmp_path / "tuned").exists()


def test_all_trainers_check_the_starts():
    for trainer in TRAINERS.values():
        if not trainer.packages:
            assert refusal({"termination.altitude.bound": 1.5}, trainer.name)


def test_a_start_upside_down_is_allowed_where_the_bounds_allow_it():
    upside = {"initial_state.largest_tilt": math.pi}
    check_starts(load_task("baseline", upside))
    # of roll and pitch in [-pi, pi], 11 deg leave about 1 in 130
    edits = upside | {"termination.tilt": TILT | {"bound_deg": 11.0}}
    assert refusal(edits).startswith("termination.tilt.bound_deg: 11 deg ends 0.9")


def test_an_evaluation_below_the_ground_is_refused(tasks):
    target = dataclasses.replace(tasks["baseline"].target, position=(0.0, 0.0, -2.0))
    problem = EVALUATION_INITIAL_STATES["clear"].problem_around(target)
    assert problem.startswith("lowest_altitude: 0.1 m lies above all starts, whose box ends at -1 m")
    assert EVALUATION_INITIAL_STATES["clear"].problem_around(tasks["baseline"].target) is None
