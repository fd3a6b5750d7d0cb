"""The wheel: every file of the package is in it, and it works away from the repository."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLE = """
import flytune
from flytune.runs.shipped import shipped_names

assert shipped_names()
for name in shipped_names():
    flytune.find_controller(name)
print(flytune.__file__)
"""


def source_files():
    """Every file of the package by its path below src/, but for what Python compiled."""
    files = [path for path in (ROOT / "src" / "flytune").rglob("*") if path.is_file() and path.suffix != ".pyc"]
    return {path.relative_to(ROOT / "src").as_posix() for path in files}


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    """The folder that a wheel of this source unpacks to."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"  # a copy, since setuptools keeps what it built before in the folder of the source
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "src" / "flytune", source / "src" / "flytune")
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, source]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "unpacked")
    return folder / "unpacked"


def test_every_file_of_the_package_is_in_the_wheel_and_nothing_else(unpacked):
    files = {path.relative_to(unpacked).as_posix() for path in unpacked.rglob("*") if path.is_file()}
    assert {name for name in files if ".dist-info/" not in name} == source_files()


def test_the_package_works_from_the_wheel_alone(unpacked, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(unpacked)}
    for command in (["-c", EXAMPLE], ["-m", "flytune", "show", "baseline"]):
        answer = subprocess.run(
            [sys.executable, *command], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert answer.returncode == 0, answer.stderr
        if command[0] == "-c":
            assert Path(answer.stdout.strip()).is_relative_to(unpacked)
