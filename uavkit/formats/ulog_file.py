"""Messages and topics of a ULog, PX4's log format, read as a stream of blocks.

Source of the format: "ULog File Format" of PX4's developer guide (file version 1, with flag bits and appended data).

The format has no checksums. A message is accepted

* by its own content: data messages when the size is what the format of their subscription allows (padding at the end
  may be missing); marks (S) by their 8 bytes; information and parameters (I, M, P, Q) when the type in their key gives
  exactly the size they have; formats, subscriptions and texts (F, A, L, C) by their characters; others by their size;
* and by what follows: where no message begins at its end, it must not hide the beginning of another one, or it was cut
  short; after damage the weaker kinds count only when a message follows at once;
* data messages whose subscription or format was destroyed, when they have the size of a known format, or all one size,
  and a message follows.

Damage inside the values of a message leaves no trace and cannot be noticed. A log whose flags ask for features that
are not known is read as far as it is understood, and the flags are noted: one flipped bit must not cost a flight.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uavkit.core.flight_log import Damage
from uavkit.core.progress import Progress
from uavkit.formats.kernels import ulog_frames as kernels
from uavkit.formats.log_bytes import DamageTally, feed, opened

MAGIC = bytes((0x55, 0x4C, 0x6F, 0x67, 0x01, 0x12, 0x35))
BLOCK_BYTES = 1024 * 1024
MOST_TEXTS = 10_000
_MOST_LISTED = 1 << 17
MOST_FORMATS, MOST_ALIKE = 1024, 8
"""Formats of a log, and subscriptions under one number, that are kept: what is beyond is no flight log."""
_TYPES = {
    "int8_t": "i1", "uint8_t": "u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4", "uint32_t": "<u4",
    "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8", "bool": "u1", "char": "S1",
}  # fmt: skip
_FIELD = re.compile(r"([a-zA-Z0-9_\-/]+)(?:\[(\d{1,5})\])? ([a-zA-Z0-9_]+)")
_WORDS = {
    "A": "subscription", "B": "flag bits", "C": "tagged text", "F": "format", "I": "information", "L": "text",
    "M": "multiple information", "O": "dropout", "P": "parameter", "Q": "default parameter", "R": "end of subscription",
    "S": "synchronisation",
}  # fmt: skip
_REASONS = ("no message begins here", "a message is cut short by others", "the file ends within a message")

Rows = NDArray[Any]
"""(n,) of a structured type: the fields that were asked for and that the log has."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic:
    """A topic with all rows of one of its instances."""

    name: str
    instance: int
    rows: Rows


@dataclass(frozen=True, slots=True, kw_only=True)
class UlogContent:
    """What a ULog holds of the topics that were asked for."""

    topics: tuple[Topic, ...]
    """By name and instance; those without a row are left out."""
    message_counts: Mapping[str, int]
    """By topic; other messages by a word for their kind."""
    information: Mapping[str, "str | int | float"]
    parameters: Mapping[str, float]
    texts: tuple[str, ...]
    damage: Damage
    notes: tuple[str, ...]

    def of(self, name: str) -> tuple[Topic, ...]:
        """Return the instances of a topic."""
        return tuple(topic for topic in self.topics if topic.name == name)


def read_ulog(path: Path, wanted: Mapping[str, tuple[str, ...]], progress: Progress) -> UlogContent:
    """Read a file; ``wanted`` names topics and their fields, arrays as ``q[4]``.

    Raises InputError where the file cannot be read at all.
    """
    size = max(path.stat().st_size, 1) if path.is_file() else 1
    with opened(path) as stream:
        scanner = _Scanner(wanted)
        feed(stream, scanner.scan, progress, size, BLOCK_BYTES)
    return scanner.result()


def count_definitions(head: bytes) -> int:
    """Return how many messages that define or describe (all but data) are in the first bytes of a file."""
    scanner = _Scanner({})
    block = np.frombuffer(head, dtype=np.uint8).copy()  # compiled for arrays that may be written to
    scanner.scan(block, 0, final=False)
    return sum(scanner.type_count(letter) for letter in "BFIMPQS")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Format:
    """A format: its fields' types (a basic type, or another format's name), numbers of elements and names."""

    name: str
    fields: tuple[tuple[str, int, str], ...]


@dataclass(slots=True, kw_only=True)
class _Subscription:
    """A topic's instance under a number; sizes of its data messages, the number included; -1 while unknown."""

    name: str
    instance: int
    number: int
    section: int
    """How many headers of files stand before it."""
    least: int = 0
    most: int = -1
    row: "np.dtype[Any] | None" = None
    """Of the first bytes of a data message's content, with the fields that are wanted; None for none."""
    chunks: list[Rows] = field(default_factory=list)


class _Scanner:
    """Reads the blocks of one file in turn."""

    def __init__(self, wanted: Mapping[str, tuple[str, ...]]) -> None:
        self._wanted_fields = wanted
        self._state = np.zeros(kernels.STATE_LENGTH, dtype=np.int64)
        self._state[kernels.SYNCED] = 1
        self._tables = _empty_tables()
        self._frames = np.zeros((_MOST_LISTED, 3), dtype=np.int64)
        self._spans = np.zeros((4096, 3), dtype=np.int64)
        self._formats: dict[str, _Format] = {}
        self._bytes: dict[str, int] = {}
        self._open_formats: list[_Format] = []
        self._open_subscriptions: list[_Subscription] = []
        self._subscriptions: dict[int, list[_Subscription]] = {}
        self._topics: list[_Subscription] = []
        self._named_counts: dict[str, int] = {}
        self._information: dict[str, str | int | float] = {}
        self._parameters: dict[str, float] = {}
        self._defaults: dict[str, float] = {}
        self._texts: list[str] = []
        self._tally = DamageTally()
        self._notes: list[str] = []
        self._undecoded: dict[str, int] = {}

    def scan(self, block: NDArray[np.uint8], offset: int, final: bool) -> int:
        """Take a block's messages and return the number of bytes that are done with."""
        self._state[kernels.PLACE] = 0
        while True:
            self._state[kernels.FRAMES] = self._state[kernels.SPANS] = 0
            answer = kernels.scan(block, final, self._state, self._tables, self._frames, self._spans)
            for place, length, why in self._spans[: self._state[kernels.SPANS]].tolist():
                self._tally.add(offset + place, length, _REASONS[why])
            frames = self._frames[: self._state[kernels.FRAMES]]
            self._take_data(block, frames[frames[:, 2] >= 0])
            for place, length, number in frames[frames[:, 2] < 0].tolist():
                self._take_other(chr(-number), block[place : place + length].tobytes(), offset + place)
            full = len(frames) == len(self._frames) or self._state[kernels.SPANS] == len(self._spans)
            if answer == kernels.DONE and not full:
                return int(self._state[kernels.PLACE])

    def type_count(self, letter: str) -> int:
        """Return how many messages of a type were found."""
        return int(self._tables.type_counts[ord(letter)])

    def _take_data(self, block: NDArray[np.uint8], frames: NDArray[np.int64]) -> None:
        """Take rows of data messages, (n, 3), in parts of one number and one size each."""
        key = frames[:, 2] * 65536 + frames[:, 1]
        order = np.argsort(key, kind="stable")
        for part in np.split(frames[order], np.flatnonzero(np.diff(key[order])) + 1):
            if len(part):
                self._take_rows(block, part[:, 0], int(part[0, 2]), int(part[0, 1]) - 3)

    def _take_rows(self, block: NDArray[np.uint8], places: NDArray[np.int64], number: int, size: int) -> None:
        known = self._subscriptions.get(number, [])
        one = next((one for one in known if one.least <= size <= one.most and one.row is not None), None)
        if one is None or one.row is None:
            name = known[-1].name if known else str(number)
            self._undecoded[name] = self._undecoded.get(name, 0) + len(places)
            return
        windows = np.lib.stride_tricks.sliding_window_view(block, one.row.itemsize)
        found = windows[places + 5].view(one.row)[:, 0]
        packed = np.empty(len(found), dtype=[(name, one.row[name]) for name in one.row.names or ()])
        for name in one.row.names or ():
            packed[name] = found[name]
        one.chunks.append(packed)

    def _take_other(self, letter: str, message: bytes, offset: int) -> None:
        body = message[3:]
        if letter == "F":
            self._take_format(body)
        elif letter == "A":
            self._take_subscription(body)
        elif letter in "IP":
            self._take_value(letter, *_key_and_value(body))
        elif letter == "Q":
            self._take_value(letter, *_key_and_value(body[1:]))
        elif letter in "LC":
            if len(self._texts) < MOST_TEXTS:
                self._texts.append(body[9 if letter == "L" else 11 :].decode("utf-8", "replace").strip())
        elif letter == "B":
            self._take_flags(body)
        elif ord(letter) == kernels.HEADER_TYPE:
            self._take_header(message, offset)

    def _take_header(self, message: bytes, offset: int) -> None:
        if message[7] > 1:
            self._note(f"file version {message[7]}: read as version 1")
        if self.type_count(chr(kernels.HEADER_TYPE)) > 1:
            self._note(f"another log begins at byte {offset}: both are read as one")
            self._begin_section()

    def _begin_section(self) -> None:
        """Forget the definitions: another log begins with its own."""
        self._count_by_name()
        for known in (self._formats, self._bytes, self._subscriptions):
            known.clear()
        self._open_formats, self._open_subscriptions = [], []
        self._tables.least[:], self._tables.most[:], self._tables.learned[:] = 0, -1, 0
        self._tables.known_sizes[:] = self._tables.subscribed[:] = self._tables.wanted[:] = False

    def _take_flags(self, body: bytes) -> None:
        incompatible, appended = body[8:16], np.frombuffer(body[16:40], dtype="<u8")
        if incompatible[0] & 1:
            self._note(f"data appended after the flight (a crash dump): {int(np.sum(appended > 0))} times")
        if incompatible[0] & ~1 or any(incompatible[1:]):
            self._note(
                f"the flags ask for features that are not known ({incompatible.hex()}): read as far as understood"
            )

    def _take_format(self, body: bytes) -> None:
        one = _format_of(body)
        if one is None or one.name in self._formats or len(self._formats) == MOST_FORMATS:
            return
        self._formats[one.name] = one
        self._open_formats.append(one)
        while any([self._settle(open_one) for open_one in self._open_formats]):
            self._open_formats = [one for one in self._open_formats if one.name not in self._bytes]
        for subscription in [waiting for waiting in self._open_subscriptions if waiting.name in self._bytes]:
            self._resolve(subscription)
        self._open_subscriptions = [one for one in self._open_subscriptions if one.name not in self._bytes]

    def _settle(self, one: _Format) -> bool:
        """Work out the length of a format, and tell whether that can be done yet: nested ones come first."""
        lengths = [self._type_bytes(kind) for kind, _, _ in one.fields]
        if None in lengths:
            return False
        self._bytes[one.name] = sum(
            (each or 0) * count for each, (_, count, _) in zip(lengths, one.fields, strict=True)
        )
        sizes = self._sizes(one.name)
        if sizes is not None:
            self._tables.known_sizes[list(sizes)] = True
        return True

    def _take_subscription(self, body: bytes) -> None:
        number = body[1] + 256 * body[2]
        one = _Subscription(
            name=body[3:].decode("ascii"),
            instance=body[0],
            number=number,
            section=self.type_count(chr(kernels.HEADER_TYPE)),
        )
        others = self._subscriptions.setdefault(number, [])
        if len(others) == MOST_ALIKE or any(
            (other.name, other.instance) == (one.name, one.instance) for other in others
        ):
            return
        if others:
            self._note(f"two subscriptions under the number {number}: {others[-1].name} and {one.name}")
            self._count_by_name()
        others.append(one)
        self._topics.append(one)
        self._tables.subscribed[number] = True
        self._resolve(one)
        if one.name not in self._bytes:
            self._open_subscriptions.append(one)

    def _resolve(self, one: _Subscription) -> None:
        sizes = self._sizes(one.name)
        if sizes is None:
            return
        one.least, one.most = sizes
        self._tables.least[one.number], self._tables.most[one.number] = sizes
        fields = self._wanted_fields.get(one.name)
        if fields:
            self._tables.wanted[one.number] = True
            one.row = self._row_type(one.name, fields)

    def _sizes(self, name: str) -> tuple[int, int] | None:
        """Return the least and the greatest size of data messages of a format; None where it cannot be known."""
        most = self._bytes.get(name, 0)
        if not 8 <= most <= 65533:
            return None
        least = most
        for kind, count, label in reversed(self._formats[name].fields):
            if not label.startswith("_padding"):
                break
            least -= (self._type_bytes(kind) or 0) * count
        return max(least, 8) + 2, most + 2

    def _type_bytes(self, kind: str) -> int | None:
        """Return the length of a basic type or a format; None where it is not known (yet)."""
        return np.dtype(_TYPES[kind]).itemsize if kind in _TYPES else self._bytes.get(kind)

    def _row_type(self, name: str, wanted: tuple[str, ...]) -> "np.dtype[Any] | None":
        """Return the type of the first bytes of a message, up to the last field that is wanted."""
        at, names, kinds, offsets = 0, list[str](), list[Any](), list[int]()
        for kind, count, label in self._formats[name].fields:
            size = (self._type_bytes(kind) or 0) * count
            asked = label if count == 1 else f"{label}[{count}]"
            usable = kind in _TYPES and kind != "char" and not label.startswith("_padding")
            if asked in wanted and usable and label not in names:
                names.append(label)
                kinds.append(_TYPES[kind] if count == 1 else (_TYPES[kind], (count,)))
                offsets.append(at)
            at += size
        missing = "timestamp" not in names or kinds[names.index("timestamp")] != "<u8"
        if missing:
            self._note(f"{name}: its format has no time and is left out")
            return None
        end = offsets[-1] + np.dtype(kinds[-1]).itemsize
        return np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": end})

    def _take_value(self, letter: str, kind: str, name: str, value: bytes) -> None:
        number = np.frombuffer(value, dtype=_TYPES[kind])[0].item() if kind in _TYPES and kind != "char" else None
        if letter == "I" and len(self._information) < MOST_TEXTS:
            self._information[name] = value.decode("utf-8", "replace") if number is None else number
        parameters = self._parameters if letter == "P" else self._defaults
        if letter != "I" and number is not None and (name in parameters or len(parameters) < MOST_TEXTS):
            parameters[name] = float(number)

    def _note(self, text: str) -> None:
        if len(self._notes) < 50 and text not in self._notes:
            self._notes.append(text)

    def _count_by_name(self) -> None:
        """Move the counts of data messages by number to those by name."""
        for number in np.flatnonzero(self._tables.counts).tolist():
            known = self._subscriptions.get(number, [])
            if not known:
                self._note(f"{self._tables.counts[number]} messages of the number {number}: their subscription is lost")
            name = known[-1].name if known else f"data of number {number}"
            self._named_counts[name] = self._named_counts.get(name, 0) + int(self._tables.counts[number])
        self._tables.counts[:] = 0

    def result(self) -> UlogContent:
        """Return all that was found."""
        self._count_by_name()
        named = dict(sorted(self._named_counts.items()))
        for letter, word in _WORDS.items():
            if self.type_count(letter):
                named[word] = self.type_count(letter)
        damage = self._tally.result()
        if not self._tables.type_counts[kernels.HEADER_TYPE]:
            self._note("the header of the file is damaged: read without it")
        for name, count in self._undecoded.items():
            self._note(f"{count} messages of {name} have another size than its format: not decoded")
        if self._state[kernels.DROPOUTS]:
            total, most = self._state[kernels.DROPOUT_MS], self._state[kernels.DROPOUT_MOST_MS]
            self._note(f"{self._state[kernels.DROPOUTS]} dropouts of the logger: {total} ms, the longest {most} ms")
        return UlogContent(
            topics=tuple(self._joined()),
            message_counts=named,
            information=self._information,
            parameters=self._defaults | self._parameters,
            texts=tuple(self._texts),
            damage=damage,
            notes=tuple(self._notes),
        )

    def _joined(self) -> Iterator[Topic]:
        """Yield the topics; the parts of each are let go as soon as they are joined."""
        filled = [one for one in self._topics if one.chunks]
        for name, instance in sorted({(one.name, one.instance) for one in filled}):
            parts = list[Rows]()
            for section in sorted({one.section for one in filled}):
                key = (name, instance, section)
                same = [one for one in filled if (one.name, one.instance, one.section) == key]
                if len(same) > 1:
                    self._note(f"{name} is logged under two numbers: the one with more messages is read")
                if same:
                    parts += max(same, key=lambda one: sum(map(len, one.chunks))).chunks
                for one in same:
                    one.chunks = []
            if parts:
                yield Topic(name=name, instance=instance, rows=_concatenated(parts))


def _concatenated(parts: list[Rows]) -> Rows:
    """Return parts as one table of the fields of the first of them; those of another format are left out."""
    return np.concatenate([part for part in parts if part.dtype == parts[0].dtype])


def _empty_tables() -> kernels.Tables:
    """Return the tables of a log of which nothing is known yet."""
    names = np.zeros((len(_TYPES), 9), dtype=np.uint8)
    for row, name in enumerate(_TYPES):
        names[row, : len(name)] = list(name.encode())
    return kernels.Tables(
        least=np.zeros(65536, dtype=np.int32),
        most=np.full(65536, -1, dtype=np.int32),
        learned=np.zeros(65536, dtype=np.int32),
        counts=np.zeros(65536, dtype=np.int64),
        known_sizes=np.zeros(65536, dtype=np.bool_),
        subscribed=np.zeros(65536, dtype=np.bool_),
        wanted=np.zeros(65536, dtype=np.bool_),
        type_counts=np.zeros(256, dtype=np.int64),
        type_names=names,
        type_sizes=np.array([np.dtype(kind).itemsize for kind in _TYPES.values()], dtype=np.int64),
    )


def _format_of(body: bytes) -> _Format | None:
    """Return a format read from its text; None where it is none (a damaged one)."""
    name, _, text = body.decode("ascii").partition(":")
    fields = []
    for part in text.removesuffix(";").split(";"):
        match = _FIELD.fullmatch(part)
        if match is None:
            return None
        fields.append((match[1], int(match[2] or 1), match[3]))
    return _Format(name=name, fields=tuple(fields)) if name and name not in _TYPES else None


def _key_and_value(body: bytes) -> tuple[str, str, bytes]:
    """Return type, name and value of an information or a parameter."""
    end = 1 + body[0]
    kind, _, name = body[1:end].decode("ascii", "replace").partition(" ")
    return kind, name, body[end:]
