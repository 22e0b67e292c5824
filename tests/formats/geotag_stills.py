"""Stills that the geotag tests make for themselves, with EXIF blocks encoded by hand, and exiftool as the judge."""

import io
import json
import os
import shutil
import struct
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.formats.media import picture

GPS_POINTER, EXIF_POINTER, MAKER_NOTE = 0x8825, 0x8769, 0x927C
RDF = 'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"'
Row = tuple[int, int, int, bytes]
"""Tag, type, count, and the values as bytes."""


class ExifMaker:
    """Encodes an EXIF block in either byte order, with a maker note that points into the block."""

    def __init__(self, order: str) -> None:
        self.order = order
        self._block = bytearray({"<": b"II*\0", ">": b"MM\0*"}[order] + bytes(4))

    def number(self, value: int, form: str = "I") -> bytes:
        return struct.pack(f"{self.order}{form}", value)

    def place(self, data: bytes) -> int:
        at = len(self._block)
        self._block += data + bytes(len(data) % 2)
        return at

    def directory(self, rows: Sequence[Row], following: int = 0) -> int:
        body = struct.pack(f"{self.order}H", len(rows))
        for tag, kind, count, data in sorted(rows):
            inline = data.ljust(4, b"\0") if len(data) <= 4 else self.number(self.place(data))
            body += struct.pack(f"{self.order}HHI", tag, kind, count) + inline
        return self.place(body + self.number(following))

    def text(self, tag: int, text: str) -> Row:
        return tag, 2, len(text) + 1, text.encode() + b"\0"

    def pointer(self, tag: int, offset: int) -> Row:
        return tag, 4, 1, self.number(offset)

    def rationals(self, tag: int, *pairs: tuple[int, int]) -> Row:
        return tag, 5, len(pairs), b"".join(self.number(n) for pair in pairs for n in pair)

    def finished(self, first: int) -> bytes:
        self._block[4:8] = self.number(first)
        return bytes(self._block)


def exif_block(
    order: str, *, gps: Sequence[Row] | None = None, thumbnail: bool = True, maker_note: bool = True
) -> bytes:
    """Return an EXIF block; ``gps`` None leaves out the GPS directory and its pointer."""
    maker = ExifMaker(order)
    detail = [maker.text(36867, "2024:05:01 10:00:00"), (0x9000, 7, 4, b"0232"), (0xA001, 3, 1, maker.number(1, "H"))]
    detail += [(0x9101, 7, 4, b"\1\2\3\0"), (0xA000, 7, 4, b"0100")]
    detail += [(0xA002, 3, 1, maker.number(64, "H")), (0xA003, 3, 1, maker.number(48, "H"))]
    if maker_note:
        secret = maker.place(b"the maker's secret")
        note = b"NOTE" + maker.number(secret) + bytes(range(40))
        detail.append((MAKER_NOTE, 7, len(note), note))
    resolution = [maker.rationals(0x11A, (72, 1)), maker.rationals(0x11B, (72, 1)), (0x128, 3, 1, maker.number(2, "H"))]
    main = [maker.text(271, "Maker"), maker.text(272, "M"), (0x213, 3, 1, maker.number(1, "H")), *resolution]
    main.append(maker.pointer(EXIF_POINTER, maker.directory(detail)))
    if gps is not None:
        main.append(maker.pointer(GPS_POINTER, maker.directory(gps)))
    following = 0
    if thumbnail:
        small = small_jpeg()
        rows = [maker.pointer(0x201, maker.place(small)), maker.pointer(0x202, len(small))]
        following = maker.directory([(0x103, 3, 1, maker.number(6, "H")), *resolution, *rows])
    return maker.finished(maker.directory(main, following))


def old_gps(order: str) -> list[Row]:
    """Return a GPS directory of a camera's own receiver with DOP, satellites, speed, track, direction and time."""
    m = ExifMaker(order)
    rows = [(0, 1, 4, b"\2\2\0\0"), m.text(1, "N"), m.rationals(2, (35, 1), (0, 1), (0, 1)), m.text(3, "E")]
    rows += [m.rationals(4, (139, 1), (0, 1), (0, 1)), (5, 1, 1, b"\0"), m.rationals(6, (100, 1))]
    rows += [m.rationals(7, (1, 1), (2, 1), (3, 1)), m.text(8, "12"), m.text(9, "A"), m.text(10, "3")]
    rows += [m.rationals(11, (2, 1)), m.text(12, "K"), m.rationals(13, (18, 1)), m.text(14, "T")]
    rows += [m.rationals(15, (90, 1)), m.text(16, "M"), m.rationals(17, (45, 1)), m.text(29, "2020:02:29")]
    return [*rows, m.rationals(31, (77, 1))]


def small_jpeg() -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture(16, 12)).save(buffer, "JPEG")
    return buffer.getvalue()


def bare_jpeg() -> bytes:
    """Return a JPEG with JFIF's header and no other metadata."""
    buffer = io.BytesIO()
    Image.fromarray(picture()).save(buffer, "JPEG", quality=90)
    return buffer.getvalue()


def app1(payload: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, 0xE1, len(payload) + 2) + payload


def write_still(path: Path, *, exif: bytes | None = None, xmp: bytes | None = None, more: bytes = b"") -> Path:
    """Write a JPEG with EXIF block, XMP packet and further segments as given."""
    bare = bare_jpeg()
    jfif_end = 4 + int.from_bytes(bare[4:6], "big")
    head = bare[:jfif_end]
    if exif is not None:
        head += app1(b"Exif\0\0" + exif)
    if xmp is not None:
        head += app1(b"http://ns.adobe.com/xap/1.0/\0" + xmp)
    path.write_bytes(head + more + bare[jfif_end:])
    return path


def packet(body: str, padding: int = 0) -> bytes:
    """Return an XMP packet around rdf:Description elements."""
    wrapped = f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF {RDF}>{body}</rdf:RDF></x:xmpmeta>'
    begin = '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
    return (begin + wrapped + "\n" * padding + '<?xpacket end="w"?>').encode()


def exiftool(*arguments: str | Path) -> str:
    """Run exiftool; skip the test where it is not installed, unless this is the continuous integration."""
    program = shutil.which("exiftool")
    if program is None:
        if os.environ.get("UAVKIT_CI"):
            pytest.fail("exiftool is missing: apt-get install libimage-exiftool-perl")
        pytest.skip("exiftool is not installed (Debian: libimage-exiftool-perl)")
    command = [program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120).stdout


def tags_of(*paths: Path) -> list[dict[str, Any]]:
    """Return all tags of each file by group and name, numbers as numbers, without what the file system says."""
    found = json.loads(exiftool("-j", "-n", "-a", "-G1", "-ee", *paths))
    skipped = ("System:", "ExifTool:", "SourceFile", "Composite:")
    return [{key: value for key, value in each.items() if not key.startswith(skipped)} for each in found]


def warnings_of(path: Path) -> list[str]:
    """Return what exiftool finds wrong with a file, without places in it."""
    lines = exiftool("-validate", "-warning", "-error", "-a", path).splitlines()
    return sorted(line for line in lines if not line.startswith("Validate"))
