"""A file's bytes, looked at here and there, by reading.

No memory map: where somebody cuts a mapped file short, the next look into it ends the process without a word (SIGBUS).
"""

import errno
import os
import re
from typing import IO, overload

_BLOCK = 1 << 16
_OVERLAP = 64  # no match of a pattern looks at more


class FileBytes:
    """Looks like the bytes that a file held when this was made; raises OSError if they are no longer there."""

    def __init__(self, stream: IO[bytes]):
        self._stream = stream
        self._size = os.fstat(stream.fileno()).st_size
        self._block, self._block_at = b"", 0

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, place: int) -> int: ...

    @overload
    def __getitem__(self, place: slice) -> bytes: ...

    def __getitem__(self, place: int | slice) -> int | bytes:
        if isinstance(place, int):
            return self._between(place, place + 1)[0]
        begin, end, step = place.indices(self._size)
        if step != 1:
            raise ValueError(f"only bytes in a row can be looked at, not every {step}th")
        return self._between(begin, end)

    def search(self, pattern: re.Pattern[bytes], begin: int, end: int | None = None) -> int | None:
        """Returns where a pattern, whose matches look at few bytes, matches first from a place on; None: nowhere."""
        end = self._size if end is None else min(end, self._size)
        while begin < end:
            block_end = self._block_at + len(self._block)
            needed = min(begin + _OVERLAP, self._size - 1)
            if not self._block_at <= begin <= needed < block_end:
                self._load(begin)
                block_end = self._block_at + len(self._block)
            found = pattern.search(self._block, begin - self._block_at, min(end, block_end) - self._block_at)
            sure = end if block_end >= end else block_end - _OVERLAP  # what matches behind it may look beyond the block
            if found is not None and self._block_at + found.start() < sure:
                return self._block_at + found.start()
            begin = sure
        return None

    def _between(self, begin: int, end: int) -> bytes:
        if end <= begin:
            return b""
        if end - begin > _BLOCK:
            return self._read(begin, end)
        if begin < self._block_at or end > self._block_at + len(self._block):
            self._load(begin)
        return self._block[begin - self._block_at : end - self._block_at]

    def _load(self, begin: int) -> None:
        self._block, self._block_at = self._read(begin, min(begin + _BLOCK, self._size)), begin

    def _read(self, begin: int, end: int) -> bytes:
        self._stream.seek(begin)
        data = self._stream.read(end - begin)
        if len(data) < end - begin:
            raise OSError(errno.EIO, "it was cut short while it was read")
        return data
