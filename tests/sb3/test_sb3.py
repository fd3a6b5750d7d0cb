"""The trainer `sb3`: the same run directory, the same numbers again, and how it fails."""

import pytest

pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")

import dataclasses
import json
import subprocess
import sys

import jax
import numpy as np
import torch

from flytune.adapters.vec_env import HoverVecEnv
from flytune.control.policy import load_policy
from flytune.errors import BadInput, Diverged
from flytune.export.untrusted.sb3_model import actor_network
from flytune.runs.directory import RunDirectory
from flytune.task.files import load_task, write_task
from flytune.training import sb3
from flytune.training.loop import train
from flytune.training.trainer import find_trainer
from flytune.training.update import metrics_row

SMALL = {
    "ppo.environments": 4,
    "ppo.rollout": 16,
    "ppo.minibatch": 16,
    "ppo.epochs": 2,
    "ppo.steps": 256,
    "ppo.hidden": [8, 8],
    "horizon": 10,
}


@pytest.fixture(scope="module")
def task():
    """The baseline with a training of four small updates, in which episodes reach their horizon."""
    return load_task("baseline", SMALL)


@pytest.fixture(scope="module")
def whole(task):
    """That training, uninterrupted."""
    return train(task, "sb3", seed=1)


def assert_identical(first, second):
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(one, other)


def without_times(rows):
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


@pytest.mark.floor
def test_a_run_directory_holds_what_those_of_other_trainers_hold(task, tmp_path):
    run, other = (train(task, trainer, seed=3, out=tmp_path / trainer) for trainer in ("sb3", "ppo"))
    names = {path.name for path in (tmp_path / "sb3").iterdir()}
    assert names == {path.name for path in (tmp_path / "ppo").iterdir()}
    assert write_task(load_task(tmp_path / "sb3" / "task.toml")) == write_task(task)
    facts = json.loads((tmp_path / "sb3" / "run.json").read_text())
    assert facts["finished"] and facts["trainer"] == "sb3" and facts["steps"] == 256
    rows = [json.loads(line) for line in (tmp_path / "sb3" / "metrics.jsonl").read_text().splitlines()]
    assert [row["update"] for row in rows] == [1, 2, 3, 4]
    assert [list(row) for row in rows] == [list(row) for row in other.metrics]
    for row in rows:
        assert row["reward"] == pytest.approx(sum(row["terms"].values()), abs=1e-5)
        assert 1 <= row["episode_length"] <= 10 and row["episodes"] >= sum(row["terminations"].values())
    assert sum(row["episodes"] for row in rows) > sum(sum(row["terminations"].values()) for row in rows)  # horizons
    assert_identical(load_policy(tmp_path / "sb3" / "policy.safetensors"), run.policy)
    assert_identical(load_policy(tmp_path / "sb3" / "policy-last.safetensors"), run.last_policy)


def test_the_same_seed_gives_the_same_policy_bit_by_bit_and_another_seed_another(task, whole):
    again, other = (train(task, "sb3", seed=seed) for seed in (1, 2))
    assert_identical(whole.policy, again.policy)
    assert_identical(whole.last_policy, again.last_policy)
    assert without_times(whole.metrics) == without_times(again.metrics)
    assert np.abs(np.subtract(whole.policy.actor.weights[0], other.policy.actor.weights[0])).max() > 0.01


@pytest.mark.parametrize("done", [1, 3])
def test_an_interrupted_run_goes_on_to_the_same_result_bit_by_bit(task, whole, tmp_path, done):
    directory = RunDirectory(tmp_path / "run", task, "sb3", 1, resume=False)
    train_state, rows = sb3.start(task, task.ppo, jax.random.key(1)), []
    for number in range(1, done + 1):
        train_state, seen = sb3.update(task, task.ppo, train_state)
        rows.append(metrics_row(task, seen, number, 64 * number, 0.0))
    directory.checkpoint(train_state, rows)
    del train_state
    torch.manual_seed(99), np.random.seed(99)  # noqa: NPY002  # another process begins with other random numbers
    resumed = train(task, "sb3", seed=1, out=tmp_path / "run", resume=True)
    assert_identical(whole.policy, resumed.policy)
    assert_identical(whole.last_policy, resumed.last_policy)
    assert without_times(whole.metrics) == without_times(resumed.metrics)


def test_the_trainer_is_stable_baselines3s_own_training_bit_by_bit(task, whole):
    # the same model left to itself for as many rollouts: what is put and taken in between changes nothing
    seed = int(jax.random.bits(jax.random.key(1)))
    model = sb3.make_model(task.ppo, HoverVecEnv(task, task.ppo.environments, seed), seed)
    model.learn(task.ppo.steps)
    weights = {name: weight.detach().numpy() for name, weight in model.policy.named_parameters()}
    assert_identical(whole.last_policy.actor, actor_network(weights))


def test_the_same_training_state_can_be_updated_twice_and_gives_the_same(task):
    train_state = sb3.start(task, task.ppo, jax.random.key(5))
    first, _ = sb3.update(task, task.ppo, train_state)
    sb3.update(task, task.ppo, first)  # leaves the model in another state
    again, _ = sb3.update(task, task.ppo, train_state)
    assert_identical(first, again)


def test_the_flown_policy_is_the_average_and_the_last_one_is_not(task, whole):
    assert np.abs(np.subtract(whole.policy.actor.weights[0], whole.last_policy.actor.weights[0])).max() > 1e-5
    assert whole.policy.about["trainer"] == "sb3"


def test_the_random_numbers_of_the_process_are_left_as_they_were(task):
    torch.manual_seed(3), np.random.seed(3)  # noqa: NPY002
    wanted = float(torch.rand(())), np.random.random()  # noqa: NPY002
    torch.manual_seed(3), np.random.seed(3)  # noqa: NPY002
    torch.set_num_threads(2)
    train(find_trainer("sb3").with_steps(task, 64), "sb3")
    assert (float(torch.rand(())), np.random.random()) == wanted  # noqa: NPY002
    assert torch.get_num_threads() == 2
    torch.set_num_threads(1)


def test_numbers_that_stop_being_finite_end_the_training_with_what_and_when(task):
    # 1e38: Adam's first step, 1e39, is none of float32's; 1e30: the weights hold it, what they give does not
    for learning_rate in (1e38, 1e30):
        settings = dataclasses.replace(task.ppo, learning_rate=learning_rate)
        with pytest.raises(Diverged, match=r"(is (nan|inf)|finite) in update [12] \((64|128) environment steps\)"):
            train(dataclasses.replace(task, ppo=settings), "sb3")


def test_steps_are_those_of_ppo(task):
    assert find_trainer("sb3").with_steps(task, 100).ppo.updates == 2


@pytest.mark.parametrize("package", ["stable_baselines3", "torch", "gymnasium"])
def test_a_missing_package_is_named_with_its_remedy_before_anything_is_written(tmp_path, package):
    script = (
        f"import sys; sys.modules[{package!r}] = None\n"
        "from flytune.errors import BadInput\n"
        "from flytune.training.loop import train\n"
        "from flytune.task.files import load_task\n"
        "from pathlib import Path\n"
        "try: train(load_task('baseline'), 'sb3', out=Path(sys.argv[1]))\n"
        "except BadInput as error: print(error)\n"
    )
    said = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "run")], capture_output=True, text=True, check=True
    )
    assert said.stdout == f'{package}: is not installed. Install it with: pip install "flytune[sb3]"\n'
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_of_another_trainer_is_refused(task, tmp_path):
    train(find_trainer("sb3").with_steps(task, 64), "sb3", out=tmp_path / "run")
    with pytest.raises(BadInput, match="sb3"):
        train(find_trainer("ppo").with_steps(task, 64), "ppo", out=tmp_path / "run", resume=True)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ({"separate_grad_clipping": True}, r"ppo\.separate_grad_clipping: true is not allowed.*Allowed: false\."),
        ({"final_learning_rate": 0.5}, r"ppo\.final_learning_rate: 0\.5 is not allowed.*Allowed: 1\.0\."),
        ({"input_scale": (2.0, 1.0, 1.0, 1.0, 1.0)}, r"ppo\.input_scale: \[2\.0, 1\.0.*Allowed: \[1\.0, 1\.0"),
    ],
)
def test_what_only_our_own_ppo_can_do_is_refused_before_anything_is_written(task, tmp_path, edit, said):
    asked = dataclasses.replace(task, ppo=dataclasses.replace(task.ppo, **edit))
    with pytest.raises(BadInput, match=said):
        train(asked, "sb3", out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
