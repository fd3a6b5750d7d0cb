"""The page of a tuning: everything that was said, in words that cannot harm, and figures a browser draws."""

import copy

import pytest
from tests.chromium import DRAWN, MISPLACED, assert_quiet
from tests.pages import HOSTILE, Reader

from flytune.report.tuning import write_tuning


def line(number, time, **changes):
    measured = {"settling_time": time, "overshoot": 0.01, "error": 0.002, "settled": 1.0, "constraints_satisfied": 1.0}
    return {
        "number": number,
        "parent": number - 1 if number else None,
        "edit": f"edit {number}",
        "result": f"response {number}",
        "seconds": 12.0,
        "response": measured,
        **changes,
    }


TUNING = {
    "title": "position settles in 6 s",
    "requirement": {
        "settling_time": 6.0,
        "tolerance": 0.1,
        "at_most": False,
        "overshoot": 0.05,
        "error": 0.01,
        "axis": "position",
    },
    "start": "baseline-refined",
    "met": True,
    "best": 2,
    "why": "",
    "iterations": [line(0, 3.0), line(1, None), line(2, 6.1)],
    "validations": [
        {
            "iteration": 2,
            "seed": 4000,
            "judgement": {
                "trials": 200,
                "position": {
                    "settled": 200,
                    "settling_time": {"median": 6.08},
                    "overshoot": {"median": 0.0},
                    "steady_state_error": {"median": 0.0031},
                },
            },
            "misses": {},
        }
    ],
}


def test_every_step_its_reason_and_the_verdict_are_on_the_page(tmp_path):
    write_tuning(tmp_path / "page.html", TUNING)
    read = Reader((tmp_path / "page.html").read_text())
    for words in ("Met: step 2", "edit 1", "response 1", "6.08 s", "200/200", "3.1 mm", "4000"):
        assert words in read.text
    ways, times = read.figures[0]["data"][:2]
    assert times["y"] == [3.0, None, 6.1]
    assert ways["x"] == [0, 1, None, 1, 2, None]
    assert ways["y"] == [3.0, None, None, None, 6.1, None]
    bands = [(shape["y0"], shape["y1"]) for shape in read.figures[0]["layout"]["shapes"]]
    assert bands == [pytest.approx((5.4, 6.6)), pytest.approx((0, 5)), pytest.approx((0, 10))]


def test_no_overshoot_at_all_still_has_an_axis(tmp_path):
    tuning = copy.deepcopy(TUNING)
    tuning["requirement"]["overshoot"] = 0.0
    for each in tuning["iterations"]:
        each["response"]["overshoot"] = 0.0
    write_tuning(tmp_path / "page.html", tuning)
    layout = Reader((tmp_path / "page.html").read_text()).figures[0]["layout"]
    assert layout["yaxis2"]["range"][1] > 0


def test_what_was_not_met_is_said_with_its_reason(tmp_path):
    write_tuning(tmp_path / "page.html", TUNING | {"met": False, "why": "not met: 9% too slow. no rule can help."})
    assert "Not met: 9% too slow. no rule can help." in Reader((tmp_path / "page.html").read_text()).text


def test_a_hostile_name_stays_text(tmp_path):
    tuning = copy.deepcopy(TUNING)
    tuning["iterations"][0]["edit"] = tuning["title"] = tuning["start"] = HOSTILE
    write_tuning(tmp_path / "page.html", tuning)
    read = Reader((tmp_path / "page.html").read_text())
    assert HOSTILE in read.text
    assert not [tag for tag, _ in read.elements if tag == "img"]


@pytest.mark.browser
@pytest.mark.parametrize("width", [1200, 400])
def test_a_browser_draws_the_figure_with_nothing_misplaced(browser, tmp_path, width):
    write_tuning(tmp_path / "page.html", TUNING)
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
    try:
        browser.open(tmp_path / "page.html")
        plot = "document.querySelector('.figure > div')"
        browser.evaluate(f"{plot}.scrollIntoView()")
        browser.wait_for(f"{plot}.querySelector('.main-svg')?.getBoundingClientRect().width > 300")
        assert browser.evaluate(DRAWN % 0) > 0
        assert browser.evaluate(MISPLACED % 0) == []
        assert browser.evaluate("document.documentElement.scrollWidth") <= width
    finally:
        browser.call("Emulation.clearDeviceMetricsOverride")
    assert_quiet(browser)
