"""The page and the figures of a reproduction, drawn from evidence made by hand."""

import json
import xml.etree.ElementTree as ET

import pytest
from tests.chromium import DRAWN, assert_quiet

from flytune.reproduction.figures import write_figures
from flytune.reproduction.inconsistencies import points
from flytune.reproduction.markdown import markdown
from flytune.reproduction.page import write_page
from flytune.reproduction.study import ROLES
from flytune.reproduction.verdict import Measure, Verdict

ORDERED = {"baseline": 1.0, "acrobatic": 0.5, "inspection": 1.5}
FIGURES = {  # what each must say
    "reward": "episode reward",
    "settling": "settling time [s]",
    "overshoot": "overshoot [% of the step]",
    "error": "steady-state error",
    "profile": "x [m]",
    "rotor-speed": "mean rotor speed [rpm]",
    "actuation": "RMS of the action",
}
VERDICT = Verdict(
    item="R24",
    claim="a < b & <script>alert(1)</script>",
    word="holds",
    reading="none",
    why="Because.",
    measures=[Measure(what="share <b>", value=0.5, low=0.4, high=0.6, unit="share", agrees=False)],
)


def test_every_figure_of_the_paper_is_drawn_for_paper(make_evidence, tmp_path):
    paths = write_figures(tmp_path / "figures", make_evidence(ORDERED))
    assert [path.stem for path in paths] == list(FIGURES)
    for path in paths:
        words = " ".join(text for text in ET.parse(path).getroot().itertext())
        assert FIGURES[path.stem] in words
    profile = " ".join(ET.parse(tmp_path / "figures" / "profile.svg").getroot().itertext())
    assert all(role in profile for role in ROLES) and "yaw [deg]" in profile


def test_the_same_evidence_draws_the_same_files(make_evidence, tmp_path):
    evidence = make_evidence(ORDERED)
    first, again = (write_figures(tmp_path / name, evidence) for name in ("first", "again"))
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in again]


@pytest.mark.browser
def test_a_browser_draws_the_page_without_an_error_or_a_request(browser, make_evidence, tmp_path):
    evidence = make_evidence(ORDERED)
    write_page(tmp_path / "report.html", evidence, [VERDICT], points(evidence))
    browser.open(tmp_path / "report.html")
    number = browser.evaluate("document.querySelectorAll('.figure > div').length")
    assert number == 10  # reward, three metrics under two conditions, profile, motors, averaged weights
    for index in range(number):
        plot = f"document.querySelectorAll('.figure > div')[{index}]"
        browser.evaluate(f"{plot}.scrollIntoView()")
        browser.wait_for(f"{plot}.querySelector('.main-svg')")
        assert browser.evaluate(DRAWN % index) > 0, f"figure {index} is empty"
    assert "a < b & <script>alert(1)</script>" in browser.evaluate("document.body.innerText")
    assert_quiet(browser)


def test_verdicts_are_plain_values(make_evidence):
    told = json.loads(json.dumps(VERDICT.to_dict()))
    assert told["measures"][0] == {
        "what": "share <b>",
        "value": 0.5,
        "low": 0.4,
        "high": 0.6,
        "unit": "share",
        "agrees": False,
    }


def test_verdicts_are_written_as_tables_of_markdown(make_evidence):
    text = markdown([VERDICT], points(make_evidence(ORDERED)))
    assert "| R24 | a < b & <script>alert(1)</script> | **holds** | none |" in text
    assert "| share <b> | 50.0 % [40.0 %, 60.0 %] | no |" in text
    assert all(f"\n### C{number}\n" in text for number in range(1, 11))
