"""Our vector environment of Stable-Baselines3: what it promises to those that learn in it."""

import pytest

pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")

import csv
import pickle
from pathlib import Path

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor, VecNormalize

from flytune.adapters.gymnasium import HoverEnv
from flytune.adapters.vec_env import HoverVecEnv
from flytune.errors import BadInput
from flytune.task.files import load_task

NUMBER, HORIZON = 6, 12
GENTLE = np.zeros((NUMBER, 4), np.float32)


@pytest.fixture(scope="module")
def task():
    """The baseline with short episodes, and so much speed allowed that hover reaches the horizon."""
    return load_task("baseline", {"horizon": HORIZON})


@pytest.fixture
def environments(task):
    """Six of them."""
    return HoverVecEnv(task, NUMBER, seed=4)


def test_an_episode_that_reaches_its_horizon_says_so_and_shows_where_it_stopped(environments):
    before = environments.reset()
    rewards, terms = [], []
    for step in range(1, HORIZON + 1):
        observations, reward, ended, infos = environments.step(GENTLE)
        rewards.append(reward)
        terms.append(sum(environments.transition.terms.values()))
        assert observations.shape == (NUMBER, 17) and observations.dtype == np.float32
        assert reward.shape == ended.shape == (NUMBER,) and ended.dtype == bool
        if step < HORIZON:
            assert not ended.any() and all(info == {} for info in infos)
    assert ended.all()
    np.testing.assert_allclose(rewards, terms, atol=1e-6)
    for index, info in enumerate(infos):
        assert info["TimeLimit.truncated"] is True and info["termination"] is None
        assert set(info["reward_terms"]) == set(environments.task.reward)
        assert sum(info["reward_terms"].values()) == pytest.approx(rewards[-1][index], abs=1e-6)
        assert info["episode"]["l"] == HORIZON and info["episode"]["t"] > 0
        assert info["episode"]["r"] == pytest.approx(np.sum(rewards, axis=0)[index], abs=1e-5)
        # after 0.12 s near hover: still about where it began, and not where the next one begins
        assert np.abs(info["terminal_observation"][:3] - before[index, :3]).max() < 0.15
    stopped = np.stack([info["terminal_observation"] for info in infos])
    assert np.abs(stopped[:, :3] - observations[:, :3]).max() > 0.3


def test_an_episode_that_fails_is_no_time_limit_and_names_what_was_broken(environments):
    environments.reset()
    spin = np.tile(np.float32([1, -1, 1, -1]), (NUMBER, 1))
    spin[0] = 0  # one that goes on hovering
    seen = {}
    for _ in range(HORIZON - 1):
        _, _, ended, infos = environments.step(np.where(np.arange(NUMBER)[:, None] == 1, [1, 1, -1, -1], spin))
        assert not ended[0]
        seen |= {index: info for index, info in enumerate(infos) if info}
    assert seen[1]["TimeLimit.truncated"] is False
    assert seen[1]["termination"] in ("body_rate", "speed", "attitude") and seen[1]["episode"]["l"] < HORIZON


def test_a_seed_repeats_everything_and_no_seed_goes_on(environments):
    def flight(seed):
        if seed is not None:
            environments.seed(seed)
        return [environments.reset().copy()] + [environments.step(GENTLE)[0] for _ in range(HORIZON + 3)]

    first, again, other, later = flight(7), flight(7), flight(8), flight(None)
    np.testing.assert_array_equal(first, again)
    for another in (other, later):
        assert np.abs(np.subtract(first, another)).max() > 0.1


def test_what_a_trainer_does_to_rewards_and_infos_does_not_come_back(environments):
    environments.reset()
    _, reward, _, infos = environments.step(GENTLE)
    kept = environments.transition.reward.copy()
    reward += 100
    infos[0]["mark"] = 1
    np.testing.assert_array_equal(environments.transition.reward, kept)
    _, _, _, later = environments.step(GENTLE)
    assert "mark" not in later[0] and len({id(info) for info in later}) == NUMBER


@pytest.mark.parametrize("actions", [np.zeros(4), np.zeros((NUMBER, 3)), np.zeros((NUMBER + 1, 4))])
def test_actions_of_another_shape_are_refused(environments, actions):
    with pytest.raises(ValueError, match="shape"):
        environments.step(actions)


def test_actions_that_are_not_finite_are_refused(environments):
    with pytest.raises(ValueError, match="finite"):
        environments.step(GENTLE + np.nan)


def test_attributes_can_be_kept_with_single_environments_but_what_they_share_cannot_be_changed(environments, task):
    environments.set_attr("level", 3, indices=[1, 2])
    assert environments.get_attr("level", [1, 2]) == [3, 3]
    assert environments.get_attr("task") == [task] * NUMBER and environments.get_attr("render_mode", 0) == [None]
    assert not environments.has_attr("level") and environments.has_attr("task")
    with pytest.raises(AttributeError, match="shared"):
        environments.set_attr("task", None)
    with pytest.raises(AttributeError, match="one batch"):
        environments.env_method("reset")
    assert environments.env_is_wrapped(Monitor, [0, 3]) == [False, False]


@pytest.mark.floor
@pytest.mark.filterwarnings("error")
def test_the_wrappers_and_the_logs_of_stable_baselines3_work_on_it(environments):
    wrapped = VecNormalize(VecCheckNan(VecMonitor(environments), raise_exception=True))
    model = PPO("MlpPolicy", wrapped, n_steps=24, batch_size=36, n_epochs=1, device="cpu", seed=0)
    model.learn(2 * 24 * NUMBER)
    lengths = [info["l"] for info in model.ep_info_buffer]
    assert len(lengths) >= NUMBER and max(lengths) == HORIZON
    rewards, lengths = evaluate_policy(model, wrapped, n_eval_episodes=8, return_episode_rewards=True)
    assert len(rewards) == len(lengths) == 8 and max(lengths) <= HORIZON


def test_the_mean_return_and_length_of_episodes_are_logged_without_a_wrapper(environments, tmp_path):
    model = PPO("MlpPolicy", environments, n_steps=24, batch_size=36, n_epochs=1, device="cpu", seed=0)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(24 * NUMBER)
    (row,) = csv.DictReader((tmp_path / "progress.csv").read_text().splitlines())
    for column, key in (("rollout/ep_rew_mean", "r"), ("rollout/ep_len_mean", "l")):
        assert float(row[column]) == pytest.approx(np.mean([info[key] for info in model.ep_info_buffer]))


def test_its_spaces_are_those_of_the_gymnasium_environment(environments, task):
    assert environments.observation_space == HoverEnv(task).observation_space
    assert environments.action_space == HoverEnv(task).action_space
    assert environments.num_envs == NUMBER


def test_a_model_of_one_door_is_loaded_at_every_other(environments, task, tmp_path):
    doors = [environments, HoverEnv(task), DummyVecEnv([lambda: HoverEnv(task)])]
    for number, door in enumerate(doors):
        PPO("MlpPolicy", door, n_steps=8, batch_size=8, device="cpu").save(tmp_path / f"{number}.zip")
        for other in doors:
            PPO.load(tmp_path / f"{number}.zip", env=other, device="cpu")


def test_a_model_saved_with_the_former_box_is_loaded_as_the_page_says(task, tmp_path):
    class Former(HoverEnv):
        observation_space = None

        def __init__(self):
            super().__init__(task)
            largest = float(np.finfo(np.float32).max)
            self.observation_space = gymnasium.spaces.Box(-largest, largest, (17,), np.float32)

    PPO("MlpPolicy", Former(), n_steps=8, batch_size=8, device="cpu").save(tmp_path / "old.zip")
    env = HoverEnv(task)
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        PPO.load(tmp_path / "old.zip", env=env, device="cpu")
    spaces = {"observation_space": env.observation_space}
    PPO.load(tmp_path / "old.zip", env=env, custom_objects=spaces, device="cpu").predict(env.reset(seed=0)[0])
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "stable-baselines3.md").read_text(encoding="utf-8")
    assert 'custom_objects={"observation_space": env.observation_space}' in page


def test_starts_can_be_given_for_all_or_for_each_and_not_for_some(environments):
    environments.set_options({"position": [0.3, 0.2, 1.1], "yaw": 0.5})
    # the noise on a position has a standard deviation of 1 mm; six environments, six of them
    np.testing.assert_allclose(environments.reset()[:, :3], [[0.3, 0.2, 0.1]] * NUMBER, atol=6e-3)
    assert np.abs(environments.reset()[:, 0] - 0.3).max() > 0.05  # options hold for one reset
    environments.set_options([{"position": [0.1 * index, 0.0, 1.0]} for index in range(NUMBER)])
    np.testing.assert_allclose(environments.reset()[:, 0], 0.1 * np.arange(NUMBER), atol=6e-3)
    environments.set_options([{"position": [0.1, 0.0, 1.0]}, *({} for _ in range(NUMBER - 1))])
    with pytest.raises(BadInput, match="1 of 6 environments"):
        environments.reset()
    environments.set_options({"start": [0, 0, 1]})
    with pytest.raises(BadInput, match=r"options\.start: is unknown"):
        environments.reset()


def test_it_takes_what_the_gymnasium_environment_takes(tmp_path):
    made = HoverVecEnv("acrobatic", 2, edits={"horizon": 3}, simulator_options={"physics_steps": 2})
    assert made.task.name == "acrobatic" and made.task.horizon == 3
    with pytest.raises(BadInput, match="basline"):
        HoverVecEnv("basline", 2)
    with pytest.raises(BadInput, match="render_mode: 'human'"):
        HoverVecEnv("baseline", 2, render_mode="human")


def test_pictures_are_tiled_and_only_drawn_where_asked_for(task, environments):
    drawn = HoverVecEnv(task, 4, render_mode="rgb_array")
    first = drawn.render()
    for _ in range(6):
        drawn.step(np.full((4, 4), 0.3, np.float32))
    assert first.shape == (960, 960, 3) and (drawn.render() != first).any()
    with pytest.warns(UserWarning, match="render_mode"):
        assert environments.render() is None


def test_a_copy_goes_on_as_the_original_does(environments):
    environments.reset()
    twin = pickle.loads(pickle.dumps(environments))
    for _ in range(HORIZON + 2):
        mine, theirs = environments.step(GENTLE), twin.step(GENTLE)
        np.testing.assert_array_equal(mine[0], theirs[0])
        np.testing.assert_array_equal(mine[1], theirs[1])
