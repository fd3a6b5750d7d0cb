"""flytune's environment as a vector environment of Stable-Baselines3: one compiled call steps all episodes."""

# pyright: reportMissingImports=false
# PyTorch is in no pinned requirement; without it the rest is checked all the same

import time
from collections.abc import Iterable
from typing import Any

import numpy as np

from flytune.errors import require
from flytune.simulation.host import HostEnvironment, Transition
from flytune.simulation.simulators import make_simulator
from flytune.task.observation import SIZE
from flytune.task.task import Task
from flytune.task.termination import causes

for package in ("gymnasium", "torch", "stable_baselines3"):
    require(package, "sb3")

from gymnasium import spaces  # noqa: E402
from stable_baselines3.common.vec_env import VecEnv  # noqa: E402

Indices = int | Iterable[int] | None


class HoverVecEnv(VecEnv):
    """N environments of one task; one that ends starts anew at once, as Stable-Baselines3 expects.

    The info of a step is empty until an episode ends; it then holds `terminal_observation`, `TimeLimit.truncated`,
    `episode` with its return `r`, length `l` and time `t` in s as Stable-Baselines3's Monitor gives them, and `cause`,
    the termination condition that was broken or "horizon". The seed holds until `seed` and `reset` are called.
    """

    transition: Transition | None = None  # of the last step, with the reward of each term

    def __init__(self, task: Task, number: int, seed: int = 0, simulator: str = "flytune") -> None:
        self.task = task
        self.environment = HostEnvironment(task, make_simulator(simulator, task.vehicle, number), number)
        self.environment.reset(seed)
        self.render_mode: str | None = None  # the base class reads it before it sets it
        self._names = causes(task.termination)
        self._own: list[dict[str, Any]] = [{} for _ in range(number)]
        self._action, self._started = np.zeros((number, 4), np.float32), time.monotonic()
        super().__init__(
            number,
            spaces.Box(-np.inf, np.inf, (SIZE,), np.float32),
            spaces.Box(-1.0, 1.0, (4,), np.float32),
        )

    def reset(self) -> np.ndarray:
        """The observations [N, 17] of new episodes, drawn from the seed that `seed` was last given, if any."""
        seed = self._seeds[0]
        self._reset_seeds()
        self._reset_options()
        return self.environment.reset(None if seed is None else seed % 2**32)

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions [N, 4] of the next step.

        Raises:
            ValueError: they have another shape, or are not finite.
        """
        actions = np.asarray(actions, np.float32)
        if actions.shape != self._action.shape:
            raise ValueError(f"actions: shape {actions.shape} is not allowed. Allowed: {self._action.shape}.")
        if not np.isfinite(actions).all():
            raise ValueError("actions: hold numbers that are not finite. Allowed: -1 to 1.")
        self._action = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations [N, 17], rewards [N], whether an episode ended [N], and N infos."""
        self.transition = now = self.environment.step(self._action)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if (ended := now.ended).any():
            failed, cause, final = now.terminated, now.cause, now.final_observation
            total, length, elapsed = now.episode_return, now.episode_length, time.monotonic() - self._started
            for index in np.flatnonzero(ended):
                infos[index] = {
                    "terminal_observation": final[index],
                    "TimeLimit.truncated": not failed[index],
                    "cause": self._names[cause[index]] if failed[index] else "horizon",
                    "episode": {"r": float(total[index]), "l": int(length[index]), "t": round(elapsed, 6)},
                }
        return self.environment.observation, now.reward, ended, infos

    def close(self) -> None:
        """Free the memory of the simulator."""
        self.environment.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of each environment: the value from `set_attr`, else the shared one."""
        which = self._get_indices(indices)
        return [self._own[i][attr_name] if attr_name in self._own[i] else getattr(self, attr_name) for i in which]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Store a value for environments; attributes that all of them share (the task, the spaces) cannot be set.

        Raises:
            AttributeError: the environments share that attribute.
        """
        if hasattr(self, attr_name):
            raise AttributeError(f"{attr_name}: is shared by all environments. Make another HoverVecEnv.")
        for index in self._get_indices(indices):
            self._own[index][attr_name] = value

    def env_method(self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any) -> Any:
        """Refuse: the environments are one batch, and have no methods of their own.

        Raises:
            AttributeError: always.
        """
        raise AttributeError(f"{method_name}: these environments are one batch and have no methods of their own.")

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """False for each environment: nothing wraps them one by one."""
        return [False for _ in self._get_indices(indices)]
