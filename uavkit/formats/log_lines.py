"""Logs that are texts: their lines with where they stand, and rows collected column by column."""

import math
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import BinaryIO, Protocol, TypeVar

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.core.gpstime import NO_TIME, gps_time_ns_from_utc
from uavkit.core.progress import Progress

LONGEST_LINE = 64 * 1024
"""Bytes; what is longer is no line of a log and comes in pieces."""
_REPORT_BYTES = 1024 * 1024
_LAST_YEAR = 2200
"""Later ones are nonsense, and beyond 64 bits of nanoseconds."""
_NUMBER = re.compile(r"[+-]?(?:\d{1,40}(?:\.\d{0,40})?|\.\d{1,40})(?:[eE][+-]?\d{1,3})?")
_SECONDS = re.compile(r"([+-]?)(\d{1,19})(?:\.(\d{1,18}))?")


@dataclass(frozen=True, slots=True)
class Line:
    """A line, or a run of zero bytes within one (those are never text)."""

    offset: int
    length: int
    """Its line end included."""
    text: str
    """Without its line end; bytes that are no UTF-8 are replaced."""

    @property
    def end(self) -> int:
        """Offset of the byte after it."""
        return self.offset + self.length


def lines_of(stream: BinaryIO) -> Iterator[Line]:
    """Yield the lines of a stream at its beginning; zero bytes end a line, as a part that a card did not write."""
    offset = 0
    while raw := stream.readline(LONGEST_LINE):
        for part in re.finditer(rb"[^\0]+|\0+", raw):
            text = part[0].decode("utf-8", errors="replace").rstrip("\r\n")
            yield Line(offset + part.start(), len(part[0]), text.removeprefix("\ufeff") if offset == 0 else text)
        offset += len(raw)


class _Placed(Protocol):
    """Something at a place in a file."""

    @property
    def offset(self) -> int:
        """Of its first byte."""


PlacedT = TypeVar("PlacedT", bound=_Placed)


def reported(things: Iterable[PlacedT], path: Path, progress: Progress) -> Iterator[PlacedT]:
    """Yield what is read of a file, and tell how far reading is, each megabyte."""
    size, next_offset = path.stat().st_size if path.is_file() else 0, 0
    for thing in things:
        if thing.offset >= next_offset:
            progress("reading", thing.offset, max(size, thing.offset))  # of a KMZ the offset is in what it unpacks to
            next_offset = thing.offset + _REPORT_BYTES
        yield thing
    progress("reading", size, size)


def head_text(head: bytes) -> str:
    """Return the first bytes of a file as text, whatever they are; UTF-16 only where a byte order mark says so."""
    encoding = "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"
    return head.decode(encoding, errors="replace").removeprefix("\ufeff")


def number(text: str) -> float:
    """Return a decimal number, NaN for anything else (also for inf, hexadecimal, underscores, decimal commas)."""
    if not text:
        return math.nan
    text = text.strip()
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    return value if math.isfinite(value) else math.nan


def nanoseconds(text: str, digits: int = 9) -> int | None:
    """Return decimal seconds as integer ns, exactly (cut beyond ns); None for anything else.

    ``digits`` are those of a nanosecond behind the point of the unit: 6 for milliseconds, 0 for ns themselves.
    """
    found = _SECONDS.fullmatch(text.strip())
    if found is None:
        return None
    value: int = int(found[2]) * 10**digits + int("0" + (found[3] or "").ljust(digits, "0")[:digits])
    if value > 2**62:
        return None
    return -value if found[1] == "-" else value


def gps_time_of(text: str, zone: tzinfo | None) -> int | None:
    """Return the GPS time of an ISO 8601 instant, in ``zone`` where it names none; None for what is no instant.

    That is a date alone, a time of no zone where ``zone`` is None, and nonsense.
    """
    text = text.strip()
    if len(text) < 16:
        return None
    try:
        moment = datetime.fromisoformat(text)
        moment = moment if moment.tzinfo else moment.replace(tzinfo=zone)
        return gps_time_ns_from_utc(moment.astimezone(UTC)) if moment.tzinfo and moment.year <= _LAST_YEAR else None
    except (ValueError, OverflowError):
        return None


def is_place(latitude_deg: float, longitude_deg: float) -> bool:
    """Tell whether degrees are a place on earth."""
    return abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0


class Columns:
    """Rows collected column by column, 8 bytes a value."""

    def __init__(self, numbers: Sequence[str], integers: Sequence[str] = ()) -> None:
        """Name the columns: float64, and int64."""
        self._numbers = {name: array("d") for name in numbers}
        self._integers = {name: array("q") for name in integers}
        self._count = 0

    def add(self, **values: float | None) -> None:
        """Append a row; what is not given, or None, is unknown: NaN in numbers, NO_TIME in integers."""
        for name, column in self._numbers.items():
            value = values.get(name)
            column.append(math.nan if value is None else value)
        for name, integers in self._integers.items():
            value = values.get(name)
            integers.append(NO_TIME if value is None else int(value))
        self._count += 1

    def __len__(self) -> int:
        return self._count

    def numbers(self, name: str) -> Array:
        """Return a column of float64, (n,)."""
        return np.array(self._numbers[name], dtype=np.float64)

    def integers(self, name: str) -> Indices:
        """Return a column of int64, (n,)."""
        return np.array(self._integers[name], dtype=np.int64)
