"""Every remedy that a message names is followed as it is printed, and then the command works.

Commands that a message prints whole are run word for word. Those of logs are in `test_judge.py`, those of trainings
that have ended in `tests/training/test_warm_start.py`.
"""

import dataclasses
import re
import shlex
import shutil
import tomllib
from pathlib import Path

import jax
import pytest
from tests.command import refused

import flytune
from flytune.cli.main import main
from flytune.control.policy import load_policy, save_policy
from flytune.runs.directory import CHECKPOINT, RunDirectory
from flytune.task.files import load_task
from flytune.training.trainer import find_trainer
from flytune.tuning.asked import make_requirement

ROOT = Path(__file__).parents[2]
FLY = ["--trials", "1", "--duration", "1"]
TINY = ["apg.environments=4", "apg.window=10", "apg.updates=1", "apg.hidden=[8, 8]", "duration=1.0"]
MINE = ["evaluate", "mine", *FLY]


@pytest.fixture
def here(tmp_path, monkeypatch, small_run):
    """A folder with a run `mine` that has ended, and one, `begun`, that was interrupted after an update."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(small_run, "mine")
    task = load_task(small_run / "task.toml")
    directory, method = RunDirectory(Path("begun"), task, "apg", 0, resume=False), find_trainer("apg")
    directory.checkpoint(method.start(task, jax.random.key(0)), [])
    (tmp_path / "file").touch()
    (tmp_path / "mine.toml").write_text('based_on = "baseline"\n[apg]\nleeway = 0.5\n')
    (tmp_path / "task.toml").write_text('based_on = "baseline"\nduration = 1.0\n')
    (tmp_path / "notes.html").write_text("mine")
    shutil.copytree(small_run, Path("runs") / "known")
    (tmp_path / "rules.toml").write_text("")
    return tmp_path


def swap(old, new):
    """A remedy: another word in place of one that was typed. The new one may be a group of the message."""

    def repaired(arguments, match):
        word = match[1] if new is None else new
        return [word if each == old else each.replace(old, word) if "=" in each else each for each in arguments]

    return repaired


def add(*words):
    """A remedy: further words."""
    return lambda arguments, match: [*arguments, *words]


def beside(word):
    """A remedy: one more controller."""
    return lambda arguments, match: [arguments[0], word, *arguments[1:]]


def drop(*words):
    """A remedy: words that are left out."""
    return lambda arguments, match: [each for each in arguments if each not in words]


def printed(arguments, match):
    """A remedy that the message prints as a whole command."""
    return shlex.split(match[1])


def nearer(arguments, match):
    """A remedy: a settling time within the range that the message names."""
    return ["evaluate", f"dial@settling_time={float(match[1]) - 0.1:.2f}", *FLY]


EVALUATE = ["evaluate", "pid", *FLY]
NEW = ["--out", "new", "--resume"]
REMEDIES = [  # what is typed, what the message says, and what is typed after reading it
    (["shw", "baseline"], r"Did you mean (\w+)\?", swap("shw", None)),
    (["show", "basline"], r"Did you mean ([\w-]+)\?", swap("basline", None)),
    (["show", "none.toml"], r"Give a TOML file or a preset's name", swap("none.toml", "baseline")),
    (["show", "mine.toml"], r"apg\.leeway: is called (apg\.\w+) now\. Write", "rename"),
    (["train", "baseline", "--resume", "--set", *TINY], r"resume: needs --out DIR", drop("--resume")),
    (["train", "baseline", *NEW, "--set", *TINY], r"Leave out (--resume) to start", drop("--resume")),
    (["train", "mine/task.toml", "--out", "mine"], r"Give another directory, or (--resume) to", add("--resume")),
    (["train", "mine/task.toml", "--out", "mine"], r"Give another directory", swap("mine", "other")),
    (["train", "mine/task.toml", "--out", "file"], r"Give a directory that does not exist", swap("file", "other")),
    (["train", "mine/task.toml", "--seed", "3", "--out", "mine", "--resume"], r"with apg, seed (0),", swap("3", None)),
    (["train", "mine/task.toml", "--out", "begun", "--resume", "--set", "apg.updates=9"],
     r"To continue it as it is: flytune (.*)\n", printed),
    (["train", "mine/task.toml", "--out", "mine", "--resume", "--set", "apg.updates=3", "reward.velocity.weight=0.2"],
     r"To go on from its policy: flytune (.*)\n", printed),
    (["train", "baseline", "--set", *TINY, "apg.hidden=[9]", "--from", "mine"],
     r"Add --set '(apg.hidden=\[8, 8\])'", swap("apg.hidden=[9]", None)),
    (["train", "mine/task.toml", "--trainer", "ppo", "--set", "ppo.hidden=[8, 8]", "--from", "mine"],
     r"Add (--trainer apg)\.", swap("ppo", "apg")),
    (["train", "mine/task.toml", "--from", "pid"], r"Allowed: a run directory", swap("pid", "mine")),
    (["train", "begun/task.toml", "--out", "begun", "--resume", "--from", "mine"], r"Leave out (--from)\.",
     drop("--from", "mine")),
    (["evaluate", "begun", *FLY], r"Continue it with: flytune (.*)\n", printed),
    (["evaluate", "nobody", *FLY], r"Allowed: a run directory, .* (pid),", swap("nobody", None)),
    (["evaluate", "pid@tunned", *FLY], r"Allowed: (tuned), textbook", swap("pid@tunned", "pid@tuned")),
    (["evaluate", "pid", "--trials", "0", "--duration", "1"], r"Allowed: a whole number, (1) to", swap("0", None)),
    (["evaluate", "pid", "--trials", "1", "--duration", "0.5"], r"Allowed: above 0\.5 to (3600) s", swap("0.5", "0.6")),
    ([*EVALUATE, "--starts", "claer"], r"Did you mean (\w+)\?", swap("claer", None)),
    ([*EVALUATE, "--world", "flytun"], r"Did you mean (\w+)\?", swap("flytun", None)),
    ([*EVALUATE, "--trails", "1"], r"Did you mean (--\w+)\?", swap("--trails", None)),
    ([*EVALUATE, "--flights", "no/f.npz"], r"Give a file in a folder that exists", swap("no/f.npz", "f.npz")),
    ([*EVALUATE, "--flights", "."], r"Give a file\.", swap(".", "f.npz")),
    ([*EVALUATE, "--out", "mine"], r"Give another folder", swap("mine", "folder")),
    ([*EVALUATE, "--out", "file"], r"Allowed: a folder, which may be new", swap("file", "folder")),
    (["evaluate", "pid@speed=0.5", *FLY], r"for instance (dial@speed=0\.5)", swap("pid@speed=0.5", "dial@speed=0.5")),
    (["evaluate", "dial@sped=0.5", *FLY], r"is no dial here", swap("dial@sped=0.5", "dial@speed=0.5")),
    (["evaluate", "dial@speed=3", *FLY], r"Allowed: [\d.]+ to ([\d.]+)", swap("dial@speed=3", "dial@speed=1")),
    (["evaluate", "dial@settling_time=0.5", *FLY], r"Allowed: [\d.]+ to ([\d.]+) s", nearer),
    (["evaluate", "dial@settling_time=4,speed=0.5", *FLY], r"Give one of the two",
     swap("dial@settling_time=4,speed=0.5", "dial@settling_time=4")),
    ([*EVALUATE, "--dial", "speed=1"], r"for instance (dial@speed=0\.5)", swap("pid", "dial@speed=0.5")),
    (["compare", "pid", *FLY], r"two or more\. Name another", beside("lqr")),
    (["report", "pid", *FLY, "--out", "notes.html"], r"Give another path, or remove", swap("notes.html", "page.html")),
    (["report", "pid", *FLY, "--out", "page.pdf"], r"Did you mean (\S+)\?", swap("page.pdf", None)),
    ([*EVALUATE, "--flights", "f.csv"], r"Did you mean (\S+)\?", swap("f.csv", None)),
    (["compare", "pid", "lqr", *FLY, "--flights", "f.csv"], r"Did you mean (\S+)\?", swap("f.csv", None)),
    (["compare", "pid", "lqr", *FLY, "--out", "c.html"], r"Did you mean (\S+)\?", swap("c.html", None)),
    (["train", "mine/task.toml", "--out", "p.safetensors"], r"Did you mean (\S+)\?", swap("p.safetensors", None)),
    (["export", "mine", "--format", "safetensors", "--out", "p.onnx"], r"Did you mean (\S+)\?", swap("p.onnx", None)),
    (["evaluate", "baseline", *FLY], r"Did you mean ([\w-]+)\?", swap("baseline", None)),
    (["evaluate", "pids", *FLY], r"Did you mean (\w+)\?", swap("pids", None)),
    (["show", "tsk.toml"], r"no such file\. Did you mean (\S+)\?", swap("tsk.toml", None)),
    (["evaluate", "pid@texbook", *FLY], r"Did you mean (\w+)\?", swap("pid@texbook", "pid@textbook")),
    (["evaluate", "known", *FLY], r"Did you mean (\S+)\?", swap("known", None)),
    (["evaluate", "runs/knwon", *FLY], r"Did you mean (\S+)\?", swap("runs/knwon", None)),
    (["evaluate", "mine/task.toml", *FLY], r"Did you mean its run, (\w+)\?", swap("mine/task.toml", None)),
    (["evaluate", "runs", *FLY], r"It holds the runs (\S+)\.\n", swap("runs", None)),
    (["show", "known"], r"Did you mean (\S+)\?", swap("known", None)),
    (["evaluate", "dial@settling=4", *FLY], r"Did you mean (\w+)\?", swap("settling", None)),
    (["show", "pid"], r"Fly it: flytune (.*)\.\n", printed),
    (["evaluate", "task.toml", *FLY], r"or fly it: flytune (.*)\.\n", printed),
    (["show", "baseline", "--set", "target_yaw=1"], r"Did you mean ([\w.]+)\?", swap("target_yaw", None)),
    (["show", "baseline", "--set", "target.position=0,0,2"], r"For instance (\S+)\.\n",
     swap("target.position=0,0,2", None)),
    (["show", "baseline", "--set", "target.position=[1,0]"], r"For instance (\S+)\.\n",
     swap("target.position=[1,0]", None)),
    (["show", "baseline", "--set", "vehicle.rotor_drag=some"], r'"(none)" removes it', swap("some", None)),
    (["show", "baseline", "--set", "termination.speed=3"], r'"(none)" removes it', swap("3", None)),
    (["export", "pid", "--format", "safetensors", "--out", "p"], r"or one that ships", swap("pid", "baseline-refined")),
    (["export", "mine", "--format", "safetensor", "--out", "p"], r"Did you mean (\w+)\?", swap("safetensor", None)),
    (["map", "pid"], r"for instance (dial)\.", swap("pid", None)),
    (["rules", "--jsn"], r"Did you mean (--json)\?", swap("--jsn", None)),
]  # fmt: skip

OF_WHOLE_TRAININGS = [  # the same, with trainings from new weights, which take longer
    (["train", "baseline", "--set", "apg.updats=1", *TINY], r"Did you mean (apg\.\w+)", swap("apg.updats", None)),
    (["train", "baseline", "--set", *TINY, "apg.updates=0"], r"Allowed: a whole number, (1) to",
     swap("apg.updates=0", "apg.updates=1")),
    (["train", "baseline", "--set", "x", *TINY], r"Write path=value, for instance (\S+)\.\n", swap("x", None)),
    (["train", "baseline", "--set", "vehicle=crazyfly", *TINY], r"Did you mean ([\w-]+)\?", swap("crazyfly", None)),
    (["train", "baseline", "--steps", "0", "--set", *TINY], r"Allowed: a whole number, (1) or more", swap("0", "40")),
    (["train", "baseline", "--seed", "-1", "--set", *TINY], r"Allowed: a whole number, (0) to", swap("-1", None)),
]  # fmt: skip


def named(arguments):
    return " ".join(arguments)[:70]


EVERY = [pytest.param(*each, id=named(each[0])) for each in REMEDIES]
EVERY += [pytest.param(*each, marks=pytest.mark.slow, id=named(each[0])) for each in OF_WHOLE_TRAININGS]


@pytest.mark.slow
@pytest.mark.parametrize(("typed", "said", "remedy"), EVERY)
def test_what_a_message_tells_to_do_works(here, capsys, typed, said, remedy):
    line = refused(*typed, capsys=capsys)
    match = re.search(said, line)
    assert match, line
    if remedy == "rename":
        text = (here / "mine.toml").read_text().replace("leeway", match[1].removeprefix("apg."))
        (here / "mine.toml").write_text(text)
        remedy = add()
    assert main(remedy(typed, match)) == 0, capsys.readouterr().err


@pytest.mark.slow
def test_a_smaller_learning_rate_helps_a_training_that_diverged(here, capsys):
    words = ["train", "mine/task.toml", "--set", "apg.learning_rate=1e38"]
    assert main(words) == 3
    (field,) = re.findall(r"A smaller learning rate \(--set (apg\.learning_rate)=VALUE", capsys.readouterr().err)
    assert main([*words, f"{field}=0.005"]) == 0


@pytest.mark.slow
def test_what_is_damaged_is_trained_again_into_another_directory_as_the_message_says(here, capsys):
    task = ["train", "mine/task.toml"]
    for spoil, typed in (
        (lambda run: (run / CHECKPOINT).write_bytes(b"not one"), [*task, "--out", "spoilt", "--resume"]),
        (lambda run: (run / CHECKPOINT).unlink(), [*task, "--out", "spoilt", "--resume"]),
        (lambda run: (run / "run.json").write_text("{"), [*task, "--out", "spoilt", "--resume"]),
        (
            lambda run: (run / "policy.safetensors").unlink() or (run / CHECKPOINT).unlink(),
            ["evaluate", "spoilt", *FLY],
        ),
    ):
        shutil.rmtree("spoilt", ignore_errors=True)
        shutil.copytree("mine", "spoilt")
        spoil(here / "spoilt")
        assert "Train again into another directory" in refused(*typed, capsys=capsys)
    assert main([*task, "--out", "another"]) == 0
    (here / "mine" / "metrics.jsonl").write_text("{")
    assert "Remove this file" in refused(*MINE, capsys=capsys)
    (here / "mine" / "metrics.jsonl").unlink()
    assert main(MINE) == 0


@pytest.mark.slow
def test_a_policy_whose_response_map_is_of_no_use_flies_by_its_dial_and_is_measured_again(here, capsys):
    policy = flytune.find_controller("dial").controller
    none = {**policy.maps["speed"], "monotone": [None] * len(policy.maps["speed"]["values"])}
    for name, maps, said in (
        ("few", none, "fewer than two settings"),
        ("bad", {"values": 3}, "response map .* is damaged"),
    ):
        file = here / f"{name}.safetensors"
        save_policy(file, dataclasses.replace(policy, maps={"speed": maps}))
        assert re.search(said, line := refused("evaluate", f"{file}@settling_time=4", *FLY, capsys=capsys))
        assert "Set the dial itself" in line
        assert main(["evaluate", f"{file}@speed=0.5", *FLY]) == 0
    assert "`flytune map CONTROLLER --measure 11`" in line
    assert "`flytune train TASK --from CONTROLLER`" in refused(
        "evaluate", "few.safetensors@settling_time=4", capsys=capsys
    )
    save_policy(here / "bare.safetensors", dataclasses.replace(policy, maps={}))
    assert "Set its dial: speed" in refused("evaluate", "bare.safetensors@settling_time=4", *FLY, capsys=capsys)
    find_trainer("apg").check_warm_start(load_task("dial"), load_policy(here / "few.safetensors"))


def test_the_extra_that_a_message_installs_exists_and_holds_the_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    calls = [
        call
        for file in (ROOT / "src").rglob("*.py")
        for call in re.findall(r'require\("([\w.]+)", "(\w+)"\)', file.read_text(encoding="utf-8"))
    ]
    assert len(calls) > 5
    for package, extra in calls:
        distribution = package.partition(".")[0].replace("_", "-").replace("PIL", "pillow")
        assert any(each.startswith(distribution) for each in extras[extra]), (package, extra)


def test_every_value_that_the_tuner_proposes_is_one_it_takes(capsys):
    for wrong in ({"--settling-time": "2500"}, {"--overshoot": "0.05"}, {"--error": "5"}, {"--percentile": "0.9"}):
        options = {"--settling-time": "3", **wrong}
        words = [word for pair in options.items() for word in pair]
        said = refused("tune", *words, capsys=capsys)
        option, value = re.match(r"([\w-]+): .*Did you mean ([\d.]+)", said).groups()
        options[f"--{option}"] = value.rstrip(".")
        given = {name.removeprefix("--").replace("-", "_"): float(each) for name, each in options.items()}
        assert make_requirement(**{"settling_time": 3.0, "overshoot": 5.0, "error": None, **given})
