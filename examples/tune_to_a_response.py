"""Ask for a settling time, and get a policy: flytune edits the task by rules and trains until the response is reached.

python examples/tune_to_a_response.py                      about a minute
python examples/tune_to_a_response.py --settling-time 3    a few seconds: a policy that ships already settles in 3 s
"""

import argparse

import flytune

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--settling-time", type=float, default=2.5, help="wanted settling time of the position, in s")
options = parser.parse_args()

# what physics forbids is refused before any training, with the numbers
try:
    flytune.tune(0.3, out="impossible")
except flytune.BadInput as error:
    print(error)

result = flytune.tune(
    options.settling_time,  # s, median of the trials, within 10 %
    overshoot=5.0,  # %, at most
    error=0.01,  # m, at most
    out="tuned",
    on_message=print,  # each edit of the task, its reason, and its effect
)
print("met" if result.met else f"not met: {result.why()}")

# the directory is a run directory of the best policy
print(flytune.evaluate("tuned", trials=20).judgement.line())
