"""Logs as streams of bytes: read in blocks with bounded memory, what is lost counted span by span."""

import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from uavkit.core.errors import InputError
from uavkit.core.flight_log import Damage, LostBytes
from uavkit.core.progress import Progress

BLOCK_BYTES = 8 * 1024 * 1024
MOST_SPANS = 200
"""Damaged spans that are kept one by one; the others are counted."""


class Blocks:
    """A stream in blocks: what a scan left undecided at the end of one comes again at the head of the next.

    ``while (block := blocks.next(consumed)) is not None: ...``, where ``consumed`` is the number of bytes of the last
    block that are done with, 0 at first. A block that is not ``final`` may be decided up to any byte; the scan must
    consume the final one whole.
    """

    def __init__(self, stream: BinaryIO, block_bytes: int = BLOCK_BYTES) -> None:
        """Take a stream at its beginning."""
        self._stream, self._size = stream, block_bytes
        self._block = np.zeros(0, dtype=np.uint8)
        self.offset = 0
        """Of the block's first byte in the stream."""
        self.final = False
        """Whether the stream ends with this block."""

    def next(self, consumed: int) -> NDArray[np.uint8] | None:
        """Return the next block, None when all is consumed; one that nothing was consumed of comes again, longer."""
        if not 0 <= consumed <= len(self._block):
            raise ValueError(f"consumed {consumed} of {len(self._block)} bytes")
        self.offset += consumed
        left = self._block[consumed:]
        if self.final:
            self._block = left
            return left if len(left) else None
        more = self._stream.read(self._size)
        self.final = len(more) < self._size
        self._block = np.concatenate([left, np.frombuffer(more, dtype=np.uint8)])
        return self._block if len(self._block) else None


def feed(
    stream: BinaryIO,
    take: Callable[[NDArray[np.uint8], int, bool], int],
    progress: Progress,
    size: int,
    block_bytes: int,
) -> None:
    """Hand a stream block by block to ``take(block, offset, final)``, which returns how much of it is done with."""
    blocks, consumed = Blocks(stream, block_bytes), 0
    while (block := blocks.next(consumed)) is not None:
        consumed = take(block, blocks.offset, blocks.final)
        progress("reading the log", blocks.offset + consumed, max(size, blocks.offset + consumed))


class DamageTally:
    """Counts lost bytes; spans that touch one another count as one."""

    def __init__(self) -> None:
        """Begin with nothing lost."""
        self._lost, self._count, self._end = 0, 0, -1
        self._spans: list[LostBytes] = []

    def add(self, offset: int, length: int, why: str) -> None:
        """Count a span; spans come in the order of the file. Raises ValueError where they do not."""
        if length <= 0:
            return
        if offset < self._end:
            raise ValueError(f"span at {offset} begins before {self._end}")
        self._lost += length
        if offset == self._end and self._spans and self._count == len(self._spans):
            last = self._spans[-1]
            self._spans[-1] = LostBytes(offset=last.offset, length=last.length + length, why=last.why)
        elif offset != self._end:
            self._count += 1
            if len(self._spans) < MOST_SPANS:
                self._spans.append(LostBytes(offset=offset, length=length, why=why))
        self._end = offset + length

    def result(self) -> Damage:
        """Return what was counted."""
        return Damage(lost_bytes=self._lost, span_count=self._count, spans=tuple(self._spans))


def check_is_file(path: Path, as_a_folder: str) -> None:
    """Raise InputError for what is no file: missing, a folder, or a pipe or device, which may have no end."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if stat.S_ISDIR(mode):
        raise InputError(f"{path}: is {as_a_folder}")
    if not stat.S_ISREG(mode):
        raise InputError(f"{path}: is a device or a pipe, no file: copy what comes from it into a file, and give that")


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """Open a file to read; raises InputError naming it where it cannot be."""
    try:
        with path.open("rb") as stream:
            yield stream
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
