"""Files are whole or absent, and an error is one line."""

import json
import os
from pathlib import Path

import pytest

from flytune.config.files import check_file, held, make_folder, write_bytes, write_json, write_text
from flytune.errors import BadInput


def test_text_bytes_and_json_are_read_back_as_written(tmp_path: Path):
    write_text(tmp_path / "text", "größer\n")
    write_bytes(tmp_path / "bytes", b"\x00\xff")
    write_json(tmp_path / "json", {"a": [1, None]})
    assert (tmp_path / "text").read_text(encoding="utf-8") == "größer\n"
    assert (tmp_path / "bytes").read_bytes() == b"\x00\xff"
    assert json.loads((tmp_path / "json").read_text(encoding="utf-8")) == {"a": [1, None]}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bytes", "json", "text"]


def test_a_name_that_is_not_valid_unicode_does_not_stop_a_text(tmp_path: Path):
    write_text(tmp_path / "text", "flown by " + os.fsdecode(b"caf\xe9"))
    assert (tmp_path / "text").read_text(encoding="utf-8") == "flown by caf?"


def test_content_that_cannot_be_written_leaves_the_earlier_file_and_nothing_beside_it(tmp_path: Path):
    write_text(tmp_path / "file", "earlier")
    with pytest.raises(TypeError):
        write_json(tmp_path / "file", {"a": object()})
    with pytest.raises(TypeError):
        write_bytes(tmp_path / "file", "text")  # type: ignore[arg-type]
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("file", "earlier")]


def test_a_file_that_cannot_be_written_is_refused_in_one_line_and_leaves_nothing(tmp_path: Path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for path in (tmp_path / "folder", tmp_path / "none" / "x", tmp_path / "file" / "x", tmp_path / ("x" * 300)):
        with pytest.raises(BadInput, match=r"^flights: .* cannot be written \(.+\)\. Give another path\.$"):
            write_text(path, "text", field="flights")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder"]


def test_a_folder_is_made_with_those_above_it_and_refused_below_a_file(tmp_path: Path):
    make_folder(tmp_path / "a" / "b")
    make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(BadInput, match=r"^out: .*file/b cannot be written"):
        make_folder(tmp_path / "file" / "b")


def test_a_path_that_no_file_can_have_is_refused_before_writing(tmp_path: Path):
    check_file(tmp_path / "new")
    with pytest.raises(BadInput, match=r"^out: .* is a folder\. Give a file\.$"):
        check_file(tmp_path)
    with pytest.raises(BadInput, match=r"^flights: .*none is no folder"):
        check_file(tmp_path / "none" / "x", "flights")
    check_file(tmp_path / ("x" * 300))


def test_a_folder_that_another_holds_is_refused_until_it_is_free(tmp_path: Path):
    with held(tmp_path):
        refusal = r"^out: .* is being written by another process\. Give another directory, or wait for its end\.$"
        with pytest.raises(BadInput, match=refusal), held(tmp_path):
            pass
    with held(tmp_path):
        assert list(tmp_path.iterdir()) == []
