"""The page, the Markdown and the figures of a reproduction, from evidence made by hand."""

import base64
import json
import re
import xml.etree.ElementTree as ET

import pytest
from tests.chromium import assert_quiet
from tests.pages import Reader

from flytune.reproduction.claims import judge_claims
from flytune.reproduction.figures import FIGURES, draw_figures
from flytune.reproduction.inconsistencies import find_inconsistencies
from flytune.reproduction.page import html, markdown, summary
from flytune.reproduction.study import BEHAVIOURS
from flytune.reproduction.verdict import JudgedClaim, Measure

pytestmark = pytest.mark.slow

ORDERED = {"baseline": 1.0, "acrobatic": 0.5, "inspection": 1.5}
LABELS = {  # what each figure must say
    "reward": "episode reward",
    "settling": "settling time [s]",
    "overshoot": "overshoot [% of the step]",
    "error": "steady-state error",
    "profile": "x [m]",
    "rotor-speed": "mean rotor speed [rpm]",
    "actuation": "RMS of the action",
}
CLAIM = JudgedClaim(
    item="R24",
    claim="a < b & <script>alert(1)</script>",
    verdict="does not hold",
    reading="none",
    why="Because.",
    measures=[Measure(what="share <b>", value=0.5, low=0.4, high=0.6, unit="share", agrees=False)],
)


def text_of(svg):
    return " ".join(ET.fromstring(svg).itertext())


def test_every_figure_of_the_paper_is_drawn(make_evidence):
    drawn = draw_figures(make_evidence(ORDERED))
    assert list(drawn) == [spec.name for spec in FIGURES]
    for name, label in LABELS.items():
        assert label in text_of(drawn[name])
    assert all(behaviour in text_of(drawn["profile"]) for behaviour in BEHAVIOURS)
    assert "yaw [deg]" in text_of(drawn["profile"])


def test_a_box_says_which_share_of_the_trials_it_shows(make_evidence):
    # inspection rests 3 cm away along x, outside the band, so none of its trials settles in x
    drawn = draw_figures(make_evidence(ORDERED, offsets={"inspection": 0.03}))
    shares = re.findall(r"\d+%", text_of(drawn["settling"]))
    assert shares == ["100%", "100%", "0%", *["100%"] * 9]


def test_the_same_evidence_draws_the_same_files(make_evidence):
    evidence = make_evidence(ORDERED)
    assert draw_figures(evidence) == draw_figures(evidence)


def test_the_page_shows_the_very_figures_that_are_written(make_evidence):
    evidence = make_evidence(ORDERED)
    drawn = draw_figures(evidence)
    page = html(evidence, [CLAIM], find_inconsistencies(evidence), drawn)
    images = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', page)
    assert [base64.b64decode(image).decode() for image in images] == list(drawn.values())


def test_the_page_begins_with_how_many_claims_hold(make_evidence):
    claims = judge_claims(make_evidence(ORDERED), ["R23-damping", "R23-error", "R24", "R26", "R29-settling"])
    assert summary(claims) == (
        "Of 5 claims, 2 hold, 1 holds under a reading, 1 does not hold and 1 cannot be tested as printed."
    )


def test_each_verdict_has_its_word_and_its_colour(make_evidence):
    evidence = make_evidence(ORDERED)
    claims = judge_claims(evidence)
    read = Reader(html(evidence, claims, [], draw_figures(evidence)))
    shown = [attributes["class"] for tag, attributes in read.elements if tag == "span"]
    assert set(shown) == {"verdict good", "verdict fair", "verdict bad", "verdict unknown"}
    assert len(shown) == 2 * len(claims)  # in the table of verdicts, and above the numbers


@pytest.mark.browser
@pytest.mark.parametrize("width", [1200, 420])
def test_a_browser_shows_the_page_without_an_error_a_request_or_anything_cut_off(
    browser, make_evidence, tmp_path, width
):
    evidence = make_evidence(ORDERED)
    page = tmp_path / "report.html"
    page.write_text(html(evidence, [CLAIM], find_inconsistencies(evidence), draw_figures(evidence)), encoding="utf-8")
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
    try:
        browser.open(page)
        sizes = browser.evaluate("[...document.querySelectorAll('figure img')].map(i => [i.naturalWidth, i.width])")
        assert len(sizes) == len(FIGURES)
        assert all(natural > 0 and min(width, 440) * 0.85 < shown < width for natural, shown in sizes)
        assert browser.evaluate("document.documentElement.scrollWidth") <= width
        assert "a < b & <script>alert(1)</script>" in browser.evaluate("document.body.innerText")
    finally:
        browser.call("Emulation.clearDeviceMetricsOverride")
    assert_quiet(browser)


def test_verdicts_are_plain_values():
    told = json.loads(json.dumps(CLAIM.to_dict()))
    assert told["measures"][0] == {
        "what": "share <b>",
        "value": 0.5,
        "low": 0.4,
        "high": 0.6,
        "unit": "share",
        "agrees": False,
        "missing": "",
    }


def test_verdicts_are_written_as_tables_of_markdown(make_evidence):
    text = markdown([CLAIM], find_inconsistencies(make_evidence(ORDERED)))
    assert "| R24 | **does not hold** | a < b & <script>alert(1)</script> | none |" in text
    assert "| share <b> | 50.0 % [40.0 %, 60.0 %] | no |" in text
    assert all(f"\n### C{number}\n" in text for number in range(1, 11))
