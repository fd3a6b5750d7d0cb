"""Tunes the classical controllers with Optuna and prints their gains as a TOML table; needs flytune[optuna].

    python benchmarks/tune_classical.py pid geometric lqr
    python benchmarks/tune_classical.py pid --trials 400 --write

Each trial flies one set of gains on the baseline task from the same 64 `clear` starts with the same noise, of a seed
that no evaluation uses. The cost is in seconds:

    cost = mean settling time of the position (an unsettled trial counts twice the duration)
         + 0.1 * the same of the yaw
         + 10 * share of trials that crossed a bound of the task
         + mean steady-state error / 0.01 m
         + mean change of the action per step and motor

and the mean of that over the vehicles. The first set tried is the textbook's; the others are drawn by the
tree-structured Parzen estimator, each gain on a logarithmic scale between a quarter and four times the textbook's.
"""

import os

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import argparse
import dataclasses
from pathlib import Path

import numpy as np
import tomlkit

import flytune
from flytune.config import document
from flytune.control.classical import CLASSICAL, AnyGains, controller_with, read_gains
from flytune.errors import FlytuneError, require
from flytune.task.task import Task

STARTS_SEED = 900_001  # evaluation uses 0 to 10
FLIGHTS = 64
FACTOR = 4.0
FIXED = ("largest_tilt", "integral_limit", "motor_time_constant")  # limits and vehicles, not responses
HIGHEST = {"bound_share": 1.0, "largest_yaw_error": 1.5}
LOWEST = {"bound_share": 0.7}


def cost(gains: AnyGains, tasks: list[Task]) -> float:
    """What a set of gains costs, in s; see the head of the file."""
    try:
        return float(np.mean([_cost(gains, task) for task in tasks]))
    except FlytuneError:  # no stabilising feedback, or an action that is not finite
        return 100.0


def _cost(gains: AnyGains, task: Task) -> float:
    judgement = flytune.judge(flytune.fly(controller_with(gains, task), task, trials=FLIGHTS, seed=STARTS_SEED))
    late = 2 * task.duration
    position, yaw = (np.minimum(judgement.settling_time[channel], late).mean() for channel in ("position", "yaw"))
    crossed = np.mean(np.logical_or.reduce(list(judgement.violated.values())))
    error = np.minimum(judgement.steady_state_error["position"], 1.0).mean()
    change = np.nan_to_num(judgement.action_total_variation, nan=1.0).mean()
    return position + 0.1 * yaw + 10 * crossed + error / 0.01 + change


def tune(name: str, trials: int, seed: int, tasks: list[Task]) -> tuple[dict[str, float], float, float]:
    """The best gains found, their cost, and the textbook's cost."""
    optuna = require("optuna", "optuna")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    textbook = read_gains(name)["textbook"]
    start = document.plain(textbook)
    free = {field: value for field, value in start.items() if field not in FIXED}

    def objective(trial) -> float:
        values = {
            field: trial.suggest_float(
                field, LOWEST.get(field, value / FACTOR), HIGHEST.get(field, value * FACTOR), log=True
            )
            for field, value in free.items()
        }
        return cost(dataclasses.replace(textbook, **values), tasks)

    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed, multivariate=True))
    study.enqueue_trial(free)
    study.optimize(objective, n_trials=trials)
    best = {field: float(f"{value:.3g}") for field, value in study.best_params.items()}
    return start | best, study.best_value, study.trials[0].value


def write(name: str, gains: dict[str, float], path: Path, source: str) -> None:
    """Put the tuned table into a gains file, everything else as it stands."""
    text = tomlkit.parse(path.read_text(encoding="utf-8"))
    for field, value in gains.items():
        text["tuned"][field] = value
    text["sources"]["tuned"] = source
    path.write_text(tomlkit.dumps(text), encoding="utf-8")


def main() -> None:
    """Tune what the command line names."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="+", choices=CLASSICAL)
    parser.add_argument("--trials", type=int, default=300, help="sets of gains to try per controller (default 300)")
    parser.add_argument("--seed", type=int, default=0, help="of the sampler (default 0)")
    parser.add_argument("--vehicles", default="crazyflie", help="flown by each trial, separated by commas")
    parser.add_argument("--write", action="store_true", help="write the gains into the package's files")
    given = parser.parse_args()
    tasks = [flytune.load_task("baseline", {"vehicle": vehicle}) for vehicle in given.vehicles.split(",")]
    folder = Path(__file__).parents[1] / "src" / "flytune" / "control" / "gains"
    for name in given.names:
        gains, best, before = tune(name, given.trials, given.seed, tasks)
        source = (
            f"Optuna {require('optuna', 'optuna').__version__}, TPE, seed {given.seed}, {given.trials} trials of "
            f"{FLIGHTS} flights of 10 s per vehicle ({given.vehicles}), baseline task, clear starts of seed "
            f"{STARTS_SEED}; cost {before:.2f} s -> {best:.2f} s, as defined in benchmarks/tune_classical.py; "
            f"python benchmarks/tune_classical.py {name} --trials {given.trials} --seed {given.seed} "
            f"--vehicles {given.vehicles} --write"
        )
        print(tomlkit.dumps({name: {"tuned": gains, "sources": {"tuned": source}}}))
        if given.write:
            write(name, gains, folder / f"{name}.toml", source)


if __name__ == "__main__":
    main()
