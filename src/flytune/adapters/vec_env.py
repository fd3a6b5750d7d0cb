"""flytune's environment as a vector environment of Stable-Baselines3: one compiled call steps all episodes."""

# pyright: reportMissingImports=false
# PyTorch is in no pinned requirement; without it the rest is checked all the same

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flytune.adapters.hover import METADATA, Pictures, make_spaces, read_starts, read_task, refuse_unknown, start_at
from flytune.errors import BadInput, require
from flytune.simulation.host import HostEnvironment, Transition
from flytune.simulation.simulators import make_simulator
from flytune.task.task import Task
from flytune.task.termination import causes

for package in ("gymnasium", "torch", "stable_baselines3"):
    require(package, "sb3")

from stable_baselines3.common.vec_env import VecEnv  # noqa: E402

Indices = int | Iterable[int] | None


class HoverVecEnv(VecEnv):
    """N environments of one task; one that ends starts anew at once, as Stable-Baselines3 expects.

    The spaces are those of `flytune/Hover-v0`. For speed, the info of a step is empty until an episode ends; it then
    holds what that environment's info holds (`termination`, None where the horizon was reached, and `reward_terms`),
    and what Stable-Baselines3 expects: `terminal_observation`, `TimeLimit.truncated`, and `episode` with its return
    `r`, length `l` and time `t` in s as Monitor gives them. The seed holds until `seed` and `reset` are called.

    Args:
        task: a preset, a .toml file, or a Task.
        number: N.
        seed: of all random numbers.
        simulator: "flytune", "pybullet" or "mujoco".
        edits: field path -> value, applied to a preset or file.
        simulator_options: of that simulator, see `make_simulator`.
        render_mode: None, or "rgb_array".

    Raises:
        BadInput: one of these is not allowed, or the simulator's package is not installed.
    """

    transition: Transition | None = None  # of the last step, with the reward of each term

    def __init__(
        self,
        task: str | Path | Task = "baseline",
        number: int = 1,
        seed: int = 0,
        simulator: str = "flytune",
        edits: dict[str, Any] | None = None,
        simulator_options: dict[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.task = read_task(task, edits)
        used = make_simulator(simulator, self.task.vehicle, number, simulator_options)
        self.environment = HostEnvironment(self.task, used, number)
        self.environment.reset(seed)
        self.render_mode: str | None = render_mode  # the base class reads it before it sets it
        self._pictures, self._rewards = Pictures(render_mode), np.zeros(number)
        self._pictures.follow(self.environment)
        self._names = causes(self.task.termination)
        self._own: list[dict[str, Any]] = [{} for _ in range(number)]
        self._action, self._started = np.zeros((number, 4), np.float32), time.monotonic()
        super().__init__(number, *make_spaces())
        self.metadata = METADATA

    def reset(self) -> np.ndarray:
        """The observations [N, 17] of new episodes, drawn from the seed that `seed` was last given, if any.

        `set_options` may have given `position` and `yaw` as for `flytune/Hover-v0`: one start for all environments (a
        dictionary), or a list with a dictionary for each.

        Raises:
            BadInput: an unknown option, an impossible start, or starts for some environments only.
        """
        starts = self._starts()
        seed = self._seeds[0]
        self._reset_seeds()
        self._reset_options()
        observations = self.environment.reset(None if seed is None else seed % 2**32)
        if starts is not None:
            observations = start_at(self.environment, starts)
        self._rewards = np.zeros(self.num_envs)
        self._pictures.follow(self.environment)
        return observations

    def _starts(self) -> tuple[np.ndarray, np.ndarray] | None:
        each = []
        for options in self._options:
            refuse_unknown(options, "position", "yaw")
            each.append(read_starts(options, 1))
        given = [starts for starts in each if starts is not None]
        if given and len(given) < len(each):
            raise BadInput(f"options: give a start for {len(given)} of {len(each)} environments. Allowed: all or none.")
        return (np.concatenate([at for at, _ in given]), np.concatenate([yaw for _, yaw in given])) if given else None

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
        self._rewards = np.where(now.ended, 0.0, now.reward)
        self._pictures.follow(self.environment)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if (ended := now.ended).any():
            failed, cause, final = now.terminated, now.cause, now.final_observation
            total, length, elapsed = now.episode_return, now.episode_length, time.monotonic() - self._started
            terms = now.terms
            for index in np.flatnonzero(ended):
                infos[index] = {
                    "terminal_observation": final[index],
                    "TimeLimit.truncated": not failed[index],
                    "termination": self._names[cause[index]] if failed[index] else None,
                    "reward_terms": {name: float(rewards[index]) for name, rewards in terms.items()},
                    "episode": {"r": float(total[index]), "l": int(length[index]), "t": round(elapsed, 6)},
                }
        return self.environment.observation, now.reward, ended, infos

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture [480, 480, 3] of each environment; `render` shows them side by side."""
        return self._pictures.draw(self.environment, self._rewards) or [None] * self.num_envs

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
