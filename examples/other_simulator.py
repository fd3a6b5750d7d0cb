"""Fly the same policy in flytune's own simulator and in another one, and print how far the flights are apart.

Needs `pip install "flytune[pybullet]"`, or `"flytune[mujoco]"` for `--simulator mujoco`.

python examples/other_simulator.py
python examples/other_simulator.py --simulator mujoco --trials 5   for a first look
"""

import argparse

import numpy as np

import flytune

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--simulator", choices=("pybullet", "mujoco"), default="pybullet", help="the other simulator")
parser.add_argument("--trials", type=int, default=20, help="trials in each simulator")
options = parser.parse_args()

task = flytune.load_task("baseline-refined")
policy = flytune.find_controller("baseline-refined")

here = flytune.fly(policy, task, trials=options.trials, duration=5.0)
there = flytune.fly(policy, task, trials=options.trials, duration=5.0, simulator=options.simulator)

distance = np.linalg.norm(here.position - there.position, axis=-1)  # m, [trials, samples]
print(f"largest distance between the flights: {1000 * distance.max():.1f} mm")
print(f"at the end: {1000 * distance[:, -1].max():.1f} mm")
for flights in (here, there):
    print(flytune.judge(flights).line())
