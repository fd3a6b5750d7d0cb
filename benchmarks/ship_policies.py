"""Put the best policy of each behaviour of finished studies into the package, with the run.json that proves it.

    flytune reproduce --refined --trainer apg --out refined-apg
    flytune reproduce --refined --trainer ppo --out refined-ppo
    python benchmarks/ship_policies.py refined-apg refined-ppo
    python benchmarks/ship_policies.py --run runs/dial-apg-s0

Of a study, the best seed has the most feasible trials settled on all axes; among equals, the smallest median
position error. The script flies the averaged policy, on trials that neither training nor `evaluate` uses.
"""

import argparse
import json
import shutil
from pathlib import Path

import numpy as np

from flytune.control.policy import load_policy
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import AXES, judge
from flytune.reproduction.study import BEHAVIOURS, Study
from flytune.runs.directory import read_facts
from flytune.runs.shipped import HOME

SEED = 1000  # of initial conditions and noise; evaluations use 1


def quality(directory: Path, study: Study, behaviour: str) -> tuple[int, float]:
    """The number of feasible trials settled on all axes, and minus the median position error; larger is better."""
    judgement = judge(fly(load_policy(directory / "policy.safetensors"), study.task(behaviour), trials=200, seed=SEED))
    settled = np.all([np.isfinite(judgement.settling_time[axis]) for axis in AXES], axis=0)
    return int(np.sum(settled & ~judgement.infeasible)), -float(np.median(judgement.steady_state_error["position"]))


def ship(folder: Path, commit: str | None) -> None:
    """Copy the best policies of one study; `commit` is that of its code, where it did not run from a checkout."""
    told = json.loads((folder / "verdicts.json").read_text(encoding="utf-8"))
    study = Study(folder=folder, **{name: told[name] for name in ("trainer", "steps", "refined", "seeds")})
    for behaviour in BEHAVIOURS:
        trainings = [training for training in study.trainings() if training.behaviour == behaviour]
        ranked = sorted(trainings, key=lambda training: quality(training.directory, study, behaviour), reverse=True)
        best = ranked[0]
        ship_run(best.directory, best.preset, study.trainer, best.seed, commit)
        print(f"{best.preset}@{study.trainer}: seed {best.seed}, {quality(best.directory, study, behaviour)}")


def ship_run(directory: Path, preset: str, trainer: str, seed: int, commit: str | None) -> None:
    """Copy the policy of one run."""
    stem, target = f"{preset}@{trainer}", Path(str(HOME))
    target.mkdir(exist_ok=True)
    shutil.copyfile(directory / "policy.safetensors", target / f"{stem}.safetensors")
    facts = read_facts(directory)
    # the command of a study names a task file; this command gives the same policy bit by bit
    facts["command"] = f"flytune train {preset} --trainer {trainer} --seed {seed}".split()
    facts["commit"] = facts["commit"] or commit
    (target / f"{stem}.json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("studies", nargs="*", type=Path)
    parser.add_argument("--run", type=Path, help="the run directory of one policy")
    parser.add_argument("--commit", help="of the code, where the studies did not run from a checkout")
    options = parser.parse_args()
    for study_folder in options.studies:
        ship(study_folder, options.commit)
    if options.run:
        run = read_facts(options.run)
        ship_run(options.run, run["task"], run["trainer"], run["seed"], options.commit)
