"""Files made anew of ranges of an old file and of new bytes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import BinaryIO

_COPY_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Copied:
    """Bytes ``start`` to ``end`` of the source; ``end`` None is the end of the file."""

    start: int
    end: int | None


Piece = Copied | bytes
"""A file made anew is a sequence of these."""


def write_pieces(source: BinaryIO, pieces: Sequence[Piece], target: BinaryIO) -> None:
    """Write the pieces one after the other; ranges of the source are copied in blocks."""
    for piece in joined(pieces):
        if isinstance(piece, bytes):
            target.write(piece)
            continue
        source.seek(piece.start)
        left = piece.end - piece.start if piece.end is not None else None
        while block := source.read(_COPY_BYTES if left is None else min(left, _COPY_BYTES)):
            target.write(block)
            left = None if left is None else left - len(block)


def joined(pieces: Sequence[Piece]) -> list[Piece]:
    """Return the pieces with neighbouring ranges made one."""
    result: list[Piece] = []
    for piece in pieces:
        last = result[-1] if result else b""
        if isinstance(piece, Copied) and isinstance(last, Copied) and last.end == piece.start:
            result[-1] = replace(last, end=piece.end)
        else:
            result.append(piece)
    return result
