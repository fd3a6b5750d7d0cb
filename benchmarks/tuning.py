"""Is the heuristic any good? The tuner, Optuna's TPE and random search on the same requirements, with the same budget.

    python benchmarks/tuning.py --out tuning-benchmark --methods tuner tpe random --seeds 3
    python benchmarks/tuning.py --out tuning-benchmark --docs    # docs/tuning/benchmark.md from what is there

Every method begins with the same known policy, trains with the same settings, may train twelve times, looks at the
same 100 starts, and is judged on the same 200 fresh ones. TPE and random search draw the fields the rules may edit from
the rules' ranges, in logarithms, each training going on from the known policy; TPE minimises the distance from the
requirement, after four random draws.
A task that was trained once from the same policy with the same seed is not trained again. One process per core;
what is done is kept, one JSON per requirement, method and seed.
"""

import argparse
import dataclasses
import hashlib
import json
import multiprocessing
import os
import shutil
import time
from pathlib import Path
from typing import Any

BUDGET = 12
SPEED = "termination.speed.bound"
# settling time [s], overshoot [%], error [m], at most, fixed fields
GRID = [
    *[(time, 5.0, 0.01, False, {}) for time in (1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)],
    *[(time, 0.0, 0.01, False, {}) for time in (2.0, 3.5, 7.0)],
    *[(time, 10.0, 0.005, False, {}) for time in (1.5, 2.5, 5.0, 10.0)],
    (3.0, 2.0, 0.02, False, {}),
    (2.0, 5.0, 0.01, True, {}),
    (4.0, 1.0, 0.005, True, {}),
    (3.5, 5.0, 0.01, False, {SPEED: 0.8}),
    (5.0, 5.0, 0.01, False, {SPEED: 0.8}),
    (6.0, 5.0, 0.01, True, {SPEED: 0.5}),
    (5.0, 5.0, 0.01, False, {SPEED: 0.45}),
    # impossible: to be refused
    (1.5, 5.0, 0.01, False, {SPEED: 0.8}),
    (5.0, 5.0, 0.01, True, {SPEED: 0.2}),
    (0.3, 5.0, 0.01, False, {}),
]


def name_of(index: int) -> str:
    """A requirement in a file name."""
    time, overshoot, error, at_most, fixed = GRID[index]
    bound = "".join(f"-v{value:g}" for value in fixed.values())
    return f"{'le' if at_most else 't'}{time:g}-o{overshoot:g}-e{1e3 * error:g}{bound}"


def requirement_of(index: int) -> tuple[Any, dict[str, float]]:
    """A requirement and the fields that are fixed with it."""
    from flytune.tune.requirement import make_requirement

    time, overshoot, error, at_most, fixed = GRID[index]
    return make_requirement(time, overshoot, error, at_most=at_most), dict(fixed)


def solve(folder: Path, index: int, method: str, seed: int) -> None:
    """One requirement by one method, written down."""
    from flytune.errors import BadInput
    from flytune.tune.rules import load_rules
    from flytune.tune.search import tune

    requirement, fixed = requirement_of(index)
    work = folder / "work" / f"{name_of(index)}-{method}-{seed}"
    shutil.rmtree(work, ignore_errors=True)
    began, said = time.monotonic(), []
    row: dict[str, Any] = {"requirement": name_of(index), "method": method, "seed": seed}
    try:
        if method == "tuner":
            result = tune(requirement, load_rules(), work, edits=fixed, seed=seed, most_steps=BUDGET, tell=said.append)
            row |= {"met": result.met, "trainings": sum(step.edit is not None for step in result.steps)}
            row |= {"blocked": result.blocked, "last": said[-2]}
        else:
            row |= search(requirement, fixed, method, seed, work, folder / "cache")
    except BadInput as error:
        row |= {"refused": str(error)}
    row["seconds"] = round(time.monotonic() - began, 1)
    shutil.rmtree(work, ignore_errors=True)
    path = folder / f"{name_of(index)}-{method}-{seed}.json"
    whole = path.with_suffix(".part")
    whole.write_text(json.dumps(row), encoding="utf-8")
    whole.replace(path)
    print(json.dumps(row), flush=True)


def search(requirement: Any, fixed: dict, method: str, seed: int, work: Path, cache: Path) -> dict[str, Any]:
    """Optuna over the fields of the rules, from the policy the tuner begins with, until met or out of budget."""
    import optuna

    from flytune.task.task import write_task
    from flytune.tune.requirement import MARGIN, Measured
    from flytune.tune.rules import field_of, load_rules
    from flytune.tune.search import Tuner

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    tuner = Tuner(
        requirement, load_rules(), work, task=None, edits=fixed, seed=seed, trainer="apg", most_steps=BUDGET,
        tell=lambda line: None, on_progress=None,
    )  # fmt: skip
    ranges = {
        rule.field: tuple(map(float, rule.range))
        for rule in tuner.rules
        if rule.field
        and rule.field not in fixed
        and not rule.field.startswith("apg.")
        and field_of(tuner.tables, rule.field)
    }
    tuner._begin()
    if not requirement.misses(tuner.steps[0].measured, MARGIN) and not tuner._verdict(tuner.steps[0]).misses:
        return {"met": True, "trainings": 0}
    samplers = {
        "tpe": optuna.samplers.TPESampler(seed=seed, n_startup_trials=4),
        "random": optuna.samplers.RandomSampler(seed),
    }
    study = optuna.create_study(sampler=samplers[method])
    study.add_trial(
        optuna.trial.create_trial(
            params={name: min(max(field_of(tuner.tables, name), low), high) for name, (low, high) in ranges.items()},
            distributions={
                name: optuna.distributions.FloatDistribution(low, high, log=True)
                for name, (low, high) in ranges.items()
            },
            value=requirement.distance(tuner.steps[0].measured),
        )
    )
    for number in range(1, BUDGET + 1):
        trial = study.ask()
        values = {name: trial.suggest_float(name, low, high, log=True) for name, (low, high) in ranges.items()}
        reasons = dict.fromkeys(values, method)
        text = write_task(dataclasses.replace(tuner.task_of(values, reasons), name="")).replace(method, "")
        key = hashlib.sha256(f"{tuner.start} {seed} {tuner.duration} {text}".encode()).hexdigest()[:24]
        known = cache / key
        if (known / "measured.json").exists():
            measured = Measured.from_dict(json.loads((known / "measured.json").read_text(encoding="utf-8")))
            step = dataclasses.replace(tuner.steps[0], number=number, values=values, reasons=reasons, measured=measured)
            shutil.copytree(known, work / "steps" / f"{number:02d}")
            tuner.steps.append(step)
        else:
            tuner._train(number, values, reasons, None, 0)
            step = tuner.steps[-1]
            known.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(work / "steps" / f"{number:02d}" / "policy.safetensors", known / "policy.safetensors")
            (known / "measured.json").write_text(json.dumps(step.measured.to_dict()), encoding="utf-8")
        study.tell(trial, requirement.distance(step.measured))
        if not requirement.misses(step.measured, MARGIN) and not tuner._verdict(step).misses:
            return {"met": True, "trainings": number}
    return {"met": False, "trainings": BUDGET}


def summary(folder: Path) -> str:
    """The results as Markdown: success and median per method, then every requirement."""
    from flytune.response.statistics import bootstrap_interval

    rows = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*-*.json"))]
    methods = [method for method in ("tuner", "tpe", "random") if any(row["method"] == method for row in rows)]
    tried = [{row["requirement"] for row in rows if row["method"] == method} for method in methods]
    shared = set.intersection(*tried)
    groups = [("tuner, all seeds", [row for row in rows if row["method"] == "tuner"])]
    first = [row for row in rows if row["seed"] == 0 and row["requirement"] in shared]
    groups += [(f"{method}, seed 0", [row for row in first if row["method"] == method]) for method in methods]
    lines = ["| | met | trainings until met, median [95 % interval] | seconds, median |", "|---|---|---|---|"]
    for title, chosen in groups:
        mine = [row for row in chosen if "refused" not in row]
        needed = [float(row["trainings"]) if row["met"] else float("inf") for row in mine]
        seconds = sorted(row["seconds"] for row in mine)
        low, high = bootstrap_interval([needed])
        middle = sorted(needed)[(len(needed) - 1) // 2]
        told = " to ".join("never" if end is None else f"{end:g}" for end in (low, high))
        median = f"{middle:g}" if middle < float("inf") else "never"
        lines.append(
            f"| {title} | {sum(row['met'] for row in mine)} of {len(mine)} | {median} [{told}] | "
            f"{seconds[len(seconds) // 2]:.0f} |"
        )
    lines += ["", f"| requirement | {' | '.join(methods)} |", f"|---|{'---|' * len(methods)}"]
    for index in range(len(GRID)):
        cells = []
        for method in methods:
            mine = [row for row in rows if row["method"] == method and row["requirement"] == name_of(index)]
            cells.append(
                ", ".join("refused" if "refused" in r else f"{r['trainings']}" if r["met"] else "not met" for r in mine)
            )
        time, overshoot, error, at_most, fixed = GRID[index]
        bound = "".join(f", at most {value:g} m/s" for value in fixed.values())
        said = f"{'at most ' if at_most else ''}{time:g} s, {overshoot:g} %, {1e3 * error:g} mm{bound}"
        lines.append(f"| {said} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("tuning-benchmark"))
    parser.add_argument("--methods", nargs="+", choices=("tuner", "tpe", "random"), default=["tuner", "tpe", "random"])
    parser.add_argument("--seeds", type=int, default=3, help="of the tuner; the others have one")
    parser.add_argument("--requirements", type=int, nargs="+", default=range(len(GRID)), help="their places in GRID")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--docs", action="store_true", help="write docs/tuning/benchmark.md; tunes nothing")
    options = parser.parse_args()
    if options.docs:
        target = Path(__file__).parents[1] / "docs" / "tuning"
        target.mkdir(exist_ok=True)
        (target / "benchmark.md").write_text(summary(options.out), encoding="utf-8")
    else:
        options.out.mkdir(parents=True, exist_ok=True)
        missing = [
            (options.out, index, method, seed)
            for index in options.requirements
            for method in options.methods
            for seed in range(options.seeds if method == "tuner" else 1)
            if not (options.out / f"{name_of(index)}-{method}-{seed}.json").exists()
        ]
        with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
            pool.starmap(solve, missing, chunksize=1)
        print(summary(options.out))
