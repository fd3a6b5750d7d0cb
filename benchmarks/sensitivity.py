"""Measure the effect of each parameter of a task on the response: the sensitivities that the tuner uses.

    python benchmarks/sensitivity.py --out sensitivity    # trains what is missing there, then writes the package's data
    python benchmarks/sensitivity.py --docs               # tables and drawing of the documentation from that data

One parameter of baseline-refined is changed at a time: five values, three seeds of episodes and noise. Every training
starts from the policy that ships, as those of the tuner do. (A training from new weights has not converged after 300
updates: the unchanged baseline then settles in 5.4 s instead of 3.0 s, and the differences would be those of the
convergence.) The unchanged task is trained once per seed and is part of the curve of every parameter. One process per
core.
"""

import argparse
import json
import multiprocessing
import os
import platform
import time
from importlib import metadata
from pathlib import Path

BASE = "baseline-refined"
TRIALS, DURATION, SEED = 100, 20.0, 2000  # of the evaluation
PARAMETERS = {
    "reward.survival.reward": (0.0, 0.02, 0.05, 0.1, 0.3),
    "reward.horizontal.wide": (0.125, 0.25, 0.5, 1.0, 4.0),
    "reward.horizontal.share": (0.2, 0.4, 0.6, 0.8, 0.95),
    "reward.horizontal.narrow": (5.0, 10.0, 20.0, 60.0, 150.0),
    "reward.vertical.sharpness": (1.0, 2.0, 4.0, 8.0, 16.0),
    "reward.velocity.weight": (0.025, 0.05, 0.1, 0.2, 0.4),
    "reward.velocity.sharpness": (0.25, 0.5, 1.0, 2.0, 4.0),
    "reward.attitude.weight": (0.04, 0.08, 0.15, 0.3, 0.6),
    "reward.smoothness.weight": (0.02, 0.05, 0.1, 0.3, 1.0),
    "termination.speed.bound": (0.3, 0.5, 0.8, 1.2, 2.0),
    "termination.body_rate.bound_deg_per_s": (115.0, 230.0, 530.0, 1000.0, 2000.0),
}
HERE = Path(__file__).parents[1]
DATA = HERE / "src" / "flytune" / "tuning" / "sensitivity.json"
DOCS = HERE / "docs" / "results" / "heuristics"


def jobs(seeds: int) -> list[tuple[str | None, float | None, int]]:
    """Every training: parameter, value, seed; the unchanged task once per seed."""
    from flytune.config.writing import plain
    from flytune.task.files import load_task
    from flytune.tuning.rules import number_at

    tables = plain(load_task(BASE))
    changed = [
        (parameter, value, seed)
        for parameter, values in PARAMETERS.items()
        for value in values
        for seed in range(seeds)
        if value != number_at(tables, parameter)
    ]
    return [(None, None, seed) for seed in range(seeds)] + changed


def file_of(folder: Path, job: tuple[str | None, float | None, int]) -> Path:
    """Where the judgement of a training is constraints_satisfied."""
    parameter, value, seed = job
    return folder / f"{parameter or 'baseline'}-{'' if value is None else f'{value:g}'}-s{seed}.json"


def measure_one(folder: Path, updates: int, job: tuple[str | None, float | None, int]) -> None:
    """Train one task and write its response to a file."""
    from flytune.config.files import write_json
    from flytune.control.policy import load_policy
    from flytune.errors import Diverged
    from flytune.evaluation.fly import fly
    from flytune.evaluation.judge import AXES, judge
    from flytune.runs.shipped import shipped_files
    from flytune.task.files import load_task
    from flytune.training.loop import train

    parameter, value, seed = job
    settings = {"apg.updates": updates, "apg.learning_rate": 0.002}
    task = load_task(BASE, settings | ({} if parameter is None else {parameter: value}))
    initial = load_policy(shipped_files(BASE)[0])
    began = time.monotonic()
    row = {"seed": seed, "settled": 0, "settling_time": None, "overshoot": None, "error": None}
    try:
        told = judge(
            fly(train(task, seed=seed, warm_start=initial).policy, task, trials=TRIALS, seed=SEED, duration=DURATION)
        ).to_dict()
        position, axes = told["position"], told["axes"]
        row |= {
            "settled": position["settled"],
            "settling_time": position["settling_time"]["median"],
            "overshoot": position["overshoot"]["median"],
            "error": position["steady_state_error"]["median"],
            "settling_time_axes": {axis: axes[axis]["settling_time"]["median"] for axis in AXES},
            "overshoot_axes": {axis: axes[axis]["overshoot"]["median"] for axis in AXES},
            "yaw_error": axes["yaw"]["steady_state_error"]["median"],
            "violations": told["violations"],
            "crashed": told["crashed"],
        }
    except Diverged as error:
        row["diverged"] = str(error)
    path = file_of(folder, job)
    write_json(path, row)
    print(
        f"{path.stem}: {row['settled']} settled, {row['settling_time']} s ({time.monotonic() - began:.0f} s)",
        flush=True,
    )


def measure(folder: Path, updates: int, seeds: int, workers: int) -> None:
    """Train what is missing, and collect all results."""
    folder.mkdir(parents=True, exist_ok=True)
    plan = folder / "plan.json"
    asked = {"trainer": "apg", "updates": updates, "base": BASE}
    if plan.exists() and json.loads(plan.read_text(encoding="utf-8")) != asked:
        raise SystemExit(f"{folder}: holds results of other trainings. Give another folder.")
    plan.write_text(json.dumps(asked), encoding="utf-8")
    missing = [(folder, updates, job) for job in jobs(seeds) if not file_of(folder, job).exists()]
    if missing:
        with multiprocessing.get_context("spawn").Pool(workers) as pool:
            pool.starmap(measure_one, missing, chunksize=1)

    from flytune.config.writing import plain
    from flytune.task.files import load_task
    from flytune.tuning.rules import number_at

    tables = plain(load_task(BASE))

    def rows(parameter: str, value: float, baseline: float) -> list[dict]:
        unchanged = value == baseline
        files = [file_of(folder, (None, None, s) if unchanged else (parameter, value, s)) for s in range(seeds)]
        return [json.loads(file.read_text(encoding="utf-8")) for file in files]

    told = {
        "schema": 1,
        "command": f"python benchmarks/sensitivity.py --seeds {seeds} --updates {updates}",
        **asked,
        "trials": TRIALS,
        "duration": DURATION,
        "seeds": list(range(seeds)),
        "versions": {name: metadata.version(name) for name in ("flytune", "jax")}
        | {"python": platform.python_version()},
        "parameters": {
            parameter: {
                "baseline": (baseline := number_at(tables, parameter)),
                "points": [{"value": value, "seeds": rows(parameter, value, baseline)} for value in values],
            }
            for parameter, values in PARAMETERS.items()
        },
    }
    DATA.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    print(DATA)


def document_it() -> None:
    """Write the tables and the drawing of the documentation from the measured data."""
    from heuristics import draw_sensitivities, heuristics_tables

    from flytune.tuning.sensitivity import load_sensitivities

    sensitivities = load_sensitivities()
    DOCS.mkdir(exist_ok=True)
    draw_sensitivities(DOCS / "sensitivity.svg", sensitivities)
    tables = "# The paper's heuristics: every number\n\n" + heuristics_tables(sensitivities)
    (DOCS / "tables.md").write_text(tables, encoding="utf-8")
    print(DOCS)


if __name__ == "__main__":
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("sensitivity"))
    parser.add_argument("--updates", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--docs", action="store_true", help="only write the tables and the drawing")
    options = parser.parse_args()
    document_it() if options.docs else measure(options.out, options.updates, options.seeds, options.workers)
