"""The first minute at the command line: help, version, what there is, suggestions and completion."""

import json
import subprocess
from importlib import metadata

import pytest
from tests.command import flytune, refused

from flytune.cli.main import main
from flytune.control.classical import CLASSICAL
from flytune.physics.vehicle import load_vehicle, vehicle_names
from flytune.runs.find import find_controller
from flytune.runs.shipped import shipped_names
from flytune.simulation.simulators import SIMULATORS
from flytune.task.files import load_task, preset_names

COMMANDS = (
    "train", "evaluate", "compare", "report", "map", "tune", "rules", "reproduce", "export", "list", "show", "bench",
    "judge", "completion",
)  # fmt: skip


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


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["flytune", "tra"], {"train"}),
        (["flytune", ""], set(COMMANDS)),
        (["flytune", "evaluate", "--du"], {"--duration"}),
        (["flytune", "train", "baseline", "--trainer", "p"], {"ppo"}),
    ],
)
def test_bash_completes_commands_options_and_choices(capsys, words, offered):
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    array = " ".join(f"'{word}'" for word in words)
    ask = f"COMP_WORDS=({array}); COMP_CWORD={len(words) - 1}; _flytune; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    answer = subprocess.run(["bash", "-c", f"{script}\n{ask}"], capture_output=True, text=True, check=True, timeout=60)
    assert set(answer.stdout.split()) == offered


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
