"""The command line: which commands and options exist, how they are explained, and how they are refused."""

import subprocess
import sys
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest

from flytune.cli.main import main, make_app
from flytune.cli.options import assignments

OPTIONS = {
    "train": "TASK --trainer --seed --steps --out --set --from --resume --tensorboard --json",
    "evaluate": "CONTROLLER --task --world --world-set --trials --seed --duration --starts --dial --set --json --out "
    "--flights",
    "compare": "CONTROLLER --task --world --world-set --trials --seed --duration --starts --dial --set --json --out "
    "--flights",
    "report": "CONTROLLER --task --world --world-set --trials --seed --duration --starts --dial --set --out",
    "judge": "FILE --columns --target --start --gap --json",
    "map": "CONTROLLER --dial --measure --json",
    "tune": "TASK --settling-time --at-most --tolerance --overshoot --error --axis --percentile --set --rules "
    "--trainer "
    "--iterations --seed --out --resume --json",
    "rules": "--rules --json",
    "reproduce": "--trainer --seeds --steps --refined --out --json",
    "export": "CONTROLLER --format --out",
    "list": "--json",
    "show": "TASK --set",
    "vehicle": "VEHICLE --out --json",
    "bench": "WHAT --json",
    "completion": "SHELL",
}


def parsed(*words):
    """The command, its arguments and its options."""
    command, bound, _ = make_app().parse_args(list(words), exit_on_error=False, print_error=False)
    bound.apply_defaults()
    options = dict(bound.kwargs)
    shared = vars(options.pop("options")) if "options" in options else {}
    return command.__name__, bound.args, SimpleNamespace(**shared, **options)


def test_flytune_alone_prints_the_help_and_ends_well(capsys):
    assert main([]) == 0
    alone = capsys.readouterr()
    assert main(["--help"]) == 0
    assert capsys.readouterr() == alone
    assert alone.err == ""
    assert all(f" {command} " in alone.out for command in OPTIONS)
    assert "Exit codes: 0 done, 2 bad input" in alone.out


def test_the_version_is_that_of_the_package(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == metadata.version("flytune") + "\n"


def test_the_help_imports_nothing_slow(tmp_path):
    code = (
        "import sys\nfrom flytune.cli.main import main\nassert main(sys.argv[1:]) == 0\n"
        "slow = {'jax', 'numpy', 'pydantic', 'plotly', 'matplotlib', 'markdown_it'} & set(sys.modules)\n"
        "assert not slow, f'{slow} imported too early'\n"
    )
    for words in (["--help"], ["--version"], ["tune", "--help"]):
        command = [sys.executable, "-c", code, *words]
        answer = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert answer.returncode == 0, answer.stderr


@pytest.mark.parametrize("command", OPTIONS)
def test_a_command_explains_every_option_it_has(command, capsys):
    assert main([command, "--help"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"Usage: flytune {command}")
    words = shown.replace("│", " ").replace("*", " ").split("\n")
    listed = [
        line.split()[0]
        for line in words
        if line.split() and line.split()[0].startswith(("--", "TASK", "CONT", "WHAT", "FILE", "SHELL", "VEHICLE"))
    ]
    assert [name for name in OPTIONS[command].split() if name not in listed] == []


def test_the_commands_are_those_of_the_table():
    assert [name for name in make_app() if not name.startswith("-")] == list(OPTIONS)


def test_defaults_and_units_are_shown(capsys):
    main(["evaluate", "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "number of trials [default: 100]" in shown
    assert "--duration S length of each trial, in seconds (default: the task's own)" in shown
    assert "[choices: flytune, pybullet, mujoco] [default: flytune]" in shown
    main(["tune", "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "[choices: position, x, y, z, yaw] [default: position]" in shown


def test_assignments_may_follow_one_option_or_repeat_it():
    _, arguments, options = parsed("train", "baseline", "--set", "a=1", "b=[2, 3]", "--seed", "4", "--set", "c=x y")
    assert arguments == ("baseline",)
    assert options.edits == ("a=1", "b=[2, 3]", "c=x y")
    assert options.seed == 4


def test_of_two_values_of_one_path_the_last_one_counts():
    assert assignments(("a.b=1", "c=3", "a.b=2")) == {"a.b": 2, "c": 3}


def test_a_whole_number_may_be_written_as_a_float():
    *_, options = parsed("train", "baseline", "--steps", "1e6", "--seed", "3.0")
    assert (options.steps, options.seed) == (1_000_000, 3) and isinstance(options.steps, int)


def test_an_option_that_is_given_twice_counts_as_given_last():
    *_, options = parsed("evaluate", "pid", "--seed", "3", "--trials=5", "--seed", "4")
    assert (options.seed, options.trials) == (4, 5)


def test_every_option_arrives_with_its_type():
    command, arguments, options = parsed(
        "compare", "pid", "runs/a", "--world", "mujoco", "--starts", "paper", "--duration", "2", "--json", "--out", "x"
    )
    assert (command, arguments) == ("compare", (("pid", "runs/a"),))
    assert (options.simulator, options.initial_conditions, options.duration) == ("mujoco", "paper", 2.0)
    assert options.as_json is True
    assert options.out == Path("x")
    assert options.flights is None


def test_a_bare_tuning_asks_for_what_the_help_says():
    *_, options = parsed("tune", "--settling-time", "2.5")
    assert (options.settling_time, options.tolerance, options.axis) == (2.5, 10.0, ("position",))
    assert (options.overshoot, options.error, options.percentile) == ((), (), ())  # the defaults of flytune.tune
    assert (options.trainer, options.most_iterations, options.seed) == ("apg", 12, 0)


def test_the_iterations_of_a_tuning_may_be_called_steps():
    *_, options = parsed("tune", "--settling-time", "2.5", "--steps", "3")
    assert options.most_iterations == 3


REFUSED = {
    "evalute pid": "'evalute': there is no such command. Did you mean evaluate?",
    "fly": "'fly': there is no such command. Allowed: train, evaluate,",
    "--verson": "--verson: there is no such option. Did you mean --version?",
    "evaluate pid --trails 3": "--trails: there is no such option. Did you mean --trials?",
    "evaluate pid --tria 3": "--tria: there is no such option. Did you mean --trials?",
    "train baseline --no-resume": "--no-resume: there is no such option. Did you mean --resume?",
    "evaluate pid --world mars": "--world: 'mars' is not allowed. Allowed: flytune, pybullet, mujoco.",
    "evaluate pid --starts cloudy": "--starts: 'cloudy' is not allowed. Allowed: clear, paper.",
    "evaluate pid --trials 3.7": "--trials: '3.7' is not allowed. Allowed: a whole number.",
    "evaluate pid --trials 1e-2": "--trials: '1e-2' is not allowed. Allowed: a whole number.",
    "evaluate pid --trials inf": "--trials: 'inf' is not allowed. Allowed: a whole number.",
    "evaluate pid --duration soon": "--duration: 'soon' is not allowed. Allowed: a number.",
    "evaluate pid --json=3": "--json: '3' is not allowed. Allowed: the option without a value.",
    "evaluate": "CONTROLLER: a value is missing. Give CONTROLLER: a run directory,",
    "train": "TASK: a value is missing. Give TASK: a preset",
    "train baseline --trainer sarsa": "--trainer: 'sarsa' is not allowed. Allowed: apg, ppo, sb3.",
    "train baseline --steps many": "--steps: 'many' is not allowed. Allowed: a whole number.",
    "train baseline --out": "--out: a value is missing. Give --out DIR: run directory",
    "train baseline --set": "--set: a value is missing. Give --set PATH=VALUE: change the task",
    "tune": "--settling-time: a value is missing. Give --settling-time S: wanted settling time, in seconds",
    "export pid --out x": "--format: a value is missing. Give --format onnx|safetensors:",
    "bench sleep": "WHAT: 'sleep' is not allowed. Allowed: all, train, simulate.",
    "compare pid --seed 1 lqr": "'lqr': a value is not expected here. CONTROLLER stands before the options.",
    "evaluate pid lqr": "'lqr': a value is not expected here. One CONTROLLER is allowed, before the options. `flytune "
    "compare` takes several.",
    "show a b": "'b': a value is not expected here. One TASK is allowed, before the options.",
    "list x": "'x': a value is not expected here. list takes options alone.",
    "judge f.csv --target 0 0 1 0": "--target: 4 values are not allowed. Allowed: one, X,Y,Z,YAW. Write --target "
    "0,0,1,0.",
    "judge f.csv --target -1 0": "--target: 2 values are not allowed. Allowed: one, X,Y,Z,YAW. See",
    "compare pid lqr --sets x=1": "--sets: there is no such option. Did you mean --set?",
    "map dial --set x=1": "--set: is no option of map. Edits of a task belong to train, tune and show. See",
}


@pytest.mark.parametrize("typed", REFUSED)
def test_what_is_not_understood_is_refused_with_its_remedy(typed, capsys):
    assert main(typed.split()) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(REFUSED[typed])
    command = f"{typed.split()[0]} " if typed.split()[0] in OPTIONS else ""
    assert said.err.endswith(f" See: flytune {command}--help\n")
    assert said.err.count("\n") == 1
