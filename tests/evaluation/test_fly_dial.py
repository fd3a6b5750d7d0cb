"""Flights with a dial: the bound that follows it, turned in flight, in every simulator, in exports."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune import evaluate, export_policy, find_controller, fly, judge, load_task
from flytune.cli.main import main
from flytune.control.schedule import with_schedule
from flytune.errors import BadInput
from flytune.evaluation.measure_map import measure_map
from flytune.runs.find import split_setting

FAMILY = load_task("dial")
POLICY = find_controller("dial").controller
TRIALS = 20


def test_the_bound_of_a_flight_is_that_of_the_setting():
    for speed in (0.3, 1.0):
        flights = fly(POLICY.at(speed=speed), FAMILY, trials=TRIALS)
        assert flights.speed_bound == pytest.approx(speed)
        velocity = np.linalg.norm(flights.velocity, axis=-1)
        np.testing.assert_allclose(flights.margins["speed"], 1 - velocity / speed, atol=1e-5)
    # a controller without a dial flies the default
    assert fly(find_controller("pid", FAMILY), FAMILY, trials=2, duration=1.0).speed_bound == pytest.approx(0.8)


@pytest.mark.slow
@pytest.mark.parametrize("to", [0.2, 1.6])
@pytest.mark.parametrize("at", [0.05, 0.5, 1.5, 6.0])
def test_the_dial_may_be_turned_at_every_phase_of_a_flight(at, to):
    start = 1.8 - to
    flights = fly(with_schedule(POLICY, {"speed": [[0, start], [at, to]]}), FAMILY, trials=TRIALS, duration=at + 8.0)
    judged = judge(flights)
    assert judged.crashed.sum() == 0
    speed = np.linalg.norm(flights.velocity, axis=-1)
    assert speed[:, round(100 * (at + 2.0)) :].max() <= to  # 2 s after the turn, the bound of the new setting is kept
    jump = np.abs(np.diff(flights.action, axis=1)).max(axis=-1)
    # the turn itself changes no action more than flying does
    assert jump[:, round(100 * at)].max() <= max(0.2, jump[:, 5:].max())


def test_a_turn_moves_the_dial_no_faster_than_its_sweep_time():
    sweep_time = float(FAMILY.dial["speed"].sweep_time)
    turned = with_schedule(POLICY, {"speed": [[0, 0.2], [1.0, 1.6]]})
    values = turned.settings(500)["speed"]
    assert values[:100] == pytest.approx(0.2)
    shares = np.log(values / 0.2) / np.log(1.6 / 0.2)
    assert np.diff(shares).max() == pytest.approx(0.01 / sweep_time, rel=1e-3)
    assert values[round(100 * (1.0 + sweep_time)) + 1] == pytest.approx(1.6)
    # the margins of a flight are those of the setting at which the dial stands at each sample
    flights = fly(turned, FAMILY, trials=2, duration=4.0)
    velocity = np.linalg.norm(flights.velocity, axis=-1)
    np.testing.assert_allclose(flights.margins["speed"], 1 - velocity / values[:401], atol=1e-4)
    assert flights.speed_bound == pytest.approx(1.6)


@pytest.mark.slow
def test_a_schedule_flies_the_same_in_another_simulator():
    pytest.importorskip("mujoco")
    schedule = {"speed": [[0, 0.4], [2.0, 1.2]]}
    here, there = (
        evaluate("dial", dial=schedule, simulator=simulator, trials=5, duration=6.0).flights
        for simulator in ("flytune", "mujoco")
    )
    assert np.abs(here.position - there.position).max() < 0.05


@pytest.mark.slow
def test_a_schedule_flies_the_same_from_an_onnx_file(tmp_path):
    pytest.importorskip("onnxruntime")
    path = export_policy(POLICY, tmp_path / "dial.onnx")
    schedule = {"speed": [[0, 0.4], [2.0, 1.2]]}
    here, there = (
        evaluate(name, FAMILY, dial=schedule, trials=5, duration=5.0).flights for name in ("dial", str(path))
    )
    assert np.abs(here.position - there.position).max() < 1e-3
    fixed = export_policy(POLICY.at(speed=0.4).fixed(), tmp_path / "fixed.onnx")
    again = evaluate(str(fixed), FAMILY.at({"speed": 0.4}), trials=5, duration=5.0).flights
    same = evaluate("dial@speed=0.4", trials=5, duration=5.0).flights
    assert np.abs(again.position - same.position).max() < 1e-3


def test_a_controller_without_a_dial_refuses_a_setting():
    with pytest.raises(BadInput, match="lqr: has no dial"):
        evaluate("lqr", dial={"speed": 0.3})
    with pytest.raises(BadInput, match="baseline-refined: has no dial"):
        find_controller("baseline-refined@speed=0.3")


def test_a_judgement_says_at_which_setting_it_was_flown(tmp_path):
    flights = fly(POLICY.at(speed=0.3), FAMILY, trials=2, duration=1.0)
    judged = judge(flights)
    assert judged.to_dict()["dial"] == {"speed": 0.3}
    assert "on dial (crazyflie, world flytune, dial speed 0.3): " in judged.table()
    turned = evaluate("dial", dial={"speed": [[0, 0.3], [0.5, 1.0]]}, trials=2, duration=1.0).judgement
    assert turned.to_dict()["dial"] == {"speed": [[0.0, 0.3], [0.5, 1.0]]}
    assert "dial speed 0.3 from 0 s on, 1 from 0.5 s on): " in turned.table()
    assert evaluate("lqr", trials=2, duration=1.0).judgement.to_dict()["dial"] is None
    flights.save(tmp_path / "flights.npz")
    with np.load(tmp_path / "flights.npz") as file:
        assert str(file["dial"]) == '{"speed": 0.3}'


def test_a_name_carries_the_setting_of_one_dial_or_of_several():
    assert split_setting("dial@speed=0.5") == ("dial", {"speed": 0.5})
    assert split_setting("runs/x@speed=0.5,calm=1") == ("runs/x", {"speed": 0.5, "calm": 1})
    assert split_setting("dial@speed=[[0, 0.3],[5,1]],calm=1") == ("dial", {"speed": [[0, 0.3], [5, 1]], "calm": 1})
    assert split_setting("baseline-refined@ppo") == ("baseline-refined@ppo", {})
    turned = find_controller("dial@speed=[[0,0.3],[5,1]]").controller
    assert turned.setting == {"speed": [[0.0, 0.3], [5.0, 1.0]]}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("dial@settling_time=1", r"settling_time: 1 is not allowed\. Allowed: 1\.\d+ to 1\d\.\d+ s with dial"),
        ("dial@settling_time=fast", "settling_time: fast is not allowed"),
        ("dial@settling_time=4,speed=1", "settling_time: sets the dial speed, which is given as well"),
        ("dial@speed=", "speed= is not allowed"),
        ("dial@=1", "not an assignment"),
        ("nosuch@speed=1", "nosuch: no such controller"),
    ],
)
def test_a_setting_in_a_name_that_is_none_is_refused(name, message):
    with pytest.raises(BadInput, match=message):
        find_controller(name)


def test_a_settling_time_is_not_promised_for_another_vehicle():
    with pytest.raises(BadInput, match=r"measured with the vehicle crazyflie, and this task flies crazyflie-measured"):
        find_controller("dial@settling_time=4", load_task("baseline", {"vehicle": "crazyflie-measured"}))
    assert find_controller("dial@settling_time=4", load_task("baseline", {"target.yaw": 1.0}))
    assert find_controller("dial@speed=0.5", load_task("baseline", {"vehicle": "crazyflie-measured"}))


def test_a_settling_time_in_a_name_is_flown_within_a_tenth():
    for wish in (2.5, 5.0):
        judged = evaluate(f"dial@settling_time={wish}", trials=200, seed=11).judgement
        assert judged.to_dict()["position"]["settling_time"]["median"] == pytest.approx(wish, rel=0.1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class WithOtherSettings:
    """A controller of a user that has fields of these names and no dial."""

    settings: float = 1.0
    setting: float = 2.0

    def initial_memory(self):
        return ()

    def act(self, memory, observation):
        return memory, jnp.zeros(4)


@pytest.mark.parametrize("task", ["baseline", "dial"])
def test_a_controller_without_dials_may_have_any_fields(task):
    flights = fly(WithOtherSettings(), load_task(task), trials=2, duration=1.0)
    assert flights.dial == {}
    assert flights.speed_bound == pytest.approx(0.8)


@pytest.mark.parametrize("value", [0.5, np.float32(0.5), np.float64(0.5), jnp.asarray(0.5), np.asarray(0.5)])
def test_a_setting_may_be_a_number_of_python_numpy_or_jax(value):
    assert POLICY.at(speed=value).setting == {"speed": 0.5}
    assert FAMILY.at({"speed": value}).speed_bound == 0.5
    assert with_schedule(POLICY, {"speed": [[0, value], [np.float32(1), 1]]}).setting["speed"][0] == [0.0, 0.5]


@pytest.mark.parametrize("value", [True, np.bool_(True), "0.5", None, np.asarray([0.5]), [0.5], 1j])
def test_a_setting_that_is_no_number_is_refused(value):
    with pytest.raises(BadInput, match="dial: "):
        with_schedule(POLICY, {"speed": value})


def test_a_policy_is_exported_at_one_setting_with_the_task_of_this_setting(tmp_path):
    path = tmp_path / "slow.safetensors"
    assert main(["export", "dial@speed=0.5", "--format", "safetensors", "--out", str(path)]) == 0
    slow = find_controller(str(path))
    assert slow.controller.actor.sizes == (17, 64, 64, 4)
    assert slow.task.speed_bound == 0.5
    assert slow.about["dial"] == "speed=0.5"
    flights = [fly(each, FAMILY.at({"speed": 0.5}), trials=5, duration=3.0) for each in (slow, POLICY.at(speed=0.5))]
    assert np.abs(flights[0].position - flights[1].position).max() < 1e-3


@pytest.mark.parametrize("name", ["dial@speed=[[0,0.3],[5,1]]", "onnx@speed=0.5"])
def test_what_has_no_weights_at_one_setting_is_not_exported(tmp_path, capsys, name):
    pytest.importorskip("onnxruntime")
    export_policy(POLICY, tmp_path / "onnx.onnx")
    name = name.replace("onnx@", f"{tmp_path / 'onnx.onnx'}@")
    assert main(["export", name, "--format", "onnx", "--out", str(tmp_path / "out.onnx")]) == 2
    assert "cannot be written at one setting" in capsys.readouterr().err
    assert not (tmp_path / "out.onnx").exists()


@pytest.mark.slow
def test_the_map_of_an_onnx_file_is_measured_and_that_of_a_schedule_is_the_policys(tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    path = export_policy(POLICY, tmp_path / "dial.onnx")
    assert main(["map", "dial@speed=[[0,0.3],[5,1]]"]) == 0
    carried = capsys.readouterr().out
    assert main(["map", "dial"]) == 0
    assert capsys.readouterr().out == carried
    measured = measure_map(find_controller(str(path)).controller, FAMILY, settings=2, trials=5)
    assert measured.settled == [5, 5]
    assert main(["map", "pid"]) == 2
    assert "pid: has no dial" in capsys.readouterr().err
