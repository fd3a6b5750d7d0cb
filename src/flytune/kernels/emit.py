"""From a jaxpr of scalars and small arrays to LLVM instructions: one element, no loop and no memory.

Every number of every array becomes one LLVM value. So slices, stacks and reshapes cost nothing: they only rename
values. Python's own functions on object arrays do the renaming.
"""

import functools
import struct
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.extend.random
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from flytune.kernels.elementary import FUNCTIONS

Values = np.ndarray  # of LLVM values and constants, as text; the shape is that of the JAX array
INFINITY = "0x7FF0000000000000"

BINARY = {  # of floats, of integers
    "add": ("fadd", "add"), "add_any": ("fadd", "add"), "sub": ("fsub", "sub"), "mul": ("fmul", "mul"),
    "div": ("fdiv", "sdiv"), "and": ("", "and"), "or": ("", "or"), "xor": ("", "xor"), "shift_left": ("", "shl"),
    "shift_right_logical": ("", "lshr"), "shift_right_arithmetic": ("", "ashr"),
}  # fmt: skip
COMPARISONS = {"eq": "eq", "ne": "ne", "lt": "lt", "le": "le", "gt": "gt", "ge": "ge"}
INTRINSICS = {"sqrt": "sqrt", "abs": "fabs", "floor": "floor", "max": "maximum", "min": "minimum"}  # of floats
REDUCTIONS = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_and": "and", "reduce_or": "or"}
SAME = ("stop_gradient", "copy", "optimization_barrier", "random_wrap", "random_unwrap", "device_put")
CALLS = ("jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2", "custom_jvp_call")


class Unsupported(Exception):
    """A primitive of JAX has no form here; the text is its name."""


def llvm_type(dtype: Any) -> str:
    """The LLVM type of a number."""
    return {"float32": "float", "int32": "i32", "uint32": "i32", "bool": "i1"}[np.dtype(dtype).name]


def constant(value: Any, dtype: Any) -> str:
    """A number as LLVM writes it; floats by the bits of the double of the same value."""
    kind = np.dtype(dtype)
    if kind == np.float32:
        return f"0x{struct.unpack('<Q', struct.pack('<d', float(np.float32(value))))[0]:016X}"
    if kind == np.bool_:
        return "true" if value else "false"
    return str(np.asarray(value).astype(kind).astype(np.int32))


def constants(array: Any, dtype: Any) -> Values:
    """A constant array."""
    return np.vectorize(lambda value: constant(value, dtype), otypes=[object])(np.asarray(array))


class Emitter:
    """The instructions of one element, in order; the same instruction is written once."""

    def __init__(self, prefix: str = "%v") -> None:
        self.lines: list[str] = []
        self._known: dict[str, str] = {}
        self._prefix = prefix  # of the names of values

    def add(self, instruction: str) -> str:
        """The value of an instruction."""
        if instruction not in self._known:
            self._known[instruction] = name = f"{self._prefix}{len(self._known)}"
            self.lines.append(f"  {name} = {instruction}")
        return self._known[instruction]

    def run(self, jaxpr: Any, consts: Iterable[Any], inputs: Sequence[Values]) -> list[Values]:
        """The outputs of a jaxpr.

        Raises:
            Unsupported: a primitive has no form here.
        """
        known: dict[Any, Values] = dict(zip(jaxpr.invars, inputs, strict=True))
        known |= {variable: constants(value, variable.aval.dtype)
                  for variable, value in zip(jaxpr.constvars, consts, strict=True)}  # fmt: skip

        def read(atom: Any) -> Values:
            kind: Any = atom.aval
            return constants(atom.val, kind.dtype) if isinstance(atom, core.Literal) else known[atom]

        for equation in (each for each in jaxpr.eqns if each.outvars):
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            known |= dict(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _equation(self, equation: Any, inputs: list[Values]) -> list[Values]:
        name, parameters = equation.primitive.name, equation.params
        kinds = [atom.aval for atom in equation.invars]
        out: Any = equation.outvars[0].aval
        if name in CALLS or name.startswith("custom_vjp_call"):
            inner = next(parameters[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in parameters)
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), inputs)
        if name in SAME:
            return inputs
        if name in FUNCTIONS:
            return self._function(FUNCTIONS[name], kinds, inputs)
        if name.startswith("random_"):
            return self._random(name, parameters, inputs)
        if name == "iota_2x32_shape":
            low = np.arange(int(np.prod(parameters["shape"]))).reshape(parameters["shape"])
            return [constants(np.zeros_like(low), np.uint32), constants(low, np.uint32)]
        renamed = _rename(name, parameters, inputs, out)
        if renamed is not None:
            return renamed
        if name in REDUCTIONS or name in ("argmin", "argmax"):
            return [
                self._reduce(name, [int(axis) for axis in parameters["axes"]], inputs[0], kinds[0].dtype, out.shape)
            ]
        if name == "dot_general":
            return [self._product(parameters["dimension_numbers"], inputs[0], inputs[1], out.shape)]
        types = [kind.dtype for kind in kinds]
        return [_each(functools.partial(self._scalar, name, parameters, types), *inputs)]

    def _function(self, function: Callable[..., Any], kinds: Sequence[Any], inputs: list[Values]) -> list[Values]:
        """A function in JAX, computed for each element."""
        scalars = [jax.ShapeDtypeStruct((), kind.dtype) for kind in kinds]
        traced = jax.make_jaxpr(function)(*scalars)
        arrays = np.broadcast_arrays(*inputs)
        results = [np.empty(arrays[0].shape, object) for _ in traced.out_avals]
        for index in np.ndindex(arrays[0].shape):
            values = self.run(traced.jaxpr, traced.consts, [np.array(array[index], object) for array in arrays])
            for result, value in zip(results, values, strict=True):
                result[index] = value[()]
        return results

    def _random(self, name: str, parameters: Any, inputs: list[Values]) -> list[Values]:
        """Random numbers of JAX's default generator; a key is its two words along the last axis."""
        generator = jax.extend.random.threefry_prng_impl
        if inputs[0].shape != (2,):
            raise Unsupported(f"{name} of several keys")
        functions: dict[str, Callable[..., Any]] = {
            "random_bits": lambda key: generator.random_bits(key, parameters["bit_width"], parameters["shape"]),
            "random_split": lambda key: generator.split(key, parameters["shape"]),
            "random_fold_in": generator.fold_in,
        }
        if name not in functions:
            raise Unsupported(name)
        kinds = [jax.ShapeDtypeStruct((2,), jnp.uint32)]
        kinds += [jax.ShapeDtypeStruct(value.shape, jnp.uint32) for value in inputs[1:]]
        traced = jax.make_jaxpr(functions[name])(*kinds)
        return self.run(traced.jaxpr, traced.consts, inputs)

    def _reduce(self, name: str, axes: Sequence[int], values: Values, dtype: Any, shape: Sequence[int]) -> Values:
        rows = np.moveaxis(values, tuple(axes), tuple(range(len(axes))))
        rows = [np.asarray(row, object) for row in rows.reshape(-1, *rows.shape[len(axes) :])]
        if not rows:
            return constants(np.zeros(shape), dtype)
        if name in REDUCTIONS:
            add = functools.partial(self._scalar, REDUCTIONS[name], {}, [dtype, dtype])
            return functools.reduce(functools.partial(_each, add), rows)
        compare, best = "fcmp olt float" if name == "argmin" else "fcmp ogt float", rows[0]
        where = constants(np.zeros(best.shape), np.int32)
        for number, row in enumerate(rows[1:], start=1):
            better = _each(lambda x, y: self.add(f"{compare} {x}, {y}"), row, best)
            best = _each(lambda w, x, y: self.add(f"select i1 {w}, float {x}, float {y}"), better, row, best)
            where = _each(lambda w, y, n=number: self.add(f"select i1 {w}, i32 {n}, i32 {y}"), better, where)
        return where

    def _product(self, dimensions: Any, first: Values, second: Values, shape: Sequence[int]) -> Values:
        (left, right), batched = dimensions
        if batched[0]:
            raise Unsupported("dot_general with batch dimensions")
        inner = int(np.prod([first.shape[axis] for axis in left]))
        rows = np.moveaxis(first, left, range(first.ndim - len(left), first.ndim)).reshape(-1, inner)
        columns = np.moveaxis(second, right, range(len(right))).reshape(inner, -1)
        multiply, add = (functools.partial(self._scalar, name, {}, [np.float32] * 2) for name in ("mul", "add"))
        return np.array(
            [[functools.reduce(add, map(multiply, row, column)) for column in columns.T] for row in rows], object
        ).reshape(shape)

    def _scalar(self, name: str, parameters: Any, types: Sequence[Any], *values: str) -> str:
        """The value of a primitive on numbers."""
        kind = np.dtype(types[0])
        floats, text = kind == np.float32, llvm_type(types[0])
        add = self.add
        match name:
            case "max" | "min" if not floats:
                sign = ("u" if kind == np.uint32 else "s") + ("gt" if name == "max" else "lt")
                first, second = values
                return add(f"select i1 {add(f'icmp {sign} {text} {first}, {second}')}, {text} {first}, {text} {second}")
            case _ if name in INTRINSICS and floats:
                return add(f"call float @llvm.{INTRINSICS[name]}.f32(float {', float '.join(values)})")
            case "shift_left" | "shift_right_logical":  # LLVM does not define shifts by 32 and more
                shifted = add(f"{BINARY[name][1]} {text} {values[0]}, {values[1]}")
                if values[1].isdigit():
                    return shifted if int(values[1]) < 32 else "0"
                return add(f"select i1 {add(f'icmp ult i32 {values[1]}, 32')}, i32 {shifted}, i32 0")
            case _ if name in BINARY:
                return add(f"{BINARY[name][0]} contract float {values[0]}, {values[1]}" if floats
                           else f"{BINARY[name][1]} {text} {values[0]}, {values[1]}")  # fmt: skip
            case _ if name in COMPARISONS:
                sign = "" if name in ("eq", "ne") else "u" if kind in (np.uint32, np.bool_) else "s"
                code = f"fcmp {'u' if name == 'ne' else 'o'}{name}" if floats else f"icmp {sign}{name}"
                return add(f"{code} {text} {values[0]}, {values[1]}")
            case "neg":
                return add(f"fneg float {values[0]}" if floats else f"sub {text} 0, {values[0]}")
            case "not":
                return add(f"xor {text} {values[0]}, {'true' if text == 'i1' else -1}")
            case "square":
                return add(f"fmul contract float {values[0]}, {values[0]}")
            case "one_minus_square":  # of jax from 0.11 on; this form keeps its digits near 1
                one = constant(1, np.float32)
                return add(f"fmul contract float {add(f'fadd float {one}, {values[0]}')}, "
                           f"{add(f'fsub float {one}, {values[0]}')}")  # fmt: skip
            case "integer_pow":
                return self._integer_power(values[0], parameters["y"])
            case "rsqrt":
                return add(f"fdiv float {constant(1, np.float32)}, {self._scalar('sqrt', {}, types, *values)}")
            case "sign":
                one, minus, zero = (constant(number, np.float32) for number in (1, -1, 0))
                below = add(f"fcmp olt float {values[0]}, {zero}")
                rest = add(f"select i1 {below}, float {minus}, float {values[0]}")  # keeps 0 and NaN
                return add(f"select i1 {add(f'fcmp ogt float {values[0]}, {zero}')}, float {one}, float {rest}")
            case "is_finite":
                return add(f"fcmp one float {self._scalar('abs', {}, types, *values)}, {INFINITY}")
            case "select_n":
                which, no, yes = values
                text = llvm_type(types[1])
                return add(f"select i1 {which}, {text} {yes}, {text} {no}")
            case "clamp":
                low, value, high = values
                above = self._scalar("max", {}, types, value, low)
                return self._scalar("min", {}, types, above, high)
            case "bitcast_convert_type":
                new = llvm_type(parameters["new_dtype"])
                return values[0] if new == text else add(f"bitcast {text} {values[0]} to {new}")
            case "convert_element_type":
                return self._convert(values[0], kind, np.dtype(parameters["new_dtype"]))
        raise Unsupported(name)

    def _integer_power(self, value: str, exponent: int) -> str:
        def multiply(first: str, second: str) -> str:
            return self.add(f"fmul contract float {first}, {second}")

        left, square, result = abs(exponent), value, constant(1, np.float32)
        while left:
            if left & 1:
                result = square if result == constant(1, np.float32) else multiply(result, square)
            left >>= 1
            square = multiply(square, square) if left else square
        return result if exponent > 0 else self.add(f"fdiv float {constant(1, np.float32)}, {result}")

    def _convert(self, value: str, old: np.dtype, new: np.dtype) -> str:
        integers = (np.int32, np.uint32)
        if old == new or (old in integers and new in integers):
            return value
        if new == np.float32:
            return self.add(f"{'sitofp' if old == np.int32 else 'uitofp'} {llvm_type(old)} {value} to float")
        if new == np.bool_:
            zero = constant(0, old)
            return self.add(f"fcmp une float {value}, {zero}" if old == np.float32 else f"icmp ne i32 {value}, {zero}")
        if old == np.bool_:
            return self.add(f"zext i1 {value} to i32")
        return self.add(f"call i32 @llvm.{'fptosi' if new == np.int32 else 'fptoui'}.sat.i32.f32(float {value})")


def _each(function: Callable[..., str], *arrays: Values) -> Values:
    """A function of numbers, element by element."""
    parts = np.broadcast_arrays(*arrays)
    result = np.empty(parts[0].shape, object)
    for index in np.ndindex(result.shape):
        result[index] = function(*(part[index] for part in parts))
    return result


def _rename(name: str, parameters: Any, inputs: list[Values], out: Any) -> list[Values] | None:
    """The outputs of a primitive that only arranges its inputs; None of another primitive."""
    match name:
        case "broadcast_in_dim":
            shape = [1] * len(parameters["shape"])
            for size, axis in zip(inputs[0].shape, parameters["broadcast_dimensions"], strict=True):
                shape[axis] = size
            return [np.broadcast_to(inputs[0].reshape(shape), parameters["shape"])]
        case "reshape" | "squeeze" | "expand_dims":
            words = (2,) if jnp.issubdtype(out.dtype, jax.dtypes.prng_key) else ()
            return [inputs[0].reshape((*out.shape, *words))]
        case "transpose":
            return [inputs[0].transpose(parameters["permutation"])]
        case "slice":
            steps = parameters["strides"] or [1] * inputs[0].ndim
            parts = zip(parameters["start_indices"], parameters["limit_indices"], steps, strict=True)
            return [inputs[0][tuple(map(slice, *zip(*parts, strict=True)))]] if inputs[0].ndim else inputs
        case "concatenate":
            return [np.concatenate(inputs, axis=parameters["dimension"])]
        case "stack":
            return [np.stack(inputs, axis=parameters["axis"])]
        case "unstack":
            return [np.array(part, object) for part in np.moveaxis(inputs[0], parameters["axis"], 0)]
        case "split":
            return list(np.split(inputs[0], np.cumsum(parameters["sizes"])[:-1], axis=parameters["axis"]))
        case "rev":
            return [np.flip(inputs[0], parameters["dimensions"])]
        case "pad":
            padded = np.full(out.shape, inputs[1][()], object)
            sizes = zip(parameters["padding_config"], inputs[0].shape, strict=True)
            padded[tuple(slice(low, low + size) for (low, _, _), size in sizes)] = inputs[0]
            return [padded]
        case "iota":
            rows = np.arange(parameters["shape"][parameters["dimension"]])
            shape = [-1 if axis == parameters["dimension"] else 1 for axis in range(len(parameters["shape"]))]
            return [constants(np.broadcast_to(rows.reshape(shape), parameters["shape"]), parameters["dtype"])]
    return None
