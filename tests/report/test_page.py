"""Pages: the script of plotly, packed once for all processes."""

import base64
import gzip

import jax
import pytest
from plotly.offline import get_plotlyjs

from flytune.report import page


@pytest.fixture
def folder(tmp_path):
    """JAX's folder for compiled programs, an empty one."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def packed():
    """The packed script, as a new process has it."""
    page._packed_plotly.cache_clear()
    return page._packed_plotly()


def test_plotly_is_packed_once_and_a_damaged_copy_is_packed_again(folder):
    first = packed()
    assert gzip.decompress(base64.b64decode(first)).decode() == get_plotlyjs()
    (kept,) = folder.iterdir()
    changed = kept.stat().st_mtime_ns
    assert packed() == first
    assert kept.stat().st_mtime_ns == changed  # read, and not written again
    whole = kept.read_bytes()
    kept.write_bytes(whole[:-1000])
    assert packed() == first
    assert kept.read_bytes() == whole


def test_plotly_is_packed_without_a_folder_to_keep_it_in(folder):
    jax.config.update("jax_compilation_cache_dir", None)
    assert gzip.decompress(base64.b64decode(packed())).decode() == get_plotlyjs()
    assert not list(folder.iterdir())
