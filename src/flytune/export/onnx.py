"""Policies as ONNX files: `save_onnx` writes them, `load_onnx` reads them.

The graph has one input `observation`, float32 [batch, 17], and one output `action`, float32 [batch, 4] in [-1, 1]. A
policy with dials has a second input `dial`, float32 [batch, dials], in the order of their names. The graph contains the
scaling of the observation and the squashing of the action. The metadata says what the numbers mean, and for which task
and vehicle the policy was trained.
"""

import itertools
import json
import math
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from flytune.config import document
from flytune.config.files import write_bytes
from flytune.control.policy import CONVENTIONS, Policy, conventions, limited
from flytune.errors import BadInput, require
from flytune.export.untrusted.onnx_controller import OnnxController, load_onnx, read_onnx, sample_observations
from flytune.export.untrusted.onnx_inspection import DIAL_INPUT, DIALS, FORMAT, INPUT, OUTPUT, VERSION
from flytune.task.dial import Dial, told
from flytune.task.observation import SIZE

__all__ = ["CONVENTIONS", "OnnxController", "check_actions", "load_onnx", "rounding_bound", "save_onnx"]

# From December 2020: onnxruntime 1.6 and every later version read it, and no operator of the graph has changed since.
OPERATOR_SET, INTERMEDIATE_REPRESENTATION = 13, 7
CHECKED = 10_000  # observations for which the file must give the actions of the policy
UNIT_ROUNDOFF = 2.0**-24  # of float32
FORMULA_ERROR = 32 * UNIT_ROUNDOFF  # of an input that a formula gives: each of its few operations rounds
LIMIT_ERROR = 8 * UNIT_ROUNDOFF  # of a position error that is shortened: three squares, a root, a quotient, a product
TANH_ERROR = 8 * UNIT_ROUNDOFF  # measured: 5.5 in onnxruntime 1.32, 4.6 in XLA, over all of [-12, 12]

FORMAT_VALUE = "flytune-onnx-1"  # in every file that is written here


def save_onnx(path: Path, policy: Policy) -> None:
    """Write a policy as ONNX, after a check that onnxruntime computes its actions; bytes depend on the policy alone.

    Raises:
        BadInput: the extra `onnx` is missing, the file cannot be written, or onnxruntime computes other actions. An
            earlier file at this path is then untouched.
    """
    content = _model(policy).SerializeToString()
    check_actions(read_onnx(content, str(path)), policy, str(path))
    write_bytes(path, content)


def rounding_bound(policy: Policy, observations: Float[np.ndarray, "batch 17"]) -> Float[np.ndarray, "batch 4"]:
    """The largest error that float32 can cause in each action, for any order of its sums.

        |fl(x w + b) - (x w + b)| <= gamma (|x| |w| + |b|) + e |w|,   gamma = k u / (1 - k u), k = inputs + 1
        |tanh(z + e) - tanh(z)| <= e / cosh(max(|z| - e, 0))^2

    with u = 2^-24, e the error of the input of a layer, and `TANH_ERROR` for the tanh routine itself.

    Source: Higham 2002, Accuracy and Stability of Numerical Algorithms, section 3.1; the mean value theorem.
    """
    seen = np.asarray(limited(jnp.asarray(observations), policy.error_limit))
    clipped = seen if policy.bounds is None else np.clip(seen, *np.asarray(policy.bounds))
    x = clipped.astype(float) * np.asarray(policy.input_scale, float)
    error = np.where(seen == observations, UNIT_ROUNDOFF, LIMIT_ERROR) * np.abs(x)
    if policy.inputs:
        further = np.asarray(told(policy.inputs, jnp.asarray(seen), policy.setting), float)[:, SIZE:]
        x = np.concatenate([x, further], axis=-1)
        error = np.concatenate([error, FORMULA_ERROR * np.abs(further)], axis=-1)
    last = len(policy.actor.weights) - 1
    for index, (weight, bias) in enumerate(zip(policy.actor.weights, policy.actor.biases, strict=True)):
        w, b = np.asarray(weight, float), np.asarray(bias, float)
        roundings = (len(w) + 1) * UNIT_ROUNDOFF
        gamma = roundings / (1 - roundings)
        error = error @ np.abs(w) + gamma * ((np.abs(x) + error) @ np.abs(w) + np.abs(b))
        x = x @ w + b
        if index < last or policy.squash == "tanh":
            nearest = np.minimum(np.maximum(np.abs(x) - error, 0), 300)  # beyond 300, cosh^2 overflows
            error = error / np.cosh(nearest) ** 2 + TANH_ERROR
            x = np.tanh(x)
    return error


def check_actions(controller: OnnxController, policy: Policy, where: str) -> None:
    """Refuse an ONNX file whose actions differ from those of the policy by more than the rounding of float32.

    Raises:
        BadInput: an action differs; the message begins with `where`, the name of the file.
    """
    observations = sample_observations(CHECKED)
    for setting in checked_settings(policy.dials):
        here = policy.at(setting)
        found = controller.session(observations, np.asarray([list(setting.values())], np.float32))
        difference = np.abs(found - np.asarray(jax.jit(here.__call__)(observations)))
        allowed = 2 * rounding_bound(here, observations)  # each of the two actions may have this error
        if not np.all(difference <= allowed):
            row, motor = np.unravel_index(np.argmax(difference - allowed), difference.shape)
            raise BadInput(
                f"{where}: for sample observation {row}, the action of onnxruntime differs from that of the policy by "
                f"{difference[row, motor]:.2g} at motor {motor}. Allowed: {allowed[row, motor]:.2g}, the rounding of "
                "float32. Nothing was written; try another version of onnxruntime."
            )


def checked_settings(dials: dict[str, Dial]) -> list[dict[str, float]]:
    """The settings at which a file is checked: all dials at their lowest, default and highest value."""
    if not dials:
        return [{}]
    ends = ("lowest", "default", "highest")
    return [{name: float(getattr(dials[name], end)) for name in sorted(dials)} for end in ends]


def _model(policy: Policy) -> Any:
    onnx = require("onnx", "onnx")
    helper = onnx.helper
    nodes, weights = [], []

    def weight(name: str, values: Any, kind: Any = np.float32) -> str:
        weights.append(onnx.numpy_helper.from_array(np.asarray(values, kind), name))
        return name

    def node(operator: str, *inputs: str, output: str, **attributes: int) -> str:
        nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    value = seen = _limited(policy, node, weight) if math.isfinite(policy.error_limit) else INPUT
    if policy.bounds is not None:
        value = node("Max", value, weight("lowest", policy.bounds[0]), output="above")
        value = node("Min", value, weight("highest", policy.bounds[1]), output="within")
    value = node("Mul", value, weight("input_scale", policy.input_scale), output="scaled")
    if policy.inputs:
        value = node("Concat", value, *_further_inputs(policy, seen, node, weight), output="inputs", axis=1)
    last = len(policy.actor.weights) - 1
    for index, (matrix, bias) in enumerate(zip(policy.actor.weights, policy.actor.biases, strict=True)):
        layer = f"actor.{index}"
        value = node("MatMul", value, weight(f"{layer}.weight", matrix), output=f"{layer}.product")
        value = node("Add", value, weight(f"{layer}.bias", bias), output=f"{layer}.sum")
        if index < last or policy.squash == "tanh":
            value = node("Tanh", value, output=f"{layer}.tanh")
    # needed after a tanh as well: the tanh of onnxruntime exceeds 1 by two units in the last place
    node("Clip", value, weight("least", -1.0), weight("most", 1.0), output=OUTPUT)
    graph = helper.make_graph(
        nodes,
        "policy",
        [
            helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", size])
            for name, size in ((INPUT, SIZE), (DIAL_INPUT, len(policy.dials)))
            if size
        ],
        [helper.make_tensor_value_info(OUTPUT, onnx.TensorProto.FLOAT, ["batch", 4])],
        weights,
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPERATOR_SET)],
        ir_version=INTERMEDIATE_REPRESENTATION,
        producer_name="flytune",
        producer_version=metadata.version("flytune"),
    )
    about = {key: str(value) for key, value in policy.about.items()}
    if policy.dials:
        about[DIALS] = json.dumps({name: document.plain(policy.dials[name]) for name in sorted(policy.dials)})
    facts = {FORMAT: FORMAT_VALUE, VERSION: metadata.version("flytune")}
    helper.set_model_props(model, about | conventions(policy.about) | facts)
    return model


def _limited(policy: Policy, node: Callable[..., str], weight: Callable[..., str]) -> str:
    """The observation with a position error of at most the policy's limit, as a node of the graph."""
    error, rest = (
        node("Gather", INPUT, weight(f"{name}.columns", columns, np.int64), output=name, axis=1)
        for name, columns in (("position_error", range(3)), ("rest", range(3, SIZE)))
    )
    square = node("Mul", error, error, output="position_error.square")
    length = node("Sqrt", node("ReduceSum", square, weight("axis", [1], np.int64), output="sum"), output="length")
    most = weight("error_limit", policy.error_limit)
    factor = node("Div", most, node("Max", length, most, output="length.or.limit"), output="factor")
    return node("Concat", node("Mul", error, factor, output="near"), rest, output="limited", axis=1)


def _further_inputs(
    policy: Policy, observation: str, node: Callable[..., str], weight: Callable[..., str]
) -> list[str]:
    """The inputs of the network behind the observation, each [batch, its size], as nodes of the graph."""
    count = itertools.count()
    operators = {"+": "Add", "-": "Sub", "*": "Mul", "/": "Div", "**": "Pow"}

    def operation(name: str, *values: str) -> str:
        return node(operators.get(name, name.capitalize()), *values, output=f"formula.{next(count)}")

    def constant(value: float) -> str:
        return weight(f"constant.{next(count)}", [[value]])

    columns = {
        name: node(
            "Gather", DIAL_INPUT, weight(f"dial.{name}.column", [index], np.int64), output=f"dial.{name}", axis=1
        )
        for index, name in enumerate(sorted(policy.dials))
    }
    first = columns[min(policy.dials)]
    one = node("Exp", node("Sub", first, first, output="zero"), output="one")  # [batch, 1]
    parts = []
    for name in sorted(policy.inputs):
        each, block = policy.inputs[name], one
        if (rows := each.rows()) is not None:
            numbers = weight(f"input.{name}.rows", range(SIZE)[rows], np.int64)
            block = node("Gather", observation, numbers, output=f"input.{name}.block", axis=1)
        value = each.value.build(columns.__getitem__, operation, constant)
        parts.append(node("Mul", value, block, output=f"input.{name}"))
    return parts
