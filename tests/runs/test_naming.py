"""Names of run directories: no two processes get the same one, and no setting is hidden by a name."""

import subprocess
import sys

import pytest

from flytune.errors import BadInput
from flytune.runs.naming import new_directory, run_name

# takes twenty names as fast as it can, from the moment its standard input is closed
TAKE = """
import sys
from flytune.runs.naming import new_directory
print("ready", flush=True)
sys.stdin.read()
for _ in range(20):
    with new_directory("baseline-apg-s0") as path:
        (path / "run.json").write_text("{}")
        print(path)
"""


def test_six_processes_that_start_at_once_share_no_directory(tmp_path):
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", TAKE], cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for _ in range(6)
    ]
    for each in processes:
        assert each.stdout.readline() == "ready\n"
    for each in processes:
        each.stdin.close()
    taken = [line for each in processes for line in each.stdout.read().split()]
    assert [each.wait() for each in processes] == [0] * 6
    assert len(taken) == len(set(taken)) == 120
    assert {tmp_path / path for path in taken} == set((tmp_path / "runs").iterdir())


def test_a_directory_into_which_nothing_was_written_is_removed_with_the_folder_that_was_made_for_it(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with new_directory("x") as path:
        assert path.is_dir()
    assert list(tmp_path.iterdir()) == []
    with new_directory("x") as path:
        (path / "run.json").touch()
    with new_directory("x") as second:
        assert str(second) == "runs/x-2"
    assert [each.name for each in (tmp_path / "runs").iterdir()] == ["x"]


def test_a_place_that_holds_no_directory_is_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").touch()
    with (
        pytest.raises(BadInput, match=r"^out: runs/x cannot be written \(.*\)\. Give --out DIR\.$"),
        new_directory("x"),
    ):
        pass
    (tmp_path / "runs").unlink()
    (tmp_path / "runs").symlink_to(tmp_path / "nowhere")
    with pytest.raises(BadInput, match=r"^out: runs/x cannot be written"), new_directory("x"):
        pass
    with pytest.raises(BadInput, match=r"^out: runs/x+ cannot be written"), new_directory("x" * 300):
        pass


def test_a_name_differs_with_every_change_and_stays_below_runs():
    assert run_name("baseline-apg-s0", {}) == "baseline-apg-s0"
    changed = [{"apg.updates": 2}, {"apg.updates": 3}, {"vehicle.mass": 2}, {"apg.updates": 2, "vehicle.mass": 2}]
    names = {run_name("baseline-apg-s0", each) for each in changed}
    assert len(names) == 4 and all(name.startswith("baseline-apg-s0-") for name in names)
    assert run_name("baseline-apg-s0", {"a": 1, "b": 2}) == run_name("baseline-apg-s0", {"b": 2, "a": 1})
    assert run_name("../../mine two", {}) == "mine-two"
