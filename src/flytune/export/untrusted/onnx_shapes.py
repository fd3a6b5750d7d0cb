"""Which input of an ONNX model is the observation, which output the action, and in which shape they go in and out.

The metadata says what the numbers mean, so their names and shapes are free as far as no doubt is left: 17 numbers for
each observation, 4 for each action, in a row or a column, for any number of observations at once or a fixed one.
"""

import dataclasses
from typing import Any

from flytune.errors import BadInput, require
from flytune.export.untrusted.onnx_inspection import DIAL_INPUT, INPUT, OUTPUT, shown
from flytune.task.observation import SIZE

TYPES = {1: "float32", 10: "float16", 11: "float64"}  # of onnx.TensorProto, as far as NumPy has them
# its scale comes from all rows of a batch; a vehicle runs it with one row
BATCHWISE = {"DynamicQuantizeLinear"}


@dataclasses.dataclass(frozen=True)
class Port:
    """An input: its name, the type of its numbers, its shape for one observation, and the fixed batch size, if any."""

    name: str
    type: str
    row: tuple[int, ...]  # behind the axis of the batch
    batch: int | None = None  # None: any
    bare: bool = False  # without an axis of the batch

    @property
    def whole(self) -> list[int]:
        """The shape of one batch; -1 for any number of rows."""
        return [*self.row] if self.bare else [self.batch or -1, *self.row]


@dataclasses.dataclass(frozen=True)
class Ports:
    """How a model is called."""

    inputs: tuple[Port, ...]  # the observation, and the dials where there are any
    output: str

    @property
    def batch(self) -> int | None:
        """How many observations one call takes, None for any number."""
        return self.inputs[0].batch


def find_ports(model: Any, dials: int, where: str) -> Ports:
    """How to call a model that has this number of dials.

    Raises:
        BadInput: its inputs or outputs are not those of a policy.
    """
    weights = {tensor.name for tensor in model.graph.initializer}  # old models list weights among the inputs as well
    values = [value for value in model.graph.input if value.name not in weights]
    wanted = f"Allowed: one input {INPUT!r}, float32 [batch, {SIZE}]"
    wanted += f", and one input {DIAL_INPUT!r}, float32 [batch, {dials}]." if dials else "."
    named = {value.name: value for value in values}
    chosen = [(values[0] if len(values) == 1 else named.get(INPUT), SIZE)]
    if dials:
        chosen = [(named.get(INPUT), SIZE), (named.get(DIAL_INPUT), dials)]
    found = [(value, size) for value, size in chosen if value is not None]
    if len(found) < len(chosen) or len(values) != len(chosen):
        names = ", ".join(shown(value.name) for value in values) or "none"
        memory = (
            " A policy with a memory, whose state is an input, cannot be flown." if len(values) > len(chosen) else ""
        )
        raise BadInput(f"{where}: has the inputs {names}. {wanted}{memory} Export it with this.")
    inputs = [_port(value, size, wanted, where) for value, size in found]
    if any(node.op_type in BATCHWISE for node in model.graph.node) and inputs[0].batch is None:
        inputs = [dataclasses.replace(each, batch=1) for each in inputs]
    if len({each.batch for each in inputs}) > 1:
        raise BadInput(f"{where}: has inputs of different batch sizes. {wanted} Export it with this.")
    return Ports(inputs=tuple(inputs), output=_output(model, where))


def _port(value: Any, size: int, wanted: str, where: str) -> Port:
    tensor = value.type.tensor_type
    if tensor.elem_type not in TYPES:
        kind, name = _type_name(tensor.elem_type), shown(value.name)
        raise BadInput(f"{where}: input {name} is of type {kind}. {wanted} Export it with this.")
    lengths = _lengths(tensor)
    port = Port(name=value.name, type=TYPES[tensor.elem_type], row=(size,))
    if lengths is None:
        return port
    fixed = [length for length in lengths if isinstance(length, int)]
    if len(fixed) == len(lengths) and _is_row(fixed, size):
        bare = len(fixed) == 1 or fixed[0] != 1
        return dataclasses.replace(port, row=tuple(fixed if bare else fixed[1:]), batch=1, bare=bare)
    row = lengths[1:]
    if len(lengths) == 2 and not fixed:  # exported with every axis dynamic
        row = [size]
    if all(isinstance(length, int) for length in row) and _is_row(row, size):
        batch = lengths[0] if isinstance(lengths[0], int) else None
        return dataclasses.replace(port, row=tuple(row), batch=batch)
    raise BadInput(f"{where}: input {shown(value.name)} has shape {shown(lengths)}. {wanted} Export it with this.")


def _output(model: Any, where: str) -> str:
    """The name of the output: the one that is called so, else the only one that may hold 4 numbers per observation."""
    wanted = f"Allowed: one output {OUTPUT!r}, float32 [batch, 4]. Export it with this."
    outputs = list(model.graph.output)
    chosen = [value for value in outputs if value.name == OUTPUT] or [
        value for value in outputs if _may_be_action(value)
    ]
    if len(chosen) != 1:
        names = ", ".join(shown(value.name) for value in outputs) or "none"
        if len(outputs) == 1:
            lengths = _lengths(outputs[0].type.tensor_type)
            raise BadInput(f"{where}: output {names} has shape {shown(lengths)}. {wanted}")
        raise BadInput(f"{where}: has the outputs {names}. {wanted}")
    tensor = chosen[0].type.tensor_type
    if tensor.elem_type not in TYPES:
        name, kind = shown(chosen[0].name), _type_name(tensor.elem_type)
        raise BadInput(f"{where}: output {name} is of type {kind}. {wanted}")
    if not _may_be_action(chosen[0]):
        raise BadInput(f"{where}: output {shown(chosen[0].name)} has shape {shown(_lengths(tensor))}. {wanted}")
    return chosen[0].name


def _may_be_action(value: Any) -> bool:
    lengths = _lengths(value.type.tensor_type)
    if lengths is None:
        return True
    row = [4 if not isinstance(length, int) else length for length in lengths[1:]]
    return _is_row(row, 4) or _is_row([length for length in lengths if isinstance(length, int)], 4)


def _is_row(lengths: list[Any], size: int) -> bool:
    """Whether the shape is that of so many numbers in a row or a column."""
    return [length for length in lengths if length != 1] == ([size] if size != 1 else [])


def _lengths(tensor: Any) -> list[Any] | None:
    """The axes of a shape: a number, a name, or "?"; None where the model does not say."""
    if not tensor.HasField("shape"):
        return None
    return [axis.dim_value or axis.dim_param or "?" for axis in tensor.shape.dim]


def _type_name(number: int) -> str:
    known = require("onnx", "onnx").TensorProto.DataType
    return known.Name(number) if number in known.values() else "unknown"
