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

found = flytune.find_controller("baseline-refined")
flights = flytune.fly(found.controller, found.task, trials=options.trials, seed=1, name=found.name)
entry = flytune.Entry(
    name=found.name,
    task=found.task,
    flights=flights,
    judgement=flytune.judge(flights),
    metrics=found.metrics,  # the learning curve of a run directory; None for a policy file
    about=found.about,
)
flytune.write_report(Path("report.html"), [entry])
print("open report.html in a browser")

# the numbers behind the page, for a program of your own
flights.save(Path("flights.npz"))
print(entry.judgement.line())
