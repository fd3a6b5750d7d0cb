"""Edit a task in Python, save it as a file, and see what the edit does to the response.

python examples/edit_a_task.py
python examples/edit_a_task.py --trials 5   for a first look
"""

import argparse
from pathlib import Path

import flytune

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--trials", type=int, default=100, help="trials of each evaluation")
options = parser.parse_args()

slow = flytune.load_task("baseline", {"termination.speed.bound": 0.4})  # m/s
fast = flytune.load_task("baseline", {"termination.speed.bound": 1.6, "vehicle": "crazyflie-km794"})

# a task is a file: write it, edit it with a text editor, read it again
Path("slow.toml").write_text(flytune.write_task(slow), encoding="utf-8")
slow = flytune.load_task("slow.toml")

# the LQR reads the speed bound of the task, so no training is needed to see the effect
for task in (slow, fast):
    controller = flytune.classical_controller("lqr", task)
    judgement = flytune.judge(flytune.fly(controller, task, trials=options.trials, duration=15.0))
    position = judgement.to_dict()["position"]
    print(f"speed bound {task.speed_bound:.1f} m/s: settles in {position['settling_time']['median']:.2f} s (median)")

# a value that is not allowed is refused in one line
try:
    flytune.load_task("baseline", {"termination.speed.bound": -1.0})
except flytune.BadInput as error:
    print(error)
