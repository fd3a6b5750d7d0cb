"""What the pages of the documentation promise: commands, Python names and files that are really there."""

import ast
import importlib
import importlib.util
import re
import shlex
import tomllib
from pathlib import Path

import pytest

from flytune.cli.main import make_app

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md")] + sorted((ROOT / "docs").rglob("*.md"))
TEXTS = {str(page.relative_to(ROOT)): page.read_text(encoding="utf-8") for page in PAGES}


def each(pattern, flags=re.MULTILINE):
    """Every place in the pages where a pattern is found, as parameters of a test."""
    return [
        pytest.param(found, id=f"{name}-{number}")
        for name, text in TEXTS.items()
        for number, found in enumerate(re.findall(pattern, text, flags))
    ]


@pytest.mark.parametrize("line", each(r"^    (flytune (?!--help).*)$"))
def test_every_command_is_understood(line):
    words = shlex.split(line.split(" > ")[0], comments=True)[1:]
    command, _, _ = make_app().parse_args(words, exit_on_error=False, print_error=False)
    assert command.__name__ == words[0]


@pytest.mark.parametrize("block", each(r"```python\n(.*?)```", re.DOTALL))
def test_every_python_block_uses_names_that_exist(block):
    import flytune

    if "vec_env" in block:
        pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")
    for node in ast.walk(ast.parse(block)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("flytune"):
            module = importlib.import_module(node.module or "")
            assert [name.name for name in node.names if not hasattr(module, name.name)] == []
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "flytune":
            assert node.attr in (*flytune.__all__, "adapters")


@pytest.mark.parametrize("path", each(r"`((?!.*NAME)[\w-]+/[\w/-]+\.(?:py|toml))`"))
def test_every_file_that_is_named_is_there(path):
    places = (ROOT / path, ROOT / "src" / "flytune" / path, *(ROOT / "src" / "flytune").glob(f"*/{path}"))
    assert any(place.exists() for place in places)


@pytest.mark.parametrize("block", each(r"```toml\n(.*?)```", re.DOTALL))
def test_every_task_file_can_be_loaded(block, tmp_path):
    from flytune.task.files import load_task

    assert tomllib.loads(block)["based_on"]
    (tmp_path / "mine.toml").write_text(block, encoding="utf-8")
    assert load_task(tmp_path / "mine.toml").name == "mine"


def test_the_drawing_of_a_layout_shows_each_rotor_where_it_is_and_how_it_turns():
    pytest.importorskip("sphinx", reason="needs flytune[docs]")
    file = ROOT / "docs" / "_ext" / "vehicle_page.py"
    spec = importlib.util.spec_from_file_location("vehicle_page", file)
    page = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(page)
    image = page.drawing("hummingbird")
    # front, left, back, right: x is up and y to the left; the front and the back turn clockwise (sweep 1)
    middles = [tuple(map(float, each)) for each in re.findall(r'cx="([-.\d]+)" cy="([-.\d]+)"', image)]
    assert [(x > 1) - (x < -1) for x, _ in middles] == [0, -1, 0, 1]
    assert [(y > 1) - (y < -1) for _, y in middles] == [-1, 0, 1, 0]
    assert re.findall(r"A[-.\d]+ [-.\d]+ 0 0 (\d)", image) == ["1", "0", "1", "0"]
    assert re.findall(r">(\d: [+-]1)<", image) == ["0: +1", "1: -1", "2: +1", "3: -1"]
