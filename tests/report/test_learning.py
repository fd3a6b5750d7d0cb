import numpy as np
import pytest

from flytune.report.learning import POINTS, ends_that_never_came, learning


def test_the_curve_draws_each_term_and_each_cause_that_came(curve):
    names = [trace.name for trace in learning(curve).data]
    assert names == ["total", "horizontal", "smoothness", "survival", "episode", "altitude", "speed"]


def test_causes_that_never_came_are_named(curve):
    assert ends_that_never_came(curve) == ["diverged"]
    assert ends_that_never_came(None) == []


def test_a_term_may_be_called_total(curve):
    rows = [row | {"terms": {"total": 0.25}} for row in curve]
    total, term = learning(rows).data[:2]
    assert total.y == pytest.approx([row["reward"] for row in rows])
    assert term.y == pytest.approx([0.25] * len(rows))


def test_a_null_is_a_gap_and_not_a_zero(curve):
    episode = next(trace for trace in learning(curve).data if trace.name == "episode")
    assert np.isnan(episode.y[:2]).all()
    assert episode.y[2] == pytest.approx(303)


def test_a_long_training_is_thinned_to_means_of_its_neighbours():
    # 1201 updates make 401 points of three updates: the first is the mean of 0, 1 and 2, the last holds 1200 alone
    rows = [{"steps": 10 * update, "reward": float(update)} for update in range(1201)]
    line = learning(rows).data[0]
    assert len(line.y) == 401 <= POINTS
    assert line.y[0] == pytest.approx(1.0)
    assert line.x[0] == pytest.approx(10.0)
    assert line.y[-1] == pytest.approx(1200.0)
