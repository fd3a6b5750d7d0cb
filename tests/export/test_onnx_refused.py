"""ONNX files from other programs: those that follow the conventions fly, all others are refused with their reason."""

import os

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flytune.errors import BadInput, Diverged
from flytune.evaluation.fly import fly
from flytune.task.files import load_task

onnx = pytest.importorskip("onnx", reason="needs flytune[onnx]")
pytest.importorskip("onnxruntime", reason="needs flytune[onnx]")

from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from flytune.export.onnx import CONVENTIONS, OnnxController, load_onnx  # noqa: E402
from flytune.export.untrusted.onnx_controller import read_onnx, sample_observations  # noqa: E402
from flytune.export.untrusted.sandbox import SANDBOX  # noqa: E402

RANDOM = np.random.default_rng(7)
FIRST = 0.1 * RANDOM.standard_normal((8, 17)).astype(np.float32)
SECOND = 0.05 * RANDOM.standard_normal((4, 8)).astype(np.float32)
BIAS = np.linspace(-0.2, 0.2, 8, dtype=np.float32)

LAYERS = (
    helper.make_node("Gemm", ["observation", "first", "bias"], ["sum"], transB=1),
    helper.make_node("Relu", ["sum"], ["hidden"]),
    helper.make_node("Gemm", ["hidden", "second"], ["raw"], transB=1, name="head"),
    helper.make_node("Tanh", ["raw"], ["action"]),
)


def value(name, shape, kind=TensorProto.FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def make_model(nodes=LAYERS, inputs=None, outputs=None, opsets=("",), facts=CONVENTIONS, version=17, **weights):
    """A model that differs from those that flytune writes: Gemm with transposed weights, Relu, another opset."""
    weights = {"first": FIRST, "second": SECOND, "bias": BIAS} | weights
    graph = helper.make_graph(
        nodes,
        "torch_jit",
        inputs or [value("observation", ["n", 17])],
        outputs or [value("action", ["n", 4])],
        [numpy_helper.from_array(array, name) for name, array in weights.items() if array is not None],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid(name, version) for name in opsets])
    model.ir_version = 8
    helper.set_model_props(model, facts)
    return model


def squashed(*nodes):
    """Other nodes between the network and its Tanh, from `raw` to `more`."""
    return (*LAYERS[:3], *nodes, helper.make_node("Tanh", ["more"], ["action"]))


def assert_refused(content, *reasons):
    """Assert that a file of this content is refused in one line that gives all these reasons."""
    assert reasons
    content = content if isinstance(content, bytes) else content.SerializeToString()
    with pytest.raises(BadInput) as caught:
        read_onnx(content, "p.onnx")
    line = str(caught.value)
    assert line.startswith("p.onnx: ") and len(line.splitlines()) == 1 and len(line) < 600
    assert [reason for reason in reasons if reason not in line] == [], line


@pytest.fixture(scope="module")
def good():
    """The bytes of a small model that flies."""
    content = make_model(facts=CONVENTIONS | {"task": "baseline"}).SerializeToString()
    assert isinstance(read_onnx(content, "p.onnx"), OnnxController)
    return content


# --- models that fly ---


def test_a_model_of_another_program_flies_if_it_follows_the_conventions(tmp_path):
    onnx.save(make_model(), tmp_path / "theirs.onnx")
    controller = load_onnx(tmp_path / "theirs.onnx")
    observation = sample_observations(50)[7]
    expected = np.tanh(np.maximum(observation @ FIRST.T + BIAS, 0) @ SECOND.T)
    np.testing.assert_allclose(controller.act((), jax.numpy.asarray(observation))[1], expected, atol=1e-6)
    flights = fly(controller, load_task("baseline"), trials=3, duration=0.6)
    assert np.all(np.isfinite(flights.action)) and np.abs(flights.action[:, 1:]).min() > 0


def test_weights_listed_among_the_inputs_and_unused_operator_sets_are_allowed():
    inputs = [value("observation", [None, 17]), value("first", [8, 17])]
    model = make_model(inputs=inputs, opsets=("", "some.exporter"))
    assert isinstance(read_onnx(model.SerializeToString(), "p.onnx"), OnnxController)


def test_actions_beyond_one_by_rounding_are_clipped():
    saturated = (*LAYERS[:3], helper.make_node("Tanh", ["raw"], ["t"]), helper.make_node("Mul", ["t", "k"], ["action"]))
    model = make_model(saturated, second=1000 * SECOND, k=np.float32(1 + 1e-6))
    controller = read_onnx(model.SerializeToString(), "p.onnx")
    observations = sample_observations(64)
    assert np.abs(controller.session(observations)).max() > 1
    assert np.abs(jax.vmap(lambda o: controller.act((), o)[1])(observations)).max() == 1


# --- files ---


def test_a_file_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "folder.onnx").mkdir()
    (tmp_path / "empty.onnx").write_bytes(b"")
    (tmp_path / "text.onnx").write_text("a policy, honestly\n")
    for name, reason in [
        ("missing.onnx", "no such file"),
        ("folder.onnx", "is a directory"),
        ("empty.onnx", "is not an ONNX model"),
        ("text.onnx", "is not an ONNX model"),
        ("nul\0.onnx", "no such file"),
        ("n" * 5000 + ".onnx", "no such file"),
    ]:
        with pytest.raises(BadInput, match=reason) as caught:
            load_onnx(tmp_path / name)
        assert len(str(caught.value).splitlines()) == 1


def test_a_huge_file_is_refused_without_being_read_whole(tmp_path):
    with open(tmp_path / "huge.onnx", "wb") as file:
        os.truncate(file.fileno(), 10**13)  # sparse: 10 TB that take no room, and would not fit into memory
    with pytest.raises(BadInput, match="larger than 100 MB"):
        load_onnx(tmp_path / "huge.onnx")


def test_every_truncation_and_other_protobufs_are_refused():
    content = make_model().SerializeToString()
    for end in range(0, len(content) - 1, 7):
        assert_refused(content[:end], "is not an ONNX model", "Give the file of a policy")
    assert_refused(make_model().graph, "is not an ONNX model (it contains no graph)")


# --- weights in other files ---


def external(tensor, location):
    tensor.data_location = TensorProto.EXTERNAL
    tensor.ClearField("raw_data")
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", location


@pytest.mark.parametrize("location", ["weights.bin", "../secret.bin", "/etc/hostname", "*/_ORT_MEM_ADDR_/*"])
def test_weights_in_another_file_are_refused_wherever_they_say_it_is(location):
    model = make_model()
    external(model.graph.initializer[0], location)
    assert_refused(model, "'first' is kept in another file")


def test_weights_in_another_file_are_found_in_constants_subgraphs_functions_and_half_said(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "w.bin").write_bytes(FIRST.tobytes())  # there to be read, were it asked for
    hidden = numpy_helper.from_array(FIRST, "hidden")
    external(hidden, "w.bin")
    constant = helper.make_node("Constant", [], ["first"], value=hidden)
    inside = helper.make_graph([constant], "inside", [], [value("first", [8, 17])])
    branch = helper.make_node("If", ["yes"], ["first"], then_branch=inside, else_branch=inside)
    function = helper.make_function("own", "F", [], ["first"], [constant], [helper.make_opsetid("", 17)])
    in_constant, in_branch = make_model((constant, *LAYERS), first=None), make_model((branch, *LAYERS), first=None)
    in_function = make_model()
    in_function.functions.append(function)
    flag_only, entry_only = make_model(), make_model()
    flag_only.graph.initializer[0].data_location = TensorProto.EXTERNAL
    entry_only.graph.initializer[0].external_data.add().key = "location"
    for model in (in_constant, in_branch, in_function, flag_only, entry_only):
        assert_refused(model, "kept in another file")


# --- more than arithmetic ---


def test_operators_of_other_makers_are_refused():
    own = helper.make_node("Tanh", ["raw"], ["action"], domain="com.microsoft")
    opsets = ("", "com.microsoft")
    assert_refused(make_model((*LAYERS[:3], own), opsets=opsets), "'com.microsoft::Tanh' is not allowed", "standard")
    unknown = helper.make_node("TanhOfMine", ["raw"], ["action"])
    assert_refused(make_model((*LAYERS[:3], unknown)), "'TanhOfMine' is not allowed", "standard")


@pytest.mark.parametrize(
    "node",
    [
        helper.make_node("RandomNormalLike", ["raw"], ["more"]),
        helper.make_node("RandomUniformLike", ["raw"], ["more"]),
        helper.make_node("RandomNormal", [], ["more"], shape=[1, 4]),
        helper.make_node("RandomUniform", [], ["more"], shape=[1, 4]),
        helper.make_node("Bernoulli", ["raw"], ["more"]),
        helper.make_node("Multinomial", ["raw"], ["more"]),
        helper.make_node("Dropout", ["raw", "", "yes"], ["more"]),
        helper.make_node("Dropout", ["raw", "", "computed"], ["more"]),
    ],
    ids=lambda node: f"{node.op_type}{list(node.input)}",
)
def test_operators_that_draw_random_numbers_are_refused_with_this_reason(node):
    model = make_model(squashed(node), yes=np.array(True))
    assert_refused(model, f"'{node.op_type}' is not allowed, because it draws random numbers")


def graph(*nodes):
    return helper.make_graph(nodes, "inside", [], [value("inner", ["n", 4])])


@pytest.mark.parametrize(
    "node",
    [
        helper.make_node("If", ["yes"], ["more"], then_branch=graph(), else_branch=graph()),
        helper.make_node("Loop", ["", "yes"], ["more"], body=graph()),
        helper.make_node("Scan", ["raw"], ["more"], body=graph(), num_scan_inputs=1),
        helper.make_node("SequenceMap", ["raw"], ["more"], body=graph()),
        helper.make_node("Tanh", ["raw"], ["more"], hidden=graph()),
        helper.make_node("If", ["yes"], ["more"], then_branch=graph(helper.make_node("RandomNormal", [], ["inner"]))),
    ],
    ids=lambda node: node.op_type,
)
def test_operators_that_branch_or_loop_are_refused_with_this_reason(node):
    assert_refused(make_model(squashed(node), yes=np.array(True)), f"'{node.op_type}'", "because it branches or loops")


def function(name, *nodes, opsets=("", "own"), inputs=("x",), outputs=("y",)):
    return helper.make_function("own", name, inputs, outputs, nodes, [helper.make_opsetid(each, 17) for each in opsets])


def call(name, *ends):
    return helper.make_node(name, ends[:1], ends[1:], domain="own")


def test_what_is_refused_is_refused_inside_a_function_as_well():
    for node, reason in [
        (helper.make_node("RandomNormalLike", ["x"], ["y"]), "draws random numbers"),
        (helper.make_node("If", ["x"], ["y"], then_branch=graph(), else_branch=graph()), "branches or loops"),
        (helper.make_node("Tanh", ["x"], ["y"], domain="com.microsoft"), "'com.microsoft::Tanh' is not allowed"),
    ]:
        model = make_model(squashed(call("F", "raw", "more")), opsets=("", "own"))
        model.functions.append(function("F", node))
        assert_refused(model, reason)


def test_functions_that_call_themselves_or_multiply_are_refused():
    model = make_model(squashed(call("F40", "raw", "more")), opsets=("", "own"))
    model.functions.append(function("F0", helper.make_node("Sin", ["x"], ["y"])))
    for level in range(40):  # each calls the one before twice: 2^40 nodes in 3 kB
        model.functions.append(function(f"F{level + 1}", call(f"F{level}", "x", "m"), call(f"F{level}", "m", "y")))
    assert_refused(model, "contains more than 10000 nodes")
    endless = make_model(squashed(call("F", "raw", "more")), opsets=("", "own"))
    endless.functions.extend([function("F", call("G", "x", "y")), function("G", call("F", "x", "y"))])
    assert_refused(endless, "functions that call themselves")


def test_a_file_of_countless_parts_is_refused_before_they_take_memory():
    nodes = b"\x0a\x00" * 20_000_000  # 40 MB, which protobuf would turn into some 3 GB of empty nodes
    size, length = len(nodes), b""
    while size:
        size, length = size >> 7, length + bytes([(size & 127) | (128 if size > 127 else 0)])
    assert_refused(b"\x08\x08\x3a" + length + nodes, "has more than 100000 parts")


def swollen(factor, condition=()):
    """Nodes that add 0 to `raw`, by way of as many numbers as `factor` times the largest number of `raw` say."""
    return (
        *condition,
        helper.make_node("Abs", ["when" if condition else "raw"], ["sizes"]),
        helper.make_node("ReduceMax", ["sizes"], ["largest"], keepdims=0),
        helper.make_node("Mul", ["largest", "factor"], ["wanted"]),
        helper.make_node("Cast", ["wanted"], ["whole"], to=TensorProto.INT64),
        helper.make_node("Unsqueeze", ["whole", "zero"], ["shape"]),
        helper.make_node("ConstantOfShape", ["shape"], ["zeros"]),
        helper.make_node("ReduceSum", ["zeros"], ["nothing"], keepdims=0),
        helper.make_node("Add", ["raw", "nothing"], ["more"]),
    ), {"factor": np.float32(factor), "zero": np.array([0])}


def test_memory_that_only_the_observation_decides_on_is_limited():
    nodes, constants = swollen(2.0**35)
    assert_refused(make_model(squashed(*nodes), **constants), "needs more than 1024 MiB of memory")
    nodes, constants = swollen(1000.0)
    assert isinstance(
        read_onnx(make_model(squashed(*nodes), **constants).SerializeToString(), "p.onnx"), OnnxController
    )


def test_a_model_that_takes_too_long_is_ended_and_others_go_on(good):
    shapes = {"long": np.array([1, 1, 900_000]), "wide": np.array([1, 1, 400_000])}  # 2e11 products in one node
    slow = (
        helper.make_node("ConstantOfShape", ["long"], ["signal"]),
        helper.make_node("ConstantOfShape", ["wide"], ["kernel"]),
        helper.make_node("Conv", ["signal", "kernel"], ["product"]),
        helper.make_node("ReduceSum", ["product"], ["nothing"], keepdims=0),
        helper.make_node("Add", ["raw", "nothing"], ["more"]),
    )
    other = read_onnx(good, "p.onnx")
    assert_refused(make_model(squashed(*slow), **shapes), "takes longer than 10 s for the actions of one time step")
    assert np.all(np.isfinite(other.session(sample_observations(3))))  # in a process of its own, started anew


def test_a_process_that_was_ended_from_outside_is_started_anew(good):
    controller = read_onnx(good, "p.onnx")
    before = controller.session(sample_observations(3))
    SANDBOX.end()
    np.testing.assert_array_equal(controller.session(sample_observations(3)), before)


def test_a_model_that_fails_in_flight_says_why(good):
    # more numbers than there is memory for, once a vehicle is at this start; no sample observation is near it
    task = load_task("baseline")
    start = fly(read_onnx(good, "p.onnx"), task, trials=3, duration=0.6).position[2, 0, :2]
    assert np.abs(sample_observations(256)[:, :2] - start).max(axis=1).min() > 0.01
    condition = (
        helper.make_node("Slice", ["observation", "zero", "two", "one"], ["place"]),
        helper.make_node("Sub", ["place", "start"], ["away"]),
        helper.make_node("Abs", ["away"], ["each"]),
        helper.make_node("ReduceMax", ["each"], ["distance"], axes=[1]),
        helper.make_node("Less", ["distance", "near"], ["is_near"]),
        helper.make_node("Cast", ["is_near"], ["when"], to=TensorProto.FLOAT),
    )
    nodes, constants = swollen(2.0**40, condition)
    constants |= {"one": np.array([1]), "two": np.array([2])}
    constants |= {"start": np.float32(start), "near": np.float32(0.01)}
    controller = read_onnx(make_model(squashed(*nodes), **constants).SerializeToString(), "p.onnx")
    with pytest.raises(Diverged, match=r"^mine: needs more than 1024 MiB of memory"):
        fly(controller, task, trials=3, duration=0.6, name="mine")


def test_a_small_file_that_would_need_all_memory_is_refused():
    doubled = [helper.make_node("Concat", [f"x{i}", f"x{i}"], [f"x{i + 1}"], axis=1) for i in range(40)]
    back = helper.make_node("Slice", ["x40", "zero", "four", "one"], ["more"])
    start = helper.make_node("Identity", ["raw"], ["x0"])
    ends = {name: np.array([number]) for name, number in (("zero", 0), ("four", 4), ("one", 1))}
    assert_refused(
        make_model(squashed(start, *doubled, back), **ends), "numbers per observation. Allowed: up to 1000000"
    )


# --- other inputs, outputs, conventions ---


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"inputs": [value("observation", ["n", 17]), value("h", ["n", 8])]}, "has the inputs 'observation', 'h'"),
        ({"outputs": [value("raw", ["n", 4]), value("sum", ["n", 4])]}, "has the outputs 'raw', 'sum'"),
        ({"outputs": [value("action", ["n", 4], TensorProto.INT64)]}, "output 'action' is of type INT64"),
        ({"inputs": [value("h", ["n", 8]), value("c", ["n", 8])]}, "has the inputs 'h', 'c'"),
        ({"inputs": [value("observation", ["n", 12])], "first": FIRST[:, :12]}, r"has shape ['n', 12]"),
        ({"inputs": [value("observation", [17, "n"])]}, "has shape [17, 'n']"),
        ({"inputs": [value("observation", [2, 2, 17])]}, "has shape [2, 2, 17]"),
        ({"inputs": [value("observation", ["n", 17], TensorProto.INT64)]}, "is of type INT64"),
        ({"outputs": [value("action", ["n", 2])], "second": SECOND[:2]}, r"has shape ['n', 2]"),
        ({"facts": {}}, "entry 'observation' is missing"),
        ({"facts": CONVENTIONS | {"observation": "height, speed\nand more"}}, "entry 'observation' is 'height"),
        ({"facts": CONVENTIONS | {"action": "rpm"}}, "entry 'action' is 'rpm'"),
        ({"facts": CONVENTIONS | {"rate": "5 Hz"}}, "entry 'rate' is '5 Hz'"),
    ],
)  # fmt: skip
def test_a_model_for_something_else_is_refused_with_what_it_has_and_what_is_wanted(change, reason):
    assert_refused(make_model(LAYERS, **change), reason)


def test_a_state_among_the_inputs_is_named_as_what_it_is():
    inputs = [value("observation", ["n", 17]), value("h", ["n", 8])]
    assert_refused(make_model(inputs=inputs), "has the inputs 'observation', 'h'", "A policy with a memory")


def test_the_refusal_of_missing_conventions_names_the_entry_to_set_and_its_text():
    assert_refused(make_model(facts={}), repr(CONVENTIONS["observation"]), "set_model_props")


@pytest.mark.parametrize("text", [b"task", b"baseline"])
def test_metadata_that_is_not_text_is_refused(text):
    content = make_model(facts=CONVENTIONS | {"task": "baseline"}).SerializeToString()
    assert_refused(content.replace(text, text[:-3] + b"\xff\xfe\xfd"), "damaged metadata")


# --- numbers ---


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_weights_that_are_not_finite_are_refused_in_initializers_constants_and_attributes(bad):
    broken = SECOND.copy()
    broken[2, 3] = bad
    assert_refused(make_model(second=broken), "'second' contains numbers that are not finite")
    constant = helper.make_node("Constant", [], ["second"], value=numpy_helper.from_array(broken, "inside"))
    assert_refused(make_model((constant, *LAYERS), second=None), "'inside' contains numbers that are not finite")
    scalar = helper.make_node("Constant", [], ["c"], value_float=bad)
    more = helper.make_node("Mul", ["raw", "c"], ["more"])
    assert_refused(make_model(squashed(scalar, more)), "'value_float' contains numbers that are not finite")


def test_actions_that_are_not_finite_too_large_or_depend_on_the_rest_of_the_batch_are_refused():
    nothing = helper.make_node("Log", ["raw"], ["more"])
    assert_refused(make_model(squashed(nothing)), "gives an action that is not finite")
    unsquashed = (*LAYERS[:3], helper.make_node("Mul", ["raw", "gain"], ["action"]))
    assert_refused(make_model(unsquashed, gain=np.float32(100)), "gives actions up to", "Allowed: -1 to 1")
    together = helper.make_node("Softmax", ["raw"], ["action"], axis=0)
    assert_refused(make_model((*LAYERS[:3], together)), "alone in its batch")


def test_a_model_that_onnxruntime_cannot_run_is_refused():
    one_row = helper.make_node("Reshape", ["raw", "shape"], ["more"])
    assert_refused(make_model(squashed(one_row), shape=np.array([1, 4])), "onnxruntime cannot run it")


def test_an_operator_set_that_is_not_known_is_named():
    for version in (99, 6, 1):
        assert_refused(make_model(version=version), f"is written with operator set {version}. Allowed: 7 to")


def test_tensors_of_text_or_with_fewer_numbers_than_their_shape_are_refused():
    short = make_model()
    short.graph.initializer[0].raw_data = short.graph.initializer[0].raw_data[:-4]
    assert_refused(short, "damaged", "first")
    assert_refused(make_model(first=np.array([["a"] * 17] * 8, dtype=object)), "tensor 'first' holds text")
    assert_refused(make_model(unused=np.array(["a"], dtype=object)), "tensor 'unused' holds text")


# --- two faults: what is said is one of them ---

FAULTS = {
    "is kept in another file": lambda model: external(model.graph.initializer[0], "w.bin"),
    "draws random numbers": lambda model: setattr(model.graph.node[1], "op_type", "RandomNormalLike"),
    "branches or loops": lambda model: setattr(model.graph.node[3], "op_type", "Loop"),
    "is not allowed. Allowed: the operators": lambda model: setattr(model.graph.node[3], "domain", "ai.onnx.ml"),
    "metadata entry 'rate'": lambda model: model.metadata_props.pop(),
    "numbers that are not finite": lambda model: setattr(
        model.graph.initializer[2], "raw_data", b"\x00\x00\x80\x7f" + model.graph.initializer[2].raw_data[4:]
    ),
    "operator set 99": lambda model: setattr(model.opset_import[0], "version", 99),
    "has shape ['n', 12]": lambda model: setattr(model.graph.input[0].type.tensor_type.shape.dim[1], "dim_value", 12),
    "is of type INT32": lambda model: setattr(model.graph.output[0].type.tensor_type, "elem_type", TensorProto.INT32),
    "is a damaged ONNX model": lambda model: model.graph.node[0].input.append("nobody"),
}


@pytest.mark.parametrize("first", FAULTS)
def test_of_two_faults_one_is_named_and_it_is_there(first):
    for second in FAULTS:
        model = make_model()
        for fault in {first, second}:
            FAULTS[fault](model)
        with pytest.raises(BadInput) as caught:
            read_onnx(model.SerializeToString(), "p.onnx")
        assert any(fault in str(caught.value) for fault in (first, second)), f"{second}: {caught.value}"


# --- random damage ---


@settings(max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(data=st.data())
def test_a_file_damaged_anywhere_is_refused_in_one_line_or_gives_finite_actions(good, data):
    content = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        position = data.draw(st.integers(0, len(content) - 1))
        content[position] ^= data.draw(st.integers(1, 255))
    cut = data.draw(st.sampled_from([len(content), data.draw(st.integers(0, len(content)))]))
    try:
        controller = read_onnx(bytes(content[:cut]), "p.onnx")
    except BadInput as refused:
        lines = str(refused).splitlines()
    else:
        lines = []
        assert all(isinstance(text, str) for text in controller.about.values())
        actions = controller.session(sample_observations(20))
        assert actions.shape == (20, 4) and np.all(np.isfinite(actions))
    assert [line.startswith("p.onnx: ") for line in lines] in ([], [True])
