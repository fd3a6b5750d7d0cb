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
    from flytune.control.classical import classical_pilot
    from flytune.control.policy import Policy, load_policy, save_policy
    from flytune.errors import BadInput, Diverged, FlytuneError, Interrupted
    from flytune.export.onnx import save_onnx
    from flytune.export.onnx_pilot import load_onnx
    from flytune.learn.pilot import find_pilot
    from flytune.learn.run import Run, train
    from flytune.physics.vehicle import Vehicle, load_vehicle
    from flytune.response.compare import Comparison, compare
    from flytune.response.flights import Flights
    from flytune.response.fly import fly
    from flytune.response.judge import Judgement, judge
    from flytune.show.comparison import write_comparison
    from flytune.show.report import Entry, write_report
    from flytune.task.task import Task, load_task, write_task

_HOMES = {
    "BadInput": "flytune.errors",
    "Comparison": "flytune.response.compare",
    "Diverged": "flytune.errors",
    "Entry": "flytune.show.report",
    "Flights": "flytune.response.flights",
    "FlytuneError": "flytune.errors",
    "Interrupted": "flytune.errors",
    "Judgement": "flytune.response.judge",
    "Policy": "flytune.control.policy",
    "Run": "flytune.learn.run",
    "Task": "flytune.task.task",
    "Vehicle": "flytune.physics.vehicle",
    "classical_pilot": "flytune.control.classical",
    "compare": "flytune.response.compare",
    "find_pilot": "flytune.learn.pilot",
    "fly": "flytune.response.fly",
    "judge": "flytune.response.judge",
    "load_onnx": "flytune.export.onnx_pilot",
    "load_policy": "flytune.control.policy",
    "load_task": "flytune.task.task",
    "load_vehicle": "flytune.physics.vehicle",
    "save_onnx": "flytune.export.onnx",
    "save_policy": "flytune.control.policy",
    "train": "flytune.learn.run",
    "write_comparison": "flytune.show.comparison",
    "write_report": "flytune.show.report",
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
    "classical_pilot",
    "compare",
    "find_pilot",
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
