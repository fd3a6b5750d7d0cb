"""ONNX files from other programs: those that follow the conventions fly, all others are refused with their reason."""

import os

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flytune.errors import BadInput
from flytune.evaluation.fly import fly
from flytune.task.files import load_task

onnx = pytest.importorskip("onnx", reason="needs flytune[onnx]")
pytest.importorskip("onnxruntime", reason="needs flytune[onnx]")

from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from flytune.export.onnx import CONVENTIONS, OnnxController, load_onnx  # noqa: E402
from flytune.export.untrusted.onnx_controller import read_onnx, sample_observations  # noqa: E402

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


def test_operators_of_other_makers_loops_randomness_and_functions_are_refused():
    own = helper.make_node("Tanh", ["raw"], ["action"], domain="com.microsoft")
    assert_refused(make_model((*LAYERS[:3], own), opsets=("", "com.microsoft")), "'com.microsoft::Tanh' is not allowed")
    noise = helper.make_node("RandomNormalLike", ["raw"], ["more"])
    assert_refused(make_model(squashed(noise)), "'RandomNormalLike' is not allowed")
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"])],
        "for_ever",
        [value("i", [], TensorProto.INT64), value("go", [], TensorProto.BOOL)],
        [value("on", [], TensorProto.BOOL)],
    )
    loop = helper.make_node("Loop", ["", "yes"], [], body=body)
    assert_refused(make_model((loop, *LAYERS), yes=np.array(True)), "'Loop' is not allowed")
    with_function = make_model()
    with_function.functions.append(helper.make_function("own", "F", ["x"], ["x"], [], [helper.make_opsetid("", 17)]))
    assert_refused(with_function, "contains functions")


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
        ({"inputs": [value("obs", ["n", 17])]}, "has the inputs 'obs'"),
        ({"inputs": [value("observation", ["n", 17]), value("h", ["n", 8])]}, "has the inputs 'observation', 'h'"),
        ({"outputs": [value("action", ["n", 4]), value("raw", ["n", 4])]}, "has the outputs 'action', 'raw'"),
        ({"inputs": [value("observation", ["n", 12])], "first": FIRST[:, :12]}, r"has shape ['n', 12]"),
        ({"inputs": [value("observation", [17])]}, "has shape [17]"),
        ({"inputs": [value("observation", [1, 17])]}, "has the fixed batch size 1"),
        ({"inputs": [value("observation", ["n", 17], TensorProto.DOUBLE)]}, "is of type DOUBLE"),
        ({"outputs": [value("action", ["n", 2])], "second": SECOND[:2]}, r"has shape ['n', 2]"),
        ({"facts": {}}, "entry 'observation' is missing"),
        ({"facts": CONVENTIONS | {"observation": "height, speed\nand more"}}, "entry 'observation' is 'height"),
        ({"facts": CONVENTIONS | {"action": "rpm"}}, "entry 'action' is 'rpm'"),
        ({"facts": CONVENTIONS | {"rate": "500 Hz"}}, "entry 'rate' is '500 Hz'"),
    ],
)  # fmt: skip
def test_a_model_for_something_else_is_refused_with_what_it_has_and_what_is_wanted(change, reason):
    nodes = list(LAYERS)
    if change.get("inputs") and change["inputs"][0].name == "obs":
        nodes[0] = helper.make_node("Gemm", ["obs", "first", "bias"], ["sum"], transB=1)
    assert_refused(make_model(nodes, **change), reason)


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
    # which of the two refuses an operator set of the future depends on the version of onnx
    with pytest.raises(BadInput, match=r"onnxruntime cannot run it|is a damaged ONNX model"):
        read_onnx(make_model(version=99).SerializeToString(), "p.onnx")


def test_tensors_of_text_or_with_fewer_numbers_than_their_shape_are_refused():
    short = make_model()
    short.graph.initializer[0].raw_data = short.graph.initializer[0].raw_data[:-4]
    assert_refused(short, "damaged", "first")
    assert_refused(make_model(first=np.array([["a"] * 17] * 8, dtype=object)), "is a damaged ONNX model")
    unused = make_model(unused=np.array(["a"], dtype=object))
    assert_refused(unused, "'unused' has a type that is not allowed. Allowed: FLOAT")


# --- random damage ---


@pytest.fixture(scope="module")
def good():
    """The bytes of a small model that flies."""
    content = make_model(facts=CONVENTIONS | {"task": "baseline"}).SerializeToString()
    assert isinstance(read_onnx(content, "p.onnx"), OnnxController)
    return content


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
