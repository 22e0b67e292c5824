"""EXIF blocks and TIFF directories changed without moving anything."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.formats.geotag_stills import exif_block, old_gps
from uavkit.core.errors import InputError
from uavkit.formats.tiff_tags import EMPTY_BLOCK, Field, TagBlock, block_of_resolution, without

NEW = [Field.text(1, "S"), Field.of_bytes(0, b"\2\3\0\0"), Field.undefined(27, b"odd")]


def edited(block: bytes, fields: list[Field], xmp: bytes | None = None) -> bytes:
    return TagBlock.of_bytes(block, "a").with_fields(fields, xmp).applied(block)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("gps", [True, False])
@pytest.mark.parametrize("xmp", [None, b"<odd/>.."])
def test_fields_are_found_again_in_the_order_of_their_tags(order: str, gps: bool, xmp: bytes | None) -> None:
    block = exif_block(order, gps=old_gps(order) if gps else None)
    rationals = Field.rationals(2, order, [(35, 1), (48, 1), (123, 1000)])
    again = TagBlock.of_bytes(edited(block, [*NEW, rationals], xmp), "a")
    assert again.gps_fields() == (NEW[1], NEW[0], rationals, NEW[2])
    assert again.xmp() == xmp
    assert rationals.data == struct.pack(f"{order}6I", 35, 1, 48, 1, 123, 1000)


@pytest.mark.parametrize("odd", [b"", b"x"])
def test_directories_and_values_stand_at_even_offsets(odd: bytes) -> None:
    block = block_of_resolution(300, 150, 2) + odd
    new = edited(block, [Field.text(1, "seven b"), Field.undefined(2, b"odd:x"), Field.text(3, "after it")])
    (first,) = struct.unpack_from("<I", new, 4)
    rows = dict(struct.unpack_from("<H6xI", new, first + 2 + 12 * i) for i in range(5))
    gps = rows[0x8825]
    offsets = [first, gps, *(struct.unpack_from("<8xI", new, gps + 2 + 12 * i)[0] for i in range(3))]
    assert [offset % 2 for offset in offsets] == [0] * 5
    assert new[: len(block)][8:] == block[8:]


def test_the_other_values_of_the_first_directory_stay_where_they_are() -> None:
    block = exif_block("<", gps=None)
    new = edited(block, NEW)
    assert new[8 : len(block)] == block[8:]
    (old_first,), (first,) = struct.unpack_from("<I", block, 4), struct.unpack_from("<I", new, 4)

    def rows(data: bytes, at: int) -> dict[int, bytes]:
        (count,) = struct.unpack_from("<H", data, at)
        return {
            int.from_bytes(data[p : p + 2], "little"): data[p : p + 12] for p in range(at + 2, at + 2 + 12 * count, 12)
        }

    before, after = rows(block, old_first), rows(new, first)
    assert after.keys() - before.keys() == {0x8825}
    assert {tag: after[tag] for tag in before} == before
    assert list(after) == sorted(after)
    assert new[first + 2 + 12 * len(after) :][:4] == block[old_first + 2 + 12 * len(before) :][:4] != bytes(4)


@pytest.mark.parametrize("order", ["<", ">"])
def test_values_outside_the_block_are_left_out(order: str) -> None:
    block = bytearray(exif_block(order, gps=old_gps(order), thumbnail=False))
    names = {field.tag for field in TagBlock.of_bytes(bytes(block), "a").gps_fields()}
    place = block.index(struct.pack(f"{order}HHI", 13, 5, 1))
    block[place + 8 : place + 12] = struct.pack(f"{order}I", len(block) - 7)
    assert {field.tag for field in TagBlock.of_bytes(bytes(block), "a").gps_fields()} == names - {13}
    block[place + 2 : place + 4] = struct.pack(f"{order}H", 99)
    assert {field.tag for field in TagBlock.of_bytes(bytes(block), "a").gps_fields()} == names - {13}


def test_a_gps_directory_that_cannot_be_read_counts_as_none() -> None:
    block = bytearray(exif_block("<", gps=old_gps("<")))
    place = block.index(struct.pack("<HHI", 0x8825, 4, 1))
    block[place + 8 : place + 12] = struct.pack("<I", len(block) + 10)
    damaged = TagBlock.of_bytes(bytes(block), "a")
    assert damaged.gps_fields() == ()
    assert TagBlock.of_bytes(edited(bytes(block), NEW), "a").gps_fields() == (NEW[1], NEW[0], NEW[2])


def test_a_tiff_does_not_grow_beyond_its_offsets() -> None:
    class Huge:
        def __init__(self) -> None:
            self.at = 0

        def seek(self, at: int) -> None:
            self.at = at

        def read(self, size: int) -> bytes:
            return EMPTY_BLOCK[self.at : self.at + size]

    block = TagBlock(Huge(), 0xFFFFFFF0, "huge.tif")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"huge\.tif: a TIFF cannot grow beyond 4 GiB"):
        block.with_fields([Field.text(1, "N" * 30)], None)


def test_fields_are_taken_out_by_tag() -> None:
    assert without(NEW, {1, 99}) == NEW[1:]


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.sampled_from([b"II*\0", b"MM\0*"]), st.binary(max_size=120))
def test_no_bytes_give_anything_but_an_input_error(head: bytes, rest: bytes) -> None:
    block = head + rest
    try:
        new = edited(block, NEW)
    except InputError:
        return
    assert len(new) > len(block)
    assert {field.tag for field in TagBlock.of_bytes(new, "a").gps_fields()} == {0, 1, 27}
