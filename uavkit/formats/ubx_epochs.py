"""The navigation epochs of a u-blox receiver: the messages of one time of week joined.

Old receivers (u-blox 5 and 6) tell POSLLH, SOL, VELNED and TIMEUTC of one time of week (iTOW), newer ones PVT and
HPPOSLLH.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Indices
from uavkit.core.flight_log import FixType

JOINED = ("NAV-POSLLH", "NAV-STATUS", "NAV-SOL", "NAV-PVT", "NAV-VELNED", "NAV-HPPOSLLH", "NAV-TIMEGPS", "NAV-TIMEUTC")


@dataclass(frozen=True, slots=True, kw_only=True)
class Messages:
    """The decoded messages of one kind in the order of the stream."""

    rows: NDArray[np.void]
    """(n,) with the fields of ``uavkit.formats.ubx_messages``."""
    lengths: Indices
    """(n,) of the payloads."""
    offsets: Indices
    """(n,) of the frames in the stream."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Epochs:
    """The navigation epochs of a stream, m of them; which message of each kind belongs to each."""

    iTOW_ms: Indices
    """(m,)."""
    offsets: Indices
    """(m,) of the first message of each."""
    member: Mapping[str, Indices]
    """(m,) rows of the messages of a kind, -1 where the epoch has none."""


def joined_epochs(messages: Mapping[str, Messages]) -> Epochs:
    """Return the epochs: messages that follow one another with the same time of week.

    Of several messages of one kind in an epoch the last counts.
    """
    kinds = [kind for kind in JOINED if kind in messages]
    offset = np.concatenate([messages[kind].offsets for kind in kinds] or [np.zeros(0, dtype=np.int64)])
    tow = np.concatenate([messages[kind].rows["iTOW"].astype(np.int64) for kind in kinds] or [offset])
    order = np.argsort(offset, kind="stable")
    first = np.diff(tow[order], prepend=-1) != 0
    epoch = np.empty(len(offset), dtype=np.int64)
    epoch[order] = np.cumsum(first) - 1
    member, begin = {}, 0
    for kind in kinds:
        count = len(messages[kind].offsets)
        member[kind] = np.full(int(np.sum(first)), -1, dtype=np.int64)
        member[kind][epoch[begin : begin + count]] = np.arange(count)
        begin += count
    return Epochs(iTOW_ms=tow[order][first], offsets=offset[order][first], member=member)


def column(messages: Mapping[str, Messages], epochs: Epochs, kind: str, name: str) -> tuple[Indices, NDArray[np.bool_]]:
    """Return a field for each epoch, (m,) int64, and where the epoch has such a message."""
    member = epochs.member.get(kind)
    if member is None:
        m = len(epochs.iTOW_ms)
        return np.zeros(m, dtype=np.int64), np.zeros(m, dtype=np.bool_)
    there = member >= 0
    values = messages[kind].rows[name].astype(np.int64)[np.maximum(member, 0)]
    return np.where(there, values, 0), there


def fix_types(messages: Mapping[str, Messages], epochs: Epochs) -> NDArray[np.uint8]:
    """Return how each position came about, (m,) FixType: as PVT says, or SOL, or STATUS.

    Dead reckoning without satellites and time-only fixes are no fix; nor is one outside the receiver's own limits
    (gnssFixOK not set).
    """
    result = np.full(len(epochs.iTOW_ms), FixType.UNKNOWN, dtype=np.uint8)
    for kind, fix_name, carrier_name in (
        ("NAV-STATUS", "gpsFix", "flags2"),
        ("NAV-SOL", "gpsFix", ""),
        ("NAV-PVT", "fixType", "flags"),
    ):
        fix, there = column(messages, epochs, kind, fix_name)
        flags, _ = column(messages, epochs, kind, "flags")
        carrier = column(messages, epochs, kind, carrier_name)[0] >> 6 if carrier_name else np.zeros_like(fix)
        of_fix = np.array([1, 1, FixType.TWO_DIMENSIONAL, FixType.THREE_DIMENSIONAL, FixType.THREE_DIMENSIONAL, 1])
        found = of_fix[np.minimum(fix, 5)]
        found = np.where((found == FixType.THREE_DIMENSIONAL) & (flags & 2 > 0), FixType.DIFFERENTIAL, found)
        fixed = found >= FixType.TWO_DIMENSIONAL
        found = np.where(fixed & (carrier == 1), FixType.RTK_FLOAT, found)
        found = np.where(fixed & (carrier == 2), FixType.RTK_FIXED, found)
        found = np.where(flags & 1 > 0, found, FixType.NO_FIX)
        result = np.where(there, found, result).astype(np.uint8)
    return result
