"""flytune: ask for a step response, get a trained quadrotor controller, and see how it flies.

    import flytune
    task = flytune.load_task("baseline")
    run = flytune.train(task, trainer="apg", seed=0)            # run.policy, run.metrics
    flights = flytune.fly(run.policy, task, trials=100, seed=1)
    print(flytune.judge(flights))

JAX is imported with the first name that needs it, not with the package.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flytune.control.classical import classical_controller
    from flytune.control.policy import Policy, load_policy, save_policy
    from flytune.errors import BadInput, Diverged, FlytuneError, Interrupted
    from flytune.evaluation.comparison import Comparison, compare
    from flytune.evaluation.flights import Flights
    from flytune.evaluation.fly import fly
    from flytune.evaluation.judge import Judgement, judge
    from flytune.export.onnx import save_onnx
    from flytune.export.untrusted.onnx_controller import load_onnx
    from flytune.physics.vehicle import Vehicle, load_vehicle
    from flytune.report.comparison import write_comparison
    from flytune.report.report import Entry, write_report
    from flytune.runs.find import find_controller
    from flytune.task.task import Task, load_task, write_task
    from flytune.training.loop import Run, train

_HOMES = {
    "BadInput": "flytune.errors",
    "Comparison": "flytune.evaluation.comparison",
    "Diverged": "flytune.errors",
    "Entry": "flytune.report.report",
    "Flights": "flytune.evaluation.flights",
    "FlytuneError": "flytune.errors",
    "Interrupted": "flytune.errors",
    "Judgement": "flytune.evaluation.judge",
    "Policy": "flytune.control.policy",
    "Run": "flytune.training.loop",
    "Task": "flytune.task.task",
    "Vehicle": "flytune.physics.vehicle",
    "classical_controller": "flytune.control.classical",
    "compare": "flytune.evaluation.comparison",
    "find_controller": "flytune.runs.find",
    "fly": "flytune.evaluation.fly",
    "judge": "flytune.evaluation.judge",
    "load_onnx": "flytune.export.untrusted.onnx_controller",
    "load_policy": "flytune.control.policy",
    "load_task": "flytune.task.task",
    "load_vehicle": "flytune.physics.vehicle",
    "save_onnx": "flytune.export.onnx",
    "save_policy": "flytune.control.policy",
    "train": "flytune.training.loop",
    "write_comparison": "flytune.report.comparison",
    "write_report": "flytune.report.report",
    "write_task": "flytune.task.task",
}

__all__ = [
    "BadInput",
    "Comparison",
    "Diverged",
    "Entry",
    "Flights",
    "FlytuneError",
    "Interrupted",
    "Judgement",
    "Policy",
    "Run",
    "Task",
    "Vehicle",
    "classical_controller",
    "compare",
    "find_controller",
    "fly",
    "judge",
    "load_onnx",
    "load_policy",
    "load_task",
    "load_vehicle",
    "save_onnx",
    "save_policy",
    "train",
    "write_comparison",
    "write_report",
    "write_task",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'flytune' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(_HOMES)
