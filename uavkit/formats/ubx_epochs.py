"""Positions of a u-blox receiver: the messages of one navigation epoch joined, with the epoch's GPS time.

Old receivers (u-blox 5 and 6) tell POSLLH, SOL, VELNED and TIMEUTC of one time of week (iTOW), newer ones PVT and
HPPOSLLH; where both are in the stream there is one row for an epoch.

``hAcc`` is the radial accuracy in the plane (root of the sum of both axes' variances): ``sigma_horizontal_m``, for each
axis, is hAcc / sqrt(2). ``vAcc`` is ``sigma_vertical_m``. u-blox does not say of what probability they are.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Indices
from uavkit.core.flight_log import FixTable, FixType, Stamps, fix_table, no_fixes
from uavkit.core.gpstime import NO_TIME, WEEK_NS
from uavkit.formats.receiver_times import (
    EARLIEST_NS,
    EARLIEST_PVT_NS,
    SECOND_NS,
    dated_leap_seconds,
    dates,
    gps_from_utc_fields,
    roll_over_note,
    unrolled,
)

JOINED = ("NAV-POSLLH", "NAV-STATUS", "NAV-SOL", "NAV-PVT", "NAV-VELNED", "NAV-HPPOSLLH", "NAV-TIMEGPS", "NAV-TIMEUTC")
POSITIONED = ("NAV-HPPOSLLH", "NAV-PVT", "NAV-POSLLH")
"""The best first."""
NO_COUNT = -1
"""Marks an unknown count of leap seconds."""
_MS_NS = 1_000_000
_ROUNDED_NS = 10 * _MS_NS
"""UTC's fields are rounded, to 1/100 s at most, and ``nano`` corrects them: its sign does not change the second."""
_FARTHEST_LEAP_S = 30
"""UTC that is farther than this from the time of week is not of a wrong count of leap seconds."""
_LEAST_UNKNOWN_MM = 4_000_000_000
"""Receivers without a fix tell accuracies of 2^32 - 1 mm or about 4295 km."""


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


def _column(
    messages: Mapping[str, Messages], epochs: Epochs, kind: str, name: str
) -> tuple[Indices, NDArray[np.bool_]]:
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
        fix, there = _column(messages, epochs, kind, fix_name)
        flags, _ = _column(messages, epochs, kind, "flags")
        carrier = _column(messages, epochs, kind, carrier_name)[0] >> 6 if carrier_name else np.zeros_like(fix)
        of_fix = np.array([1, 1, FixType.TWO_DIMENSIONAL, FixType.THREE_DIMENSIONAL, FixType.THREE_DIMENSIONAL, 1])
        found = of_fix[np.minimum(fix, 5)]
        found = np.where((found == FixType.THREE_DIMENSIONAL) & (flags & 2 > 0), FixType.DIFFERENTIAL, found)
        fixed = found >= FixType.TWO_DIMENSIONAL
        found = np.where(fixed & (carrier == 1), FixType.RTK_FLOAT, found)
        found = np.where(fixed & (carrier == 2), FixType.RTK_FIXED, found)
        found = np.where(flags & 1 > 0, found, FixType.NO_FIX)
        result = np.where(there, found, result).astype(np.uint8)
    return result


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
        flags, there = _column(messages, epochs, kind, flag_name)
        week, _ = _column(messages, epochs, kind, "week")
        rest_ns, _ = _column(messages, epochs, kind, "fTOW")
        good = there & (flags & needed == needed) & (week > 0)
        result = np.where(good, week * WEEK_NS + epochs.iTOW_ms * _MS_NS + rest_ns, result)
        denied |= there & ~good
    return result, denied & (result == NO_TIME)


def _times_by_utc(
    messages: Mapping[str, Messages], epochs: Epochs, fixes: NDArray[np.uint8]
) -> tuple[Indices, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return GPS times of the UTC dates of TIMEUTC and PVT by the dated table, NO_TIME without, (m,).

    And where the receiver knows its leap seconds (a row inside a leap second tells nothing of it), and where it says
    that it does not know the time. A date that is not resolved to the second counts only with a fix: before one it is
    that of the receiver's own clock.
    """
    m = len(epochs.iTOW_ms)
    result, resolved = np.full(m, NO_TIME, dtype=np.int64), np.zeros(m, dtype=np.bool_)
    denied = np.zeros(m, dtype=np.bool_)
    fixed = (fixes >= FixType.TWO_DIMENSIONAL) & (fixes != FixType.UNKNOWN)
    for kind in ("NAV-TIMEUTC", "NAV-PVT"):
        valid, there = _column(messages, epochs, kind, "valid")
        fields = ("year", "month", "day", "hour", "min", "sec", "nano")
        year, month, day, hour, minute, second, nano = (
            _column(messages, epochs, kind, name)[0] for name in fields
        )  # fmt: skip
        gps_ns = gps_from_utc_fields(dates(year, month, day), hour * 3600 + minute * 60 + second, nano)
        good = there & (valid & 3 == 3) & ((valid & 4 > 0) | fixed) & (gps_ns != NO_TIME)
        good &= (hour < 24) & (minute < 60) & (second < 61)
        result, denied = np.where(good, gps_ns, result), denied | (there & ~good)
        resolved = np.where(good, (valid & 4 > 0) & (second < 60), resolved)
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


def ubx_fixes(
    messages: Mapping[str, Messages], epochs: Epochs, times: EpochTimes, fixes: NDArray[np.uint8]
) -> FixTable:
    """Return a row for each epoch that has a position, of HPPOSLLH before PVT before POSLLH."""
    there = np.zeros(len(epochs.iTOW_ms), dtype=np.bool_)
    for kind in POSITIONED:
        there |= epochs.member.get(kind, np.full(len(there), -1)) >= 0
    if not there.any():
        return no_fixes()
    columns = {name: values[there] for name, values in _positions(messages, epochs, fixes).items()}
    when = Stamps.of(int(there.sum()), gps_ns=times.gps_ns[there])
    return fix_table(
        when,
        columns.pop("latitude_deg"),
        columns.pop("longitude_deg"),
        **columns,
        velocity_m_s=_velocities(messages, epochs)[there],
        fix_type=fixes[there],
        satellites=_satellites(messages, epochs)[there],
    )


def _positions(messages: Mapping[str, Messages], epochs: Epochs, fixes: NDArray[np.uint8]) -> dict[str, Array]:
    """Return the columns of position, (m,) each; NaN where the receiver calls them invalid."""
    m = len(epochs.iTOW_ms)
    names = ("latitude_deg", "longitude_deg", "height_ellipsoid_m", "height_geoid_m")
    result = {name: np.full(m, np.nan) for name in (*names, "sigma_horizontal_m", "sigma_vertical_m")}
    for kind in reversed(POSITIONED):
        there, columns = _positions_of(messages, epochs, kind)
        result = {name: np.where(there, columns[name], values) for name, values in result.items()}
    zero = (fixes == FixType.NO_FIX) & (result["latitude_deg"] == 0.0) & (result["longitude_deg"] == 0.0)
    for name in names:
        result[name][zero] = np.nan
    return result


def _positions_of(
    messages: Mapping[str, Messages], epochs: Epochs, kind: str
) -> tuple[NDArray[np.bool_], dict[str, Array]]:
    """Return where epochs have a message of a kind, and its columns, (m,) each; a place off the earth is unknown."""

    def value(name: str) -> Array:
        return np.asarray(_column(messages, epochs, kind, name)[0], dtype=np.float64)

    there = _column(messages, epochs, kind, "iTOW")[1]
    fine = kind == "NAV-HPPOSLLH"
    place = {name: value(name) for name in ("lat", "lon", "height", "hMSL")}
    if fine:
        place["lat"] += value("latHp") * 0.01
        place["lon"] += value("lonHp") * 0.01
        place["height"] += value("heightHp") * 0.1
        place["hMSL"] += value("hMSLHp") * 0.1
    bad = _invalid(messages, epochs, kind) | (np.abs(place["lat"]) > 90e7) | (np.abs(place["lon"]) > 180e7)
    lat, lon, height, above_sea = (np.where(bad, np.nan, place[name]) for name in ("lat", "lon", "height", "hMSL"))
    unit_m = 1e-4 if fine else 1e-3
    horizontal, vertical = (_sigma(value(name), unit_m) for name in ("hAcc", "vAcc"))
    return there, {
        "latitude_deg": lat / 1e7,
        "longitude_deg": lon / 1e7,
        "height_ellipsoid_m": height / 1e3,
        "height_geoid_m": above_sea / 1e3,
        "sigma_horizontal_m": horizontal / np.sqrt(2.0),
        "sigma_vertical_m": vertical,
    }


def _invalid(messages: Mapping[str, Messages], epochs: Epochs, kind: str) -> NDArray[np.bool_]:
    """Return where a message says that its position is not valid, (m,)."""
    if kind == "NAV-HPPOSLLH":
        return np.asarray(_column(messages, epochs, kind, "flags")[0] & 1 > 0)
    if kind == "NAV-PVT" and kind in messages:
        long = messages[kind].lengths[np.maximum(epochs.member[kind], 0)] >= 92
        return np.asarray(long & (_column(messages, epochs, kind, "flags3")[0] & 1 > 0))
    return np.zeros(len(epochs.iTOW_ms), dtype=np.bool_)


def _sigma(value: Array, unit_m: float) -> Array:
    """Return accuracies in metres; NaN for 0 and for the numbers that stand for "not known"."""
    known = (value > 0) & (value < _LEAST_UNKNOWN_MM)
    return np.where(known, value * unit_m, np.nan)


def _velocities(messages: Mapping[str, Messages], epochs: Epochs) -> Array:
    """Return velocities east, north, up, (m, 3), of PVT (mm/s) before VELNED (cm/s)."""
    result = np.full((len(epochs.iTOW_ms), 3), np.nan)
    for kind, unit_m_s in (("NAV-VELNED", 1e-2), ("NAV-PVT", 1e-3)):
        north, there = _column(messages, epochs, kind, "velN")
        east, down = (_column(messages, epochs, kind, name)[0] for name in ("velE", "velD"))
        result[there] = (np.column_stack([east, north, -down]) * unit_m_s)[there]
    return result


def _satellites(messages: Mapping[str, Messages], epochs: Epochs) -> NDArray[np.uint8]:
    result = np.full(len(epochs.iTOW_ms), 255, dtype=np.int64)
    for kind in ("NAV-SOL", "NAV-PVT"):
        count, there = _column(messages, epochs, kind, "numSV")
        result = np.where(there, count, result)
    return result.astype(np.uint8)
