"""From LLVM instructions to a function that XLA calls: the loop over the batch, its compilation and its registration.

XLA calls a handler with one pointer to a frame that holds the addresses of all buffers (XLA's FFI, c_api.h). The
handler is a few instructions and is compiled with the loop, so that no C++ compiler is needed.
"""

import contextlib
import ctypes
import functools
import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from flytune.config.files import write_bytes
from flytune.errors import BadInput
from flytune.kernels.emit import Emitter, Values, llvm_type

WIDTH = 16  # elements that the loop computes at once
# bytes from the start of XLA's structures: the frame, the metadata it may ask for, a buffer
ARGUMENTS, RESULTS, EXTENSION, METADATA, MAJOR, MINOR, DATA = 72, 112, 8, 24, 24, 28, 24
VERSION = (0, 1)  # of the interface that these offsets belong to
DECLARATIONS = (
    *(f"declare float @llvm.{name}.f32(float)" for name in ("sqrt", "fabs", "floor")),
    *(f"declare float @llvm.{name}.f32(float, float)" for name in ("maximum", "minimum")),
    *(f"declare i32 @llvm.{name}.sat.i32.f32(float)" for name in ("fptosi", "fptoui")),
    *(
        f"declare <{width} x float> @llvm.fmuladd.v{width}f32({', '.join([f'<{width} x float>'] * 3)})"
        for width in range(1, 33)
    ),
    *(f"declare float @llvm.vector.reduce.fadd.v{width}f32(float, <{width} x float>)" for width in (8, 16, 32)),
)
LOOP_METADATA = (
    "!0 = distinct !{!0, !1, !2, !3}",
    '!1 = !{!"llvm.loop.vectorize.enable", i1 true}',
    f'!2 = !{{!"llvm.loop.vectorize.width", i32 {WIDTH}}}',
    '!3 = !{!"llvm.loop.interleave.count", i32 1}',
)


def module(functions: Sequence[str], main: str, inputs: int, outputs: int) -> tuple[str, str]:
    """The name of a kernel, which depends on all that it computes, and its LLVM module.

    Args:
        functions: in LLVM, of any names.
        main: the name of the one that XLA calls; it takes pointers to all inputs, then to all outputs.
        inputs: their number.
        outputs: their number.
    """
    text = "\n".join([*DECLARATIONS, *functions, _handler(main, inputs, outputs), *LOOP_METADATA])
    name = f"flytune_{hashlib.sha256(text.encode()).hexdigest()[:24]}"
    return name, text.replace("@KERNEL", f"@{name}")


def function(name: str, inputs: int, outputs: int, body: Sequence[str], *, shared: bool = False) -> str:
    """A function in LLVM of pointers %in0, ... and %out0, ..., which do not overlap.

    With `shared`, another thread may read and write what they point to.
    """
    kind = "ptr" if shared else "ptr noalias"
    arguments = ", ".join(f"{kind} {buffer}" for buffer in _buffers(inputs, outputs))
    return "\n".join([f"define internal void @{name}({arguments}) noinline {{", *body, "  ret void", "}"])


def vectorised(number: int) -> str:
    """What a branch back to the start of a loop carries so that LLVM computes many elements at once."""
    return ", !llvm.loop !0" if number >= WIDTH else ""  # of fewer elements, LLVM would say that it does not


def _buffers(inputs: int, outputs: int) -> list[str]:
    return [f"%in{index}" for index in range(inputs)] + [f"%out{index}" for index in range(outputs)]


def loop(name: str, jaxpr: Any, batched: Sequence[bool], number: int) -> str:
    """A function in LLVM that computes a jaxpr of one element for a batch.

    Args:
        name: of the function.
        jaxpr: closed, of one element.
        batched: of each input, whether it has a last axis of `number` elements; the others are the same for all.
        number: elements of the batch. Outputs are batched.

    Raises:
        Unsupported: a primitive has no form as a loop.
    """
    emitter, before = Emitter("%v"), Emitter("%u")
    inputs = [
        _loads(emitter if each else before, f"%in{index}", variable.aval, number if each else 0)
        for index, (variable, each) in enumerate(zip(jaxpr.jaxpr.invars, batched, strict=True))
    ]
    outputs = emitter.run(jaxpr.jaxpr, jaxpr.consts, inputs)
    stores = [
        line
        for index, (values, variable) in enumerate(zip(outputs, jaxpr.jaxpr.outvars, strict=True))
        for line in _stores(f"%out{index}", values, variable.aval, number)
    ]
    body = [
        "entry:",
        *before.lines,
        "  br label %loop",
        "loop:",
        "  %i = phi i64 [0, %entry], [%next, %loop]",
        *emitter.lines,
        *stores,
        "  %next = add nuw nsw i64 %i, 1",
        f"  %more = icmp ult i64 %next, {number}",
        f"  br i1 %more, label %loop, label %end{vectorised(number)}",
        "end:",
    ]
    return function(name, len(inputs), len(outputs), body)


def _memory_type(dtype: Any) -> str:
    return "i8" if np.dtype(dtype) == np.bool_ else llvm_type(dtype)


def _loads(emitter: Emitter, buffer: str, kind: Any, number: int) -> Values:
    """The numbers of an input, of the element %i where `number` elements follow each other in memory."""
    memory, values = _memory_type(kind.dtype), np.empty(kind.shape, object)
    for position, index in enumerate(np.ndindex(kind.shape)):
        address = emitter.add(f"getelementptr {memory}, ptr {buffer}, i64 {position * max(number, 1)}")
        address = emitter.add(f"getelementptr {memory}, ptr {address}, i64 %i") if number else address
        value = emitter.add(f"load {memory}, ptr {address}, align {1 if memory == 'i8' else 4}")
        values[index] = emitter.add(f"trunc i8 {value} to i1") if memory == "i8" else value
    return values


def _stores(buffer: str, values: Values, kind: Any, number: int) -> list[str]:
    """The instructions that write the numbers of an output, of the element %i."""
    memory, lines = _memory_type(kind.dtype), []
    for position, value in enumerate(np.broadcast_to(values, kind.shape).flat):
        name = f"{buffer.replace('out', 'o')}_{position}"
        written = f"{name}_b" if memory == "i8" else value
        lines += [f"  {written} = zext i1 {value} to i8"] * (memory == "i8")
        lines += [
            f"  {name}_r = getelementptr {memory}, ptr {buffer}, i64 {position * number}",
            f"  {name}_a = getelementptr {memory}, ptr {name}_r, i64 %i",
            f"  store {memory} {written}, ptr {name}_a, align {1 if memory == 'i8' else 4}",
        ]
    return lines


def _handler(main: str, inputs: int, outputs: int) -> str:
    """What XLA calls: it answers what version it is of, or takes the addresses of the buffers and calls `main`."""
    buffers = _buffers(inputs, outputs)
    counts = {"in": ARGUMENTS, "out": RESULTS}
    lines = []
    for kind, offset in counts.items():
        lines += [
            f"  %{kind}s_p = getelementptr i8, ptr %frame, i64 {offset}",
            f"  %{kind}s = load ptr, ptr %{kind}s_p",
        ]
    for buffer in buffers:
        kind = buffer[1:].rstrip("0123456789")
        index, name = buffer[1 + len(kind) :], buffer[1:]
        lines += [
            f"  %{name}_p = getelementptr ptr, ptr %{kind}s, i64 {index}",
            f"  %{name}_b = load ptr, ptr %{name}_p",
            f"  %{name}_d = getelementptr i8, ptr %{name}_b, i64 {DATA}",
            f"  {buffer} = load ptr, ptr %{name}_d",
        ]
    return "\n".join(
        [
            "define ptr @KERNEL(ptr %frame) {",
            f"  %ext_p = getelementptr i8, ptr %frame, i64 {EXTENSION}",
            "  %ext = load ptr, ptr %ext_p",
            "  %asks = icmp ne ptr %ext, null",
            "  br i1 %asks, label %answer, label %run",
            "answer:",
            f"  %meta_p = getelementptr i8, ptr %ext, i64 {METADATA}",
            "  %meta = load ptr, ptr %meta_p",
            f"  %major = getelementptr i8, ptr %meta, i64 {MAJOR}",
            f"  store i32 {VERSION[0]}, ptr %major",
            f"  %minor = getelementptr i8, ptr %meta, i64 {MINOR}",
            f"  store i32 {VERSION[1]}, ptr %minor",
            "  ret ptr null",
            "run:",
            *lines,
            f"  call void @{main}({', '.join(f'ptr {buffer}' for buffer in buffers)})",
            "  ret ptr null",
            "}",
        ]
    )


@functools.cache
def vector_width() -> int:
    """Numbers in a vector register of this processor, in single precision."""
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    return 16 if features.get("avx512f") else 8 if features.get("avx") else 4


def architecture() -> str:
    """The name of the architecture of this processor, for instance x86_64."""
    from llvmlite import binding

    return binding.get_process_triple().split("-")[0]


@functools.cache
def _machine() -> Any:
    """LLVM's description of this processor."""
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(),
        features=binding.get_host_cpu_features().flatten(),
        opt=3,
        codemodel="jitdefault",
    )


_engines: dict[str, Any] = {}  # the machine code of each registered kernel, kept for as long as the process lives
_recorders: list[set[str]] = []


@contextlib.contextmanager
def recorded() -> Iterator[set[str]]:
    """The names of the kernels that are registered, or are registered already and asked for again, meanwhile."""
    names: set[str] = set()
    _recorders.append(names)
    try:
        yield names
    finally:
        _recorders.remove(names)


def register(name: str, text: str) -> None:
    """Make machine code of a module and tell XLA of it, once per process.

    The code is kept beside XLA's compiled programs, where JAX has a folder for them (`jax_compilation_cache_dir`).
    """
    for names in _recorders:
        names.add(name)
    if not load(name):
        code = _compile(text)
        place = _place(name)
        if place is not None:
            keep(place, code)
        _register(name, code)


def load(name: str) -> bool:
    """Whether a kernel is registered, after an attempt with the code that an earlier process kept."""
    if name not in _engines:
        place = _place(name)
        code = None if place is None else kept(place)
        if code is not None:
            _register(name, code)
    return name in _engines


def _register(name: str, code: bytes) -> None:
    from llvmlite import binding

    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _machine())
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _engines[name] = engine
    capsule = ctypes.pythonapi.PyCapsule_New
    capsule.restype, capsule.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    jax.ffi.register_ffi_target(name, capsule(engine.get_function_address(name), None, None), platform="cpu")


def _compile(text: str) -> bytes:
    """The object code of a module for this processor."""
    from llvmlite import binding

    parsed = binding.parse_assembly(text)
    parsed.verify()
    options = binding.create_pipeline_tuning_options(speed_level=3)
    options.loop_vectorization, options.slp_vectorization, options.loop_unrolling = True, False, False
    passes = binding.create_pass_builder(_machine(), options)
    passes.getModulePassManager().run(parsed, passes)
    return _machine().emit_object(parsed)


@functools.cache
def processor() -> str:
    """This processor and the version of LLVM: what machine code is made for."""
    from llvmlite import binding

    return f"{binding.get_host_cpu_name()} {binding.get_host_cpu_features().flatten()} {binding.llvm_version_info}"


def _place(name: str) -> Path | None:
    """Where the code of a kernel is kept; another processor or another version of LLVM has another file."""
    folder = cache_folder()
    return None if folder is None else folder / f"{name}-{hashlib.sha256(processor().encode()).hexdigest()[:12]}.o"


def cache_folder() -> Path | None:
    """Where JAX keeps compiled programs, None where it keeps none on this machine."""
    folder: str | None = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    return None if folder is None or "://" in folder else Path(folder)


def kept(place: Path) -> bytes | None:
    """The content of a file that `keep` wrote, None where there is none or it is damaged."""
    content = place.read_bytes() if place.is_file() else b""
    digest, content = content[:32], content[32:]
    return content if content and hashlib.sha256(content).digest() == digest else None


def keep(place: Path, content: bytes) -> None:
    """Write a file, with a digest before its content; a folder that cannot be written only costs time."""
    with contextlib.suppress(OSError, BadInput):
        place.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(place, hashlib.sha256(content).digest() + content)
