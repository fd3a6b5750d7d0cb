"""Many vehicles at once for Gymnasium 1.x: flytune/Hover-v0 as a vector environment over the batched core."""

from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flytune.adapters.hover import (
    METADATA,
    TRAIL,
    make_spaces,
    read_action,
    read_mask,
    read_render_mode,
    read_task,
    take_picture,
)
from flytune.errors import BadInput, require
from flytune.simulation.host import HostEnvironment, Transition
from flytune.simulation.simulators import make_simulator
from flytune.task.task import Task
from flytune.task.termination import causes

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import AutoresetMode
else:
    gymnasium = require("gymnasium", "gymnasium")  # a missing one in one line
    AutoresetMode = gymnasium.vector.AutoresetMode


class HoverVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many vehicles that are to hover, stepped by one compiled call.

    An environment that ends starts anew in the same step (`AutoresetMode.SAME_STEP`): the observation is then the new
    episode's, and `final_obs` and `final_info` of the infos hold what the old one came to.

    Args:
        num_envs: how many.
        task: a preset, a .toml file, or a Task.
        edits: field path -> value, applied to a preset or file.
        simulator: "flytune", "pybullet" or "mujoco".
        simulator_options: of that simulator, see `make_simulator`.
        render_mode: None, or "rgb_array".

    Raises:
        BadInput: one of these is not allowed.
    """

    metadata = METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        task: str | Path | Task = "baseline",
        edits: dict[str, Any] | None = None,
        simulator: str = "flytune",
        simulator_options: dict[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        if num_envs < 1:
            raise BadInput(f"num_envs: {num_envs} is not allowed. Allowed: a whole number, 1 or more.")
        self.task = read_task(task, edits)
        self.render_mode = read_render_mode(render_mode)
        self.num_envs = num_envs
        self._simulator, self._simulator_options = simulator, simulator_options
        make_simulator(simulator, self.task.vehicle, 1, simulator_options).close()  # an unknown one is refused now
        self.single_observation_space, self.single_action_space = make_spaces()
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self._environment: HostEnvironment | None = None  # until the first reset, which brings the seed
        self._names = np.array([*causes(self.task.termination), None], dtype=object)  # the last, -1, is SAFE
        self._trail: deque[np.ndarray] = deque(maxlen=TRAIL)
        self._reward = np.zeros(num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """The observations at new starts, and an empty info.

        Args:
            seed: makes everything that follows reproducible.
            options: `reset_mask`, a boolean array of the environments to reset; all where it is left out.

        Raises:
            BadInput: an unknown option, or a mask that is none.
        """
        super().reset(seed=seed)
        mask = read_mask(options, self.num_envs)
        if self._environment is None:
            if mask is not None:
                raise gymnasium.error.ResetNeeded("reset() with a mask was called before the first full reset.")
            simulator = make_simulator(self._simulator, self.task.vehicle, self.num_envs, self._simulator_options)
            self._environment = HostEnvironment(self.task, simulator, self.num_envs)
            observation = self._environment.reset(int(self.np_random.integers(2**32)))
        else:
            anew = None if seed is None else int(self.np_random.integers(2**32))
            observation = self._environment.reset(anew, mask)
        self._reward = np.where(True if mask is None else mask, 0.0, self._reward)
        self._follow()
        return observation, {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """The observations, rewards, terminations, truncations and infos of one control period (0.01 s).

        Raises:
            ResetNeeded: before the first reset.
            InvalidAction: not four finite numbers for each environment.
        """
        if self._environment is None:
            raise gymnasium.error.ResetNeeded("step() was called before the first reset. Call reset() first.")
        moved = self._environment.step(read_action(actions, (self.num_envs, 4)))
        reward, observation = moved.reward, self._environment.observation
        self._reward = np.where(moved.ended, 0.0, reward)
        self._follow()
        return observation, reward, moved.terminated, moved.truncated, self._infos(moved)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture [480, 480, 3] of each environment, or None without a render mode.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('render() needs render_mode="rgb_array", given to gymnasium.make_vec.')
            return None
        if self._environment is None:
            raise gymnasium.error.ResetNeeded("render() was called before the first reset. Call reset() first.")
        steps, bodies, trail = self._environment.steps(), self._environment.states, np.array(self._trail)
        return tuple(
            take_picture(self.task, body, trail[-(count + 1) :, index], int(count), float(reward))
            for index, (body, count, reward) in enumerate(zip(bodies, steps, self._reward, strict=True))
        )

    def close_extras(self, **kwargs: Any) -> None:
        """Give the simulator's memory back."""
        if self._environment is not None:
            self._environment.close()

    def _follow(self) -> None:
        """Remember where the vehicles are, if somebody may want to see it."""
        if self.render_mode is not None and self._environment is not None:
            self._trail.append(self._environment.states[:, :3])

    def _infos(self, moved: Transition) -> dict[str, Any]:
        """The infos as Gymnasium's own vector environments give them: arrays, each with its mask `_name`."""
        ended = moved.ended
        infos = self._account(moved, ~ended)
        if ended.any():
            final, last = np.full(self.num_envs, None, dtype=object), moved.final_observation
            for index in np.flatnonzero(ended):
                final[index] = last[index]
            infos |= {"final_obs": final, "_final_obs": ended}
            infos |= {"final_info": self._account(moved, ended), "_final_info": ended.copy()}
        return infos

    def _account(self, moved: Transition, which: np.ndarray) -> dict[str, Any]:
        """The reward terms and terminations of the environments in a mask."""
        if not which.any():
            return {}
        terms: dict[str, Any] = {}
        for name, reward in moved.terms.items():
            terms |= {name: np.where(which, reward, 0.0), f"_{name}": which.copy()}
        termination = np.full(self.num_envs, None, dtype=object)
        termination[which] = self._names[moved.cause[which]]
        return {
            "reward_terms": terms,
            "_reward_terms": which.copy(),
            "termination": termination,
            "_termination": which.copy(),
        }
