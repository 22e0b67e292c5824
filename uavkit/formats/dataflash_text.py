"""Reads ArduPilot dataflash logs as text (.log), as ground stations write them from binary ones.

A line is a message: name, then the columns that a line ``FMT, type, length, name, format, columns`` defines for it,
parted by commas, with or without blanks; values are in whole units. A line is understood if its name is defined, it has
as many columns as the definition (a text in the last column may hold commas), no control bytes, none above 127 where no
column is a text, and numbers where numbers belong (looked at in the kinds that are decoded). Bytes of other lines are
lost bytes; blank lines are not. A message that stands whole at the end of a line, behind what is left of another whose
end was lost, is found. A last line without its end is taken if it is understood.

Sources: ArduPilot, libraries/AP_Logger (writing as text), and the binary format in ``uavkit.formats.dataflash``.
"""

import re
from collections import defaultdict
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Indices
from uavkit.core.errors import InputError
from uavkit.core.flight_log import FlightLog, LogKind
from uavkit.core.progress import Progress, silent
from uavkit.formats.dataflash_fields import (
    TEXT_CHARACTERS,
    WANTED,
    Column,
    Definition,
    Messages,
    Rows,
    joined,
    size_of,
)
from uavkit.formats.dataflash_tables import flight_log
from uavkit.formats.kernels import dataflash_lines as marks
from uavkit.formats.log_bytes import DamageTally, feed, opened

_BLOCK_BYTES = 1024 * 1024
_LONGEST_LINE = 8192
_MOST_TRIES = 200_000
"""Looks for a message inside a damaged line, over a whole file: a file so damaged is not worth more time."""
_FMT_LINE = re.compile(rb"(?m)^[ \t]*FMT[ \t]*,[ \t]*\d+[ \t]*,[ \t]*\d+[ \t]*,[ \t]*\w+[ \t]*,")
_NAMES = re.compile(rb"(?=([A-Z][A-Z0-9]{0,3})[ \t]*,)")
_FMT_PARTS = 6
_FMT = "FMT"
_TEXTS = TEXT_CHARACTERS | {"M", "a"}
"""Modes are written by their names, arrays in brackets."""


def recognises(head: bytes) -> bool:
    """Tell whether the first bytes are of a dataflash log as text: a line defines a message."""
    return bool(_FMT_LINE.search(head))


def read_log(path: Path, progress: Progress = silent) -> FlightLog:
    """Read a dataflash log as text; raises InputError where the file cannot be read or nothing is defined in it."""
    return flight_log(read_messages(path, WANTED, progress), str(path), LogKind.DATAFLASH_TEXT)


def read_messages(
    path: Path, names: frozenset[str] = WANTED, progress: Progress = silent, block_bytes: int = _BLOCK_BYTES
) -> Messages:
    """Return the messages of some names with all their columns, and counts and damage of all.

    Raises InputError where the file cannot be read or no message is in it.
    """
    size = path.stat().st_size if path.is_file() else 0
    with opened(path) as stream:
        lines = _read(stream, _Lines(names), progress, size, block_bytes)
        if lines.late:
            stream.seek(0)
            lines = _read(stream, _Lines(names, lines.first), progress, size, block_bytes)
    if not lines.first:
        raise InputError(
            f"{path}: no line defines messages (FMT), without which a dataflash log cannot be read: "
            "convert the binary log again, or give the binary log itself"
        )
    return lines.messages()


def _read(stream: BinaryIO, lines: "_Lines", progress: Progress, size: int, block_bytes: int) -> "_Lines":
    feed(stream, lines.take, progress, size, block_bytes)
    return lines


class _Lines:
    """One reading of a file, block by block; ``first`` holds the first definition of each name."""

    def __init__(self, names: frozenset[str], known: "dict[str, Definition] | None" = None) -> None:
        """Begin with the definitions that another reading found."""
        self._names = names
        self.first: dict[str, Definition] = dict(known or {})
        self.late = False
        """Whether a name was defined after lines of it."""
        self._now: dict[str, Definition] = dict(self.first)
        self._parts: dict[str, list[Rows]] = defaultdict(list)
        self._counts: dict[str, int] = defaultdict(int)
        self._undefined: set[str] = set()
        self._tally = DamageTally()
        self._table = np.zeros((1 << 15, 5), dtype=np.int64)
        self._endless = False
        self._tries = 0

    def take(self, block: NDArray[np.uint8], offset: int, final: bool) -> int:
        """Read the lines of a block; returns how much of it is done with."""
        p = 0
        while True:
            begin, found = marks.lines(block, final, p, self._table)
            if found == 0:
                break
            self._take_lines(block, self._table[:found], offset)
            p = begin
        if not final and len(block) - p > _LONGEST_LINE:
            self._tally.add(offset + p, len(block) - p, "a line without an end")
            self._endless = True
            return len(block)
        return p

    def messages(self) -> Messages:
        """Return what was found."""
        notes = [
            f"lines begin with {name}, but nothing defines them: they count as lost"
            for name in sorted(self._undefined - set(self.first))[:20]
        ]
        return Messages(
            rows={name: joined(parts) for name, parts in self._parts.items()},
            counts=dict(self._counts),
            damage=self._tally.result(),
            notes=tuple(notes),
        )

    def _take_lines(self, block: NDArray[np.uint8], table: Indices, offset: int) -> None:
        why = np.full(len(table), "", dtype="U64")
        why[table[:, marks.WHAT] == marks.BROKEN] = "a line that is no message"
        if self._endless:
            why[0], self._endless = "a line without an end", False
        defining = table[:, marks.NAME] == _code_of(_FMT)
        self._take_kinds(block, table, defining, why, offset)
        self._split_texts(block, table, why)
        self._take_kinds(block, table, ~defining, why, offset)
        self._take_tails(block, table[why != ""], why[why != ""], offset)

    def _take_tails(self, block: NDArray[np.uint8], bad: Indices, why: NDArray[np.str_], offset: int) -> None:
        """Read what stands whole at the end of damaged lines, and count the rest of them as lost."""
        if len(bad) == 0:
            return
        tails = bad.copy()
        tails[:, marks.WHAT] = marks.BROKEN
        for row in range(len(bad)):
            if self._tries > _MOST_TRIES:
                break
            tails[row] = self._tail(block, bad[row])
        refused = np.where(tails[:, marks.WHAT] == marks.BROKEN, "no message inside", "").astype("U64")
        self._take_kinds(block, tails, np.full(len(tails), True), refused, offset)
        begin, end = bad[:, marks.BEGIN], np.where(refused == "", tails[:, marks.BEGIN], bad[:, marks.END])
        first = np.flatnonzero(np.append(True, begin[1:] != end[:-1]))
        last = np.append(first[1:], len(bad)) - 1
        for a, b in zip(first.tolist(), last.tolist(), strict=True):
            self._tally.add(offset + int(begin[a]), int(end[b] - begin[a]), str(why[a]))

    def _split_texts(self, block: NDArray[np.uint8], table: Indices, why: NDArray[np.str_]) -> None:
        """Refuse lines that end with a text in which another message stands: the end of the line was lost."""
        texts = [
            _code_of(definition.name)
            for definition in self._now.values()
            if _text_columns(definition)[-1] and definition.name != _FMT
        ]
        for row in np.flatnonzero((why == "") & np.isin(table[:, marks.NAME], texts)).tolist():
            if self._tail(block, table[row])[marks.WHAT] != marks.BROKEN:
                why[row] = "a line that runs into the next one"

    def _take_kinds(
        self, block: NDArray[np.uint8], table: Indices, which: NDArray[np.bool_], why: NDArray[np.str_], offset: int
    ) -> None:
        """Read those of some lines that have no reason in ``why`` yet, definitions first."""
        usable = which & (why == "") & (table[:, marks.WHAT] != marks.BLANK)
        codes = np.unique(table[usable, marks.NAME]).tolist()
        for code in sorted(codes, key=lambda code: _name_of(code) != _FMT):
            rows = np.flatnonzero(usable & (table[:, marks.NAME] == code))
            self._take_kind(block, table, rows, why, offset)

    def _tail(self, block: NDArray[np.uint8], row: Indices) -> Indices:
        """Return the mark of a message that stands whole at the end of a damaged line, one that is BROKEN if none does.

        Where the end of the line before was lost, the message begins in the middle.
        """
        begin, end = int(row[marks.BEGIN]), int(row[marks.END])
        none = np.array([begin, end, 0, 0, marks.BROKEN], dtype=np.int64)
        if end - begin > _LONGEST_LINE:
            return none
        out = np.zeros((1, 5), dtype=np.int64)
        for match in _NAMES.finditer(block[begin:end].tobytes(), 1):
            self._tries += 1
            if self._tries > _MOST_TRIES:
                break
            marks.lines(block[:end], True, begin + match.start(), out)
            name = match.group(1).decode("ascii")
            if out[0, marks.WHAT] in (marks.PLAIN, marks.WIDE) and (name == _FMT or self._fits(name, out)[0]):
                return np.array(out[0], dtype=np.int64)
        return none

    def _fits(self, name: str, table: Indices) -> NDArray[np.bool_]:
        """Tell which lines of a name have as many columns as are defined, and bytes as its columns may have, (n,)."""
        definition = self._now.get(name)
        if definition is None:
            return np.zeros(len(table), dtype=np.bool_)
        is_text = _text_columns(definition)
        commas, count = table[:, marks.COMMAS], len(definition.columns)
        enough = (commas >= count) if is_text[-1] else (commas == count)
        return np.asarray(enough & (bool(is_text.any()) | (table[:, marks.WHAT] == marks.PLAIN)), dtype=np.bool_)

    def _take_kind(
        self, block: NDArray[np.uint8], table: Indices, rows: Indices, why: NDArray[np.str_], offset: int
    ) -> None:
        """Read the lines of one name; those that cannot be read get their reason in ``why``."""
        name = _name_of(int(table[rows[0], marks.NAME]))
        if name == _FMT:
            for row in rows.tolist():
                why[row] = self._define(block[table[row, marks.BEGIN] : table[row, marks.END]].tobytes())
            self._counts[name] += int(np.sum(why[rows] == ""))
            return
        definition = self._now.get(name)
        if definition is None:
            self._undefined.add(name)
            why[rows] = "lines of a name that nothing defines"
            return
        fits = self._fits(name, table[rows])
        why[rows[~fits]] = "a line of another number of columns, or of bytes that are no text"
        good = rows[fits]
        if name in self._names and len(good):
            good = self._decode(block, table, good, definition, offset)
            why[np.setdiff1d(rows[fits], good)] = "a line with something else where a number belongs"
        self._counts[name] += len(good)
        if not self._counts[name]:
            del self._counts[name]

    def _decode(
        self, block: NDArray[np.uint8], table: Indices, rows: Indices, definition: Definition, offset: int
    ) -> Indices:
        """Keep the columns of lines; returns those that could be read."""
        is_text = _text_columns(definition)
        values = np.zeros((len(rows), len(is_text)))
        bounds = np.zeros((len(rows), len(is_text), 2), dtype=np.int64)
        good = marks.fields(block, table[rows], is_text, values, bounds)
        columns: dict[str, Column] = {}
        for k, column in enumerate(definition.columns):
            if column in columns:
                continue
            columns[column] = _texts(block, bounds[good, k]) if is_text[k] else values[good, k]
        if np.any(good):
            self._parts[definition.name].append(Rows(places=offset + table[rows[good], marks.BEGIN], columns=columns))
        return rows[good]

    def _define(self, line: bytes) -> str:
        """Take note of a line FMT; returns why it cannot be understood, or nothing."""
        definition = _definition_of(line)
        if definition is None:
            return "a definition that cannot be read"
        if definition.name != _FMT:
            self.late = self.late or (definition.name in self._undefined and definition.name not in self.first)
            self._now[definition.name] = definition
            self.first.setdefault(definition.name, definition)
        return ""


def _definition_of(line: bytes) -> Definition | None:
    parts = [part.strip() for part in line.decode("ascii", errors="replace").split(",", _FMT_PARTS - 1)]
    if len(parts) < _FMT_PARTS or not (parts[1].isdecimal() and parts[2].isdecimal() and parts[3].isalnum()):
        return None
    columns = tuple(column.strip() for column in parts[5].split(","))
    characters = parts[4]
    named = all(re.fullmatch(r"[A-Za-z_]\w*", column, re.ASCII) for column in columns)
    if not named or len(columns) > len(characters):
        return None
    if min(map(size_of, characters), default=0) == 0 or int(parts[1]) > 255 or int(parts[2]) > 255:
        return None
    return Definition(
        type_number=int(parts[1]), length=int(parts[2]), name=parts[3], characters=characters, columns=columns
    )


def _text_columns(definition: Definition) -> NDArray[np.bool_]:
    characters = definition.characters[: len(definition.columns)]
    return np.array([character in _TEXTS for character in characters], dtype=np.bool_)


def _name_of(code: int) -> str:
    return code.to_bytes(8, "little").rstrip(b"\0").decode("ascii")


def _code_of(name: str) -> int:
    return int.from_bytes(name.encode("ascii")[:8], "little")


def _texts(block: NDArray[np.uint8], bounds: Indices) -> Column:
    texts = [block[a:b].tobytes().strip() for a, b in bounds.tolist()]
    return np.array(texts, dtype=f"S{max(1, *map(len, texts))}") if texts else np.zeros(0, dtype="S1")
