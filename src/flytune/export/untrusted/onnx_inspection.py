"""The conventions of a policy in ONNX, and the inspection of a file before any part of it is run.

A model may come from an untrusted source. It may name other files for its weights, loop without end, or draw random
numbers. A policy needs none of these, so only arithmetic that is known to be harmless is allowed.
"""

import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from flytune.control.policy import CONVENTIONS
from flytune.errors import BadInput, require
from flytune.task.dial import Dial, read_named
from flytune.task.observation import SIZE

INPUT, OUTPUT = "observation", "action"
DIAL_INPUT, DIALS = "dial", "dials"  # a second input, and the metadata entry that describes it, of a policy with dials
FORMAT, VERSION = "format", "flytune_version"  # metadata entries that say which program wrote the file
# fmt: off
OPERATORS = {
    "Abs", "Add", "And", "BatchNormalization", "Cast", "Ceil", "Celu", "Clip", "Concat", "Constant", "Cos", "Div",
    "Elu", "Equal", "Erf", "Exp", "Flatten", "Floor", "Gather", "Gelu", "Gemm", "Greater", "GreaterOrEqual",
    "HardSigmoid", "HardSwish", "Identity", "LayerNormalization", "LeakyRelu", "Less", "LessOrEqual", "Log",
    "MatMul", "Max", "Mean", "Min", "Mish", "Mul", "Neg", "Not", "Or", "PRelu", "Pow", "Reciprocal", "ReduceL2",
    "ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum", "Relu", "Reshape", "Selu", "Shape", "Sigmoid", "Sign",
    "Sin", "Slice", "Softmax", "Softplus", "Softsign", "Split", "Sqrt", "Squeeze", "Sub", "Sum", "Swish", "Tanh",
    "ThresholdedRelu", "Transpose", "Unsqueeze", "Where",
}
# fmt: on
WIDEST = 1_000_000  # numbers that one node may compute from one observation; a layer of the paper computes 64
NUMBERS = ("FLOAT", "FLOAT16", "DOUBLE", "INT32", "INT64", "BOOL")


def inspect(content: bytes, where: str) -> Any:
    """The model in the bytes of a file, if it may be run; no other file is opened.

    Raises:
        BadInput: the file is not ONNX, contains more than arithmetic, keeps weights in another file, has numbers that
            are not finite, or does not map an observation to an action.
    """
    onnx = require("onnx", "onnx")
    try:
        model = onnx.load_model_from_string(content)
    except Exception as error:  # protobuf raises exceptions of several classes
        raise BadInput(f"{where}: is not an ONNX model ({first_line(error)}). Give the file of a policy.") from None
    if not model.graph.node:
        raise BadInput(f"{where}: is not an ONNX model (it contains no graph). Give the file of a policy.")
    model.DiscardUnknownFields()  # a field that was not inspected must not be run
    _refuse_other_files(onnx, model, where)
    _refuse_more_than_arithmetic(onnx, model, where)
    if not all(isinstance(text, str) for entry in model.metadata_props for text in (entry.key, entry.value)):
        raise BadInput(f"{where}: has damaged metadata (bytes that are not UTF-8). Export it again.")
    _refuse_other_inputs_and_outputs(onnx, model, where)
    try:
        onnx.checker.check_model(model, full_check=True)
        inferred = onnx.shape_inference.infer_shapes(model, data_prop=True)
    except Exception as error:  # ValidationError, InferenceError, and RuntimeError from below
        raise BadInput(f"{where}: is a damaged ONNX model ({first_line(error)}). Export it again.") from None
    _refuse_wide_nodes(inferred, where)
    _refuse_other_conventions(model, where)
    _refuse_broken_numbers(onnx, model, where)
    return model


def read_dials(model: Any, where: str) -> dict[str, Dial]:
    """The dials of a model in the order of its second input; empty for a model with the observation alone.

    Raises:
        BadInput: the entry of the metadata is damaged.
    """
    try:
        found = json.loads(metadata(model).get(DIALS, "{}"))
    except ValueError:
        found = None
    dials = read_named(Dial, found, f"{where}: {DIALS}")
    return {name: dials[name] for name in sorted(dials)}


def metadata(model: Any) -> dict[str, str]:
    """The entries of a model's metadata."""
    return {entry.key: entry.value for entry in model.metadata_props}


def first_line(error: Exception) -> str:
    """The message of an error of another package, as one line of at most 150 characters."""
    text = " ".join(str(error).split())
    return text if len(text) <= 150 else f"{text[:150]}..."


def _messages(kind: type, message: Any) -> Iterator[Any]:
    """A protobuf message and all messages inside it, in any field, as far as they are of a kind."""
    if isinstance(message, kind):
        yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            for child in [value] if hasattr(value, "ListFields") else value:
                yield from _messages(kind, child)


def _refuse_other_files(onnx: Any, model: Any, where: str) -> None:
    for tensor in _messages(onnx.TensorProto, model):
        if tensor.external_data or tensor.data_location == onnx.TensorProto.EXTERNAL:
            raise BadInput(
                f"{where}: tensor {_shown(tensor.name)} is kept in another file. "
                "Allowed: all weights inside this file. Save it with onnx.save(onnx.load(path), path)."
            )


def _refuse_more_than_arithmetic(onnx: Any, model: Any, where: str) -> None:
    if model.functions or model.training_info or model.graph.sparse_initializer:
        raise BadInput(
            f"{where}: contains functions, training information or sparse weights. "
            "Allowed: one graph of standard operators. Export it for inference, with functions inlined."
        )
    for node in _messages(onnx.NodeProto, model):
        if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
            name = f"{node.domain}::{node.op_type}" if node.domain else node.op_type
            raise BadInput(
                f"{where}: operator {_shown(name)} is not allowed. Allowed: the standard operators of a "
                "feed-forward network (MatMul, Gemm, Add, Tanh, Relu, Clip, ...), without loops or randomness."
            )


def _refuse_other_inputs_and_outputs(onnx: Any, model: Any, where: str) -> None:
    graph, dials = model.graph, len(read_dials(model, where))
    weights = {tensor.name for tensor in graph.initializer}  # old models list weights among the inputs as well
    inputs = [value for value in graph.input if value.name not in weights]
    wanted = [("input", inputs[:1] if dials else inputs, INPUT, SIZE), ("output", list(graph.output), OUTPUT, 4)]
    if dials:
        wanted.append(("input", inputs[1:], DIAL_INPUT, dials))
    for kind, found, name, size in wanted:
        wanted = f"Allowed: one {kind} {name!r}, float32 [batch, {size}]. Export it with this one."
        if [value.name for value in found] != [name]:
            names = ", ".join(_shown(value.name) for value in found) or "none"
            raise BadInput(f"{where}: has the {kind}s {names}. {wanted}")
        tensor = found[0].type.tensor_type
        if tensor.elem_type != onnx.TensorProto.FLOAT:
            shown = onnx.TensorProto.DataType.Name(tensor.elem_type) if tensor.elem_type in range(1, 17) else "unknown"
            raise BadInput(f"{where}: {kind} {name!r} is of type {shown}. {wanted}")
        shape = [size.dim_value or size.dim_param or "?" for size in tensor.shape.dim]
        if len(shape) != 2 or shape[1] != size:
            raise BadInput(f"{where}: {kind} {name!r} has shape {_shown(shape)}. {wanted}")
        if isinstance(shape[0], int):
            raise BadInput(
                f"{where}: {kind} {name!r} has the fixed batch size {shape[0]}. Allowed: any batch size, since many "
                "trials are flown at once. Export it with a dynamic first axis."
            )


def _refuse_wide_nodes(inferred: Any, where: str) -> None:
    for value in inferred.graph.value_info:
        width = math.prod(size.dim_value or 1 for size in value.type.tensor_type.shape.dim)
        if width > WIDEST:
            raise BadInput(
                f"{where}: node {_shown(value.name)} computes {width} numbers per observation. Allowed: up to {WIDEST}."
            )


def _refuse_other_conventions(model: Any, where: str) -> None:
    found = metadata(model)
    # a graph does not say what its numbers mean: a model without these entries in its metadata is refused
    for key, wanted in CONVENTIONS.items():
        if found.get(key) != wanted:
            has = f"is {_shown(found[key])}" if key in found else "is missing"
            raise BadInput(
                f"{where}: the metadata entry {key!r} {has}. Allowed: {wanted!r}. If the model follows this, set it: "
                "onnx.helper.set_model_props(model, flytune.export.onnx.CONVENTIONS)."
            )


def _refuse_broken_numbers(onnx: Any, model: Any, where: str) -> None:
    allowed = {getattr(onnx.TensorProto, name) for name in NUMBERS}
    for tensor in _messages(onnx.TensorProto, model):
        if tensor.data_type not in allowed:
            raise BadInput(
                f"{where}: tensor {_shown(tensor.name)} has a type that is not allowed. Allowed: {', '.join(NUMBERS)}."
            )
        try:
            values = onnx.numpy_helper.to_array(tensor)
        except Exception as error:  # its size does not match its shape
            shown = f"{_shown(tensor.name)} is damaged ({first_line(error)})"
            raise BadInput(f"{where}: tensor {shown}. Export it again.") from None
        _refuse_not_finite(values, f"tensor {_shown(tensor.name)}", where)
    for attribute in _messages(onnx.AttributeProto, model):
        _refuse_not_finite(np.array([attribute.f, *attribute.floats]), f"attribute {_shown(attribute.name)}", where)


def _refuse_not_finite(values: np.ndarray, what: str, where: str) -> None:
    if not np.all(np.isfinite(values)):
        raise BadInput(f"{where}: {what} contains numbers that are not finite. Train it again.")


def _shown(value: Any) -> str:
    """A text of the file on one line of at most 80 characters."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..."
