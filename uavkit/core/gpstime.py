"""GPS time in integer nanoseconds, and UTC at the border with the dated table of leap seconds."""

from datetime import UTC, datetime, timedelta

import numpy as np

from uavkit.core.arrays import Indices

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
WEEK_NS = 7 * 86_400 * 1_000_000_000
NO_TIME = int(np.iinfo(np.int64).min)
"""Marks an unknown time in a table's column of nanoseconds."""
UNIX_EPOCH_NS = 315_964_800 * 1_000_000_000
"""1980-01-06 in Unix time."""

_LEAP_DATES = (
    "1981-07-01 1982-07-01 1983-07-01 1985-07-01 1988-01-01 1990-01-01 1991-01-01 1992-07-01 1993-07-01 "
    "1994-07-01 1996-01-01 1997-07-01 1999-01-01 2006-01-01 2009-01-01 2012-07-01 2015-07-01 2017-01-01"
)
LEAP_SECOND_DATES = tuple(datetime.fromisoformat(f"{day}T00:00:00+00:00") for day in _LEAP_DATES.split())
"""Instants (UTC) since which one more second is counted in UTC than in GPS time; IERS Bulletin C, last change 2017."""


def leap_seconds(utc: datetime) -> int:
    """Return GPS time minus UTC in whole seconds at an instant in UTC (18 since 2017-01-01)."""
    return sum(utc >= date for date in LEAP_SECOND_DATES)


def gps_time_ns_from_utc(utc: datetime) -> int:
    """Return the GPS time of an aware datetime; raises ValueError for a naive one or one before 1980-01-06."""
    if utc.tzinfo is None:
        raise ValueError(f"{utc} has no time zone: UTC must be told from local time")
    span = utc - GPS_EPOCH
    if span < timedelta(0):
        raise ValueError(f"{utc} lies before the GPS epoch 1980-01-06")
    microseconds = (span.days * 86_400 + span.seconds + leap_seconds(utc)) * 1_000_000 + span.microseconds
    return microseconds * 1000


def utc_from_gps_time_ns(gps_time_ns: int) -> datetime:
    """Return UTC, rounded down to microseconds; inside a leap second (23:59:60) the following second is returned."""
    atomic = GPS_EPOCH + timedelta(microseconds=gps_time_ns // 1000)
    ahead = sum(atomic >= date + timedelta(seconds=count) for count, date in enumerate(LEAP_SECOND_DATES, start=1))
    return atomic - timedelta(seconds=ahead)


def gps_time_ns_from_week(week: int, time_of_week_ns: int) -> int:
    """Return the GPS time of a full week number (not modulo 1024) and a time of week in nanoseconds."""
    return week * WEEK_NS + time_of_week_ns


_LEAP_GPS_NS = np.array([gps_time_ns_from_utc(date) for date in LEAP_SECOND_DATES], dtype=np.int64)
"""GPS time of the first instant after each leap second."""


def gps_times_ns_from_unix_ns(unix_ns: Indices) -> Indices:
    """Return GPS times of Unix times (UTC without leap seconds), both integer ns of any shape; NO_TIME stays."""
    unix = np.asarray(unix_ns, dtype=np.int64)
    unknown = unix == NO_TIME
    since = np.where(unknown, 0, unix) - UNIX_EPOCH_NS
    dates = _LEAP_GPS_NS - np.arange(1, len(_LEAP_GPS_NS) + 1) * 1_000_000_000
    leap = np.searchsorted(dates, since, side="right") * 1_000_000_000
    return np.where(unknown, NO_TIME, since + leap)


def leap_seconds_at(gps_time_ns: int) -> int:
    """Return GPS time minus UTC in whole seconds at an instant in GPS time."""
    return int(np.searchsorted(_LEAP_GPS_NS, gps_time_ns, side="right"))
