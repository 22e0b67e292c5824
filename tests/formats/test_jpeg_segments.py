"""Segments before the picture data, and files made of pieces of others."""

import io
import itertools
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uavkit.core.errors import InputError
from uavkit.formats.jpeg_segments import (
    APP1,
    APP2,
    EXIF_HEADER,
    JFIF_HEADER,
    LARGEST_PAYLOAD,
    MPF_HEADER,
    XMP_HEADER,
    encode_segment,
    read_segments,
    rebuilt,
    resolution,
)
from uavkit.formats.pieces import Copied, joined, write_pieces

SCAN = b"\xff\xda\x00\x02" + bytes(range(256)) + b"\xff\xd9"
"""A start of scan, picture data of any kind, the end of image."""


def segment(marker: int, payload: bytes, fill: int = 0) -> bytes:
    return b"\xff" * fill + encode_segment(marker, payload, "x")


def picture_index(order: str, images: list[tuple[int, int]]) -> bytes:
    """Return an MPF payload whose entries hold (size, offset)."""
    entries = b"".join(struct.pack(f"{order}IIIHH", 0x20030000, size, offset, 0, 0) for size, offset in images)
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(f"{order}I", 8)
    fields = struct.pack(f"{order}HHII", 0xB001, 4, 1, len(images))
    fields += struct.pack(f"{order}HHII", 0xB002, 7, len(entries), 8 + 2 + 24 + 4)
    return MPF_HEADER + head + struct.pack(f"{order}H", 2) + fields + bytes(4) + entries


def made_anew(data: bytes, changed: dict[int, bytes], added: list[tuple[int, bytes]]) -> bytes:
    source, target = io.BytesIO(data), io.BytesIO()
    write_pieces(source, rebuilt(read_segments(source, "x"), changed, added), target)
    return target.getvalue()


def test_segments_tell_where_they_stand_and_keep_only_what_geotags_concern() -> None:
    parts = [
        segment(0xE0, b"JFIF\0"),
        segment(APP1, EXIF_HEADER + b"abc", fill=3),
        b"\xff\x01",
        segment(0xDB, bytes(64)),
        segment(APP1, XMP_HEADER + b"<x/>"),
        segment(0xE4, EXIF_HEADER),
    ]
    found = read_segments(io.BytesIO(b"\xff\xd8" + b"".join(parts) + SCAN), "x")
    assert [s.marker for s in found] == [0xE0, APP1, 0x01, 0xDB, APP1, 0xE4]
    assert [s.end - s.start for s in found] == [len(part) for part in parts]
    assert found[0].start == 2
    assert all(a.end == b.start for a, b in itertools.pairwise(found))
    assert [s.payload for s in found] == [JFIF_HEADER, EXIF_HEADER + b"abc", None, None, XMP_HEADER + b"<x/>", None]


@pytest.mark.parametrize(
    "data, what",
    [
        (b"", "no JPEG"),
        (b"\x89PNG", "no JPEG"),
        (b"\xff\xd8", "cut short"),
        (b"\xff\xd8\xff\xe1\x00", "does not end within the file"),
        (b"\xff\xd8\xff\xe1\x00\x01" + SCAN, "does not end within the file"),
        (b"\xff\xd8\xff\xe1\xff\xff" + SCAN, "does not end within the file"),
        (b"\xff\xd8" + segment(0xE0, b"a") + b"x" + SCAN, "no segment begins at byte 7"),
        (b"\xff\xd8\xff\x00" + SCAN, "no segment begins"),
        (b"\xff\xd8" + b"\xff" * 200_000, "cut short"),
        (b"\xff\xd8" + b"\xff\x01" * 200_000, "segments before"),
    ],
)
def test_damage_before_the_picture_is_named(data: bytes, what: str) -> None:
    with pytest.raises(InputError, match=what):
        read_segments(io.BytesIO(data), "still.jpg")


def test_changed_and_added_segments_leave_all_else_byte_for_byte() -> None:
    jfif, table, trailer = segment(0xE0, b"JFIF\0"), segment(0xDB, bytes(64), fill=2), b"what follows the picture"
    old = segment(APP1, EXIF_HEADER + b"old")
    new, packet = segment(APP1, EXIF_HEADER + b"newer"), segment(APP1, XMP_HEADER)
    data = b"\xff\xd8" + jfif + old + table + SCAN + trailer
    expected = b"\xff\xd8" + jfif + new + packet + table + SCAN + trailer
    assert made_anew(data, {1: new}, [(2, packet)]) == expected
    assert made_anew(data, {}, []) == data
    assert made_anew(b"\xff\xd8" + SCAN, {}, [(0, new), (0, packet)]) == b"\xff\xd8" + new + packet + SCAN


def test_the_copied_scan_does_not_end_with_the_block() -> None:
    scan = SCAN + bytes(3_000_001)
    assert made_anew(b"\xff\xd8" + scan, {}, [(0, b"new")]) == b"\xff\xd8new" + scan


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("exif_first", [True, False])
def test_further_images_are_found_where_picture_index_says(order: str, exif_first: bool) -> None:
    """MPF's offsets count from its own header: what grows before it changes the first image's size only."""
    exif, newer = segment(APP1, EXIF_HEADER + bytes(10)), segment(APP1, EXIF_HEADER + bytes(310))
    preview = b"\xff\xd8 preview \xff\xd9"

    def still(index: bytes) -> bytes:
        parts = [exif, segment(APP2, index)] if exif_first else [segment(APP2, index), exif]
        return b"\xff\xd8" + b"".join(parts) + SCAN

    blank = still(picture_index(order, [(0, 0), (0, 0)]))
    header = blank.index(MPF_HEADER) + 4
    index = picture_index(order, [(len(blank), 0), (len(preview), len(blank) + 5 - header)])
    data = still(index) + b"gap.." + preview
    copy = made_anew(data, {0 if exif_first else 1: newer}, [])
    assert len(copy) == len(data) + 300
    header = copy.index(MPF_HEADER) + 4
    entries = struct.unpack_from(f"{order}IIIHHIIIHH", copy, header + 38)
    assert (entries[1], entries[2]) == (len(blank) + 300, 0)
    assert copy[header + entries[7] :][: entries[6]] == preview
    if exif_first:
        assert entries[7] == len(blank) + 5 - (data.index(MPF_HEADER) + 4)


def test_nothing_of_picture_index_changes_where_the_size_stays() -> None:
    old, new = segment(APP1, EXIF_HEADER + b"one"), segment(APP1, EXIF_HEADER + b"two")
    index = segment(APP2, picture_index("<", [(999, 0), (5, 1000)]))
    assert made_anew(b"\xff\xd8" + old + index + SCAN, {0: new}, []) == b"\xff\xd8" + new + index + SCAN


def test_a_mended_picture_index_keeps_its_length() -> None:
    index = segment(APP2, picture_index(">", [(999, 0), (5, 1000)]), fill=2)
    grown, mended = segment(APP2, picture_index(">", [(1004, 0), (5, 1000)]), fill=2), b"\xff\xd8added"
    assert made_anew(b"\xff\xd8" + index + SCAN, {}, [(0, b"added")]) == mended + grown + SCAN


@settings(derandomize=True, max_examples=200, deadline=None)
@given(st.binary(max_size=80))
def test_no_picture_index_breaks_the_writer(block: bytes) -> None:
    index = segment(APP2, MPF_HEADER + b"II*\0" + block)
    copy = made_anew(b"\xff\xd8" + index + SCAN, {}, [(0, b"added")])
    assert copy.startswith(b"\xff\xd8added")
    assert copy.endswith(SCAN)
    assert len(copy) == 2 + 5 + len(index) + len(SCAN)


def test_a_segment_holds_so_much_and_no_more() -> None:
    assert len(encode_segment(APP1, bytes(LARGEST_PAYLOAD), "x")) == 65_537
    with pytest.raises(InputError, match=r"still.jpg: its XMP segment .*\(1 bytes\) does not fit"):
        encode_segment(APP1, XMP_HEADER + bytes(LARGEST_PAYLOAD - len(XMP_HEADER) + 1), "still.jpg")


@pytest.mark.parametrize(
    "density, expected",
    [(b"\1\1\1\x01\x2c\x00\x96", (300, 150, 2)), (b"\1\1\2\0\x76\0\x76", (118, 118, 3))]
    + [(wrong, (72, 72, 2)) for wrong in (b"\1\1\0\0\1\0\1", b"\1\1\1\0\0\0\0", b"\1\1", b"\1\1\7\1\1\1\1")],
)
def test_resolution_is_that_of_jfif(density: bytes, expected: tuple[int, int, int]) -> None:
    data = b"\xff\xd8" + segment(0xE0, b"JFIF\0" + density) + SCAN
    assert resolution(read_segments(io.BytesIO(data), "x")) == expected
    assert resolution(()) == (72, 72, 2)


def test_neighbouring_ranges_are_copied_as_one() -> None:
    assert joined([Copied(0, 2), Copied(2, 9), b"x", Copied(9, 11), Copied(11, None)]) == [
        Copied(0, 9),
        b"x",
        Copied(9, None),
    ]


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.binary(max_size=300))
def test_no_bytes_give_anything_but_an_input_error(data: bytes) -> None:
    try:
        found = read_segments(io.BytesIO(b"\xff\xd8" + data), "x")
    except InputError:
        return
    assert all(2 <= s.start < s.end <= 2 + len(data) for s in found)
