import dataclasses
import html

import numpy as np
import pytest
from tests.chromium import DRAWN, assert_quiet
from tests.pages import HOSTILE, Reader

from flytune.errors import BadInput
from flytune.report.report import write_report
from flytune.task.files import write_task


@pytest.fixture
def read(tmp_path):
    """Writes the report of some evaluations and reads it."""

    def write_and_read(*evaluations):
        write_report(tmp_path / "report.html", evaluations)
        return Reader((tmp_path / "report.html").read_text())

    return write_and_read


@pytest.fixture(scope="session")
def hostile_evaluation(make_evaluation, task, flights, curve):
    """An evaluation in which everything that a user names is an attack."""
    rows = [row | {"terms": {HOSTILE: 0.1}, "terminations": {HOSTILE: 1, HOSTILE + "never": 0}} for row in curve]
    return make_evaluation(
        name=HOSTILE,
        task=dataclasses.replace(task, name=HOSTILE, sources={"horizon": HOSTILE}),
        vehicle=HOSTILE,
        simulator=HOSTILE,
        margins={HOSTILE: flights.margins["speed"]},
        metrics=rows,
        about={HOSTILE: HOSTILE},
    )


@pytest.fixture(scope="session")
def odd_evaluations(make_evaluation, task, flights, keep):
    """Entries at the edge of what there is to show, by what is odd about them."""
    on_target = np.broadcast_to(flights.target_position, flights.position.shape)
    nobody = np.zeros(flights.trials, dtype=bool)
    lost = flights.position.copy()
    lost[:, 50:] = np.nan
    level = np.broadcast_to([0.0, 0.0, 0.0, 1.0], flights.attitude.shape)
    return {
        "without a curve": make_evaluation(metrics=None),
        "an empty curve": make_evaluation(metrics=[]),
        "a curve of nulls": make_evaluation(metrics=[{"update": 1, "steps": None, "reward": None, "terms": None}]),
        "one update": make_evaluation(metrics=[{"update": 1, "steps": 16384, "reward": 0.4}]),
        "a single trial": make_evaluation(**keep([1])),
        "everything crashed": make_evaluation(crashed=np.ones(flights.trials, dtype=bool)),
        "states that are not finite": make_evaluation(position=lost),
        "no termination": make_evaluation(task=dataclasses.replace(task, termination={}), margins={}),
        "no speed bound": make_evaluation(speed_bound=None),
        "everything settled at once": make_evaluation(position=on_target, attitude=level, crashed=nobody),
        "nothing known": make_evaluation(about={}),
    }


SENTENCES = {
    "without a curve": "This controller comes without a training curve.",
    "an empty curve": "The training left no numbers that could be drawn.",
    "a curve of nulls": "The training left no numbers that could be drawn.",
    "one update": "reward per step",
    "a single trial": "0 of 1 trials settle on all four axes",
    "everything crashed": "Every trial crashed",
    "states that are not finite": "Every trial crashed",
    "no termination": "The task has no termination condition, so there is no margin to draw.",
    "no speed bound": "(no bound)",
    "everything settled at once": "12 of 12 trials settle on all four axes",
    "nothing known": "Nothing is known of it.",
}


def test_the_page_shows_the_numbers_of_the_judgement(read, make_evaluation):
    evaluation = make_evaluation()
    page = read(evaluation)
    axes = evaluation.judgement.to_dict()["axes"]
    assert f"{axes['yaw']['steady_state_error']['median'] * 180 / np.pi:.2f}" in page.text
    assert f"{axes['x']['steady_state_error']['median'] * 1e3:.1f}" in page.text
    assert f"{axes['z']['settled']}/12" in page.text
    assert f"speed {np.count_nonzero(evaluation.judgement.violated['speed'])}" in page.text


def test_the_page_holds_the_task_with_every_number(read, make_evaluation, task):
    text = read(make_evaluation()).text
    assert all(line in text for line in write_task(task).splitlines())


@pytest.mark.floor
def test_the_page_of_one_controller_has_a_figure_of_each_kind(read, make_evaluation):
    kinds = [{trace["type"] for trace in figure["data"]} for figure in read(make_evaluation()).figures]
    assert kinds == [{"scatter"}, {"scatter"}, {"box"}, {"scatter"}, {"scatter3d"}, {"scatter"}]


def test_the_page_loads_nothing_from_the_network(read, make_evaluation):
    page = read(make_evaluation(), make_evaluation())
    tags = {tag for tag, _ in page.elements}
    assert not tags & {"link", "img", "iframe", "object", "embed", "base", "video", "audio", "source"}
    for _, attributes in page.elements:
        assert "src" not in attributes
        assert attributes.get("href", "#").startswith("#")
    policy = next(attributes["content"] for tag, attributes in page.elements if "http-equiv" in attributes)
    assert policy.startswith("default-src 'none';")
    assert "http" not in policy


def test_every_link_leads_to_one_place_on_the_page(read, make_evaluation):
    page = read(make_evaluation(), make_evaluation(metrics=None), make_evaluation())
    places = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(places) == len(set(places))
    assert {attributes["href"][1:] for _, attributes in page.elements if "href" in attributes} <= set(places)


def test_names_that_are_markup_come_out_as_text(read, hostile_evaluation):
    page = read(hostile_evaluation, hostile_evaluation)
    scripts = [attributes for tag, attributes in page.elements if tag == "script"]
    assert len(scripts) == len(page.figures) + 2  # the figures' data, plotly.js and the page's own
    assert not any(name.startswith("on") for _, attributes in page.elements for name in attributes)
    assert page.text.count(HOSTILE) >= 10
    assert "<script" not in page.texts_of_figures()
    assert html.escape("<script>") in page.texts_of_figures()


def test_the_page_of_one_controller_is_smaller_than_its_limit(read, make_evaluation, flights, tmp_path):
    # the packed plotly.js and the figures of 100 trials of 10 s, a training curve among them
    copies, long = -(-100 // flights.trials), -(-1001 // flights.time.size)

    def enlarge(values):
        noise = 1e-3 * np.random.default_rng(0).normal(size=(100, 1001, *values.shape[2:]))
        return np.tile(values, (copies, long, *[1] * (values.ndim - 2)))[:100, :1001] + noise

    names = ("position", "attitude", "velocity", "body_rate", "rotor_speed_rpm", "action")
    read(
        make_evaluation(
            time=np.arange(1001) / 100,
            crashed=np.zeros(100, dtype=bool),
            margins={name: enlarge(margin) for name, margin in flights.margins.items()},
            **{name: enlarge(getattr(flights, name)) for name in names},
        )
    )
    assert (tmp_path / "report.html").stat().st_size < 2.5e6


@pytest.mark.parametrize("odd", SENTENCES)
def test_what_cannot_be_drawn_is_said(read, odd_evaluations, odd):
    page = read(odd_evaluations[odd])
    assert SENTENCES[odd] in page.text + page.texts_of_figures()
    assert all(figure["data"] for figure in page.figures)


@pytest.mark.floor
def test_several_controllers_are_compared_on_top_and_their_differing_numbers_listed(read, make_evaluation, task):
    faster = dataclasses.replace(task, name="faster", horizon=700)
    page = read(make_evaluation(name="one"), make_evaluation(name="two", task=faster))
    assert "2 controllers compared" in page.text
    assert page.text.index("two") < page.text.index("How their tasks differ") < page.text.index("on all four axes")
    assert "horizon500700" in page.text
    assert len(page.figures) == 1 + 2 * 6  # differences of flights on other tasks would be of unlike with unlike


def test_controllers_of_other_trials_stand_side_by_side_without_paired_differences(read, make_evaluation):
    page = read(make_evaluation(name="one"), make_evaluation(name="two", seed=2))
    assert "There are no paired differences" in page.text
    assert "seed: 1 for one and 2 for two" in page.text
    assert len(page.figures) == 1 + 2 * 6


def test_controllers_of_the_same_task_are_said_to_share_it(read, make_evaluation):
    assert "All were given the same task, number by number." in read(make_evaluation(), make_evaluation()).text


def test_a_report_replaces_an_earlier_one_and_leaves_nothing_beside_it(make_evaluation, tmp_path):
    (tmp_path / "report.html").write_text("an earlier one")
    write_report(tmp_path / "report.html", [make_evaluation()])
    assert (tmp_path / "report.html").read_text().startswith("<!DOCTYPE html>")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("missing/report.html", "no folder"),
        ("file/report.html", "no folder"),
        ("folder", "is a folder"),
        ("x" * 300 + ".html", "cannot be written"),
    ],
)
def test_a_place_that_cannot_be_written_is_refused_in_one_line(make_evaluation, tmp_path, place, says):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(BadInput, match=says) as error:
        write_report(tmp_path / place, [make_evaluation()])
    assert "\n" not in str(error.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_a_report_without_a_controller_is_refused(tmp_path):
    with pytest.raises(BadInput, match="no controller"):
        write_report(tmp_path / "report.html", [])


# how many pixels of a figure in space have a colour, with the traces and without
COLOURED = """
(async number => {
  const plot = document.querySelectorAll(".figure > div")[number];
  const [width, height] = [300, 200];
  const count = async data => {
    const picture = new Image();
    const figure = {data, layout: {...plot.layout, showlegend: false}, config: {plotGlPixelRatio: 1}};
    picture.src = await Plotly.toImage(figure, {format: "png", width, height});
    await picture.decode();
    const canvas = new OffscreenCanvas(width, height).getContext("2d", {willReadFrequently: true});
    canvas.drawImage(picture, 0, 0);
    const pixels = canvas.getImageData(0, 0, width, height).data;
    let coloured = 0;
    for (let i = 0; i < pixels.length; i += 4) {
      const [red, green, blue] = pixels.subarray(i, i + 3);
      coloured += Math.max(red, green, blue) - Math.min(red, green, blue) > 40;
    }
    return coloured;
  };
  return await count(plot.data) - await count([]);
})(%d)
"""


def look_at(browser, path):
    """Open the page, scroll to every figure, and fail on whatever a reader should not meet."""
    browser.open(path)
    number = browser.evaluate("document.querySelectorAll('.figure > div').length")
    for index in range(number):
        plot = f"document.querySelectorAll('.figure > div')[{index}]"
        browser.evaluate(f"{plot}.scrollIntoView()")
        browser.wait_for(f"{plot}.querySelector('.main-svg')?.getBoundingClientRect().width > 300")
        in_space = browser.evaluate(f"{plot}.dataset.space === 'yes'")
        assert browser.evaluate((COLOURED if in_space else DRAWN) % index) > 0, f"figure {index} is empty"
    assert_quiet(browser)
    return number


@pytest.mark.browser
def test_a_browser_draws_every_figure_without_an_error_or_a_request(browser, make_evaluation, tmp_path):
    write_report(tmp_path / "report.html", [make_evaluation(name="one"), make_evaluation(name="two")])
    assert look_at(browser, tmp_path / "report.html") == 4 + 2 * 6


@pytest.mark.slow
@pytest.mark.browser
def test_a_browser_draws_the_odd_cases_too(browser, odd_evaluations, tmp_path):
    evaluations = [dataclasses.replace(evaluation, name=odd) for odd, evaluation in odd_evaluations.items()]
    write_report(tmp_path / "report.html", evaluations)
    # the shares, and six of each but for three without a curve, two without boxes, one without margins
    assert look_at(browser, tmp_path / "report.html") == 1 + 6 * len(evaluations) - 6


@pytest.mark.slow
@pytest.mark.browser
def test_a_browser_shows_hostile_names_as_text(browser, hostile_evaluation, tmp_path):
    write_report(tmp_path / "report.html", [hostile_evaluation, hostile_evaluation])
    look_at(browser, tmp_path / "report.html")
    assert browser.evaluate("document.querySelector('h2').textContent").startswith(HOSTILE)
    assert browser.evaluate("document.querySelector('.legendtext').textContent").startswith(
        "2 <script>alert(1)</script>"
    )


@pytest.mark.slow
@pytest.mark.browser
def test_the_page_offers_no_upload_and_fits_a_narrow_window(browser, make_evaluation, tmp_path):
    write_report(tmp_path / "report.html", [make_evaluation(), make_evaluation(name="y" * 200)])
    browser.call("Emulation.setDeviceMetricsOverride", width=400, height=800, deviceScaleFactor=1, mobile=False)
    try:
        look_at(browser, tmp_path / "report.html")
        assert browser.evaluate("document.documentElement.scrollWidth") <= 400
    finally:
        browser.call("Emulation.clearDeviceMetricsOverride")
    buttons = browser.evaluate("[...document.querySelectorAll('.modebar-btn')].map(b => b.dataset.title).join()")
    assert "Download" in buttons
    assert "loud" not in buttons
