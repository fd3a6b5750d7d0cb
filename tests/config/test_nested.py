"""Nested tables: walked, looked up, edited, laid over each other and compared."""

import pytest

from flytune.config import nested
from flytune.errors import BadInput

TABLE = {"a": {"b": 1, "c": [2, 3]}, "d": 4}


def test_the_leaves_of_a_table_are_its_values_by_their_path():
    assert dict(nested.leaves(TABLE)) == {"a.b": 1, "a.c": [2, 3], "d": 4}
    assert dict(nested.leaves(TABLE, separator="/")) == {"a/b": 1, "a/c": [2, 3], "d": 4}
    assert dict(nested.leaves({**TABLE, "e": {"a": 1, "f": 2}}, skip=["a"])) == {"d": 4, "e.f": 2}


@pytest.mark.parametrize(
    ("path", "value"), [("a.b", 1), ("a", TABLE["a"]), ("d", 4), ("x", None), ("a.x", None), ("d.x", None)]
)
def test_a_path_finds_a_value_or_a_table_or_nothing(path, value):
    assert nested.look_up(TABLE, path) == value


def test_an_edit_replaces_one_value_and_leaves_the_original_alone():
    assert nested.edit(TABLE, "a.b", 9) == {"a": {"b": 9, "c": [2, 3]}, "d": 4}
    assert nested.edit(TABLE, "x.y", 9) == {**TABLE, "x": {"y": 9}}
    assert nested.edit(TABLE, "d", 9) == {**TABLE, "d": 9}
    assert TABLE == {"a": {"b": 1, "c": [2, 3]}, "d": 4}


def test_an_edit_through_a_value_is_refused():
    with pytest.raises(BadInput, match=r"^a\.b\.c: a\.b is a value, not a table\.$"):
        nested.edit({"a": {"b": 1}}, "a.b.c", 2)


def test_a_table_laid_over_one_of_another_kind_replaces_it():
    below = {"end": {"kind": "speed", "bound": 0.8}, "term": {"kind": "old", "a": 1.0, "b": 2.0}}
    above = {"end": {"bound": 0.2}, "term": {"kind": "new", "a": 3.0}, "more": 1}
    assert nested.overlay(below, above) == {
        "end": {"kind": "speed", "bound": 0.2},
        "term": {"kind": "new", "a": 3.0},
        "more": 1,
    }


@pytest.mark.parametrize(
    ("changes", "path"),
    [({}, None), ({"d": 5}, "d"), ({"x": 1}, "x"), ({"a": {"b": 2, "c": [2, 3]}}, "a.b"), ({"a": {}}, "a.b"),
     ({"name": "another", "sources": {"d": "why"}}, None), ({"a": {"b": 1, "c": [2, 3], "name": "n"}}, None)],
)  # fmt: skip
def test_the_first_difference_of_two_tables_is_named_and_names_and_sources_make_none(changes, path):
    assert nested.first_difference(TABLE, TABLE | changes) == path
    assert nested.first_difference(TABLE | changes, TABLE) == path
