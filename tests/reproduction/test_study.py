"""Trainings of a study on disk: real ones, very short, in processes of their own."""

import json
import os
import signal
import subprocess
import threading
from pathlib import Path

import pytest

import flytune
from flytune.errors import BadInput, Interrupted
from flytune.reproduction.study import Study, open_study, training_status
from flytune.reproduction.trainings import train_all
from flytune.runs.directory import CHECKPOINT
from flytune.training.loop import train

pytestmark = pytest.mark.slow

STEPS = 3 * 16_384  # three updates


def ignore(*_):
    """Take progress and messages, and do nothing."""


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A finished study of one seed."""
    study = Study(folder=tmp_path_factory.mktemp("finished") / "study", seeds=1, steps=STEPS)
    open_study(study)
    train_all(study, on_progress=ignore, on_message=ignore, workers=2)
    return study


@pytest.fixture
def endless(tmp_path):
    """A study whose trainings cannot end while a test runs: a million updates each."""
    study = Study(folder=tmp_path / "endless", seeds=1, steps=1_000_000 * 16_384)
    open_study(study)
    return study


@pytest.fixture
def ctrl_c():
    """Ctrl-C as Python answers it, also where the tests run in the background of a shell, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def pids(directory):
    """Processes whose command line names a directory."""
    listing = subprocess.run(["ps", "-axww", "-o", "pid=,command="], capture_output=True, text=True, check=True).stdout
    lines = [line.split(None, 1) for line in listing.splitlines()]
    return [
        int(pid) for pid, command in lines if "flytune.reproduction.worker" in command and str(directory) in command
    ]


def test_every_training_ends_with_its_policies(done):
    for training in done.trainings():
        assert training_status(done, training, ignore) == "finished"
        assert (training.directory / "policy-last.safetensors").exists()


def test_a_finished_study_is_not_trained_again(done):
    lines = []
    before = [training.directory.stat().st_mtime for training in done.trainings()]
    train_all(done, on_progress=ignore, on_message=lines.append)
    assert lines == ["3 of 3 trainings were done before"]
    assert [training.directory.stat().st_mtime for training in done.trainings()] == before


@pytest.mark.slow
def test_a_worker_that_is_killed_is_started_again(endless, ctrl_c):
    victim = endless.trainings()[0].directory
    killed, lines, once = set(), [], threading.Event()

    def kill_then_interrupt(training, progress):
        if training.directory != victim:
            return
        running = set(pids(victim))
        if not killed:
            killed.update(running)
            for pid in killed:
                os.kill(pid, signal.SIGKILL)
        elif running - killed and not once.is_set():
            once.set()
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Interrupted):
        train_all(endless, on_progress=kill_then_interrupt, on_message=lines.append, workers=1)
    assert len(killed) == 1
    assert len(lines) == 1 and lines[0].startswith(f"{victim.name}: its process ended with -9")
    assert training_status(endless, endless.trainings()[0], ignore) == "interrupted"


@pytest.mark.slow
def test_ctrl_c_keeps_a_checkpoint_of_every_training_under_way(endless, ctrl_c):
    under_way = set()
    lock = threading.Lock()

    def interrupt_once_two_are_under_way(training, progress):
        with lock:
            before = len(under_way)
            under_way.add(training)
            if before == 1 and len(under_way) == 2:
                os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Interrupted, match="Continue with the same command"):
        train_all(endless, on_progress=interrupt_once_two_are_under_way, on_message=ignore, workers=2)
    status = [training_status(endless, training, ignore) for training in endless.trainings()]
    assert status == ["interrupted", "interrupted", "new"]
    assert not pids(endless.folder)


@pytest.mark.slow
def test_an_interrupted_study_goes_on_to_the_same_result(done, tmp_path, ctrl_c):
    study = Study(folder=tmp_path / "study", seeds=1, steps=STEPS)
    open_study(study)
    first = study.trainings()[0]

    def interrupt(progress):
        if progress.update == 1:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted):  # in this process, so that it ends after update 1 however busy the machine is
        train(study.task(first.behaviour), study.trainer, seed=0, out=first.directory, on_progress=interrupt)
    assert training_status(study, first, ignore) == "interrupted"
    updates = {training: [] for training in study.trainings()}
    train_all(study, on_progress=lambda training, progress: updates[training].append(progress.update),
              on_message=ignore, workers=2)  # fmt: skip
    assert updates[first][0] >= 2  # update 1 is not trained again
    for ours, theirs in zip(study.trainings(), done.trainings(), strict=True):
        for name in ("policy.safetensors", "policy-last.safetensors"):
            assert (ours.directory / name).read_bytes() == (theirs.directory / name).read_bytes()


@pytest.mark.slow
def test_one_call_judges_a_finished_study_and_writes_every_file(done):
    lines = []
    result = flytune.reproduce(done.folder, seeds=1, steps=STEPS, on_message=lines.append)
    assert lines[0] == "3 of 3 trainings were done before"
    written = {str(path.relative_to(done.folder)) for path in result.files}
    assert {"report.html", "verdicts.json", "verdicts.md", "figures/settling.svg"} <= written
    assert all(path.stat().st_size for path in result.files)
    told = json.loads((done.folder / "verdicts.json").read_text())
    assert [claim["verdict"] for claim in told["verdicts"]] == [claim.verdict for claim in result.claims]
    assert len(told["inconsistencies"]) == 10


def copy_of(done, tmp_path):
    study = Study(folder=tmp_path / "copy", seeds=1, steps=STEPS)
    subprocess.run(["cp", "-r", str(done.folder), str(study.folder)], check=True)
    return study


@pytest.mark.parametrize("file", ["run.json", "policy.safetensors", "policy-last.safetensors", "task.toml"])
def test_a_damaged_training_is_named_and_set_aside_and_the_rest_is_kept(done, tmp_path, file):
    study = copy_of(done, tmp_path)
    first, *others = study.trainings()
    (first.directory / file).write_bytes(b"\x00 rubbish")
    lines = []
    assert training_status(study, first, lines.append) == "new"
    assert len(lines) == 1 and first.directory.name in lines[0]
    assert (first.directory.with_name(f"{first.directory.name}.damaged-1") / file).read_bytes() == b"\x00 rubbish"
    assert [training_status(study, training, ignore) for training in others] == ["finished", "finished"]


def test_a_training_that_never_came_to_a_checkpoint_begins_again(done, tmp_path):
    study = copy_of(done, tmp_path)
    training = study.trainings()[0]
    facts = json.loads((training.directory / "run.json").read_text())
    (training.directory / "run.json").write_text(json.dumps({**facts, "finished": False}))
    assert training_status(study, training, ignore) == "interrupted"
    (training.directory / CHECKPOINT).unlink()
    assert training_status(study, training, ignore) == "new"
    assert not training.directory.exists()


def test_a_training_of_another_task_is_refused(done, tmp_path):
    study = copy_of(done, tmp_path)
    training = study.trainings()[0]
    text = (training.directory / "task.toml").read_text()
    (training.directory / "task.toml").write_text(text.replace("reward = 0.05", "reward = 0.06"))
    with pytest.raises(BadInput, match=r"another reward\.survival\.reward"):
        training_status(study, training, ignore)


def test_a_folder_with_another_reproduction_is_refused_and_left_alone(done):
    before = sorted(str(path) for path in done.folder.rglob("*"))
    with pytest.raises(BadInput, match="another trainer"):
        open_study(Study(folder=done.folder, trainer="apg", seeds=1, steps=STEPS))
    with pytest.raises(BadInput, match="another steps"):
        open_study(Study(folder=done.folder, seeds=1))
    assert sorted(str(path) for path in done.folder.rglob("*")) == before


def test_more_seeds_may_be_added_to_a_study(done):
    more = Study(folder=done.folder, seeds=2, steps=STEPS)
    open_study(more)
    status = {training: training_status(more, training, ignore) for training in more.trainings()}
    assert [training.seed for training in more.trainings() if status[training] == "finished"] == [0, 0, 0]
    assert [training.seed for training in more.trainings() if status[training] == "new"] == [1, 1, 1]


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
