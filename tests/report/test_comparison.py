"""The page of a comparison: its numbers, its figures in the data and in a browser, and what it refuses."""

import dataclasses
import math

import numpy as np
import pytest
from tests.chromium import DRAWN, MISPLACED, assert_quiet
from tests.pages import HOSTILE, Reader

from flytune.errors import BadInput
from flytune.evaluation.comparison import compare
from flytune.evaluation.comparison_table import signed
from flytune.evaluation.difference import METRICS
from flytune.report import comparison_plots
from flytune.report.report import write_report


@pytest.fixture(scope="session")
def make_flown(make_evaluation, flights):
    """Factory of evaluations that fly the untrained flights, faster to the target the larger `haste` is."""

    def make(name, haste=0.0, **changes):
        pull = 1 - np.exp(-haste * flights.time)[:, None]
        position = flights.position + pull * (flights.target_position - flights.position)
        nobody = np.zeros(flights.trials, dtype=bool)
        return make_evaluation(**{"name": name, "position": position, "crashed": nobody, **changes})

    return make


@pytest.fixture(scope="session")
def six(make_flown, flights, task):
    """Six controllers: slow and fast ones, one that never settles, one that crashes at once, long and hostile names."""
    everything = np.ones(flights.trials, dtype=bool)
    flown = {"task": dataclasses.replace(task, name=HOSTILE)}
    return [
        make_flown("fast", 4.0, **flown),
        make_flown("slow-" * 12, 2.5, **flown),
        make_flown("never-" * 12, 0.0, **flown),
        make_flown("lost-" * 12, 4.0, crashed=everything, **flown),
        make_flown("runs/" + "long-" * 40, 5.0, **flown),
        make_flown(
            HOSTILE,
            3.0,
            **flown,
            margins={HOSTILE: flights.margins["speed"]},
            about={HOSTILE: HOSTILE},
        ),
    ]


@pytest.fixture
def read(tmp_path):
    """Writes the comparison of some evaluations and reads it."""

    def write_and_read(*evaluations, reference=0):
        judgements = [evaluation.judgement for evaluation in evaluations]
        write_report(tmp_path / "compare.html", evaluations, compare(judgements, reference=reference))
        return Reader((tmp_path / "compare.html").read_text())

    return write_and_read


# --- what the figures hold ---


def traces(figure, controller, mode):
    """The traces of a controller by its number, but for the evaluation of the legend."""
    group = str(controller - 1)
    found = [trace for trace in figure.data if trace.legendgroup == group and trace.mode == mode]
    return [trace for trace in found if trace.showlegend is False]


def test_the_same_trials_are_drawn_for_every_controller_and_the_error_of_all(make_flown, flights):
    evaluations = [make_flown("slow", 1.0), make_flown("fast", 3.0)]
    comparison = compare([evaluation.judgement for evaluation in evaluations])
    figure = comparison_plots.responses([evaluation.flights for evaluation in evaluations], comparison)
    for number, evaluation in enumerate(evaluations, start=1):
        trials, low, high, median = traces(figure, number, "lines")[:4]  # of x
        first = evaluation.flights.position[:3, :, 0]
        assert np.asarray(trials.y).reshape(3, -1)[:, :-1] == pytest.approx(first, abs=1e-6)
        ranked = np.sort(np.abs(evaluation.flights.position[:, :, 0] - flights.target_position[0]), axis=0)
        for trace, rank in ((low, 3), (median, 6), (high, 9)):  # ceil(0.25 * 12), ceil(0.5 * 12), ceil(0.75 * 12)
            floor = comparison_plots.FLOOR * 0.02
            assert np.asarray(trace.y) == pytest.approx(np.maximum(ranked[rank - 1], floor), rel=1e-5)


def test_a_crashed_trial_is_infinitely_far_and_ends_the_line_it_falls_on(make_flown, flights):
    most = np.arange(flights.trials) < 8  # the quarter of 12 is the 3rd and finite, the median the 6th and not
    evaluations = [make_flown("a", 1.0), make_flown("b", 1.0, crashed=most)]
    figure = comparison_plots.responses([e.flights for e in evaluations], compare([e.judgement for e in evaluations]))
    _, low, high, median = (np.asarray(trace.y) for trace in traces(figure, 2, "lines")[:4])
    assert np.isfinite(low).all()
    assert np.isnan(median).all() and np.isnan(high).all()


def test_the_dots_stand_at_the_differences_and_the_bars_at_their_intervals(make_flown):
    evaluations = [make_flown("slow", 1.0), make_flown("fast", 3.0)]
    comparison = compare([evaluation.judgement for evaluation in evaluations])
    figure = comparison_plots.paired(comparison)
    bars, dots = traces(figure, 2, "lines"), traces(figure, 2, "markers")
    assert len(bars) == len(dots) == len(comparison.differences) == len(METRICS)
    compared = 0
    for bar, dot, difference in zip(bars, dots, comparison.differences, strict=True):
        _, scale = difference.metric.shown
        if math.isfinite(difference.low + difference.median + difference.high):
            compared += 1
            assert bar.x == pytest.approx((difference.low * scale, difference.high * scale))
            assert dot.x == pytest.approx((difference.median * scale,))
    assert compared >= 8
    assert not traces(figure, 1, "markers")  # the reference has no difference from itself


@pytest.mark.parametrize(
    ("order", "symbol"), [(("fast", "never"), "triangle-right"), (("never", "fast"), "triangle-left")]
)
def test_an_infinite_median_is_a_triangle_at_the_edge_of_its_side(make_flown, order, symbol):
    controllers = {"fast": make_flown("fast", 5.0), "never": make_flown("never", 0.0)}
    figure = comparison_plots.paired(compare([controllers[name].judgement for name in order]))
    dot = traces(figure, 2, "markers")[0]
    assert dot.marker.symbol == symbol
    assert dot.x[0] == figure.layout.xaxis.range[symbol == "triangle-right"]


def test_every_controller_has_a_box_in_each_panel_over_the_number_of_its_trials(six):
    figure = comparison_plots.boxes(compare([evaluation.judgement for evaluation in six]))
    boxes = [trace for trace in figure.data if trace.type == "box"]
    assert len(boxes) == 6 * len(comparison_plots.BOXES)
    settled = [evaluation.judgement.settled("position") for evaluation in six]
    assert settled[0] == 12 and settled[2] == settled[3] == 0
    assert list(figure.layout.xaxis.ticktext) == [f"<b>{n}</b><br>{count}" for n, count in enumerate(settled, start=1)]
    assert [len(box.y) for box in boxes[:6]] == settled


def test_the_legend_names_each_controller_once_even_where_it_has_nothing_to_draw(six):
    comparison = compare([evaluation.judgement for evaluation in six])
    for figure, number in ((comparison_plots.boxes(comparison), 6), (comparison_plots.paired(comparison), 5)):
        named = [trace.name for trace in figure.data if trace.showlegend is not False]
        assert len(named) == len(set(named)) == number
        assert named[-1].startswith("<b>6</b> &lt;script&gt;")


# --- the page ---


def test_the_page_shows_the_table_the_words_and_every_difference(read, make_flown):
    evaluations = [make_flown("slow", 5.0), make_flown("fast", 8.0)]
    page = read(*evaluations)
    told = evaluations[1].judgement.to_dict()
    assert f"{told['position']['settling_time']['median']:.2f}" in page.text
    assert f"{told['position']['steady_state_error']['median'] * 1e3:.1f}" in page.text
    difference = compare([evaluation.judgement for evaluation in evaluations]).differences[0]
    assert f"fast settles {-difference.median:.2f} s earlier than slow" in page.text
    assert f"\N{MINUS SIGN}{-difference.median:.3g}" in page.text
    assert f"{difference.better} : {difference.worse}" in page.text
    assert "All were given the same task, number by number." in page.text
    kinds = [{trace["type"] for trace in figure["data"]} for figure in page.figures]
    assert kinds[:4] == [{"scatter"}, {"scatter"}, {"box", "scatter"}, {"scatter"}]


def test_the_reference_may_be_another_than_the_first(read, make_flown):
    page = read(make_flown("slow", 2.5), make_flown("fast", 4.0), reference=1)
    assert "slow does not settle where fast settles" in page.text
    assert "Each controller less the reference" in page.text and "2fast, trial by trial" in page.text


@pytest.mark.parametrize(("value", "text"), [(0.5, "+0.5"), (-0.25, "\N{MINUS SIGN}0.25"), (0.0, "0"),
    (math.inf, "+\N{INFINITY}"), (-math.inf, "\N{MINUS SIGN}\N{INFINITY}"), (math.nan, "-")])  # fmt: skip
def test_a_difference_is_written_with_its_sign(value, text):
    assert signed(value) == text


@pytest.mark.slow
def test_the_page_loads_nothing_from_the_network(read, six):
    page = read(*six)
    assert not {tag for tag, _ in page.elements} & {"link", "img", "iframe", "object", "embed", "base", "source"}
    for _, attributes in page.elements:
        assert "src" not in attributes
        assert attributes.get("href", "#").startswith("#")
    policy = next(attributes["content"] for tag, attributes in page.elements if "http-equiv" in attributes)
    assert policy.startswith("default-src 'none';")


@pytest.mark.slow
def test_names_that_are_markup_come_out_as_text(read, six):
    page = read(*six)
    assert len([tag for tag, _ in page.elements if tag == "script"]) == len(page.figures) + 2
    assert page.text.count(HOSTILE) >= 3  # table, every difference, about
    for figure in page.figures:
        assert all("<script" not in (trace.get("name") or "") for trace in figure["data"])


def test_every_link_leads_to_one_place_on_the_page(read, make_flown):
    page = read(make_flown("a", 1.0), make_flown("b", 2.0))
    places = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    links = [attributes["href"][1:] for _, attributes in page.elements if "href" in attributes]
    assert len(links) == len(set(links)) == 7 + 2 + 2 * 8
    assert sorted([*links, "plotly"]) == sorted(places)  # the last is the packed plotly.js


def test_flights_that_start_elsewhere_are_refused(make_flown, flights, tmp_path):
    moved = flights.position.copy()
    moved[3, 0, 1] += 0.01
    evaluations = [make_flown("a"), make_flown("b", position=moved)]
    with pytest.raises(BadInput, match=r"^starts: b starts elsewhere, seen from its target, than a") as error:
        write_report(
            tmp_path / "compare.html", evaluations, compare([evaluation.judgement for evaluation in evaluations])
        )
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_evaluations_that_are_not_those_of_the_comparison_are_refused(make_flown, tmp_path):
    evaluations = [make_flown("a"), make_flown("b")]
    with pytest.raises(BadInput, match=r"^compare: 1 controllers are not allowed"):
        write_report(
            tmp_path / "x.html", evaluations[:1], compare([evaluation.judgement for evaluation in evaluations])
        )


def test_a_place_that_cannot_be_written_is_refused(make_flown, tmp_path):
    evaluations = [make_flown("a"), make_flown("b")]
    with pytest.raises(BadInput, match="no folder"):
        write_report(
            tmp_path / "no" / "x.html", evaluations, compare([evaluation.judgement for evaluation in evaluations])
        )


# --- a browser ---


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.parametrize(("controllers", "width"), [(2, 1200), (6, 900), (6, 400)])
def test_a_browser_draws_every_figure_with_nothing_misplaced(browser, six, tmp_path, controllers, width):
    evaluations = six[:controllers]
    page = tmp_path / "compare.html"
    write_report(page, evaluations, compare([evaluation.judgement for evaluation in evaluations]))
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
    try:
        browser.open(page)
        for index in range(4):
            plot = f"document.querySelectorAll('.figure > div')[{index}]"
            browser.evaluate(f"{plot}.scrollIntoView()")
            browser.wait_for(f"{plot}.querySelector('.main-svg')?.getBoundingClientRect().width > 300")
            assert browser.evaluate(DRAWN % index) > 0, f"figure {index} is empty"
            assert browser.evaluate(MISPLACED % index) == [], f"figure {index}"
        assert browser.evaluate("document.querySelectorAll('.figure > div').length") >= 4
        assert browser.evaluate("document.documentElement.scrollWidth") <= width
    finally:
        browser.call("Emulation.clearDeviceMetricsOverride")
    assert_quiet(browser)
