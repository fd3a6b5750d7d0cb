"""Training runs: what they leave behind, that they repeat and resume bit by bit, and how they fail."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from flytune.control.policy import load_policy
from flytune.errors import BadInput, Diverged
from flytune.runs.directory import CHECKPOINT, RunDirectory
from flytune.task.files import load_task, write_task
from flytune.training.loop import train
from flytune.training.trainer import TRAINERS, find_trainer, trainer_names
from flytune.training.update import metrics_row

OWN = trainer_names(every_task=True)  # without Stable-Baselines3, which has its own tests


def weights(policy):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(policy)]


def assert_identical(first, second):
    for one, other in zip(weights(first), weights(second), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.floor
@pytest.mark.parametrize("trainer", OWN)
def test_a_run_directory_holds_all_that_the_contract_names(small_task, tmp_path, trainer):
    run = train(small_task, trainer, seed=3, out=tmp_path / "run")
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names == {
        "task.toml",
        "run.json",
        "policy.safetensors",
        "policy-last.safetensors",
        "metrics.jsonl",
        "checkpoint",
    }
    assert write_task(load_task(tmp_path / "run" / "task.toml")) == write_task(small_task)
    facts = json.loads((tmp_path / "run" / "run.json").read_text())
    assert facts["finished"] and facts["seed"] == 3 and facts["trainer"] == trainer and facts["steps"] > 0
    assert {"flytune", "jax", "python"} <= set(facts["versions"])
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [row["update"] for row in rows] == list(range(1, getattr(small_task, trainer).updates + 1))
    assert set(rows[0]["terms"]) == set(small_task.reward)
    assert set(rows[0]["terminations"]) == {*small_task.termination, "diverged"}
    assert_identical(load_policy(tmp_path / "run" / "policy.safetensors"), run.policy)
    assert_identical(load_policy(tmp_path / "run" / "policy-last.safetensors"), run.last_policy)


@pytest.mark.parametrize("trainer", OWN)
def test_the_same_seed_gives_the_same_policy_bit_by_bit_and_another_seed_another(small_task, trainer):
    first, again, other = (train(small_task, trainer, seed=seed) for seed in (1, 1, 2))
    assert_identical(first.policy, again.policy)
    assert_identical(first.last_policy, again.last_policy)
    assert any((a != b).any() for a, b in zip(weights(first.policy), weights(other.policy), strict=True))


@pytest.mark.parametrize("trainer", OWN)
def test_an_interrupted_run_goes_on_to_the_same_result_bit_by_bit(small_task, tmp_path, trainer):
    whole = train(small_task, trainer, seed=1)
    # the state after two updates, as an interruption would have left it
    directory = RunDirectory(tmp_path / "run", small_task, trainer, 1, resume=False)
    method = find_trainer(trainer)
    train_state, rows = method.start(small_task, jax.random.key(1)), []
    for number in (1, 2):
        train_state, measured = method.update(small_task, train_state)
        rows.append(metrics_row(small_task, measured, number, number, 0.0))
    directory.checkpoint(train_state, rows)
    resumed = train(small_task, trainer, seed=1, out=tmp_path / "run", resume=True)
    assert_identical(whole.policy, resumed.policy)
    assert_identical(whole.last_policy, resumed.last_policy)
    assert [row["update"] for row in resumed.metrics] == [row["update"] for row in whole.metrics]


def test_resuming_with_another_task_seed_or_trainer_is_refused_and_changes_nothing(small_task, tmp_path):
    train(small_task, "apg", seed=1, out=tmp_path / "run")
    before = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    other = dataclasses.replace(small_task, horizon=400)
    for task, trainer, seed, word in [
        (other, "apg", 1, "horizon"),
        (small_task, "ppo", 1, "apg"),
        (small_task, "apg", 2, "seed 1"),
    ]:
        with pytest.raises(BadInput, match=word):
            train(task, trainer, seed=seed, out=tmp_path / "run", resume=True)
    assert {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()} == before


def test_a_directory_that_holds_a_run_is_refused_and_kept(small_task, tmp_path):
    train(small_task, "apg", out=tmp_path / "run")
    before = (tmp_path / "run" / "policy.safetensors").read_bytes()
    with pytest.raises(BadInput, match="already holds a run"):
        train(small_task, "apg", seed=9, out=tmp_path / "run")
    assert (tmp_path / "run" / "policy.safetensors").read_bytes() == before


def test_a_damaged_checkpoint_is_named(small_task, tmp_path):
    train(small_task, "apg", out=tmp_path / "run")
    (tmp_path / "run" / CHECKPOINT).write_bytes(b"not a checkpoint")
    with pytest.raises(BadInput, match=r"train_state\.safetensors is damaged"):
        train(small_task, "apg", out=tmp_path / "run", resume=True)


def test_a_checkpoint_of_an_older_version_is_refused_in_one_line(small_task, tmp_path):
    train(small_task, "apg", out=tmp_path / "run")
    (tmp_path / "run" / CHECKPOINT).rename(tmp_path / "run" / "checkpoint" / "learner.safetensors")
    with pytest.raises(BadInput, match=r"^resume: .*older version of flytune \(learner\.safetensors\).*[^\n]*$"):
        train(small_task, "apg", out=tmp_path / "run", resume=True)


@pytest.mark.parametrize("trainer", OWN)
def test_numbers_that_stop_being_finite_end_the_training_with_what_and_when(small_task, trainer):
    settings = dataclasses.replace(getattr(small_task, trainer), learning_rate=1e38)
    with pytest.raises(Diverged, match=r"is (nan|inf|-inf) in update \d+ \(\d+ environment steps\)"):
        train(dataclasses.replace(small_task, **{trainer: settings}), trainer)


def test_steps_are_rounded_up_to_whole_updates(small_task):
    # apg: 4 environments x 10 steps = 40 per update; 100 steps need 3 updates
    assert find_trainer("apg").with_steps(small_task, 100).apg.updates == 3
    # ppo: 4 x 16 = 64 per update; 100 steps need 2 updates
    assert find_trainer("ppo").with_steps(small_task, 100).ppo.updates == 2
    with pytest.raises(BadInput, match="steps: 0"):
        find_trainer("apg").with_steps(small_task, 0)


def test_unknown_trainers_and_impossible_seeds_are_refused(small_task):
    with pytest.raises(BadInput, match=f"Allowed: {', '.join(TRAINERS)}"):
        train(small_task, "sarsa")
    with pytest.raises(BadInput, match="seed"):
        train(small_task, "apg", seed=-1)


@pytest.mark.parametrize("trainer", OWN)
def test_an_update_gives_a_state_of_the_types_it_took_so_that_it_compiles_only_once(small_task, trainer):
    method = find_trainer(trainer)
    before = jax.eval_shape(lambda key: method.start(small_task, key), jax.random.key(0))
    after, _ = jax.eval_shape(lambda train_state: method.update(small_task, train_state), before)
    kinds = [
        [(leaf.shape, leaf.dtype, leaf.weak_type) for leaf in jax.tree.leaves(train_state)]
        for train_state in (before, after)
    ]
    assert kinds[0] == kinds[1]


def test_a_training_writes_what_tensorboard_reads(tmp_path, small_task):
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator", reason="needs flytune[tensorboard]"
    )
    run = train(small_task, "apg", out=tmp_path / "run", tensorboard=True)
    seen = accumulator.EventAccumulator(str(tmp_path / "run")).Reload().Scalars("reward")
    assert [event.step for event in seen] == [row["steps"] for row in run.metrics]
    assert [event.value for event in seen] == pytest.approx([row["reward"] for row in run.metrics])


def test_tensorboard_without_a_directory_is_refused(small_task):
    with pytest.raises(BadInput, match="run directory"):
        train(small_task, "apg", tensorboard=True)
