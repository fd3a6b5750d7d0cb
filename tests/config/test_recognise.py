"""What a name stands for that is in the wrong place: said in one line, with its use."""

import dataclasses
from pathlib import Path

import pytest

from flytune.config.recognise import CONTROLLER, FLIGHTS, KEYS, RULES, SHIPPED, TASK, VEHICLE, meant, misplaced, runs_in
from flytune.control.classical import CLASSICAL
from flytune.physics.vehicle import Vehicle, vehicle_names
from flytune.runs.shipped import shipped_names
from flytune.task.files import preset_names
from flytune.task.task import Task

FILES = {
    "v.toml": ("mass = 1.0\n", "a vehicle file", VEHICLE),
    "part.toml": ("arm = 0.1\n", "a vehicle file", VEHICLE),
    "t.toml": ('based_on = "baseline"\n', "a task file", TASK),
    "whole.toml": ('name = "mine"\n[reward.survival]\nreward = 0.1\n[vehicle]\nmass = 1.0\n', "a task file", TASK),
    "r.toml": ("[[rule]]\n", "a file of rules", RULES),
    "p.safetensors": ("", "a policy file", CONTROLLER),
    "p.onnx": ("", "a policy file", CONTROLLER),
    "p.zip": ("", "a policy file", CONTROLLER),
    "log.csv": ("", "a log", FLIGHTS),
    "f.npz": ("", "a file of arrays", FLIGHTS),
}
NAMES = {"baseline": TASK, "crazyflie": VEHICLE, "pid": CONTROLLER, "lqr@textbook": CONTROLLER,
         "baseline-refined@ppo": CONTROLLER, "dial@speed=0.5": CONTROLLER}  # fmt: skip
WANTED = (TASK, CONTROLLER, VEHICLE, FLIGHTS, RULES)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, (text, _, _) in FILES.items():
        Path(name).write_text(text)
    for name in ("runs/mine", "runs/baseline-apg-s0", "runs/empty"):
        Path(name).mkdir(parents=True)
    for name in ("runs/mine", "runs/baseline-apg-s0"):
        Path(name, "run.json").write_text("{}")


@pytest.mark.parametrize("wanted", WANTED)
@pytest.mark.parametrize("name", FILES)
def test_a_file_is_refused_everywhere_but_in_its_own_place(here, name, wanted):
    _, words, kind = FILES[name]
    line = misplaced(name, wanted)
    assert line is None if kind == wanted else line.startswith(f"{name} is {words}, not {wanted}. ")


@pytest.mark.parametrize("wanted", WANTED)
@pytest.mark.parametrize("name", NAMES)
def test_a_name_that_ships_is_refused_everywhere_but_in_its_own_place(name, wanted):
    line = misplaced(name, wanted)
    assert (
        line is None
        if NAMES[name] == wanted
        else line.startswith(f"{name} is {NAMES[name]} that ships with flytune, not {wanted}. ")
    )


def test_a_name_of_a_task_and_of_a_policy_is_both():
    assert misplaced("dial", TASK) is None and misplaced("dial", CONTROLLER) is None


def test_what_is_in_a_run_directory_leads_to_the_directory(here):
    assert misplaced("runs/mine", FLIGHTS) == (
        "runs/mine is a run directory, not flights. Fly its policy: flytune evaluate runs/mine; or see its task: "
        "flytune show runs/mine."
    )
    assert misplaced("runs/mine/run.json", CONTROLLER) == (
        "runs/mine/run.json is a record of the run runs/mine, not a controller. Give the run directory."
    )
    Path("runs/mine/task.toml").write_text('based_on = "baseline"\n')
    assert "Did you mean its run, runs/mine?" in misplaced("runs/mine/task.toml", CONTROLLER)


def test_a_task_in_place_of_a_controller_names_its_policies(here):
    line = misplaced("baseline", CONTROLLER)
    assert "Did you mean baseline-refined or runs/baseline-apg-s0? Train for it: flytune train baseline;" in line


@pytest.mark.parametrize("name", ["nothing", "no.toml", "runs/empty", "here.txt", "n" * 5000, "", "a\nb"])
def test_of_what_is_not_known_nothing_is_said(here, name):
    assert all(misplaced(name, wanted) is None for wanted in WANTED)


@pytest.mark.parametrize(
    ("typed", "wanted", "hint"),
    [
        ("mine", CONTROLLER, "runs/mine"), ("miner", CONTROLLER, "runs/mine"), ("runs/mien", CONTROLLER, "runs/mine"),
        ("mine", TASK, "runs/mine"), ("pids", CONTROLLER, "pid"), ("p", CONTROLLER, "p.onnx"),
        ("p.onx", CONTROLLER, "p.onnx"), ("whloe.toml", TASK, "whole.toml"), ("whole", TASK, "whole.toml"),
        ("whole", VEHICLE, ""), ("parts.toml", VEHICLE, "part.toml"), ("parts.toml", TASK, ""),
        ("lgo.csv", FLIGHTS, "log.csv"),
        ("mine", FLIGHTS, ""), (".", TASK, ""), ("quux", CONTROLLER, ""), ("nowhere/mine", CONTROLLER, ""),
        ("n" * 5000, CONTROLLER, ""),
    ],
)  # fmt: skip
def test_an_unknown_name_gets_the_nearest_name_file_or_run_of_its_kind(here, typed, wanted, hint):
    suffixes = {CONTROLLER: [".onnx"], FLIGHTS: [".csv"]}.get(wanted, [".toml"])
    names = CLASSICAL if wanted == CONTROLLER else []
    assert meant(typed, wanted, names, suffixes) == (f" Did you mean {hint}?" if hint else "")


def test_a_folder_says_which_runs_it_holds(here):
    assert runs_in("runs") == " It holds the runs runs/baseline-apg-s0, runs/mine."
    assert runs_in("runs/empty") == runs_in("nowhere") == ""


def test_the_names_that_ship_and_the_keys_of_files_are_those_of_the_package():
    shipped = {kind: set() for kind in SHIPPED.values()}
    for name in (*preset_names(), *vehicle_names(), *CLASSICAL, *shipped_names()):
        for kind in shipped:
            if misplaced(name, kind) is None:
                shipped[kind].add(name)
    assert shipped == {
        TASK: set(preset_names()), VEHICLE: set(vehicle_names()), CONTROLLER: {*CLASSICAL, *shipped_names()},
    }  # fmt: skip
    fields = {kind: {field.name for field in dataclasses.fields(kind)} for kind in (Task, Vehicle)}
    assert KEYS[TASK] - {"based_on"} <= fields[Task] and not KEYS[TASK] & fields[Vehicle]
    assert KEYS[VEHICLE] <= fields[Vehicle] and not KEYS[VEHICLE] & fields[Task]
