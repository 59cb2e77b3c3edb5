"""A file's bytes by reading: as if they were in memory, and an error where they are gone."""

import os
import re

import numpy as np
import pytest

from replay import file_bytes
from replay.file_bytes import FileBytes


@pytest.fixture
def opened(tmp_path, monkeypatch):
    """Opens a file of random bytes, read in small blocks; returns the bytes, too."""
    monkeypatch.setattr(file_bytes, "_BLOCK", 256)
    data = np.random.default_rng(3).integers(0, 4, 5000).astype(np.uint8).tobytes()
    (tmp_path / "file").write_bytes(data)
    with (tmp_path / "file").open("rb") as stream:
        yield FileBytes(stream), data


def test_slices_and_bytes_are_those_of_the_file(opened):
    view, data = opened
    assert len(view) == len(data)
    rng = np.random.default_rng(4)
    for begin, end in rng.integers(0, 5300, (300, 2)).tolist():
        assert view[begin:end] == data[begin:end]
    assert view[-20:] == data[-20:]
    assert [view[at] for at in (0, 255, 256, 4999, 3)] == [data[at] for at in (0, 255, 256, 4999, 3)]
    with pytest.raises(IndexError):
        view[5000]
    with pytest.raises(ValueError, match="only bytes in a row"):
        view[0:9:2]


@pytest.mark.parametrize("pattern", [rb"\x01\x02\x03", rb"(?=\x01.{9}\x02)", rb"(?=\x03\x03\x03\x03\x03)", rb"\x09"])
def test_a_search_finds_what_it_finds_in_memory(opened, pattern):
    view, data = opened
    compiled = re.compile(pattern, re.DOTALL)
    rng = np.random.default_rng(5)
    for begin, end in [(0, None), (4990, None), (6000, None), *rng.integers(0, 5300, (200, 2)).tolist()]:
        expected = compiled.search(data, begin, len(data) if end is None else end)
        assert view.search(compiled, begin, end) == (None if expected is None else expected.start())


def test_bytes_that_are_gone_are_an_error(opened, tmp_path):
    view, data = opened
    os.truncate(tmp_path / "file", 300)
    assert view[:200] == data[:200]
    with pytest.raises(OSError, match="it was cut short while it was read"):
        view[4000:4010]


def test_an_empty_file_has_none(tmp_path):
    (tmp_path / "empty").write_bytes(b"")
    with (tmp_path / "empty").open("rb") as stream:
        view = FileBytes(stream)
        assert (len(view), view[:9], view.search(re.compile(b"x"), 0)) == (0, b"", None)
