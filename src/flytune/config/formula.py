"""Formulas: numbers that follow other numbers, written in a file as text, for instance `1.5 * max(speed ** -1.3, 0.7)`.

A formula is read once into a small tree and never executed as Python. It computes with plain numbers or inside compiled
code.
"""

import ast
import math
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from pydantic_core import core_schema

T = TypeVar("T")
LONGEST, DEEPEST = 200, 20  # characters, and operations inside each other: files may come from anyone
OPERATORS: dict[type, str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}
FUNCTIONS = {"min": 2, "max": 2, "exp": 1, "log": 1, "sqrt": 1}  # name -> number of arguments
ALLOWED = f"numbers, names of dials, + - * / **, {', '.join(FUNCTIONS)} and parentheses"


class Formula(str):
    """The text of a formula; part of the structure of a task, so that another formula compiles another program."""

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> core_schema.CoreSchema:
        return core_schema.no_info_after_validator_function(cls, core_schema.str_schema(strict=True))

    def names(self) -> set[str]:
        """The names that the formula depends on.

        Raises:
            ValueError: it is not a formula; the text says why.
        """
        found: set[str] = set()
        _walk(_parse(self), lambda name: found.add(name) or 1.0, lambda operation, *values: 1.0)
        return found

    def value(self, numbers: Mapping[str, Any]) -> Any:
        """The value where each name has a number, of Python or of JAX.

        A power whose exponent is written as a whole number is a product. Any other is computed as exp(b log a), so its
        base has to be positive.

        Raises:
            ValueError: it is not a formula, or a name has no number.
            ArithmeticError: of plain numbers, a division by zero or a result that is too large.
        """
        plain = all(isinstance(number, int | float) for number in numbers.values())

        def number(name: str) -> Any:
            if name not in numbers:
                raise ValueError(f"{name} is unknown, allowed: {', '.join(numbers)}")
            return numbers[name]

        return _walk(_parse(self), number, _plain if plain else _traced)

    def build(self, number: Callable[[str], T], operation: Callable[..., T], constant: Callable[[float], T]) -> T:
        """The value in another language, for instance a node of a graph.

        Args:
            number: the value of a name.
            operation: of a name in `OPERATORS` or `FUNCTIONS` and values.
            constant: the value of a number.

        Raises:
            ValueError: it is not a formula.
        """
        return _walk(_parse(self), number, operation, constant)


def _parse(text: str) -> ast.expr:
    if len(text) > LONGEST:
        raise ValueError(f"it has {len(text)} characters, allowed: {LONGEST}")
    try:
        return ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        raise ValueError(f"it is not a formula, allowed: {ALLOWED}") from None


def _walk(
    node: ast.expr,
    number: Callable[[str], Any],
    apply: Callable[..., Any],
    constant: Callable[[float], Any] = float,
    depth: int = 0,
) -> Any:
    """The value of a tree, where `number` gives that of a name and `apply` that of an operation."""
    if depth > DEEPEST:
        raise ValueError(f"more than {DEEPEST} operations lie inside each other")

    def inner(child: ast.expr) -> Any:
        return _walk(child, number, apply, constant, depth + 1)

    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool) and math.isfinite(value):
            return constant(float(value))
        case ast.Name(id=name):
            return number(name)
        case ast.BinOp(left=left, op=ast.Pow(), right=right) if _whole(right) is None:
            return apply("exp", apply("*", inner(right), apply("log", inner(left))))
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            return apply("**", inner(left), constant(float(_whole(right) or 0)))
        case ast.BinOp(left=left, op=operator, right=right) if type(operator) in OPERATORS:
            return apply(OPERATORS[type(operator)], inner(left), inner(right))
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return apply("-", constant(0.0), inner(operand))
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if FUNCTIONS.get(name) == len(arguments):
            return apply(name, *map(inner, arguments))
    raise ValueError(f"{ast.unparse(node)} is not allowed, allowed: {ALLOWED}")


def _whole(exponent: ast.expr) -> int | None:
    """The exponent where it is written as a whole number of at most 16, also a negative one; else None."""
    match exponent:
        case ast.UnaryOp(op=ast.USub(), operand=operand) if (positive := _whole(operand)) is not None:
            return -positive
        case ast.Constant(value=int() | float() as value) if float(value).is_integer() and abs(value) <= 16:
            return int(value)
    return None


def _plain(operation: str, *values: float) -> float:
    result = _compute(operation, values, math)
    if not math.isfinite(result):
        raise OverflowError("the result is too large")
    return result


def _traced(operation: str, *values: Any) -> Any:
    import jax.numpy as jnp

    return _compute(operation, values, jnp)


def _compute(operation: str, values: tuple[Any, ...], library: Any) -> Any:
    match operation:
        case "+":
            return values[0] + values[1]
        case "-":
            return values[0] - values[1]
        case "*":
            return values[0] * values[1]
        case "/":
            return values[0] / values[1]
        case "**":
            return values[0] ** int(values[1])
        case "min" | "max":
            if library is math:
                return (min if operation == "min" else max)(values)
            return (library.minimum if operation == "min" else library.maximum)(*values)
        case _:
            return getattr(library, operation)(values[0])
