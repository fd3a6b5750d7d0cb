"""What the README tells a newcomer to type."""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from flytune.cli.main import make_app

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    flytune (.*)$", README, flags=re.MULTILINE)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_of_the_readme_is_understood(command):
    words = shlex.split(command.split(" > ")[0], comments=True)
    command, _, _ = make_app().parse_args(words, exit_on_error=False, print_error=False)
    assert command.__name__ == words[0]


def test_every_edit_of_the_readme_changes_the_task():
    from flytune.config.document import parse_assignment
    from flytune.task.task import load_task, write_task

    edits = [word for command in COMMANDS for word in shlex.split(command, comments=True) if "=" in word]
    assert edits
    for edit in edits:
        path, value = parse_assignment(edit)
        assert write_task(load_task("baseline", {path: value})) != write_task(load_task("baseline"))


def test_every_file_the_readme_links_to_is_there():
    links = re.findall(r"\]\(([^)]+)\)", README)
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_the_names_the_readme_lists_are_the_ones_that_ship():
    from flytune.control.classical import CLASSICAL
    from flytune.physics.vehicle import vehicle_names
    from flytune.task.task import preset_names
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
