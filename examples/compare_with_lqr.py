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
# "baseline-refined" is also the name of a policy that ships with flytune
evaluations = flytune.evaluate_all(["baseline-refined", "lqr"], task, trials=options.trials, seed=1)
judgements = [evaluation.judgement for evaluation in evaluations]
comparison = flytune.compare(judgements)  # paired, trial by trial; the first one is the reference
print(comparison)

policy_times, lqr_times = (judgement.settling_time["position"] for judgement in judgements)  # s, one per trial
print(f"The LQR settles first in {(lqr_times < policy_times).sum()} of {options.trials} trials.")
