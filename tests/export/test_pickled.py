"""Pickles of strangers: their numbers are read, nothing in them is run, and their size is bounded."""

import io
import os
import pickle
import struct
import tracemalloc

import numpy as np
import pytest

from flytune.errors import BadInput
from flytune.export.untrusted.normalisation import read_statistics
from flytune.export.untrusted.pickled import Record, read_array, read_pickle

ARRAYS = [
    np.arange(6.0).reshape(2, 3),
    np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
    np.arange(4, dtype=">f8"),
    np.zeros((0, 17), np.float16),
    np.float32(3.5),
    np.float64(-1e300),
    np.array(2.0),
    0.25,
    7,
]


@pytest.mark.parametrize("protocol", [4, 5])
@pytest.mark.parametrize("value", ARRAYS, ids=lambda value: f"{np.shape(value)}{np.asarray(value).dtype}")
def test_the_numbers_of_an_array_are_read_as_they_were_written(value, protocol):
    found = read_array(read_pickle(pickle.dumps(value, protocol)))
    assert found.dtype == float and found.shape == np.shape(value)
    np.testing.assert_array_equal(found, value)


@pytest.mark.parametrize(
    "value", [np.arange(3), np.array(["a"]), np.array([{}], dtype=object), "text", [1.0], True, {}]
)
def test_what_is_no_array_of_floating_point_numbers_is_refused(value):
    with pytest.raises(BadInput, match=r"allowed|damaged array"):
        read_array(read_pickle(pickle.dumps(value)))


class Trap:
    """What leaves a file behind where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"), {"state": 1})


def test_a_call_becomes_a_record_and_nothing_is_run(tmp_path):
    found = read_pickle(pickle.dumps({"a": Trap(tmp_path / "sprung"), "b": np.ones(2)}))
    assert isinstance(found["a"], Record) and found["a"].path.endswith("open")
    assert found["a"].args == (str(tmp_path / "sprung"), "w") and found["a"].state == {"state": 1}
    np.testing.assert_array_equal(read_array(found["b"]), [1, 1])
    assert not (tmp_path / "sprung").exists()
    pickle.loads(pickle.dumps(Trap(tmp_path / "sprung"))).close()
    assert (tmp_path / "sprung").exists()  # the trap itself works


def test_what_a_file_names_is_new_for_each_file_and_cannot_be_changed():
    # GLOBAL os system, then BUILD on the class itself with ({}, {"path": "mine"})
    changed = b"\x80\x04cos\nsystem\n}}\x8c\x04path\x8c\x04mines\x86b."
    with pytest.raises(TypeError):
        read_pickle(changed)
    found = read_pickle(b"\x80\x04cos\nsystem\n.")
    assert issubclass(found, Record) and found.path == "os.system" and Record.path == ""
    assert found is not read_pickle(b"\x80\x04cos\nsystem\n.") and os.system.__name__ == "system"


def nested_key():
    """A table whose key is a tuple that holds itself twice, forty levels deep: its hash takes 2^40 steps."""
    return b"\x80\x04})" + b"2\x86" * 40 + b"Ns."


HOSTILE = {
    "bytes that are not there": b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b".",
    "text that is not there": b"\x80\x05\x8d" + struct.pack("<Q", 2**62) + b".",
    "a frame that is not there": b"\x80\x04\x95" + struct.pack("<Q", 2**60) + b"N.",
    "millions of tables": b"\x80\x04" + b"}" * 4_000_000 + b".",
    "millions of sets": b"\x80\x04" + b"\x8f" * 1000 + b".",
    "a hash that never ends": nested_key(),
    "a registered extension": b"\x80\x04\x82\x01.",
    "the oldest protocol": pickle.dumps([1.0], 0),
    "a whole number of text": b"\x80\x04I" + b"9" * 100_000 + b"\n.",
    "something of another file": b"\x80\x04\x8c\x01aQ.",
    "nothing on the stack": b"\x80\x04R.",
    "a call of a number": b"\x80\x04K\x01)R.",
    "a new object of a number": b"\x80\x04K\x01)\x81.",
    "a state of a number": b"\x80\x04K\x01}b.",
    "no end": b"\x80\x04N",
    "nothing": b"",
    "text": b"a policy, honestly",
}


@pytest.mark.parametrize("content", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_pickle_is_refused_in_one_line_and_takes_no_memory(content, tmp_path):
    (tmp_path / "s.pkl").write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(BadInput) as caught:
            read_statistics(tmp_path / "s.pkl")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert str(caught.value).startswith(f"{tmp_path / 's.pkl'}: ") and len(str(caught.value).splitlines()) == 1
    assert peak < 3 * len(content) + 50e6  # 200,000 instructions of at most some 200 bytes each


# --- statistics as arrays ---


def written(path, **arrays):
    np.savez_compressed(path, **arrays)
    return path


def test_statistics_of_another_program_are_read_from_arrays(tmp_path):
    mean, var = np.arange(17.0), np.full(17, 4.0)
    found = read_statistics(written(tmp_path / "s.npz", mean=mean, var=var))
    np.testing.assert_allclose(found.deviation, 2, atol=1e-8)
    assert found.clip == np.inf and found.mean.tolist() == mean.tolist()
    found = read_statistics(written(tmp_path / "s.npz", mean=mean[None], var=var[None], epsilon=5.0, clip=3.0))
    np.testing.assert_allclose(found.deviation, 3)
    assert found.clip == 3


@pytest.mark.parametrize(
    ("arrays", "complaint"),
    [
        ({"mean": np.zeros(12), "var": np.ones(12)}, "statistics of 12 and 12 numbers, allowed: 17"),
        ({"mean": np.zeros(17), "var": np.ones(16)}, "statistics of 17 and 16 numbers"),
        ({"mean": np.zeros(17), "var": -np.ones(17)}, "not finite, or variances and a clip that are not above 0"),
        ({"mean": np.full(17, np.nan), "var": np.ones(17)}, "not finite"),
        ({"mean": np.zeros(17), "var": np.ones(17), "clip": 0.0}, "not above 0"),
        ({"mean": np.zeros(17)}, r"holds the arrays \['mean'\]"),
        ({"mean": np.zeros(17), "var": np.ones(17), "std": np.ones(17)}, "'std'"),
        ({"mean": np.zeros(17), "var": np.array([{}] * 17)}, "is damaged"),
        ({"mean": np.zeros(17), "var": np.ones(17), "count": np.zeros(3_000_000)}, "unpacks to more than 16 MiB"),
    ],
)
def test_arrays_that_are_no_statistics_are_refused_in_one_line(tmp_path, arrays, complaint):
    with pytest.raises(BadInput, match=complaint) as caught:
        read_statistics(written(tmp_path / "s.npz", **arrays))
    assert len(str(caught.value).splitlines()) == 1


def test_damaged_missing_and_huge_files_of_statistics_are_refused_in_one_line(tmp_path):
    buffer = io.BytesIO()
    np.savez(buffer, mean=np.zeros(17), var=np.ones(17))
    for end in range(0, len(buffer.getvalue()) - 1, 41):
        (tmp_path / "s.npz").write_bytes(buffer.getvalue()[:end])
        with pytest.raises(BadInput, match="is damaged"):
            read_statistics(tmp_path / "s.npz")
    with open(tmp_path / "huge.pkl", "wb") as file:
        os.truncate(file.fileno(), 10**12)
    for path, complaint in [(tmp_path / "huge.pkl", "larger than 16 MiB"), (tmp_path, "Is a directory")]:
        with pytest.raises(BadInput, match=complaint):
            read_statistics(path)
    with pytest.raises(BadInput, match="No such file"):
        read_statistics(tmp_path / "missing.pkl")
