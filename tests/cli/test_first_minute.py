"""The first minute at the command line: help, version, what there is, suggestions and completion."""

import json
import re
import shlex
import subprocess
from importlib import metadata
from pathlib import Path

import pytest
from tests.command import COMMAND, flytune, refused

from flytune.cli import completion
from flytune.cli.main import main
from flytune.control.classical import CLASSICAL
from flytune.physics.vehicle import load_vehicle, vehicle_names
from flytune.runs.catalogue import catalogue
from flytune.runs.find import find_controller
from flytune.runs.shipped import shipped_names
from flytune.simulation.simulators import SIMULATORS
from flytune.task.files import load_task, preset_names

COMMANDS = (
    "train", "evaluate", "compare", "report", "map", "tune", "rules", "reproduce", "export", "list", "show", "vehicle",
    "bench", "judge", "completion",
)  # fmt: skip


def list_of(kind):
    """The names of one kind that `flytune list` prints."""
    return list(catalogue()[kind])


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_flytune_alone_explains_itself_and_names_every_command(capsys, arguments):
    assert main(arguments) == 0
    said = capsys.readouterr()
    assert all(f" {command} " in said.out for command in COMMANDS)
    assert said.err == ""


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_its_own_help(capsys, command):
    assert main([command, "--help"]) == 0
    assert capsys.readouterr().out.startswith(f"Usage: flytune {command}")


def test_the_version_is_that_of_the_package(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == metadata.version("flytune")


def test_the_list_names_everything_that_commands_take_with_a_line_each(capsys):
    assert main(["list", "--json"]) == 0
    known = json.loads(capsys.readouterr().out)
    assert known.pop("schema") == 1
    names = {kind: list(entries) for kind, entries in known.items()}
    assert names == {
        "presets": preset_names(), "vehicles": vehicle_names(), "conditions": [], "policies": shipped_names(),
        "controllers": list(CLASSICAL), "simulators": list(SIMULATORS),
    }  # fmt: skip
    lines = [line for entries in known.values() for line in entries.values()]
    assert all(line.endswith(".") and "\n" not in line and " " in line for line in lines)
    assert main(["list"]) == 0
    text = capsys.readouterr().out
    assert all(f"  {name} " in text for entries in names.values() for name in entries)
    assert all(line in text for line in lines)
    folders = dict(re.findall(r"^(\w+) \(files in (.*)\)$", text, re.MULTILINE))
    for kind, folder in folders.items():
        assert {f"{name}.toml" for name in names[kind]} <= {file.name for file in Path(folder).iterdir()}
    assert set(folders) == {"presets", "vehicles"}


def test_every_name_in_the_list_can_be_used(capsys):
    main(["list", "--json"])
    known = json.loads(capsys.readouterr().out)
    for name in known["presets"]:
        assert load_task(name).name == name
    for name in known["vehicles"]:
        assert load_vehicle(name).name == name
    for name in [*known["policies"], *known["controllers"]]:
        assert find_controller(name).name == name


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["trian", "baseline"], "Did you mean train?"),
        (["evalute", "pid"], "Did you mean evaluate?"),
        (["lst"], "Did you mean list?"),
        (["train", "baseline", "--sed", "1"], "Did you mean --seed? See: flytune train --help"),
        (["train", "baseline", "--hepl"], "Did you mean --help? See: flytune train --help"),
        (["--verison"], "Did you mean --version?"),
        (["train", "baseline", "--trainer", "pp"], "Did you mean ppo?"),
        (["show", "basline"], "Did you mean baseline?"),
    ],
)
def test_what_is_mistyped_gets_the_nearest_name(capsys, arguments, hint):
    assert hint in refused(*arguments, capsys=capsys)


@pytest.mark.parametrize("arguments", [["quux"], ["train", "baseline", "--quux"], ["train", "quux"]])
def test_what_is_near_nothing_gets_no_suggestion(capsys, arguments):
    assert "Did you mean" not in refused(*arguments, capsys=capsys)


COMPLETED = {  # words as bash splits them, the last one being typed
    "tra": {"train"},
    "": set(COMMANDS),
    "evaluate --du": {"--duration"},
    "train baseline --trainer p": {"ppo"},
    "tune --axis x ya": {"yaw"},
    "evaluate pid --world = p": {"pybullet"},
    "evaluate g": {"geometric"},
    "evaluate pid @ te": {"textbook"},
    "compare pid lq": {"lqr"},
    "compare pid lqr --task bas": {"baseline", "baseline-refined"},
    "evaluate mo": {"model.zip"},
    "evaluate runs/": {"runs/mine"},
    "train my": {"mytask.toml"},
    "show ru": {"runs/"},
    "vehicle x": {"x500"},
    "vehicle my": {"mytask.toml"},
    "judge lo": {"log.csv"},
    "judge log.csv --columns t ti": {"time="},
    "report pid --out lo": {"log.csv"},
    "train baseline --set vehicle = crazyflie-m": {"crazyflie-measured"},
    "tune --settling-time 3 --set horizon = 3 vehicle = my": {"mytask.toml"},
    "show baseline --set target": {"target.kind=", "target.position=", "target.yaw="},
    "completion z": {"zsh"},
    "evaluate nobody": set(),
}


@pytest.fixture(scope="module")
def completing(tmp_path_factory):
    """A function that gives what bash offers, in a folder with a run, a task, a model and a log."""
    folder = tmp_path_factory.mktemp("completing")
    program = folder / "bin" / "flytune"
    for each in (program, folder / "runs" / "mine" / "run.json"):
        each.parent.mkdir(parents=True)
    program.write_text(f'#!/bin/sh\nexec {shlex.join(COMMAND)} "$@"\n')
    program.chmod(0o755)
    for name in ("runs/mine/run.json", "mytask.toml", "model.zip", "log.csv"):
        (folder / name).touch()
    script = flytune("completion", "bash", cwd=folder).stdout

    def offered(typed):
        words = " ".join(shlex.quote(word) for word in [str(program), *typed.split(" ")])
        ask = f"COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); _flytune; "
        ask += "printf '%s\\n' \"${COMPREPLY[@]}\""
        answer = subprocess.run(
            ["bash", "-c", f"{script}\n{ask}"], cwd=folder, capture_output=True, text=True, check=True, timeout=120
        )
        return set(answer.stdout.split())

    return offered


@pytest.mark.parametrize("typed", COMPLETED)
def test_bash_completes_commands_options_names_and_files_and_further_values_of_an_option(completing, typed):
    assert completing(typed) == COMPLETED[typed]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_ask_for_names_as_well(capsys, shell):
    assert main(["completion", shell]) == 0
    assert "__complete" in capsys.readouterr().out


def test_what_is_completed_can_be_used(capsys):
    assert sorted(completion.CLASSICAL) == sorted(CLASSICAL)
    for typed, names in (("evaluate", list_of("policies") + list_of("controllers")), ("show", list_of("presets"))):
        assert main(["__complete", typed, ""]) == 0
        offered = [line.partition("\t")[0] for line in capsys.readouterr().out.splitlines()]
        assert [name for name in offered if name in names] == sorted(names)


def test_a_run_directory_is_also_a_task(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ["apg.environments=4", "apg.window=10", "apg.updates=1", "apg.hidden=[8, 8]"]
    answer = flytune("train", "baseline", "--set", *small, "--json", "--out", "mine", cwd=tmp_path)
    told = json.loads(answer.stdout)
    assert told["schema"] == 1 and told["directory"] == "mine"
    assert told["run"] == json.loads((tmp_path / "mine" / "run.json").read_text())
    assert told["evaluation"] == json.loads((tmp_path / "mine" / "evaluation.json").read_text())
    assert main(["show", "mine"]) == 0
    assert capsys.readouterr().out == (tmp_path / "mine" / "task.toml").read_text()
    assert main(["evaluate", "pid", "--task", "mine", "--trials", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["task"] == "baseline"
    (tmp_path / "empty").mkdir()
    assert "or a run directory" in refused("show", "empty", capsys=capsys)
