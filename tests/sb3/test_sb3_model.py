"""Stable-Baselines3 models as policies: the same actions, and files that are refused."""

import pytest

pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")

import collections
import io
import json
import pickle
import zipfile

import jax.numpy as jnp
import numpy as np
import torch
from stable_baselines3 import A2C, PPO, SAC

from flytune.control.policy import load_policy, save_policy
from flytune.errors import BadInput
from flytune.export.untrusted.sb3_model import load_sb3

OBSERVATIONS = np.random.default_rng(1).normal(size=(10_000, 17)).astype(np.float32)


@pytest.fixture
def saved(make_model, tmp_path):
    """The path of a small saved model."""
    make_model(policy_kwargs={"net_arch": [8, 8]}).save(tmp_path / "model.zip")
    return tmp_path / "model.zip"


def act(policy, observations=OBSERVATIONS):
    """The policy's actions."""
    return np.asarray(policy(jnp.asarray(observations)))


def rewritten(path, changes, compression=zipfile.ZIP_STORED):
    """The archive with other contents of some members; None leaves a member out."""
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()} | changes
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in contents.items():
            if content is not None:
                archive.writestr(name, content)
    return path


def torch_file(content):
    """What torch.save writes."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


def weights(path):
    """The tensors of a saved model, read by torch."""
    with zipfile.ZipFile(path) as archive:
        return torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)


@pytest.mark.parametrize("algorithm", [PPO, A2C])
@pytest.mark.parametrize("net_arch", [[64, 64], {"pi": [32], "vf": [16, 16]}, [], [8, 16, 8]])
def test_a_converted_policy_acts_as_the_model_does(make_model, tmp_path, algorithm, net_arch):
    # float32 sums of up to 64 products of size 1 in another order differ by some 64 * 6e-8
    options = {"activation_fn": torch.nn.Tanh} if algorithm is A2C else {}
    model = make_model(algorithm=algorithm, policy_kwargs={"net_arch": net_arch, **options})
    model.save(tmp_path / "model.zip")
    wanted, _ = model.predict(OBSERVATIONS, deterministic=True)
    policy = load_sb3(tmp_path / "model.zip")
    np.testing.assert_allclose(act(policy), wanted, rtol=0, atol=5e-6)
    assert (np.abs(wanted) == 1).any() and (np.abs(wanted) < 1).any()
    save_policy(tmp_path / "policy.safetensors", policy)
    np.testing.assert_array_equal(act(load_policy(tmp_path / "policy.safetensors")), act(policy))


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"policy_kwargs": {"activation_fn": torch.nn.ReLU}}, "ReLU"),
        ({"use_sde": True}, "gSDE"),
        ({"use_sde": True, "policy_kwargs": {"squash_output": True}}, "gSDE"),
        ({"policy_kwargs": {"share_features_extractor": False}}, "share_features_extractor"),
    ],
)
def test_another_architecture_is_refused_by_name(make_model, tmp_path, options, complaint):
    make_model(**options).save(tmp_path / "model.zip")
    with pytest.raises(BadInput, match=complaint):
        load_sb3(tmp_path / "model.zip")


def test_another_algorithm_or_another_size_is_refused(make_model, tmp_path):
    room = type(make_model().get_env().envs[0].unwrapped)
    for name, size, complaint in [
        ("observations", {"observations": 12}, r"observation_space \[12\]"),
        ("actions", {"actions": 3}, r"action_space \[3\]"),
        ("reach", {"reach": 0.5}, "actions from"),
        ("row", {"observations": (1, 12)}, r"observation_space \[1, 12\]"),
        ("two", {"observations": (2, 17)}, r"observation_space \[2, 17\]"),
        ("square", {"actions": (2, 2)}, r"action_space \[2, 2\]"),
        ("row_reach", {"actions": (1, 4), "reach": 0.5}, r"actions from \['-0.5', '-0.5', '-0.5', '-0.5'\]"),
    ]:
        make_model(room(**size)).save(tmp_path / f"{name}.zip")
        with pytest.raises(BadInput, match=complaint):
            load_sb3(tmp_path / f"{name}.zip")
    SAC("MlpPolicy", room(), device="cpu", buffer_size=10).save(tmp_path / "sac.zip")
    with pytest.raises(BadInput, match="the policy of another algorithm, or a custom policy"):
        load_sb3(tmp_path / "sac.zip")


@pytest.mark.parametrize(("observations", "actions"), [((1, 17), (1, 4)), ((17, 1), (4,)), ((1, 1, 17), (4, 1))])
def test_the_same_numbers_in_rows_or_columns_are_the_same_policy(make_model, tmp_path, observations, actions):
    room = type(make_model().get_env().envs[0].unwrapped)
    model = make_model(room(observations=observations, actions=actions), policy_kwargs={"net_arch": [8, 8]})
    model.save(tmp_path / "model.zip")
    wanted, _ = model.predict(OBSERVATIONS.reshape(-1, *observations), deterministic=True)
    np.testing.assert_allclose(act(load_sb3(tmp_path / "model.zip")), wanted.reshape(-1, 4), rtol=0, atol=5e-6)


@pytest.mark.parametrize(
    ("name", "tensor", "complaint"),
    [
        ("action_net.bias", torch.full((4,), torch.nan), "action_net.bias holds numbers that are not finite"),
        ("action_net.weight", torch.zeros(4, 9), "action_net has shape"),
        ("action_net.weight", torch.zeros(4, 8, 1), "tensor of shape"),
        ("action_net.weight", torch.zeros(8, 4).T, "not contiguous"),
        ("action_net.weight", torch.zeros(4, 8, dtype=torch.float64), "DoubleStorage"),
        ("features_extractor.cnn.0.weight", torch.zeros(4, 8), "another architecture"),
        ("action_net.bias", None, "another architecture"),
    ],
)
def test_weights_that_do_not_fit_together_or_are_not_finite_are_refused(saved, name, tensor, complaint):
    load_sb3(saved)
    changed = {key: value for key, value in {**weights(saved), name: tensor}.items() if value is not None}
    rewritten(saved, {"policy.pth": torch_file(changed)})
    with pytest.raises(BadInput, match=complaint) as refusal:
        load_sb3(saved)
    assert len(str(refusal.value).splitlines()) == 1


def altered(path, fault):
    """The model with a fault in its description (keys, value) or in its tensors (name, tensor)."""
    keys, new = fault
    if isinstance(keys, str):
        return rewritten(path, {"policy.pth": torch_file(weights(path) | {keys: new})})
    about = json.loads(zipfile.ZipFile(path).read("data"))
    inside = about
    for key in keys[:-1]:
        inside = inside[key]
    inside[keys[-1]] = new
    return rewritten(path, {"data": json.dumps(about).encode()})


RELU = "<class 'torch.nn.modules.activation.ReLU'>"
FAULTS = {
    "custom policy (module 'stable_baselines3.sac.policies')": (
        ("policy_class", "__module__"), "stable_baselines3.sac.policies",
    ),
    "explores by gSDE": (("use_sde",), True),
    "squashes its output": (("policy_kwargs", "squash_output"), True),
    "activation <class 'torch.nn.modules.activation.ReLU'>": (("policy_kwargs", "activation_fn"), RELU),
    "policy_kwargs ['features_extractor_class']": (("policy_kwargs", "features_extractor_class"), "Mine"),
    "observation_space [1, 12]": (("observation_space", "_shape"), [1, 12]),
    "action_space [2]": (("action_space", "_shape"), [2]),
    "actions from ['-2.', '-1.', '-1.', '-1.']": (("action_space", "low"), "[-2. -1. -1. -1.]"),
    "log_std holds numbers that are not finite": ("log_std", torch.full((4,), torch.inf)),
    "action_net has shape (4, 9)": ("action_net.weight", torch.zeros(4, 9)),
    "another architecture": ("features_extractor.cnn.0.weight", torch.zeros(4, 8)),
    "DoubleStorage": ("value_net.bias", torch.zeros(1, dtype=torch.float64)),
}  # fmt: skip


@pytest.mark.parametrize("first", FAULTS)
def test_of_two_faults_one_is_named_and_it_is_there(saved, tmp_path, first):
    for second in FAULTS:
        path = tmp_path / "faulty.zip"
        path.write_bytes(saved.read_bytes())
        for fault in {first, second}:
            altered(path, FAULTS[fault])
        with pytest.raises(BadInput) as caught:
            load_sb3(path)
        line = str(caught.value)
        assert any(fault in line for fault in (first, second)) and len(line.splitlines()) == 1, f"{second}: {line}"


class Trap:
    """What leaves a file behind where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def test_nothing_in_a_file_is_run(saved, tmp_path):
    trap = tmp_path / "sprung"
    about = json.loads(zipfile.ZipFile(saved).read("data"))
    about["lr_schedule"] = {":type:": "x", ":serialized:": pickle.dumps(Trap(trap)).hex()}
    rewritten(saved, {"data": json.dumps(about).encode()})
    load_sb3(saved)  # flies, since what was pickled there is never looked at
    for content in (torch_file({"a": Trap(trap)}), torch_file(collections.OrderedDict(weights(saved)) | {"a": eval})):
        rewritten(saved, {"policy.pth": content})
        with pytest.raises(BadInput, match="asks for"):
            load_sb3(saved)
    assert not trap.exists()
    torch.load(io.BytesIO(torch_file({"a": Trap(trap)})), weights_only=False)
    assert trap.exists()  # the trap itself works


def bomb(name, size):
    """An archive whose one member unpacks to `size` zeros."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, bytes(size))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"policy.pth": None}, "no 'policy.pth' in it"),
        ({"data": None}, "no 'data' in it"),
        ({"data": b"not json"}, "is not a Stable-Baselines3 model"),
        ({"data": b"[]"}, "damaged description"),
        ({"data": b"[" * 100_000}, "is not a Stable-Baselines3 model"),
        ({"policy.pth": b"not a zip"}, "is not a Stable-Baselines3 model"),
        ({"policy.pth": torch_file([torch.zeros(3)])}, "does not contain a table"),
        ({"policy.pth": torch_file({"a": 3.0})}, "does not contain a table"),
        ({"policy.pth": bomb("archive/data.pkl", 10**5)}, "unpacks to 100000 bytes"),
        ({"policy.pth": bomb("archive/data/0", 10**8)}, "of 100000000 bytes"),
        ({"data": bytes(10**8)}, "unpacks to 100000000 bytes"),
        ({f"extra/{number}": b"" for number in range(2000)}, "entries"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_damaged_foreign_and_oversized_files_are_refused_in_one_line(saved, changes, complaint):
    rewritten(saved, changes, zipfile.ZIP_DEFLATED)
    with pytest.raises(BadInput, match=complaint) as refusal:
        load_sb3(saved)
    assert len(str(refusal.value).splitlines()) == 1


def test_a_truncated_file_a_missing_one_and_a_directory_are_refused_in_one_line(saved, tmp_path):
    content = saved.read_bytes()
    for length in range(0, len(content), 997):
        saved.write_bytes(content[:length])
        with pytest.raises(BadInput, match="is not a Stable-Baselines3 model"):
            load_sb3(saved)
    with pytest.raises(BadInput, match="no such file"):
        load_sb3(tmp_path / "missing.zip")
    with pytest.raises(BadInput, match="Is a directory"):
        load_sb3(tmp_path)


def test_a_bent_bit_anywhere_is_refused_or_changes_nothing(saved):
    # every byte that is read lies under a checksum, but for what names and dates the members
    content, whole = saved.read_bytes(), load_sb3(saved)
    refused = []
    for place in range(0, len(content), 61):
        bent = bytearray(content)
        bent[place] ^= 4
        saved.write_bytes(bytes(bent))
        try:
            policy = load_sb3(saved)
        except BadInput as refusal:
            refused.append(str(refusal))
        else:
            np.testing.assert_array_equal(act(policy, OBSERVATIONS[:10]), act(whole, OBSERVATIONS[:10]))
    assert len(refused) > 20
    assert [line for line in refused if not line.startswith(f"{saved}: ") or "\n" in line] == []
