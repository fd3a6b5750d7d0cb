"""The one table model: the same table as text, HTML and Markdown."""

import math

import pytest

from flytune.tables import Cell, Column, Table, number

NUMBERS = Table.of(
    [
        Column("", lambda row: row["name"], align="left", width=6),
        Column("[s]", lambda row: row["time"], group="time", decimals=2, width=8),
        Column("median", lambda row: row["error"], group="error [mm]", decimals=1, scale=1e3, width=9),
        Column("p95", lambda row: row["worst"], group="error [mm]", decimals=1, scale=1e3, width=7),
    ],
    [
        {"name": "x", "time": 1.234, "error": 0.0021, "worst": None},
        {"name": "yaw", "time": math.inf, "error": 0, "worst": 1.5},
    ],
)
WORDS = Table.plain(["rule", "because"], [("H1", "a | b"), ("<i>", Cell(text="holds", tone="good"))], underlined=True)


def test_a_table_of_numbers_is_aligned_under_its_headings():
    assert NUMBERS.text().splitlines() == [
        "          time      error [mm]",
        "           [s]   median    p95",
        "x         1.23      2.1      -",
        "yaw          -      0.0 1500.0",
    ]


def test_a_table_of_words_is_as_wide_as_its_longest_text():
    assert str(WORDS).splitlines() == ["rule  because", "-------------", "H1    a | b", "<i>   holds"]


def test_a_column_grows_with_a_text_longer_than_its_width():
    table = Table.plain([Column("n", width=3), "text"], [(123456, "a"), (1, "b")])
    assert table.text().splitlines() == ["     n  text", "123456  a", "     1  b"]


def test_a_page_gets_escaped_texts_groups_over_their_columns_and_tones():
    html = NUMBERS.html()
    assert '<th colspan="2">error [mm]</th>' in html
    assert '<tr><th scope="row">x</th><td>1.23</td><td>2.1</td><td>-</td></tr>' in html
    assert WORDS.__html__() == WORDS.html()
    assert '<th scope="row">&lt;i&gt;</th><td class="words"><span class="good">holds</span></td>' in WORDS.html()


def test_a_cell_may_be_longer_on_a_page_and_carry_a_number():
    table = Table.plain(["name"], [(Cell(text="…end", page="a/long/end\nb", badge=12),)])
    assert table.text().splitlines()[1] == "…end"
    assert '<b class="badge c1">12</b>a/long/end<br>b' in table.html()


def test_markdown_has_one_heading_line_and_no_bar_inside_a_cell():
    assert NUMBERS.markdown().splitlines()[:3] == [
        "|  | time [s] | error [mm] median | error [mm] p95 |",
        "| --- | --: | --: | --: |",
        "| x | 1.23 | 2.1 | - |",
    ]
    assert WORDS.markdown().splitlines()[2:] == ["| H1 | a / b |", "| <i> | **holds** |"]


def test_a_table_without_rows_has_its_headings():
    assert Table.plain(["a", "b"], []).text() == "a  b"


@pytest.mark.parametrize(
    ("value", "text"), [(1.005, "1.00"), (None, "-"), (math.inf, "-"), (math.nan, "-"), (0, "0.00")]
)
def test_a_number_has_its_decimals_and_a_missing_one_is_a_dash(value, text):
    assert number(value, 2) == text


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match="zip"):
        Table.plain(["a", "b"], [("only one",)])
