import numpy as np
import pytest

from flytune.report import envelope, plots


def test_the_response_follows_the_flight_and_marks_where_it_settled(make_evaluation, flights, task):
    late, nobody = flights.position.copy(), np.zeros(flights.trials, dtype=bool)
    late[:, 100:] = flights.target_position  # arrives after 1 s
    evaluation = make_evaluation(position=late, crashed=nobody)
    figure = plots.response(evaluation.flights, evaluation.judgement, task)
    curve = next(trace for trace in figure.data if trace.mode == "lines")
    assert curve.y == pytest.approx(late[0, :, 0])
    assert curve.dx == pytest.approx(0.01)
    dot = next(trace for trace in figure.data if trace.mode == "markers")
    assert dot.x == (evaluation.judgement.settling_time["x"][0],)


def test_a_long_flight_is_thinned_to_some_hundred_points_a_curve(make_evaluation, flights, task):
    def long(values):
        return np.repeat(values, 30, axis=1)

    evaluation = make_evaluation(
        time=np.arange(30 * flights.time.size) / 100,
        **{name: long(getattr(flights, name)) for name in ("position", "attitude", "velocity", "body_rate", "action")},
        margins={name: long(margin) for name, margin in flights.margins.items()},
    )
    curve = plots.response(evaluation.flights, evaluation.judgement, task).data[0]
    assert 500 <= len(curve.y) <= 600
    assert curve.dx * (len(curve.y) - 1) == pytest.approx(evaluation.flights.duration, abs=curve.dx)


def test_each_box_says_how_many_of_the_trials_it_holds(make_evaluation, flights):
    crashed = np.arange(flights.trials) < 2
    evaluation = make_evaluation(crashed=crashed)
    figure = plots.spread(evaluation.judgement)
    assert figure.layout.xaxis3.ticktext == ("x<br>10/12", "y<br>10/12", "z<br>10/12")
    assert figure.layout.xaxis.ticktext[0] == f"x<br>{evaluation.judgement.settled('x')}/12"


def test_the_share_of_settled_trials_ends_at_those_that_settled(make_evaluation, flights):
    position = flights.position.copy()
    position[:3] = flights.target_position  # three of twelve are there from the start
    position[3:, :, 0] = 1.0
    evaluation = make_evaluation(position=position, crashed=np.zeros(flights.trials, dtype=bool))
    line = plots.settled_share([evaluation.judgement]).data[0]
    assert line.y[-1] == pytest.approx(25)
    assert line.x[-1] == pytest.approx(evaluation.judgement.duration)


def test_margins_stand_in_order_of_tightness_and_count_the_crossings(make_evaluation, flights):
    loose, tight = np.full_like(flights.margins["speed"], 0.9), np.full_like(flights.margins["speed"], 0.1)
    tight[0] = -0.5
    evaluation = make_evaluation(margins={"loose": loose, "tight": tight})
    titles = [note.text for note in envelope.margins(evaluation.flights, evaluation.judgement).layout.annotations]
    assert titles == ["<b>tight</b><br>crossed in 1 of 12", "<b>loose</b><br>crossed in 0 of 12"]


def test_a_margin_that_is_not_finite_counts_as_the_worst(make_evaluation, flights):
    margin = np.full_like(flights.margins["speed"], 0.5)
    margin[0] = np.nan
    evaluation = make_evaluation(margins={"speed": margin})
    lowest, _, _, highest, median = (
        np.asarray(t.y) for t in envelope.margins(evaluation.flights, evaluation.judgement).data
    )
    assert np.isnan(lowest).all()
    assert highest == pytest.approx(50)
    assert median == pytest.approx(50)


def test_a_margin_beyond_all_of_the_bound_is_drawn_at_its_end(make_evaluation, flights):
    evaluation = make_evaluation(margins={"altitude": np.full_like(flights.margins["speed"], 7.0)})
    figure = envelope.margins(evaluation.flights, evaluation.judgement)
    assert all(np.asarray(trace.y) == pytest.approx(100) for trace in figure.data)
    assert figure.layout.yaxis.range == (-5, 102)


def test_the_motion_shows_tilt_rates_commands_and_speed_over_one_time(make_evaluation, flights):
    # a roll of 0.3 rad and no other turn: quaternion (sin 0.15, 0, 0, cos 0.15)
    attitude = np.broadcast_to([np.sin(0.15), 0, 0, np.cos(0.15)], flights.attitude.shape)
    evaluation = make_evaluation(attitude=attitude)
    figure = plots.motion(evaluation.flights, evaluation.judgement)
    axes = [figure.layout[f"yaxis{number if number > 1 else ''}"] for number in range(1, 11)]
    assert [axis.title.text.partition(" [")[0] for axis in axes] == [
        "roll", "motor 1", "pitch", "motor 2", "rate x", "motor 3", "rate y", "motor 4", "rate z", "speed"
    ]  # fmt: skip
    assert figure.data[0].y == pytest.approx(np.full(flights.time.size, np.degrees(0.3)), rel=1e-5)
    assert figure.data[5].y == pytest.approx(np.zeros(flights.time.size), abs=1e-5)  # pitch of the first trial
    assert figure.data[10].y == pytest.approx(np.degrees(flights.body_rate[0, :, 0]), rel=1e-5)


def test_the_flights_in_space_start_where_the_trials_start(make_evaluation, flights):
    figure = envelope.flights_3d(make_evaluation().flights)
    initial_conditions = [trace for trace in figure.data if (trace.name or "").startswith("start of")]
    assert len(initial_conditions) == 5
    for trace, position in zip(initial_conditions, flights.position, strict=False):
        assert (*trace.x, *trace.y, *trace.z) == pytest.approx(tuple(position[0]))
    assert figure.data[0].name == "7 more trials"
