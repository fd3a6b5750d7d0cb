"""The Python interface: every public name is there, typed, lazy, and prints on a line."""

import ast
import subprocess
import sys
from importlib import metadata, resources
from pathlib import Path

import pytest

import flytune

STUB = Path(flytune.__file__).with_suffix(".pyi").read_text(encoding="utf-8")


def test_every_name_of_the_stub_is_public_and_a_type_checker_sees_it_too():
    imports = [node for node in ast.parse(STUB).body if isinstance(node, ast.ImportFrom)]
    names = [name for node in imports for name in node.names]
    assert all(name.asname == name.name for name in names)  # else it is not re-exported
    assert sorted(name.name for name in names) == sorted(flytune.__all__)
    assert {*flytune.__all__, "__version__"} <= set(dir(flytune))


def test_every_public_name_is_documented():
    assert [name for name in flytune.__all__ if not getattr(flytune, name).__doc__] == []


def test_a_name_that_does_not_exist_is_refused_as_python_does():
    with pytest.raises(AttributeError, match="No flytune attribute tuna"):
        _ = flytune.tuna


def test_the_package_tells_its_version_and_that_it_is_typed():
    assert flytune.__version__ == metadata.version("flytune")
    assert resources.files("flytune").joinpath("py.typed").is_file()


def test_jax_is_imported_with_the_first_name_that_needs_it():
    code = (
        "import sys, flytune\n"
        "flytune.__version__, flytune.BadInput, flytune.__all__, dir(flytune)\n"
        "assert not {'jax', 'numpy'} & set(sys.modules), 'imported too early'\n"
        "flytune.load_task\n"
        "assert 'jax' in sys.modules\n"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr


@pytest.fixture(scope="module")
def evaluation():
    return flytune.evaluate("baseline-refined", trials=3, duration=1.0)


def test_a_found_controller_flies_as_the_policy_in_it(evaluation):
    found = flytune.find_controller("baseline-refined")
    for controller in (found, found.controller):
        flights = flytune.fly(controller, found.task, trials=3, duration=1.0)
        assert (flights.position == evaluation.flights.position).all()
        assert flytune.judge(flights).settling_time["x"].tolist() == evaluation.judgement.settling_time["x"].tolist()


def test_a_controller_of_any_kind_is_evaluated_for_the_task_that_is_named():
    pid = flytune.classical_controller("pid", flytune.load_task("acrobatic"))
    mine, named = (flytune.evaluate(one, "acrobatic", trials=2, duration=1.0) for one in (pid, "pid"))
    assert (mine.flights.position == named.flights.position).all()
    assert (mine.task.name, mine.name, named.name) == ("acrobatic", "", "pid")
    assert flytune.evaluate(pid, trials=1, duration=1.0, name="mine").flights.name == "mine"


def test_several_controllers_are_found_before_the_first_one_flies():
    with pytest.raises(flytune.BadInput, match="nobody: no such controller"):
        flytune.evaluate_all(["pid", "nobody"], trials=10**5)
    pid, lqr = flytune.evaluate_all(["pid", "lqr"], trials=2, duration=1.0)
    assert flytune.compare([pid.judgement, lqr.judgement]).names == ("pid", "lqr")


def test_what_is_printed_in_a_session_fits_on_a_line(evaluation):
    found = flytune.find_controller("baseline-refined")
    run = flytune.Run(
        task=found.task, trainer="apg", seed=0, policy=found.controller, last_policy=found.controller,
        metrics=[{"steps": 1}] * 500, directory=None,
    )  # fmt: skip
    shown = [repr(thing) for thing in (found, found.controller, found.task, found.task.vehicle, run, evaluation,
                                       evaluation.flights, evaluation.judgement)]  # fmt: skip
    assert [text for text in shown if len(text) > 200 or "\n" in text] == []
    assert "Policy(17-64-64-4, tanh, baseline-refined on crazyflie)" in shown
    assert "Run(baseline-refined, apg, seed 0, 500 updates)" in shown
    assert str(evaluation) == str(evaluation.judgement) == evaluation.judgement.table()
