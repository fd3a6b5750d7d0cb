"""Dials of a task: what follows them, what a controller is told, how they are drawn and turned, what is refused."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.config.formula import Formula
from flytune.errors import BadInput
from flytune.simulation import environment
from flytune.simulation.rollout import reset_all
from flytune.task.dial import Dial, Input, number_of_inputs, told
from flytune.task.files import load_task, read_task_text, write_task
from flytune.training.update import turned

FAMILY = load_task("dial")
OBSERVATION = jnp.arange(1.0, 18.0)


def file(tmp_path, text):
    """A task file that changes the baseline."""
    path = tmp_path / "mine.toml"
    path.write_text(f'based_on = "baseline"\n{text}')
    return str(path)


DIALS = """
[dial.speed]
lowest = 0.5
highest = 2.0
default = 1.0
[dial.calm]
lowest = 0.0
highest = 1.0
default = 0.5
[follow]
"termination.speed.bound" = "speed"
"reward.velocity.weight" = "0.1 + 0.2 * calm / speed"
[input.calm]
value = "calm"
[input.share]
of = "velocity"
value = "1 / speed"
"""


def test_every_field_that_follows_has_the_value_of_its_formula_at_every_setting(tmp_path):
    family = load_task(file(tmp_path, DIALS))
    for speed, calm in ((0.5, 0.0), (1.0, 0.5), (2.0, 1.0)):
        task = family.at({"speed": speed, "calm": calm})
        assert task.termination["speed"].bound == pytest.approx(speed)
        assert task.reward["velocity"].weight == pytest.approx(0.1 + 0.2 * calm / speed)
        assert not (task.dial or task.follow or task.input)
        member = family.member({"speed": jnp.asarray(speed), "calm": jnp.asarray(calm)})
        assert float(member.reward["velocity"].weight) == pytest.approx(0.1 + 0.2 * calm / speed)
    # without a setting, and in the family itself, the fields have their values at the defaults
    assert family.speed_bound == family.at().speed_bound == 1.0
    assert family.at({"calm": 1.0}).reward["velocity"].weight == pytest.approx(0.3)


def test_a_family_is_written_and_read_without_a_difference(tmp_path):
    for family in (FAMILY, load_task(file(tmp_path, DIALS))):
        text = write_task(family)
        again = read_task_text(text, "text")
        assert write_task(again) == text
        assert (again.follow, again.dial.keys(), again.input) == (family.follow, family.dial.keys(), family.input)


def test_a_task_without_a_dial_is_written_without_a_word_of_dials():
    assert "dial" not in write_task(load_task("baseline"))
    assert load_task("baseline").at() is not None
    assert load_task("baseline").inputs == 17


def test_the_controller_is_told_what_the_inputs_say(tmp_path):
    family = load_task(file(tmp_path, DIALS))
    seen = family.see(OBSERVATION, {"speed": jnp.asarray(2.0), "calm": jnp.asarray(0.25)})
    # in the order of the names: calm, share (the velocity is 8, 9, 10 in this observation)
    np.testing.assert_allclose(seen, [*range(1, 18), 0.25, 4.0, 4.5, 5.0], rtol=1e-6)
    assert family.inputs == 17 + number_of_inputs(family.input) == 21


def test_every_block_of_the_observation_can_be_an_input():
    places = {"position_error": (0, 3), "attitude_error": (3, 7), "velocity": (7, 10), "body_rate": (10, 13),
              "last_action": (13, 17)}  # fmt: skip
    for block, (first, end) in places.items():
        inputs = {"one": Input(of=block, value=Formula("speed"))}
        seen = told(inputs, OBSERVATION, {"speed": jnp.asarray(2.0)})
        np.testing.assert_allclose(seen[17:], 2 * OBSERVATION[first:end])


def test_a_dial_is_drawn_evenly_in_its_spacing():
    keys = jax.random.split(jax.random.key(0), 4000)
    for spacing, middle in (("linear", 0.9), ("logarithmic", math.sqrt(0.2 * 1.6))):
        dial = Dial(lowest=0.2, highest=1.6, default=0.8, spacing=spacing)
        values = np.asarray(jax.vmap(dial.draw)(keys))
        assert values.min() >= 0.2 - 1e-6
        assert values.max() <= 1.6 + 1e-6
        assert np.mean(values < middle) == pytest.approx(0.5, abs=0.03)  # four standard deviations
        grid = dial.grid(3)
        assert grid == pytest.approx([0.2, middle, 1.6])
        assert (grid[0], grid[-1]) == (0.2, 1.6)


def test_training_also_draws_settings_beyond_the_ends_by_the_stated_share_of_the_range():
    keys = jax.random.split(jax.random.key(0), 4000)
    # a tenth of the range beyond both ends: 0.2 - 0.14 and 1.6 + 0.14; a factor of 8^0.1 = 1.231
    for spacing, low, high in (("linear", 0.06, 1.74), ("logarithmic", 0.2 / 1.231, 1.6 * 1.231)):
        dial = Dial(lowest=0.2, highest=1.6, default=0.8, spacing=spacing, trained_beyond=0.1)
        values = np.asarray(jax.vmap(dial.draw)(keys))
        assert (values.min(), values.max()) == pytest.approx((low, high), rel=0.02)
        # a twelfth of the draws lies beyond each end: 0.1 / 1.2
        assert (values > 1.6).mean() == pytest.approx(1 / 12, abs=0.018)  # four standard deviations
        assert (values < 0.2).mean() == pytest.approx(1 / 12, abs=0.018)
        assert (dial.grid(5)[0], dial.grid(5)[-1]) == (0.2, 1.6)


def test_the_horizon_follows_a_dial_in_whole_steps_and_ends_an_episode_there(tmp_path):
    family = load_task(file(tmp_path, DIALS.replace("[follow]", '[follow]\nhorizon = "100.5 / speed"')))
    # 201 at 0.5; 100.5 is no whole number of steps, and 101 are the first that reach it
    for speed, steps in ((0.5, 201), (1.0, 101), (2.0, 51)):
        assert family.at({"speed": speed}).horizon == steps
        member = family.member({"speed": jnp.asarray(speed), "calm": jnp.asarray(0.5)})
        episode = environment.reset(member, jax.random.key(0))
        for before, truncated in ((steps - 2, False), (steps - 1, True)):
            late = dataclasses.replace(episode, steps=jnp.asarray(before))
            assert bool(environment.step(member, late, jnp.zeros(4))[1].truncated) is truncated


def test_episodes_of_one_batch_have_settings_of_their_own_and_the_bounds_that_follow():
    episodes = reset_all(FAMILY, jax.random.split(jax.random.key(0), 50))
    speeds = np.asarray(episodes.numbers["speed"])
    assert len(np.unique(speeds)) == 50

    def margin(episode):
        return environment.step(FAMILY.member(episode.numbers), episode, jnp.zeros(4))[1].margins["speed"]

    moving = dataclasses.replace(
        episodes, state=dataclasses.replace(episodes.state, velocity=(0.1 * jnp.ones(50),) * 3)
    )
    margins = jax.vmap(margin, in_axes=-1)(moving)
    change = 0.01 * 9.81 / speeds  # of the speed within a step, by a tilted thrust
    np.testing.assert_array_less(np.abs(margins - (1 - 0.1 * math.sqrt(3) / speeds)), change)


def test_about_the_stated_share_of_the_dials_is_turned_before_an_update():
    episodes = reset_all(FAMILY, jax.random.split(jax.random.key(0), 1000))
    after = turned(FAMILY, episodes, jax.random.key(1))
    changed = np.asarray(after.numbers["speed"] != episodes.numbers["speed"])
    assert changed.mean() == pytest.approx(FAMILY.dial["speed"].turned, abs=0.06)  # four standard deviations
    fixed = load_task("baseline")
    episodes = reset_all(fixed, jax.random.split(jax.random.key(0), 3))
    assert turned(fixed, episodes, jax.random.key(1)) is episodes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (DIALS.replace('= "speed"', '= "spede"'), "termination.speed.bound: spede is no dial. Allowed: speed, calm"),
        (DIALS.replace('= "speed"', '= "speed +"'), "it is not a formula"),
        (DIALS.replace('= "speed"', '= "speed - 0.5"'), "at speed 0.5, calm 0: termination.speed.bound: 0.0"),
        (DIALS.replace('= "speed"', '= "1 / calm"'), "has no value at speed 0.5, calm 0"),
        (DIALS.replace('"termination.speed.bound"', '"termination.speed.limit"'), "the task has no such number"),
        (DIALS.replace('"termination.speed.bound"', '"termination.speed"'), "the task has no such number"),
        (DIALS.replace('"termination.speed.bound"', '"apg.updates"'), "cannot follow a dial"),
        (DIALS.replace("lowest = 0.5", "lowest = 3.0"), "dial.speed.lowest: 3.0 is not below highest"),
        (DIALS.replace("default = 1.0", "default = 5.0"), "dial.speed.default: 5.0 is out of range"),
        (DIALS.replace("lowest = 0.0", 'lowest = 0.0\nspacing = "logarithmic"'), "has no logarithm"),
        (DIALS.replace("default = 0.5", "default = 0.5\ntrained_beyond = 0.6"), "calm -0.6: reward.velocity"),
        (DIALS.replace("[follow]", '[follow]\nhorizon = "0 * speed"'), "horizon: 0 is not allowed"),
        (DIALS.replace("dial.calm", "dial.log"), "dial.log: cannot be used in a formula"),
        (DIALS.replace('value = "1 / speed"', 'value = "1 / quick"'), "input.share.value: quick is no dial"),
        ('[follow]\n"duration" = "8"\n', "dial: no dial, though"),
        ("".join(f"[dial.d{i}]\nlowest = 0\nhighest = 1\ndefault = 0\n" for i in range(5)), "5 dials are not allowed"),
        (DIALS + "[dial.x]\nlow = 1\n", "dial.x.low: no such field"),
    ],
)  # fmt: skip
def test_dials_that_cannot_work_are_refused_in_one_line(tmp_path, text, message):
    with pytest.raises(BadInput) as error:
        load_task(file(tmp_path, text))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "edit",
    [
        {"termination.speed.bound": 0.5},
        {"termination.speed": {"kind": "maximum_speed", "bound": 0.5}},
        {"termination": {"speed": {"kind": "maximum_speed", "bound": 0.5}}},
    ],
)
def test_a_field_that_follows_a_dial_cannot_be_set_by_itself(edit):
    with pytest.raises(BadInput, match=r"termination\.speed\.bound: follows the dials of this task, as speed"):
        load_task("dial", edit)


def test_the_dial_or_the_formula_of_a_field_that_follows_it_can_be_set():
    assert load_task("dial", {"dial.speed.default": 0.5}).speed_bound == 0.5
    # its formula can
    assert load_task("dial", {"follow.termination.speed.bound": "2 * speed"}).speed_bound == 1.6
    assert load_task("dial", {"follow.termination.speed.bound": 0.7}).at({"speed": 0.2}).speed_bound == 0.7


def test_a_file_may_repeat_the_value_of_a_field_that_follows_and_give_no_other(tmp_path):
    assert load_task(file(tmp_path, DIALS + "[termination.speed]\nbound = 1.0\n")).speed_bound == 1.0
    with pytest.raises(BadInput, match=r"mine\.toml: termination\.speed\.bound: 0\.9 is not allowed, since it follows"):
        load_task(file(tmp_path, DIALS + "[termination.speed]\nbound = 0.9\n"))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"speed": 3.0}, "dial: speed=3.0 is not allowed. Allowed: 0.2 to 1.6 m/s."),
        ({"speed": "fast"}, "dial: speed=fast is not allowed"),
        ({"speed": True}, "is not allowed"),
        ({"speed": math.nan}, "is not allowed"),
        ({"pace": 1.0}, "dial: 'pace' is no dial here. Allowed: speed."),
    ],
)
def test_a_setting_that_is_no_setting_is_refused(setting, message):
    with pytest.raises(BadInput) as error:
        FAMILY.at(setting)
    assert message in str(error.value)
