"""The closed loop, with real trainings from policies that ship: it meets what is asked, and loses nothing."""

import json
import shutil

import numpy as np
import pytest

from flytune.control.policy import load_policy
from flytune.errors import BadInput
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import judge
from flytune.runs.find import find_controller
from flytune.task.task import load_task
from flytune.tuning.requirement import make_requirement
from flytune.tuning.rules import Rule, load_rules
from flytune.tuning.search import tune

RULES = load_rules()


def test_what_a_known_policy_already_does_takes_no_training(tmp_path):
    measured = judge(fly(*_known("baseline-refined"), trials=100, seed=3000)).to_dict()
    time = measured["position"]["settling_time"]["median"]
    said = []
    result = tune(make_requirement(time), RULES, tmp_path / "t", tell=said.append)
    assert result.met
    assert result.best == 0
    assert result.start == "baseline-refined"
    assert [line.split()[0] for line in said] == ["asked", "tuning", "start", "step", "fresh", "done"]
    controller = find_controller(str(tmp_path / "t"))
    assert judge(fly(controller.controller, controller.task, seed=7)).settled("position") == 100


def test_what_physics_forbids_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(BadInput, match="whoever flies"):
        tune(make_requirement(1.0), RULES, tmp_path / "t", edits={"termination.speed.bound": 0.8})
    assert not (tmp_path / "t").exists()


def test_a_directory_that_holds_a_run_is_refused_and_kept(tmp_path):
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(BadInput, match="already holds"):
        tune(make_requirement(3.0), RULES, tmp_path)
    assert (tmp_path / "run.json").read_text() == "{}"


def test_to_resume_needs_a_tuning_that_was_asked_for_the_same(tmp_path):
    with pytest.raises(BadInput, match="holds no tuning"):
        tune(make_requirement(3.0), RULES, tmp_path / "none", resume=True)
    fixed = {"apg.updates": 1}
    tune(make_requirement(3.4), RULES, tmp_path / "t", edits=fixed, most_steps=1)
    with pytest.raises(BadInput, match="another requirement"):
        tune(make_requirement(3.0), RULES, tmp_path / "t", edits=fixed, resume=True)
    (tmp_path / "t" / "tune.json").write_text("{")
    with pytest.raises(BadInput, match="damaged"):
        tune(make_requirement(3.4), RULES, tmp_path / "t", edits=fixed, resume=True)


def test_starts_of_a_verdict_that_disappoints_become_tuning_starts_and_a_resumed_tuning_knows_them(tmp_path):
    # the median yaw of the tuning starts is not that of others, and 2 % of tolerance tell them apart
    policy, task = _known("baseline-refined")
    tuning, others = (judge(fly(policy, task, trials=n, seed=s)) for n, s in ((100, 3000), (200, 4000)))
    time, elsewhere, everywhere = (
        make_requirement(1, axis="yaw").measure(*judged).settling_time
        for judged in ((tuning,), (others,), (tuning, others))
    )
    assert abs(elsewhere / time - 1) > 0.02
    said = []
    wanted = make_requirement(time, axis="yaw", tolerance=2)
    fixed = {"apg.updates": 1}
    result = tune(wanted, RULES, tmp_path / "t", task="baseline-refined", edits=fixed, most_steps=1, tell=said.append)
    first = result.verdicts[0]
    assert (first.step, set(first.misses)) == (0, {"settling_time"})
    assert "step 0 on all 300 starts seen so far" in next(line for line in said if line.startswith("again"))
    assert result.steps[0].measured.settling_time == everywhere
    told = json.loads((tmp_path / "t" / "tune.json").read_text())
    # cut off between the verdict and the second look
    told["steps"] = [told["steps"][0] | {"looks": 1, "measured": wanted.measure(tuning).to_dict()}]
    told["verdicts"] = told["verdicts"][:1]
    shutil.rmtree(tmp_path / "t" / "steps" / "01", ignore_errors=True)
    (tmp_path / "t" / "tune.json").write_text(json.dumps(told))
    again = tune(wanted, RULES, tmp_path / "t", task="baseline-refined", edits=fixed, most_steps=1, resume=True)
    assert [step.measured for step in again.steps] == [step.measured for step in result.steps]
    assert [verdict.seed for verdict in again.verdicts] == [verdict.seed for verdict in result.verdicts]


def test_a_training_that_diverges_is_a_step_that_is_not_gone_on_from(tmp_path):
    # a gradient of 5e18 has a finite square in float32, nine times as much has not
    (tmp_path / "stiff.toml").write_text('based_on = "baseline"\n[reward.smoothness]\nweight = 3e20\n')
    rule = Rule(
        name="stiffer", when="unsettled", field="reward.smoothness.weight", direction="up", slope=0.1, largest=9.0,
        range=(1e-4, 1e25), says="it is stiffer", source="test",
    )  # fmt: skip
    said = []
    arguments = {"task": str(tmp_path / "stiff.toml"), "edits": {"apg.updates": 2}, "most_steps": 3}
    result = tune(make_requirement(2.0), [rule], tmp_path / "t", tell=said.append, **arguments)
    assert [bool(step.diverged) for step in result.steps] == [False, True]
    assert any(line.startswith("step 1   diverged: training: ") for line in said)
    assert result.best == 0
    again = tune(make_requirement(2.0), [rule], tmp_path / "t", resume=True, **arguments)
    assert (again.steps, again.verdicts) == (result.steps, result.verdicts)


def test_what_has_ended_without_success_stays_as_it_is_when_resumed(tmp_path):
    rules = [rule for rule in RULES if rule.name == "H6 faster"]
    fixed = {"apg.updates": 1}
    first = tune(make_requirement(2.0), rules, tmp_path / "t", edits=fixed, most_steps=2)
    assert not first.met
    again = tune(make_requirement(2.0), rules, tmp_path / "t", edits=fixed, most_steps=2, resume=True)
    assert (again.steps, again.verdicts, again.best) == (first.steps, first.verdicts, first.best)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seed": -1}, r"seed: -1 is not allowed"),
        ({"edits": {"termination.speed": {"kind": "maximum_speed", "bound": 0.8}}}, "the speed bound of 0.8 m/s you"),
        ({"trainer": "sb3"}, "trainer: 'sb3' is not allowed"),
        ({"task": "n" * 300}, "is no preset"),
    ],
)
def test_what_cannot_be_tuned_is_refused_before_anything_is_written(tmp_path, changes, said):
    with pytest.raises(BadInput, match=said):
        tune(make_requirement(1.0), RULES, tmp_path / "t", **changes)
    assert not (tmp_path / "t").exists()


def test_a_directory_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file" / "t", tmp_path / ("n" * 300)):
        with pytest.raises(BadInput, match="cannot be written"):
            tune(make_requirement(3.0), RULES, out, task="baseline-refined")


@pytest.mark.slow
def test_a_response_twice_as_slow_is_met_and_a_resumed_tuning_is_the_same(tmp_path):
    wanted = make_requirement(6.0)
    said = []
    result = tune(wanted, RULES, tmp_path / "whole", tell=said.append)
    assert result.met, said
    judged = result.verdicts[-1].judgement
    assert judged["trials"] == 200
    assert judged["position"]["settling_time"]["median"] == pytest.approx(6.0, rel=0.1)
    assert judged["position"]["settled"] >= 198
    # the edits are in the task that is written, with their reasons
    task = load_task(tmp_path / "whole" / "task.toml")
    assert 0.3 < task.speed_bound < 0.5
    assert "H7" in task.sources["termination.speed.bound"]
    # cut off after its first edit, it goes on to the same end
    shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    for name in ("policy.safetensors", "task.toml"):
        (tmp_path / "cut" / name).unlink()
    told = json.loads((tmp_path / "cut" / "tune.json").read_text())
    for step in told["steps"][2:]:
        shutil.rmtree(tmp_path / "cut" / "steps" / f"{step['number']:02d}")
    told["steps"], told["verdicts"] = told["steps"][:2], []
    (tmp_path / "cut" / "tune.json").write_text(json.dumps(told))
    again = tune(wanted, RULES, tmp_path / "cut", resume=True)
    assert [step.values for step in again.steps] == [step.values for step in result.steps]
    for one, other in zip(*(_weights(tmp_path / name) for name in ("whole", "cut")), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_what_no_rule_can_reach_ends_with_the_best_and_the_reasons(tmp_path):
    # every parameter but one is fixed, and that one hardly matters
    fixed = {"termination.speed.bound": 0.8, "apg.updates": 60}
    rules = [rule for rule in RULES if rule.name == "H1 bolder"]
    result = tune(make_requirement(2.6), rules, tmp_path / "t", task="baseline-refined", edits=fixed, most_steps=3)
    assert not result.met
    assert "too slow" in result.why()
    assert (tmp_path / "t" / "policy.safetensors").exists()


def _known(name):
    controller = find_controller(name)
    return controller.controller, controller.task


def _weights(directory):
    return load_policy(directory / "policy.safetensors").actor.weights
