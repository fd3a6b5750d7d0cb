"""The command line as a user meets it: real processes, their output, their exit codes, and what they leave behind."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from tests.command import COMMAND, flytune, interrupted, refused

from flytune.config.files import held

SMALL = [
    "apg.environments=4",
    "apg.window=10",
    "apg.updates=4",
    "apg.hidden=[8, 8]",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("user")


@pytest.fixture(scope="module")
def run(folder):
    answer = flytune("train", "baseline", "--set", *SMALL, cwd=folder)
    lines = answer.stdout.splitlines()
    assert re.fullmatch(r"runs/baseline-apg-s0-[0-9a-f]{6}", lines[-1])  # six digits for the settings that differ
    assert lines[-2].startswith("settled ")
    assert "reward" in answer.stderr and "steps" in answer.stderr
    return lines[-1]


@pytest.mark.slow
def test_a_second_training_without_out_gets_a_number_of_its_own(folder, run):
    assert flytune("train", "baseline", "--set", *SMALL, cwd=folder).stdout.splitlines()[-1] == f"{run}-2"


@pytest.mark.slow
def test_a_training_with_other_settings_gets_another_name_and_one_without_changes_has_no_digits(folder, run):
    other = flytune("train", "baseline", "--set", *SMALL, "apg.updates=1", cwd=folder).stdout.splitlines()[-1]
    assert other != run and re.fullmatch(r"runs/baseline-apg-s0-[0-9a-f]{6}", other)
    (folder / "short.toml").write_text((folder / run / "task.toml").read_text())
    assert flytune("train", "short.toml", cwd=folder).stdout.splitlines()[-1] == "runs/baseline-apg-s0"


def test_a_directory_in_which_another_process_trains_is_refused(folder, run, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    with held(Path(run)):
        for arguments in (["baseline"], [f"{run}/task.toml", "--resume"]):
            line = refused("train", *arguments, "--out", run, capsys=capsys)
            assert line.startswith(f"out: {run} is being written by another process. Give another directory")


@pytest.mark.slow
def test_six_trainings_that_start_at_once_have_a_directory_each_and_one_gets_a_directory_that_all_ask_for(tmp_path):
    def started(*arguments):
        command = [*COMMAND, "train", "baseline", "--set", *SMALL, *arguments]
        return [subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) for _ in range(6)]

    printed = [each.communicate()[0].splitlines()[-1] for each in started()]
    assert len(set(printed)) == 6 and all((tmp_path / path / "policy.safetensors").exists() for path in printed)
    same = started("--out", "same")
    outputs = [each.communicate()[0] for each in same]
    assert sorted(each.returncode for each in same) == [0, 2, 2, 2, 2, 2]
    assert sorted(output.splitlines()[-1:] for output in outputs) == [[]] * 5 + [["same"]]


def test_evaluate_prints_exactly_one_json_object_with_the_keys_of_the_contract(folder, run):
    answer = flytune("evaluate", run, "--trials", 7, "--duration", 2, "--json", cwd=folder)
    judged = json.loads(answer.stdout)
    assert judged["schema"] == 1 and judged["trials"] == 7 and judged["duration"] == 2.0
    assert list(judged) == [
        "schema", "who", "task", "vehicle", "world", "trials", "seed", "starts", "duration", "axes", "position",
        "secondary", "infeasible", "crashed", "violations", "peak_speed", "action", "efficiency", "dial",
        "conditions",
    ]  # fmt: skip
    assert set(judged["axes"]) == {"x", "y", "z", "yaw"}
    assert json.loads((folder / run / "evaluation.json").read_text()) == judged


def test_evaluate_prints_a_table_and_writes_named_trajectories(folder, run):
    answer = flytune("evaluate", run, "--trials", 3, "--duration", 2, "--flights", "flights.npz", cwd=folder)
    assert re.search(r"^yaw\s+\d/3", answer.stdout, flags=re.MULTILINE)
    with np.load(folder / "flights.npz") as file:
        columns = list(file["columns"])
        assert file["data"].shape == (3, 201, len(columns))
        assert columns[:4] == ["time", "x", "y", "z"] and "margin_speed" in columns
        np.testing.assert_allclose(file["data"][:, :, 0], np.tile(np.arange(201) * 0.01, (3, 1)), atol=1e-6)


def test_evaluate_flies_a_bare_policy_for_the_task_in_its_header(folder, run):
    policy = Path(run) / "policy.safetensors"
    from_file = json.loads(flytune("evaluate", policy, "--trials", 3, "--json", cwd=folder).stdout)
    from_run = json.loads(flytune("evaluate", run, "--trials", 3, "--json", cwd=folder).stdout)
    assert {**from_file, "who": ""} == {**from_run, "who": ""}


def test_evaluate_writes_where_out_says_and_leaves_the_run_alone(folder, run):
    before = (folder / run / "evaluation.json").read_bytes()
    flytune("evaluate", run, "--trials", 2, "--duration", 2, "--out", "elsewhere", cwd=folder)
    assert json.loads((folder / "elsewhere" / "evaluation.json").read_text())["trials"] == 2
    assert (folder / run / "evaluation.json").read_bytes() == before


def test_report_writes_one_page(folder, run):
    answer = flytune("report", run, "--trials", 5, "--duration", 2, "--out", "page.html", cwd=folder)
    assert answer.stdout.splitlines()[-1] == "page.html"
    assert "plotly" in (folder / "page.html").read_text(encoding="utf-8")


def test_show_prints_a_task_that_can_be_trained_again(folder):
    text = flytune("show", "acrobatic", cwd=folder).stdout
    assert re.search(r"^weight = 0.08 # .*paper R12", text, flags=re.MULTILINE)
    (folder / "mine.toml").write_text(text, encoding="utf-8")
    assert flytune("show", "mine.toml", cwd=folder).stdout == text


def test_the_same_seed_gives_the_same_policy_file_from_two_processes(folder, run):
    flytune("train", "baseline", "--set", *SMALL, "--out", "again", cwd=folder)
    first = (folder / run / "policy.safetensors").read_bytes()
    assert (folder / "again" / "policy.safetensors").read_bytes() == first


BAD = [
    (["train", "basline"], "task: 'basline' is no preset"),
    (["train", "missing.toml"], "missing.toml: cannot be read"),
    (["train", "baseline", "--set", "reward.velocity.wieght=0.2"], "Did you mean reward.velocity.weight"),
    (["train", "baseline", "--set", "reward.velocity.weight=-1"], "reward.velocity.weight: -1"),
    (["train", "baseline", "--set", "reward.velocity.weight=nan"], "reward.velocity.weight: nan"),
    (["train", "baseline", "--set", "reward.velocity.weight=fast"], "reward.velocity.weight: 'fast'"),
    (["train", "baseline", "--set", "termination.speed.bound=0"], "Allowed: above 0"),
    (["train", "baseline", "--set", "nonsense"], "nonsense: not an assignment. Write path=value"),
    (["train", "baseline", "--steps", "0"], "steps: 0 is not allowed. Allowed: a whole number, 1 or more"),
    (["train", "baseline", "--seed", "-1"], "seed: -1 is not allowed"),
    (["train", "baseline", "--resume"], "resume: needs --out DIR"),
    (["train", "baseline", "--resume", "--out", "nowhere"], "resume: nowhere holds no run"),
    (["evaluate", "nobody"], "nobody: no such controller. Allowed: a run directory"),
    (["evaluate", "broken.safetensors"], "broken.safetensors: is not a policy"),
    (["report", "nobody"], "nobody: no such controller. Allowed: a run directory"),
    (["show", "basline"], "Did you mean baseline?"),
]


@pytest.mark.parametrize(("arguments", "reason"), BAD, ids=[" ".join(arguments) for arguments, _ in BAD])
def test_bad_input_is_one_clear_line_exit_code_two_and_nothing_written(
    tmp_path, monkeypatch, capsys, arguments, reason
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.safetensors").write_bytes(b"\x00\x01garbage")
    assert reason in refused(*arguments, capsys=capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["broken.safetensors"]


def test_a_process_that_refuses_ends_with_code_two_and_prints_nothing(tmp_path):
    answer = flytune("show", "basline", cwd=tmp_path, expect=2)
    assert (answer.stdout, answer.stderr.count("\n")) == ("", 1)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--trials", "0"], "trials: 0 is not allowed. Allowed: a whole number, 1 to 100000"),
        (["--duration", "nan"], "duration: nan is not allowed. Allowed: above 0.5 to 3600 s"),
        (["--duration", "0.2"], "duration: 0.2 is not allowed. Allowed: above 0.5 to 3600 s"),
        (["--seed", "-3"], "seed: -3 is not allowed. Allowed: a whole number, 0 to 4294967295"),
        (["--task", "basline"], "task: 'basline' is no preset"),
        (["--flights", "no/such/folder/f.npz"], "flights: no/such/folder is no folder"),
        (["--flights", "."], "flights: . is a folder. Give a file"),
    ],
)
def test_bad_trials_are_refused_before_anything_flies(folder, run, monkeypatch, capsys, arguments, reason):
    monkeypatch.chdir(folder)
    before = (folder / run / "evaluation.json").read_bytes()
    assert reason in refused("evaluate", run, *arguments, capsys=capsys)
    assert (folder / run / "evaluation.json").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "content"), [("run.json", "{}"), ("run.json", "[]"), ("metrics.jsonl", "3\n"), ("metrics.jsonl", "{")]
)
def test_a_damaged_run_is_named_and_refused(folder, run, tmp_path, monkeypatch, capsys, name, content):
    shutil.copytree(folder / run, tmp_path / "run")
    (tmp_path / "run" / name).write_text(content)
    monkeypatch.chdir(tmp_path)
    assert refused("evaluate", "run", capsys=capsys).startswith(f"run/{name}: is damaged")


def test_a_directory_that_holds_a_run_is_refused(folder, run, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before = {path: path.read_bytes() for path in (folder / run).rglob("*") if path.is_file()}
    line = refused("train", "baseline", "--set", *SMALL, "--out", run, capsys=capsys)
    assert line.startswith(f"out: {run} already holds a run")
    assert {path: path.read_bytes() for path in (folder / run).rglob("*") if path.is_file()} == before


def test_a_training_that_diverges_ends_with_exit_code_three_and_says_what_and_when(folder):
    edits = [*SMALL, "apg.learning_rate=1e38"]
    answer = flytune("train", "baseline", "--set", *edits, "--out", "diverged", cwd=folder, expect=3)
    assert re.search(r"is -?(nan|inf) in update \d+", answer.stderr)


@pytest.mark.slow
def test_ctrl_c_saves_a_checkpoint_exits_with_130_and_resumes_to_the_same_policy(folder):
    edits = [edit for edit in SMALL if "updates" not in edit] + ["apg.updates=40"]
    train = ["train", "baseline", "--set", *edits]
    whole = flytune(*train, "--out", "whole", cwd=folder)
    assert whole.stdout.splitlines()[-1] == "whole"
    message = interrupted(*train, "--out", "cut", cwd=folder, at="10 %")
    assert "cut/checkpoint" in message
    assert "flytune train cut/task.toml --trainer apg --seed 0 --out cut --resume" in message
    assert not (folder / "cut" / "policy.safetensors").exists()
    assert "has not ended" in flytune("evaluate", "cut", cwd=folder, expect=2).stderr
    flytune(*["train", "cut/task.toml", "--trainer", "apg", "--seed", "0", "--out", "cut", "--resume"], cwd=folder)
    assert (folder / "cut" / "policy.safetensors").read_bytes() == (
        folder / "whole" / "policy.safetensors"
    ).read_bytes()


@pytest.mark.slow
def test_bench_prints_one_json_object_of_rates(folder):
    rates = json.loads(flytune("bench", "--json", cwd=folder, timeout=1200).stdout)
    assert rates["ppo"] > 0 and rates["apg"] > 0 and rates["simulate"] > 0
    assert rates["spread"].keys() == {"ppo", "apg", "simulate"}
    assert rates["requirement"]["met"] and len(rates["requirement"]["warm"]) == 3
    assert 0 < rates["ppo_share_of_limit"] < 1.5 and 0 < rates["apg_share_of_limit"] < 1.5
    assert all(row["steps_per_second"] or row["missing"] for row in rates["training"] + rates["simulation"])
