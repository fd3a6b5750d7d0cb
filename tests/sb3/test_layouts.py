"""Models of another layout, by way of the example that translates it."""

import pytest

pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")

import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "gym_pybullet_drones.py"


@pytest.mark.parametrize(("numbers", "rate"), [(12, 240), (12 + 4 * 10, 30)])
def test_the_example_flies_a_model_with_the_spaces_of_gym_pybullet_drones(make_model, tmp_path, numbers, rate):
    room = type(make_model().get_env().envs[0].unwrapped)
    make_model(room(observations=(1, numbers), actions=(1, 4))).save(tmp_path / "best_model.zip")
    command = [sys.executable, EXAMPLE, "--model", "best_model.zip", "--rate", str(rate), "--trials", "2"]
    answer = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert answer.returncode == 0, answer.stderr
    assert f"a policy of {numbers} numbers at {rate} Hz: settled" in answer.stdout
