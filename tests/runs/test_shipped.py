"""The policies inside the package: each is what its run.json says, and flies its own task without a training."""

import json

import pytest

from flytune.control.policy import load_policy
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import judge
from flytune.runs.shipped import shipped_files, shipped_names
from flytune.task.task import load_task, preset_names

REFINED = [name for name in preset_names() if name.endswith("-refined")]
# least of 100 trials on any axis; docs/results/refined.md says why inspection does not reach more with PPO
SETTLED = {"inspection-refined@ppo": 80}


def test_each_refined_preset_has_a_policy_of_both_trainers():
    assert sorted(shipped_names()) == sorted(f"{name}{suffix}" for name in REFINED for suffix in ("", "@ppo"))


@pytest.mark.parametrize("name", shipped_names())
def test_a_policy_is_that_of_the_training_beside_it(name):
    task, _, trainer = name.partition("@")
    told = json.loads(shipped_files(name)[1].read_text(encoding="utf-8"))
    assert (told["task"], told["trainer"]) == (task, trainer or "apg")
    assert told["finished"]
    assert told["command"][1:3] == ["train", task]


@pytest.mark.parametrize("name", shipped_names())
def test_a_policy_settles_the_starts_of_its_task(name):
    task = load_task(name.partition("@")[0])
    duration = 20.0 if task.name.startswith("inspection") else 10.0
    judged = judge(fly(load_policy(shipped_files(name)[0]), task, trials=100, seed=9, duration=duration)).to_dict()
    assert min(axis["settled"] for axis in judged["axes"].values()) >= SETTLED.get(name, 99)
