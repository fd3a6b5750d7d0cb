"""Policies: what they answer, how they start, and the file they are kept in (paper R7, R9, R16)."""

import dataclasses
import itertools
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors
import safetensors.numpy

from flytune.control.controller import Controller
from flytune.control.policy import FORMAT, HEADER, Network, Policy, load_policy, make_network, save_policy
from flytune.errors import BadInput
from flytune.task.observation import EARLIER_LAYOUTS, LAYOUT

SIZES = (17, 64, 64, 4)
ABOUT = {"task": "baseline", "vehicle": "crazyflie", "trainer": "apg", "seed": 3}


@pytest.fixture(scope="module")
def networks():
    """A fresh actor, as training begins with."""
    return jax.jit(lambda key: make_network(key, SIZES, 0.5))(jax.random.key(0))


@pytest.fixture(params=["clip", "tanh"])
def policy(request, networks):
    """A policy with either way into the box."""
    biases = tuple(jnp.linspace(-0.3, 0.4, bias.size) for bias in networks.biases)
    actor = Network(weights=networks.weights, biases=biases)
    return Policy(actor=actor, input_scale=jnp.linspace(0.5, 2, 17), squash=request.param, about=ABOUT)


@pytest.fixture
def saved(policy, tmp_path):
    """The file of a policy."""
    save_policy(tmp_path / "policy.safetensors", policy)
    return tmp_path / "policy.safetensors"


@pytest.fixture
def observations():
    """A batch of observations, some of them far away."""
    return jnp.asarray(np.random.default_rng(0).normal(0, 3, (32, 17)), jnp.float32)


# --- what it answers ---


def test_a_policy_is_a_controller(policy):
    assert isinstance(policy, Controller)
    memory, action = policy.act(policy.initial_memory(), jnp.zeros(17))
    assert memory == () and action.shape == (4,)


def test_an_action_is_the_actor_on_the_scaled_observation_squashed(policy, observations):
    # written out: tanh(tanh(s o W0 + b0) W1 + b1) W2 + b2
    x = np.asarray(observations) * np.linspace(0.5, 2, 17)
    weights, biases = (
        [np.asarray(part, float) for part in parts] for parts in (policy.actor.weights, policy.actor.biases)
    )
    for weight, bias in zip(weights[:2], biases[:2], strict=True):
        x = np.tanh(x @ weight + bias)
    raw = x @ weights[2] + biases[2]
    expected = np.tanh(raw) if policy.squash == "tanh" else np.clip(raw, -1, 1)
    np.testing.assert_allclose(policy(observations), expected, atol=1e-5)


def test_a_batch_of_observations_is_each_of_them_alone(policy, observations):
    together = policy(observations)
    for index in (0, 7, 31):
        np.testing.assert_allclose(policy(observations[index]), together[index], atol=1e-6)
        np.testing.assert_allclose(policy.act((), observations[index])[1], together[index], atol=1e-6)


def test_an_action_stays_in_its_box_however_large_the_observation(policy, observations):
    large = Policy(
        actor=jax.tree.map(lambda leaf: 50 * leaf, policy.actor), input_scale=policy.input_scale, squash=policy.squash
    )
    actions = np.asarray(large(observations * 100))
    assert np.abs(actions).max() == pytest.approx(1)
    assert np.all(np.abs(actions) <= 1)


def test_a_new_network_is_orthogonal_with_the_gains_of_the_papers_recipe(networks):
    # 17 -> 64: the rows are orthogonal, W W^T = g^2 I; 64 -> 64 and 64 -> 4: the columns are, W^T W = g^2 I
    first, middle, last = (np.asarray(weight, float) for weight in networks.weights)
    np.testing.assert_allclose(first @ first.T, 2 * np.eye(17), atol=1e-5)
    np.testing.assert_allclose(middle.T @ middle, 2 * np.eye(64), atol=1e-5)
    np.testing.assert_allclose(last.T @ last, 0.5**2 * np.eye(4), atol=1e-5)
    assert not any(np.any(bias) for bias in networks.biases)


def test_another_seed_gives_another_network(networks):
    other = jax.jit(lambda key: make_network(key, SIZES, 0.5))(jax.random.key(1))
    assert not np.allclose(other.weights[0], networks.weights[0])


def test_a_position_error_beyond_the_limit_is_seen_as_one_at_the_limit(policy, observations):
    limit = 2.0
    near = dataclasses.replace(policy, error_limit=limit)
    length = np.linalg.norm(observations[:, :3], axis=1)
    assert (length < limit).any() and (length > limit).any()
    shortened = np.array(observations)
    far = length > limit
    shortened[far, :3] *= (limit / length[far])[:, None]
    np.testing.assert_allclose(near(observations), policy(jnp.asarray(shortened)), atol=1e-6)
    np.testing.assert_array_equal(near(observations)[~far], policy(observations)[~far])
    np.testing.assert_array_equal(near(jnp.zeros(17)), policy(jnp.zeros(17)))


def test_the_limit_of_the_position_error_is_kept_in_the_file(policy, tmp_path):
    path = tmp_path / "near.safetensors"
    save_policy(path, dataclasses.replace(policy, error_limit=2.5))
    assert load_policy(path).error_limit == 2.5
    save_policy(path, policy)
    assert load_policy(path).error_limit == math.inf
    for damaged in (0, -1, "far", True, [2], math.nan):
        assert "error limit" in refusal(forge(path, {"error_limit": damaged}))


def test_a_file_of_the_earlier_layout_is_read(saved):
    assert load_policy(forge(saved, {"observation": EARLIER_LAYOUTS[0]})).squash


# --- its file ---


def test_a_policy_is_read_back_to_the_last_bit(policy, saved):
    again = load_policy(saved)
    assert (again.squash, again.about) == (policy.squash, ABOUT)
    ours, theirs = jax.tree.leaves(policy), jax.tree.leaves(again)
    assert len(ours) == len(theirs) == 8
    for one, other in zip(ours, theirs, strict=True):
        assert np.asarray(one).dtype == np.asarray(other).dtype
        np.testing.assert_array_equal(one, other)


def test_a_policy_with_bounds_clips_its_observation_and_is_read_back_with_them(policy, observations, tmp_path):
    bounds = jnp.stack([jnp.full(17, -0.5), jnp.linspace(0.1, 2, 17)])
    bounded = dataclasses.replace(policy, bounds=bounds)
    np.testing.assert_array_equal(bounded(observations), policy(jnp.clip(observations, bounds[0], bounds[1])))
    save_policy(tmp_path / "p.safetensors", bounded)
    np.testing.assert_array_equal(load_policy(tmp_path / "p.safetensors")(observations), bounded(observations))
    for damaged in (bounds[::-1], bounds[:, :12], bounds[0], bounds * np.nan):
        forge(tmp_path / "p.safetensors", change_tensors={"bounds": np.asarray(damaged)})
        assert "its bounds are damaged" in refusal(tmp_path / "p.safetensors")


@pytest.mark.parametrize("hidden", [(), (8,), (8, 5, 9)])
def test_a_network_of_another_depth_is_read_back(tmp_path, observations, hidden):
    sizes = (17, *hidden, 4)
    deep = Policy(actor=make_network(jax.random.key(1), sizes, 0.5), input_scale=jnp.ones(17), squash="tanh")
    save_policy(tmp_path / "p.safetensors", deep)
    again = load_policy(tmp_path / "p.safetensors")
    assert [weight.shape for weight in again.actor.weights] == list(itertools.pairwise(sizes))
    np.testing.assert_array_equal(again(observations), deep(observations))


def test_the_header_says_what_the_policy_sees_does_and_was_trained_for(saved):
    with safetensors.safe_open(saved, framework="numpy") as file:
        header = json.loads(file.metadata()[HEADER])
    assert header["format"] == FORMAT
    assert header["observation"] == LAYOUT
    assert "[-1, 1]" in header["action"] and "0 (+x, -y), 1 (-x, -y), 2 (-x, +y), 3 (+x, +y)" in header["action"]
    assert header["rate"] == "100 Hz"
    assert header["about"] == ABOUT


def test_saving_leaves_nothing_but_the_policy_behind(saved):
    assert [path.name for path in saved.parent.iterdir()] == ["policy.safetensors"]


# --- what is refused ---


def refusal(path):
    """The one line that a file is refused with."""
    with pytest.raises(BadInput) as caught:
        load_policy(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and "\n" not in text
    return text.removeprefix(f"{path}: ")


def forge(path, change_header=None, change_tensors=None):
    """The same file with another header or other tensors."""
    with safetensors.safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()[HEADER]) | (change_header or {})
    tensors = safetensors.numpy.load_file(path)
    for name, tensor in (change_tensors or {}).items():
        if tensor is None:
            del tensors[name]
        else:
            tensors[name] = tensor
    safetensors.numpy.save_file(tensors, path, metadata={HEADER: json.dumps(header)})
    return path


def test_a_missing_file_is_refused(tmp_path):
    assert refusal(tmp_path / "none.safetensors").startswith("no such file.")


def test_a_directory_is_refused(tmp_path):
    assert "is not a policy" in refusal(tmp_path)


@pytest.mark.parametrize(
    "content",
    [b"", b"\x00", b"not a policy at all", bytes(range(256)) * 8, b"\xff" * 64],
    ids=["empty", "one byte", "text", "bytes", "huge header"],
)
def test_a_file_that_is_no_safetensors_is_refused(tmp_path, content):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(content)
    assert refusal(path).startswith("is not a policy (")


def test_half_a_file_is_refused(saved):
    saved.write_bytes(saved.read_bytes()[:-100])
    assert refusal(saved).startswith("is not a policy (")


def test_somebody_elses_safetensors_are_refused(tmp_path):
    path = tmp_path / "model.safetensors"
    safetensors.numpy.save_file({"weight": np.zeros((3, 3), np.float32)}, path)
    assert refusal(path) == f"is not a flytune policy (format None). Allowed: {FORMAT}."
    safetensors.numpy.save_file({"weight": np.zeros(3, np.float32)}, path, metadata={HEADER: '{"format": "pt"}'})
    assert refusal(path) == f"is not a flytune policy (format 'pt'). Allowed: {FORMAT}."


def test_a_policy_of_another_observation_is_refused(saved):
    assert refusal(forge(saved, {"observation": "13 numbers"})).startswith(
        f"was trained on another observation, '13 numbers'. Allowed: {LAYOUT}."
    )


@pytest.mark.parametrize(
    ("changes", "start"),
    [
        ({"actor.0.weight": np.zeros((16, 64), np.float32)}, "layer 0 has shape (16, 64), allowed: (17, 64)."),
        ({"actor.1.weight": np.zeros((32, 64), np.float32)}, "layer 1 has shape (32, 64), allowed: (64, 64)."),
        ({"actor.1.bias": np.zeros(63, np.float32)}, "layer 1 has shape"),
        ({"actor.2.weight": np.zeros((64, 3), np.float32), "actor.2.bias": np.zeros(3, np.float32)}, "maps (17,) to 3"),
        ({"input_scale": np.ones(16, np.float32)}, "maps (16,) to 4"),
        ({"actor.2.bias": np.full(4, math.nan, np.float32)}, "actor.2.bias holds numbers that are not finite."),
        ({"input_scale": np.full(17, math.inf, np.float32)}, "input_scale holds numbers that are not finite."),
        ({"actor.2.bias": None}, "is a damaged policy"),
        ({"input_scale": None}, "is a damaged policy"),
        ({"extra": np.zeros(3, np.float32)}, "is a damaged policy"),
        ({"actor.0.weight": np.zeros((), np.float32)}, "layer 0 has shape ()"),
    ],
)
def test_a_policy_with_damaged_tensors_is_refused(saved, changes, start):
    assert refusal(forge(saved, change_tensors=changes)).startswith(start)


def test_a_policy_that_squashes_otherwise_is_refused(saved):
    assert refusal(forge(saved, {"squash": "relu"})).startswith("is a damaged policy")


@pytest.mark.parametrize("header", ["{not json", "[]", "3", "null"])
def test_a_policy_with_a_damaged_header_is_refused(saved, header):
    tensors = safetensors.numpy.load_file(saved)
    safetensors.numpy.save_file(tensors, saved, metadata={HEADER: header})
    assert refusal(saved).startswith("is not a ")
