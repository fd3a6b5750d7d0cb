"""A run directory for tests of the command line that call it in their own process: a training of two updates."""

import pytest

from flytune.task.files import load_task
from flytune.training.loop import train

SMALL = {"apg.environments": 4, "apg.window": 10, "apg.updates": 2, "apg.hidden": [8, 8], "duration": 1.0}


@pytest.fixture(scope="session")
def small_run(tmp_path_factory):
    """A run directory of `apg` on the baseline. Tests copy what they change."""
    path = tmp_path_factory.mktemp("small") / "mine"
    train(load_task("baseline", SMALL), "apg", out=path)
    return path
