"""Fly a policy that was trained in gym-pybullet-drones: its 12 numbers, its action range and its control rate.

gym-pybullet-drones gives a policy (kinematic observation, one drone) the row

    x y z [m], roll pitch yaw [rad], velocity (3) [m/s], angular velocity (3) [rad/s, inertial], last K actions (4 each)

and asks rotor i for hover speed * (1 + 0.05 action[i]). K is 0 in its first releases, later 10, then half the control
rate, which its training script sets to 30 Hz. Its rotors 0, 1, 2, 3 stand at (+x, -y), (-x, -y), (-x, +y), (+x, +y), as
flytune's do. Older releases have (+x, +y), (-x, +y), (-x, -y), (+x, -y) with the same spins, which is another vehicle:
for a model of those, write a vehicle with these places under `[rotors]`. It does not know flytune's target: its own is
(0, 0, 1) without a heading, and so is that of the baseline task.
Source: gym-pybullet-drones, envs/BaseRLAviary.py (_computeObs, _preprocessAction) and assets/cf2x.urdf.

python examples/gym_pybullet_drones.py                     with a controller written here for these 12 numbers
python examples/gym_pybullet_drones.py --model best_model.zip   with your own PPO model, which needs Stable-Baselines3
"""

import argparse
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import flytune

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--model", help="a PPO model of your own, trained there with ActionType.RPM")
parser.add_argument("--rate", type=float, default=30.0, help="control rate of its training, Hz")
parser.add_argument("--trials", type=int, default=100, help="trials of the evaluation")
options = parser.parse_args()
REACH = 0.05  # an action of 1 asks for 5 % more than the hover speed


def euler_and_matrix(attitude):
    """Roll, pitch and yaw [rad] of a quaternion (x, y, z, w), and its rotation matrix from body to inertial frame."""
    x, y, z, w = attitude / jnp.linalg.norm(attitude)
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1, 1))
    yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    matrix = jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return jnp.stack([roll, pitch, yaw]), matrix


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class GymPybulletDrones:
    """A policy of gym-pybullet-drones as a controller of flytune."""

    network: Any  # 12 + 4 K numbers -> 4 actions
    target: Any  # m
    action_scale: Any  # of the vehicle that flies
    period: float = dataclasses.field(metadata={"static": True})  # s, of its control
    actions: int = dataclasses.field(metadata={"static": True})  # K, how many of the last actions it sees

    def initial_memory(self):
        """The time until it decides next, its action, and the last actions it sees."""
        return jnp.zeros(()), jnp.zeros(4), jnp.zeros((self.actions, 4))

    def act(self, memory, observation):
        """The action of one observation; between two decisions, the last action is held."""
        wait, action, seen = memory
        angles, to_inertial = euler_and_matrix(observation[3:7])
        position, velocity = observation[:3] + self.target, observation[7:10]
        numbers = jnp.concatenate([position, angles, velocity, to_inertial @ observation[10:13], seen.reshape(-1)])
        decides = wait <= 1e-6
        decided = jnp.clip(self.network(numbers), -1, 1)
        action = jnp.where(decides, decided, action)
        seen = jnp.where(decides, jnp.concatenate([seen, decided[None]])[1:], seen) if self.actions else seen
        wait = jnp.where(decides, wait + self.period, wait) - 0.01
        return (wait, action, seen), action * REACH / self.action_scale


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Layers:
    """The actor of a PPO model with an MlpPolicy and tanh."""

    weights: Any
    biases: Any

    def __call__(self, numbers):
        """The mean action."""
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            numbers = jnp.tanh(weight @ numbers + bias)
        return self.weights[-1] @ numbers + self.biases[-1]


def load_model(path):
    """The actor of your own model; loading it runs what the file says, so do not load one that you do not trust."""
    from stable_baselines3 import PPO

    model = PPO.load(path, device="cpu")
    if model.policy.activation_fn.__name__ != "Tanh":
        raise SystemExit(f"{path}: has the activation {model.policy.activation_fn.__name__}. Allowed here: Tanh.")
    linear = [
        each for each in (*model.policy.mlp_extractor.policy_net, model.policy.action_net) if hasattr(each, "weight")
    ]
    return Layers(
        weights=[jnp.asarray(each.weight.detach().numpy()) for each in linear],
        biases=[jnp.asarray(each.bias.detach().numpy()) for each in linear],
    ), int(np.prod(model.observation_space.shape))


def written_here(numbers):
    """A cascade of proportional and derivative gains on the 12 numbers, in place of a network."""
    x, y, z, roll, pitch, yaw, vx, vy, vz, wx, wy, wz = numbers[:12]
    along = (-0.16 * x - 0.22 * vx, -0.16 * y - 0.22 * vy)  # wanted acceleration over gravity, inertial frame
    forward, left = (
        jnp.cos(yaw) * along[0] + jnp.sin(yaw) * along[1],
        jnp.cos(yaw) * along[1] - jnp.sin(yaw) * along[0],
    )
    rate_x, rate_y = jnp.cos(yaw) * wx + jnp.sin(yaw) * wy, jnp.cos(yaw) * wy - jnp.sin(yaw) * wx
    about_x = 1.0 * (jnp.clip(-left, -0.2, 0.2) - roll) - 0.2 * rate_x
    about_y = 1.0 * (jnp.clip(forward, -0.2, 0.2) - pitch) - 0.2 * rate_y
    about_z = jnp.clip(-0.3 * yaw - 0.4 * wz, -0.3, 0.3)
    thrust = jnp.clip(1.5 * (1.0 - z) - 2.0 * vz, -0.5, 0.5)
    side_x, side_y, spin = np.array([1, -1, -1, 1]), np.array([-1, -1, 1, 1]), np.array([-1, 1, -1, 1])
    return thrust + about_x * side_y - about_y * side_x + about_z * spin


task = flytune.load_task("baseline")
network, size = load_model(options.model) if options.model else (jax.tree_util.Partial(written_here), 12)
controller = GymPybulletDrones(
    network=network,
    target=jnp.asarray(task.target.position, float),
    action_scale=task.vehicle.action_scale,
    period=1 / options.rate,
    actions=(size - 12) // 4,
)
judgement = flytune.judge(flytune.fly(controller, task, trials=options.trials, name="gym-pybullet-drones"))
print(f"a policy of {size} numbers at {options.rate:g} Hz: {judgement.line()}")
