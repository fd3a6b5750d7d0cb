"""Commands with other simulators, other controllers, other files and missing packages, as a user types them."""

import json
import os
import sys

import pytest
from tests.cli.test_cli import SMALL
from tests.command import flytune, refused

SHORT = ["--trials", 4, "--duration", 2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("user")
    flytune("train", "baseline", "--set", *SMALL, "--out", "run", cwd=folder)
    return folder


@pytest.mark.parametrize("name", ["pid", "geometric", "lqr@textbook"])
def test_a_classical_controller_flies_by_its_name(folder, name):
    judged = json.loads(flytune("evaluate", name, "--task", "acrobatic", *SHORT, "--json", cwd=folder).stdout)
    assert (judged["who"], judged["task"], judged["crashed"]) == (name, "acrobatic", 0)


@pytest.mark.floor
@pytest.mark.parametrize("simulator", ["pybullet", "mujoco"])
def test_a_controller_flies_the_same_trials_in_another_simulator(folder, simulator):
    pytest.importorskip(simulator, reason=f"needs flytune[{simulator}]")
    here, there = (
        json.loads(flytune("evaluate", "pid", *SHORT, "--world", name, "--json", cwd=folder).stdout)
        for name in ("flytune", simulator)
    )
    assert there["world"] == simulator
    error_here, error_there = (each["axes"]["x"]["rms_error"]["median"] for each in (here, there))
    assert error_there == pytest.approx(error_here, rel=0.02)  # docs/results/worlds.md: centimetres in a metre


@pytest.mark.slow
def test_an_option_of_a_simulator_changes_the_flight(folder):
    pytest.importorskip("pybullet", reason="needs flytune[pybullet]")
    common = ["evaluate", "pid", *SHORT, "--world", "pybullet", "--json"]
    plain, damped = (
        json.loads(flytune(*common, *more, cwd=folder).stdout) for more in ([], ["--world-set", "damping=0.9"])
    )
    assert damped["peak_speed"]["median"] < 0.99 * plain["peak_speed"]["median"]


@pytest.mark.slow
@pytest.mark.floor
def test_an_exported_policy_flies_as_the_run_it_came_from(folder):
    pytest.importorskip("onnxruntime", reason="needs flytune[onnx]")
    answer = flytune("export", "run", "--format", "onnx", "--out", "policy.onnx", cwd=folder)
    assert answer.stdout == "policy.onnx\n"
    ours, theirs = (
        json.loads(flytune("evaluate", name, *SHORT, "--json", cwd=folder).stdout) for name in ("run", "policy.onnx")
    )
    assert theirs["task"] == ours["task"]
    assert theirs["axes"]["z"]["rms_error"]["median"] == pytest.approx(
        ours["axes"]["z"]["rms_error"]["median"], rel=1e-3
    )


def test_a_run_becomes_a_bare_policy(folder):
    flytune("export", "run", "--format", "safetensors", "--out", "bare.safetensors", cwd=folder)
    assert (folder / "bare.safetensors").read_bytes() == (folder / "run" / "policy.safetensors").read_bytes()


def test_compare_prints_tables_and_writes_a_page_and_its_numbers(folder):
    common = ["compare", "run", "pid", *SHORT]
    answer = flytune(*common, "--out", "comparison", "--flights", "paths.npz", cwd=folder)
    assert "pid and run: neither settles in 4 of 4 trials" in answer.stdout  # in 2 s
    told = json.loads((folder / "comparison" / "comparison.json").read_text())
    assert [controller["who"] for controller in told["controllers"]] == ["run", "pid"]
    assert "plotly" in (folder / "comparison" / "comparison.html").read_text(encoding="utf-8")
    assert (folder / "paths-1.npz").exists() and (folder / "paths-2.npz").exists()
    assert json.loads(flytune(*common, "--json", cwd=folder).stdout) == told


@pytest.mark.parametrize(
    ("package", "arguments"),
    [
        ("pybullet", ["evaluate", "pid", "--world", "pybullet"]),
        ("mujoco", ["evaluate", "pid", "--world", "mujoco"]),
        ("onnx", ["export", "run", "--format", "onnx", "--out", "new.onnx"]),
        ("tensorboard", ["train", "baseline", "--tensorboard", "--out", "new"]),
        ("gymnasium", ["train", "baseline", "--trainer", "sb3", "--out", "new"]),
    ],
)
def test_a_missing_package_is_named_with_its_remedy_and_nothing_is_written(
    folder, monkeypatch, capsys, package, arguments
):
    monkeypatch.chdir(folder)
    monkeypatch.setitem(sys.modules, package, None)  # an import of it now fails as if it were not installed
    before = sorted(os.listdir(folder))
    extra = {"gymnasium": "sb3"}.get(package, package)
    assert f'{package}: is not installed. Install it with: pip install "flytune[{extra}]"' in refused(
        *arguments, capsys=capsys
    )
    assert sorted(os.listdir(folder)) == before


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["compare", "pid"], "CONTROLLER: pid alone cannot be compared. Allowed: two or more."),
        (["compare", "pid", "nobody"], "nobody: no such controller. Allowed: a run directory"),
        (["evaluate", "pid@books"], "Allowed: tuned, textbook"),
        (["evaluate", "pidd"], "pidd: no such controller. Allowed: a run directory"),
        (["evaluate", "pid", "--world", "flytune", "--world-set", "damping=1"], "damping"),
        (["evaluate", "pid", "--world", "pybullet", "--world-set", "damping=-1"], "0 to 1"),
        (["evaluate", "pid", "--world", "mujoco", "--world-set", "integrator=magic"], "RK4"),
        (["evaluate", "broken.onnx"], "broken.onnx"),
        (["evaluate", "broken.zip"], "broken.zip"),
        (
            ["export", "pid", "--format", "onnx", "--out", "pid.onnx"],
            "cannot be exported. Allowed: a policy with its weights",
        ),
        (["export", "run", "--format", "onnx", "--out", "no/such/folder/policy.onnx"], "out: no/such/folder is no"),
        (["reproduce", "--seeds", "0"], "seeds: 0 is not allowed. Allowed: a whole number, 1 to 100"),
        (["reproduce", "--steps", "0"], "steps: 0 is not allowed. Allowed: a whole number, 1 or more"),
        (["reproduce", "--out", "run"], "holds no reproduction"),
    ],
)
def test_bad_input_is_one_clear_line_and_nothing_is_written(folder, monkeypatch, capsys, arguments, reason):
    monkeypatch.chdir(folder)
    for name in ("broken.onnx", "broken.zip"):
        (folder / name).write_bytes(b"\x00\x01garbage")
    before = sorted(os.listdir(folder))
    assert reason in refused(*arguments, capsys=capsys)
    assert sorted(os.listdir(folder)) == before
