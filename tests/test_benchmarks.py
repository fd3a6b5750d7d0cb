"""The search that tuned the gains of the classical controllers, as its documentation says to run it."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "tune_classical.py"


@pytest.mark.floor
def test_the_search_with_optuna_prints_gains_that_cost_no_more_than_the_textbook_s(tmp_path):
    pytest.importorskip("optuna", reason="needs flytune[optuna]")
    command = [sys.executable, SCRIPT, "pid", "--trials", "2"]
    answer = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    found = tomllib.loads(answer.stdout)["pid"]
    assert found["tuned"]
    ((before, after),) = re.findall(r"cost ([\d.]+) s -> ([\d.]+) s", found["sources"]["tuned"])
    assert float(after) <= float(before)
