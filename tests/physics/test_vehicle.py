"""Vehicles: what ships, the numbers that follow from theirs, and what is refused (paper R4, R5, R9)."""

import dataclasses
import math

import pytest

from flytune.config import document
from flytune.errors import BadInput
from flytune.physics.vehicle import Vehicle, load_vehicle, vehicle_names, vehicle_table


def refusal(**changes):
    """The error that the paper's vehicle with some fields changed is refused with."""
    with pytest.raises(BadInput) as caught:
        document.read(Vehicle, vehicle_table("crazyflie") | changes, where="mine.toml")
    text = str(caught.value)
    assert text.startswith("mine.toml: ") and "\n" not in text and " allowed" in text.lower()
    return text


def test_ten_vehicles_ship():
    crazyflies = [f"crazyflie{end}" for end in ("", "-b500", "-km794", "-l250", "-measured", "-p250", "-t350")]
    assert vehicle_names() == [*crazyflies, "hummingbird", "racer", "x500"]


@pytest.mark.parametrize("name", sorted(set(vehicle_names()) - {"crazyflie", "crazyflie-km794"}))
def test_full_action_is_full_thrust(name):
    # the papers' two fly with the paper's action scale (R9); the others to what their motors give
    vehicle = load_vehicle(name)
    full = vehicle.square_of_speed(vehicle.hover_rotor_speed_rpm * (1 + vehicle.action_scale)) / vehicle.hover_square
    motors = vehicle.square_of_speed(vehicle.top_rotor_speed_rpm) / vehicle.hover_square
    assert full == pytest.approx(motors, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "thrust", "lag"),
    [
        # thrust_max over m g / 4; rotor_dyn_coef [a, b, c, d]: 1 / (a + 2 b n), 1 / (c + 2 d n) at hover
        ("crazyflie-l250", 4 * 0.12 / (0.0319 * 9.81), (1 / 7.355624, 1 / (2 * 2.444386e-4 * 18967.8))),
        (
            "crazyflie-p250",
            4 * 0.12 / (0.0318 * 9.81),
            (1 / (5.172597 + 2 * 8.147742e-5 * 23191.8), 1 / (2 * 2.095253e-4 * 23191.8)),
        ),
        ("crazyflie-t350", 4 * 0.18 / (0.0379 * 9.81), (1 / 11.374753, 1 / (2 * 3.786769e-4 * 19041.0))),
        (
            "crazyflie-b500",
            4 * 0.2 / (0.04338 * 9.81),
            (1 / (13.996002 + 2 * 1.109321e-4 * 15896.3), 1 / (5.933169 + 2 * 3.195131e-4 * 15896.3)),
        ),
        ("racer", 4 * 8.5 / (0.752 * 9.81), (0.033, 0.033)),
        ("hummingbird", 4 * 5.57e-6 * 838**2 / (0.5 * 9.81), (0.0125, 0.025)),
        ("x500", 4 * 8.54858e-6 * 1000**2 / (2.0643077 * 9.81), (0.0125, 0.025)),
    ],
)
def test_thrust_to_weight_and_lag_are_those_of_the_published_numbers(name, thrust, lag):
    vehicle = load_vehicle(name)
    assert vehicle.full_thrust_to_weight == pytest.approx(thrust, rel=1e-3)
    assert (vehicle.motor_rise_time_constant, vehicle.motor_fall_time_constant) == pytest.approx(lag, rel=1e-3)


@pytest.mark.parametrize("name", vehicle_names())
def test_a_shipped_vehicle_has_a_source_for_every_number(name):
    vehicle = load_vehicle(name)
    assert vehicle.name == name
    assert sorted(vehicle.sources) == sorted(vehicle_table(name).keys() - {"name", "sources"})
    assert all(vehicle.sources.values())


def test_the_papers_vehicle_holds_the_papers_numbers():
    vehicle = load_vehicle("crazyflie")
    assert vehicle.mass == 0.033
    assert vehicle.inertia == (1.7108e-5, 1.7108e-5, 2.6517e-5)
    assert vehicle.arm == 39.73e-3
    assert vehicle.thrust_coefficient == 3.16e-10
    assert vehicle.torque_coefficient == 7.49e-12
    assert vehicle.propeller_radius == 23.1348e-3
    assert vehicle.drag == (0, 0, 0)
    assert vehicle.gravity == 9.81
    assert vehicle.action_scale == 0.5
    assert (vehicle.motor_rise_time_constant, vehicle.motor_fall_time_constant) == (0, 0)
    assert vehicle.action_latency_steps == 0


def test_the_variant_differs_in_its_torque_coefficient_alone():
    variant, paper = load_vehicle("crazyflie-km794"), load_vehicle("crazyflie")
    assert variant.torque_coefficient == 7.94e-12
    assert dataclasses.replace(variant, torque_coefficient=7.49e-12, name="", sources={}) == dataclasses.replace(
        paper, name="", sources={}
    )


def test_the_paper_hovers_at_about_16004_rpm():
    # sqrt(g m / 4 kf) = sqrt(9.81 * 0.033 / (4 * 3.16e-10)) = sqrt(2.56115e8) = 16,003.6
    assert load_vehicle("crazyflie").hover_rotor_speed_rpm == pytest.approx(16_003.6, abs=0.1)


def test_the_paper_flies_with_a_thrust_to_weight_of_2_25_and_the_measured_vehicle_with_1_48():
    # paper: (1 + 1/2)^2; measured: 4 * 0.12 N / (0.033 kg * 9.81 m/s^2) = 0.48 / 0.32373 = 1.4827 (C7)
    assert load_vehicle("crazyflie").full_thrust_to_weight == pytest.approx(2.25)
    assert load_vehicle("crazyflie-measured").full_thrust_to_weight == pytest.approx(1.4827, abs=1e-3)


def test_a_motor_limit_lowers_the_thrust_to_weight():
    limited = dataclasses.replace(load_vehicle("crazyflie"), maximum_rotor_speed_rpm=16_003.6 * 1.2)
    assert limited.full_thrust_to_weight == pytest.approx(1.44, abs=1e-4)


def test_the_lever_is_the_arm_over_root_two():
    assert load_vehicle("crazyflie").lever == pytest.approx(39.73e-3 / math.sqrt(2))
    assert load_vehicle("crazyflie-measured").lever == pytest.approx(0.03253, abs=1e-5)


@pytest.mark.parametrize(
    ("changes", "start"),
    [
        ({"mass": 0.0}, "mass: 0.0 is not allowed. Allowed: above 0"),
        ({"mass": -1.0}, "mass: -1.0 is not allowed"),
        ({"mass": math.nan}, "mass: nan is not allowed"),
        ({"mass": math.inf}, "mass: inf is not allowed"),
        ({"mass": "33 g"}, "mass: '33 g' is not allowed"),
        ({"mass": True}, "mass: True is not allowed"),
        ({"gravity": 0.0}, "gravity: 0.0 is not allowed"),
        ({"gravity": 981.0}, "gravity: 981.0 is not allowed. Allowed: 1 to 30 m/s^2 (the Moon has 1.6, the Earth 9.8,"),
        ({"action_scale": 3.5}, "action_scale: 3.5 is not allowed. Allowed: above 0 to 3 (at 3, full action gives 16"),
        ({"action_scale": 50.0}, "action_scale: 50.0 is not allowed."),
        (
            {"motor_fall_time_constant": 12.5},
            "motor_fall_time_constant: 12.5 is not allowed. Allowed: 0 to 1 s (motors",
        ),
        ({"rotor_drag": [0.0, 0.0, -1.0]}, "rotor_drag.2: -1.0 is not allowed. Allowed: 0 or more"),
        ({"rotor_drag": 1e-7}, "rotor_drag: 1e-07 is not allowed. Allowed: 3 values, each 0 or more kg/rad"),
        ({"mass": 1e-39}, "mass: 1e-39 is not allowed: numbers are single precision"),
        ({"drag": [0.0, 0.0, -1.0]}, "drag.2: -1.0 is not allowed. Allowed: 0 or more"),
        ({"drag": [0.0, 0.0]}, "drag"),
        ({"motor_rise_time_constant": -0.1}, "motor_rise_time_constant: -0.1 is not allowed"),
        ({"action_latency_steps": 21}, "action_latency_steps: 21 is not allowed. Allowed: a whole number, 0 to 20"),
        ({"action_latency_steps": 1.5}, "action_latency_steps: 1.5 is not allowed"),
        # hover takes 16,004 rpm
        ({"maximum_rotor_speed_rpm": 16_000.0}, "maximum_rotor_speed_rpm: 16000.0 cannot lift the vehicle. Allowed:"),
        # 3e-5 > 1e-5 + 1e-5: no body has its mass so far from one axis and so near to the others
        ({"inertia": [1e-5, 1e-5, 3e-5]}, "inertia: [1e-05, 1e-05, 3e-05] is no rigid body's"),
        ({"inertia": [0.0, 1e-5, 1e-5]}, "inertia.0: 0.0 is not allowed"),
    ],
)
def test_a_bad_number_is_refused_with_one_line_that_names_it(changes, start):
    assert refusal(**changes).removeprefix("mine.toml: ").startswith(start)


def test_an_unknown_key_is_refused_with_the_nearest_one():
    with pytest.raises(BadInput, match=r"^mas: no such field\. Did you mean mass \(now 0\.033, allowed: above 0\)\?$"):
        document.read(Vehicle, vehicle_table("crazyflie") | {"mas": 0.03})


def test_a_missing_number_is_named():
    table = vehicle_table("crazyflie")
    del table["arm"]
    with pytest.raises(BadInput, match=r"^arm: missing\. Allowed: above 0 m, or a table \[rotors\]"):
        document.read(Vehicle, table)


def test_an_unknown_vehicle_is_refused_with_the_nearest_name():
    with pytest.raises(BadInput, match=r"'crazyfly' is no vehicle.*Did you mean crazyflie\?$"):
        load_vehicle("crazyfly")


def test_a_missing_vehicle_file_is_refused(tmp_path):
    with pytest.raises(BadInput, match=r"mine\.toml: cannot be read \(No such file"):
        load_vehicle(str(tmp_path / "mine.toml"))


def test_a_vehicle_file_is_read_and_named_after_its_file(tmp_path):
    heavy = dataclasses.replace(load_vehicle("crazyflie"), name="heavy", mass=0.05)
    (tmp_path / "heavy.toml").write_text(document.write(heavy).replace('name = "heavy"\n', ""))
    assert load_vehicle(str(tmp_path / "heavy.toml")) == heavy
