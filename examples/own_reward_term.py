"""Add a reward term of your own to a task, and train with it: here a penalty on climbing and sinking.

A term is a JAX pytree that can be called with a situation (position error, velocity, ... of one vehicle) and returns
the reward of one step. To use it in task files too, add it to the package: see "To add a reward term" in
CONTRIBUTING.md.

python examples/own_reward_term.py               about a minute
python examples/own_reward_term.py --updates 3   a few seconds; the policy then flies badly
"""

import argparse
import dataclasses

import jax

import flytune

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--updates", type=int, default=300, help="updates of the training")
parser.add_argument("--trials", type=int, default=100, help="trials of the evaluation")
options = parser.parse_args()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class VerticalSpeed:
    """Penalty on the vertical speed: -weight * v_z^2."""

    weight: float  # s^2/m^2, 0 or more

    def __call__(self, situation):
        """The reward of one step, at most zero."""
        return -self.weight * situation.velocity[2] ** 2


task = flytune.load_task("baseline", {"apg.updates": options.updates})
task = dataclasses.replace(task, reward={**task.reward, "vertical_speed": VerticalSpeed(weight=0.2)})

run = flytune.train(task)
print("reward per step of each term in the last update:", run.metrics[-1]["terms"])
print(flytune.judge(flytune.fly(run.policy, task, trials=options.trials)))
