"""The policies inside the package: each is the result that its run.json records, and flies its own task untrained."""

import dataclasses
import json

import pytest

from flytune.config import document
from flytune.control.policy import load_policy
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import judge
from flytune.runs.shipped import DEFAULT_TRAINER, shipped_files, shipped_name, shipped_names
from flytune.task.files import load_task, preset_names, read_task_text
from flytune.training.trainer import TRAINERS, find_trainer, trainer_names

REFINED = [name for name in preset_names() if name.endswith("-refined")]
# least of 100 trials on any axis; docs/results/refined.md says why PPO does not reach more on the inspection task
SETTLED = {"inspection-refined@ppo": 80}


def test_each_refined_preset_has_a_policy_of_each_trainer_that_can_train_it():
    trainers = trainer_names(every_task=True)
    ours = [shipped_name(task, trainer) for task in REFINED for trainer in trainers]
    assert sorted(shipped_names()) == sorted([*ours, "dial"])


@pytest.mark.parametrize("name", shipped_names())
def test_a_policy_is_the_result_of_the_training_that_its_record_describes(name):
    preset, _, trainer = name.partition("@")
    path, record = shipped_files(name)
    recorded, header = json.loads(record.read_text(encoding="utf-8")), load_policy(path).about
    assert recorded["finished"]
    assert (recorded["task"], recorded["trainer"]) == (preset, trainer or DEFAULT_TRAINER)
    assert recorded["command"][1:] == [
        "train",
        preset,
        "--trainer",
        recorded["trainer"],
        "--seed",
        str(recorded["seed"]),
    ]
    assert {key: header[key] for key in ("task", "trainer", "seed", "steps")} == {
        key: recorded[key] for key in ("task", "trainer", "seed", "steps")
    }
    task = read_task_text(header["task_toml"], name)
    # the settings of other trainers may have changed since, and those of APG have: it reaches the same in less time
    settings_field = find_trainer(recorded["trainer"]).settings_field
    now = load_task(preset)
    other = {each.settings_field for each in TRAINERS.values()} - {settings_field} | {"apg"}
    before = dataclasses.replace(task, **{name: getattr(now, name) for name in other})
    assert document.plain(before) | {"sources": {}} == document.plain(now) | {"sources": {}}
    settings = find_trainer(recorded["trainer"]).settings(task)
    assert recorded["steps"] == settings.updates * settings.steps_per_update


@pytest.mark.parametrize("name", shipped_names())
def test_a_policy_settles_from_the_initial_conditions_of_its_task(name):
    task = load_task(name.partition("@")[0])
    duration = 20.0 if task.name.startswith("inspection") else 10.0
    judged = judge(fly(load_policy(shipped_files(name)[0]), task, trials=100, seed=9, duration=duration)).to_dict()
    assert min(axis["settled"] for axis in judged["axes"].values()) >= SETTLED.get(name, 99)
    assert judged["crashed"] == 0
