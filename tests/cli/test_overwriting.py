"""What is written, and what is left alone: a file is replaced only if flytune wrote one of its kind there before."""

import json
import os
import shutil
import stat

import pytest
from tests.command import refused

from flytune.cli.main import main

FLY = ["--trials", "2", "--duration", "1"]


@pytest.fixture
def here(tmp_path, monkeypatch, small_run):
    """A folder with a run `mine`, a file of the user's own, `notes`, and a link to it."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(small_run, "mine")
    (tmp_path / "notes").write_text("mine alone")
    (tmp_path / "link").symlink_to("notes")
    return tmp_path


def files(folder):
    """Every file below a folder and what it holds."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_an_evaluation_of_a_run_on_another_task_is_kept_under_the_name_of_that_task(here, capsys):
    assert main(["evaluate", "mine", *FLY]) == 0
    own = (here / "mine" / "evaluation.json").read_bytes()
    (here / "windy day.toml").write_text('based_on = "baseline"\n[target]\nposition = [0.0, 0.0, 1.5]\n')
    for task, name in (("acrobatic", "acrobatic"), ("windy day.toml", "windy-day"), ("baseline", "baseline")):
        capsys.readouterr()
        assert main(["evaluate", "mine", "--task", task, *FLY]) == 0
        assert f"kept as mine/evaluation-{name}.json" in capsys.readouterr().err
        judged = json.loads((here / "mine" / f"evaluation-{name}.json").read_text())
        assert judged["task"] == task.removesuffix(".toml")
    assert (here / "mine" / "evaluation.json").read_bytes() == own
    assert (
        main(["evaluate", "mine", "--task", "mine/task.toml", "--out", "mine", "--trials", "3", "--duration", "1"]) == 0
    )
    assert json.loads((here / "mine" / "evaluation.json").read_text())["trials"] == 3


def test_a_report_into_a_folder_is_called_report_html_and_one_without_suffix_as_it_is_named(here, capsys):
    for out, written in (("mine", "mine/report.html"), ("page", "page")):
        assert main(["report", "mine", *FLY, "--out", out]) == 0
        assert capsys.readouterr().out.splitlines()[-1] == written
        assert (here / written).read_text(encoding="utf-8").startswith("<!DOCTYPE html>")


TAKEN = [
    (["evaluate", "pid", *FLY, "--out", "mine"], "out: mine is the run directory of another training"),
    (["evaluate", "pid", *FLY, "--flights", "notes"], "flights: notes is there and is not a file of flights"),
    (["evaluate", "pid", *FLY, "--flights", "link"], "flights: link is there and is not a file of flights"),
    (["compare", "pid", "lqr", *FLY, "--flights", "f.npz"], "flights: f-2.npz is there and is not a file of flights"),
    (["compare", "pid", "lqr", *FLY, "--out", "pages"], "out: pages/comparison.html is there and is not a page"),
    (["compare", "pid", "lqr", *FLY, "--out", "mine"], "out: mine is the run directory of another training"),
    (["report", "pid", *FLY, "--out", "notes"], "out: notes is there and is not a page of controllers of flytune"),
    (["report", "pid", *FLY, "--out", "mine/run.json"], "out: mine/run.json is a file of a run"),
    (["export", "baseline-refined", "--format", "safetensors", "--out", "notes"], "out: notes is there and is not"),
    (["export", "baseline-refined", "--format", "safetensors", "--out", "mine/policy.safetensors"], "file of a run"),
    (["export", "mine", "--format", "onnx", "--out", "copy.onnx"], "out: copy.onnx is there"),
    (["export", "mine", "--format", "onnx", "--out", "copy.safetensors"], "whose name ends in .onnx. Did you"),
    (["train", "baseline", "--out", "notes"], "out: notes is a file"),
    (["train", "baseline", "--out", "link"], "out: link is a file"),
    (["train", "baseline", "--out", "own"], "out: own is no run and holds task.toml, which is not replaced"),
    (["tune", "--settling-time", "3", "--out", "pages"], "out: pages already holds a tuning or a run"),
    (["tune", "--settling-time", "3", "--out", "own"], "out: own is no tuning and holds task.toml"),
    (["reproduce", "--out", "own"], "out: own is not empty and holds no reproduction"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "reason"), TAKEN, ids=[" ".join(arguments) for arguments, _ in TAKEN])
def test_what_somebody_else_wrote_is_not_replaced(here, capsys, arguments, reason):
    (here / "f-2.npz").write_bytes(b"PK of something else")
    (here / "own").mkdir()
    (here / "own" / "task.toml").write_text('based_on = "baseline"\n')
    (here / "pages" / "iterations").mkdir(parents=True)
    (here / "pages" / "comparison.html").write_text("<html>mine</html>")
    for name in ("copy.onnx", "copy.safetensors"):
        shutil.copyfile(here / "mine" / "policy.safetensors", here / name)
    before = files(here)
    said = refused(*arguments, capsys=capsys)
    assert said.startswith(reason) or reason in said
    assert files(here) == before


@pytest.mark.slow
def test_what_flytune_wrote_is_replaced_by_one_of_its_kind_and_so_is_an_empty_file(here):
    for name in ("f.npz", "page.html", "p.onnx", "p.safetensors"):
        (here / name).touch()
    for _ in range(2):
        assert main(["evaluate", "pid", *FLY, "--flights", "f.npz"]) == 0
        assert main(["report", "pid", *FLY, "--out", "page.html"]) == 0
        assert main(["compare", "pid", "lqr", *FLY, "--out", "pages", "--flights", "g.npz"]) == 0
        assert main(["export", "mine", "--format", "safetensors", "--out", "p.safetensors"]) == 0
    assert all((here / name).stat().st_size > 1000 for name in ("f.npz", "g-2.npz", "page.html", "p.safetensors"))


def test_an_exported_onnx_file_is_replaced_by_the_next(here):
    pytest.importorskip("onnx", reason="needs flytune[onnx]")
    for _ in range(2):
        assert main(["export", "mine", "--format", "onnx", "--out", "p.onnx"]) == 0
    assert (here / "p.onnx").stat().st_size > 500


def test_a_link_stays_a_link_and_its_file_is_replaced(here):
    (here / "elsewhere").mkdir()
    (here / "latest.npz").symlink_to("elsewhere/f.npz")
    for _ in range(2):  # at first there is nothing at its end
        assert main(["evaluate", "pid", *FLY, "--flights", "latest.npz"]) == 0
        assert (here / "latest.npz").is_symlink() and (here / "elsewhere" / "f.npz").stat().st_size > 1000


def test_a_device_is_written_to_and_stays_a_device(here):
    null = here / "null"
    try:
        os.mknod(null, stat.S_IFCHR | 0o666, os.stat(os.devnull).st_rdev)
    except PermissionError:
        pytest.skip("making a device needs the rights of root; /dev/null itself is safe from a user without them")
    assert main(["evaluate", "pid", *FLY, "--flights", str(null)]) == 0
    assert null.is_char_device()
