"""Compare the tuner with Optuna's TPE and random search, on the same requirements and with the same budget.

    python benchmarks/tuning.py --out tuning-benchmark           # about two hours on two cores; can be continued
    python benchmarks/tuning.py --out tuning-benchmark --docs    # the page of the documentation from the results there

Every method starts from the same known policy, uses the same training settings, may train twelve times, compares its
policies on the same training set, and is judged on the same validation sets. TPE and random search draw the fields that
the rules may edit from the ranges of the rules, on a logarithmic scale; each of their trainings starts from the known
policy. TPE minimises what the tuner minimises, the distance from the requirement on the training set. It is given the
result of the known policy first, and its first four draws are random. They leave the settings of the trainer as they
are; the tuner may train longer.

All methods share a cache of trainings (same task, first policy and seed). A training from the cache counts with its
seconds, as if it had been made again. One process per core; one JSON file per requirement, method and seed.
"""

import argparse
import hashlib
import json
import math
import multiprocessing
import os
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np

BUDGET = 12
SPEED = "termination.speed.bound"
# settling time [s], overshoot [%], error [m or deg], what else is asked, fixed fields
GRID: list[tuple[float, float, float, dict[str, Any], dict[str, float]]] = [
    *[(time, 5.0, 0.01, {}, {}) for time in (1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)],
    *[(time, 0.0, 0.01, {}, {}) for time in (2.0, 3.5, 7.0)],
    *[(time, 10.0, 0.005, {}, {}) for time in (1.5, 2.5, 5.0, 10.0)],
    (3.0, 2.0, 0.02, {}, {}),
    (2.0, 5.0, 0.001, {}, {}),
    (6.0, 0.0, 0.001, {}, {}),
    (2.0, 5.0, 0.01, {"at_most": True}, {}),
    (4.0, 1.0, 0.005, {"at_most": True}, {}),
    (5.0, 5.0, 0.01, {"percentile": 90.0}, {}),
    (2.0, 5.0, 0.01, {"axis": "z"}, {}),
    (1.0, 5.0, 1.0, {"axis": "yaw"}, {}),
    (3.5, 5.0, 0.01, {}, {SPEED: 0.8}),
    (5.0, 5.0, 0.01, {}, {SPEED: 0.8}),
    (6.0, 5.0, 0.01, {"at_most": True}, {SPEED: 0.5}),
    (5.0, 5.0, 0.01, {}, {SPEED: 0.45}),
    # impossible, has to be refused
    (1.5, 5.0, 0.01, {}, {SPEED: 0.8}),
    (5.0, 5.0, 0.01, {"at_most": True}, {SPEED: 0.2}),
    (0.3, 5.0, 0.01, {}, {}),
]


def title_of(index: int) -> str:
    """A requirement in words."""
    time, overshoot, error, more, fixed = GRID[index]
    axis = more.get("axis", "")
    wanted = f"{axis} {'at most ' if 'at_most' in more else ''}{time:g} s".strip()
    share = f" (percentile {more['percentile']:g})" if "percentile" in more else ""
    exact = f"{error:g} deg" if axis == "yaw" else f"{1e3 * error:g} mm"
    bound = "".join(f", speed bound {value:g} m/s" for value in fixed.values())
    return f"{wanted}{share}, {overshoot:g} %, {exact}{bound}"


def name_of(index: int) -> str:
    """A requirement in a file name."""
    return "".join(letter if letter.isalnum() or letter == "." else "-" for letter in title_of(index)).replace(
        "--", "-"
    )


def solve(folder: Path, index: int, method: str, seed: int) -> None:
    """Try one requirement with one method, and write the result to a file."""
    import jax

    from flytune.config.files import write_json
    from flytune.config.writing import plain
    from flytune.control.policy import Policy, load_policy
    from flytune.errors import BadInput
    from flytune.task.task import Task
    from flytune.tuning.asked import make_requirement
    from flytune.tuning.loop import Tuner
    from flytune.tuning.rules import load_rules

    class CachedTuner(Tuner):
        """A tuner that repeats no training."""

        spent = 0.0  # s in trainings made now

        def learn(self, task: Task, initial: Policy | None, folder: Path) -> tuple[Policy, float]:
            tables = {name: value for name, value in plain(task).items() if name not in ("name", "duration", "sources")}
            start = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(initial))
            told = json.dumps([tables, self.trainer, self.seed], sort_keys=True).encode()
            known = cache / hashlib.sha256(told + start).hexdigest()[:24]
            if known.exists():
                shutil.copytree(known, folder, dirs_exist_ok=True)
                run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
                return load_policy(folder / "policy.safetensors"), run["seconds"]
            policy, seconds = super().learn(task, initial, folder)
            self.spent += seconds
            part = known.with_name(f"{known.name}-{os.getpid()}")
            part.mkdir(parents=True)
            for name in ("policy.safetensors", "run.json"):
                shutil.copyfile(folder / name, part / name)
            if known.exists():  # the other process was faster
                shutil.rmtree(part)
            else:
                part.rename(known)
            return policy, seconds

    cache = folder / "cache"
    time_wanted, overshoot, error, more, fixed = GRID[index]
    requirement = make_requirement(time_wanted, overshoot, error, **more)
    work = folder / "work" / f"{name_of(index)}-{method}-{seed}"
    shutil.rmtree(work, ignore_errors=True)
    began, said = time.monotonic(), []
    row: dict[str, Any] = {"requirement": name_of(index), "method": method, "seed": seed}
    try:
        tuner = CachedTuner(
            requirement=requirement, rules=load_rules(), out=work, task=None, edits=fixed, seed=seed, trainer="apg",
            most_iterations=BUDGET, on_message=said.append, on_progress=None,
        )  # fmt: skip
    except BadInput as refusal:
        row |= {"refused": str(refusal), "seconds": round(time.monotonic() - began, 1)}
    else:
        met = tuner.run().met if method == "tuner" else search(tuner, method, seed)
        trainings = [each.seconds for each in tuner.history.iterations[1:]]
        elsewhere = time.monotonic() - began - tuner.spent
        row |= {"met": met, "trainings": len(trainings), "seconds": round(elsewhere + sum(trainings), 1), "said": said}
    shutil.rmtree(work, ignore_errors=True)
    path = folder / f"{name_of(index)}-{method}-{seed}.json"
    write_json(path, row)
    print(path.stem, row.get("met", "refused"), row.get("trainings", ""), f"{row['seconds']} s", flush=True)


def search(tuner: Any, method: str, seed: int) -> bool:
    """Whether Optuna meets the requirement within the budget, from the policy the tuner starts with."""
    import optuna

    from flytune.tuning.iteration import Iteration
    from flytune.tuning.rules import number_at

    optuna.logging.set_verbosity(optuna.logging.WARNING)

    def distance(iteration: Any) -> float:
        return tuner.target.distance(iteration.response)

    ranges = {
        rule.field: tuple(map(float, rule.range))
        for rule in tuner.rules
        if rule.field
        and rule.field not in tuner.edits
        and rule.field.split(".")[0] not in ("apg", "ppo")
        and number_at(tuner.tables, rule.field)
    }
    history = tuner.history
    tuner.begin()
    samplers = {
        "tpe": optuna.samplers.TPESampler(seed=seed, n_startup_trials=5),  # the known policy, and four draws
        "random": optuna.samplers.RandomSampler(seed),
    }
    study = optuna.create_study(sampler=samplers[method])
    study.add_trial(
        optuna.trial.create_trial(
            params={name: min(max(number_at(tuner.tables, name), low), high) for name, (low, high) in ranges.items()},
            distributions={
                name: optuna.distributions.FloatDistribution(low, high, log=True)
                for name, (low, high) in ranges.items()
            },
            value=distance(history.iterations[0]),
        )
    )
    while True:
        last = history.iterations[-1]
        if not tuner.target.misses(last.response) and not tuner.validate(last).misses:
            return True
        if len(history.iterations) > BUDGET:
            nearest = history.nearest(tuner.requirement, tuner.target)
            return not history.validated(nearest.number) and not tuner.validate(nearest).misses
        trial = study.ask()
        values = {name: trial.suggest_float(name, low, high, log=True) for name, (low, high) in ranges.items()}
        planned = Iteration(
            number=len(history.iterations), values=values, reasons=dict.fromkeys(values, method), parent=0
        )
        tuner.train(planned)
        study.tell(trial, distance(history.iterations[-1]))


def summary(folder: Path) -> str:
    """The results as Markdown: success and median per method, then every requirement."""
    from flytune.evaluation.statistics import bootstrap_interval, median
    from flytune.tables import Table

    rows = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*-*.json"))]
    methods = [method for method in ("tuner", "tpe", "random") if any(row["method"] == method for row in rows)]
    shared = set.intersection(*({row["requirement"] for row in rows if row["method"] == m} for m in methods))
    groups = [("tuner, all seeds", [row for row in rows if row["method"] == "tuner"])]
    first = [row for row in rows if row["seed"] == 0 and row["requirement"] in shared]
    groups += [(f"{method}, seed 0", [row for row in first if row["method"] == method]) for method in methods]
    hard = {row["requirement"] for row in rows if row["method"] == "tuner" and row.get("trainings")}
    groups += [
        (f"{title}, where the start does not meet it", [row for row in chosen if row["requirement"] in hard])
        for title, chosen in groups
    ]
    overall = []
    for title, chosen in groups:
        mine = [row for row in chosen if "refused" not in row]
        cells = []
        for name in ("trainings", "seconds"):
            asked = sorted({row["requirement"] for row in mine})
            needed = [
                [float(row[name]) if row["met"] else math.inf for row in mine if row["requirement"] == one]
                for one in asked
            ]
            low, high = bootstrap_interval(needed)  # over requirements, then over the seeds of each
            ends = (median(np.concatenate(needed)), low, high)
            told = ["never" if end is None else f"{end:.0f}" for end in ends]
            cells.append(f"{told[0]} [{told[1]} to {told[2]}]")
        overall.append((title, f"{sum(row['met'] for row in mine)} of {len(mine)}", *cells))
    single = []
    for index in range(len(GRID)):
        cells = []
        for method in methods:
            mine = [row for row in rows if row["method"] == method and row["requirement"] == name_of(index)]
            cells.append(
                ", ".join("refused" if "refused" in r else f"{r['trainings']}" if r["met"] else "-" for r in mine)
            )
        single.append((title_of(index), *cells))
    until = [f"{name} until met, median [95 % interval]" for name in ("trainings", "seconds")]
    parts = [
        "# The tuner beside two searches: every requirement",
        Table.plain(("", "met", *until), overall).markdown(),
        'Trainings of each seed; "-": not met with twelve.',
        Table.plain(("requirement", *methods), single).markdown(),
    ]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("tuning-benchmark"))
    parser.add_argument("--methods", nargs="+", choices=("tuner", "tpe", "random"), default=["tuner", "tpe", "random"])
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds of the tuner; the other methods have one")
    parser.add_argument("--requirements", type=int, nargs="+", default=range(len(GRID)), help="indices into GRID")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--docs", action="store_true", help="only write the page of the documentation")
    options = parser.parse_args()
    if options.docs:
        target = Path(__file__).parents[1] / "docs" / "results" / "tuning"
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
