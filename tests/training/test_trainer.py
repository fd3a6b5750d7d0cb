"""The list of trainers: what each entry promises, and what is refused."""

import dataclasses
import importlib
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from flytune.control.policy import Policy
from flytune.errors import BadInput
from flytune.task.observation import input_scale
from flytune.training.loop import train
from flytune.training.trainer import TRAINERS, find_trainer, trainer_names


@pytest.fixture(scope="module")
def policy(small_task):
    """A policy with the layers of trainer apg, which was trained on other multiples of the observation."""
    train_state = find_trainer("ppo").start(small_task, jax.random.key(7))
    return Policy(actor=train_state.ema, input_scale=input_scale((1.0, 0.5, 3.0, 2.0, 0.1)), squash="tanh")


@pytest.mark.parametrize("trainer", TRAINERS.values(), ids=TRAINERS)
def test_the_module_of_a_trainer_offers_the_functions_that_its_entry_promises(trainer):
    module = importlib.import_module(trainer.module)
    functions = ["start", "update", "policy", "last_policy"]
    assert [name for name in functions if not callable(getattr(module, name, None))] == []
    assert hasattr(module, "warm_start") == trainer.supports_warm_start


@pytest.mark.parametrize("trainer", TRAINERS.values(), ids=TRAINERS)
def test_the_settings_of_a_trainer_are_in_the_task(small_task, trainer):
    settings = trainer.settings(small_task)
    assert settings is getattr(small_task, trainer.settings_field)
    assert settings.updates >= 1 and settings.steps_per_update >= 1
    assert all(hasattr(settings, name) for name in trainer.missing_settings)
    longer = trainer.with_steps(small_task, 10 * settings.steps_per_update + 1)
    assert trainer.settings(longer).updates == 11
    others = [field.name for field in dataclasses.fields(longer) if field.name != trainer.settings_field]
    assert all(getattr(longer, name) is getattr(small_task, name) for name in others)


def test_a_list_of_trainers_for_every_task_leaves_out_those_that_lack_settings():
    assert trainer_names() == ("apg", "ppo", "sb3")
    assert trainer_names(every_task=True) == ("apg", "ppo")
    assert find_trainer("sb3").name == "sb3"
    with pytest.raises(BadInput, match=r"^trainer: 'sb3' is not allowed\. Allowed: apg, ppo\.$"):
        find_trainer("sb3", every_task=True)


def test_naming_the_trainers_takes_no_jax():
    program = "import sys, flytune.training.trainer as t; print(*t.trainer_names(), 'jax' in sys.modules)"
    answer = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=dict(os.environ)
    )
    assert answer.stdout == "apg ppo sb3 False\n"


def test_a_warm_start_flies_as_the_policy_it_starts_from(small_task, policy):
    apg = find_trainer("apg")
    train_state = apg.warm_start(small_task, apg.start(small_task, jax.random.key(0)), policy)
    seen = jax.random.normal(jax.random.key(0), (16, 17))
    for started in (apg.policy(small_task, train_state), apg.last_policy(small_task, train_state)):
        np.testing.assert_array_equal(started.input_scale, input_scale(small_task.apg.input_scale))
        np.testing.assert_allclose(started(seen), policy(seen), atol=1e-6)
    apg.update(small_task, train_state)  # takes the memory of its own state, not that of the policy
    assert np.isfinite(policy(seen)).all()


def test_a_warm_start_from_other_layers_or_another_squash_is_refused_and_nothing_is_written(
    small_task, policy, tmp_path
):
    wider = dataclasses.replace(small_task, apg=dataclasses.replace(small_task.apg, hidden=(9, 8)))
    with pytest.raises(BadInput, match=r"^warm_start: .*\(17, 8\).* Allowed: .*\(17, 9\)"):
        train(wider, "apg", warm_start=policy, out=tmp_path / "run")
    with pytest.raises(BadInput, match=r"^warm_start: .*squash clip is not allowed\. Allowed: .* squash tanh"):
        train(small_task, "apg", warm_start=dataclasses.replace(policy, squash="clip"), out=tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("trainer", [name for name, trainer in TRAINERS.items() if not trainer.supports_warm_start])
def test_a_warm_start_is_refused_by_a_trainer_without_one_and_nothing_is_written(small_task, policy, tmp_path, trainer):
    with pytest.raises(
        BadInput, match=f"^warm_start: trainer {trainer} cannot start from a policy. Allowed: trainer apg, ppo."
    ):
        train(small_task, trainer, warm_start=policy, out=tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("trainer", "path", "remedy"),
    [
        ("apg", "ppo.learning_rate", "which has its settings in apg. Set a field of apg, or give --trainer ppo."),
        ("ppo", "apg.updates", "which has its settings in ppo. Set a field of ppo, or give --trainer apg."),
        ("sb3", "apg.updates", "which has its settings in ppo. Set a field of ppo, or give --trainer apg."),
        ("apg", "initial_state.largest_tilt", "Set apg.initial_state.largest_tilt."),
        ("apg", "initial_state", "Set apg.initial_state."),
    ],
)
def test_an_edit_that_a_trainer_does_not_read_is_refused(trainer, path, remedy):
    with pytest.raises(BadInput, match=f"^set: {path} is not read by trainer {trainer}, ") as caught:
        find_trainer(trainer).check_edits([path])
    assert str(caught.value).endswith(remedy)


@pytest.mark.parametrize("trainer", TRAINERS.values(), ids=TRAINERS)
def test_an_edit_that_a_trainer_reads_is_accepted(trainer):
    trainer.check_edits([f"{trainer.settings_field}.hidden", "reward.velocity.weight", "vehicle", "duration"])
    if not trainer.own_starts:
        trainer.check_edits(["initial_state.largest_tilt"])
