"""How large an ONNX file becomes in memory: a part takes two bytes in the file, and hundreds once it is read."""

from collections.abc import Iterable
from typing import Any

LARGEST_MESSAGES = 100_000  # parts of a file; the network of the paper has some 60
VARINT, EIGHT, BYTES, FOUR = 0, 1, 2, 5  # wire types


def count_messages(content: bytes, descriptor: Any) -> int:
    """How many fields a protobuf message and the messages in it have, at most one more than `LARGEST_MESSAGES`.

    Where the message is damaged, the count is that of the part before; who reads it will refuse it.

    Source: Protocol Buffers, "Encoding".
    """
    number, left = 0, [(0, len(content), descriptor)]
    while left and number <= LARGEST_MESSAGES:
        at, end, kind = left.pop()
        while at < end and number <= LARGEST_MESSAGES:
            number += 1
            tag, at = _varint(content, at, end)
            wire = tag & 7
            if wire == BYTES:
                size, at = _varint(content, at, end)
                field = kind.fields_by_number.get(tag >> 3)
                if field is not None and field.message_type is not None:
                    left.append((at, min(at + size, end), field.message_type))
                at += size
            elif wire == VARINT:
                _, at = _varint(content, at, end)
            elif wire in (EIGHT, FOUR):
                at += 8 if wire == EIGHT else 4
            else:  # groups, which ONNX does not use
                break
    return number


def _varint(content: bytes, at: int, end: int) -> tuple[int, int]:
    """A number of variable length, and where it ends."""
    value = shift = 0
    while at < end and shift < 70:
        byte = content[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            break
    return value, at


def count_nodes(nodes: Iterable[Any], functions: dict[tuple[str, str], Any], most: int) -> int | None:
    """How many nodes a graph has when its functions are written out, None if a function calls itself.

    Above `most`, any larger number.
    """
    known: dict[tuple[str, str], int] = {}
    open_calls: set[tuple[str, str]] = set()

    def count(nodes: Iterable[Any]) -> int | None:
        total = 0
        for node in nodes:
            key = (node.domain, node.op_type)
            if key in functions and key not in known:
                if key in open_calls:
                    return None
                open_calls.add(key)
                inside = count(functions[key].node)
                if inside is None:
                    return None
                known[key] = min(inside, most + 1)
                open_calls.discard(key)
            total += known.get(key, 0) + 1
        return total

    return count(nodes)
