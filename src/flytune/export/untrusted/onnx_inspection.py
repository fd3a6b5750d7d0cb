"""The conventions of a policy in ONNX, and the inspection of a file before any part of it is run.

A model may come from an untrusted source. It may name other files for its weights, loop without end, or draw random
numbers. A policy needs none of these, so they are refused; every other operator of the ONNX standard is allowed, in a
process with limits of memory and time (`sandbox`).
"""

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from flytune.control.policy import ACTIONS, CONVENTIONS
from flytune.errors import BadInput, require
from flytune.export.untrusted.onnx_size import LARGEST_MESSAGES, count_messages, count_nodes
from flytune.task.dial import Dial, read_named
from flytune.task.observation import RATE

INPUT, OUTPUT = "observation", "action"
DIAL_INPUT, DIALS = "dial", "dials"  # a second input, and the metadata entry that describes it, of a policy with dials
FORMAT, VERSION = "format", "flytune_version"  # metadata entries that say which program wrote the file
NODES = 10_000  # of a graph whose functions are written out; the network of the paper has 8
OLDEST = 7  # the first operator set that onnxruntime runs
CONTROL_FLOW = {"If", "Loop", "Scan", "SequenceMap"}
RANDOM = {"Bernoulli", "Multinomial", "RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike"}
STANDARD = ("", "ai.onnx")
OTHERS = {  # what is allowed of an entry beside the usual
    "rate": ", or another of 50 to 1000 Hz",
    "action": "".join(f", or {text!r}" for text in list(ACTIONS.values())[1:]),
}


def inspect(content: bytes, where: str) -> Any:
    """The model in the bytes of a file, if it may be run; no other file is opened.

    Raises:
        BadInput: the file is not ONNX, contains control flow, randomness or operators outside the standard, keeps
            weights in another file, has numbers that are not finite, or does not follow the conventions.
    """
    onnx = require("onnx", "onnx")
    try:
        if count_messages(content, onnx.ModelProto.DESCRIPTOR) > LARGEST_MESSAGES:
            raise BadInput(f"{where}: has more than {LARGEST_MESSAGES} parts. Give a smaller network.")
        model = onnx.load_model_from_string(content)
    except BadInput:
        raise
    except Exception as error:  # protobuf raises exceptions of several classes
        raise BadInput(f"{where}: is not an ONNX model ({first_line(error)}). Give the file of a policy.") from None
    if not model.graph.node:
        raise BadInput(f"{where}: is not an ONNX model (it contains no graph). Give the file of a policy.")
    model.DiscardUnknownFields()  # a field that was not inspected must not be run
    _refuse_damaged_text(onnx, model, where)
    _refuse_other_files(onnx, model, where)
    _refuse_other_operators(onnx, model, where)
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


def shown(value: Any) -> str:
    """A text of the file on one line of at most 80 characters."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..."


def _messages(kind: type, message: Any) -> Iterator[Any]:
    """A protobuf message and all messages inside it, in any field, as far as they are of a kind."""
    if isinstance(message, kind):
        yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            for child in [value] if hasattr(value, "ListFields") else value:
                yield from _messages(kind, child)


def _refuse_damaged_text(onnx: Any, model: Any, where: str) -> None:
    for message in _messages(object, model):
        for field, value in message.ListFields():
            if field.type == field.TYPE_STRING and not all(
                isinstance(text, str) for text in ([value] if isinstance(value, str | bytes) else value)
            ):
                what = "metadata" if isinstance(message, onnx.StringStringEntryProto) else f"text in {field.name!r}"
                raise BadInput(f"{where}: has damaged {what} (bytes that are not UTF-8). Export it again.")


def _refuse_other_files(onnx: Any, model: Any, where: str) -> None:
    for tensor in _messages(onnx.TensorProto, model):
        if tensor.external_data or tensor.data_location == onnx.TensorProto.EXTERNAL:
            raise BadInput(
                f"{where}: tensor {shown(tensor.name)} is kept in another file. "
                "Allowed: all weights inside this file. Save it with onnx.save(onnx.load(path), path)."
            )


def _refuse_other_operators(onnx: Any, model: Any, where: str) -> None:
    if model.training_info or model.graph.sparse_initializer:
        what = "training information" if model.training_info else "sparse weights"
        raise BadInput(f"{where}: contains {what}. Allowed: dense weights and one graph. Export it for inference.")
    for used in model.opset_import:
        newest = onnx.defs.onnx_opset_version()
        if used.domain in STANDARD and not OLDEST <= used.version <= newest:
            raise BadInput(
                f"{where}: is written with operator set {used.version}. Allowed: {OLDEST} to {newest} (onnx "
                f"{onnx.__version__}). Export it again, for instance with opset_version=17."
            )
    functions = {(each.domain, each.name): each for each in model.functions}
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    for node in _messages(onnx.NodeProto, model):
        name = shown(f"{node.domain}::{node.op_type}" if node.domain else node.op_type)
        if (node.domain, node.op_type) in functions:
            continue
        if node.domain not in STANDARD or not onnx.defs.has(node.op_type, ""):
            raise BadInput(
                f"{where}: operator {name} is not allowed. Allowed: the operators of the ONNX standard "
                f"(onnx {onnx.__version__}), and functions that the file itself defines from them."
            )
        if node.op_type in CONTROL_FLOW or any(each.HasField("g") or each.graphs for each in node.attribute):
            raise BadInput(
                f"{where}: operator {name} is not allowed, because it branches or loops. Allowed: the operators of "
                "the ONNX standard without control flow. Export it without branches (torch.where instead of if)."
            )
        if node.op_type in RANDOM or (node.op_type == "Dropout" and _trains(onnx, node, constants)):
            raise BadInput(
                f"{where}: operator {name} is not allowed, because it draws random numbers. Allowed: an action that "
                "depends on the observation alone. Export the mean of the policy, for inference (model.eval())."
            )
    number = count_nodes(model.graph.node, functions, NODES)
    if number is None:
        raise BadInput(f"{where}: contains functions that call themselves. Export it with functions inlined.")
    if number > NODES:
        raise BadInput(f"{where}: contains more than {NODES} nodes. Give a smaller network.")


def _trains(onnx: Any, node: Any, constants: dict[str, Any]) -> bool:
    """Whether a Dropout draws, or may draw, random numbers: its third input says so."""
    if len(node.input) < 3 or not node.input[2]:
        return False
    training = constants.get(node.input[2])
    return training is None or bool(np.any(onnx.numpy_helper.to_array(training)))


def _refuse_other_conventions(model: Any, where: str) -> None:
    found = metadata(model)
    # a graph does not say what its numbers mean: a model without these entries in its metadata is refused
    for key, wanted in CONVENTIONS.items():
        if not _is_known(key, found.get(key)):
            has = f"is {shown(found[key])}" if key in found else "is missing"
            raise BadInput(
                f"{where}: the metadata entry {key!r} {has}. Allowed: {wanted!r}{OTHERS.get(key, '')}. If the model "
                "follows this, set it: onnx.helper.set_model_props(model, flytune.export.onnx.CONVENTIONS)."
            )


def _is_known(key: str, value: str | None) -> bool:
    """Whether a convention is one that flytune can fly."""
    if key == "action":
        return value in ACTIONS.values()
    if key == "rate":
        number = re.fullmatch(r"(\d{2,4}) Hz", value or "")
        return number is not None and 50 <= int(number[1]) <= 1000
    return value == CONVENTIONS[key]


def conventions_of(found: Mapping[str, str]) -> dict[str, Any]:
    """The facts of `conventions` from the metadata of a model that was inspected; the usual ones are left out."""
    rate = int(found["rate"].removesuffix(" Hz"))
    convention = next(name for name, text in ACTIONS.items() if text == found["action"])
    return ({} if rate == RATE else {"control_rate": rate}) | (
        {} if convention == "hover_relative" else {"action_convention": convention}
    )


def _refuse_broken_numbers(onnx: Any, model: Any, where: str) -> None:
    for tensor in _messages(onnx.TensorProto, model):
        if tensor.data_type == onnx.TensorProto.STRING:
            raise BadInput(f"{where}: tensor {shown(tensor.name)} holds text. Allowed: numbers.")
        try:
            values = onnx.numpy_helper.to_array(tensor)
        except Exception as error:  # its size does not match its shape, or its type is unknown
            raise BadInput(
                f"{where}: tensor {shown(tensor.name)} is damaged ({first_line(error)}). Export it again."
            ) from None
        _refuse_not_finite(values, f"tensor {shown(tensor.name)}", where)
    for attribute in _messages(onnx.AttributeProto, model):
        _refuse_not_finite(np.array([attribute.f, *attribute.floats]), f"attribute {shown(attribute.name)}", where)


def _refuse_not_finite(values: np.ndarray, what: str, where: str) -> None:
    if not np.all(np.isfinite(values.astype(np.float32) if values.dtype.kind == "V" else values)):
        raise BadInput(
            f"{where}: {what} contains numbers that are not finite. Allowed: finite numbers. Train it again, if this "
            "is a weight; write a large number such as -1e9, if it is a bound or a mask."
        )
