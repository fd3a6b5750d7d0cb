"""flytune: ask for a step response, get a trained quadrotor controller, and see how it flies.

    import flytune
    task = flytune.load_task("baseline")
    run = flytune.train(task, trainer="apg", seed=0)            # run.policy, run.metrics
    flights = flytune.fly(run.policy, task, trials=100, seed=1)
    print(flytune.judge(flights))

Each command of the command line is one call here:

- train: `train`; evaluate: `evaluate`, or `find_controller`, `fly` and `judge` one by one
- compare, report: `evaluate_all`, then `compare` of the judgements, and `write_report`
- tune, rules: `tune`, `load_rules`; reproduce: `reproduce`; bench: `bench`
- export: `export_policy`, or `save_onnx` and `save_policy`; show: `load_task`, `write_task`

JAX is imported with the first name that needs it, not with the package.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flytune.benchmark.throughput import Throughput as Throughput
    from flytune.benchmark.throughput import bench as bench
    from flytune.control.classical import classical_controller as classical_controller
    from flytune.control.policy import Policy as Policy
    from flytune.control.policy import load_policy as load_policy
    from flytune.control.policy import save_policy as save_policy
    from flytune.errors import BadInput as BadInput
    from flytune.errors import Diverged as Diverged
    from flytune.errors import FlytuneError as FlytuneError
    from flytune.errors import Interrupted as Interrupted
    from flytune.errors import Unmet as Unmet
    from flytune.evaluation.comparison import Comparison as Comparison
    from flytune.evaluation.comparison import compare as compare
    from flytune.evaluation.evaluate import Evaluation as Evaluation
    from flytune.evaluation.evaluate import evaluate as evaluate
    from flytune.evaluation.evaluate import evaluate_all as evaluate_all
    from flytune.evaluation.flights import Flights as Flights
    from flytune.evaluation.fly import fly as fly
    from flytune.evaluation.judge import Judgement as Judgement
    from flytune.evaluation.judge import judge as judge
    from flytune.export import export_policy as export_policy
    from flytune.export.onnx import save_onnx as save_onnx
    from flytune.export.untrusted.onnx_controller import load_onnx as load_onnx
    from flytune.physics.vehicle import Vehicle as Vehicle
    from flytune.physics.vehicle import load_vehicle as load_vehicle
    from flytune.report.report import write_report as write_report
    from flytune.reproduction.reproduction import Reproduction as Reproduction
    from flytune.reproduction.reproduction import reproduce as reproduce
    from flytune.runs.find import FoundController as FoundController
    from flytune.runs.find import find_controller as find_controller
    from flytune.task.task import Task as Task
    from flytune.task.task import load_task as load_task
    from flytune.task.task import write_task as write_task
    from flytune.training.loop import Run as Run
    from flytune.training.loop import train as train
    from flytune.tuning.result import Tuning as Tuning
    from flytune.tuning.rules import load_rules as load_rules
    from flytune.tuning.tune import tune as tune

    __version__: str

_MODULES = {
    "flytune.benchmark.throughput": ("Throughput", "bench"),
    "flytune.control.classical": ("classical_controller",),
    "flytune.control.policy": ("Policy", "load_policy", "save_policy"),
    "flytune.errors": ("BadInput", "Diverged", "FlytuneError", "Interrupted", "Unmet"),
    "flytune.evaluation.comparison": ("Comparison", "compare"),
    "flytune.evaluation.evaluate": ("Evaluation", "evaluate", "evaluate_all"),
    "flytune.evaluation.flights": ("Flights",),
    "flytune.evaluation.fly": ("fly",),
    "flytune.evaluation.judge": ("Judgement", "judge"),
    "flytune.export": ("export_policy",),
    "flytune.export.onnx": ("save_onnx",),
    "flytune.export.untrusted.onnx_controller": ("load_onnx",),
    "flytune.physics.vehicle": ("Vehicle", "load_vehicle"),
    "flytune.report.report": ("write_report",),
    "flytune.reproduction.reproduction": ("Reproduction", "reproduce"),
    "flytune.runs.find": ("FoundController", "find_controller"),
    "flytune.task.task": ("Task", "load_task", "write_task"),
    "flytune.training.loop": ("Run", "train"),
    "flytune.tuning.result": ("Tuning",),
    "flytune.tuning.rules": ("load_rules",),
    "flytune.tuning.tune": ("tune",),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}

__all__ = list(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("flytune")
    if name not in _HOMES:
        raise AttributeError(f"module 'flytune' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
