"""Documents: assignments, edits, ranges in words, and text that is read back exactly."""

import tomllib
from typing import Annotated, Literal

import pytest
from annotated_types import Ge, Gt, Le, Lt, Unit
from hypothesis import given, settings
from hypothesis import strategies as st

from flytune.config import document
from flytune.config.document import Real, Vector, Whole
from flytune.config.pytree import label, pytree
from flytune.errors import BadInput


@pytree
class Wheel:
    """A part."""

    radius: Annotated[Real, Gt(0), Unit("m")]


@pytree
class Car:
    """A thing to be written and read."""

    name: str = label(default="car")
    mass: Annotated[Real, Ge(0), Unit("kg")]
    doors: Annotated[Whole, Ge(1), Le(5)]
    centre: Vector
    wheels: dict[str, Wheel]
    note: str | None = label(default=None)


CAR = Car(mass=900.0, doors=3, centre=(0.1, 0.0, 0.5), wheels={"left": Wheel(radius=0.3), "right": Wheel(radius=0.31)})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("reward.velocity.weight=0.08", ("reward.velocity.weight", 0.08)),
        (" horizon = 300", ("horizon", 300)),
        ("a=1e-3", ("a", 1e-3)),
        ("a=[1.0, 2.0]", ("a", [1.0, 2.0])),
        ("a=true", ("a", True)),
        ('a="text"', ("a", "text")),
        ("vehicle=crazyflie-measured", ("vehicle", "crazyflie-measured")),  # a bare word is text
        ("a={b = 1}", ("a", {"b": 1})),
        ("a=b=c", ("a", "b=c")),
        ("a=", ("a", "")),
    ],
)
def test_an_assignment_is_a_path_and_a_value_as_toml_reads_it(text, expected):
    path, value = document.parse_assignment(text)
    assert (path, value) == expected
    assert type(value) is type(expected[1])


@pytest.mark.parametrize("text", ["horizon", "=3", " = 3", ""])
def test_what_is_no_assignment_is_refused_with_an_example(text):
    with pytest.raises(BadInput, match=r"not an assignment\. Write path=value, for instance"):
        document.parse_assignment(text)


@pytest.mark.parametrize(
    ("annotation", "words"),
    [
        (Real, "a finite number"),
        (Whole, "a whole number"),
        (str, "text"),
        (bool, "true or false"),
        (Annotated[Real, Ge(0)], "0 or more"),
        (Annotated[Real, Gt(0)], "above 0"),
        (Annotated[Real, Le(1)], "1 or less"),
        (Annotated[Real, Lt(1)], "below 1"),
        (Annotated[Real, Ge(0), Le(1)], "0 to 1"),
        (Annotated[Real, Gt(0), Le(1)], "above 0 to 1"),
        (Annotated[Whole, Ge(1)], "a whole number, 1 or more"),
        (Literal["red", "green"], "one of red, green"),
        (Vector, "3 values, each a finite number"),
        (tuple[Annotated[Whole, Ge(1)], ...], "a list, each a whole number, 1 or more"),
        (Wheel, "a table"),
        (dict[str, Wheel], "a table"),
        (Annotated[Real, Ge(0)] | None, "0 or more"),
    ],
)
def test_a_range_is_said_in_words(annotation, words):
    assert document.allowed(annotation) == words


@pytest.mark.parametrize("lower", [Ge(0), Gt(0)])
def test_a_range_says_that_its_upper_end_is_left_out(lower):
    assert "below 1" in document.allowed(Annotated[Real, lower, Lt(1)])


def test_a_document_is_read_back_exactly():
    text = document.write(CAR)
    assert document.read(Car, tomllib.loads(text)) == CAR
    assert document.read(Car, document.plain(CAR)) == CAR


@pytest.mark.parametrize("locked", [True, False])
def test_a_yes_or_no_is_written_and_read_back(locked):
    @pytree
    class Door:
        locked: bool

    text = document.write(Door(locked=locked))
    assert f"locked = {str(locked).lower()} # true or false" in text
    assert document.read(Door, tomllib.loads(text)).locked is locked


@settings(max_examples=100)
@given(st.just(0.0) | st.floats(1e-30, 1e30))
def test_every_number_is_written_to_its_last_bit(mass):
    text = document.write(Car(mass=mass, doors=2, centre=(0.0, 0.0, 0.0), wheels={"left": Wheel(radius=0.3)}))
    assert document.read(Car, tomllib.loads(text)).mass == mass


def test_a_value_is_written_with_its_unit_range_and_the_nearest_source():
    text = document.write(
        CAR, {"wheels": "the shop", "wheels.right.radius": "measured", "mass": "the scales"}, "My car"
    )
    assert text.startswith("# My car\n")
    assert "mass = 900.0 # kg; 0 or more; the scales" in text
    assert "[wheels.left]\nradius = 0.3 # m; above 0; the shop" in text
    assert "[wheels.right]\nradius = 0.31 # m; above 0; measured" in text


def test_a_table_without_entries_is_read_back_too():
    bare = Car(mass=1.0, doors=1, centre=(0.0, 0.0, 0.0), wheels={})
    assert document.read(Car, tomllib.loads(document.write(bare))) == bare


def test_an_empty_optional_field_is_left_out():
    assert "note" not in document.plain(CAR)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": "heavy"}, "mass: 'heavy' is not allowed. Allowed: 0 or more kg."),
        ({"doors": 2.5}, "doors: 2.5 is not allowed. Allowed: a whole number, 1 to 5."),
        ({"doors": True}, "doors: True is not allowed. Allowed: a whole number, 1 to 5."),
        ({"doors": 6}, "doors: 6 is not allowed. Allowed: a whole number, 1 to 5."),
        ({"centre": [0.0, 0.0, float("nan")]}, "centre.2: nan is not allowed. Allowed: a finite number."),
        (
            {"centre": "0,0,1"},
            "centre: '0,0,1' is not allowed. Allowed: 3 values, each a finite number. For instance centre=[0,0,1].",
        ),
        (
            {"centre": [1.5, 2.0]},
            "centre: [1.5, 2.0] is not allowed. Allowed: 3 values, each a finite number. For "
            "instance centre=[1.5,2.0,0].",
        ),
        (
            {"centre": [1, 2, 3, 4]},
            "centre: [1, 2, 3, 4] is not allowed. Allowed: 3 values, each a finite number. For "
            "instance centre=[1,2,3].",
        ),
        (
            {"centre": 7},
            "centre: 7 is not allowed. Allowed: 3 values, each a finite number. For instance centre=[7,0,0].",
        ),
        ({"centre": "home"}, "centre: 'home' is not allowed. Allowed: 3 values, each a finite number."),
        ({"wheels_left_radius": 1.0}, "wheels_left_radius: no such field. Did you mean wheels.left.radius?"),
        (
            {"wheels": {"left": {"radius": 1.0}, "left_radius": 1.0}},
            "wheels.left_radius: 1.0 is not allowed. Allowed: a table. Did you mean wheels.left.radius?",
        ),
        ({"left-radius": 1.0}, "left-radius: no such field. Did you mean wheels.left.radius?"),
        ({"wheels": {"left": {"radius": 0}}}, "wheels.left.radius: 0 is not allowed. Allowed: above 0 m."),
        ({"wheels": {"left": {}}}, "wheels.left.radius: missing. Allowed: above 0 m."),
        (
            {"wheels": {"left": {"radus": 1.0}}},
            "wheels.left.radus: no such field. Did you mean wheels.left.radius (allowed: above 0)?",
        ),
        ({"colour": "red"}, "colour: no such field. Fields here: name, mass, doors, centre, wheels, note."),
    ],
)
def test_a_bad_value_is_refused_with_its_path_its_value_and_what_is_allowed(changes, message):
    with pytest.raises(BadInput) as caught:
        document.read(Car, document.plain(CAR) | changes, where="car.toml")
    assert str(caught.value) == f"car.toml: {message}"


def test_a_float_without_a_fraction_will_do_for_a_whole_number_and_becomes_one():
    doors = document.read(Car, document.plain(CAR) | {"doors": 4.0}).doors
    assert (doors, type(doors)) == (4, int)


def test_a_whole_number_will_do_for_a_real_one():
    assert document.read(Car, document.plain(CAR) | {"mass": 900}).mass == 900.0


def test_the_nearest_option_is_named_and_none_where_none_is_near():
    assert document.nearest("wieght", ["weight", "sharpness"]) == "weight"
    assert document.nearest("zzz", ["weight", "sharpness"]) is None


@pytest.mark.parametrize("name", ["rotor_directions", "zzz", "kf"])
def test_nothing_is_named_where_nothing_is_near(name):
    assert document.nearest(name, ["motor_rise_time_constant", "thrust_coefficient", "maximum_rotor_speed_rpm"]) is None


@pytest.mark.parametrize(
    ("name", "option"),
    [
        ("arm_length", "arm"),
        ("rotor_speed", "maximum_rotor_speed_rpm"),
        ("thrust_coeff", "thrust_coefficient"),
        ("motor_time_constant", "motor_rise_time_constant"),
    ],
)
def test_a_name_with_more_or_fewer_words_is_near(name, option):
    options = ["arm", "motor_rise_time_constant", "thrust_coefficient", "maximum_rotor_speed_rpm", "mass"]
    assert document.nearest(name, options) == option
