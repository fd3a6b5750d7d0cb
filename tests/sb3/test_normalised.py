"""Models that learned from scaled observations: they are told from others, and fly with the statistics of that."""

import pytest

pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")

import json
import pickle
import shutil
import zipfile

import gymnasium
import jax.numpy as jnp
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tests.command import refused

from flytune.adapters.gymnasium import HoverEnv
from flytune.adapters.vec_env import HoverVecEnv
from flytune.cli.main import main
from flytune.control.policy import load_policy, save_policy
from flytune.errors import BadInput
from flytune.export.onnx import load_onnx, save_onnx
from flytune.export.untrusted.onnx_controller import sample_observations
from flytune.export.untrusted.sb3_model import load_sb3
from flytune.runs.find import find_controller

# from the target to 100 m away: most numbers of most of them are clipped at 10 standard deviations
OBSERVATIONS = np.concatenate([sample_observations(5000), 0.3 * sample_observations(5000)])


def learned(environments, steps=256, **options):
    options = {"n_steps": 32, "batch_size": 32, "n_epochs": 1, "policy_kwargs": {"net_arch": [16, 16]}} | options
    return PPO("MlpPolicy", environments, device="cpu", seed=0, **options).learn(steps)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with models and statistics that were made in different ways."""
    folder = tmp_path_factory.mktemp("made")
    environments = HoverVecEnv("baseline", 4)
    for name, options in {"scaled": {}, "narrow": {"clip_obs": 1.5}, "rewards": {"norm_obs": False}}.items():
        wrapped = VecNormalize(environments, **options)
        learned(wrapped).save(folder / f"{name}.zip")
        wrapped.save(str(folder / f"{name}.pkl"))
    model = learned(environments)
    model.save(folder / "raw.zip")
    PPO("MlpPolicy", VecNormalize(environments), n_steps=8, batch_size=8, device="cpu").save(folder / "untrained.zip")
    return folder


@pytest.fixture
def folder(made, tmp_path):
    """A folder of its own with copies of some of these files."""

    def copies(**names):
        for name, source in names.items():
            shutil.copy(made / source, tmp_path / name.replace("__", "."))
        return tmp_path

    return copies


def act(policy, observations=OBSERVATIONS):
    return np.asarray(policy(jnp.asarray(observations)))


def wanted(made, name):
    """What the model does behind its own VecNormalize."""
    with open(made / f"{name}.pkl", "rb") as file:
        scaled = pickle.load(file).normalize_obs(OBSERVATIONS)
    return PPO.load(made / f"{name}.zip", device="cpu").predict(scaled, deterministic=True)[0]


@pytest.mark.parametrize("name", ["scaled", "narrow"])
def test_with_its_statistics_a_model_acts_as_behind_vecnormalize(made, tmp_path, name):
    policy = load_sb3(made / f"{name}.zip", made / f"{name}.pkl")
    actions = wanted(made, name)
    # float32 sums of 17 products of up to 10 in another order; the variance of noise alone is some 1e-6
    np.testing.assert_allclose(act(policy), actions, rtol=0, atol=1e-4)
    assert np.abs(np.median(actions - act(policy))) < 1e-6 and actions.std() > 1e-3
    # written and read again, as flytune's file and as ONNX, which is checked against the policy before it is written
    save_policy(tmp_path / "policy.safetensors", policy)
    np.testing.assert_array_equal(act(load_policy(tmp_path / "policy.safetensors")), act(policy))
    pytest.importorskip("onnxruntime", reason="needs flytune[onnx]")
    save_onnx(tmp_path / "policy.onnx", policy)
    np.testing.assert_allclose(load_onnx(tmp_path / "policy.onnx").session(OBSERVATIONS), act(policy), atol=1e-4)


def test_without_statistics_it_is_refused_and_each_remedy_of_the_message_helps(folder, made, capsys, monkeypatch):
    place = folder(m__zip="scaled.zip")
    monkeypatch.chdir(place)
    line = refused("evaluate", "m.zip", capsys=capsys)
    assert "VecNormalize scaled its observations" in line and "columns 3 to 6" in line
    assert "as vecnormalize.pkl beside the model" in line and "m.zip@vecnormalize=FILE" in line
    folder(named__pkl="scaled.pkl")
    named = find_controller("m.zip@vecnormalize=named.pkl")
    folder(vecnormalize__pkl="scaled.pkl")
    beside = find_controller("m.zip")
    assert named.about["observations"] == "scaled by named.pkl"
    for found in (named, beside):
        np.testing.assert_allclose(act(found.controller), wanted(made, "scaled"), rtol=0, atol=1e-4)


def test_the_message_is_true_about_where_statistics_were_looked_for(folder, made):
    place = folder(m__zip="scaled.zip", untrained__zip="untrained.zip")

    def said(model):
        with pytest.raises(BadInput) as caught:
            load_sb3(place / model)
        return str(caught.value)

    assert "There is no vecnormalize.pkl beside the model, nor in a folder there." in said("m.zip")
    for name in ("one", "two"):
        (place / name).mkdir()
        shutil.copyfile(made / "scaled.pkl", place / name / "vecnormalize.pkl")
        if name == "one":
            assert f"{place / 'one' / 'vecnormalize.pkl'} may belong to it" in said("untrained.zip")
    assert "Several may belong to it: one/vecnormalize.pkl, two/vecnormalize.pkl." in said("m.zip")


def test_models_of_raw_observations_are_not_taken_for_scaled_ones(folder):
    for name in ("raw.zip", "rewards.zip", "untrained.zip"):
        assert "observations" not in load_sb3(folder(m__zip=name) / "m.zip").about
    place = folder(raw__zip="raw.zip", rewards__zip="rewards.zip", vecnormalize__pkl="scaled.pkl")
    for name in ("raw", "rewards"):  # statistics of some other model stand beside them
        assert load_sb3(place / f"{name}.zip").bounds is None


def test_a_trained_model_that_does_not_say_flies_and_says_that_it_does_not(made, tmp_path):
    PPO.load(made / "raw.zip", device="cpu").save(tmp_path / "bare.zip", exclude=["_last_obs", "_last_original_obs"])
    assert "does not say whether they were scaled" in load_sb3(tmp_path / "bare.zip").about["observations"]


def test_a_scaled_model_is_exported_from_the_command_line(folder, made, monkeypatch, capsys):
    pytest.importorskip("onnxruntime", reason="needs flytune[onnx]")
    place = folder(m__zip="scaled.zip", named__pkl="scaled.pkl")
    monkeypatch.chdir(place)
    assert main(["export", "m.zip@vecnormalize=named.pkl", "--format", "onnx", "--out", "m.onnx"]) == 0
    found = load_onnx(place / "m.onnx").session(OBSERVATIONS)
    np.testing.assert_allclose(found, wanted(made, "scaled"), rtol=0, atol=1e-4)
    capsys.readouterr()
    assert "nothing.pkl: cannot be read" in refused("evaluate", "m.zip@vecnormalize=nothing.pkl", capsys=capsys)
    assert "gone.zip: no such file" in refused("evaluate", "gone.zip@vecnormalize=named.pkl", capsys=capsys)


def test_a_model_that_does_not_say_needs_an_answer_where_statistics_stand_beside_it(folder, made):
    place = folder(m__zip="untrained.zip", vecnormalize__pkl="scaled.pkl")
    with pytest.raises(BadInput, match="does not say whether its observations were scaled") as caught:
        load_sb3(place / "m.zip")
    named, none = (word.rstrip(".,") for word in str(caught.value).split() if "@vecnormalize=" in word)
    assert find_controller(named).controller.bounds is not None
    assert find_controller(none).controller.bounds is None


@pytest.mark.parametrize(
    ("model", "statistics", "complaint"),
    [
        ("scaled.zip", "rewards.pkl", "it scales rewards alone"),
        ("raw.zip", "scaled.pkl", "learned from observations as they are"),
        ("rewards.zip", "scaled.pkl", "learned from observations as they are"),
    ],
)
def test_statistics_that_do_not_belong_to_a_model_are_refused(made, model, statistics, complaint):
    with pytest.raises(BadInput, match=complaint) as caught:
        load_sb3(made / model, made / statistics)
    assert len(str(caught.value).splitlines()) == 1
    with pytest.raises(BadInput, match="cannot fly without the statistics"):
        load_sb3(made / "scaled.zip", "none")


def test_statistics_of_another_training_are_refused(made, tmp_path):
    other = VecNormalize(HoverVecEnv("baseline", 2))
    other.obs_rms.mean, other.obs_rms.var = np.full(17, 0.5), np.full(17, 9.0)
    other.save(str(tmp_path / "other.pkl"))
    with pytest.raises(BadInput, match="does not belong to it: without that scaling, the attitude"):
        load_sb3(made / "scaled.zip", tmp_path / "other.pkl")


def test_a_model_that_was_loaded_and_saved_again_is_still_told_from_others(made, tmp_path):
    model = PPO.load(made / "scaled.zip", env=VecNormalize(HoverVecEnv("baseline", 4)), device="cpu")
    model.save(tmp_path / "again.zip")
    assert json.loads(zipfile.ZipFile(tmp_path / "again.zip").read("data"))["_last_obs"] is None
    with pytest.raises(BadInput, match="VecNormalize was around its environment"):
        load_sb3(tmp_path / "again.zip")
    policy = load_sb3(tmp_path / "again.zip", made / "scaled.pkl")
    np.testing.assert_array_equal(act(policy), act(load_sb3(made / "scaled.zip", made / "scaled.pkl")))


def test_what_the_checkpoint_callback_writes_is_found(tmp_path):
    keep = CheckpointCallback(128, str(tmp_path), name_prefix="hover", save_vecnormalize=True)
    model = PPO("MlpPolicy", VecNormalize(HoverVecEnv("baseline", 4)), n_steps=64, batch_size=64, device="cpu")
    model.learn(512, callback=keep)
    assert load_sb3(tmp_path / "hover_512_steps.zip").about["observations"].endswith("hover_vecnormalize_512_steps.pkl")


def test_the_folders_of_rl_zoo_are_known_and_several_of_them_are_not_guessed_among(folder):
    place = folder(best_model__zip="scaled.zip", vecnormalize__pkl="scaled.pkl")
    (place / "flytune-Hover-v0").mkdir()
    (place / "vecnormalize.pkl").rename(place / "flytune-Hover-v0" / "vecnormalize.pkl")
    assert load_sb3(place / "best_model.zip").bounds is not None
    shutil.copytree(place / "flytune-Hover-v0", place / "another")
    with pytest.raises(BadInput, match="Give the statistics"):
        load_sb3(place / "best_model.zip")


def test_the_wrapper_of_gymnasium_is_seen_and_flies_with_the_arrays_of_the_page(tmp_path):
    env = gymnasium.wrappers.NormalizeObservation(HoverEnv(edits={"horizon": 40}))
    model = learned(DummyVecEnv([lambda: env]), n_steps=64)
    model.save(tmp_path / "m.zip")
    with pytest.raises(BadInput, match="did not learn from flytune's 17 numbers as they are"):
        load_sb3(tmp_path / "m.zip")
    np.savez(tmp_path / "vecnormalize.npz", mean=env.obs_rms.mean, var=env.obs_rms.var, epsilon=env.epsilon)
    observations = sample_observations(1000) * 0.1
    scaled = np.float32((observations - env.obs_rms.mean) / np.sqrt(env.obs_rms.var + env.epsilon))
    np.testing.assert_allclose(
        act(load_sb3(tmp_path / "m.zip"), observations), model.predict(scaled, deterministic=True)[0], atol=1e-4
    )


def test_what_stands_in_place_of_the_last_observations_is_not_run(made, tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    import base64

    with zipfile.ZipFile(made / "raw.zip") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    about = json.loads(members["data"])
    for content in (pickle.dumps(Trap()), b"\x80\x04}.", b"", pickle.dumps(np.zeros((3, 12)))):
        about["_last_obs"][":serialized:"] = base64.b64encode(content).decode()
        with zipfile.ZipFile(tmp_path / "m.zip", "w") as archive:
            for name, member in (members | {"data": json.dumps(about)}).items():
                archive.writestr(name, member)
        with pytest.raises(BadInput, match="its _last_obs cannot be read") as caught:
            load_sb3(tmp_path / "m.zip")
        assert len(str(caught.value).splitlines()) == 1
    assert not (tmp_path / "sprung").exists()
