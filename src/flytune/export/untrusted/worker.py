"""The process that checks and runs ONNX models of strangers; `sandbox` starts it. It imports nothing of flytune.

It reads requests from its standard input and writes an answer to each: a line of JSON, and as many bytes as that says.
"""

import json
import os
import sys
from collections import OrderedDict
from typing import Any, BinaryIO

import numpy as np

ARENA = 2**30  # bytes for the weights and the intermediate results of all models
PROCESS = 3 * 2**30  # bytes of everything
KEPT = 8  # models; the one that was used longest ago is forgotten
WIDEST = 1_000_000  # numbers that one node may compute from one observation; a layer of the paper computes 64


class OtherShape(Exception):
    """The output of a model does not hold 4 numbers for each observation."""


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer requests until there are no more."""
    models: OrderedDict[str, Any] = OrderedDict()
    while line := requests.readline():
        request = json.loads(line)
        content, result = requests.read(request["size"]), b""
        try:
            if request["do"] == "load":
                answer: dict[str, Any] = {"problem": _load(models, request["key"], content)}
            elif request["key"] not in models:
                answer = {"forgotten": True}
            else:
                models.move_to_end(request["key"])
                actions = _run(models[request["key"]], request, content)
                answer, result = {"shape": actions.shape}, actions.tobytes()
        except Exception as error:  # the exceptions of onnx and onnxruntime have no common base
            answer = {"problem": _refusal(error)}
        answers.write(json.dumps(answer | {"size": len(result)}).encode() + b"\n" + result)
        answers.flush()


def _load(models: OrderedDict[str, Any], key: str, content: bytes) -> str | None:
    """What is wrong with a model, or None where it is ready to run."""
    import onnx
    import onnxruntime

    try:
        model = onnx.load_model_from_string(content)
        onnx.checker.check_model(model, full_check=True)
        inferred = onnx.shape_inference.infer_shapes(model)
    except Exception as error:  # ValidationError, InferenceError, and RuntimeError from below
        return f"is a damaged ONNX model ({_first_line(error)}). Export it again."
    for value in inferred.graph.value_info:
        width = 1
        for size in value.type.tensor_type.shape.dim:
            width *= size.dim_value or 1
        if width > WIDEST:
            return f"node {value.name[:60]!r} computes {width} numbers per observation. Allowed: up to {WIDEST}."
    options = onnxruntime.SessionOptions()
    # a network this small needs microseconds, and a single thread repeats its sums bit by bit
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # log nothing: every failure is also an exception
    # what is computed while the graph is rewritten would not count against the arena
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.add_session_config_entry("session.use_env_allocators", "1")
    try:
        models[key] = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        return _refusal(error)
    while len(models) > KEPT:
        models.popitem(last=False)
    return None


def _run(session: Any, request: dict[str, Any], content: bytes) -> np.ndarray:
    """The output for inputs of N rows each, in batches of the size that the model wants."""
    given, start = {}, 0
    for name, kind, shape in request["inputs"]:
        count = int(np.prod(shape)) * np.dtype(kind).itemsize
        given[name] = np.frombuffer(content[start : start + count], kind).reshape(shape)
        start += count
    rows, batch = request["rows"], request["batch"]
    if batch is None:
        return _answer(session, request["output"], given, rows)
    parts = []
    for first in range(0, rows, batch):
        chosen = np.minimum(np.arange(first, first + batch), rows - 1)  # the last row fills up the last batch
        part = {name: values[chosen].reshape(request["whole"][name]) for name, values in given.items()}
        parts.append(_answer(session, request["output"], part, batch))
    return np.concatenate(parts)[:rows]


def _answer(session: Any, output: str, given: dict[str, np.ndarray], rows: int) -> np.ndarray:
    found = np.asarray(session.run([output], given)[0], np.float32)
    if found.size != 4 * rows:
        raise OtherShape(f"gives actions of shape {found.shape} for {rows} observations. Allowed: ({rows}, 4).")
    return np.ascontiguousarray(found.reshape(rows, 4))


def _refusal(error: Exception) -> str:
    text = str(error)
    if isinstance(error, MemoryError) or any(
        sign in text for sign in ("Available memory", "bad_alloc", "bad allocation")
    ):
        return f"needs more than {ARENA // 2**20} MiB of memory. Give a smaller network."
    if isinstance(error, OtherShape):
        return str(error)
    return f"onnxruntime cannot run it ({_first_line(error)}). Export it again, for instance with opset_version=17."


def _first_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 150 else f"{text[:150]}..."


def _limit_memory() -> None:
    import onnxruntime

    where = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    # strategy 1 asks the system for no more than is needed
    limit = onnxruntime.OrtArenaCfg({"max_mem": ARENA, "arena_extend_strategy": 1})
    onnxruntime.create_and_register_allocator(where, limit)
    if sys.platform == "linux":  # where the system keeps such a limit
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (PROCESS, PROCESS))


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints is no answer
    _limit_memory()
    serve(sys.stdin.buffer, answers)
