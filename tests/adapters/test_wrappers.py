"""flytune/Hover-v0 under the wrappers and in the loops that people put around an environment."""

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="needs flytune[gymnasium]")

from gymnasium import wrappers  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

import flytune.adapters.gymnasium  # noqa: E402, F401
from flytune.task.files import load_task  # noqa: E402

NUMBER, HORIZON = 6, 12  # six as in test_gymnasium: one compiled program serves them all
TASK = load_task("baseline", {"horizon": HORIZON})
HOVER = np.zeros((NUMBER, 4), np.float32)


def make(**given):
    return gymnasium.make("flytune/Hover-v0", task=TASK, **given)


def make_many(**given):
    return gymnasium.make_vec("flytune/Hover-v0", num_envs=NUMBER, task=TASK, **given)


def episode(env):
    """All that an episode near hover gives, its reset first."""
    steps = [(env.reset(seed=0)[0],)]
    while len(steps[-1]) == 1 or not (steps[-1][2] or steps[-1][3]):
        steps.append(env.step(np.zeros(env.action_space.shape, np.float32)))
    return steps


def test_the_statistics_of_an_episode_are_its_sum_and_length():
    steps = episode(wrappers.RecordEpisodeStatistics(make()))
    told = steps[-1][4]["episode"]
    assert told["l"] == HORIZON == len(steps) - 1
    assert told["r"] == pytest.approx(sum(step[1] for step in steps[1:]), rel=1e-5)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP], ids=lambda mode: mode.name)
def test_the_statistics_of_many_episodes_are_their_sums_and_lengths(mode):
    envs = wrappers.vector.RecordEpisodeStatistics(make_many(autoreset_mode=mode))
    envs.reset(seed=0)
    total = np.zeros(NUMBER)
    for _ in range(HORIZON):
        _, rewards, _, truncated, infos = envs.step(HOVER)
        total += rewards
    assert truncated.all()
    told = infos["episode"]
    assert told["l"].tolist() == [HORIZON] * NUMBER
    np.testing.assert_allclose(told["r"], total, rtol=1e-5)


def test_observations_and_rewards_are_normalised():
    env = wrappers.NormalizeReward(wrappers.NormalizeObservation(make()))
    steps = episode(env)
    assert np.all(np.isfinite([step[0] for step in steps])) and np.all(np.isfinite([step[1] for step in steps[1:]]))
    assert env.env.obs_rms.mean.shape == (17,) and not np.allclose(np.linalg.norm(steps[-1][0][3:7]), 1, atol=1e-3)
    many = wrappers.vector.NormalizeObservation(make_many(autoreset_mode=AutoresetMode.NEXT_STEP))
    assert many.reset(seed=0)[0].shape == many.step(HOVER)[0].shape == (NUMBER, 17)


def test_an_unbounded_observation_cannot_be_rescaled_and_says_so_but_can_be_transformed_and_actions_rescaled():
    with pytest.raises(ValueError, match="unbounded components"):
        wrappers.RescaleObservation(make(), -1.0, 1.0)
    space = gymnasium.spaces.Box(-np.inf, np.inf, (17,), np.float32)
    half = wrappers.TransformObservation(make(), lambda observation: 0.5 * observation, space)
    np.testing.assert_allclose(half.reset(seed=3)[0], 0.5 * make().reset(seed=3)[0])
    rescaled = wrappers.RescaleAction(make(), np.float32(0), np.float32(1))
    rescaled.reset(seed=0)
    np.testing.assert_allclose(rescaled.step(np.float32([0.5, 1, 0, 0.5]))[0][13:], [0, 1, -1, 0], atol=1e-6)


def test_a_loop_in_the_style_of_cleanrl_runs():
    """One rollout buffer filled over the end of episodes, as ppo_continuous_action.py fills it."""
    envs = wrappers.vector.RecordEpisodeStatistics(make_many())
    assert isinstance(envs.single_action_space, gymnasium.spaces.Box)
    size, actions = np.prod(envs.single_observation_space.shape), np.random.default_rng(0).normal(size=(20, NUMBER, 4))
    observation, _ = envs.reset(seed=1)
    buffer, returns = np.zeros((20, NUMBER, size)), []
    for step in range(20):
        buffer[step] = observation
        observation, _, terminated, truncated, infos = envs.step(np.clip(0.1 * actions[step], -1, 1))
        if "episode" in infos:
            ended = infos["_episode"]
            assert (ended == (terminated | truncated)).all()
            returns += list(infos["episode"]["r"][ended])
            assert all(infos["final_obs"][index].shape == (17,) for index in np.flatnonzero(ended))
    assert len(returns) >= NUMBER and np.all(np.isfinite(returns)) and np.all(np.isfinite(buffer))


def test_processes_of_their_own_give_the_same_as_this_one():
    # started by spawn: a process that uses JAX must not be forked
    seen = []
    for mode, options in (("sync", {}), ("async", {"context": "spawn"})):
        envs = gymnasium.make_vec(
            "flytune.adapters.registration:flytune/Hover-v0",
            num_envs=2,
            task="baseline",
            vectorization_mode=mode,
            vector_kwargs=options,
        )
        seen.append([envs.reset(seed=5)[0], *(envs.step(HOVER[:2])[0] for _ in range(3))])
        envs.close()
    np.testing.assert_array_equal(*seen)


def test_frames_of_an_episode_are_collected():
    env = wrappers.RenderCollection(make(render_mode="rgb_array"))
    steps = episode(env)
    assert [frame.shape for frame in env.render()] == [(480, 480, 3)] * len(steps)
