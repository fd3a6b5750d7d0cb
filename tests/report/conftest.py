"""A real flight to report on."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.control.policy import Policy, make_network
from flytune.evaluation.evaluate import Evaluation
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import judge
from flytune.task.files import load_task
from flytune.task.observation import SIZE


@pytest.fixture(scope="session")
def task():
    """The baseline task."""
    return load_task("baseline")


@pytest.fixture(scope="session")
def flights(task):
    """Twelve real flights of two seconds, by an untrained network that holds the hover thrust and drifts."""
    actor = make_network(jax.random.key(0), (SIZE, 64, 64, 4), last_gain=0.01)
    controller = Policy(actor=actor, input_scale=jnp.ones(SIZE), squash="tanh")
    return fly(controller, task, trials=12, duration=2.0, name="untrained")


@pytest.fixture(scope="session")
def curve():
    """A training curve of 40 updates with what a real one has: nulls, causes that die out, one that never comes."""

    def row(update):
        return {
            "update": update,
            "steps": 16_384 * update,
            "seconds": 0.4 * update,
            "episode_reward": None if update < 3 else 300.0 + update,
            "reward": 0.4 + 0.005 * update,
            "terms": {"horizontal": 0.1 + 0.002 * update, "smoothness": -0.01, "survival": 0.05},
            "terminations": {"altitude": max(0, 30 - update), "speed": max(0, 20 - update), "diverged": 0},
            "episodes": 36,
            "episode_length": 489.0,
        }

    return [row(update) for update in range(1, 41)]


@pytest.fixture(scope="session")
def make_evaluation(task, flights, curve):
    """Factory of evaluations from the real flights; arguments replace fields of the evaluation, or of the flights."""
    fields = {field.name for field in dataclasses.fields(flights)} - {"task", "name"}

    def make(**changes):
        flown = dataclasses.replace(
            flights,
            task=changes.get("task", task).name,
            name=changes.get("name", flights.name),
            **{key: value for key, value in changes.items() if key in fields},
        )
        given = {
            "name": "untrained",
            "task": task,
            "flights": flown,
            "judgement": judge(flown),
            "metrics": curve,
            "about": {"trainer": "none", "seed": "0"},
        }
        return Evaluation(**(given | {key: value for key, value in changes.items() if key not in fields}))

    return make


@pytest.fixture(scope="session")
def keep(flights):
    """Factory of the fields that flights have with some trials only."""

    def choose(trials):
        per_trial = {
            field.name: value[trials]
            for field in dataclasses.fields(flights)
            if isinstance(value := getattr(flights, field.name), np.ndarray) and len(value) == flights.trials
        }
        return per_trial | {"margins": {name: margin[trials] for name, margin in flights.margins.items()}}

    return choose
