"""Training on a target that moves."""

import numpy as np
import pytest

import flytune
from flytune.task.files import load_task

SMALL = {"target.kind": "circle", "target.centre": [0.0, 0.0, 1.2], "apg.updates": 10, "ppo.steps": 100_000}


@pytest.mark.slow
@pytest.mark.parametrize("trainer", ["apg", "ppo"])
def test_a_training_on_a_circle_learns_and_writes_the_path_into_its_policy(trainer, tmp_path):
    run = flytune.train(load_task("baseline", SMALL), trainer=trainer, out=tmp_path / "run")
    rewards = [row["reward"] for row in run.metrics]
    assert rewards[-1] > rewards[0]
    assert flytune.load_task(tmp_path / "run").target.kind == "circle"
    assert flytune.evaluate(str(tmp_path / "run"), trials=2, duration=2.0).judgement.tracking is not None


@pytest.mark.slow
def test_a_training_on_a_circle_follows_it_within_the_speed_bound(tmp_path):
    flytune.train(load_task("baseline", {"target.kind": "circle"}), out=tmp_path / "run")
    judgement = flytune.evaluate(str(tmp_path / "run"), trials=50, duration=20.0).judgement
    assert np.median(judgement.tracking.mean_error) < 0.02
    assert judgement.to_dict()["violations"]["speed"] <= 2
