"""`flytune tune` and `flytune rules` as a user meets them: real processes, exit codes, and what they leave behind."""

import json
import re

import pytest
from tests.command import flytune, interrupted, refused

from flytune.tuning.rules import load_rules


def test_the_rules_are_printed_as_a_table_and_as_json(tmp_path):
    table = flytune("rules", cwd=tmp_path).stdout
    told = json.loads(flytune("rules", "--json", cwd=tmp_path).stdout)
    assert [rule["name"] for rule in told["rules"]] == [rule.name for rule in load_rules()]
    assert all(rule["name"] in table and rule["source"] in table for rule in told["rules"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--settling-time", "2500"], "Did you mean 2.5"),
        (["--settling-time", "-2"], "settling-time: -2 is not allowed. Allowed: 0.2 to 60 s"),
        (["--settling-time", "3", "--overshoot", "0.05"], "Did you mean 5"),
        (["--settling-time", "3", "--error", "5"], "Did you mean 0.005"),
        (["--settling-time", "1", "--set", "termination.speed.bound=0.8"], "the speed bound of 0.8 m/s you have set"),
        (["--settling-time", "0.3"], "times the weight"),
        (["nobody", "--settling-time", "3"], "is no preset"),
        (["--settling-time", "3", "--overshoot", "much"], "--overshoot: 'much' is not allowed. Allowed: a number, or"),
        (["--settling-time", "3", "--error", "yaw=1"], "error: 'yaw' is not asked for. Allowed: position; add it"),
        (["--settling-time", "3", "--axis", "roll"], "--axis: 'roll' is not allowed"),
        (["--settling-time", "3", "--set", "reward.velocity.wieght=1"], "Did you mean reward.velocity.weight"),
        (["--settling-time", "3", "--rules", "none.toml"], "none.toml: cannot be read"),
        (["--settling-time", "3", "--resume"], "resume: needs --out DIR"),
        (["--settling-time", "3", "--out", "none", "--resume"], "holds no tuning"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    assert said in refused("tune", *arguments, capsys=capsys)
    assert list(tmp_path.iterdir()) == []


def test_a_known_response_is_found_at_once_and_flies_everywhere_a_run_does(tmp_path):
    arguments = ["tune", "--settling-time", "3", "--tolerance", "30"]
    told = json.loads(flytune(*arguments, "--json", "--out", "told", cwd=tmp_path).stdout)
    assert (told["schema"], told["met"], told["directory"]) == (1, True, "told")
    answer = flytune(*arguments, "--out", "mine", cwd=tmp_path)
    assert answer.stdout.splitlines()[-1] == "mine"
    judged = json.loads(flytune("evaluate", "mine", "--json", cwd=tmp_path).stdout)
    assert judged["position"]["settled"] == 100
    kept = {path.name for path in (tmp_path / "mine").iterdir()}
    assert {"task.toml", "run.json", "policy.safetensors", "evaluation.json", "tune.json", "report.html"} <= kept
    assert (
        "tuned: trials last more than twice the wanted settling time" in (tmp_path / "mine" / "task.toml").read_text()
    )
    assert "already holds" in flytune("tune", "--settling-time", "3", "--out", "mine", cwd=tmp_path, expect=2).stderr


def test_several_axes_are_asked_for_at_once_each_with_its_own_bounds(tmp_path):
    arguments = [
        "--axis",
        "position",
        "yaw",
        "--overshoot",
        "5",
        "yaw=8",
        "--error",
        "yaw=0.5",
        "--percentile",
        "yaw=90",
    ]
    answer = flytune("tune", "--settling-time", "4", *arguments, "--json", cwd=tmp_path)
    told = json.loads(answer.stdout)
    assert told["met"]
    assert re.search(r"settles in [\d.]+ s \(position\), [\d.]+ s \(yaw\), overshoot", answer.stderr)
    assert (
        "yaw settles no later (percentile 90 of the trials), overshoot at most 8 %, error at most 0.5 deg"
        in told["title"]
    )
    page = (tmp_path / told["directory"] / "report.html").read_text()
    assert "yaw: settling time, percentile 90" in page and "yaw: overshoot, median" in page


@pytest.mark.slow
def test_what_cannot_be_met_ends_with_code_4_the_reason_and_the_best_so_far(tmp_path):
    arguments = ["tune", "baseline-refined", "--settling-time", "6", "--iterations", "1", "--set", "apg.updates=1"]
    answer = flytune(*arguments, "--out", "mine", cwd=tmp_path, expect=4)
    assert answer.stdout.splitlines()[-1] == "mine"
    assert answer.stderr.splitlines()[-1].startswith("not met: ")
    assert "1 edits were made" in answer.stderr
    assert not json.loads((tmp_path / "mine" / "tune.json").read_text())["met"]
    flytune("evaluate", "mine", "--trials", "5", cwd=tmp_path)


@pytest.mark.slow
def test_an_interrupted_tuning_keeps_its_steps_and_goes_on(tmp_path):
    arguments = ["tune", "baseline-refined", "--settling-time", "5", "--out", "mine"]
    message = interrupted(*arguments, cwd=tmp_path, at="50 %")
    assert "interrupted in iteration 1" in message
    before = json.loads((tmp_path / "mine" / "tune.json").read_text())
    assert [each["number"] for each in before["iterations"]] == [0]
    flytune(*arguments, "--resume", cwd=tmp_path, timeout=900)
    after = json.loads((tmp_path / "mine" / "tune.json").read_text())
    assert after["met"]
    assert after["iterations"][0] == before["iterations"][0]
    # one that has ended is told again, and judged no further
    flytune(*arguments, "--resume", cwd=tmp_path)
    assert json.loads((tmp_path / "mine" / "tune.json").read_text()) == after


@pytest.mark.slow
def test_an_interrupted_first_training_goes_on_where_it_was(tmp_path):
    arguments = ["tune", "baseline", "--settling-time", "5", "--out", "mine", "--steps", "1", "--set", "apg.updates=30"]
    message = interrupted(*arguments, cwd=tmp_path, at="50 %")
    assert "interrupted in iteration 0" in message
    assert "--out mine and --resume" in message
    assert json.loads((tmp_path / "mine" / "tune.json").read_text())["iterations"] == []
    flytune(*arguments, "--resume", cwd=tmp_path, expect=4)
    rows = (tmp_path / "mine" / "iterations" / "00" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(row)["update"] for row in rows] == list(range(1, 31))
