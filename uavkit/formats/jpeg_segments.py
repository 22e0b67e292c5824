"""The segments before a JPEG's picture data, and the pieces of a file with some of them changed.

ITU-T T.81, annex B: a segment is a marker (0xFF, any number of 0xFF before it, a code) and, but for a few codes, a
length of two bytes that counts itself. Only what stands before the first scan is looked at; all else is a range of
bytes to copy.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import BinaryIO

from uavkit.core.errors import InputError
from uavkit.formats.pieces import Copied, Piece

APP0, APP1, APP2 = 0xE0, 0xE1, 0xE2
EXIF_HEADER = b"Exif\0\0"
XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\0"
MPF_HEADER = b"MPF\0"
JFIF_HEADER = b"JFIF\0"
LARGEST_PAYLOAD = 0xFFFF - 2
"""Bytes that a segment holds beside its marker and its length."""

_KEPT = {APP0: (JFIF_HEADER,), APP1: (EXIF_HEADER, XMP_HEADER), APP2: (MPF_HEADER,)}
_SOI, _EOI, _SOS, _TEM = 0xD8, 0xD9, 0xDA, 0x01
_MOST_SEGMENTS = 100_000
"""Thermal cameras keep megabytes in segments (some hundreds); beyond this the file is made to exhaust the reader."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """One segment: where it stands in the file, and its payload where it is of a kind that geotags concern."""

    marker: int
    start: int
    """Of its first 0xFF."""
    end: int
    payload: bytes | None
    """Without marker and length; None for segments that are only copied."""

    def holds(self, header: bytes) -> bool:
        """Tell whether the payload is kept and begins so."""
        return self.payload is not None and self.payload.startswith(header)


def read_segments(stream: BinaryIO, name: str) -> tuple[Segment, ...]:
    """Return the segments between the start of image and the first scan (or the end of image), in order.

    Raises InputError where the file is no JPEG, or ends or goes astray before its picture data.
    """
    if stream.read(2) != bytes((0xFF, _SOI)):
        raise InputError(f"{name}: no JPEG: it does not begin with FF D8")
    segments: list[Segment] = []
    position = 2
    while len(segments) < _MOST_SEGMENTS:
        segment = _next_segment(stream, position, name)
        if segment is None:
            return tuple(segments)
        segments.append(segment)
        position = segment.end
        stream.seek(position)
    raise InputError(f"{name}: more than {_MOST_SEGMENTS} segments before the picture data: damaged")


def _next_segment(stream: BinaryIO, start: int, name: str) -> Segment | None:
    marker, fill = _marker(stream, start, name)
    if marker in (_SOS, _EOI):
        return None
    if marker == _TEM:
        return Segment(marker=marker, start=start, end=start + fill + 1, payload=None)
    length = int.from_bytes(stream.read(2), "big")
    payload = stream.read(max(length - 2, 0))
    if length < 2 or len(payload) < length - 2:
        raise InputError(f"{name}: damaged or cut short: the segment at byte {start} does not end within the file")
    kept = marker in _KEPT and payload.startswith(_KEPT[marker])
    end = start + fill + 1 + length
    return Segment(marker=marker, start=start, end=end, payload=payload if kept else None)


def _marker(stream: BinaryIO, start: int, name: str) -> tuple[int, int]:
    """Return the code of a marker and the number of 0xFF before it."""
    fill = 0
    while (byte := stream.read(1)) == b"\xff":
        fill += 1
        if fill > _MOST_SEGMENTS:
            break
    if not byte or byte == b"\xff":
        raise InputError(f"{name}: damaged or cut short: no picture data after byte {start}")
    if fill == 0 or byte == b"\0":
        raise InputError(f"{name}: damaged: no segment begins at byte {start}")
    return byte[0], fill


def resolution(segments: Sequence[Segment]) -> tuple[int, int, int]:
    """Return points per unit, x and y, and EXIF's code of the unit, of JFIF's header; 72 per inch where unknown."""
    head = next((segment.payload for segment in segments if segment.holds(JFIF_HEADER)), None) or b""
    if len(head) < 12 or head[7] not in (1, 2):
        return 72, 72, 2
    x, y = struct.unpack(">HH", head[8:12])
    return (x, y, head[7] + 1) if x and y else (72, 72, 2)


def encode_segment(marker: int, payload: bytes, name: str) -> bytes:
    """Return a segment's bytes; raises InputError where the payload does not fit into one segment."""
    if len(payload) > LARGEST_PAYLOAD:
        raise InputError(
            f"{name}: its {'XMP' if payload.startswith(XMP_HEADER) else 'EXIF'} segment is so full that the position "
            f"({len(payload) - LARGEST_PAYLOAD} bytes) does not fit: JPEG allows 64 KiB. Remove its thumbnail first"
        )
    return struct.pack(">BBH", 0xFF, marker, len(payload) + 2) + payload


def rebuilt(segments: Sequence[Segment], changed: dict[int, bytes], added: Sequence[tuple[int, bytes]]) -> list[Piece]:
    """Return the pieces of the new file; the bytes from the first scan on, and what follows the image, are copied.

    ``changed`` gives the new bytes of segments by their index, ``added`` new segments with the index before which
    they go. MPF's (multi-picture format) sizes and offsets are put right.
    """
    changed = changed | mended_picture_index(segments, changed, added)
    pieces: list[Piece] = [Copied(0, 2)]
    for index, segment in enumerate(segments):
        pieces += [data for place, data in added if place == index]
        pieces.append(changed.get(index, Copied(segment.start, segment.end)))
    pieces += [data for place, data in added if place >= len(segments)]
    return [*pieces, Copied(segments[-1].end if segments else 2, None)]


def mended_picture_index(
    segments: Sequence[Segment], changed: dict[int, bytes], added: Sequence[tuple[int, bytes]]
) -> dict[int, bytes]:
    """Return the MPF segment with its sizes and offsets as they are in the new file, by index; nothing if unchanged.

    CIPA DC-007-2009: offsets to the further images count from the header *within* the MPF segment, so only what
    grows behind it moves them; the size of the first image counts all its segments. A size that the camera stated
    wrongly (DJI leaves out its XMP segment) stays wrong by as much.
    """
    place = next((i for i, s in enumerate(segments) if s.marker == APP2 and s.holds(MPF_HEADER)), None)
    if place is None:
        return {}
    sizes = {index: len(data) - (segments[index].end - segments[index].start) for index, data in changed.items()}
    growth = sum(sizes.values()) + sum(len(data) for _, data in added)
    behind = sum(size for index, size in sizes.items() if index > place)
    behind += sum(len(data) for index, data in added if index > place)
    payload = segments[place].payload or b""
    mended = MPF_HEADER + _moved_images(payload[len(MPF_HEADER) :], growth, behind)
    if mended == payload:
        return {}
    fill = segments[place].end - segments[place].start - len(payload) - 4
    return {place: b"\xff" * fill + encode_segment(APP2, mended, "MPF")}


def _moved_images(block: bytes, growth: int, behind: int) -> bytes:
    """Return the MPF block with the first image grown and the others moved; a block that cannot be read is kept."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(block[:4])
    if order is None or (growth == 0 and behind == 0):
        return block
    mended = bytearray(block)
    for number, place in enumerate(_image_entries(block, order)):
        size, offset = struct.unpack_from(f"{order}II", block, place + 4)
        if offset == 0 and number == 0:
            size += growth
        elif offset:
            offset += behind
        if 0 <= size <= 0xFFFFFFFF and 0 <= offset <= 0xFFFFFFFF:
            struct.pack_into(f"{order}II", mended, place + 4, size, offset)
    return bytes(mended)


def _image_entries(block: bytes, order: str) -> Iterator[int]:
    """Yield where in the MPF block the entries of 16 bytes (attributes, size, offset, dependents) stand."""
    try:
        (directory,) = struct.unpack_from(f"{order}I", block, 4)
        (count,) = struct.unpack_from(f"{order}H", block, directory)
        for index in range(count):
            tag, _, size, offset = struct.unpack_from(f"{order}HHII", block, directory + 2 + 12 * index)
            if tag == 0xB002:
                yield from range(offset, min(offset + size, len(block)) - 15, 16)
    except struct.error:
        return
