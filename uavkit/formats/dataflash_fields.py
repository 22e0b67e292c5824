"""What messages of a dataflash log look like: format characters, definitions, and messages of one name as columns.

Format characters and units: ArduPilot, libraries/AP_Logger/LogStructure.h. The hundredths of c, C, e, E and the 1e-7
degrees of L are turned into whole units here; other columns stay as they are written.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Indices
from uavkit.core.flight_log import Damage

Column = NDArray[Any]

FMT_TYPE = 0x80
FMT_LENGTH = 89
CHARACTERS: Mapping[str, tuple[str, float]] = {
    "a": ("(32,)<i2", 1.0),
    "b": ("i1", 1.0),
    "B": ("u1", 1.0),
    "h": ("<i2", 1.0),
    "H": ("<u2", 1.0),
    "i": ("<i4", 1.0),
    "I": ("<u4", 1.0),
    "f": ("<f4", 1.0),
    "d": ("<f8", 1.0),
    "g": ("<f2", 1.0),
    "n": ("S4", 1.0),
    "N": ("S16", 1.0),
    "Z": ("S64", 1.0),
    "c": ("<i2", 100.0),
    "C": ("<u2", 100.0),
    "e": ("<i4", 100.0),
    "E": ("<u4", 100.0),
    "L": ("<i4", 1e7),
    "M": ("u1", 1.0),
    "q": ("<i8", 1.0),
    "Q": ("<u8", 1.0),
}
"""Type of a column by its character, and by what it is divided."""
USED = frozenset(
    [
        "TimeUS", "TimeMS", "T", "I", "Status", "GMS", "GWk", "Week", "NSats", "Lat", "Lng", "Alt", "RelAlt", "RAlt",
        "RelHomeAlt", "Spd", "GCrs", "VZ", "HAcc", "VAcc", "VV", "SMS", "AEl", "Und", "Roll", "Pitch", "Yaw",
        "R", "P", "Y", "Img", "Name", "Value", "Message",
    ]
)  # fmt: skip
"""Columns that end up in tables."""
TEXT_CHARACTERS = frozenset("nNZ")
WANTED = frozenset({"CAM", "TRIG", "GPS", "GPS2", "GPSB", "GPA", "GPA2", "GPAB", "POS", "ATT", "MSG", "PARM"})


def size_of(character: str) -> int:
    """Return the bytes of a column, 0 for a character that is not known."""
    known = CHARACTERS.get(character)
    return np.dtype(known[0]).itemsize if known else 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Definition:
    """One FMT: what messages of a type are called and hold."""

    type_number: int
    length: int
    """Of the whole message in bytes, its head of three included."""
    name: str
    characters: str
    columns: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """Whether all characters are known and their sizes add up to the length."""
        sizes = [size_of(character) for character in self.characters]
        return bool(sizes) and min(sizes) > 0 and sum(sizes) + 3 == self.length

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Columns with their characters; a column named twice counts once, one without a name not at all."""
        first: dict[str, str] = {}
        for column, character in zip(self.columns, self.characters, strict=False):
            if column:
                first.setdefault(column, character)
        return tuple(first.items())

    def dtype(self) -> "np.dtype[np.void]":
        """Return the type of a row, its head included; raises ValueError where the definition does not agree."""
        if not self.agrees:
            raise ValueError(f"{self.name}: {self.characters} are not {self.length} bytes")
        at, names, formats, offsets = 3, list[str](), list[str](), list[int]()
        taken = set[str]()
        for column, character in zip(self.columns, self.characters, strict=False):
            if column and column not in taken:
                taken.add(column)
                names.append(column)
                formats.append(CHARACTERS[character][0])
                offsets.append(at)
            at += size_of(character)
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": self.length})

    def columns_of(self, rows: NDArray[np.uint8], only: frozenset[str] | None = None) -> dict[str, Column]:
        """Return the columns of messages (n, length) in whole units, each (n,) or (n, 32); all, or some by name."""
        table = np.ascontiguousarray(rows).reshape(-1).view(self.dtype())
        scaled = dict[str, Column]()
        for column, character in self.pairs:
            if only is not None and column not in only:
                continue
            divisor = CHARACTERS[character][1]
            raw = table[column]
            scaled[column] = raw.astype(np.float64) / divisor if divisor != 1.0 else raw.copy()
        return scaled


@dataclass(frozen=True, slots=True, kw_only=True)
class Rows:
    """Messages of one name, n of them in the order of the file."""

    places: Indices
    """(n,) of their first bytes in the file."""
    columns: Mapping[str, Column]

    def __len__(self) -> int:
        return len(self.places)

    def number(self, *names: str) -> Array:
        """Return the first of these columns that is there, as float64 (n,); NaN where none is."""
        found = next((self.columns[name] for name in names if name in self.columns), None)
        if found is None or found.dtype.kind not in "iufb" or found.ndim != 1:
            return np.full(len(self), np.nan)
        return np.asarray(found, dtype=np.float64)

    def integer(self, name: str, otherwise: int) -> Indices:
        """Return a column as int64 (n,), ``otherwise`` where it is not there or not within 2^62."""
        column = self.columns.get(name)
        if column is None or column.ndim != 1 or column.dtype.kind not in "iuf":
            return np.full(len(self), otherwise, dtype=np.int64)
        if column.dtype.kind == "f":
            good = np.abs(column) < 2.0**62
        else:
            good = column <= np.iinfo(np.int64).max // 2 if column.dtype.itemsize == 8 else np.full(len(self), True)
        return np.where(good, np.where(good, column, 0).astype(np.int64), otherwise)

    def texts(self, name: str) -> tuple[str, ...]:
        """Return a column of text; bytes that are not UTF-8 are shown as such."""
        column = self.columns.get(name)
        if column is None or column.dtype.kind != "S":
            return ("",) * len(self)
        return tuple(text_of(bytes(value)) for value in column.tolist())

    def where(self, rows: "NDArray[np.bool_] | Indices") -> "Rows":
        """Return the rows that a mask or indexes choose."""
        return Rows(places=self.places[rows], columns={name: column[rows] for name, column in self.columns.items()})


NO_ROWS = Rows(places=np.zeros(0, dtype=np.int64), columns={})


@dataclass(frozen=True, slots=True, kw_only=True)
class Messages:
    """What a dataflash log holds, before it is turned into tables."""

    rows: dict[str, Rows]
    """Of the wanted names that are in the log."""
    counts: Mapping[str, int]
    """Intact messages by name."""
    damage: Damage
    notes: tuple[str, ...] = ()

    def of(self, name: str) -> Rows:
        """Return the messages of a name, none where there are none."""
        return self.rows.get(name, NO_ROWS)

    def take(self, name: str) -> Rows:
        """Return the messages of a name and keep them no longer: logs are large."""
        return self.rows.pop(name, NO_ROWS)


def text_of(raw: bytes) -> str:
    """Return the text before the first zero byte."""
    return raw.split(b"\0", 1)[0].decode("utf-8", errors="backslashreplace")


def definition_of(message: bytes) -> Definition:
    """Return what an FMT message (89 bytes) defines."""
    columns = text_of(message[25:89])
    return Definition(
        type_number=message[3],
        length=message[4],
        name=text_of(message[5:9]),
        characters=text_of(message[9:25]),
        columns=tuple(name.strip() for name in columns.split(",")) if columns else (),
    )


def joined(parts: Sequence[Rows]) -> Rows:
    """Return the rows of several parts in the order of the file; columns that a part lacks are NaN or empty there."""
    if len(parts) == 1:
        return parts[0]
    places = np.concatenate([part.places for part in parts])
    order = np.argsort(places, kind="stable")
    names = dict.fromkeys(name for part in parts for name in part.columns)
    columns = {name: _joined_column([part.columns.get(name) for part in parts], parts)[order] for name in names}
    return Rows(places=places[order], columns=columns)


def _joined_column(columns: Sequence[Column | None], parts: Sequence[Rows]) -> Column:
    known = [column for column in columns if column is not None]
    if any(column.dtype.kind == "S" for column in known):
        texts = [
            column if column is not None and column.dtype.kind == "S" else np.zeros(len(part), dtype="S64")
            for column, part in zip(columns, parts, strict=True)
        ]
        return np.concatenate(texts)
    if len(known) == len(columns) and all(column.shape[1:] == known[0].shape[1:] for column in known):
        return np.concatenate(known)
    filled = [
        column if column is not None and column.ndim == 1 else np.full(len(part), np.nan)
        for column, part in zip(columns, parts, strict=True)
    ]
    return np.concatenate(filled)


VEHICLE = re.compile(r"^[A-Za-z][\w:+-]* V\d+\.\d+")
"""A text that names vehicle and firmware: ``ArduCopter V4.6.3 (92b0cd78)``."""
