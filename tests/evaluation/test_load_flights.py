"""Flights from files: those that flytune wrote, to the same numbers, and logs of every kind, or one line that helps."""

import json
import re

import numpy as np
import pytest
from tests.evaluation.logs import TIME, course, flown, plain, written

import flytune
from flytune.errors import BadInput
from flytune.evaluation.judge import judge
from flytune.evaluation.load_flights import load_flights

TARGET = (0.0, 0.0, 1.0, 0.0)
X, Y, Z, YAW = flown()
QUATERNION = (0 * YAW, 0 * YAW, np.sin(YAW / 2), np.cos(YAW / 2))
AXES = ("x", "y", "z", "yaw")


@pytest.fixture(scope="module")
def expected():
    """The numbers of the flight in all logs, from its arrays."""
    position = np.stack([X, Y, Z], axis=-1)
    return numbers(judge(flytune.flights_from(TIME, position, yaw=YAW, target_position=TARGET[:3])))


def numbers(judgement):
    judged = judgement.to_dict()
    return {channel: judged["axes"].get(channel, judged["position"]) for channel in (*AXES, "position")}


def assert_same(found, expected, settling=1e-9, rest=1e-6):
    for channel, values in expected.items():
        for name, quantiles in values.items():
            if isinstance(quantiles, dict):
                got, wanted = [each["median"] for each in (found[channel][name], quantiles)]
                tolerance = settling if "time" in name else rest
                assert got == pytest.approx(wanted, abs=tolerance), (channel, name)


SETTINGS = [
    ("lqr", None, {"trials": 3, "initial_conditions": "paper"}),
    ("baseline-refined", "acrobatic", {"trials": 3, "duration": 3.7, "seed": 5}),
    ("dial", None, {"trials": 2, "dial": {"speed": [[0.0, 0.3], [2.0, 1.0]]}, "duration": 4.0}),
    ("pid", "baseline", {"trials": 30, "duration": 1.0}),
]


@pytest.mark.parametrize(("who", "task", "settings"), SETTINGS, ids=[each[0] for each in SETTINGS])
def test_flights_of_an_evaluation_are_judged_again_to_exactly_the_same_object(tmp_path, who, task, settings):
    evaluation = flytune.evaluate(who, task, **settings)
    evaluation.flights.save(tmp_path / "f.npz")
    again = judge(load_flights(tmp_path / "f.npz"))
    assert json.dumps(again.to_dict()) == json.dumps(evaluation.judgement.to_dict())
    assert str(again) == str(evaluation.judgement)


def test_a_crashed_flight_without_finite_numbers_and_one_without_a_speed_bound_are_read_as_they_were(
    tmp_path, make_flights
):
    error = np.zeros((2, 1001, 3))
    error[1, 500:] = np.nan
    flights = make_flights(
        error, crashed=np.array([False, True]), speed_bound=None, dial={"speed": 0.5}, made_for="other"
    )
    flights.save(tmp_path / "f.npz")
    again = load_flights(tmp_path / "f.npz")
    assert judge(again).to_dict() == judge(flights).to_dict()
    assert again.speed_bound is None and again.made_for == "other" and again.dial == {"speed": 0.5}


LAYOUTS = {
    "plain": ("t,x,y,z,yaw", [TIME, X, Y, Z, YAW], {}),
    "pos_x": ("time,pos_x,pos_y,pos_z,psi", [TIME, X, Y, Z, YAW], {}),
    "crazyflie": (
        "Timestamp,stateEstimate.x,stateEstimate.y,stateEstimate.z,stateEstimate.roll,stateEstimate.yaw",
        [123456 + TIME * 1e3, X, Y, Z, 0 * X, np.degrees(YAW)],
        {},
    ),
    "crazyflie in mm": (
        "timestamp,stateEstimateZ.x,stateEstimateZ.y,stateEstimateZ.z,stabilizer.yaw",
        [TIME * 1e3, X * 1e3, Y * 1e3, Z * 1e3, np.degrees(YAW)],
        {},
    ),
    "kalman": (
        "timestamp,kalman.stateX,kalman.stateY,kalman.stateZ,kalman.q0,kalman.q1,kalman.q2,kalman.q3",
        [TIME * 1e3, X, Y, Z, QUATERNION[3], *QUATERNION[:3]],
        {},
    ),
    "px4": (
        "timestamp,timestamp_sample,delta_xy[0],x,y,z,vx,vy,vz,heading,xy_valid,ref_timestamp,heading_reset_counter",
        [1.6e9 + TIME * 1e6, TIME * 1e6, 0 * X, X, -Y, -Z, 0 * X, 0 * X, 0 * X, -YAW, 1 + 0 * X, 0 * X, 0 * X],
        {},
    ),
    "px4 odometry": (
        "timestamp,timestamp_sample,pose_frame,position[0],position[1],position[2],q[0],q[1],q[2],q[3]",
        [1.6e9 + TIME * 1e6, TIME * 1e6, 1 + 0 * X, X, -Y, -Z, QUATERNION[3], 0 * X, 0 * X, -QUATERNION[2]],
        {},
    ),
    "ros": (
        "%time,field.header.seq,field.header.stamp,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
        "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w",
        [1.7e18 + TIME * 1e9, TIME, TIME, X, Y, Z, *QUATERNION],
        {},
    ),
    "units in brackets": ("time [s];x [mm];y (cm);z[m];yaw (°)",
                          [TIME, X * 1e3, Y * 1e2, Z, np.degrees(YAW)], {"delimiter": ";"}),
    "units in names": ("time_us\tx_mm\ty_mm\tz_mm\tyaw_deg",
                       [TIME * 1e6, X * 1e3, Y * 1e3, Z * 1e3, np.degrees(YAW)], {"delimiter": "\t"}),
    "units in a row": ("t,x,y,z,yaw\nms,mm,mm,mm,deg", [TIME * 1e3, X * 1e3, Y * 1e3, Z * 1e3, np.degrees(YAW)], {}),
    "decimal commas": ("t;x;y;z;yaw", [TIME, X, Y, Z, YAW], {"delimiter": ";", "decimal": ","}),
    "a spreadsheet": ("t;x;y;z;yaw", [TIME, X, Y, Z, YAW],
                      {"delimiter": ";", "decimal": ",", "before": "sep=;\n", "encoding": "utf-16"}),
    "byte order mark": ("t,x,y,z,yaw", [TIME, X, Y, Z, YAW], {"encoding": "utf-8-sig"}),
    "latin-1": ("t,x,y,z,yaw [°]", [TIME, X, Y, Z, np.degrees(YAW)], {"encoding": "latin-1"}),
    "comments": ("t,x,y,z,yaw", [TIME, X, Y, Z, YAW], {"before": "# made by hand\n\n# on a Tuesday\n"}),
    "savetxt": ("# t x y z yaw", [TIME, X, Y, Z, YAW], {"delimiter": " "}),
    "columns of text beside": ("mode,t,x,y,z,yaw", [TIME, TIME, X, Y, Z, YAW], {}),
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_same_flight_in_every_layout_is_judged_to_the_same_numbers(tmp_path, expected, layout):
    header, columns, options = LAYOUTS[layout]
    path = written(tmp_path / "log.csv", header, *columns, **options)
    if layout == "columns of text beside":
        lines = (tmp_path / "log.csv").read_text().splitlines()
        modes = [f"hover,{line.partition(',')[2]}" for line in lines[1:]]
        (tmp_path / "log.csv").write_text("\n".join([lines[0], *modes]))
    told = []
    found = judge(load_flights(path, target=TARGET, on_message=told.append))
    assert_same(numbers(found), expected)
    assert found.to_dict()["action"] == {"rms": None, "total_variation": None}
    assert found.to_dict()["efficiency"] == {"median": None} and found.to_dict()["seed"] is None
    assert found.to_dict()["peak_speed"]["median"] == (0.0 if layout == "px4" else None)
    assert "x = " in told[0] and "rows" in told[0]  # what was taken is said


GIVEN = {
    "no header": ("", {"time": "col1", "x": "col2", "y": "col3", "z": "col4", "yaw": "col5"}, [TIME, X, Y, Z, YAW]),
    "names and signs": (
        "clock,north,east,down,nose",
        {"time": "clock[ms]", "x": "north[mm]", "y": "-east[mm]", "z": "-down[mm]", "yaw": "-nose[deg]"},
        [TIME * 1e3, X * 1e3, -Y * 1e3, -Z * 1e3, -np.degrees(YAW)],
    ),
    "degrees without a unit": ("t,x,y,z,yaw", {"yaw": "yaw[deg]"}, [TIME, X, Y, Z, np.degrees(YAW)]),
}


@pytest.mark.parametrize("layout", GIVEN)
def test_columns_that_are_given_are_taken(tmp_path, expected, layout):
    header, columns, values = GIVEN[layout]
    found = judge(load_flights(written(tmp_path / "log.csv", header, *values), columns=columns, target=TARGET))
    assert_same(numbers(found), expected)


def test_a_constant_stands_for_a_column_that_a_log_lacks(tmp_path, expected):
    path = written(tmp_path / "log.csv", "t,x,y,z", TIME, X, Y, Z)
    found = numbers(judge(load_flights(path, columns={"yaw": "0"}, target=TARGET)))
    assert found["yaw"]["settling_time"]["median"] == 0
    assert_same({name: found[name] for name in "xyz"}, {name: expected[name] for name in "xyz"})


@pytest.mark.parametrize("rate", [10, 47, 250, 1000])
def test_another_rate_gives_the_same_numbers_within_the_error_that_is_told(tmp_path, expected, rate):
    time = np.arange(0, 8 + 1e-9, 1 / rate)
    told = []
    found = numbers(judge(load_flights(plain(tmp_path / "log.csv", time), target=TARGET, on_message=told.append)))
    (line,) = [line for line in told if "error at most" in line]
    error = float(re.search(r"error at most about ([\d.e+-]+) mm", line)[1]) * 1e-3
    assert 0 < error < 0.5 * 6.25 / rate**2  # h^2 / 8 times the largest acceleration, 2.5^2 m/s^2
    slope = 0.02 * 2.5  # m/s where the error enters the band: its decay
    assert found["x"]["settling_time"]["median"] == pytest.approx(
        expected["x"]["settling_time"]["median"], abs=0.011 + error / slope
    )


def test_irregular_samples_with_doubled_ones_and_empty_cells_give_the_same_numbers(tmp_path, expected):
    generator = np.random.default_rng(0)
    time = np.sort(np.concatenate([[0.0, 8.0], generator.uniform(0, 8, 800)]))
    time = np.repeat(time, 1 + (np.arange(time.size) % 50 == 7))
    x, y, z, yaw = (np.array(values) for values in flown(time))
    for values in (x, yaw):
        values[generator.choice(np.arange(1, time.size - 1), 40, replace=False)] = np.nan
    path = written(tmp_path / "log.csv", "t,x,y,z,yaw", time, x, y, z, yaw)
    told = []
    found = numbers(judge(load_flights(path, target=TARGET, on_message=told.append)))
    assert_same(found, expected, settling=0.011, rest=2e-3)
    assert any("40 of" in line for line in told) and any("has the same time" in line for line in told)


def test_a_heading_and_a_quaternion_turn_the_short_way_between_two_samples(tmp_path):
    time = np.arange(0, 8, 0.05)
    yaw = (np.pi + 0.3 * np.sin(time) + np.pi) % (2 * np.pi) - np.pi  # jumps between -pi and pi
    still = (0 * time, 0 * time, 1 + 0 * time)
    by_angle = written(tmp_path / "a.csv", "t,x,y,z,yaw", time, *still, yaw)
    half = yaw / 2
    quaternion = (0 * half, 0 * half, np.sin(half), np.cos(half))
    by_quaternion = written(tmp_path / "q.csv", "t,x,y,z,qx,qy,qz,qw", time, *still, *quaternion)
    for path in (by_angle, by_quaternion):
        flights = load_flights(path, target=(0, 0, 1, np.pi))
        x, y, z, w = np.moveaxis(flights.attitude[0], -1, 0)
        found = np.arctan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)
        wanted = np.pi + 0.3 * np.sin(flights.time)
        off = (found - wanted + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(off).max() < 0.3 * 0.05**2 / 8 * 1.1


def stepping(path, instants, time=TIME):
    """A log whose target goes to and fro between x = 0 and x = 1, and a vehicle that follows."""
    target = np.sum([np.where(time >= each, (-1) ** number, 0) for number, each in enumerate(instants)], axis=0) * 1.0
    x = np.sum([(-1) ** n * (1 - course(time, each)) for n, each in enumerate(instants)], axis=0)
    zero = 0 * time
    header = "t,x,y,z,yaw,target_x,target_y,target_z,target_yaw"
    return written(path, header, time, x, zero, 1 + zero, zero, target, zero, 1 + zero, zero)


def test_a_late_step_begins_where_the_target_changes_or_where_the_user_says(tmp_path, expected):
    path = stepping(tmp_path / "late.csv", [2.0])
    wanted = expected["x"]["settling_time"]["median"]
    judged = judge(load_flights(path))
    assert judged.duration == 6.0 and judged.to_dict()["axes"]["x"]["settling_time"]["median"] == pytest.approx(wanted)
    later = judge(load_flights(path, start=2.5)).to_dict()["axes"]["x"]["settling_time"]["median"]
    assert later == pytest.approx(wanted - 0.5)
    alone = judge(load_flights(path, target=(1, 0, 1, 0), start=2.0))
    assert alone.to_dict()["axes"]["x"] == judged.to_dict()["axes"]["x"]


def test_of_several_steps_one_is_chosen_by_its_start_and_ends_at_the_next(tmp_path):
    path = stepping(tmp_path / "steps.csv", [1.0, 4.0, 6.5])
    with pytest.raises(
        BadInput, match=r"changes 3 times, 1\.00, 4\.00, 6\.50 s after .* for instance --start 1\.00; it ends"
    ):
        load_flights(path)
    first = load_flights(path, start=1.0)
    assert (first.duration, first.target_position.tolist()) == (2.99, [1.0, 0.0, 1.0])
    second = load_flights(path, start=4.0)
    assert second.target_position.tolist() == [0.0, 0.0, 1.0] and second.position[0, 0, 0] > 0.98


def test_several_files_or_a_column_of_trials_are_several_flights_cut_to_the_shortest(tmp_path):
    first, short = plain(tmp_path / "a.csv"), plain(tmp_path / "b.csv", TIME[:500])
    told = []
    files = load_flights(first, short, target=TARGET, on_message=told.append)
    assert files.trials == 2 and files.duration == 4.99 and "cut to the shortest, 4.99 s" in told[-1]
    both = np.concatenate([TIME, TIME])
    columns = [np.repeat([3.0, 1.0], TIME.size), both, *(np.tile(each, 2) for each in (X, Y, Z, YAW))]
    trials = load_flights(written(tmp_path / "t.csv", "trial,t,x,y,z,yaw", *columns), target=TARGET)
    assert trials.trials == 2 and trials.duration == 8.0
    assert judge(trials).settling_time["x"].tolist() == [judge(files).settling_time["x"][0]] * 2


@pytest.mark.parametrize(
    ("move", "target", "said"), [(0.0, (1, 0, 1, 0), "never moves"), (1e-3, TARGET, "within 2 cm of its target")]
)
def test_a_flight_without_a_step_is_judged_and_named(tmp_path, move, target, said):
    zero, told = 0 * TIME, []
    path = written(tmp_path / "log.csv", "t,x,y,z,yaw", TIME, move * np.sin(TIME), zero, 1 + zero, zero)
    judged = judge(load_flights(path, target=target, on_message=told.append))
    assert any(said in line for line in told)
    assert judged.settled("position") == (0 if target[0] else 1)


def test_arrays_of_a_users_own_are_judged_and_a_log_that_was_saved_too(tmp_path, expected):
    position = np.stack([X, Y, Z], axis=-1)
    np.savez(tmp_path / "own.npz", time=TIME + 5, position=position, yaw=YAW, target_position=TARGET[:3])
    flights = load_flights(tmp_path / "own.npz")
    assert_same(numbers(judge(flights)), expected)
    flights.save(tmp_path / "saved.npz")
    again = load_flights(tmp_path / "saved.npz")
    assert again.missing == flights.missing == ("velocity", "body_rate", "rotor_speed_rpm", "action")
    assert_same(numbers(judge(again)), expected, rest=1e-5)
    several = {"position": np.stack([position] * 3), "attitude": np.stack([np.stack(QUATERNION, axis=-1)] * 3)}
    np.savez(tmp_path / "three.npz", time=TIME, **several, velocity=several["position"], target_position=TARGET[:3])
    assert judge(load_flights(tmp_path / "three.npz")).peak_speed.shape == (3,)


def test_a_position_that_becomes_infinite_is_a_crash_and_one_that_ends_before_the_log_ends_the_flight(tmp_path):
    for value, crashed, duration in ((np.inf, [True], 8.0), (np.nan, [False], 5.99)):
        x, told = np.where(TIME >= 6, value, X), []
        path = written(tmp_path / "log.csv", "t,x,y,z,yaw", TIME, x, Y, Z, YAW)
        judged = judge(load_flights(path, target=TARGET, on_message=told.append))
        assert judged.crashed.tolist() == crashed and judged.duration == pytest.approx(duration)
        assert judged.settled("position") == (0 if crashed[0] else 1)
        assert any("infinite from 6.00 s on" in line for line in told) == crashed[0]
    path = written(tmp_path / "log.csv", "t,x,y,z,yaw", TIME, np.nan * X, Y, Z, YAW)
    with pytest.raises(BadInput, match="has no position"):
        load_flights(path, target=TARGET)
