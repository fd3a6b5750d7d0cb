"""What the README tells a newcomer to type."""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    flytune (.*)$", README, flags=re.MULTILINE)


# what makes a command small enough for a test: documented options, added behind those of the README
SMALL = {
    "train": "--set apg.updates=2",
    "tune": "--trainer apg --steps 1 --set apg.updates=2",
    "reproduce": "--seeds 1 --steps 1",
    "evaluate": "--trials 10",
    "compare": "--trials 10",
    "report": "--trials 10",
}
SMALL_SB3 = "--set ppo.environments=4 ppo.rollout=32 ppo.steps=128"


def is_for_sb3(command):
    """Whether a command needs Stable-Baselines3, which is a large download."""
    return any(word in command.split("#")[0] for word in ("sb3", ".zip"))


def run_small(command, folder, codes=(0,)):
    """A command of the README in a real shell, with its slow parts made small."""
    typed, *to_a_file = command.split("#")[0].split(" > ")
    small = SMALL_SB3 if "sb3" in typed else SMALL.get(typed.split()[0], "")
    line = " > ".join([f"{shlex.quote(sys.executable)} -m flytune {typed} {small}", *to_a_file])
    answer = subprocess.run(["sh", "-c", line], cwd=folder, capture_output=True, text=True, timeout=900, check=False)
    assert answer.returncode in codes, f"{command}\n{answer.stderr}"
    assert answer.stdout or to_a_file, command
    if typed.startswith("train"):  # the name tells that it was made small; the commands after it know the usual one
        made = folder / answer.stdout.splitlines()[-1]
        usual = made.with_name(re.sub(r"-[0-9a-f]{6}$", "", made.name))
        if not usual.exists():
            made.rename(usual)


@pytest.mark.slow
def test_the_commands_of_the_readme_run_one_after_the_other(tmp_path):
    for package in ("pybullet", "onnxruntime"):
        pytest.importorskip(package, reason=f"the README uses {package}")
    for command in COMMANDS:
        if not is_for_sb3(command):
            # two updates rarely reach the response that was asked for, and 4 is how `tune` says so
            run_small(command, tmp_path, codes=(0, 4) if command.startswith("tune") else (0,))
    made = {path.name for path in tmp_path.iterdir()}
    assert {"runs", "report.html", "gentle", "comparison", "policy.onnx", "repro", "mine.toml"} <= made
    assert (tmp_path / "repro" / "verdicts.json").exists()
    trained = [command for command in COMMANDS if command.startswith("train") and not is_for_sb3(command)]
    assert len(list((tmp_path / "runs").glob("*-apg-s0*/policy.safetensors"))) == len(trained) > 3


@pytest.mark.slow
def test_the_commands_of_the_readme_that_need_stable_baselines3_run(tmp_path):
    stable_baselines3 = pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")
    from flytune.adapters.vec_env import HoverVecEnv
    from flytune.task.files import load_task

    model = stable_baselines3.PPO("MlpPolicy", HoverVecEnv(load_task("baseline"), 2), n_steps=8, batch_size=16)
    model.save(tmp_path / "model.zip")
    commands = [command for command in COMMANDS if is_for_sb3(command)]
    assert len(commands) == 2
    for command in commands:
        run_small(command, tmp_path)


def test_every_edit_of_the_readme_changes_the_task():
    from flytune.config.document import parse_assignment
    from flytune.task.files import load_task, write_task

    typed = [shlex.split(command, comments=True) for command in COMMANDS if " --set " in command]
    edits = [word for words in typed for word in words if "=" in word]
    assert edits
    for edit in edits:
        path, value = parse_assignment(edit)
        assert write_task(load_task("baseline", {path: value})) != write_task(load_task("baseline"))


def test_every_file_the_readme_links_to_is_there():
    links = re.findall(r"\]\(([^)]+)\)", README)
    assert links
    assert [link for link in links if not (ROOT / link.partition("#")[0]).exists()] == []


def test_the_names_the_readme_lists_are_the_ones_that_ship():
    from flytune.control.classical import CLASSICAL
    from flytune.physics.vehicle import vehicle_names
    from flytune.task.files import preset_names
    from flytune.training.trainer import TRAINERS

    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    first_cells = re.findall(r"^\| (`[^|]+`)", README, flags=re.MULTILINE)
    listed = {name for cell in first_cells for name in re.findall(r"`([\w-]+)`", cell)}
    ours = {*preset_names(), *vehicle_names(), *TRAINERS, *CLASSICAL, *extras} - {"build", "dev", "docs"}
    assert ours == listed


@pytest.mark.slow
def test_the_python_example_runs_as_it_stands(tmp_path):
    (example,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    answer = subprocess.run(
        [sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False
    )
    assert answer.returncode == 0, answer.stderr
    assert "100/100" in answer.stdout
