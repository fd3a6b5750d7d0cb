"""The page of a tuning: everything that was said, in words that cannot harm, and figures a browser draws."""

import copy
import dataclasses

import numpy as np
import pytest
from tests.chromium import DRAWN, MISPLACED, assert_quiet
from tests.pages import HOSTILE, Reader

from flytune.config.files import make_folder
from flytune.evaluation.evaluate import evaluate
from flytune.report.tuning import evaluate_best, requirement_table, write_tuning
from flytune.runs.shipped import HOME
from flytune.task.files import load_task, write_task


def line(number, time, **changes):
    response = {"settling_time": time, "overshoot": 0.01, "error": 0.002, "settled": 1.0, "constraints_satisfied": 1.0}
    return {
        "number": number,
        "parent": number - 1 if number else None,
        "edit": f"edit {number}",
        "result": f"response {number}",
        "seconds": 12.0,
        "response": response,
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
        "percentile": 50.0,
        "settled": 0.95,
        "others": [],
    },
    "directory": "runs/tune-6s",
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
            "axes": {},
        }
    ],
}


@pytest.fixture(scope="module")
def best(make_evaluation):
    """The evaluation of the best policy: here of real flights."""
    return make_evaluation(name="best")


@pytest.fixture
def read_page(best, tmp_path):
    """Factory of pages that have been written and read."""

    def read(tuning):
        write_tuning(tmp_path / "page.html", tuning, best)
        return Reader((tmp_path / "page.html").read_text())

    return read


def responding(best, **values):
    """The judgement in which every trial has these values on every axis."""
    judged = best.judgement
    fields = {
        name: {axis: np.full(judged.trials, value) for axis in getattr(judged, name)} for name, value in values.items()
    }
    return dataclasses.replace(judged, **fields)


def cells(table):
    return [tuple(cell.text for cell in row) for row in table.rows]


def test_the_page_says_first_what_was_required_and_then_shows_the_response_and_the_edits(read_page):
    read = read_page(TUNING)
    order = ["position settles in 6 s", "Met by iteration 2", "required", "Step response", "edit 1", "response 1",
             "Response per iteration", "Validations", "4000", "6.08", "200/200", "3.10"]  # fmt: skip
    places = [read.text.index(words) for words in order]
    assert places == sorted(places)
    response, iterations = read.figures
    assert response["layout"]["yaxis"]["title"]["text"] == "x [m]"
    steps, points = iterations["data"][:2]
    assert points["y"] == [3.0, None, 6.1]
    assert steps["x"] == [0, 1, None, 1, 2, None]
    assert steps["y"] == [3.0, None, None, None, 6.1, None]
    bands = [(shape["y0"], shape["y1"]) for shape in iterations["layout"]["shapes"]]
    assert bands == [pytest.approx((5.4, 6.6)), pytest.approx((0, 5)), pytest.approx((0, 10))]


def test_what_was_required_stands_beside_what_was_reached(best):
    judged = responding(best, settling_time=6.08, overshoot=0.012, steady_state_error=0.0031)
    assert cells(requirement_table(TUNING, judged)) == [
        ("settling time, median", "6 s ± 10 %", "6.08 s", "met"),
        ("overshoot, median", "at most 5 %", "1.2 %", "met"),
        ("steady-state error, median", "at most 10 mm", "3.1 mm", "met"),
        ("trials that settle", "at least 95 %", "100 % (12 of 12)", "met"),
    ]


def test_every_measure_that_misses_the_requirement_is_marked(best):
    tuning = copy.deepcopy(TUNING)
    tuning["validations"][0]["misses"] = {"settling_time": 0.3, "settled": -0.95, "constraints_satisfied": -0.15}
    judged = responding(best, settling_time=np.inf, overshoot=np.nan, steady_state_error=0.0031)
    assert cells(requirement_table(tuning, judged)) == [
        ("settling time, median", "6 s ± 10 %", "-", "not met"),
        ("overshoot, median", "at most 5 %", "-", "met"),  # no trial has a step that is large enough
        ("steady-state error, median", "at most 10 mm", "3.1 mm", "met"),
        ("trials that settle", "at least 95 %", "0 % (0 of 12)", "not met"),
        ("trials that satisfy your constraints", "at least 95 %", "80 %", "not met"),
    ]


def test_a_requirement_on_yaw_speaks_of_degrees(best):
    tuning = copy.deepcopy(TUNING)
    tuning["requirement"] |= {"axis": "yaw", "error": np.radians(1.0), "at_most": True, "percentile": 90.0}
    judged = responding(best, settling_time=2.0, overshoot=0.0, steady_state_error=np.radians(0.25))
    rows = cells(requirement_table(tuning, judged))
    assert rows[0] == ("settling time, percentile 90", "at most 6 s", "2.00 s", "met")
    assert rows[2] == ("steady-state error, median", "at most 1 deg", "0.25 deg", "met")


def test_the_best_policy_flies_again_on_the_trials_that_judged_it(tmp_path):
    directory = tmp_path / "run"
    make_folder(directory)
    for name, source in (("policy.safetensors", "safetensors"), ("run.json", "json")):
        (directory / name).write_bytes((HOME / f"baseline-refined@apg.{source}").read_bytes())
    (directory / "task.toml").write_text(write_task(load_task("baseline-refined")))
    judged = evaluate(str(directory), trials=3, seed=4001, duration=1.5).judgement.to_dict()
    other = {"iteration": 0, "seed": 4002, "judgement": judged | {"trials": 5, "seed": 4002}, "misses": {}}
    tuning = {"directory": str(directory), "best": 1}
    validation = {"iteration": 1, "seed": 4001, "judgement": judged, "misses": {}}
    again = evaluate_best(tuning | {"validations": [other, validation, other]}).judgement.to_dict()
    assert again == judged


def test_no_overshoot_at_all_still_has_an_axis(read_page):
    tuning = copy.deepcopy(TUNING)
    tuning["requirement"]["overshoot"] = 0.0
    for each in tuning["iterations"]:
        each["response"]["overshoot"] = 0.0
    assert read_page(tuning).figures[1]["layout"]["yaxis2"]["range"][1] > 0


def test_what_was_not_met_is_said_with_its_reason(read_page):
    read = read_page(TUNING | {"met": False, "why": "not met: 9% too slow. no rule can help."})
    assert "Not met: 9% too slow. no rule can help." in read.text


def test_a_hostile_name_stays_text(read_page):
    tuning = copy.deepcopy(TUNING)
    tuning["iterations"][0]["edit"] = tuning["title"] = tuning["start"] = HOSTILE
    read = read_page(tuning)
    assert HOSTILE in read.text
    assert not [tag for tag, _ in read.elements if tag == "img"]


@pytest.mark.browser
@pytest.mark.parametrize("width", [1200, 420])
def test_a_browser_draws_the_figures_with_nothing_misplaced(browser, best, tmp_path, width):
    write_tuning(tmp_path / "page.html", TUNING, best)
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
    try:
        browser.open(tmp_path / "page.html")
        for index in range(2):
            plot = f"document.querySelectorAll('.figure > div')[{index}]"
            browser.evaluate(f"{plot}.scrollIntoView()")
            browser.wait_for(f"{plot}.querySelector('.main-svg')?.getBoundingClientRect().width > 300")
            assert browser.evaluate(DRAWN % index) > 0
            assert browser.evaluate(MISPLACED % index) == []
        assert browser.evaluate("document.documentElement.scrollWidth") <= width
    finally:
        browser.call("Emulation.clearDeviceMetricsOverride")
    assert_quiet(browser)
