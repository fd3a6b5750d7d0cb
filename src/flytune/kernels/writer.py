"""The instructions of a kernel on whole arrays of numbers: products, sums, formulas and transpositions, in LLVM."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytune.kernels.emit import Emitter
from flytune.kernels.native import function, vector_width, vectorised

ZERO = "0.0"
ROWS = 6  # of a tile of a product; with two vectors of columns it fills the registers of AVX2


class Writer:
    """The instructions of a kernel on whole arrays of floats."""

    def __init__(self) -> None:
        self._room: list[str] = []  # allocations, which LLVM turns into registers where they come first
        self._lines: list[str] = []
        self._count, self._block = 0, "entry"

    def _new(self, instruction: str) -> str:
        self._count += 1
        self._lines.append(f"  %w{self._count} = {instruction}")
        return f"%w{self._count}"

    def _register(self, width: int) -> str:
        self._count += 1
        self._room.append(f"  %r{self._count} = alloca {_vector(width)}")
        return f"%r{self._count}"

    def at(self, pointer: str, index: str | int) -> str:
        """The pointer to a number behind another."""
        return self._new(f"getelementptr float, ptr {pointer}, i64 {index}")

    def _load(self, pointer: str, width: int = 0) -> str:
        return self._new(f"load {_vector(width)}, ptr {pointer}, align 4")

    def _store(self, value: str, pointer: str, width: int = 0) -> None:
        self._lines.append(f"  store {_vector(width)} {value}, ptr {pointer}, align 4")

    def each(self, number: int, body: Callable[[str], Any], metadata: str = "") -> None:
        """A loop; `body` writes the instructions of the index it is given. Without an index nothing is written."""
        if number == 0:  # the condition stands behind the body
            return
        self._count += 1
        name = f"loop{self._count}"
        before, index, following = self._block, f"%i{self._count}", f"%n{self._count}"
        self._lines += [
            f"  br label %{name}",
            f"{name}:",
            f"  {index} = phi i64 [0, %{before}], [{following}, %{name}_next]",
        ]
        self._block = name
        body(index)
        self._lines += [
            f"  br label %{name}_next",
            f"{name}_next:",
            f"  {following} = add nuw nsw i64 {index}, 1",
            f"  %m{name} = icmp ult i64 {following}, {number}",
            f"  br i1 %m{name}, label %{name}, label %{name}_end{metadata}",
            f"{name}_end:",
        ]
        self._block = f"{name}_end"

    def _columns(self, number: int, body: Callable[[str, int], Any]) -> None:
        """All columns: in a loop, as many at once as two vectors hold, then those that are left."""
        width = 2 * vector_width()
        if number >= width:
            self.each(number // width, lambda index: body(self._new(f"mul i64 {index}, {width}"), width))
        if number % width:
            body(str(number - number % width), number % width)

    def _splat(self, value: str, width: int) -> str:
        kind = _vector(width)
        first = self._new(f"insertelement {kind} poison, float {value}, i64 0")
        return self._new(f"shufflevector {kind} {first}, {kind} poison, <{width} x i32> zeroinitializer")

    def product(
        self,
        shape: tuple[int, int, int],
        left: tuple[str, int, int],
        right: tuple[str, int],
        out: tuple[str, int],
        start: str | None = None,
        *,
        add: bool = False,
    ) -> None:
        """A product of matrices: out[m, n] = start[m] + sum over k of left[m, k] * right[k, n].

        Args:
            shape: rows, columns and the length of the sum.
            left: pointer, and the distance in memory from row to row and from column to column.
            right: pointer, and the distance from row to row.
            out: likewise.
            start: pointer to one number for each row, None for zeros.
            add: whether the product is added to what is in `out`.
        """
        rows, columns, length = shape
        tiles = -(-rows // ROWS)
        edges = [rows * tile // tiles for tile in range(tiles + 1)]

        def block(column: str, width: int) -> None:
            kind = _vector(width)
            for low, high in itertools.pairwise(edges):
                sums = []
                for row in range(low, high):
                    value = "zeroinitializer"
                    if add:
                        value = self._load(self.at(self.at(out[0], row * out[1]), column), width)
                    elif start is not None:
                        value = self._splat(self._load(self.at(start, row)), width)
                    sums.append(self._register(width))
                    self._store(value, sums[-1], width)

                def multiply_and_add(k: str, low: int = low, high: int = high, sums: list[str] = sums) -> None:
                    place = self._new(f"mul i64 {k}, {right[1]}")
                    across = self._load(self.at(self.at(right[0], column), place), width)
                    place = self._new(f"mul i64 {k}, {left[2]}")
                    down = self.at(left[0], place)
                    for row, total in zip(range(low, high), sums, strict=True):
                        factor = self._splat(self._load(self.at(down, row * left[1])), width)
                        old = self._load(total, width)
                        self._store(
                            self._new(
                                f"call {kind} @llvm.fmuladd.v{width}f32({kind} {factor}, {kind} {across}, {kind} {old})"
                            ),
                            total,
                            width,
                        )

                self.each(length, multiply_and_add)
                for row, total in zip(range(low, high), sums, strict=True):
                    place = self.at(self.at(out[0], row * out[1]), column)
                    self._store(self._load(total, width), place, width)

        self._columns(columns, block)

    def sum_rows(self, source: str, out: str, rows: int, columns: int, *, add: bool = False) -> None:
        """out[n] = sum over m of source[m, n], or that added to what is in `out`."""

        def block(column: str, width: int) -> None:
            kind = _vector(width)
            total = self._register(width)
            self._store(self._load(self.at(out, column), width) if add else "zeroinitializer", total, width)

            def add_row(row: str) -> None:
                place = self.at(self.at(source, column), self._new(f"mul i64 {row}, {columns}"))
                old = self._load(total, width)
                self._store(self._new(f"fadd {kind} {old}, {self._load(place, width)}"), total, width)

            self.each(rows, add_row)
            self._store(self._load(total, width), self.at(out, column), width)

        self._columns(columns, block)

    def total(self, source: str, out: str, number: int, *, square: bool = False) -> None:
        """out[0] = the sum of source[i], or of its squares."""
        width = 2 * vector_width()
        kind, last = _vector(width), number % width
        sums = self._register(width)
        self._store("zeroinitializer", sums, width)

        def add(index: str) -> None:
            value = self._load(self.at(source, self._new(f"mul i64 {index}, {width}")), width)
            value = self._new(f"fmul {kind} {value}, {value}") if square else value
            self._store(self._new(f"fadd {kind} {self._load(sums, width)}, {value}"), sums, width)

        if number >= width:
            self.each(number // width, add)
        name = f"@llvm.vector.reduce.fadd.v{width}f32"
        result = self._new(f"call float {name}(float {ZERO}, {kind} {self._load(sums, width)})")
        for index in range(number - last, number):
            value = self._load(self.at(source, index))
            value = self._new(f"fmul float {value}, {value}") if square else value
            result = self._new(f"fadd float {result}, {value}")
        self._store(result, out)

    def elementwise(self, formula: Callable[..., Any], sources: Sequence[str], out: str, number: int) -> None:
        """out[i] = formula(sources[i]), a function in JAX of numbers."""
        traced = jax.make_jaxpr(formula)(*[jax.ShapeDtypeStruct((), jnp.float32)] * len(sources))

        def body(index: str) -> None:
            self._count += 1
            emitter = Emitter(f"%e{self._count}_")
            values = [emitter.add(f"load float, ptr {self.at(source, index)}, align 4") for source in sources]
            (result,) = emitter.run(traced.jaxpr, traced.consts, [np.array(value, object) for value in values])
            self._lines += emitter.lines
            self._store(str(result[()]), self.at(out, index))

        self.each(number, body, vectorised(number))

    def transpose(self, source: str, out: str, rows: int, columns: int) -> None:
        """out[n, m] = source[m, n]."""

        def block(row: str | int, column: str | int, height: int, width: int) -> None:
            offset = self._new(f"mul i64 {row}, {columns}")
            first = self.at(self.at(source, offset), column)
            offset = self._new(f"mul i64 {column}, {rows}")
            target = self.at(self.at(out, offset), row)
            lines = [self._load(self.at(first, index * columns), width) for index in range(height)]
            for index, line in enumerate(self._turn(lines, height, width)):
                self._store(line, self.at(target, index * rows), height)

        for row in range(0, rows - rows % 8, 8):
            self.each(columns // 8, lambda index, row=row: block(row, self._new(f"mul i64 {index}, 8"), 8, 8))
        left = columns % 8
        if left:
            for row in range(0, rows, 8):
                block(row, columns - left, min(8, rows - row), left)
        if rows % 8 and columns >= 8:
            self.each(columns // 8, lambda index: block(rows - rows % 8, self._new(f"mul i64 {index}, 8"), rows % 8, 8))

    def _turn(self, lines: list[str], height: int, width: int) -> list[str]:
        """The columns of a block of at most 8 x 8 numbers, given its rows."""
        if height == width == 8:
            for step in (4, 2, 1):  # exchange of the halves of pairs of rows
                low = [i if i & step == 0 else 8 + (i ^ step) for i in range(8)]
                high = [i ^ step if i & step == 0 else 8 + i for i in range(8)]
                new = list(lines)
                for i in range(8):
                    if i & step == 0:
                        new[i] = self._shuffle(lines[i], lines[i | step], low, 8)
                        new[i | step] = self._shuffle(lines[i], lines[i | step], high, 8)
                lines = new
            return lines
        columns = []
        for column in range(width):
            value = "poison"
            for row, line in enumerate(lines):
                number = self._new(f"extractelement {_vector(width)} {line}, i64 {column}")
                value = self._new(f"insertelement {_vector(height)} {value}, float {number}, i64 {row}")
            columns.append(value)
        return columns

    def _shuffle(self, first: str, second: str, order: Sequence[int], width: int) -> str:
        kind, mask = _vector(width), ", ".join(f"i32 {index}" for index in order)
        return self._new(f"shufflevector {kind} {first}, {kind} {second}, <{len(order)} x i32> <{mask}>")

    def copy(self, source: str | None, out: str, number: int) -> None:
        """out[i] = source[i], or 0 where there is no source."""
        self.each(number, lambda i: self._store(self._load(self.at(source, i)) if source else ZERO, self.at(out, i)))

    def copy_one(self, source: str, out: str) -> None:
        """out[0] = source[0]."""
        self._store(self._load(source), out)

    def row(self, source: str, index: str, columns: int) -> str:
        """The pointer to the row of a matrix whose index, an integer, is in memory."""
        row = self._new(f"zext i32 {self._new(f'load i32, ptr {index}, align 4')} to i64")
        return self.at(source, self.times(row, columns))

    def call(self, name: str, *pointers: str) -> None:
        """A call of a function in LLVM, see `native.function`."""
        self._lines.append(f"  call void @{name}({', '.join(f'ptr {pointer}' for pointer in pointers)})")

    def times(self, index: str, factor: int, before: int = 0) -> str:
        """before + factor * index."""
        product = self._new(f"mul i64 {index}, {factor}")
        return self._new(f"add i64 {product}, {before}")

    def remainder(self, index: str, divisor: int) -> str:
        """index modulo divisor."""
        return self._new(f"urem i64 {index}, {divisor}")

    def function(self, name: str, inputs: int, outputs: int, *, shared: bool = False) -> str:
        """The function in LLVM, see `native.function`."""
        return function(name, inputs, outputs, ["entry:", *self._room, *self._lines], shared=shared)


def _vector(width: int) -> str:
    return f"<{width} x float>" if width else "float"
