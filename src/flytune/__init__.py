"""flytune: ask for a step response, get a trained quadrotor controller, and see how it flies.

    import flytune
    task = flytune.load_task("baseline")
    run = flytune.train(task, trainer="apg", seed=0)            # run.policy, run.metrics
    flights = flytune.fly(run.policy, task, trials=100, seed=1)
    print(flytune.judge(flights))

Each command of the command line is one call here:

- train: `train`; evaluate: `evaluate`, or `find_controller`, `fly` and `judge` one by one
- judge: `load_flights`, or `flights_from` arrays, then `judge`
- compare, report: `evaluate_all`, then `compare` of the judgements, and `write_report`
- tune, rules: `tune`, `load_rules`; reproduce: `reproduce`; bench: `bench`
- export: `export_policy`, or `save_onnx` and `save_policy`; list: `catalogue`; show: `load_task`, `write_task`

JAX is imported with the first name that needs it, not with the package.
"""

from functools import cache


@cache
def _interface():
    """How to get a public name, how to list them, and the names."""
    import lazy_loader

    return lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("flytune")
    if name == "__all__":
        return _interface()[2]
    from flytune.errors import check_installed

    check_installed()  # before the first name that is used imports a package which may be too old
    return _interface()[0](name)


def __dir__() -> list[str]:
    return [*_interface()[1](), "__version__"]
