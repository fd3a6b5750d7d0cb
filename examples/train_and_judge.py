"""Train a policy for the baseline task, fly 100 trials and print the response table.

python examples/train_and_judge.py               about a minute
python examples/train_and_judge.py --updates 3   a few seconds; the policy then flies badly
"""

import argparse
from pathlib import Path

import flytune

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--updates", type=int, default=300, help="updates of the training")
parser.add_argument("--trials", type=int, default=100, help="trials of the evaluation")
options = parser.parse_args()

task = flytune.load_task("baseline", {"apg.updates": options.updates})
run = flytune.train(task, trainer="apg", seed=0)
print(f"reward per step: {run.metrics[0]['reward']:.3f} at first, {run.metrics[-1]['reward']:.3f} at the end")

flights = flytune.fly(run.policy, task, trials=options.trials, seed=1)
print(flytune.judge(flights))

flytune.save_policy(Path("policy.safetensors"), run.policy)
