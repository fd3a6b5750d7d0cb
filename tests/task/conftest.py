"""The shipped tasks, and situations made by hand."""

import jax.numpy as jnp
import pytest

from flytune.task.files import load_task, preset_names
from flytune.task.situation import Situation


@pytest.fixture(scope="session")
def tasks():
    """Every preset by its name."""
    return {name: load_task(name) for name in preset_names()}


@pytest.fixture(scope="session")
def situation():
    """Factory of situations: at the target, level and at rest, where nothing else is said."""

    def make(**changes):
        fields = {
            "position_error": (0, 0, 0),
            "attitude_error": (0, 0, 0, 1),
            "velocity": (0, 0, 0),
            "body_rate": (0, 0, 0),
            "altitude": 1,
            "roll": 0,
            "pitch": 0,
            "action_change": (0, 0, 0, 0),
        } | changes
        resting = {"velocity_error": fields["velocity"], "body_rate_error": fields["body_rate"]}
        fields = resting | fields
        return Situation(
            **{
                name: tuple(map(jnp.float32, value)) if isinstance(value, tuple) else jnp.float32(value)
                for name, value in fields.items()
            }
        )

    return make
