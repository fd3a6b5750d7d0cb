"""Step flytune's environment through Gymnasium: one episode, flown by a policy that ships.

Needs `pip install "flytune[gymnasium]"`.

python examples/gymnasium_loop.py
python examples/gymnasium_loop.py --steps 100   for a first look
"""

import argparse

import gymnasium
import numpy as np

import flytune

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--steps", type=int, default=500, help="steps of 0.01 s")
options = parser.parse_args()

policy = flytune.find_controller("baseline-refined").controller
env = gymnasium.make("flytune.adapters.registration:flytune/Hover-v0", task="baseline-refined")
observation, info = env.reset(seed=0, options={"position": [0.8, -0.5, 1.4], "yaw": 1.0})  # m, rad

total = 0.0
for step in range(options.steps):
    observation, reward, terminated, truncated, info = env.step(np.asarray(policy(observation)))
    total += reward
    if step % 50 == 0:
        print(f"{step / 100:4.1f} s   distance to the target {np.linalg.norm(observation[:3]):.3f} m")
    if terminated or truncated:
        print("the episode ended:", info["termination"] or "the horizon of the task was reached")
        break
print(f"total reward {total:.1f}; the last step's terms: {info['reward_terms']}")
env.close()
