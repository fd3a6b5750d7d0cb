"""Every script in examples/ is run as a user runs it: a real process, in an empty folder, with a small size."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
SMALL = {
    "compare_with_lqr": ("--trials", "4"),
    "edit_a_task": ("--trials", "4"),
    "export_to_onnx": ("--observations", "10"),
    "gym_pybullet_drones": ("--trials", "4"),
    "gymnasium_loop": ("--steps", "60"),
    "other_simulator": ("--trials", "2"),
    "own_controller": ("--trials", "4"),
    "own_reward_term": ("--updates", "2", "--trials", "4"),
    "own_simulator": ("--trials", "4"),
    "train_and_judge": ("--updates", "2", "--trials", "4"),
    "tune_to_a_response": ("--settling-time", "3"),
    "turn_a_dial": ("--trials", "4"),
    "write_a_report": ("--trials", "4"),
}
NEEDS = {"export_to_onnx": "onnxruntime", "gymnasium_loop": "gymnasium", "other_simulator": "pybullet"}
SHOWS = {
    "compare_with_lqr": "The LQR settles first in 4 of 4 trials.",
    "edit_a_task": "termination.speed.bound: -1.0 is not allowed.",
    "export_to_onnx": "actions: (10, 4)",
    "gym_pybullet_drones": "12 numbers at 30 Hz: settled 4/4 x, 4/4 y, 4/4 z, 4/4 yaw",
    "gymnasium_loop": "0.5 s   distance to the target",
    "other_simulator": "largest distance between the flights",
    "own_controller": "switched on baseline-refined (crazyflie",
    "own_reward_term": "'vertical_speed': -",
    "own_simulator": "PushedSimulator: settled",
    "train_and_judge": "crashed",
    "tune_to_a_response": "\nmet\n",
    "turn_a_dial": "for a settling time of 4 s: dial at 0.5",
    "write_a_report": "open report.html in a browser",
}


EXTENDS = {"own_simulator"}  # it builds on flytune's own physics
SLOW = {"own_reward_term", "turn_a_dial", "train_and_judge"}  # they compile what nothing else does
FLOOR = {"tune_to_a_response"}


@pytest.mark.parametrize(
    "script",
    [
        pytest.param(
            path,
            id=path.stem,
            marks=[pytest.mark.slow] * (path.stem in SLOW) + [pytest.mark.floor] * (path.stem in FLOOR),
        )
        for path in EXAMPLES
    ],
)
def test_the_example_runs_and_shows_what_it_promises(script, tmp_path):
    if script.stem in NEEDS:
        pytest.importorskip(NEEDS[script.stem])
    command = [sys.executable, script, *SMALL[script.stem]]
    answer = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False)
    assert answer.returncode == 0, answer.stderr
    assert SHOWS[script.stem] in answer.stdout


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.stem)
def test_the_example_says_how_to_run_it_and_uses_the_public_interface_alone(script):
    text = script.read_text(encoding="utf-8")
    assert f"python examples/{script.name}" in text
    assert script.stem in EXTENDS or ("from flytune" not in text and "import flytune." not in text)
