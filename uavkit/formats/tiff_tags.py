"""EXIF's and TIFF's directories of tags, changed without moving anything that stands in the block.

Adobe TIFF 6.0, section 2. All offsets count from the start of the block, and makers hide offsets of their own in their
notes: so new values and directories are appended, and only the few bytes that point to them are overwritten.
"""

import io
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import BinaryIO

from uavkit.core.errors import InputError

GPS_POINTER = 0x8825
XMP_TAG = 700
BYTE, ASCII, LONG, RATIONAL = 1, 2, 4, 5
SHORT, UNDEFINED = 3, 7
EMPTY_BLOCK = struct.pack("<2sHIHI", b"II", 42, 8, 0, 0)
"""An EXIF block that says nothing: one directory without fields, and no next one."""

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
"""Bytes of one value by its type."""
_FIRST_DIRECTORY = 4
"""Where in the header the offset of the first directory stands."""
_LARGEST_TIFF = 0xFFFFFFFF
_MOST_BYTES = 1 << 26


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """A tag with its values as bytes in the block's byte order."""

    tag: int
    kind: int
    count: int
    data: bytes

    @classmethod
    def text(cls, tag: int, text: str) -> "Field":
        """Return an ASCII field with its closing NUL."""
        data = text.encode("ascii") + b"\0"
        return cls(tag=tag, kind=ASCII, count=len(data), data=data)

    @classmethod
    def of_bytes(cls, tag: int, data: bytes) -> "Field":
        """Return a field of bytes."""
        return cls(tag=tag, kind=BYTE, count=len(data), data=data)

    @classmethod
    def undefined(cls, tag: int, data: bytes) -> "Field":
        """Return a field of bytes whose meaning the tag knows."""
        return cls(tag=tag, kind=UNDEFINED, count=len(data), data=data)

    @classmethod
    def rationals(cls, tag: int, order: str, values: Sequence[tuple[int, int]]) -> "Field":
        """Return a field of unsigned rationals (numerator, denominator), each below 2^32."""
        numbers = [number for pair in values for number in pair]
        return cls(tag=tag, kind=RATIONAL, count=len(values), data=struct.pack(f"{order}{len(numbers)}I", *numbers))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Entry:
    """A field of a directory as it stands there: the value itself, or the offset of the value."""

    tag: int
    kind: int
    count: int
    inline: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class _Directory:
    offset: int
    entries: tuple[_Entry, ...]
    following: bytes
    """The offset of the next directory as it stands in the block."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Edit:
    """What makes the new block of the old: bytes written over, by offset, and bytes appended."""

    overwritten: Mapping[int, bytes]
    appended: bytes

    def applied(self, block: bytes) -> bytes:
        """Return the new block."""
        changed = bytearray(block)
        for offset, data in self.overwritten.items():
            changed[offset : offset + len(data)] = data
        return bytes(changed) + self.appended


class TagBlock:
    """An EXIF block or TIFF file whose first directory and GPS directory are read; nothing is written here."""

    def __init__(self, stream: BinaryIO, size: int, name: str) -> None:
        """Read the header and the first directory; raises InputError where they are damaged."""
        self._stream, self._size, self._name = stream, size, name
        self.order = self._read_order()
        """"<" or ">", as ``struct`` has it."""
        (first,) = struct.unpack(f"{self.order}I", self._read(_FIRST_DIRECTORY, 4))
        self._first = self._read_directory(first)

    @classmethod
    def of_bytes(cls, block: bytes, name: str) -> "TagBlock":
        """Return the block of bytes held in memory, as EXIF's are."""
        return cls(io.BytesIO(block), len(block), name)

    def gps_fields(self) -> tuple[Field, ...]:
        """Return the fields of the GPS directory; none where there is none or it cannot be read."""
        entry = self._entry(GPS_POINTER)
        if entry is None:
            return ()
        try:
            directory = self._read_directory(self._number(entry))
        except InputError:
            return ()  # a damaged GPS part is replaced: its position goes anyway
        found = [self._field(entry) for entry in directory.entries]
        return tuple(field for field in found if field is not None)

    def xmp(self) -> bytes | None:
        """Return the XMP packet that a TIFF holds in tag 700; None where it holds none."""
        entry = self._entry(XMP_TAG)
        field = self._field(entry) if entry is not None else None
        return None if field is None else field.data

    def with_fields(self, gps: Sequence[Field], xmp: bytes | None) -> Edit:
        """Return the edit that puts a new GPS directory and, unless None, a new XMP packet into the block."""
        tail = _Tail(self._size, self.order)
        new = []
        if xmp is not None:
            new.append(tail.entry(Field.of_bytes(XMP_TAG, xmp)))
        new.append(self._gps_entry(tail, gps))
        overwritten = self._pointers(tail, new)
        if self._size + len(tail.data) > _LARGEST_TIFF:
            raise InputError(f"{self._name}: a TIFF cannot grow beyond 4 GiB; save it compressed or as JPEG")
        return Edit(overwritten=overwritten, appended=bytes(tail.data))

    def _gps_entry(self, tail: "_Tail", gps: Sequence[Field]) -> _Entry:
        directory = tail.directory([tail.entry(field) for field in sorted(gps, key=lambda field: field.tag)])
        return _Entry(tag=GPS_POINTER, kind=LONG, count=1, inline=struct.pack(f"{self.order}I", directory))

    def _pointers(self, tail: "_Tail", new: Sequence[_Entry]) -> dict[int, bytes]:
        """Overwrite the fields where the first directory has them; else append it anew and point the header there."""
        tags = [entry.tag for entry in self._first.entries]
        if all(entry.tag in tags for entry in new):
            start = self._first.offset + 2
            return {start + 12 * tags.index(entry.tag): tail.packed(entry) for entry in new}
        replaced = {entry.tag for entry in new}
        kept = [entry for entry in self._first.entries if entry.tag not in replaced]
        offset = tail.directory(sorted([*kept, *new], key=lambda entry: entry.tag), self._first.following)
        return {_FIRST_DIRECTORY: struct.pack(f"{self.order}I", offset)}

    def _entry(self, tag: int) -> _Entry | None:
        return next((entry for entry in self._first.entries if entry.tag == tag), None)

    def _number(self, entry: _Entry) -> int:
        return int(struct.unpack(f"{self.order}I", entry.inline)[0])

    def _field(self, entry: _Entry) -> Field | None:
        """Return the field with its values; None where its type is unknown or its values lie outside the block."""
        size = _SIZES.get(entry.kind, 0) * entry.count
        if not 0 < size <= _MOST_BYTES:
            return None
        data = entry.inline[:size]
        if size > 4:
            offset = self._number(entry)
            if offset + size > self._size:
                return None
            data = self._read(offset, size)
        return Field(tag=entry.tag, kind=entry.kind, count=entry.count, data=data)

    def _read_order(self) -> str:
        head = self._read(0, 4)
        order = {b"II": "<", b"MM": ">"}.get(head[:2])
        if order is None:
            raise self._damaged("begins neither with II nor with MM")
        (magic,) = struct.unpack(f"{order}H", head[2:])
        if magic == 43:
            raise InputError(f"{self._name}: is a BigTIFF, whose positions few programs read: save it as TIFF or JPEG")
        if magic != 42:
            raise self._damaged(f"has the number {magic} where 42 belongs")
        return order

    def _read_directory(self, offset: int) -> _Directory:
        (count,) = struct.unpack(f"{self.order}H", self._read(offset, 2))
        rows = self._read(offset + 2, 12 * count)
        entries = tuple(
            _Entry(tag=tag, kind=kind, count=number, inline=inline)
            for tag, kind, number, inline in struct.iter_unpack(f"{self.order}HHI4s", rows)
        )
        return _Directory(offset=offset, entries=entries, following=self._read(offset + 2 + 12 * count, 4))

    def _read(self, offset: int, size: int) -> bytes:
        if offset + size > self._size:
            raise self._damaged(f"points to byte {offset + size - 1} of {self._size}")
        self._stream.seek(offset)
        data = self._stream.read(size)
        if len(data) < size:
            raise self._damaged("ends early")
        return data

    def _damaged(self, what: str) -> InputError:
        return InputError(f"{self._name}: its EXIF or TIFF header is damaged ({what}): take the original from the card")


class _Tail:
    """What is appended to a block: values and directories, each at an even offset as TIFF asks."""

    def __init__(self, start: int, order: str) -> None:
        self.data = bytearray(start % 2)
        self._start, self._order = start, order

    def entry(self, field: Field) -> _Entry:
        """Return the field's entry; values too long for it are appended."""
        inline = field.data.ljust(4, b"\0")
        if len(field.data) > 4:
            inline = struct.pack(f"{self._order}I", self._append(field.data))
        return _Entry(tag=field.tag, kind=field.kind, count=field.count, inline=inline)

    def directory(self, entries: Sequence[_Entry], following: bytes = b"\0\0\0\0") -> int:
        """Append a directory; return its offset."""
        rows = b"".join(self.packed(entry) for entry in entries)
        return self._append(struct.pack(f"{self._order}H", len(entries)) + rows + following)

    def packed(self, entry: _Entry) -> bytes:
        """Return the entry's bytes."""
        return struct.pack(f"{self._order}HHI4s", entry.tag, entry.kind, entry.count, entry.inline)

    def _append(self, data: bytes) -> int:
        offset = self._start + len(self.data)
        self.data += data + bytes(len(data) % 2)
        return min(offset, _LARGEST_TIFF)  # beyond it the caller, who knows the file's name, refuses


def block_of_resolution(x: int, y: int, unit: int) -> bytes:
    """Return the EXIF block that a JPEG without one is given: the four tags that EXIF demands and nothing else.

    Points per unit, unit 2 (inch) or 3 (cm); colour samples centred, EXIF's default.
    """
    fields = struct.pack("<HHII", 0x11A, RATIONAL, 1, 62) + struct.pack("<HHII", 0x11B, RATIONAL, 1, 70)
    fields += struct.pack("<HHII", 0x128, SHORT, 1, unit) + struct.pack("<HHII", 0x213, SHORT, 1, 1)
    return struct.pack("<2sHIH", b"II", 42, 8, 4) + fields + struct.pack("<IIIII", 0, x, 1, y, 1)


def without(fields: Sequence[Field], tags: set[int]) -> list[Field]:
    """Return the fields but for those of some tags."""
    return [field for field in fields if field.tag not in tags]
