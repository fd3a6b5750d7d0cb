"""Trainings of a study on disk: real ones, very short, in processes of their own."""

import json
import os
import signal
import subprocess
import threading
from pathlib import Path

import pytest

from flytune.errors import BadInput, Interrupted
from flytune.reproduction.study import Study, condition, open_study
from flytune.reproduction.trainings import train_all
from flytune.runs.directory import CHECKPOINT

STEPS = 3 * 16_384  # three updates


def quietly(*_):
    pass


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A finished study of one seed."""
    study = Study(folder=tmp_path_factory.mktemp("done") / "study", seeds=1, steps=STEPS)
    open_study(study)
    train_all(study, on_progress=quietly, tell=quietly, workers=2)
    return study


def pids(directory):
    """Processes whose command line names a directory."""
    listing = subprocess.run(["ps", "-axww", "-o", "pid=,command="], capture_output=True, text=True, check=True).stdout
    lines = [line.split(None, 1) for line in listing.splitlines()]
    return [
        int(pid) for pid, command in lines if "flytune.reproduction.worker" in command and str(directory) in command
    ]


def test_every_training_ends_with_its_policies(done):
    for member in done.members():
        assert condition(done, member, quietly) == "done"
        assert (member.directory / "policy-last.safetensors").exists()


def test_a_finished_study_is_not_trained_again(done):
    lines = []
    before = [member.directory.stat().st_mtime for member in done.members()]
    train_all(done, on_progress=quietly, tell=lines.append)
    assert lines == ["3 of 3 trainings were done before"]
    assert [member.directory.stat().st_mtime for member in done.members()] == before


@pytest.mark.slow
def test_a_killed_worker_is_run_again_with_the_same_result(done, tmp_path):
    study = Study(folder=tmp_path / "study", seeds=1, steps=STEPS)
    open_study(study)
    victim = study.members()[0].directory
    killed, lines = [], []

    def kill(member, progress):
        if member.directory == victim and not killed:
            killed.extend(pids(victim))
            for pid in killed:
                os.kill(pid, signal.SIGKILL)

    train_all(study, on_progress=kill, tell=lines.append, workers=2)
    assert killed
    assert any(victim.name in line and "-9" in line for line in lines)
    for ours, theirs in zip(study.members(), done.members(), strict=True):
        for name in ("policy.safetensors", "policy-last.safetensors"):
            assert (ours.directory / name).read_bytes() == (theirs.directory / name).read_bytes()


@pytest.mark.slow
def test_an_interrupted_study_goes_on_to_the_same_result(done, tmp_path):
    study = Study(folder=tmp_path / "study", seeds=1, steps=STEPS)
    open_study(study)

    once = threading.Event()

    def interrupt(member, progress):
        if not once.is_set():
            once.set()
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Interrupted, match="Go on with the same command"):
        train_all(study, on_progress=interrupt, tell=quietly, workers=2)
    assert "done" not in {condition(study, member, quietly) for member in study.members()[2:]}
    train_all(study, on_progress=quietly, tell=quietly, workers=2)
    for ours, theirs in zip(study.members(), done.members(), strict=True):
        policy = "policy-last.safetensors"
        assert (ours.directory / policy).read_bytes() == (theirs.directory / policy).read_bytes()


def copy_of(done, tmp_path):
    study = Study(folder=tmp_path / "copy", seeds=1, steps=STEPS)
    subprocess.run(["cp", "-r", str(done.folder), str(study.folder)], check=True)
    return study


@pytest.mark.parametrize("file", ["run.json", "policy.safetensors", "policy-last.safetensors", "task.toml"])
def test_a_damaged_training_is_named_and_set_aside_and_the_rest_is_kept(done, tmp_path, file):
    study = copy_of(done, tmp_path)
    first, *others = study.members()
    (first.directory / file).write_bytes(b"\x00 rubbish")
    lines = []
    assert condition(study, first, lines.append) == "new"
    assert len(lines) == 1 and first.directory.name in lines[0]
    assert (first.directory.with_name(f"{first.directory.name}.damaged-1") / file).read_bytes() == b"\x00 rubbish"
    assert [condition(study, member, quietly) for member in others] == ["done", "done"]


def test_a_training_that_never_came_to_a_checkpoint_begins_again(done, tmp_path):
    study = copy_of(done, tmp_path)
    member = study.members()[0]
    facts = json.loads((member.directory / "run.json").read_text())
    (member.directory / "run.json").write_text(json.dumps({**facts, "finished": False}))
    assert condition(study, member, quietly) == "begun"
    (member.directory / CHECKPOINT).unlink()
    assert condition(study, member, quietly) == "new"
    assert not member.directory.exists()


def test_a_training_of_another_task_is_refused(done, tmp_path):
    study = copy_of(done, tmp_path)
    member = study.members()[0]
    text = (member.directory / "task.toml").read_text()
    (member.directory / "task.toml").write_text(text.replace("reward = 0.05", "reward = 0.06"))
    with pytest.raises(BadInput, match=r"another reward\.survival\.reward"):
        condition(study, member, quietly)


def test_a_folder_with_another_reproduction_is_refused_and_left_alone(done):
    before = sorted(str(path) for path in done.folder.rglob("*"))
    with pytest.raises(BadInput, match="another trainer"):
        open_study(Study(folder=done.folder, trainer="apg", seeds=1, steps=STEPS))
    with pytest.raises(BadInput, match="another steps"):
        open_study(Study(folder=done.folder, seeds=1))
    assert sorted(str(path) for path in done.folder.rglob("*")) == before


def test_more_seeds_may_be_added_to_a_study(done):
    open_study(Study(folder=done.folder, seeds=4, steps=STEPS))


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda path: path.write_text("hello"), "is a file"),
        (lambda path: (path.mkdir(), (path / "thesis.tex").write_text("x")), "not empty"),
        (lambda path: (path.mkdir(), (path / "reproduction.json").write_text("{")), "is damaged"),
    ],
)
def test_a_folder_that_is_something_else_is_refused(tmp_path, make, word):
    make(tmp_path / "study")
    with pytest.raises(BadInput, match=word):
        open_study(Study(folder=tmp_path / "study"))


@pytest.mark.parametrize(
    ("changes", "word"),
    [({"trainer": "sb3"}, "Allowed: apg, ppo"), ({"seeds": 0}, "1 to 100"), ({"steps": 0}, "1 or more")],
)
def test_a_study_nobody_can_make_is_refused(changes, word):
    with pytest.raises(BadInput, match=word):
        Study(folder=Path("nowhere"), **changes)
