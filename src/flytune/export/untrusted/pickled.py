"""Pickles of strangers, read without running anything: each name in them becomes an inert record.

A pickle is a program for a small machine, and may call any function that it names. Here no name is ever looked up: a
class or function becomes a `Record` of its arguments. Arrays of NumPy are made from their records.

Source: Python's `pickletools`, which describes each instruction; the `__reduce__` of NumPy's arrays and dtypes.
"""

import io
import math
import pickle
import pickletools
from typing import Any

import numpy as np

from flytune.errors import BadInput

MOST = 200_000  # instructions; VecNormalize writes some 600, and one or two per environment
# Left out are those that ask for a registered extension, share memory, hash what a file nests, or are of protocol 0.
# fmt: off
INSTRUCTIONS = {
    "PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK", "MEMOIZE", "BINPUT", "LONG_BINPUT", "BINGET", "LONG_BINGET",
    "NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT",
    "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8",
    "SHORT_BINSTRING", "BINSTRING", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3",
    "EMPTY_LIST", "APPEND", "APPENDS", "EMPTY_DICT", "SETITEM", "SETITEMS",
    "GLOBAL", "STACK_GLOBAL", "REDUCE", "NEWOBJ", "NEWOBJ_EX", "BUILD", "BINPERSID",
}
# fmt: on
ARRAYS = {f"numpy.{core}.multiarray._reconstruct" for core in ("core", "_core")}
BUFFERS = {f"numpy.{core}.numeric._frombuffer" for core in ("core", "_core")}
SCALARS = {f"numpy.{core}.multiarray.scalar" for core in ("core", "_core")}


class Record:
    """What a pickle says of an object: the name of its class or function, the arguments, and its state."""

    path = ""  # of a subclass: module and name
    state: Any = None

    def __new__(cls, *args: Any, **named: Any) -> "Record":
        """The record of a call; nothing is called."""
        made = object.__new__(cls)
        made.args = args
        return made

    args: tuple[Any, ...]

    def __init__(self, *args: Any, **named: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        """Keep the state that the object would have got."""
        self.state = state

    def append(self, item: Any) -> None:
        """Leave out the items of containers, such as a deque."""

    def __setitem__(self, key: Any, value: Any) -> None:
        """Leave out the items of tables, such as an OrderedDict."""


_Machine: Any = pickle._Unpickler  # written in Python; its type stubs leave most of it out


class Reader(_Machine):
    """A reader whose objects are numbers, text, bytes, tuples, lists, dictionaries and records.

    It builds on the unpickler written in Python: the one in C allocates as much memory as the largest memo number
    of a file asks for.
    """

    def __init__(self, content: bytes) -> None:
        if content[:1] != b"\x80":  # as every pickle since protocol 2 begins
            raise BadInput("is not a pickle.")
        for count, (instruction, *_) in enumerate(pickletools.genops(content)):
            if count >= MOST or instruction.name not in INSTRUCTIONS:
                found = f"over {MOST} instructions" if count >= MOST else f"the instruction {instruction.name}"
                raise BadInput(f"its pickle holds {found}, allowed: the instructions of numbers and tables.")
        super().__init__(io.BytesIO(content), encoding="bytes")
        self._kinds: dict[str, type[Record]] = {}

    def find_class(self, module: Any, name: Any) -> Any:
        """A kind of record, new for each file, so that a file cannot change anything that outlives it."""
        path = f"{module}.{name}"[:200]
        return self._kinds.setdefault(path, type("Record", (Record,), {"path": path}))

    def load_bytearray8(self) -> None:
        """The bytes that are there; the base class allocates as many as the file says first."""
        size = int.from_bytes(self.read(8), "little")
        self.append(bytearray(self.read(size)))

    def load_setitem(self) -> None:
        """One entry of a table."""
        _check_keys(self.stack[-2:-1])
        super().load_setitem()

    def load_setitems(self) -> None:
        """Entries of a table."""
        _check_keys(self.stack[::2])
        super().load_setitems()


_KNOWN = {each.name: ord(each.code) for each in pickletools.opcodes if each.name in INSTRUCTIONS}
Reader.dispatch = {code: _Machine.dispatch[code] for code in _KNOWN.values()} | {
    _KNOWN["BYTEARRAY8"]: Reader.load_bytearray8,
    _KNOWN["SETITEM"]: Reader.load_setitem,
    _KNOWN["SETITEMS"]: Reader.load_setitems,
}


def _check_keys(keys: list[Any]) -> None:
    # the hash of tuples nested in each other may take for ever
    if not all(isinstance(key, str | int) for key in keys):
        raise BadInput("its pickle holds a table with keys that are neither text nor whole numbers.")


def read_pickle(content: bytes) -> Any:
    """What a pickle describes, with records in place of objects.

    Raises:
        BadInput: it is too long, or holds an instruction that numbers and tables do not need.
        Exception: of many classes, where it is damaged.
    """
    return Reader(content).load()


def read_array(found: Any) -> np.ndarray:
    """The floating-point array, scalar or number that a record describes, as float64.

    Raises:
        BadInput: it describes something else.
    """
    path: str = getattr(found, "path", "")
    if isinstance(found, int | float) and not isinstance(found, bool):
        return np.asarray(found, float)
    try:
        record: Any = found
        if path in BUFFERS:
            content, kind, shape, order = record.args
        elif path in ARRAYS:
            _, shape, kind, fortran, content = record.state
            order = "F" if fortran else "C"
        elif path in SCALARS:
            (kind, content), shape, order = record.args, (), "C"
        else:
            raise BadInput(f"holds {path or type(found).__name__} where numbers belong, allowed: an array of NumPy.")
        dtype = _dtype(kind)
        if len(content) != math.prod(shape) * dtype.itemsize:
            raise BadInput(f"holds {len(content)} bytes for an array of shape {shape}.")
        return np.frombuffer(bytes(content), dtype).reshape(shape, order=order).astype(float)
    except (TypeError, ValueError, AttributeError, OverflowError):
        raise BadInput("holds a damaged array.") from None


def _dtype(kind: Any) -> np.dtype:
    code, order = kind.args[0], kind.state[1]
    if kind.path != "numpy.dtype" or code not in ("f2", "f4", "f8") or order not in ("<", ">"):
        raise BadInput(f"holds numbers of the kind {code!r:.20}, allowed: floating point.")
    return np.dtype(order + code)
