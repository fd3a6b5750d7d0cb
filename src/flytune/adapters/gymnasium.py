"""flytune/Hover-v0 for Gymnasium 1.x: one environment, and (`vector`) many of them over the batched core.

Out-of-range actions are clipped, as in the paper (R9). Misuse raises Gymnasium's own errors.
"""

from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from flytune.adapters import registration
from flytune.adapters.hover import (
    METADATA,
    TRAIL,
    make_spaces,
    read_action,
    read_render_mode,
    read_start,
    read_task,
    take_picture,
)
from flytune.adapters.vector import HoverVectorEnv
from flytune.errors import require
from flytune.physics.dynamics import hovering
from flytune.physics.rotation import from_euler
from flytune.simulation.host import HostEnvironment, draw_episodes, episodes_at
from flytune.simulation.simulator import state_numbers
from flytune.simulation.simulators import make_simulator
from flytune.task.observation import NOISY
from flytune.task.task import Task
from flytune.task.termination import causes

if TYPE_CHECKING:
    import gymnasium
else:
    gymnasium = require("gymnasium", "gymnasium")  # a missing one in one line

__all__ = ["HoverEnv", "HoverVectorEnv"]

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
        self.render_mode = read_render_mode(render_mode)
        self.observation_space, self.action_space = make_spaces()
        flown_in = make_simulator(simulator, self.task.vehicle, 1, simulator_options)
        self._environment = HostEnvironment(self.task, flown_in, 1, ending="none")
        self._causes = causes(self.task.termination)
        self._trail: deque[np.ndarray] = deque(maxlen=TRAIL)
        self._steps, self._reward = 0, 0.0
        self._state = "made"  # then "flying", then "ended"

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """The observation at a new start, and an empty info.

        Args:
            seed: makes everything that follows reproducible.
            options: `position` [x, y, z] in metres and `yaw` in radians (0 where left out) start there, level and at
                rest, instead of at a start drawn from the task's.

        Raises:
            BadInput: an unknown option or an impossible start.
        """
        super().reset(seed=seed)
        start, seed = read_start(options), int(self.np_random.integers(2**32))
        episodes = draw_episodes(self.task, jax.random.key(seed)[None]) if start is None else self._at(**start)
        observation = self._environment.start(episodes, self._noise())[0]
        self._steps, self._reward, self._state = 0, 0.0, "flying"
        self._trail.clear()
        self._trail.append(self._environment.states[0, :3])
        return observation, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """The observation, reward, terminated, truncated and info of one control period (0.01 s).

        Raises:
            ResetNeeded: before the first reset, or after the end of an episode.
            InvalidAction: not four finite numbers.
        """
        if self._state != "flying":
            when = "after the end of an episode" if self._state == "ended" else "before the first reset"
            raise gymnasium.error.ResetNeeded(f"step() was called {when}. Call reset() first.")
        moved = self._environment.step(read_action(action, (4,))[None], self._noise())
        terminated, truncated = bool(moved.terminated[0]), bool(moved.truncated[0])
        self._steps, self._reward = self._steps + 1, float(moved.reward[0])
        self._trail.append(self._environment.states[0, :3])
        if terminated or truncated:
            self._state = "ended"
        terms = {name: float(reward[0]) for name, reward in moved.terms.items()}
        info = {"reward_terms": terms, "termination": self._causes[moved.cause[0]] if terminated else None}
        return self._environment.observation[0], self._reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A picture [480, 480, 3] of the present state, or None without a render mode.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('render() needs render_mode="rgb_array", given to gymnasium.make.')
            return None
        if self._state == "made":
            raise gymnasium.error.ResetNeeded("render() was called before the first reset. Call reset() first.")
        return take_picture(self.task, self._environment.states[0], np.array(self._trail), self._steps, self._reward)

    def close(self) -> None:
        """Give the simulator's memory back."""
        self._environment.close()

    def _at(self, position: Any, yaw: float) -> Any:
        """The episode that begins level and at rest at a position in m and a yaw in rad."""
        about_z = from_euler(*map(jnp.float32, (0.0, 0.0, yaw)))
        states = state_numbers(hovering(self.task.vehicle, tuple(position), about_z))
        return episodes_at(self.task, states[:, None])

    def _noise(self) -> np.ndarray:
        return self.np_random.standard_normal((NOISY, 1), dtype=np.float32)
