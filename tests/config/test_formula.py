"""Formulas: what they compute, with numbers and inside compiled code, and what they refuse."""

import math

import jax
import jax.numpy as jnp
import pytest

from flytune.config.formula import Formula


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2", 2.0),
        ("speed", 0.4),
        ("-speed + 1", 0.6),
        ("1 - 2 - 3", -4.0),
        ("2 * speed / 4", 0.2),
        ("(speed / 0.8) ** -2", 4.0),
        ("2 ** 3 ** 2", 512.0),  # as in mathematics, from the right
        ("(speed - 1) ** 2", 0.36),
        ("(speed - speed) ** 2 + (speed - 1) ** 3", -0.216),
        ("max(speed, 0.7) + min(speed, 0.1)", 0.8),
        ("exp(log(speed))", 0.4),
        ("sqrt(damping)", 3.0),
    ],
)
def test_a_formula_has_the_value_of_mathematics_in_python_and_in_jax(text, value):
    numbers = {"speed": 0.4, "damping": 9.0}
    assert Formula(text).value(numbers) == pytest.approx(value, rel=1e-12)
    compiled = jax.jit(lambda numbers: Formula(text).value(numbers))({k: jnp.asarray(v) for k, v in numbers.items()})
    assert float(compiled) == pytest.approx(value, rel=1e-5)


def test_a_formula_says_what_it_depends_on():
    assert Formula("1.5 * max((speed / 0.8) ** -1.3, damping)").names() == {"speed", "damping"}
    assert Formula("2 + 3").names() == set()


@pytest.mark.parametrize(
    "text",
    ["", "True", "speed +", "speed if 1 else 2", "speed.real", "__import__('os')", "open(1)", "max(1)", "exp(1, 2)",
     "'a'",      "speed == 1", "[speed]", "lambda: 1", "1e999", "speed[0]", "max(a=1, b=2)", "x := 1", "1j", "a" * 300,
     "(" * 50 + "1" + ")" * 50 + "+1" * 80],
)  # fmt: skip
def test_text_that_is_no_formula_is_refused(text):
    with pytest.raises(ValueError, match=r"allowed|lie inside|characters"):
        Formula(text).names()


def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match="height is unknown, allowed: speed"):
        Formula("height").value({"speed": 1.0})


@pytest.mark.parametrize("text", ["1 / speed", "log(speed)", "speed ** -1", "exp(1000 + speed)", "sqrt(speed - 1)"])
def test_plain_numbers_without_a_result_are_an_error(text):
    with pytest.raises((ArithmeticError, ValueError)):
        Formula(text).value({"speed": 0.0})


def test_a_formula_can_be_written_in_another_language():
    text = Formula("-2 * max(speed, 1) ** 0.5").build(
        number=str, operation=lambda name, *values: f"{name}({', '.join(values)})", constant=str
    )
    assert text == "*(-(0.0, 2.0), exp(*(0.5, log(max(speed, 1.0)))))"


def test_the_gradient_of_a_formula_is_that_of_mathematics():
    slope = jax.grad(lambda speed: Formula("speed ** 3").value({"speed": speed}))(jnp.asarray(2.0))
    assert float(slope) == pytest.approx(3 * 2.0**2, rel=1e-5)
    assert math.isfinite(float(slope))


def test_a_power_means_the_same_in_python_and_in_compiled_code():
    # written as a whole number, it is a product, whatever the sign of the base; a dial as the exponent never is
    assert Formula("(a - 2) ** -3").value({"a": 1.0}) == -1.0
    assert float(Formula("(a - 2) ** -3").value({"a": jnp.asarray(1.0)})) == -1.0
    with pytest.raises(ValueError, match="math domain"):
        Formula("(a - 2) ** b").value({"a": 1.0, "b": 2.0})
    assert math.isnan(float(Formula("(a - 2) ** b").value({"a": jnp.asarray(1.0), "b": jnp.asarray(2.0)})))
    assert Formula("a ** b").value({"a": 3.0, "b": 2.0}) == pytest.approx(9.0)
