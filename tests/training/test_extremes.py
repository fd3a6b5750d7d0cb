"""One update of a training stays finite at the ends of what is allowed, or ends in one line that says what helps."""

import dataclasses

import jax
import numpy as np
import pytest
from tests.corners import edits_at_the_ends, vehicles
from tests.training.conftest import SMALL_APG, SMALL_PPO

from flytune.errors import BadInput, Diverged
from flytune.task.files import load_task
from flytune.training.loop import train

pytestmark = pytest.mark.slow

SMALL = SMALL_APG | SMALL_PPO | {"apg.updates": 2, "ppo.steps": 128}  # two updates, and one program for all
PARTS = ("target", "initial_state", "noise", "reward", "termination")


def trained(task, trainer):
    """Whether a short training ended well, with finite weights; any other end is an error that a user can meet."""
    try:
        run = train(task, trainer)
    except (Diverged, BadInput):
        return False
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(run.last_policy))
    return True


@pytest.mark.parametrize("trainer", ["apg", "ppo"])
def test_vehicles_at_the_corners_of_what_is_plausible_can_be_trained(trainer):
    task = load_task("baseline", SMALL)
    assert all(trained(dataclasses.replace(task, vehicle=vehicle), trainer) for vehicle in vehicles(10))


@pytest.mark.parametrize("trainer", ["apg", "ppo"])
def test_each_number_of_a_task_at_an_end_of_its_range_can_be_trained_or_is_refused(trainer):
    results = []
    for edit in edits_at_the_ends("baseline", PARTS):
        try:
            task = load_task("baseline", SMALL | edit)
        except BadInput:
            continue
        results.append(trained(task, trainer))
    assert sum(results) > 25


@pytest.mark.parametrize(
    ("trainer", "edits"),
    [
        ("apg", {"apg.environments": 1, "apg.window": 1}),
        ("apg", {"apg.hidden": []}),
        ("ppo", {"ppo.environments": 1, "ppo.rollout": 2, "ppo.minibatch": 2, "ppo.steps": 4}),
        ("ppo", {"ppo.hidden": [1], "ppo.discount": 0.0, "ppo.clip_range": 2.0}),
        ("ppo", {"horizon": 1}),
    ],
)
def test_the_smallest_settings_of_a_trainer_train(trainer, edits):
    assert trained(load_task("baseline", SMALL | edits), trainer)


@pytest.mark.parametrize(
    ("trainer", "edits", "remedy", "cure"),
    [
        ("ppo", {"ppo.learning_rate": 1e6}, "A smaller learning rate", {"ppo.learning_rate": 2e-4}),
        ("apg", {"apg.learning_rate": 1e10}, "A smaller learning rate", {"apg.learning_rate": 5e-3}),
        ("apg", {"reward.velocity.weight": 1e25}, "The term reward.velocity is ", {"reward.velocity.weight": 1.0}),
        ("ppo", {"reward.velocity.weight": 1e25}, "The term reward.velocity is ", {"reward.velocity.weight": 1.0}),
    ],
)
def test_what_a_message_about_numbers_that_diverged_proposes_helps(trainer, edits, remedy, cure):
    with pytest.raises(Diverged) as caught:
        train(load_task("baseline", SMALL | edits), trainer)
    assert remedy in str(caught.value)
    train(load_task("baseline", SMALL | edits | cure), trainer)
