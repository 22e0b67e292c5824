"""Reads ArduPilot dataflash logs (.BIN).

A message is A3 95, the number of its type, and a payload of the length that an FMT message defines for the type; there
are no checksums. The rule by which messages are told from damage:

1. Where the message before ended (or the file begins), a message stands if the head of a known type stands there and
   all its length lies in the file. Elsewhere the next *sure* one is looked for, byte by byte. Sure is a message whose
   time (its first column, TimeUS or TimeMS) is within a minute of that of the message before, an FMT whose length is
   that of its format characters, or one that a head of any type, or the end of the file, follows.
2. What a known head or the end of the file follows is accepted, unless messages inside it lead to its very end, at
   least one of them sure by its time or two in a chain: then it was cut short and they are the truth.
3. What nothing known follows is accepted (the damage is behind it), unless its time is more than a minute away from
   that of the message before, or a sure message begins inside it: then it was cut short.

So what damage did not touch is found; one case is left: a single message without a time, as firmware of 2013 has many,
that by chance ends where the one cut short before it would have. What damage touched counts as lost, except where head
and length stand and nothing tells: a payload with a flipped bit is taken as it stands. Bytes that belong to no accepted
message are lost bytes, all of them: those of types that nothing defines (an FMT is good for what stands before it too),
and zeros at the end of a file whose space was set aside, which the notes name, for they are no damage. A log that was
downloaded while it grew is a prefix of the whole one: its last message is cut short, and that is all.

Sources: ArduPilot, libraries/AP_Logger/LogStructure.h (heads, FMT, format characters).
"""

import re
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Indices
from uavkit.core.errors import InputError
from uavkit.core.flight_log import FlightLog, LogKind
from uavkit.core.progress import Progress, silent
from uavkit.formats.dataflash_fields import (
    CHARACTERS,
    FMT_LENGTH,
    FMT_TYPE,
    USED,
    WANTED,
    Definition,
    Messages,
    Rows,
    definition_of,
    joined,
    size_of,
)
from uavkit.formats.dataflash_tables import flight_log
from uavkit.formats.kernels import dataflash_frames as frames
from uavkit.formats.log_bytes import DamageTally, feed, opened

_REASONS = {
    frames.NO_HEADER: "no message begins here",
    frames.CUT_SHORT: "a message cut short: others begin inside it",
    frames.FILE_ENDS: "a message cut short by the end of the file",
    frames.WRONG_TIME: "a message of a wrong time that no message follows",
}
_HEAD = b"\xa3\x95"
_FMT_HEAD = re.compile(rb"\xa3\x95\x80[\s\S]{2}[A-Z0-9]{2,4}\0{0,2}[a-zA-Z]")
_LEAST_HEADS = 4
_LONGEST_MESSAGE = 255
_PIECE = 4096
_MOST_NOTES = 20
_BLOCK_BYTES = 256 * 1024
"""Small, for it is the greater part of what reading takes beside the tables."""


def recognises(head: bytes) -> bool:
    """Tell whether the first bytes are of a dataflash log: an FMT message, or heads far oftener than by chance."""
    return bool(_FMT_HEAD.search(head)) or head.count(_HEAD) >= max(_LEAST_HEADS, len(head) // 1024)


def read_log(path: Path, progress: Progress = silent) -> FlightLog:
    """Read a dataflash log; raises InputError where the file cannot be read or no message is in it."""
    return flight_log(_read(path, WANTED, progress, _BLOCK_BYTES).messages(USED), str(path), LogKind.DATAFLASH)


def read_messages(
    path: Path, names: frozenset[str] = WANTED, progress: Progress = silent, block_bytes: int = _BLOCK_BYTES
) -> Messages:
    """Return the messages of some names with all their columns, and counts and damage of all.

    Raises InputError where the file cannot be read or no message is in it.
    """
    return _read(path, names, progress, block_bytes).messages()


def _read(path: Path, names: frozenset[str], progress: Progress, block_bytes: int) -> "_Scan":
    size = path.stat().st_size if path.is_file() else 0
    with opened(path) as stream:
        scan = _scanned(stream, _Scan(names), progress, size, block_bytes)
        if scan.late:
            stream.seek(0)
            scan = _scanned(stream, _Scan(names, scan.first), progress, size, block_bytes)
    if not scan.first:
        raise InputError(
            f"{path}: holds no definitions of messages (FMT), without which a dataflash log cannot be read: "
            "download it again from its beginning"
        )
    return scan


def _scanned(stream: BinaryIO, scan: "_Scan", progress: Progress, size: int, block_bytes: int) -> "_Scan":
    feed(stream, scan.take, progress, size, block_bytes)
    return scan


@dataclass(slots=True)
class _Gathered:
    places: list[Indices] = field(default_factory=list)
    rows: list[NDArray[np.uint8]] = field(default_factory=list)


class _Scan:
    """One reading of a file, block by block; ``first`` holds the first definition of each type."""

    def __init__(self, names: frozenset[str], known: "dict[int, Definition] | None" = None) -> None:
        """Begin with the definitions that another reading found."""
        self._names = names
        self.first: dict[int, Definition] = {}
        self.late = False
        """Whether a type was defined after bytes were lost that may have been messages of it."""
        self._now: dict[int, Definition] = {}
        self._rivals: dict[int, Definition] = {}
        self._gathered: dict[Definition, _Gathered] = defaultdict(_Gathered)
        self._counts: dict[str, int] = defaultdict(int)
        self._undefined: dict[int, int] = defaultdict(int)
        self._tally, self._lost_any = DamageTally(), False
        self._notes: dict[str, None] = {}
        self._size, self._zeros_from, self._end = 0, 0, 0
        self._tables = np.zeros((5, 256), dtype=np.int64)
        self._tables[0, FMT_TYPE] = FMT_LENGTH
        self._tables[2, [ord(character) for character in CHARACTERS]] = [size_of(c) for c in CHARACTERS]
        self._tables[3, FMT_TYPE] = frames.STOP_AFTER
        self._state = np.array([-1, 1, 0], dtype=np.int64)
        self._places = np.zeros(1 << 16, dtype=np.int64)
        self._spans = np.zeros((1 << 12, 3), dtype=np.int64)
        for definition in (known or {}).values():
            self._define(definition)

    def take(self, block: NDArray[np.uint8], offset: int, final: bool) -> int:
        """Find the messages of a block; returns how much of it is done with."""
        self._note_zeros(block, offset)
        p, reason = 0, frames.FULL
        while reason != frames.DONE:
            p, found, lost, reason = frames.scan(block, final, p, self._tables, self._state, self._places, self._spans)
            self._note_lost(self._spans[:lost], offset)
            self._gather(block, self._places[:found], offset)
            if reason == frames.DEFINITION:
                self._redefine(definition_of(block[p - FMT_LENGTH : p].tobytes()))
            elif reason == frames.CONTESTED:
                self._decide(block, p)
        if self._state[frames.END] > 0:
            self._end, self._state[frames.END] = offset + int(self._state[frames.END]), 0
        return p if not final else len(block)

    def messages(self, columns: frozenset[str] | None = None) -> Messages:
        """Return what was found, with all columns or some by name; what it was found in is given up."""
        self._count_all()
        parts: dict[str, list[Rows]] = defaultdict(list)
        for definition in list(self._gathered):
            taken = self._gathered.pop(definition)
            places, rows = np.concatenate(taken.places), np.concatenate(taken.rows)
            parts[definition.name].append(Rows(places=places, columns=definition.columns_of(rows, columns)))
        return Messages(
            rows={name: joined(rows) for name, rows in parts.items()},
            counts=dict(self._counts),
            damage=self._tally.result(),
            notes=(*self._notes, *self._last_notes()),
        )

    def _gather(self, block: NDArray[np.uint8], places: Indices, offset: int) -> None:
        kinds = block[places + 2]
        for kind in np.unique(kinds).tolist():
            definition = self._now.get(kind)
            if kind == FMT_TYPE or definition is None:
                continue
            begins = places[kinds == kind]
            taken = self._gathered[definition]
            taken.places.append(begins + offset)
            taken.rows.append(block[begins[:, None] + np.arange(definition.length)])

    def _redefine(self, definition: Definition) -> None:
        """Take note of a definition; one that contradicts an older one of the same type is decided by what follows."""
        kind = definition.type_number
        if kind == FMT_TYPE or not _can_be(definition):
            if kind != FMT_TYPE:
                self._note(f"the definition of type {kind} contradicts itself and is left out")
            return
        old = self._now.get(kind)
        if old is None or old.length == definition.length:
            self.late = self.late or (old is None and self._lost_any)
            self._define(definition)
        elif old != definition:
            self._rivals[kind] = definition
            self._tables[3, kind] = frames.STOP_BEFORE

    def _define(self, definition: Definition) -> None:
        kind = definition.type_number
        self._count_type(kind)
        self._now[kind] = definition
        self.first.setdefault(kind, definition)
        self._tables[0, kind] = definition.length
        self._tables[1, kind] = _clock_of(definition)
        wanted = definition.name in self._names
        self._tables[3, kind] = frames.GATHER if wanted and definition.agrees else frames.COUNT
        if wanted and not definition.agrees:
            self._note(f"{definition.name} has columns of a kind that is not known: counted, not decoded")

    def _decide(self, block: NDArray[np.uint8], p: int) -> None:
        """Choose between two definitions of the type at ``p`` by which of them leads to the head of a message."""
        kind = int(block[p + 2])
        old, new = self._now[kind], self._rivals.pop(kind)
        after_old = frames.frame_length(block, p + old.length, self._tables[0])
        after_new = frames.frame_length(block, p + new.length, self._tables[0])
        if after_old > 0 and after_new == 0:
            self._note(f"a second definition of type {kind} ({new.name}) does not fit and is left out")
            self._define(old)
        else:
            self._define(new)

    def _note(self, text: str) -> None:
        if len(self._notes) < _MOST_NOTES:
            self._notes[text] = None

    def _count_type(self, kind: int) -> None:
        """Book what was counted of a type under its present name."""
        count = int(self._tables[4, kind])
        if count:
            self._counts[self._now[kind].name if kind != FMT_TYPE else "FMT"] += count
            self._tables[4, kind] = 0

    def _count_all(self) -> None:
        for kind in np.flatnonzero(self._tables[4]).tolist():
            self._count_type(kind)

    def _note_lost(self, spans: Indices, offset: int) -> None:
        for begin, length, why in spans.tolist():
            self._lost_any = True
            if why >= frames.UNDEFINED:
                self._undefined[why - frames.UNDEFINED] += 1
                reason = f"messages of type {why - frames.UNDEFINED}, which nothing defines"
            else:
                reason = _REASONS[why]
            self._tally.add(offset + begin, length, reason)

    def _note_zeros(self, block: NDArray[np.uint8], offset: int) -> None:
        """Keep track of where the zeros begin that the file ends with."""
        self._size = offset + len(block)
        if block[-1] != 0:
            self._zeros_from = self._size
            return
        if not block.any():
            return
        for end in range(len(block), 0, -_PIECE):
            filled = np.flatnonzero(block[max(0, end - _PIECE) : end])
            if len(filled):
                self._zeros_from = offset + max(0, end - _PIECE) + int(filled[-1]) + 1
                return

    def _last_notes(self) -> list[str]:
        notes = [
            f"messages of type {kind} begin at {count} places, but nothing defines them: they count as lost"
            for kind, count in sorted(self._undefined.items())
            if kind not in self.first
        ]
        begin = max(self._zeros_from, self._end)
        zeros = self._size - begin
        if zeros > _LONGEST_MESSAGE or (zeros > 0 and begin == self._end):
            notes.append(f"the file ends with {zeros} zero bytes: space set aside, no damage, though counted as lost")
        return notes


def _can_be(definition: Definition) -> bool:
    """Tell whether a definition can be used: by its length at least, for characters of the future are not known."""
    unknown = any(character not in CHARACTERS for character in definition.characters)
    return definition.length > 3 and bool(definition.name) and (definition.agrees or unknown)


def _clock_of(definition: Definition) -> int:
    first = next(iter(definition.pairs), ("", ""))
    if first == ("TimeUS", "Q"):
        return frames.CLOCK_US
    return frames.CLOCK_MS if first == ("TimeMS", "I") else frames.NO_CLOCK
