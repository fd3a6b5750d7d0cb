"""Write the report of a policy: one HTML page with its step response, its margins and its task.

python examples/write_a_report.py
python examples/write_a_report.py --trials 5   for a first look
"""

import argparse
from pathlib import Path

import flytune

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--trials", type=int, default=100, help="trials that the page shows")
options = parser.parse_args()

# a run directory, a policy file, a policy that ships, or a classical controller
evaluation = flytune.evaluate("baseline-refined", trials=options.trials, seed=1)
flytune.write_report(Path("report.html"), [evaluation])
print("open report.html in a browser")

# the numbers behind the page, for a program of your own
evaluation.flights.save(Path("flights.npz"))
print(evaluation.judgement.line())
