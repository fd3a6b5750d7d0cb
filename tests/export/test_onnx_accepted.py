"""ONNX files from other programs that fly: any standard operator, and the same numbers in other shapes and types."""

import jax
import numpy as np
import pytest

from flytune.errors import BadInput
from flytune.evaluation.fly import fly
from flytune.task.files import load_task

onnx = pytest.importorskip("onnx", reason="needs flytune[onnx]")
pytest.importorskip("onnxruntime", reason="needs flytune[onnx]")

from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from flytune.export.onnx import CONVENTIONS  # noqa: E402
from flytune.export.untrusted.onnx_controller import read_onnx, sample_observations  # noqa: E402
from flytune.export.untrusted.onnx_inspection import CONTROL_FLOW, inspect  # noqa: E402
from flytune.export.untrusted.onnx_inspection import RANDOM as RANDOM_OPERATORS  # noqa: E402

RANDOM = np.random.default_rng(3)
WEIGHT = 0.1 * RANDOM.standard_normal((17, 4)).astype(np.float32)
OBSERVATIONS = sample_observations(40)
WANTED = np.tanh(OBSERVATIONS @ WEIGHT)


def node(operator, *inputs, to, **attributes):
    return helper.make_node(operator, inputs, [to] if isinstance(to, str) else to, **attributes)


def value(name, shape, kind=TensorProto.FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def model(nodes, inputs=None, outputs=None, functions=(), opsets=("",), **weights):
    """The bytes of a model of these nodes."""
    tensors = [
        each if isinstance(each, onnx.TensorProto) else numpy_helper.from_array(np.asarray(each), name)
        for name, each in weights.items()
    ]
    inputs, outputs = inputs or [value("observation", ["n", 17])], outputs or [value("action", ["n", 4])]
    graph = helper.make_graph(nodes, "theirs", inputs, outputs, tensors)
    made = helper.make_model(
        graph, opset_imports=[helper.make_opsetid(each, 17) for each in opsets], functions=functions, ir_version=8
    )
    helper.set_model_props(made, CONVENTIONS)
    return made.SerializeToString()


def actions(content):
    return read_onnx(content, "p.onnx").session(OBSERVATIONS)


# --- operators ---

FIRST = node("MatMul", "observation", "w", to="raw")
LAST = node("Tanh", "more", to="action")
X = (OBSERVATIONS @ WEIGHT).astype(float)
UNARY = {
    "Atan": np.arctan,
    "Asin": lambda x: np.arcsin(0.5 * np.tanh(x)),
    "Acos": lambda x: np.arccos(0.5 * np.tanh(x)),
    "Asinh": np.arcsinh,
    "Sinh": lambda x: np.sinh(np.tanh(x)),
    "Cosh": lambda x: np.cosh(np.tanh(x)),
    "Atanh": lambda x: np.arctanh(0.5 * np.tanh(x)),
    "Tan": lambda x: np.tan(np.tanh(x)),
    "LogSoftmax": lambda x: (
        x - np.log(np.sum(np.exp(x - x.max(1, keepdims=True)), 1, keepdims=True)) - x.max(1, keepdims=True)
    ),
    "Hardmax": lambda x: (x == x.max(1, keepdims=True)) * 1.0,
    "Round": np.round,
}


@pytest.mark.parametrize("operator", UNARY)
def test_an_operator_that_no_network_of_ours_has_is_computed(operator):
    nodes, scale = [FIRST], np.float32(0.5 if operator in ("Asin", "Acos", "Atanh") else 1)
    inside = "raw"
    if operator in ("Asin", "Acos", "Sinh", "Cosh", "Atanh", "Tan"):
        nodes += [node("Tanh", "raw", to="small"), node("Mul", "small", "scale", to="scaled")]
        inside = "scaled"
    found = actions(model([*nodes, node(operator, inside, to="more"), LAST], w=WEIGHT, scale=scale))
    # a step of Round may fall on the other side
    assert np.mean(np.abs(found - np.tanh(UNARY[operator](X))) < 1e-4) > (0.95 if operator == "Round" else 0.9999)


def test_euler_angles_from_our_quaternion_fly():
    """Roll, pitch and yaw from columns 3 to 6 (x, y, z, w), as most controllers outside this program expect them."""
    rows = {"x": 3, "y": 4, "z": 5, "w": 6}
    nodes = [node("Gather", "observation", name + "_row", to=name, axis=1) for name in rows]

    def product(*names, to):
        nodes.extend([node("Mul", *names, to=f"{to}_1"), node("Mul", f"{to}_1", "two", to=to)])

    product("w", "x", to="wx"), product("y", "z", to="yz"), product("x", "x", to="xx"), product("y", "y", to="yy")
    product("w", "y", to="wy"), product("z", "x", to="zx")
    nodes += [
        node("Add", "wx", "yz", to="sine"),
        node("Add", "xx", "yy", to="sum"),
        node("Sub", "one", "sum", to="cosine"),
        node("Div", "sine", "cosine", to="ratio"),
        node("Atan", "ratio", to="roll"),
        node("Sub", "wy", "zx", to="lean"),
        node("Clip", "lean", "least", "most", to="clipped"),
        node("Asin", "clipped", to="pitch"),
        node("Concat", "roll", "pitch", "roll", "pitch", to="angles", axis=1),
        node("Mul", "angles", "tenth", to="more"),
        LAST,
    ]
    constants = {f"{name}_row": np.array([row]) for name, row in rows.items()}
    numbers = {"one": 1, "two": 2, "least": -1, "most": 1, "tenth": 0.1}
    constants |= {name: np.float32(number) for name, number in numbers.items()}
    controller = read_onnx(model(nodes, **constants), "p.onnx")
    level = np.eye(17, dtype=np.float32)[6]
    tilted = level.copy()
    tilted[3:7] = [np.sin(0.2), 0, 0, np.cos(0.2)]  # a roll of 0.4 rad
    found = controller.session(np.stack([level, tilted]))
    np.testing.assert_allclose(found, np.tanh([[0, 0, 0, 0], [0.04, 0, 0.04, 0]]), atol=1e-6)
    flights = fly(controller, load_task("baseline"), trials=3, duration=0.6)
    assert np.all(np.isfinite(flights.action)) and np.abs(flights.action[:, 1:]).max() > 0


def quantised():
    scale = np.float32(np.abs(WEIGHT).max() / 127)
    whole = np.round(WEIGHT / scale).astype(np.int8)
    nodes = [node("DequantizeLinear", "q", "scale", to="w"), FIRST, node("Tanh", "raw", to="action")]
    return model(nodes, q=whole, scale=scale), np.tanh(OBSERVATIONS @ (whole * scale))


def dynamically_quantised():
    """What a dynamic quantisation writes: the scale of the observations comes from all of them that are given."""
    weight = np.round(WEIGHT / 0.01).astype(np.int8)
    nodes = [
        node("DynamicQuantizeLinear", "observation", to=["q", "scale", "zero"]),
        node("MatMulInteger", "q", "w", "zero", to="whole"),
        helper.make_node("Cast", ["whole"], ["product"], to=TensorProto.FLOAT),
        node("Mul", "product", "scale", to="scaled"),
        node("Mul", "scaled", "hundredth", to="raw"),
        node("Tanh", "raw", to="action"),
    ]
    low, high = np.minimum(OBSERVATIONS.min(1), 0), np.maximum(OBSERVATIONS.max(1), 0)
    steps = ((high - low) / 255)[:, None]
    zero = np.round(-low[:, None] / steps)
    seen = (np.clip(np.round(OBSERVATIONS / steps) + zero, 0, 255) - zero) * steps
    return model(nodes, w=weight, hundredth=np.float32(0.01)), np.tanh(seen @ (weight * 0.01))


def halved():
    nodes = [node("Clip", "observation", "least", "most", to="near")]
    nodes += [helper.make_node("Cast", ["near"], ["half"], to=TensorProto.FLOAT16)]
    nodes += [node("MatMul", "half", "w", to="raw"), node("Tanh", "raw", to="t")]
    nodes += [helper.make_node("Cast", ["t"], ["action"], to=TensorProto.FLOAT)]
    bounds = {"least": np.float32(-100), "most": np.float32(100)}
    return model(nodes, w=WEIGHT.astype(np.float16), **bounds), np.tanh(np.clip(OBSERVATIONS, -100, 100) @ WEIGHT)


def recurrent():
    """An LSTM of one step from an empty state, which is a function of the observation alone."""
    gates = 0.1 * RANDOM.standard_normal((1, 16, 17)).astype(np.float32)
    back = np.zeros((1, 16, 4), np.float32)
    nodes = [
        node("Unsqueeze", "observation", "zero", to="sequence"),
        node("LSTM", "sequence", "gates", "back", to=["", "hidden"], hidden_size=4),
        node("Squeeze", "hidden", "zero", to="action"),
    ]
    entry, output, _, cell = np.split(OBSERVATIONS @ gates[0].T, 4, axis=1)
    share = lambda x: 1 / (1 + np.exp(-x.astype(float)))  # noqa: E731
    wanted = share(output) * np.tanh(share(entry) * np.tanh(cell))
    return model(nodes, gates=gates, back=back, zero=np.array([0])), wanted


def functional():
    """A model that defines a function of its own, as some exporters do."""
    inside = [node("Mul", "x", "x", to="s"), node("Sin", "s", to="y")]
    function = helper.make_function("own", "F", ["x"], ["y"], inside, [helper.make_opsetid("", 17)])
    nodes = [FIRST, helper.make_node("F", ["raw"], ["more"], domain="own"), LAST]
    wanted = np.tanh(np.sin((OBSERVATIONS @ WEIGHT) ** 2))
    return model(nodes, functions=[function], opsets=("", "own"), w=WEIGHT), wanted


def contracted():
    nodes = [
        node("Einsum", "observation", "w", to="raw", equation="bi,ij->bj"),
        node("Dropout", "raw", to="more"),
        LAST,
    ]
    return model(nodes, w=WEIGHT), WANTED


@pytest.mark.parametrize("make", [quantised, dynamically_quantised, halved, recurrent, functional, contracted])
def test_other_ways_to_write_a_network_fly(make):
    content, wanted = make()
    found = actions(content)
    # half precision has 11 bits; products of up to 100 are rounded to some 0.05 where tanh is not yet flat
    close = {halved: 0.05, dynamically_quantised: 0.02}.get(make, 1e-4)
    assert np.mean(np.abs(found - wanted) < close) > 0.97


def test_every_operator_of_the_standard_but_for_control_flow_and_randomness_passes_the_inspection():
    names = {each.name for each in onnx.defs.get_all_schemas_with_history() if each.domain == ""}
    assert names > CONTROL_FLOW | RANDOM_OPERATORS and len(names) > 180
    for name in names - CONTROL_FLOW - RANDOM_OPERATORS:
        inspect(model([helper.make_node(name, ["observation"], ["action"])]), "p.onnx")


# --- shapes, types and names ---


def reshaped(out):
    """The policy for observations of any shape that gives actions of one; -1 stands for the batch."""
    return [
        node("Reshape", "observation", "flat", to="rows"),
        node("MatMul", "rows", "w", to="raw"),
        node("Tanh", "raw", to="t"),
        node("Reshape", "t", "out", to="action"),
    ], {"w": WEIGHT, "flat": np.array([-1, 17]), "out": np.array(out)}


@pytest.mark.parametrize(
    ("declared", "out"),
    [
        (["n", 17], [-1, 4]),
        ([None, 17], [-1, 4]),
        (["batch", "width"], [-1, 4]),
        (["n", 1, 17], [-1, 1, 4]),
        (["n", 17, 1], [-1, 4, 1]),
        ([1, 17], [1, 4]),
        ([1, 1, 17], [1, 1, 4]),
        ([17], [4]),
        ([17, 1], [4, 1]),
        ([64, 17], [64, 4]),
        ([3, 1, 17], [3, 4]),
    ],
    ids=str,
)
def test_the_same_numbers_fly_in_any_shape(declared, out):
    nodes, weights = reshaped(out)
    sizes = [None if size == -1 else size for size in out]
    content = model(nodes, [value("observation", declared)], [value("action", sizes)], **weights)
    np.testing.assert_allclose(actions(content), WANTED, atol=1e-6)
    controller = read_onnx(content, "p.onnx")
    np.testing.assert_allclose(jax.vmap(lambda o: controller.act((), o)[1])(OBSERVATIONS[:7]), WANTED[:7], atol=1e-6)


@pytest.mark.parametrize(("kind", "number"), [(TensorProto.DOUBLE, np.float64), (TensorProto.FLOAT16, np.float16)])
def test_observations_and_actions_of_another_precision_are_converted(kind, number):
    nodes = [node("Clip", "observation", "least", "most", to="near"), node("MatMul", "near", "w", to="raw")]
    nodes += [node("Tanh", "raw", to="action")]
    weights = {"w": WEIGHT.astype(number), "least": number(-100), "most": number(100)}
    content = model(nodes, [value("observation", ["n", 17], kind)], [value("action", ["n", 4], kind)], **weights)
    wanted = np.tanh(np.clip(OBSERVATIONS, -100, 100) @ WEIGHT)
    assert np.mean(np.abs(actions(content) - wanted) < (1e-6 if number is np.float64 else 0.05)) > 0.97


def test_other_names_and_further_outputs_are_accepted_where_no_doubt_is_left():
    nodes = [
        node("MatMul", "obs", "w", to="raw"),
        node("Tanh", "raw", to="mean"),
        node("ReduceSum", "mean", to="value"),
    ]
    inputs, outputs = [value("obs", ["n", 17])], [value("value", [1, 1]), value("mean", ["n", 4])]
    np.testing.assert_allclose(actions(model(nodes, inputs, outputs, w=WEIGHT)), WANTED, atol=1e-6)
    both = [value("raw", ["n", 4]), value("action", ["n", 4])]
    named = [FIRST, node("Tanh", "raw", to="action")]
    np.testing.assert_allclose(actions(model(named, outputs=both, w=WEIGHT)), WANTED, atol=1e-6)


def test_an_output_of_unknown_shape_is_accepted_and_checked_when_it_is_run():
    outputs, nodes = [value("action", ["n", "m"])], [FIRST, node("Tanh", "raw", to="action")]
    np.testing.assert_allclose(actions(model(nodes, outputs=outputs, w=WEIGHT)), WANTED, atol=1e-6)
    with pytest.raises(BadInput, match=r"gives actions of shape \(256, 3\) for 256 observations. Allowed: \(256, 4\)"):
        actions(model(nodes, outputs=outputs, w=WEIGHT[:, :3]))
