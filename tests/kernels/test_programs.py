"""Programs that are kept on disk: a second process does not trace again, a change of anything traces again."""

import json
import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

SCRIPT = """
import dataclasses, json, sys
import jax, jax.numpy as jnp, numpy as np
traced = []
def listen(event, seconds, **facts):
    name = facts.get("fun_name", "").removeprefix("kept_")
    if event == "/jax/core/compile/jaxpr_trace_duration" and name in ("start", "_part", "_descend"):
        traced.append(name)
jax.monitoring.register_event_duration_secs_listener(listen)
from flytune.task.files import load_task
from flytune.training import apg
task = load_task("baseline", json.loads(sys.argv[1]))
EXTRA
settings = dataclasses.replace(task.apg, environments=4, window=5, hidden=(8, 8), updates=2)
state = apg.start(task, settings, jax.random.key(int(sys.argv[2])))
for _ in range(2):
    state, metrics = apg.update(task, settings, state)
print(json.dumps([traced, [np.asarray(leaf).ravel().tolist() for leaf in jax.tree.leaves(state.actor)]]))
"""
FEWER = "task = dataclasses.replace(task, reward={'velocity': task.reward['velocity']})"
OWN = """
from flytune.config.pytree import pytree
@pytree
class Own:
    def __call__(self, here):
        return jnp.float32(0.5)
task = dataclasses.replace(task, reward={**task.reward, "own": Own()})
"""


def run(folder, edits="{}", seed=0, extra="", **variables):
    """The programs that were traced and the weights of a small training in a process of its own."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder), **variables}
    script = SCRIPT.replace("EXTRA", extra)
    done = subprocess.run(
        [sys.executable, "-c", script, edits, str(seed)], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A folder that a process has filled, and what it gave."""
    folder = tmp_path_factory.mktemp("programs")
    return folder, run(folder)


def test_a_second_process_traces_nothing_and_gives_the_same(first):
    folder, (traced, weights) = first
    assert sorted(traced) == ["_descend", "_part", "start"]
    assert run(folder) == [[], weights]


def test_another_seed_other_numbers_of_the_task_and_another_vehicle_use_the_same_program(first):
    folder, (_, weights) = first
    edits = '{"reward.velocity.weight": 0.3}', '{"vehicle": "crazyflie-measured"}'
    for change in ({"seed": 1}, *({"edits": each} for each in edits)):
        traced, others = run(folder, **change)
        assert traced == [] and others != weights


def test_another_structure_of_the_task_is_another_program(first):
    folder, _ = first
    assert "_part" in run(folder, extra=FEWER)[0]


@pytest.mark.slow
def test_code_of_a_user_is_traced_in_every_process(first):
    folder, _ = first
    assert "_part" in run(folder, extra=OWN)[0]
    assert "_part" in run(folder, extra=OWN)[0]


def test_a_damaged_file_is_made_again(first):
    folder, (_, weights) = first
    for place in folder.glob("program-*"):
        content = bytearray(place.read_bytes())
        content[len(content) // 2] ^= 1
        place.write_bytes(content)
    traced, found = run(folder)
    assert sorted(traced) == ["_descend", "_part", "start"] and found == weights
    assert run(folder) == [[], weights]


@pytest.mark.slow
def test_a_missing_kernel_is_made_again(first):
    folder, (_, weights) = first
    for place in folder.glob("*.o"):
        place.unlink()
    assert run(folder)[1] == weights
