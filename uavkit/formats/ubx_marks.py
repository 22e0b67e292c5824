"""Exposures that a u-blox receiver timed at its interrupt pin (TIM-TM2)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Indices
from uavkit.core.flight_log import ExposureKind, ExposureTable, Stamps, exposure_table, no_exposures
from uavkit.core.gpstime import NO_TIME, WEEK_NS
from uavkit.formats.receiver_times import LAST_WEEK, SECOND_NS, dated_leap_seconds, roll_over_note, unrolled
from uavkit.formats.ubx_epochs import Epochs, Messages
from uavkit.formats.ubx_times import NO_COUNT, EpochTimes

RISING, FALLING = "R", "F"
_NEW_FALLING, _UTC_KNOWN, _TIME_VALID, _NEW_RISING = 4, 32, 64, 128
_RECEIVER_TIME, _UTC_TIME = 0, 2
_RECEIVER_CLOCK_SIGMA_S = 1e-3 / np.sqrt(12.0)
"""Receiver time is kept to the nearest tick of 1 ms of GPS time: off by up to half of it."""
_MOST_MISSED = 1000
"""A count that is farther ahead is of a receiver that was started again."""
_FAR_NS = 60 * SECOND_NS


@dataclass(frozen=True, slots=True, kw_only=True)
class _Marks:
    """The marks of one log, n of them."""

    rows: NDArray[np.void]
    offsets: Indices
    edge: str
    missed: int


def ubx_marks(messages: Messages, epochs: Epochs, times: EpochTimes) -> tuple[ExposureTable, tuple[str, ...]]:
    """Return an exposure for each step of the receiver's count of edges, and what is to be said of them.

    Rising edges count; falling ones where the log has no rising one. An edge whose own message is lost is taken from
    the next one that still tells its time. Between two epochs the receiver tells the last edge only: steps of the
    count by more than one are missed marks. Times in UTC become GPS times by the leap seconds of the receiver.
    """
    marks = _chosen(messages)
    if len(marks.rows) == 0:
        return no_exposures(), _no_edges(messages)
    gps_ns, moved = _times(marks, epochs, times)
    rows = marks.rows
    sigma_s = rows["accEst"].astype(np.float64) * 1e-9
    sigma_s = np.where((sigma_s > 0) & (rows["accEst"] < 2**32 - 1), sigma_s, np.nan)
    by_receiver = _base(rows) == _RECEIVER_TIME
    sigma_s = np.where(by_receiver, np.hypot(sigma_s, _RECEIVER_CLOCK_SIGMA_S), sigma_s)
    table = exposure_table(
        Stamps.of(len(rows), gps_ns=gps_ns),
        ExposureKind.MARK,
        sigma_s=np.asarray(sigma_s, dtype=np.float64),
        sequence=rows["count"].astype(np.int64),
    )
    return table, _notes(marks, gps_ns, moved, times)


def _no_edges(messages: Messages) -> tuple[str, ...]:
    return (f"none of {len(messages.rows)} TIM-TM2 messages tells a new edge",) if len(messages.rows) else ()


def _base(rows: NDArray[np.void]) -> Indices:
    return (rows["flags"].astype(np.int64) >> 3) & 3


def _chosen(messages: Messages) -> _Marks:
    """Return the messages that tell an edge not told before, each channel of the receiver by itself."""
    flags = messages.rows["flags"]
    edge = RISING if np.any(flags & _NEW_RISING) or not np.any(flags & _NEW_FALLING) else FALLING
    taken, missed = np.zeros(len(flags), dtype=np.bool_), 0
    for channel in np.unique(messages.rows["ch"]).tolist():
        rows = np.flatnonzero(messages.rows["ch"] == channel)
        new, lost = _new_edges(messages.rows[rows], edge)
        taken[rows[new]] = True
        missed += lost
    return _Marks(rows=messages.rows[taken], offsets=messages.offsets[taken], edge=edge, missed=missed)


def _new_edges(rows: NDArray[np.void], edge: str) -> tuple[NDArray[np.bool_], int]:
    """Return which messages of a channel, (n,), tell a new edge, and how many edges none of them tells."""
    time = _edge_ns(rows, edge)
    moved = np.append(True, np.diff(time) != 0)
    if edge == FALLING:
        return (rows["flags"] & _NEW_FALLING > 0) & moved, 0
    count = rows["count"].astype(np.int64)
    step = np.append(0, np.diff(count) % 65_536)
    flagged = (rows["flags"] & _NEW_RISING > 0) & (moved | (step != 0))
    new = flagged | ((step > 0) & (step <= _MOST_MISSED) & moved)
    return new, int(np.sum(np.where(new & (step <= _MOST_MISSED), np.maximum(step - 1, 0), 0)))


def _edge_ns(rows: NDArray[np.void], edge: str) -> Indices:
    """Return week and time of week of edges in the message's own time base, (n,) ns."""
    week, ms, rest = (rows[name + edge].astype(np.int64) for name in ("wn", "towMs", "towSubMs"))
    return week * WEEK_NS + ms * 1_000_000 + rest


def _times(marks: _Marks, epochs: Epochs, times: EpochTimes) -> tuple[Indices, int]:
    """Return GPS times of marks, (n,), NO_TIME where the receiver does not know, and how many had rolled over."""
    rows, base = marks.rows, _base(marks.rows)
    time = _edge_ns(rows, marks.edge)
    week = rows["wn" + marks.edge]
    valid = (rows["flags"] & _TIME_VALID > 0) & (week > 0) & (week <= LAST_WEEK)
    valid &= (base != _UTC_TIME) | (rows["flags"] & _UTC_KNOWN > 0)
    leap = _receiver_leaps(marks.offsets, time, epochs, times)
    gps_ns = np.where(valid, time + np.where(base == _UTC_TIME, leap * SECOND_NS, 0), NO_TIME)
    return unrolled(gps_ns, times.earliest_ns, times.leap_count)


def _receiver_leaps(offsets: Indices, time_ns: Indices, epochs: Epochs, times: EpochTimes) -> Indices:
    """Return the leap seconds in the receiver's UTC at marks, (n,): of the last epoch before that tells, or dated."""
    known = np.flatnonzero(times.leap_counts != NO_COUNT)
    dated = dated_leap_seconds(time_ns)
    dated = dated_leap_seconds(time_ns + dated * SECOND_NS)
    if len(known) == 0:
        return dated
    last = np.maximum(np.searchsorted(epochs.offsets[known], offsets) - 1, 0)
    return np.asarray(times.leap_counts[known[last]], dtype=np.int64)


def _notes(marks: _Marks, gps_ns: Indices, moved: int, times: EpochTimes) -> tuple[str, ...]:
    notes = []
    if marks.edge == FALLING:
        notes.append("time marks are of falling edges: the log has no rising one")
    if marks.missed:
        notes.append(f"{marks.missed} time marks are missing: the receiver counted edges that no message tells")
    channels = np.unique(marks.rows["ch"])
    if len(channels) > 1:
        notes.append(f"time marks are of {len(channels)} channels of the receiver")
    if np.any(_base(marks.rows) == _RECEIVER_TIME):
        notes.append("time marks are in receiver time, which is off GPS time by up to half a millisecond")
    unknown = int(np.sum(gps_ns == NO_TIME))
    if unknown:
        notes.append(f"{unknown} time marks have no valid time")
    if moved:
        notes.append(roll_over_note(moved, "time marks"))
    far = _far_from_epochs(gps_ns, times.gps_ns)
    if far:
        notes.append(
            f"{far} time marks are more than a minute from all positions: is their time base another system's?"
        )
    return tuple(notes)


def _far_from_epochs(gps_ns: Indices, epoch_ns: Indices) -> int:
    """Return how many marks lie more than a minute from every epoch; 0 where no epoch has a time."""
    epoch, mark = np.sort(epoch_ns[epoch_ns != NO_TIME]), gps_ns[gps_ns != NO_TIME]
    if len(epoch) == 0 or len(mark) == 0:
        return 0
    after = np.minimum(np.searchsorted(epoch, mark), len(epoch) - 1)
    before = np.maximum(after - 1, 0)
    nearest: Array = np.minimum(np.abs(epoch[after] - mark), np.abs(epoch[before] - mark))
    return int(np.sum(nearest > _FAR_NS))
