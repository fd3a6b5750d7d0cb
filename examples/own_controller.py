"""Write a controller of your own, fly it and judge it: here a policy far from the target, and an LQR near it.

A controller is a JAX pytree with two methods. `initial_memory()` returns what it knows before the first observation.
`act(memory, observation)` returns the memory after, and the action: four numbers in [-1, 1], one per motor.

python examples/own_controller.py
python examples/own_controller.py --trials 5   for a first look
"""

import argparse
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

import flytune

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--trials", type=int, default=100, help="trials of the evaluation")
options = parser.parse_args()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Switched:
    """One controller beyond `distance` from the target, another one within it."""

    far: Any
    near: Any
    distance: float  # m

    def initial_memory(self):
        """The memories of both controllers."""
        return self.far.initial_memory(), self.near.initial_memory()

    def act(self, memory, observation):
        """The action of one observation: position error 3, attitude error 4, velocity 3, body rate 3, last action 4."""
        far_memory, far_action = self.far.act(memory[0], observation)
        near_memory, near_action = self.near.act(memory[1], observation)
        is_near = jnp.linalg.norm(observation[:3]) < self.distance
        return (far_memory, near_memory), jnp.where(is_near, near_action, far_action)


task = flytune.load_task("baseline-refined")
policy = flytune.find_controller("baseline-refined")
controller = Switched(far=policy, near=flytune.classical_controller("lqr", task), distance=0.3)
print(flytune.judge(flytune.fly(controller, task, trials=options.trials, name="switched")))
