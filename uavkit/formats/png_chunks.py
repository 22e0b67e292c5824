"""PNG's chunks for EXIF and XMP, put into a file whose other chunks are copied.

W3C PNG, third edition: a chunk is a length, a type of four letters, data and a check sum; eXIf holds a TIFF block, and
XMP stands in an iTXt chunk of a keyword of its own.
"""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import BinaryIO

from uavkit.core.errors import InputError
from uavkit.formats.pieces import Copied, Piece

SIGNATURE = b"\x89PNG\r\n\x1a\n"
EXIF = b"eXIf"
XMP = b"iTXtXML:com.adobe.xmp\0"
"""Type and keyword."""

_DATA, _END = b"IDAT", b"IEND"
_LARGEST_KEPT = 1 << 26
_MOST_CHUNKS = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Chunk:
    """One chunk: where it stands, and its data where it holds EXIF or XMP."""

    kind: bytes
    start: int
    end: int
    data: bytes | None

    def holds(self, header: bytes) -> bool:
        """Tell whether the chunk is of a type, and text of a keyword, that were asked for."""
        return self.data is not None and (self.kind + self.data).startswith(header)


def read_chunks(stream: BinaryIO, name: str) -> tuple[Chunk, ...]:
    """Return the chunks up to the end of the picture; raises InputError where the file is no PNG or is damaged."""
    if stream.read(8) != SIGNATURE:
        raise InputError(f"{name}: no PNG: it does not begin as one")
    chunks: list[Chunk] = []
    position = len(SIGNATURE)
    while len(chunks) < _MOST_CHUNKS:
        head = stream.read(8)
        if len(head) < 8:
            raise InputError(f"{name}: damaged or cut short: it ends at byte {position} without PNG's end")
        length, kind = struct.unpack(">I4s", head)
        data = _kept(stream, kind, length, name)
        chunks.append(Chunk(kind=kind, start=position, end=position + 12 + length, data=data))
        position += 12 + length
        stream.seek(position)
        if kind == _END:
            return tuple(chunks)
    raise InputError(f"{name}: more than {_MOST_CHUNKS} chunks: damaged")


def _kept(stream: BinaryIO, kind: bytes, length: int, name: str) -> bytes | None:
    if kind not in (EXIF, XMP[:4]) or length > _LARGEST_KEPT:
        return None
    data, check = stream.read(length), stream.read(4)
    if kind == XMP[:4] and not data.startswith(XMP[4:]):
        return None
    if check != struct.pack(">I", zlib.crc32(kind + data)):
        raise InputError(f"{name}: damaged: its {kind.decode()} chunk fails its check sum; take the original again")
    return data


def payload(chunks: tuple[Chunk, ...], header: bytes, name: str) -> bytes | None:
    """Return the EXIF block or the XMP packet; None where there is none. Raises InputError where it is damaged."""
    data = next((chunk.data for chunk in chunks if chunk.holds(header)), None)
    if data is None or header == EXIF:
        return data
    compressed, method, rest = data[len(header) - 4 :][:1], data[len(header) - 3 :][:1], data[len(header) - 2 :]
    text = rest.split(b"\0", 2)
    if len(text) < 3 or compressed not in (b"\0", b"\1") or method != b"\0":
        raise InputError(f"{name}: its XMP chunk is damaged; remove it from the still first")
    if compressed == b"\0":
        return text[2]
    try:
        return zlib.decompressobj().decompress(text[2], _LARGEST_KEPT)
    except zlib.error as error:
        raise InputError(f"{name}: its XMP chunk is damaged ({error}); remove it from the still first") from error


def rebuilt(chunks: tuple[Chunk, ...], new: Mapping[bytes, bytes]) -> list[Piece]:
    """Return the pieces of the file with EXIF or XMP (by header) in place of the old, or before the picture's data."""
    pieces: list[Piece] = [Copied(0, len(SIGNATURE))]
    left = dict(new)
    for chunk in chunks:
        header = next((header for header in left if chunk.holds(header)), None)
        if header is not None:
            pieces.append(_encoded(header, left.pop(header)))
            continue
        if chunk.kind in (_DATA, _END):
            absent = [header for header in left if not any(each.holds(header) for each in chunks)]
            pieces += [_encoded(header, left.pop(header)) for header in absent]
        pieces.append(Copied(chunk.start, chunk.end))
    return [*pieces, Copied(chunks[-1].end, None)]


def _encoded(header: bytes, content: bytes) -> bytes:
    """Return a chunk; XMP is written uncompressed, in no language, as the XMP standard asks."""
    data = content if header == EXIF else header[4:] + b"\0\0\0\0" + content
    return struct.pack(">I", len(data)) + header[:4] + data + struct.pack(">I", zlib.crc32(header[:4] + data))
