"""Believed and true: a controller acts as it was made to, and meets a vehicle that differs from what it was told."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import register_dataclass
from tests.command import flytune as command

import flytune
from flytune.errors import BadInput
from flytune.task.files import load_task
from flytune.task.initial_state import InitialState
from flytune.task.met import as_met

STILL = InitialState(lowest_position=(0, 0, 1), highest_position=(0, 0, 1), largest_tilt=0.0, largest_yaw=0.0)


@register_dataclass
@dataclasses.dataclass(frozen=True)
class Hover:
    """Always the action 0."""

    def initial_memory(self):
        return ()

    def act(self, memory, observation):
        return memory, jnp.zeros(4)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of few updates."""
    folder = tmp_path_factory.mktemp("met") / "run"
    flytune.train(load_task("baseline", {"apg.updates": 2, "apg.environments": 4}), out=folder)
    return folder


@pytest.mark.parametrize("simulator", ["flytune", "pybullet", "mujoco"])
def test_an_action_means_the_rotor_speed_of_the_vehicle_that_the_controller_was_told(simulator):
    if simulator != "flytune":
        pytest.importorskip(simulator, reason=f"needs flytune[{simulator}]")
    task = load_task("baseline")
    flights = flytune.fly(
        Hover(), task, trials=1, duration=1.0, initial_conditions=STILL, simulator=simulator,
        changes={"vehicle.mass": 0.0363},
    )  # fmt: skip
    np.testing.assert_allclose(flights.rotor_speed_rpm, task.vehicle.hover_rotor_speed_rpm, rtol=1e-6)
    # four rotors that carry 33 g under 36.3 g: it falls with g / 11
    fallen = 0.5 * 9.81 / 11
    assert flights.position[0, -1, 2] == pytest.approx(1 - fallen, rel=1e-2)
    assert flights.changes == {"vehicle.mass": 0.0363} and flights.vehicle == "crazyflie"


def test_a_rotor_turns_no_faster_than_the_true_one_can():
    task = load_task("baseline")
    limit = 1.1 * task.vehicle.hover_rotor_speed_rpm
    flights = flytune.fly(
        flytune.classical_controller("pid", task), task, trials=4, duration=2.0,
        changes={"vehicle.maximum_rotor_speed_rpm": limit},
    )  # fmt: skip
    assert flights.rotor_speed_rpm.max() == pytest.approx(limit, rel=1e-6)
    assert flights.action.max() > 0.205  # at 0.2 this is its limit


def test_the_same_mass_in_the_task_is_known_to_the_controller():
    told = load_task("baseline", {"vehicle.mass": 0.0363})
    judged = flytune.judge(flytune.fly(flytune.classical_controller("pid", told), told, trials=8))
    assert judged.settled("position") == 8
    task = load_task("baseline")
    pid = flytune.classical_controller("pid", task)
    met = flytune.judge(flytune.fly(pid, task, trials=8, changes={"vehicle.mass": 0.0363}))
    assert met.settled("position") == 0 and met.to_dict()["axes"]["z"]["steady_state_error"]["median"] > 0.05


def test_noise_is_met_likewise():
    task = load_task("baseline")
    assert as_met(task, {"noise.position": 0.05}).noise.position == 0.05
    assert as_met(task, {}) is task


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reward.position.weight": 1.0}, "set: reward.position.weight is not what a controller meets in flight. "),
        ({"vehicle.action_scale": 0.4}, "set: vehicle.action_scale says what an action of the controller means"),
        ({"vehicle.control_rate": 50}, "set: vehicle.control_rate says what an action"),
        ({"vehicle.mas": 0.04}, "vehicle.mas: no such field. Did you mean vehicle.mass"),
        ({"vehicle.mass": -1.0}, "vehicle.mass: -1.0 is not allowed"),
        ({"vehicle.mass": 0.09}, "vehicle.maximum_rotor_speed_rpm: "),
    ],
)  # fmt: skip
def test_what_cannot_be_met_is_refused(changes, message):
    with pytest.raises(BadInput) as caught:
        as_met(load_task("baseline"), changes)
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)


def test_the_command_says_what_was_met_and_leaves_the_evaluation_of_the_run(tmp_path, trained):
    told = command(
        "evaluate", "baseline-refined", "--trials", "2", "--set", "vehicle.mass=0.0363", "--json", cwd=tmp_path
    )
    found = json.loads(told.stdout)
    assert found["set"] == {"vehicle.mass": 0.0363} and found["conditions"] is None
    (tmp_path / "run").mkdir()
    for name in ("run.json", "task.toml", "policy.safetensors"):
        (tmp_path / "run" / name).write_bytes((trained / name).read_bytes())
    command("evaluate", "run", "--trials", "2", cwd=tmp_path)
    own = (tmp_path / "run" / "evaluation.json").read_bytes()
    text = command("evaluate", "run", "--trials", "2", "--set", "vehicle.mass=0.0363", cwd=tmp_path).stdout
    assert "met vehicle.mass=0.0363" in text
    assert (tmp_path / "run" / "evaluation.json").read_bytes() == own
    assert len(list((tmp_path / "run").glob("evaluation-*.json"))) == 1
