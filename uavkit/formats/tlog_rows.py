"""The wanted messages of a MAVLink log as tables of raw fields, and how they are got out of the file."""

from collections.abc import Mapping
from dataclasses import dataclass
from os import SEEK_END
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Flags, Indices
from uavkit.core.flight_log import Damage
from uavkit.core.gpstime import NO_TIME
from uavkit.core.progress import Progress
from uavkit.formats.kernels.mavlink_frames import (
    BAD_CHECKSUM,
    BAD_STAMP,
    COLUMNS,
    COUNTED,
    CUT_SHORT,
    LISTED,
    MARGIN_BYTES,
    NOT_A_MESSAGE,
    SHORTEST_FRAME,
    STAMP_BYTES,
    UNDEFINED,
    gather_payloads,
    scan_frames,
)
from uavkit.formats.log_bytes import Blocks, DamageTally, opened
from uavkit.formats.mavlink_messages import FIELDS, dialect, payload_type, record_type

_BLOCK_BYTES = 256 * 1024
_HEAD_BYTES = 256 * 1024
"""Looked at to see whether stamps stand before the frames."""
_WHY = {
    NOT_A_MESSAGE: "no MAVLink message",
    BAD_CHECKSUM: "checksum wrong",
    CUT_SHORT: "message cut short",
    BAD_STAMP: "time stamp damaged, message intact",
}
_JUMP_NS = 3_600_000_000_000
_DOUBLE_NS = 1_000_000_000
_DOUBLE_BYTES = 262_144
"""So close in the file two copies of a message must be."""
_FACTOR = np.uint64(0x9E3779B97F4A7C15)
_SHIFT = np.uint64(29)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rows:
    """Messages of one kind; n of them, in the order of the file."""

    fields: NDArray[np.void]
    """(n,) ``record_type`` of the kind."""
    host_ns: Indices
    """(n,) Unix time of reception; NO_TIME where no stamp stood before the message."""
    offset: Indices
    """(n,) of the frame in the file."""
    system: NDArray[np.uint8]
    """(n,)."""
    component: NDArray[np.uint8]
    """(n,)."""

    def __len__(self) -> int:
        return len(self.fields)

    def where(self, rows: "Flags | Indices") -> "Rows":
        """Return the rows that a mask or indexes choose; these themselves where a mask chooses all."""
        if rows.dtype == np.bool_ and rows.all():
            return self
        return Rows(
            fields=self.fields[rows],
            host_ns=self.host_ns[rows],
            offset=self.offset[rows],
            system=self.system[rows],
            component=self.component[rows],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class RawLog:
    """What a scan of a log finds."""

    rows: Mapping[int, Rows]
    """By the number of the message; every one of ``FIELDS``."""
    message_counts: Mapping[str, int]
    system_counts: Mapping[int, int]
    """Messages by the number of the vehicle or ground station that sent them."""
    damage: Damage
    stamped: bool
    """Whether time stamps of the receiving computer stand before the frames."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """What a scan of one block finds; ``rows`` (k, 8), see ``scan_frames``."""

    rows: Indices
    lost: Indices
    decided: int
    synchronised: int


class _Scan:
    """Counts and work space of a scan over blocks."""

    def __init__(self, stamp_bytes: int, listed: Indices) -> None:
        known = dialect()
        self._known, self._stamp_bytes = known, stamp_bytes
        self.extra = known.crc_extra.copy()
        """(ids,) the checksum bytes; those of messages that no dialect defines are learned on the way."""
        self._use = np.where(known.crc_extra < 0, UNDEFINED, COUNTED).astype(np.uint8)
        self._use[listed] = LISTED
        self._rows, self._lost = np.empty((0, COLUMNS), dtype=np.int64), np.empty((0, 3), dtype=np.int64)
        self._id_counts = np.zeros(len(self.extra), dtype=np.int64)
        self._great_counts = dict[int, int]()
        """Of messages with numbers beyond the tables."""
        self.system_counts = np.zeros(256, dtype=np.int64)

    def block(self, block: NDArray[np.uint8], final: bool, synchronised: int) -> _Found:
        """Scan a block; what is returned is overwritten by the next one."""
        most = len(block) // SHORTEST_FRAME + 2
        if len(self._rows) < most:
            self._rows = np.empty((most, COLUMNS), dtype=np.int64)
            self._lost = np.empty((most, 3), dtype=np.int64)
        decided, synchronised, rows, lost = scan_frames(
            block, int(final), synchronised, self._stamp_bytes, self.extra, self._known.longest, self._use,
            self._rows, self._id_counts, self.system_counts, self._lost,
        )  # fmt: skip
        found = self._rows[:rows]
        great = found[found[:, 0] >= len(self.extra), 0]
        for number, count in zip(*np.unique(great, return_counts=True), strict=True):
            self._great_counts[int(number)] = self._great_counts.get(int(number), 0) + int(count)
        return _Found(rows=found, lost=self._lost[:lost], decided=decided, synchronised=synchronised)

    def message_counts(self) -> dict[str, int]:
        """Return the intact messages by name."""
        counts = {int(number): int(self._id_counts[number]) for number in np.flatnonzero(self._id_counts)}
        return {self._known.name(number): count for number, count in sorted((counts | self._great_counts).items())}


def frames_in(head: bytes) -> Indices:
    """Return the known messages among the first bytes of a file, (k, 3): first byte, end, stamp (-1 without one)."""
    return _look(head, STAMP_BYTES)[0]


def _look(head: bytes, stamp_bytes: int) -> tuple[Indices, NDArray[np.int16]]:
    """Return ``frames_in``, and the checksum bytes (ids,), also of messages that no dialect defines."""
    scan = _Scan(stamp_bytes, np.flatnonzero(dialect().crc_extra >= 0))
    block = np.frombuffer(head, dtype=np.uint8).copy()  # as blocks are, so that the scan is compiled once
    rows = scan.block(block, len(block) <= 4 * MARGIN_BYTES, 1).rows
    known = rows[rows[:, 0] < len(scan.extra)]
    return np.asarray(known[:, [6, 7, 3]], dtype=np.int64), scan.extra


def scan_log(path: Path, progress: Progress) -> RawLog:
    """Read the messages of a file."""
    with opened(path) as stream:
        size = stream.seek(0, SEEK_END)
        stream.seek(0)
        head = stream.read(_HEAD_BYTES)
        stream.seek(0)
        frames = frames_in(head)
        stamped = 2 * int(np.sum(frames[:, 2] >= 0)) >= len(frames)
        stamp_bytes = STAMP_BYTES if stamped else 0
        scan = _Scan(stamp_bytes, np.array(list(FIELDS), dtype=np.int64))
        scan.extra[:] = _look(head, stamp_bytes)[1]
        tally, parts = DamageTally(), dict[int, list[Rows]]()
        blocks, decided, synchronised = Blocks(stream, _BLOCK_BYTES), 0, 1
        while (block := blocks.next(decided)) is not None:
            found = scan.block(block, blocks.final, synchronised)
            decided, synchronised = found.decided, found.synchronised
            for begin, end, why in found.lost.tolist():
                tally.add(blocks.offset + begin, end - begin, _WHY[why])
            _gather(block, blocks.offset, found.rows, parts)
            progress("reading the log", min(blocks.offset + decided, size), size)
    return RawLog(
        rows={number: _joined(parts.pop(number, []), number) for number in FIELDS},
        message_counts=scan.message_counts(),
        system_counts={int(system): int(scan.system_counts[system]) for system in np.flatnonzero(scan.system_counts)},
        damage=tally.result(),
        stamped=stamped,
    )


def _gather(block: NDArray[np.uint8], offset: int, found: Indices, parts: dict[int, list[Rows]]) -> None:
    """Append the wanted messages of a block to the parts of their kinds."""
    for number in FIELDS:
        of_kind = found[found[:, 0] == number]
        if len(of_kind) == 0:
            continue
        kind = payload_type(number)
        payloads = np.zeros((len(of_kind), kind.itemsize), dtype=np.uint8)
        gather_payloads(block, of_kind[:, 1], of_kind[:, 2], payloads)
        stamp = of_kind[:, 3]
        rows = Rows(
            fields=payloads.view(kind)[:, 0].astype(record_type(number)),
            host_ns=np.where(stamp < 0, NO_TIME, stamp * 1000),
            offset=of_kind[:, 6] + offset,
            system=of_kind[:, 4].astype(np.uint8),
            component=of_kind[:, 5].astype(np.uint8),
        )
        parts.setdefault(number, []).append(rows)


def _joined(parts: list[Rows], number: int) -> Rows:
    if not parts:
        none = np.zeros(0, dtype=np.int64)
        no_number = np.zeros(0, dtype=np.uint8)
        fields = np.zeros(0, dtype=record_type(number))
        return Rows(fields=fields, host_ns=none, offset=none, system=no_number, component=no_number)
    return Rows(
        fields=np.concatenate([part.fields for part in parts]),
        host_ns=np.concatenate([part.host_ns for part in parts]),
        offset=np.concatenate([part.offset for part in parts]),
        system=np.concatenate([part.system for part in parts]),
        component=np.concatenate([part.component for part in parts]),
    )


def without_stray_stamps(rows: Rows) -> Rows:
    """Return the rows with NO_TIME for single stamps more than an hour away from those before and behind."""
    if len(rows) < 3:
        return rows
    host = rows.host_ns
    known = host != NO_TIME
    before, here, after = host[:-2], host[1:-1], host[2:]
    all_known = known[:-2] & known[1:-1] & known[2:]
    far = (_apart(here, before, all_known) > _JUMP_NS) & (_apart(here, after, all_known) > _JUMP_NS)
    stray = far & (_apart(before, after, all_known) < _JUMP_NS)
    if not stray.any():
        return rows
    cleaned = host.copy()
    cleaned[1:-1][stray] = NO_TIME
    return Rows(fields=rows.fields, host_ns=cleaned, offset=rows.offset, system=rows.system, component=rows.component)


def _apart(a: Indices, b: Indices, known: Flags) -> Indices:
    return np.where(known, np.abs(np.where(known, a, 0) - np.where(known, b, 0)), 0)


def host_jumps(rows: Rows) -> int:
    """Return how often the computer's clock was set while it recorded: back by a second, or ahead by an hour."""
    host = rows.host_ns[rows.host_ns != NO_TIME]
    step = np.diff(host)
    return int(np.sum((step < -1_000_000_000) | (step > _JUMP_NS)))


def first_copies(rows: Rows, anywhere: bool = False) -> Flags:
    """Return a mask (n,) without the rows that repeat another's payload and sender.

    ``anywhere``: however far apart; otherwise within a second and 256 KiB of the file. A link that is received twice,
    or a sender that repeats itself, brings such copies; payloads contain the time, so that equal ones are one.
    """
    n = len(rows)
    key = _keys(rows)
    order = np.lexsort((rows.offset, key))
    same = key[order][1:] == key[order][:-1]
    host, offset = rows.host_ns[order], rows.offset[order]
    both = (host[1:] != NO_TIME) & (host[:-1] != NO_TIME)
    near = (_apart(host[1:], host[:-1], both) < _DOUBLE_NS) & (np.diff(offset) < _DOUBLE_BYTES)
    first = np.ones(n, dtype=np.bool_)
    first[order[1:][same & (near | anywhere)]] = False
    return first


def _keys(rows: Rows) -> NDArray[np.uint64]:
    """Return a hash (n,) of payload and sender."""
    size = rows.fields.dtype.itemsize
    padded = np.zeros((len(rows), 8 * -(-size // 8)), dtype=np.uint8)
    padded[:, :size] = np.ascontiguousarray(rows.fields).view(np.uint8).reshape(len(rows), size)
    key = rows.system.astype(np.uint64) << np.uint64(8) | rows.component.astype(np.uint64)
    for word in padded.view(np.uint64).T:
        key = (key ^ word) * _FACTOR
        key ^= key >> _SHIFT
    return key
