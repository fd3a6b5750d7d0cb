"""Event files: TensorBoard reads back what metrics.jsonl says, once, also of a run that was resumed."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from flytune.training.loop import train
from flytune.training.tensorboard import EventLog, scalars

accumulator = pytest.importorskip(
    "tensorboard.backend.event_processing.event_accumulator", reason="needs flytune[tensorboard]"
)


def make_row(update, **changes):
    return {
        "update": update,
        "steps": 640 * update,
        "seconds": 0.25 * update,
        "episode_reward": None,
        "reward": 0.1 * update,
        "terms": {"xy": 0.5, "survival": 0.05},
        "terminations": {"speed": 3, "diverged": 0},
        "gradient_norm": 2.0,
    } | changes


def read(directory):
    """What TensorBoard makes of a directory: tag -> its events in order."""
    reader = accumulator.EventAccumulator(str(directory), size_guidance={"scalars": 0})
    reader.Reload()
    return {tag: reader.Scalars(tag) for tag in reader.Tags()["scalars"]}


def columns(seen):
    """Tag -> [(step, value)]."""
    return {tag: [(event.step, event.value) for event in events] for tag, events in seen.items()}


@pytest.mark.floor
def test_tensorboard_reads_every_number_of_every_row_of_a_training_over_its_steps(small_task, tmp_path):
    run = train(small_task, "ppo", out=tmp_path)
    with EventLog(tmp_path) as log:
        for row in run.metrics:
            log.write(row)
    seen = read(tmp_path)
    written = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert {"reward", "policy_loss", "terms/velocity", "terminations/speed", "update"} <= set(seen)
    for tag, events in seen.items():
        table, _, name = tag.rpartition("/")
        values = [(row[table] if table else row)[name] for row in written]
        expected = [(row["steps"], value) for row, value in zip(written, values, strict=True) if value is not None]
        assert [event.step for event in events] == [step for step, _ in expected]
        # an event holds a float32
        np.testing.assert_allclose([event.value for event in events], [value for _, value in expected], rtol=2**-23)
    numbers = {tag for row in written for tag, _ in scalars(row)}
    assert set(seen) == numbers


def test_the_scalars_of_a_row_are_its_finite_numbers_by_their_path():
    row = make_row(2, reward=float("nan"), objective=float("inf"))
    assert dict(scalars(row)) == {
        "update": 2,
        "seconds": 0.5,
        "terms/xy": 0.5,
        "terms/survival": 0.05,
        "terminations/speed": 3,
        "terminations/diverged": 0,
        "gradient_norm": 2,
    }


def test_the_time_of_an_event_is_that_of_its_row(tmp_path):
    with EventLog(tmp_path) as log:
        for update in (1, 5):
            log.write(make_row(update))
    first, second = read(tmp_path)["reward"]
    assert second.wall_time - first.wall_time == pytest.approx(1.0, abs=1e-3)


def test_a_row_can_be_seen_before_the_file_is_closed(tmp_path):
    with EventLog(tmp_path) as log:
        log.write(make_row(1))
        assert columns(read(tmp_path))["terms/xy"] == [(640, 0.5)]


def test_a_resumed_run_says_each_row_once_and_forgets_what_came_after_the_checkpoint(tmp_path):
    rows = [make_row(update) for update in range(1, 7)]
    with EventLog(tmp_path) as log:
        for row in rows[:4]:
            log.write(row)
    # interrupted after four updates, the checkpoint is of the second; updates 3 to 6 are flown (again), and differ
    later = [row | {"gradient_norm": 7.0} for row in rows[2:]]
    with EventLog(tmp_path, rows[:2]) as log:
        for row in later:
            log.write(row)
    expected = [(row["steps"], row["gradient_norm"]) for row in (*rows[:2], *later)]
    assert columns(read(tmp_path))["gradient_norm"] == expected
    assert len(list(tmp_path.iterdir())) == 2


def test_a_run_resumed_with_tensorboard_for_the_first_time_has_its_whole_past(tmp_path):
    rows = [make_row(update) for update in (1, 2, 3)]
    EventLog(tmp_path, rows).close()
    assert columns(read(tmp_path))["update"] == [(640, 1), (1280, 2), (1920, 3)]


def test_a_missing_tensorboard_is_named_with_its_remedy_and_nothing_is_written(tmp_path):
    # another process, in which the package cannot be found
    program = """
import sys, pathlib
sys.modules["tensorboard"] = None
from flytune.errors import BadInput
from flytune.training.tensorboard import EventLog
try:
    EventLog(pathlib.Path(sys.argv[1]))
except BadInput as error:
    print(error)
"""
    answer = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True, env=dict(os.environ)
    )
    assert 'pip install "flytune[tensorboard]"' in answer.stdout
    assert len(answer.stdout.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
