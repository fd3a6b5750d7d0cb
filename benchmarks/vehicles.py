"""The baseline task on every vehicle that ships: one training each, without settings by hand, beside the classical
controllers. Prints a Markdown table.

    python benchmarks/vehicles.py [VEHICLE ...]
"""

import sys
import time

import flytune
from flytune.control.classical import CLASSICAL, classical_controller
from flytune.evaluation.judge import Judgement
from flytune.physics.vehicle import vehicle_names

TRIALS, SEED = 100, 1


def cells(judgement: Judgement) -> list[str]:
    """Settled trials on x, y, z and yaw, median settling time of the position, and its median error."""
    found = judgement.to_dict()
    settled = "/".join(str(found["axes"][axis]["settled"]) for axis in ("x", "y", "z", "yaw"))
    settling, error = (found["position"][name]["median"] for name in ("settling_time", "steady_state_error"))
    shown = "-" if error is None else f"{1000 * error:.1f} mm"
    return [settled, "-" if settling is None else f"{settling:.2f} s", shown]


def main() -> None:
    print("| vehicle | controller | settled x/y/z/yaw of 100 | settling | error | training |")
    print("|---|---|---|---|---|---|")
    for name in sys.argv[1:] or vehicle_names():
        task = flytune.load_task("baseline", {"vehicle": name})
        begun = time.monotonic()
        run = flytune.train(task, trainer="apg", seed=0)
        seconds = time.monotonic() - begun
        flown = {"policy": run.policy} | {each: classical_controller(each, task) for each in CLASSICAL}
        for who, controller in flown.items():
            row = cells(flytune.judge(flytune.fly(controller, task, trials=TRIALS, seed=SEED)))
            print("|", " | ".join([name, who, *row, f"{seconds:.0f} s" if who == "policy" else ""]), "|", flush=True)


if __name__ == "__main__":
    main()
