"""Policies with dials: at a setting, without their dials, and turned in flight."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.config.formula import Formula
from flytune.control.policy import Policy, load_policy, make_network, save_policy
from flytune.control.schedule import ScheduledPolicy, with_schedule
from flytune.errors import BadInput
from flytune.task.dial import Dial, Input
from flytune.task.observation import input_scale

SPEED = Dial(lowest=0.2, highest=1.6, default=0.8, spacing="logarithmic", unit="m/s")
CALM = Dial(lowest=0.0, highest=1.0, default=0.5)
INPUTS = {
    "setting": Input(value=Formula("log(speed / 0.6)")),
    "share": Input(of="velocity", value=Formula("1 / speed")),
    "calm": Input(of="attitude_error", value=Formula("calm ** 2 + 1")),
    "two": Input(value=Formula("2")),
}


def policy(squash="tanh"):
    """A policy with two dials and random weights."""
    sizes = (17 + 1 + 3 + 4 + 1, 32, 32, 4)
    return Policy(
        actor=make_network(jax.random.key(0), sizes, last_gain=1.0),
        input_scale=input_scale((2.0, 3.0, 2.0, 0.4, 1.0)),
        squash=squash,
        dials={"speed": SPEED, "calm": CALM},
        inputs=INPUTS,
        setting={"speed": 0.8, "calm": 0.5},
    )


OBSERVATIONS = jax.random.normal(jax.random.key(1), (50, 17))


@pytest.mark.parametrize("setting", [{}, {"speed": 0.2}, {"speed": 1.6, "calm": 0.01}])
@pytest.mark.parametrize("squash", ["tanh", "clip"])
def test_without_its_dials_a_policy_gives_the_actions_of_its_setting(setting, squash):
    here = policy(squash).at(setting)
    fixed = here.fixed()
    assert fixed.actor.sizes == (17, 32, 32, 4)
    assert not (fixed.dials or fixed.inputs or fixed.setting)
    np.testing.assert_allclose(fixed(OBSERVATIONS), here(OBSERVATIONS), atol=2e-5)


def test_another_setting_gives_other_actions_and_a_dial_that_is_not_named_keeps_its_value():
    slow = policy().at(speed=0.2)
    assert slow.setting == {"speed": 0.2, "calm": 0.5}
    assert slow.at(calm=1.0).setting == {"speed": 0.2, "calm": 1.0}
    assert float(jnp.abs(slow(OBSERVATIONS) - policy()(OBSERVATIONS)).max()) > 0.1
    np.testing.assert_array_equal(policy()(OBSERVATIONS, slow.setting), slow(OBSERVATIONS))


def test_a_policy_with_dials_is_written_and_read_without_a_difference(tmp_path):
    path = tmp_path / "policy.safetensors"
    made = dataclasses.replace(policy().at(speed=0.3), maps={"speed": {"dial": "speed"}})
    save_policy(path, made)
    read = load_policy(path)
    assert (read.dials, read.inputs, read.setting, read.maps) == (made.dials, made.inputs, made.setting, made.maps)
    np.testing.assert_array_equal(read(OBSERVATIONS), made(OBSERVATIONS))


@pytest.mark.parametrize(
    ("part", "damage", "message"),
    [
        ("setting", {"speed": 9.0}, "setting: speed=9.0 is not allowed"),
        ("inputs", {"setting": Input(value=Formula("log(pace)"))}, "input setting is damaged"),
        ("inputs", {"setting": Input(value=Formula("__import__('os')"))}, "input setting is damaged"),
        ("inputs", {"setting": INPUTS["setting"]}, "layer 0 has shape"),
        ("maps", [], "has a damaged header"),
    ],
)
def test_a_file_whose_dials_are_damaged_is_refused(tmp_path, part, damage, message):
    path = tmp_path / "policy.safetensors"
    save_policy(path, dataclasses.replace(policy(), **{part: damage}))
    with pytest.raises(BadInput) as error:
        load_policy(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)


def test_a_schedule_sets_the_dial_from_the_step_of_each_time_on():
    turned = with_schedule(policy(), {"speed": [[0, 0.3], [0.05, 1.0], [0.1, 0.2]], "calm": 1.0})
    assert isinstance(turned, ScheduledPolicy)
    memory, actions = turned.initial_memory(), []
    for _ in range(12):
        memory, action = turned.act(memory, OBSERVATIONS[0])
        actions.append(action)
    for steps, speed in ((range(5), 0.3), (range(5, 10), 1.0), (range(10, 12), 0.2)):
        expected = policy().at(speed=speed, calm=1.0)(OBSERVATIONS[0])
        for step in steps:
            np.testing.assert_allclose(actions[step], expected, atol=1e-6)
    settings = turned.settings(12)
    assert settings["speed"] == pytest.approx([*[0.3] * 5, *[1.0] * 5, 0.2, 0.2])
    assert settings["calm"] == pytest.approx([1.0] * 12)


def test_a_dial_with_a_sweep_time_moves_at_its_pace_and_stops_where_it_was_turned_to():
    slow = dataclasses.replace(policy(), dials={"speed": SPEED, "calm": dataclasses.replace(CALM, sweep_time=0.1)})
    turned = with_schedule(slow, {"calm": [[0, 0.0], [0.02, 0.35]]})
    # a range of 1 in 10 steps: a tenth per step
    assert turned.settings(8)["calm"] == pytest.approx([0, 0, 0.1, 0.2, 0.3, 0.35, 0.35, 0.35])


def test_a_constant_schedule_is_a_setting():
    slow = with_schedule(policy(), {"speed": 0.3})
    assert isinstance(slow, Policy)
    assert slow.setting == {"speed": 0.3, "calm": 0.5}


@pytest.mark.parametrize(
    "schedule",
    [
        {"speed": [[1, 0.3]]},
        {"speed": [[0, 0.3], [2, 1.0], [2, 0.4]]},
        {"speed": [[0, 0.3], [2, 1.0], [1, 0.4]]},
        {"speed": [[0, 0.3, 1]]},
        {"speed": [0, 0.3]},
        {"speed": []},
        {"speed": [[0, "a"]]},
        {"speed": [[0, 5.0]]},
        {"speed": [[0, float("nan")]]},
        {"pace": [[0, 1.0]]},
        {"pace": 1.0},
    ],
)
def test_a_schedule_that_is_none_is_refused(schedule):
    with pytest.raises(BadInput, match="dial: "):
        with_schedule(policy(), schedule)
