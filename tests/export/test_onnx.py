"""A policy as an ONNX file: its content, its actions, and its flights, which are those of the policy."""

import dataclasses
import math
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import flytune
from flytune.control.controller import Controller
from flytune.control.policy import ACTION, Network, Policy, make_network
from flytune.errors import BadInput
from flytune.evaluation.fly import fly
from flytune.runs.find import find_controller
from flytune.task.files import load_task, preset_names, read_task_text, write_task
from flytune.task.observation import LAYOUT, SIZE

onnx = pytest.importorskip("onnx", reason="needs flytune[onnx]")
onnxruntime = pytest.importorskip("onnxruntime", reason="needs flytune[onnx]")

from flytune.export.onnx import CONVENTIONS, OnnxController, check_actions, load_onnx, rounding_bound, save_onnx  # noqa: E402
from flytune.export.untrusted.onnx_controller import sample_observations  # noqa: E402


def make_policy(hidden=(64, 64), squash="tanh", gain=0.5, about=None, seed=0):
    """A policy as training begins with, its biases and input scale not the trivial ones."""
    network = make_network(jax.random.key(seed), (SIZE, *hidden, 4), gain)
    actor = Network(weights=network.weights, biases=tuple(jnp.linspace(-0.3, 0.4, b.size) for b in network.biases))
    return Policy(actor=actor, input_scale=jnp.linspace(0.5, 2, 17), squash=squash, about=about or {})


@pytest.fixture(scope="module")
def task():
    """The baseline task."""
    return load_task("baseline")


@pytest.fixture(scope="module")
def policy(task):
    """A gentle policy, one whose flights stay near for a second."""
    about = {"task": task.name, "vehicle": task.vehicle.name, "task_toml": write_task(task), "trainer": "apg"}
    return make_policy(gain=0.01, about=about)


@pytest.fixture
def exported(policy, tmp_path):
    """The file of the gentle policy."""
    save_onnx(tmp_path / "policy.onnx", policy)
    return tmp_path / "policy.onnx"


@pytest.mark.slow
def test_the_file_gives_the_actions_of_the_policy_for_ten_thousand_observations_every_squash_and_size(tmp_path):
    observations = sample_observations(10_000)
    sizes = [((), "tanh"), ((8,), "clip"), ((64, 64), "clip"), ((64, 64), "tanh"), ((32, 16, 8), "tanh")]
    for limit, (hidden, squash) in zip([math.inf, 0.1, 3.02, math.inf, 30.0], sizes, strict=True):
        policy = dataclasses.replace(make_policy(hidden, squash), error_limit=limit)
        save_onnx(tmp_path / "policy.onnx", policy)
        model = onnxruntime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
        (actions,) = model.run(["action"], {"observation": observations})
        assert actions.dtype == np.float32 and np.abs(actions).max() <= 1
        # each may be one rounding bound away from the exact action
        difference = np.abs(actions - np.asarray(policy(jnp.asarray(observations))))
        assert np.all(difference <= 2 * rounding_bound(policy, observations)), (hidden, squash)


def test_the_bound_on_rounding_holds_against_float64_and_is_far_below_the_resolution_of_a_motor():
    observations = sample_observations(2_000)
    for squash in ("clip", "tanh"):
        policy = make_policy(squash=squash)
        exact = observations.astype(float) * np.asarray(policy.input_scale, float)
        for index in range(3):
            exact = exact @ np.asarray(policy.actor.weights[index], float) + np.asarray(policy.actor.biases[index])
            if index < 2 or squash == "tanh":
                exact = np.tanh(exact)
        bound = rounding_bound(policy, observations)
        error = np.abs(np.asarray(policy(jnp.asarray(observations))) - np.clip(exact, -1, 1))
        assert np.all(error <= bound)
        # a 16 bit pulse width has 65,536 steps over a range of 2
        assert np.median(bound) < 2 / 65_536 * 4


def test_the_sample_observations_reach_from_the_target_to_far_beyond_any_flight():
    observations = sample_observations(10_000)
    np.testing.assert_array_equal(observations[0], [0, 0, 0, 0, 0, 0, 1] + [0] * 10)
    np.testing.assert_array_equal(observations, sample_observations(10_000))
    np.testing.assert_allclose(np.linalg.norm(observations[:, 3:7], axis=1), 1, atol=1e-6)
    for block in (slice(0, 3), slice(7, 10), slice(10, 13)):
        size = np.linalg.norm(observations[1:, block], axis=1)
        assert size.min() < 0.01 and size.max() > 100
    assert np.abs(observations[:, 13:]).max() == 1


def test_a_file_that_gives_other_actions_is_refused(policy, exported):
    controller = load_onnx(exported)
    check_actions(controller, policy, "policy.onnx")
    with pytest.raises(BadInput, match=r"policy\.onnx: .* action of onnxruntime differs") as caught:
        check_actions(controller, make_policy(gain=0.02, about=policy.about), "policy.onnx")
    assert "\n" not in str(caught.value)


def test_a_failed_export_keeps_the_file_that_was_there(policy, exported):
    before = exported.read_bytes()
    broken = Policy(actor=policy.actor, input_scale=policy.input_scale.at[3].set(jnp.nan), squash="tanh")
    with pytest.raises(BadInput, match=r"input_scale.*not finite"):
        save_onnx(exported, broken)
    assert exported.read_bytes() == before
    assert [path.name for path in exported.parent.iterdir()] == ["policy.onnx"]


def test_a_path_that_cannot_be_written_is_named(policy, tmp_path):
    with pytest.raises(BadInput, match=r"out: .*nowhere.* cannot be written"):
        save_onnx(tmp_path / "nowhere" / "policy.onnx", policy)


def test_one_call_exports_what_was_trained_or_found_in_any_format(policy, exported, tmp_path):
    written = flytune.export_policy(policy, tmp_path / "again.onnx")
    assert written.read_bytes() == exported.read_bytes()
    written = flytune.export_policy(
        flytune.find_controller("baseline-refined"), tmp_path / "p.safetensors", "safetensors"
    )
    shipped = flytune.find_controller("baseline-refined").controller
    np.testing.assert_array_equal(flytune.load_policy(written).actor.weights[0], shipped.actor.weights[0])


def test_a_controller_without_weights_and_an_unknown_format_are_refused_before_anything_is_written(exported, tmp_path):
    with pytest.raises(BadInput, match=r"^pid: cannot be exported. Allowed: a policy with its weights"):
        flytune.export_policy(flytune.find_controller("pid"), tmp_path / "p.onnx")
    with pytest.raises(BadInput, match=r"^OnnxController: cannot be exported"):
        flytune.export_policy(load_onnx(exported), tmp_path / "p.onnx")
    with pytest.raises(BadInput, match=r"^format: 'keras' is unknown. Allowed: onnx, safetensors."):
        flytune.export_policy(load_onnx(exported), tmp_path / "p.onnx", "keras")
    assert not (tmp_path / "p.onnx").exists()


def test_the_same_policy_gives_the_same_bytes(policy, exported, tmp_path):
    save_onnx(tmp_path / "again.onnx", policy)
    assert (tmp_path / "again.onnx").read_bytes() == exported.read_bytes()


def test_the_file_has_one_input_and_one_output_and_says_what_they_mean(exported, task):
    model = onnx.load(exported)
    onnx.checker.check_model(model, full_check=True)
    for values, name, size in ((model.graph.input, "observation", 17), (model.graph.output, "action", 4)):
        (value,) = values
        batch, numbers = value.type.tensor_type.shape.dim
        assert (value.name, batch.dim_param, numbers.dim_value) == (name, "batch", size)
        assert value.type.tensor_type.elem_type == onnx.TensorProto.FLOAT
    facts = {entry.key: entry.value for entry in model.metadata_props}
    assert facts["observation"] == LAYOUT and facts["action"] == ACTION and facts["rate"] == "100 Hz"
    assert facts["task"] == "baseline" and facts["vehicle"] == task.vehicle.name
    assert facts["format"] == "flytune-onnx-1" and facts["flytune_version"]
    assert facts["task_toml"] == write_task(task)


@pytest.mark.parametrize("name", preset_names())
def test_the_task_of_every_preset_is_read_back_from_the_file(name, tmp_path):
    task = load_task(name)
    save_onnx(tmp_path / "p.onnx", make_policy((8,), about={"task": name, "task_toml": write_task(task), "seed": 3}))
    about = load_onnx(tmp_path / "p.onnx").about
    assert about["task"] == name and about["seed"] == "3"
    assert write_task(read_task_text(about["task_toml"], "p.onnx")) == about["task_toml"] == write_task(task)


def test_the_file_is_a_controller_for_one_observation_and_for_any_batch(policy, exported):
    controller = load_onnx(exported)
    assert isinstance(controller, Controller) and isinstance(controller, OnnxController)
    observations = jnp.asarray(sample_observations(6))
    expected, allowed = policy(observations), 2 * rounding_bound(policy, np.asarray(observations)).max()
    memory, action = controller.act(controller.initial_memory(), observations[2])
    assert memory == () and action.shape == (4,) and action.dtype == jnp.float32
    np.testing.assert_allclose(action, expected[2], atol=allowed)

    def act(observation):
        return controller.act((), observation)[1]

    np.testing.assert_allclose(jax.jit(jax.vmap(act))(observations), expected, atol=allowed)
    twice = jax.vmap(jax.vmap(act))(observations.reshape(2, 3, 17))
    np.testing.assert_allclose(twice.reshape(6, 4), expected, atol=allowed)


def test_two_controllers_of_one_file_share_a_compiled_program_and_those_of_two_files_do_not(exported, tmp_path):
    save_onnx(tmp_path / "other.onnx", make_policy(seed=1))
    first, again, other = load_onnx(exported), load_onnx(exported), load_onnx(tmp_path / "other.onnx")
    assert jax.tree.structure(first) == jax.tree.structure(again) != jax.tree.structure(other)
    assert hash(first.session) == hash(again.session)


def test_it_flies_the_flights_of_the_policy(policy, exported, task):
    learned = fly(policy, task, trials=5, duration=0.6)
    flown = fly(load_onnx(exported), task, trials=5, duration=0.6)
    # actions differ by a few 1e-7 at first; within 60 steps of a gentle policy that grows to less than 1e-5
    np.testing.assert_allclose(flown.action, learned.action, atol=1e-5)
    np.testing.assert_allclose(flown.position, learned.position, atol=1e-5)
    assert np.abs(learned.action).max() > 1e-3  # it does act


def test_a_run_that_fails_in_flight_gives_an_action_that_is_not_finite(exported):
    controller = load_onnx(exported)
    assert np.all(np.isnan(controller._answer(np.zeros((2, 16), np.float32))))  # one number short
    assert controller._answer(np.zeros((2, 16), np.float32)).shape == (2, 4)


def test_the_conventions_are_those_of_the_contract():
    assert CONVENTIONS == {"observation": LAYOUT, "action": ACTION, "rate": "100 Hz"}


def test_the_python_of_the_documentation_flies_the_file(exported, policy):
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "onnx.md").read_text(encoding="utf-8")
    (snippet,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    answer = subprocess.run(
        [sys.executable, "-c", snippet], cwd=exported.parent, capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stderr
    vehicle, numbers = answer.stdout.split(" ", 1)
    assert vehicle == policy.about["vehicle"]
    expected = policy(jnp.zeros(17).at[0].set(0.5).at[6].set(1.0))
    np.testing.assert_allclose(np.fromstring(numbers.strip(" []\n"), sep=" "), expected, rtol=1e-4)


def test_the_operators_of_an_exported_graph_are_those_that_the_page_names(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "onnx.md").read_text(encoding="utf-8").replace("\n", " ")
    five, six = re.search(r"Five of them .*?\((.*?)\).*? Six more .*?\((.*?)\)", page).groups()
    dials, scaled = (re.search(rf"{who} has (.*?)(?: as well|\.)", page)[1] for who in ("with dials", "VecNormalize"))
    used = {}
    for name in ("baseline-refined", "dial"):
        save_onnx(tmp_path / "p.onnx", find_controller(name).controller)
        used[name] = {node.op_type for node in onnx.load(tmp_path / "p.onnx").graph.node}
    assert used["baseline-refined"] == {*five.split(", "), *six.split(", ")}
    formulas = {"Log"}  # of the preset `dial`
    assert used["dial"] == used["baseline-refined"] | set(re.findall(r"[A-Z]\w+", dials)) | formulas
    policy = find_controller("baseline-refined").controller
    save_onnx(tmp_path / "p.onnx", dataclasses.replace(policy, bounds=jnp.stack([-jnp.ones(17), jnp.ones(17)])))
    bounded = {node.op_type for node in onnx.load(tmp_path / "p.onnx").graph.node}
    assert bounded == used["baseline-refined"] | set(re.findall(r"[A-Z]\w+", scaled))
