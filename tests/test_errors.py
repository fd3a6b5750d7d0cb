"""Packages: with those that are declared every module is imported; one that is too old is named with its remedy."""

import os
import re
import subprocess
import sys
import tomllib
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from pkgutil import walk_packages

import pytest

import flytune
from flytune.errors import BadInput, check_installed, require

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
DECLARED = [("", line) for line in PROJECT["dependencies"]]
DECLARED += [(extra, line) for extra in EXTRAS if extra != "dev" for line in EXTRAS[extra]]
NEEDS = {"flytune.adapters": "gymnasium", "flytune.adapters.vec_env": "stable_baselines3"}


def pretend(folder, name, version):
    """Metadata that say a version of a package is installed, where Python looks before any other place."""
    (folder / f"{name.replace('-', '_')}-{version}.dist-info").mkdir()
    (folder / f"{name.replace('-', '_')}-{version}.dist-info" / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    )


@pytest.fixture
def first(tmp_path, monkeypatch):
    """A folder that Python looks in first; what was checked before is checked anew."""
    monkeypatch.syspath_prepend(tmp_path)
    check_installed.cache_clear()
    yield tmp_path
    check_installed.cache_clear()


def run(*arguments, first):
    """What a command says that looks in a folder for packages first."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(first), str(ROOT / "src")])}
    return subprocess.run(
        [sys.executable, *arguments], cwd=first, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.floor
@pytest.mark.parametrize(
    "name",
    sorted(module.name for module in walk_packages(flytune.__path__, "flytune.") if "__main__" not in module.name),
)
def test_every_module_is_imported(name):
    for prefix, package in NEEDS.items():
        if name.startswith(prefix):
            pytest.importorskip(package)
    import_module(name)


def test_all_that_is_declared_is_named_with_its_lowest_version():
    lines = [line for _, line in DECLARED]
    assert [line for line in lines if not re.fullmatch(r"[a-z0-9-]+>=\d+(\.\d+)*", line)] == []


@pytest.mark.parametrize(("extra", "line"), DECLARED)
def test_a_package_that_is_too_old_is_named_with_its_remedy(first, extra, line):
    name, lowest = line.split(">=")
    pretend(first, name, "0.0.1rc1+local")
    said = re.escape(
        f'{name} 0.0.1rc1+local is too old, {lowest} or newer is needed. Install with: pip install "{line}"'
    )
    with pytest.raises(BadInput, match=f"^{said}$"):
        check_installed(extra)
    if extra:
        check_installed()
        with pytest.raises(BadInput, match=f"^{said}$"):
            require("sys", extra)


NEW_ENOUGH = ["3", "2.1.1", "2.1", "2.1.0.post1", "2.1.0+local", "2.10", "2.1.0rc1"]  # for 2.1.0


@pytest.mark.parametrize("found", [*NEW_ENOUGH, "2.0.9", "2", "1.26.4"])
def test_versions_are_compared_by_their_numbers(first, found):
    pretend(first, "flytune", "9")
    with next(first.glob("flytune-9.dist-info")).joinpath("METADATA").open("a") as file:
        file.write("Requires-Dist: numpy>=2.1.0\n")
    pretend(first, "numpy", found)
    if found in NEW_ENOUGH:
        check_installed()
    else:
        with pytest.raises(BadInput, match=rf"^numpy {re.escape(found)} is too old"):
            check_installed()


def test_what_is_always_needed_and_missing_is_named_too(first):
    pretend(first, "flytune", "9")
    with next(first.glob("flytune-9.dist-info")).joinpath("METADATA").open("a") as file:
        file.write("Requires-Dist: no-such-package>=1.2\nRequires-Dist: numpy>=99\n")
    said = f"no-such-package is not installed; numpy {version('numpy')} is too old, 99 or newer is needed."
    with pytest.raises(
        BadInput, match=re.escape(f'{said} Install with: pip install "no-such-package>=1.2" "numpy>=99"')
    ):
        check_installed()


@pytest.mark.parametrize("broken", ["jax", "numpy", "cyclopts", "lazy-loader"])
def test_the_first_command_says_in_one_line_what_is_too_old_even_where_it_cannot_be_imported(tmp_path, broken):
    pretend(tmp_path, broken, "0.0.1")
    (tmp_path / f"{broken.replace('-', '_')}.py").write_text("raise ImportError('from another age')\n")
    answer = run("-m", "flytune", "show", "baseline", first=tmp_path)
    assert (answer.returncode, answer.stdout, answer.stderr.count("\n")) == (2, "", 1), answer.stderr
    assert answer.stderr.startswith(f"{broken} 0.0.1 is too old, ")


def test_the_first_name_used_in_python_says_what_is_too_old(tmp_path):
    pretend(tmp_path, "jax", "0.0.1")
    answer = run("-c", "import flytune; flytune.load_vehicle('crazyflie')", first=tmp_path)
    assert answer.stderr.splitlines()[-1].startswith("flytune.errors.BadInput: jax 0.0.1 is too old, ")


def test_help_and_version_answer_whatever_is_installed(tmp_path):
    pretend(tmp_path, "jax", "0.0.1")
    for option in ("--help", "--version"):
        assert run("-m", "flytune", option, first=tmp_path).returncode == 0
