"""Compare a learned policy with an LQR over the same trials: the same initial conditions, the same sensor noise.

python examples/compare_with_lqr.py
python examples/compare_with_lqr.py --trials 5   for a first look
"""

import argparse

import flytune

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--trials", type=int, default=100, help="trials of each controller")
options = parser.parse_args()

task = flytune.load_task("baseline-refined")
policy = flytune.find_controller("baseline-refined").controller  # a policy that ships with flytune
lqr = flytune.classical_controller("lqr", task)

judgements = [
    flytune.judge(flytune.fly(controller, task, trials=options.trials, seed=1, name=name))
    for name, controller in {"policy": policy, "lqr": lqr}.items()
]
comparison = flytune.compare(judgements)  # paired, trial by trial; the first one is the reference
print(comparison)

policy_times, lqr_times = (judgement.settling_time["position"] for judgement in judgements)  # s, one per trial
print(f"The LQR settles first in {(lqr_times < policy_times).sum()} of {options.trials} trials.")
