"""Learning curves: smoothing and the steps to a goal, by hand."""

import math

import pytest

from flytune.reproduction.learning import reward_at, smoothed_reward, steps_to_share, steps_to_survive
from flytune.task.files import load_task


def rows(rewards, lengths=None):
    lengths = lengths or [100] * len(rewards)
    return [
        {"steps": 1000 * (number + 1), "episode_reward": reward, "episode_length": length}
        for number, (reward, length) in enumerate(zip(rewards, lengths, strict=True))
    ]


def test_a_tenth_of_the_training_is_averaged():
    # 20 updates: two make a tenth
    course = smoothed_reward(rows(list(range(20))))
    assert course[0] == 0.0  # nothing before it
    assert course[1] == 0.5  # (0 + 1) / 2
    assert course[19] == 18.5  # (18 + 19) / 2
    assert reward_at(rows(list(range(20))), 0.5) == 8.5  # ends with the tenth update: (8 + 9) / 2


def test_updates_in_which_no_episode_ended_are_left_out_of_the_mean():
    course = smoothed_reward(rows([None, 4.0, None, *[4.0] * 17]))
    assert math.isnan(course[0])
    assert course[2] == 4.0


def test_steps_to_a_share_of_the_final_reward():
    # the smoothed course is the course itself for 10 updates; 95 % of 10 is first reached at the value 10
    assert steps_to_share(rows([1.0, 5.0, 9.0, *[10.0] * 7]), 0.95) == 4000
    assert steps_to_share(rows([1.0, 5.0, 9.6, *[10.0] * 7]), 0.95) == 3000


@pytest.mark.parametrize(("lengths", "steps"), [([10, 449, 450, 500], 3000), ([10, 20, 30, 40], None)])
def test_a_training_survives_when_episodes_last_nine_tenths_of_the_horizon(lengths, steps):
    task = load_task("inspection")
    assert task.horizon == 500
    assert steps_to_survive(rows([1.0] * 4, lengths), task) == steps
