"""Times as GNSS receivers tell them: UTC dates, weeks that have rolled over, leap seconds of an old almanac."""

from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Indices
from uavkit.core.gpstime import (
    LEAP_SECOND_DATES,
    NO_TIME,
    WEEK_NS,
    gps_time_ns_from_utc,
    gps_times_ns_from_unix_ns,
)

SECOND_NS = 1_000_000_000
DAY_NS = 86_400 * SECOND_NS
ROLL_OVER_NS = 1024 * WEEK_NS
"""GPS satellites tell the week modulo 1024; firmware that is too old for the flight gives dates 1024 weeks early."""
LAST_WEEK = 10_000
"""Of the year 2171: a week beyond is none (and has no place in 64 bits of nanoseconds)."""
EARLIEST_NS = gps_time_ns_from_utc(datetime(2005, 1, 1, tzinfo=UTC))
"""No camera drone's log is older: a date before it has rolled over (or is the receiver's own before a fix)."""
EARLIEST_PVT_NS = gps_time_ns_from_utc(datetime(2012, 1, 1, tzinfo=UTC))
"""NAV-PVT came with u-blox 7."""
_LEAP_NS = np.array([gps_time_ns_from_utc(date) for date in LEAP_SECOND_DATES], dtype=np.int64)
_ANNOUNCED_NS = 183 * DAY_NS
"""A leap second is announced half a year ahead: a count higher than that of half a year later is of another era."""


def dated_leap_seconds(gps_ns: Indices) -> Indices:
    """Return GPS time minus UTC in whole seconds, (n,), by the dated table."""
    return np.searchsorted(_LEAP_NS, gps_ns, side="right").astype(np.int64)


def gps_from_utc_fields(date: "NDArray[np.datetime64]", second_of_day: Indices, nano: Indices) -> Indices:
    """Return GPS times of UTC days (datetime64[D]), seconds of the day (86400 in a leap second) and ns, (n,) each.

    NO_TIME for NaT.
    """
    known = ~np.isnat(date)
    day = np.where(known, date.astype("datetime64[D]").astype(np.int64), 0)
    leap_second = second_of_day >= 86_400
    unix_ns = day * DAY_NS + (second_of_day - leap_second) * SECOND_NS
    gps_ns = gps_times_ns_from_unix_ns(unix_ns) + leap_second * SECOND_NS + nano
    return np.where(known & (gps_ns >= 0), gps_ns, NO_TIME)


def dates(year: Indices, month: Indices, day: Indices) -> "NDArray[np.datetime64]":
    """Return days, (n,) datetime64[D]; NaT where there is no such day or it is before the GPS epoch's year."""
    good = (year >= 1980) & (year <= 2099) & (month >= 1) & (month <= 12) & (day >= 1) & (day <= 31)
    months = np.where(good, (year - 1970) * 12 + month - 1, 0).astype("datetime64[M]")
    result = months.astype("datetime64[D]") + (np.where(good, day, 1) - 1).astype("timedelta64[D]")
    good &= result.astype("datetime64[M]") == months
    return np.where(good, result, np.datetime64("NaT"))


def unrolled(gps_ns: Indices, earliest_ns: int, leap_count: int | None = None) -> tuple[Indices, int]:
    """Return times with lost roll-overs of the week made good, (n,), and how many were; NO_TIME stays.

    Evidence is a time before ``earliest_ns``, or a receiver that counts leap seconds not yet known at the time it
    tells, but right 1024 weeks later.
    """
    known = gps_ns != NO_TIME
    result = np.asarray(gps_ns, dtype=np.int64).copy()
    for _ in range(2):
        result[known & (result < earliest_ns)] += ROLL_OVER_NS
    if leap_count is not None:
        at = np.where(known, result, 0)
        early = known & (dated_leap_seconds(at + _ANNOUNCED_NS) < leap_count)
        early &= dated_leap_seconds(at + ROLL_OVER_NS) == leap_count
        result[early] += ROLL_OVER_NS
    return result, int(np.sum(result != gps_ns))


def roll_over_note(count: int, of: str) -> str:
    """Return the sentence that tells of dates that were put right."""
    return f"{count} {of} had a date 1024 weeks too early (roll-over of the GPS week in old firmware): put right"
