"""Positions of NMEA 0183 sentences: GGA, RMC, GLL, GNS, GST, ZDA, VTG and GSA of one time joined.

Fields as in NMEA 0183 4.11; talkers (GP, GN, GL, ...) are not told apart. Heights: GGA's and GNS's altitude is above
the receiver's geoid, with the geoid's separation above the ellipsoid. ``sigma_horizontal_m`` is the quadratic mean of
GST's standard deviations of latitude and longitude.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Indices
from uavkit.core.flight_log import FixTable, FixType, Stamps, fix_table, no_fixes
from uavkit.core.gpstime import NO_TIME
from uavkit.formats.kernels.nmea_fields import FIELDS, split_fields
from uavkit.formats.receiver_stream import NMEA, Batch
from uavkit.formats.receiver_times import (
    DAY_NS,
    EARLIEST_NS,
    SECOND_NS,
    dates,
    gps_from_utc_fields,
    roll_over_note,
    unrolled,
)

_KINDS = ("GGA", "RMC", "GLL", "GNS", "ZDA", "GST", "VTG", "GSA")
_KNOT_M_S = 1852.0 / 3600.0
_TIME_FIELD = {"GGA": 1, "RMC": 1, "GLL": 5, "GNS": 1, "ZDA": 1, "GST": 1}
_LATITUDE_FIELD = {"GGA": 2, "RMC": 3, "GLL": 1, "GNS": 2}
_LEAST_FIELDS = {"GGA": 12, "RMC": 10, "GLL": 6, "GNS": 11, "ZDA": 5, "GST": 9, "VTG": 6, "GSA": 3}
"""Fields without which a sentence is not decoded, the address included."""
_COLUMNS = {
    "GGA": ("latitude", "longitude", "quality", "satellites", "height", "separation"),
    "RMC": ("latitude", "longitude", "quality", "speed", "course", "day"),
    "GLL": ("latitude", "longitude", "quality"),
    "GNS": ("latitude", "longitude", "quality", "satellites", "height", "separation"),
    "ZDA": ("day",),
    "GST": ("sigma_latitude", "sigma_longitude", "sigma_height"),
    "VTG": ("speed", "course"),
    "GSA": ("dimensions",),
}
_OF_GGA = {
    0: FixType.NO_FIX, 1: FixType.THREE_DIMENSIONAL, 2: FixType.DIFFERENTIAL, 3: FixType.THREE_DIMENSIONAL,
    4: FixType.RTK_FIXED, 5: FixType.RTK_FLOAT, 6: FixType.NO_FIX, 9: FixType.DIFFERENTIAL,
}  # fmt: skip
"""GGA's quality; 6 is dead reckoning, 7 and 8 (manual, simulator) are unknown."""
_OF_MODE = {
    "N": FixType.NO_FIX, "E": FixType.NO_FIX, "V": FixType.NO_FIX, "A": FixType.THREE_DIMENSIONAL,
    "P": FixType.THREE_DIMENSIONAL, "D": FixType.DIFFERENTIAL, "F": FixType.RTK_FLOAT, "R": FixType.RTK_FIXED,
}  # fmt: skip
"""Mode indicators; M and S (manual, simulator) are unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rows:
    """The decoded sentences of one kind, n of them."""

    offsets: Indices
    second_ns: Indices
    """(n,) time of day; NO_TIME where the sentence has none."""
    columns: dict[str, Array]
    """(n,) each, NaN where empty."""


class Sentences:
    """Collects the sentences of a stream and joins them."""

    def __init__(self) -> None:
        """Begin with none."""
        self._parts: dict[str, list[_Rows]] = {kind: [] for kind in _KINDS}

    def add(self, batch: Batch) -> None:
        """Decode the sentences of a batch."""
        chosen = batch.kinds == NMEA
        codes, places = batch.codes[chosen], batch.places[chosen]
        kind_code = np.where((codes >> 40 == 0) & (codes & 255 != ord("P")), codes >> 16, 0)
        wanted = np.isin(kind_code, [_packed(kind) for kind in _KINDS])
        if not wanted.any():
            return
        places, kind_code = places[wanted], kind_code[wanted]
        numbers, texts = np.empty((len(places), FIELDS)), np.empty((len(places), FIELDS), dtype=np.int64)
        counts = split_fields(batch.block, places, numbers, texts)
        for kind in _KINDS:
            rows = (kind_code == _packed(kind)) & (counts >= _LEAST_FIELDS[kind])
            if rows.any():
                offsets = places[rows, 0] + batch.offset
                self._parts[kind].append(_decoded(kind, offsets, numbers[rows], texts[rows]))

    def fixes(self) -> tuple[FixTable, tuple[str, ...]]:
        """Return a row for each epoch that has a sentence of position, and what is to be said of them; only once."""
        parts, self._parts = self._parts, {}
        rows = {kind: _joined(kind, parts.pop(kind)) for kind in _KINDS if parts[kind]}
        return _fixes(rows) if any(kind in rows for kind in _LATITUDE_FIELD) else (no_fixes(), ())


def _packed(text: str) -> int:
    return int.from_bytes(text.encode("ascii"), "little")


def _joined(kind: str, parts: list[_Rows]) -> _Rows:
    return _Rows(
        offsets=np.concatenate([part.offsets for part in parts]),
        second_ns=np.concatenate([part.second_ns for part in parts]),
        columns={name: np.concatenate([part.columns[name] for part in parts]) for name in _COLUMNS[kind]},
    )


def _decoded(kind: str, offsets: Indices, numbers: Array, texts: Indices) -> _Rows:
    """Return the sentences of a kind from their fields, (n, FIELDS); those that leave their time open are left out."""
    columns: dict[str, Array] = {}
    if kind in _LATITUDE_FIELD:
        at = _LATITUDE_FIELD[kind]
        columns["latitude"] = _degrees(numbers[:, at], texts[:, at + 1], "NS", 90.0)
        columns["longitude"] = _degrees(numbers[:, at + 2], texts[:, at + 3], "EW", 180.0)
    if kind in ("GGA", "GNS"):
        names = ("satellites", "height", "separation")
        columns |= dict(
            zip(names, (numbers[:, at] for at in ((7, 9, 11) if kind == "GGA" else (7, 9, 10))), strict=True)
        )
    if kind == "GGA":
        columns["quality"] = _mapped(numbers[:, 6], _OF_GGA)
    elif kind == "GNS":
        columns["quality"] = _of_modes(texts[:, 6])
    elif kind == "RMC":
        columns["quality"] = _of_status(texts[:, 2], texts[:, 12])
        columns |= {"speed": numbers[:, 7] * _KNOT_M_S, "course": numbers[:, 8], "day": _short_days(numbers[:, 9])}
    elif kind == "GLL":
        columns["quality"] = _of_status(texts[:, 6], texts[:, 7])
    elif kind == "ZDA":
        columns["day"] = _days(numbers[:, 4], numbers[:, 3], numbers[:, 2])
    elif kind == "GST":
        names = ("sigma_latitude", "sigma_longitude", "sigma_height")
        columns = {
            name: np.where(numbers[:, at] > 0, numbers[:, at], np.nan)
            for name, at in zip(names, (6, 7, 8), strict=True)
        }
    elif kind == "VTG":
        columns = {"speed": _vtg_speed(numbers, texts), "course": numbers[:, 1]}
    elif kind == "GSA":
        columns = {"dimensions": numbers[:, 2]}
    if kind not in _TIME_FIELD:
        seconds = np.full(len(numbers), NO_TIME, dtype=np.int64)
        return _Rows(offsets=offsets, second_ns=seconds, columns={name: columns[name] for name in _COLUMNS[kind]})
    seconds = _second_of_day_ns(numbers[:, _TIME_FIELD[kind]])
    timed = seconds != NO_TIME
    kept = {name: columns[name][timed] for name in _COLUMNS[kind]}
    return _Rows(offsets=offsets[timed], second_ns=seconds[timed], columns=kept)


def _degrees(number: Array, letter: Indices, letters: str, most: float) -> Array:
    """Return signed degrees of dddmm.mmmm, (n,); NaN where they or the hemisphere's letter are not right."""
    whole = np.floor(number / 100.0)
    minutes = number - 100.0 * whole
    value = whole + minutes / 60.0
    positive, negative = (letter == ord(character) for character in letters)
    good = (positive | negative) & (minutes < 60.0) & (value <= most) & (number >= 0)
    return np.where(good, np.where(negative, -value, value), np.nan)


def _second_of_day_ns(number: Array) -> Indices:
    """Return ns since midnight of hhmmss.sss, (n,); NO_TIME where it is none."""
    good = np.isfinite(number) & (number >= 0) & (number < 240_000)
    units = np.rint(np.where(good, number, 0) * 1e6).astype(np.int64)
    hour, rest = np.divmod(units, 10_000_000_000)
    minute, micro = np.divmod(rest, 100_000_000)
    good &= (minute < 60) & (micro < 61_000_000)
    return np.where(good, (hour * 3600 + minute * 60) * SECOND_NS + micro * 1000, NO_TIME)


def _days(year: Array, month: Array, day: Array) -> Array:
    """Return days since 1970, (n,); NaN where there is no such day."""
    y, m, d = (np.where(np.isfinite(part), part, 0).astype(np.int64) for part in (year, month, day))
    date = dates(y, m, d)
    known = ~np.isnat(date)
    return np.where(known, np.where(known, date, np.datetime64(0, "D")).astype(np.int64), np.nan)


def _short_days(number: Array) -> Array:
    """Return days since 1970 of ddmmyy, (n,); years from 80 on are of the last century."""
    whole = np.where(np.isfinite(number), number, 0).astype(np.int64)
    year = whole % 100
    return _days(
        (year + np.where(year >= 80, 1900, 2000)).astype(np.float64),
        (whole // 100 % 100).astype(np.float64),
        (whole // 10_000).astype(np.float64),
    )


def _vtg_speed(numbers: Array, texts: Indices) -> Array:
    """Return VTG's speed in m/s, (n,): of km/h, of knots where that is empty; the old short form has no letters."""
    knots = np.where(texts[:, 6] == ord("N"), numbers[:, 5], np.nan) * _KNOT_M_S
    kmh = np.where(texts[:, 8] == ord("K"), numbers[:, 7], np.nan) / 3.6
    return np.where(np.isfinite(knots), knots, kmh)


def _mapped(number: Array, mapping: "dict[int, FixType]") -> Array:
    result = np.where(np.isfinite(number), float(FixType.UNKNOWN), float(FixType.NO_FIX))
    for value, fix in mapping.items():
        result[number == value] = fix
    return result


def _of_modes(text: Indices) -> Array:
    """Return the best of the mode indicators of the satellite systems (GNS), (n,) FixType; M and S are unknown."""
    letters = (text[:, None] >> np.arange(0, 56, 8)) & 255
    result = np.full(len(text), float(FixType.NO_FIX))
    for letter, fix in _OF_MODE.items():
        there = np.any(letters == ord(letter), axis=1)
        result[there] = np.maximum(result[there], fix)
    other = (text == 0) | np.any((letters == ord("M")) | (letters == ord("S")), axis=1)
    return np.where(other & (result == FixType.NO_FIX), float(FixType.UNKNOWN), result)


def _of_status(status: Indices, mode: Indices) -> Array:
    """Return FixType of RMC's and GLL's status and mode indicator (empty before NMEA 2.3), (n,)."""
    result = np.full(len(status), float(FixType.UNKNOWN))
    for letter in ("N", "E", "D", "F", "R"):
        result[mode == ord(letter)] = _OF_MODE[letter]
    return np.where(status == ord("A"), result, float(FixType.NO_FIX))


def _fixes(rows: dict[str, _Rows]) -> tuple[FixTable, tuple[str, ...]]:
    """Join sentences into epochs: those that follow one another with the same time, VTG and GSA with the one before."""
    kinds = [kind for kind in _KINDS if kind in rows]
    offsets = np.concatenate([rows[kind].offsets for kind in kinds])
    seconds = np.concatenate([rows[kind].second_ns for kind in kinds])
    order = np.argsort(offsets, kind="stable")
    number = np.empty(len(order), dtype=np.int64)
    number[order], epoch_ns = _epochs_of(seconds[order])
    values: dict[str, dict[str, Array]] = {}
    begin = 0
    for kind in kinds:
        count = len(rows[kind].offsets)
        values[kind] = _by_epoch(rows[kind], number[begin : begin + count], len(epoch_ns))
        begin += count
    return _table(values, epoch_ns)


def _epochs_of(seconds: Indices) -> tuple[Indices, Indices]:
    """Return the epoch of each sentence in order, (n,), -1 before the first, and the epochs' times of day, (m,)."""
    timed = np.flatnonzero(seconds != NO_TIME)
    new = np.zeros(len(seconds), dtype=np.bool_)
    new[timed] = np.diff(seconds[timed], prepend=-1) != 0
    return np.cumsum(new) - 1, seconds[new]


def _by_epoch(rows: _Rows, number: Indices, m: int) -> dict[str, Array]:
    """Return the columns of a kind for each epoch, (m,), of its last sentence; ``there`` is 1 where it has one."""
    inside = number >= 0
    result = {}
    for name, column in (rows.columns | {"there": np.ones(len(number))}).items():
        result[name] = np.full(m, np.nan)
        result[name][number[inside]] = column[inside]
    return result


def _first_known(values: dict[str, dict[str, Array]], kinds: tuple[str, ...], name: str, m: int) -> Array:
    """Return for each epoch the value of the first of kinds that has one, (m,)."""
    result = np.full(m, np.nan)
    for kind in reversed(kinds):
        if kind in values:
            column = values[kind][name]
            result = np.where(np.isnan(column), result, column)
    return result


def _table(values: dict[str, dict[str, Array]], epoch_ns: Indices) -> tuple[FixTable, tuple[str, ...]]:
    m = len(epoch_ns)
    placed = ("GGA", "GNS", "RMC", "GLL")
    there = np.isfinite(_first_known(values, placed, "there", m))
    fix = _fix_types(values, m)
    gps_ns, notes = _gps_times(epoch_ns, _first_known(values, ("RMC", "ZDA"), "day", m), fix)
    height = _first_known(values, ("GGA", "GNS"), "height", m)
    separation = _first_known(values, ("GGA", "GNS"), "separation", m)
    satellites = _first_known(values, ("GGA", "GNS"), "satellites", m)
    columns: dict[str, NDArray[np.float64] | NDArray[np.uint8]] = {
        "height_geoid_m": height,
        "height_ellipsoid_m": height + separation,
        "velocity_m_s": _velocity(values, m),
        "sigma_horizontal_m": _horizontal_sigma(values, m),
        "sigma_vertical_m": _first_known(values, ("GST",), "sigma_height", m),
        "fix_type": fix.astype(np.uint8),
        "satellites": np.where((satellites >= 0) & (satellites < 255), satellites, 255).astype(np.uint8),
    }
    table = fix_table(
        Stamps.of(int(there.sum()), gps_ns=gps_ns[there]),
        _first_known(values, placed, "latitude", m)[there],
        _first_known(values, placed, "longitude", m)[there],
        **{name: column[there] for name, column in columns.items()},
    )
    unknown = int(np.sum(table.when.gps_ns == NO_TIME))
    if unknown:
        notes = (
            *notes,
            f"{unknown} of {len(table)} rows have no time: RMC and ZDA tell the date, and only with a fix",
        )
    return table, notes


def _fix_types(values: dict[str, dict[str, Array]], m: int) -> Array:
    """Return FixType, (m,): GGA's quality, GNS's mode, then RMC's and GLL's; GSA tells 2D from 3D."""
    fix = _first_known(values, ("GGA", "GNS", "RMC", "GLL"), "quality", m)
    dimensions = _first_known(values, ("GSA",), "dimensions", m)
    plain = (fix == FixType.THREE_DIMENSIONAL) | (fix == FixType.UNKNOWN)
    fix[plain & (dimensions == 3)] = FixType.THREE_DIMENSIONAL
    fix[plain & (dimensions == 2)] = FixType.TWO_DIMENSIONAL
    return np.where(np.isnan(fix), float(FixType.UNKNOWN), fix)


def _velocity(values: dict[str, dict[str, Array]], m: int) -> Array:
    """Return velocities, (m, 3); up is not told, and east and north are unknown where the course is, but for a stop."""
    speed = _first_known(values, ("RMC", "VTG"), "speed", m)
    course = np.radians(_first_known(values, ("RMC", "VTG"), "course", m))
    course = np.where((speed == 0.0) & np.isnan(course), 0.0, course)
    return np.column_stack([speed * np.sin(course), speed * np.cos(course), np.full(m, np.nan)])


def _horizontal_sigma(values: dict[str, dict[str, Array]], m: int) -> Array:
    latitude, longitude = (_first_known(values, ("GST",), f"sigma_{name}", m) for name in ("latitude", "longitude"))
    return np.asarray(np.sqrt((latitude**2 + longitude**2) / 2.0), dtype=np.float64)


def _gps_times(epoch_ns: Indices, day: Array, fix: Array) -> tuple[Indices, tuple[str, ...]]:
    """Return GPS times of epochs, (m,), from times of day and the days that some of them tell.

    Midnight is where the time of day falls by more than half a day. A date without a fix does not count (it is that of
    the receiver's own clock), and before the first date that does, epochs without a fix have no time.
    """
    midnights = np.cumsum(np.diff(epoch_ns, prepend=epoch_ns[:1]) < -DAY_NS // 2)
    dated = np.flatnonzero(np.isfinite(day) & (fix != FixType.NO_FIX))
    if len(dated) == 0:
        return np.full(len(epoch_ns), NO_TIME, dtype=np.int64), ()
    rows = np.arange(len(epoch_ns))
    last = dated[np.maximum(np.searchsorted(dated, rows, side="right") - 1, 0)]
    days = day[last].astype(np.int64) + midnights - midnights[last]
    whole, rest = np.divmod(epoch_ns, SECOND_NS)
    gps_ns = gps_from_utc_fields(days.astype("datetime64[D]"), whole, rest)
    gps_ns = np.where((rows < dated[0]) & (fix == FixType.NO_FIX), NO_TIME, gps_ns)
    moved_ns, moved = unrolled(gps_ns, EARLIEST_NS)
    return moved_ns, (roll_over_note(moved, "positions"),) if moved else ()
