"""Trainings that go on from a policy: what they take over, what they write, and what is refused."""

import dataclasses
import json
import re
import shlex
from pathlib import Path

import jax
import numpy as np
import pytest
from tests.training.test_loop import assert_identical

from flytune.cli.main import main
from flytune.control.policy import load_policy
from flytune.errors import BadInput
from flytune.task.files import load_task
from flytune.training.loop import train
from flytune.training.trainer import find_trainer
from flytune.training.warm_start import find_warm_start

SEEN = jax.random.normal(jax.random.key(0), (16, 17))


@pytest.fixture(scope="module")
def runs(small_task, tmp_path_factory):
    """The run directory of each trainer."""
    folder = tmp_path_factory.mktemp("runs")
    for trainer in ("apg", "ppo"):
        train(small_task, trainer, seed=1, out=folder / trainer)
    return {trainer: str(folder / trainer) for trainer in ("apg", "ppo")}


@pytest.fixture(scope="module")
def heavier(small_task):
    """Another task: a heavier vehicle, another weight, and another scale of the observation."""
    ppo = dataclasses.replace(small_task.ppo, input_scale=(1.0, 0.5, 3.0, 2.0, 0.1))
    apg = dataclasses.replace(small_task.apg, input_scale=(1.0, 0.5, 3.0, 2.0, 0.1))
    vehicle = dataclasses.replace(small_task.vehicle, mass=0.05)
    return dataclasses.replace(small_task, vehicle=vehicle, ppo=ppo, apg=apg)


@pytest.mark.slow
@pytest.mark.parametrize("trainer", ["apg", "ppo"])
def test_a_training_on_another_task_begins_with_the_actions_of_the_policy(runs, heavier, trainer):
    method, start = find_trainer(trainer), find_warm_start(runs[trainer])
    train_state = method.warm_start(heavier, method.start(heavier, jax.random.key(5)), start.policy, start.critic)
    for started in (method.policy(heavier, train_state), method.last_policy(heavier, train_state)):
        np.testing.assert_allclose(
            started(SEEN), load_policy(Path(runs[trainer]) / "policy.safetensors")(SEEN), atol=1e-6
        )
    method.update(heavier, train_state)  # takes the memory of its own state alone
    assert np.isfinite(start.policy(SEEN)).all()


def test_ppo_goes_on_with_the_critic_of_a_run_of_ppo_and_with_a_new_one_from_anything_else(runs, heavier, small_task):
    method = find_trainer("ppo")
    fresh = method.start(heavier, jax.random.key(5))
    start = find_warm_start(runs["ppo"])
    critic = method.warm_start(heavier, fresh, start.policy, start.critic).parameters.critic
    whole = train(small_task, "ppo", seed=1, out=None)
    assert_identical(whole.policy, start.policy)
    scale = np.asarray(method.policy(heavier, fresh).input_scale)
    values = start.critic.network(SEEN * start.critic.input_scale)
    np.testing.assert_allclose(critic(SEEN * scale), values, atol=1e-5)
    assert not np.allclose(fresh.parameters.critic(SEEN * scale), values, atol=1e-3)
    bare = find_warm_start(f"{runs['ppo']}/policy.safetensors")
    assert bare.critic is None and find_warm_start(runs["apg"]).critic is None
    assert_identical(method.warm_start(heavier, fresh, bare.policy).parameters.critic, fresh.parameters.critic)


@pytest.mark.parametrize("trainer", ["apg", "ppo"])
def test_a_warm_start_repeats_bit_by_bit_and_run_json_says_what_it_started_from(runs, heavier, tmp_path, trainer):
    first, again = (train(heavier, trainer, seed=2, warm_start=runs[trainer], out=tmp_path / name) for name in "ab")
    assert_identical(first.policy, again.policy)
    new = train(heavier, trainer, seed=2)
    assert any((a != b).any() for a, b in zip(first.policy.actor.weights, new.policy.actor.weights, strict=True))
    told = json.loads((tmp_path / "a" / "run.json").read_text())["from"]
    assert told["who"] == runs[trainer] and told["task"] == "baseline" and told["vehicle"] == "crazyflie"
    assert told["critic"] == (trainer == "ppo") and len(told["actor_sha256"]) == 64
    assert json.loads((tmp_path / "b" / "run.json").read_text())["from"] == told


def command_in(message):
    """The words of the command that a message ends with, without the name of the program."""
    return shlex.split(re.search(r"flytune (train .*)$", message.strip())[1])


@pytest.mark.parametrize(
    ("trainer", "edit", "value", "rows"), [("apg", "updates", 7, 3), ("apg", "updates", 2, 2), ("ppo", "steps", 320, 1)]
)
def test_a_run_that_has_ended_is_not_resumed_with_more_updates_and_the_command_that_is_named_trains_them(
    runs, small_task, tmp_path, monkeypatch, capsys, trainer, edit, value, rows
):
    monkeypatch.chdir(tmp_path)
    settings = dataclasses.replace(getattr(small_task, trainer), **{edit: value})
    longer = dataclasses.replace(small_task, **{trainer: settings})
    with pytest.raises(BadInput, match=r"has ended\. To go on from its policy: flytune train ") as refused:
        train(longer, trainer, seed=1, out=Path(runs[trainer]), resume=True)
    assert main(command_in(str(refused.value))) == 0
    made = tmp_path / capsys.readouterr().out.splitlines()[-1]
    assert len((made / "metrics.jsonl").read_text().splitlines()) == rows
    assert json.loads((made / "run.json").read_text())["from"]["who"] == runs[trainer]


@pytest.mark.parametrize(
    ("source", "arguments", "reason", "remedy"),
    [
        ("apg", ["--set", "apg.hidden=[9, 8]"], r"from: a policy with layers .* Add --set 'apg.hidden=\[8, 8\]'", None),
        (
            "apg",
            ["--trainer", "ppo"],
            r"from: .*squash tanh is not allowed.* Add --trainer apg\.",
            ["--trainer", "apg"],
        ),
        ("pid", [], "from: pid has no weights to start from. Allowed: a run directory", None),
        ("dial", [], r"from: a policy with the inputs .* Give the policy at a setting, NAME@DIAL=VALUE", None),
        ("apg", ["--resume", "--out", "x"], "from: is not allowed with --resume", None),
        ("nobody", [], "nobody: no such controller", None),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line_and_nothing_is_written(
    runs, tmp_path, monkeypatch, capsys, small_edits, source, arguments, reason, remedy
):
    monkeypatch.chdir(tmp_path)

    def small(given):
        trainer = "ppo" if "ppo" in given else "apg"
        return ["--set", *(edit for edit in small_edits if edit.startswith(f"{trainer}.") or edit[3] != ".")]

    words = ["train", "baseline", "--from", runs.get(source, source)]
    assert main([*words, *small(arguments), *arguments]) == 2
    said = capsys.readouterr().err
    assert re.search(reason, said) and said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
    if remedy:
        assert main([*words, *small(remedy), *remedy]) == 0


def test_a_policy_with_a_dial_is_gone_on_from_at_a_setting_or_on_a_task_with_the_same_dial(tmp_path, monkeypatch):
    fixed = find_warm_start("dial@speed=0.5", load_task("baseline")).policy
    assert fixed.actor.sizes[0] == 17 and fixed.dials == {}
    find_trainer("apg").check_warm_start(load_task("baseline"), fixed)
    whole = find_warm_start("dial@speed=0.5", load_task("dial")).policy
    find_trainer("apg").check_warm_start(load_task("dial"), whole)
    assert list(whole.dials) == ["speed"]
