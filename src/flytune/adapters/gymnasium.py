"""flytune/Hover-v0 for Gymnasium 1.x: one vehicle, and a vector environment of many over the batched core.

Out-of-range actions are clipped, as in the paper (R9). Misuse raises Gymnasium's own errors.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from flytune.adapters import registration
from flytune.adapters.hover import (
    METADATA,
    Pictures,
    make_spaces,
    read_action,
    read_mask,
    read_starts,
    read_task,
    refuse_unknown,
    start_at,
)
from flytune.errors import BadInput, require
from flytune.simulation.host import HostEnvironment, Transition, draw_episodes
from flytune.simulation.simulators import make_simulator
from flytune.task.observation import NOISY
from flytune.task.task import Task
from flytune.task.termination import causes

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import AutoresetMode
else:
    gymnasium = require("gymnasium", "gymnasium")  # a missing one in one line
    AutoresetMode = gymnasium.vector.AutoresetMode

registration.register()


class HoverEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One vehicle that is to hover at its target.

    Observation: the 17 numbers of `observation.LAYOUT`, with noise. Action: four numbers in [-1, 1], one per motor.
    The info of a step holds `reward_terms` {name: reward} and `termination`, the name of the condition that ended the
    episode, or None.

    Args:
        task: a preset, a .toml file, or a Task.
        edits: field path -> value, applied to a preset or file.
        simulator: "flytune", "pybullet" or "mujoco".
        simulator_options: of that simulator, see `make_simulator`.
        render_mode: None, or "rgb_array".

    Raises:
        BadInput: one of these is not allowed, or the simulator's package is not installed.
    """

    metadata = METADATA

    def __init__(
        self,
        task: str | Path | Task = "baseline",
        edits: dict[str, Any] | None = None,
        simulator: str = "flytune",
        simulator_options: dict[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.task = read_task(task, edits)
        self.render_mode = render_mode
        self._pictures = Pictures(render_mode)
        self.observation_space, self.action_space = make_spaces()
        used = make_simulator(simulator, self.task.vehicle, 1, simulator_options)
        self._environment = HostEnvironment(self.task, used, 1, ending="none")
        self._causes = causes(self.task.termination)
        self._reward = np.zeros(1)
        self._missing_reset: str | None = "before the first reset"  # why `step` has to be refused

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """The observation at a new start, and an empty info; a seed makes everything that follows reproducible.

        The options `position` [x, y, z] in metres and `yaw` in radians (0 where left out) replace the start drawn from
        the task's by this one, level and at rest.

        Raises:
            BadInput: an unknown option or an impossible start.
        """
        super().reset(seed=seed)
        refuse_unknown(options, "position", "yaw")
        starts, drawn = read_starts(options, 1), int(self.np_random.integers(2**32))
        if starts is None:
            episodes = draw_episodes(self.task, jax.random.key(drawn)[None])
            observation = self._environment.start(episodes, self._noise())[0]
        else:
            observation = start_at(self._environment, starts, self._noise())[0]
        self._reward, self._missing_reset = np.zeros(1), None
        self._pictures.follow(self._environment)
        return observation, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """The observation, reward, terminated, truncated and info of one control period (0.01 s).

        Raises:
            ResetNeeded: before the first reset, or after the end of an episode.
            InvalidAction: not four finite numbers.
        """
        if self._missing_reset:
            raise gymnasium.error.ResetNeeded(f"step() was called {self._missing_reset}. Call reset() first.")
        moved = self._environment.step(read_action(action, (4,))[None], self._noise())
        terminated, truncated = bool(moved.terminated[0]), bool(moved.truncated[0])
        self._reward = moved.reward
        self._pictures.follow(self._environment)
        if terminated or truncated:
            self._missing_reset = "after the end of an episode"
        terms = {name: float(reward[0]) for name, reward in moved.terms.items()}
        info = {"reward_terms": terms, "termination": self._causes[moved.cause[0]] if terminated else None}
        return self._environment.observation[0], float(self._reward[0]), terminated, truncated, info

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A picture [480, 480, 3] of the present state, or None without a render mode.

        Raises:
            ResetNeeded: before the first reset.
        """
        pictures = self._pictures.draw(self._environment, self._reward)
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Free the memory of the simulator."""
        self._environment.close()

    def _noise(self) -> np.ndarray:
        return self.np_random.standard_normal((NOISY, 1), dtype=np.float32)


class HoverVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many vehicles that are to hover, stepped by one compiled call.

    An environment that ends starts anew in the same step: the observation is then the new episode's, and `final_obs`
    and `final_info` of the infos hold the last ones of the old episode. Other modes are those of Gymnasium: with
    `NEXT_STEP` the step after the end begins the new episode, whatever the action; with `DISABLED` the caller resets
    those that ended.

    Args:
        num_envs: how many.
        task: as for `HoverEnv`, and so are `edits`, `simulator`, `simulator_options` and `render_mode`.
        edits: of the task.
        simulator: its name.
        simulator_options: of the simulator.
        render_mode: None, or "rgb_array".
        max_episode_steps: the time limit of an episode, if it is shorter than the task's horizon.
        autoreset_mode: an `AutoresetMode`, or its name: "SAME_STEP", "NEXT_STEP" or "DISABLED".

    Raises:
        BadInput: one of these is not allowed, or the simulator's package is not installed.
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
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    ) -> None:
        if num_envs < 1:
            raise BadInput(f"num_envs: {num_envs} is not allowed. Allowed: a whole number, 1 or more.")
        self.autoreset_mode = _read_mode(autoreset_mode)
        self.metadata = METADATA | {"autoreset_mode": self.autoreset_mode}
        self.task = read_task(task, edits, max_episode_steps)
        self.render_mode = render_mode
        self._pictures = Pictures(render_mode)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = make_spaces()
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        used = make_simulator(simulator, self.task.vehicle, num_envs, simulator_options)
        ending = "restart" if self.autoreset_mode is AutoresetMode.SAME_STEP else "none"
        self._environment = HostEnvironment(self.task, used, num_envs, ending)
        self._names = np.array([*causes(self.task.termination), None], dtype=object)  # the last, -1, is SAFE
        self._rewards = np.zeros(num_envs)
        self._waiting = np.zeros(num_envs, bool)  # ended, and not begun anew
        self._begun = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """The observations at new starts, and an empty info; a seed makes everything that follows reproducible.

        The option `reset_mask` is a boolean array of the environments to reset; all are reset where it is left out.
        `position` and `yaw` are as for `HoverEnv`, one start for all of them or one for each ([N, 3] and [N]).

        Raises:
            BadInput: an unknown option, a mask that is none, or an impossible start.
            ResetNeeded: a mask before the first reset.
        """
        super().reset(seed=seed)
        refuse_unknown(options, "reset_mask", "position", "yaw")
        mask, starts = read_mask(options, self.num_envs), read_starts(options, self.num_envs)
        if not self._begun and mask is not None:
            raise gymnasium.error.ResetNeeded("reset() with a mask was called before the first full reset.")
        goes_on = self._begun and seed is None  # with the random numbers of the environment
        observation = self._environment.reset(None if goes_on else int(self.np_random.integers(2**32)), mask)
        if starts is not None:
            observation = start_at(self._environment, starts, which=mask)
        self._begun = True
        chosen = np.ones(self.num_envs, bool) if mask is None else mask
        self._rewards, self._waiting = np.where(chosen, 0.0, self._rewards), self._waiting & ~chosen
        self._pictures.follow(self._environment)
        return observation, {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """The observations, rewards, terminations, truncations and infos of one control period (0.01 s).

        Raises:
            ResetNeeded: before the first reset, or with `DISABLED` for an environment that ended.
            InvalidAction: not four finite numbers for each environment.
        """
        if not self._begun:
            raise gymnasium.error.ResetNeeded("step() was called before the first reset. Call reset() first.")
        waiting = self._waiting
        if waiting.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            raise gymnasium.error.ResetNeeded(
                f"step() was called after the end of episode {int(np.flatnonzero(waiting)[0])}. Call "
                "reset(options={'reset_mask': terminated | truncated}) first."
            )
        moved = self._environment.step(read_action(actions, (self.num_envs, 4)))
        reward, terminated, truncated = moved.reward, moved.terminated, moved.truncated
        if waiting.any():  # with NEXT_STEP, this step begins their next episodes instead
            self._environment.reset(None, waiting)
            reward, terminated, truncated = np.where(waiting, 0.0, reward), terminated & ~waiting, truncated & ~waiting
        ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            infos, self._rewards = self._infos(moved, ~ended) | self._final(moved, ended), np.where(ended, 0.0, reward)
        else:
            infos, self._rewards, self._waiting = self._infos(moved, ~waiting), reward, ended
        self._pictures.follow(self._environment)
        return self._environment.observation, reward, terminated, truncated, infos

    def _final(self, moved: Transition, ended: np.ndarray) -> dict[str, Any]:
        """What the infos say of environments that ended and have begun anew."""
        if not ended.any():
            return {}
        final, last = np.full(self.num_envs, None, dtype=object), moved.final_observation
        for index in np.flatnonzero(ended):
            final[index] = last[index]
        return {
            "final_obs": final,
            "_final_obs": ended,
            "final_info": self._infos(moved, ended),
            "_final_info": ended.copy(),
        }

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture [480, 480, 3] of each environment, or None without a render mode.

        Raises:
            ResetNeeded: before the first reset.
        """
        return self._pictures.draw(self._environment, self._rewards)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the memory of the simulator."""
        self._environment.close()

    def _infos(self, moved: Transition, which: np.ndarray) -> dict[str, Any]:
        """The infos of the environments in a mask, in the form of Gymnasium: arrays, each with its mask `_name`."""
        if not which.any():
            return {}
        terms: dict[str, Any] = {}
        for name, reward in moved.terms.items():
            terms |= {name: np.where(which, reward, 0.0), f"_{name}": which.copy()}
        return {
            "reward_terms": terms,
            "_reward_terms": which.copy(),
            "termination": self._names[np.where(which, moved.cause, -1)],
            "_termination": which.copy(),
        }


def _read_mode(mode: object) -> AutoresetMode:
    """The mode itself, by its name, or by its value.

    Raises:
        BadInput: there is no such mode.
    """
    for known in AutoresetMode:
        if mode is known or mode in (known.name, known.value):
            return known
    allowed = ", ".join(known.name for known in AutoresetMode)
    raise BadInput(f"autoreset_mode: {mode!r} is not allowed. Allowed: {allowed}.")
