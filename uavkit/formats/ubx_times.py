"""GPS times of u-blox epochs: time of week, with the week of SOL or TIMEGPS or of the UTC date."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Indices
from uavkit.core.flight_log import FixType
from uavkit.core.gpstime import NO_TIME, WEEK_NS
from uavkit.formats.receiver_times import (
    EARLIEST_NS,
    EARLIEST_PVT_NS,
    LAST_WEEK,
    SECOND_NS,
    dated_leap_seconds,
    dates,
    gps_from_utc_fields,
    roll_over_note,
    unrolled,
)
from uavkit.formats.ubx_epochs import Epochs, Messages, column

NO_COUNT = -1
"""Marks an unknown count of leap seconds."""
_MS_NS = 1_000_000
_ROUNDED_NS = 10 * _MS_NS
"""UTC's fields are rounded, to 1/100 s at most, and ``nano`` corrects them: its sign does not change the second."""
_FARTHEST_LEAP_S = 30
"""UTC that is farther than this from the time of week is not of a wrong count of leap seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpochTimes:
    """GPS times of epochs and what they were found from."""

    gps_ns: Indices
    """(m,); NO_TIME where the receiver does not know it."""
    leap_counts: Indices
    """(m,) leap seconds by which the receiver's UTC is behind its GPS time; NO_COUNT where it does not tell."""
    earliest_ns: int
    leap_count: int | None
    """The count that the receiver trusts, for ``unrolled``."""
    notes: tuple[str, ...]


def epoch_times(messages: Mapping[str, Messages], epochs: Epochs, fixes: NDArray[np.uint8]) -> EpochTimes:
    """Return the GPS times of epochs: time of week, with the week as SOL or TIMEGPS tells it, or of the UTC date.

    UTC only finds the week (and the fraction of a millisecond), so that a wrong count of leap seconds does no harm.
    Epochs that say nothing of the week take it from the nearest that does; those that say that they do not know have
    no time.
    """
    tow_ns = epochs.iTOW_ms * _MS_NS
    by_week, denied = _times_by_week(messages, epochs)
    utc, resolved, utc_denied = _times_by_utc(messages, epochs, fixes)
    by_utc, leap_counts = _with_week_of(utc, tow_ns)
    leap_counts = np.where(resolved, leap_counts, NO_COUNT)
    gps_ns = np.where(by_week != NO_TIME, by_week, by_utc)
    gps_ns = _with_nearest_week(gps_ns, tow_ns, denied | utc_denied)
    told, told_valid = _told_counts(messages)
    resolved_counts = np.concatenate([leap_counts[resolved & (leap_counts > 0)], told[told_valid]])
    trusted = int(np.bincount(resolved_counts).argmax()) if len(resolved_counts) else None
    earliest_ns = EARLIEST_PVT_NS if "NAV-PVT" in messages else EARLIEST_NS
    moved_ns, moved = unrolled(gps_ns, earliest_ns, trusted)
    notes = (roll_over_note(moved, "epochs"),) if moved else ()
    return EpochTimes(
        gps_ns=moved_ns,
        leap_counts=leap_counts,
        earliest_ns=earliest_ns,
        leap_count=trusted,
        notes=notes + _leap_notes(moved_ns, leap_counts, told),
    )


def _times_by_week(messages: Mapping[str, Messages], epochs: Epochs) -> tuple[Indices, NDArray[np.bool_]]:
    """Return times of SOL's or TIMEGPS's week, NO_TIME without, and where the receiver says it does not know, (m,)."""
    m = len(epochs.iTOW_ms)
    result, denied = np.full(m, NO_TIME, dtype=np.int64), np.zeros(m, dtype=np.bool_)
    for kind, flag_name, needed in (("NAV-TIMEGPS", "valid", 3), ("NAV-SOL", "flags", 12)):
        flags, there = column(messages, epochs, kind, flag_name)
        week, _ = column(messages, epochs, kind, "week")
        rest_ns, _ = column(messages, epochs, kind, "fTOW")
        good = there & (flags & needed == needed) & (week > 0) & (week <= LAST_WEEK)
        result = np.where(good, week * WEEK_NS + epochs.iTOW_ms * _MS_NS + rest_ns, result)
        denied |= there & ~good
    return result, denied & (result == NO_TIME)


def _times_by_utc(
    messages: Mapping[str, Messages], epochs: Epochs, fixes: NDArray[np.uint8]
) -> tuple[Indices, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return GPS times of the UTC dates of TIMEUTC and PVT by the dated table, NO_TIME without, (m,).

    And where the receiver knows its leap seconds, and where it says that it does not know the time. A date that is not
    resolved to the second counts only with a fix: before one it is that of the receiver's own clock.
    """
    m = len(epochs.iTOW_ms)
    result, resolved = np.full(m, NO_TIME, dtype=np.int64), np.zeros(m, dtype=np.bool_)
    denied = np.zeros(m, dtype=np.bool_)
    fixed = (fixes >= FixType.TWO_DIMENSIONAL) & (fixes != FixType.UNKNOWN)
    for kind in ("NAV-TIMEUTC", "NAV-PVT"):
        valid, there = column(messages, epochs, kind, "valid")
        fields = ("year", "month", "day", "hour", "min", "sec", "nano")
        year, month, day, hour, minute, second, nano = (
            column(messages, epochs, kind, name)[0] for name in fields
        )  # fmt: skip
        gps_ns = gps_from_utc_fields(dates(year, month, day), hour * 3600 + minute * 60 + second, nano)
        good = there & (valid & 3 == 3) & ((valid & 4 > 0) | fixed) & (gps_ns != NO_TIME)
        good &= (hour < 24) & (minute < 60) & (second < 61)
        result, denied = np.where(good, gps_ns, result), denied | (there & ~good)
        resolved = np.where(good, valid & 4 > 0, resolved)
    return result, resolved, denied & (result == NO_TIME)


def _with_week_of(utc_gps_ns: Indices, tow_ns: Indices) -> tuple[Indices, Indices]:
    """Return times of week with the week nearest to a time from UTC, and the receiver's count of leap seconds, (m,).

    A time of week that is not even near to UTC is not valid: UTC itself counts then.
    """
    known = utc_gps_ns != NO_TIME
    utc = np.where(known, utc_gps_ns, 0)
    base = np.rint((utc - tow_ns) / WEEK_NS).astype(np.int64) * WEEK_NS + tow_ns
    seconds = np.rint((utc - base) / SECOND_NS).astype(np.int64)
    rest = utc - base - seconds * SECOND_NS
    near = known & (np.abs(seconds) <= _FARTHEST_LEAP_S)
    gps_ns = np.where(near, base + np.where(np.abs(rest) <= _MS_NS, rest, 0), np.where(known, utc, NO_TIME))
    used = dated_leap_seconds(utc + _ROUNDED_NS)
    return gps_ns, np.where(near, used - seconds, NO_COUNT)


def _with_nearest_week(gps_ns: Indices, tow_ns: Indices, denied: NDArray[np.bool_]) -> Indices:
    """Return times with those of silent epochs filled in: their time of week in the week of the nearest known epoch."""
    known = np.flatnonzero(gps_ns != NO_TIME)
    silent = np.flatnonzero((gps_ns == NO_TIME) & ~denied)
    if len(known) == 0 or len(silent) == 0:
        return gps_ns
    after = np.minimum(np.searchsorted(known, silent), len(known) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(known[after] - silent) < np.abs(silent - known[before]), known[after], known[before])
    result = gps_ns.copy()
    weeks = np.rint((gps_ns[nearest] - tow_ns[silent]) / WEEK_NS).astype(np.int64)
    result[silent] = weeks * WEEK_NS + tow_ns[silent]
    return result


def _told_counts(messages: Mapping[str, Messages]) -> tuple[Indices, NDArray[np.bool_]]:
    """Return the leap seconds that TIMELS and TIMEGPS tell, and which of them the receiver has from satellites."""
    counts, valid = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.bool_)]
    if "NAV-TIMELS" in messages:
        rows = messages["NAV-TIMELS"].rows
        counts.append(rows["currLs"].astype(np.int64))
        valid.append((rows["valid"] & 1 > 0) & (rows["srcOfCurrLs"] != 0) & (rows["srcOfCurrLs"] != 255))
    if "NAV-TIMEGPS" in messages:
        rows = messages["NAV-TIMEGPS"].rows
        counts.append(rows["leapS"].astype(np.int64))
        valid.append(rows["valid"] & 4 > 0)
    told = np.concatenate(counts)
    return told, np.concatenate(valid) & (told > 0)


def _leap_notes(gps_ns: Indices, counts: Indices, told: Indices) -> tuple[str, ...]:
    """Return what is to be said of counts of leap seconds that differ from the dated table's."""
    known = gps_ns != NO_TIME
    dated = dated_leap_seconds(np.where(known, gps_ns, 0))
    notes = []
    wrong = known & (counts != NO_COUNT) & (counts != dated)
    for count in np.unique(counts[wrong]).tolist():
        rows = int(np.sum(wrong & (counts == count)))
        notes.append(
            f"the receiver's UTC is of {count} leap seconds in {rows} of {len(counts)} epochs, the dated table has "
            f"{_range(dated[wrong & (counts == count)])}: times are from the time of week"
        )
    usual = set(np.unique(dated[known]).tolist())
    odd = sorted(set(told.tolist()) - usual) if usual else []
    if odd:
        text = ", ".join(str(count) for count in odd)
        notes.append(
            f"the receiver tells {text} leap seconds (without an almanac it guesses), the dated table has "
            f"{_range(dated[known])}: the table's are used"
        )
    return tuple(notes)


def _range(values: Indices) -> str:
    low, high = int(values.min()), int(values.max())
    return str(low) if low == high else f"{low} to {high}"
