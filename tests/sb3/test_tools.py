"""The tools of Stable-Baselines3 around flytune's environments: monitors, evaluation in training, films, processes."""

import pytest

pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")

import csv

import numpy as np
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize

from flytune.adapters.gymnasium import HoverEnv
from flytune.adapters.vec_env import HoverVecEnv
from flytune.export.untrusted.sb3_model import load_sb3
from flytune.task.files import load_task

HORIZON = 12
TASK = load_task("baseline", {"horizon": HORIZON})
SIZES = {"n_steps": 24, "batch_size": 24, "n_epochs": 1, "device": "cpu", "seed": 0}


@pytest.mark.filterwarnings("error")
def test_the_checker_of_stable_baselines3_finds_nothing():
    check_env(HoverEnv(TASK))


def test_a_monitor_writes_what_the_infos_say(tmp_path):
    environments = VecMonitor(
        HoverVecEnv(TASK, 3), str(tmp_path / "log"), info_keywords=("termination", "TimeLimit.truncated")
    )
    environments.reset()
    for _ in range(HORIZON):
        _, _, _, infos = environments.step(np.zeros((3, 4), np.float32))
    environments.close()
    rows = list(csv.DictReader((tmp_path / "log.monitor.csv").read_text().splitlines()[1:]))
    assert [int(row["l"]) for row in rows] == [HORIZON] * 3
    np.testing.assert_allclose([float(row["r"]) for row in rows], [info["episode"]["r"] for info in infos], atol=1e-5)


@pytest.mark.filterwarnings("error")
def test_an_evaluation_in_a_training_keeps_the_best_model_and_its_statistics(tmp_path):
    training = VecNormalize(HoverVecEnv(TASK, 2))
    other = VecNormalize(VecMonitor(HoverVecEnv(TASK, 2, seed=1)), training=False, norm_reward=False)
    callback = EvalCallback(other, eval_freq=24, n_eval_episodes=4, best_model_save_path=str(tmp_path), verbose=0)
    PPO("MlpPolicy", training, **SIZES).learn(96, callback=callback)
    assert callback.last_mean_reward > 0 and callback.evaluations_length == []
    training.save(str(tmp_path / "vecnormalize.pkl"))
    assert load_sb3(tmp_path / "best_model.zip").bounds is not None


def test_frames_are_stacked_and_such_a_model_is_refused_with_its_size(tmp_path):
    stacked = VecFrameStack(HoverVecEnv(TASK, 2), 3)
    assert stacked.reset().shape == (2, 51)
    PPO("MlpPolicy", stacked, **SIZES).save(tmp_path / "stacked.zip")
    with pytest.raises(ValueError, match=r"observation_space \[51\], allowed: \[17\]"):
        load_sb3(tmp_path / "stacked.zip")


def test_make_vec_env_starts_processes_by_spawn():
    environments = make_vec_env(
        "flytune.adapters.registration:flytune/Hover-v0",
        n_envs=2,
        seed=3,
        env_kwargs={"task": "baseline", "edits": {"horizon": HORIZON}},
        vec_env_cls=SubprocVecEnv,
        vec_env_kwargs={"start_method": "spawn"},
    )
    environments.reset()
    for _ in range(HORIZON):
        _, _, ended, infos = environments.step(np.zeros((2, 4), np.float32))
    environments.close()
    assert ended.all() and [info["termination"] for info in infos] == [None, None]
    assert [info["episode"]["l"] for info in infos] == [HORIZON, HORIZON]


def test_an_algorithm_with_a_replay_buffer_learns_in_it():
    model = SAC(
        "MlpPolicy", HoverVecEnv(TASK, 2), device="cpu", seed=0, learning_starts=20, batch_size=16, buffer_size=200
    )
    model.learn(60)
    assert model.num_timesteps == 60 and model.replay_buffer.size() == 30
