"""Positions of a u-blox receiver: a row for each navigation epoch.

The best message of an epoch counts: HPPOSLLH, PVT, POSLLH, and SOL's geocentric position where there is no other.

``hAcc`` is the radial accuracy in the plane (root of the sum of both axes' variances): ``sigma_horizontal_m``, for each
axis, is hAcc / sqrt(2); of SOL's ``pAcc``, in space, it is pAcc / sqrt(3). u-blox does not say of what probability they
are.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.core.flight_log import FixTable, FixType, Stamps, fix_table, no_fixes
from uavkit.formats.ubx_epochs import Epochs, Messages, column
from uavkit.formats.ubx_times import EpochTimes

POSITIONED = ("NAV-HPPOSLLH", "NAV-PVT", "NAV-POSLLH", "NAV-SOL")
"""The best first."""
_LEAST_UNKNOWN = 4_000_000_000
"""Receivers without a fix tell accuracies of 2^32 - 1 mm or about 4295 km."""
_LEAST_RADIUS_M = 6_300_000.0
"""A geocentric position below this is none."""
_SEMI_AXIS_M, _FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""WGS 84."""


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
        columns = _geocentric(messages, epochs) if kind == "NAV-SOL" else _positions_of(messages, epochs, kind)
        there = np.isfinite(columns["latitude_deg"])
        result = {name: np.where(there, columns[name], values) for name, values in result.items()}
    zero = (fixes == FixType.NO_FIX) & (result["latitude_deg"] == 0.0) & (result["longitude_deg"] == 0.0)
    for name in names:
        result[name][zero] = np.nan
    return result


def _values(messages: Mapping[str, Messages], epochs: Epochs, kind: str, names: str) -> list[Array]:
    """Return fields of a kind for each epoch, (m,) each."""
    return [np.asarray(column(messages, epochs, kind, name)[0], dtype=np.float64) for name in names.split()]


def _positions_of(messages: Mapping[str, Messages], epochs: Epochs, kind: str) -> dict[str, Array]:
    """Return the columns of a kind of message, (m,) each; NaN without one and where its place is not valid."""
    lat, lon, height, above_sea = _values(messages, epochs, kind, "lat lon height hMSL")
    unit_m = 1e-3
    if kind == "NAV-HPPOSLLH":
        rests = _values(messages, epochs, kind, "latHp lonHp heightHp hMSLHp")
        lat, lon = lat + rests[0] * 0.01, lon + rests[1] * 0.01
        height, above_sea, unit_m = height + rests[2] * 0.1, above_sea + rests[3] * 0.1, 1e-4
    bad = ~column(messages, epochs, kind, "iTOW")[1] | _invalid(messages, epochs, kind)
    bad |= (np.abs(lat) > 90e7) | (np.abs(lon) > 180e7)
    horizontal, vertical = (_sigma(value, unit_m) for value in _values(messages, epochs, kind, "hAcc vAcc"))
    columns = {
        "latitude_deg": lat / 1e7,
        "longitude_deg": lon / 1e7,
        "height_ellipsoid_m": height / 1e3,
        "height_geoid_m": above_sea / 1e3,
        "sigma_horizontal_m": horizontal / np.sqrt(2.0),
        "sigma_vertical_m": vertical,
    }
    return {name: np.where(bad, np.nan, values) for name, values in columns.items()}


def _geocentric(messages: Mapping[str, Messages], epochs: Epochs) -> dict[str, Array]:
    """Return the columns of SOL's geocentric positions, (m,) each; NaN without one.

    Bowring (1976), one step: exact to 1e-9 degrees near the ground. The height's form has no pole.
    """
    x, y, z, accuracy = _values(messages, epochs, "NAV-SOL", "ecefX ecefY ecefZ pAcc")
    x, y, z = x / 100.0, y / 100.0, z / 100.0
    e2 = _FLATTENING * (2.0 - _FLATTENING)
    minor_m = _SEMI_AXIS_M * (1.0 - _FLATTENING)
    equatorial = np.hypot(x, y)
    reduced = np.arctan2(z * _SEMI_AXIS_M, equatorial * minor_m)
    latitude = np.arctan2(
        z + e2 / (1.0 - e2) * minor_m * np.sin(reduced) ** 3, equatorial - e2 * _SEMI_AXIS_M * np.cos(reduced) ** 3
    )
    curve = _SEMI_AXIS_M * np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
    height_m = equatorial * np.cos(latitude) + z * np.sin(latitude) - curve
    sigma_m = _sigma(accuracy, 1e-2) / np.sqrt(3.0)
    columns = {
        "latitude_deg": np.degrees(latitude),
        "longitude_deg": np.degrees(np.arctan2(y, x)),
        "height_ellipsoid_m": height_m,
        "height_geoid_m": np.full(len(x), np.nan),
        "sigma_horizontal_m": sigma_m,
        "sigma_vertical_m": sigma_m,
    }
    bad = np.sqrt(x * x + y * y + z * z) < _LEAST_RADIUS_M
    return {name: np.where(bad, np.nan, values) for name, values in columns.items()}


def _invalid(messages: Mapping[str, Messages], epochs: Epochs, kind: str) -> NDArray[np.bool_]:
    """Return where a message says that its position is not valid, (m,)."""
    if kind == "NAV-HPPOSLLH":
        return np.asarray(column(messages, epochs, kind, "flags")[0] & 1 > 0)
    if kind == "NAV-PVT" and kind in messages:
        long = messages[kind].lengths[np.maximum(epochs.member[kind], 0)] >= 92
        return np.asarray(long & (column(messages, epochs, kind, "flags3")[0] & 1 > 0))
    return np.zeros(len(epochs.iTOW_ms), dtype=np.bool_)


def _sigma(value: Array, unit_m: float) -> Array:
    """Return accuracies in metres; NaN for 0 and for the numbers that stand for "not known"."""
    known = (value > 0) & (value < _LEAST_UNKNOWN)
    return np.where(known, value * unit_m, np.nan)


def _velocities(messages: Mapping[str, Messages], epochs: Epochs) -> Array:
    """Return velocities east, north, up, (m, 3), of PVT (mm/s) before VELNED (cm/s)."""
    result = np.full((len(epochs.iTOW_ms), 3), np.nan)
    for kind, unit_m_s in (("NAV-VELNED", 1e-2), ("NAV-PVT", 1e-3)):
        north, there = column(messages, epochs, kind, "velN")
        east, down = (column(messages, epochs, kind, name)[0] for name in ("velE", "velD"))
        result[there] = (np.column_stack([east, north, -down]) * unit_m_s)[there]
    return result


def _satellites(messages: Mapping[str, Messages], epochs: Epochs) -> NDArray[np.uint8]:
    result = np.full(len(epochs.iTOW_ms), 255, dtype=np.int64)
    for kind in ("NAV-SOL", "NAV-PVT"):
        count, there = column(messages, epochs, kind, "numSV")
        result = np.where(there, count, result)
    return result.astype(np.uint8)
