"""Small Stable-Baselines3 models with flytune's spaces."""

import pytest

pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO

torch.set_num_threads(1)  # at this size more are slower, and very much so beside other tests


class Room(gymnasium.Env):
    """An environment with flytune's spaces in which nothing happens; a model needs one to be made."""

    def __init__(self, observations=17, actions=4, reach=1.0):
        shape = (observations,) if isinstance(observations, int) else observations
        self.observation_space = spaces.Box(-np.inf, np.inf, shape, np.float32)
        self.action_space = spaces.Box(-reach, reach, (actions,) if isinstance(actions, int) else actions, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(self.observation_space.shape, np.float32), {}

    def step(self, action):
        return np.zeros(self.observation_space.shape, np.float32), 0.0, False, False, {}


@pytest.fixture
def make_model():
    """An untrained PPO model, its weights spread so that actions reach both ends."""

    def make(room=None, algorithm=PPO, spread=1.0, **options):
        model = algorithm("MlpPolicy", room or Room(), device="cpu", seed=0, n_steps=64, **options)
        with torch.no_grad():
            for parameter in model.policy.parameters():
                parameter.add_(spread * 0.3 * torch.randn_like(parameter))
        return model

    return make
