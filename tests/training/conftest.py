"""Small trainings, so that one compiled program serves every test of a trainer."""

import pytest

from flytune.task.files import load_task

SMALL_APG = {"apg.environments": 4, "apg.window": 10, "apg.updates": 4, "apg.hidden": [8, 8]}
SMALL_PPO = {
    "ppo.environments": 4,
    "ppo.rollout": 16,
    "ppo.minibatch": 16,
    "ppo.epochs": 2,
    "ppo.steps": 256,
    "ppo.hidden": [8, 8],
}


@pytest.fixture(scope="session")
def small_task():
    """The baseline, with both trainers cut down to a few seconds."""
    return load_task("baseline", SMALL_APG | SMALL_PPO)


@pytest.fixture(scope="session")
def small_edits():
    """The same as the command line writes it."""
    return [f"{path}={value}" for path, value in (SMALL_APG | SMALL_PPO).items()]
