"""Flight logs with every column filled, and with gaps, made from random numbers."""

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.core.flight_log import (
    AttitudeTable,
    ExposureKind,
    ExposureTable,
    FixTable,
    FixType,
    FlightLog,
    LogKind,
    Stamps,
    attitude_table,
    exposure_table,
    fix_table,
)
from uavkit.core.gpstime import NO_TIME

NAMES = ("DSC 0001.JPG", "a,b", 'q"uote"', "line\nend", "back\\slash\\u000041", " blanks ", "\0zero", "é—北", "", "#5")
BEGIN_NS = 1_167_264_000_000_000_000  # 2016-12-31 23:59:43 UTC: the leap second of 2017 comes 17 s later


def gappy(rng: np.random.Generator, values: Array) -> Array:
    """Return values with a third of them unknown."""
    return np.where(rng.random(len(values)) < 1 / 3, np.nan, values)


def stamps(rng: np.random.Generator, count: int) -> Stamps:
    def times(begin: int) -> Indices:
        column = begin + np.cumsum(rng.integers(1, 5_000_000_000, count))
        return np.where(rng.random(count) < 0.2, NO_TIME, column)

    return Stamps.of(count, gps_ns=times(BEGIN_NS), boot_ns=times(0), host_ns=times(1_700_000_000_000_000_000))


def made_fixes(rng: np.random.Generator, count: int) -> FixTable:
    return fix_table(
        stamps(rng, count),
        np.degrees(rng.uniform(-1.5, 1.5, count)),
        np.degrees(rng.uniform(-3.1, 3.1, count)),
        height_ellipsoid_m=gappy(rng, rng.normal(0, 1e3, count)),
        height_geoid_m=gappy(rng, rng.normal(0, 1e3, count)),
        height_above_home_m=gappy(rng, rng.normal(0, 1e-9, count)),
        velocity_m_s=np.column_stack([gappy(rng, rng.normal(0, 5, count)) for _ in range(3)]),
        sigma_horizontal_m=gappy(rng, rng.random(count)),
        sigma_vertical_m=gappy(rng, rng.random(count)),
        fix_type=rng.choice([int(kind) for kind in FixType], count).astype(np.uint8),
        satellites=rng.integers(0, 256, count).astype(np.uint8),
        receiver=rng.integers(0, 3, count).astype(np.uint8),
    )


def made_attitudes(rng: np.random.Generator, count: int) -> AttitudeTable:
    return attitude_table(stamps(rng, count), *(gappy(rng, rng.normal(0, 1, count)) for _ in range(3)))


def made_exposures(rng: np.random.Generator, count: int) -> ExposureTable:
    place = gappy(rng, np.degrees(rng.uniform(-1.5, 1.5, count)))
    return exposure_table(
        stamps(rng, count),
        rng.choice([int(kind) for kind in ExposureKind], count).astype(np.uint8),
        sigma_s=gappy(rng, rng.random(count)),
        sequence=rng.integers(-1, 10_000, count),
        latitude_deg=place,
        longitude_deg=place * 2.0,
        height_ellipsoid_m=gappy(rng, rng.normal(0, 1e3, count)),
        height_geoid_m=gappy(rng, rng.normal(0, 1e3, count)),
        height_above_home_m=gappy(rng, rng.normal(0, 1e3, count)),
        roll_rad=gappy(rng, rng.normal(0, 1, count)),
        pitch_rad=gappy(rng, rng.normal(0, 1, count)),
        yaw_rad=gappy(rng, rng.normal(0, 1, count)),
        name=tuple(NAMES[n % len(NAMES)] for n in range(count)),
    )


def made_log(seed: int, count: int = 40) -> FlightLog:
    """Return a log with all its tables."""
    rng = np.random.default_rng(seed)
    return FlightLog(
        source="/flights/00000001.BIN",
        kind=LogKind.DATAFLASH,
        vehicle="ArduCopter V4.6.3",
        fix_table=made_fixes(rng, count),
        estimate_table=made_fixes(rng, count + 1),
        attitude_table=made_attitudes(rng, count + 2),
        exposure_table=made_exposures(rng, count + 3),
    )


def same_tables(one: FlightLog, other: FlightLog) -> None:
    """Check that all tables are equal to the last bit."""
    for name in ("fix_table", "estimate_table", "attitude_table", "exposure_table"):
        same_table(getattr(one, name), getattr(other, name))


def same_table(one: object, other: object) -> None:
    """Check that two tables are equal to the last bit."""
    assert type(one) is type(other)
    for field in one.__dataclass_fields__:  # type: ignore[attr-defined]
        mine, yours = getattr(one, field), getattr(other, field)
        if isinstance(mine, Stamps):
            same_table(mine, yours)
        elif isinstance(mine, np.ndarray):
            assert mine.dtype == yours.dtype, field
            np.testing.assert_array_equal(mine, yours, err_msg=field)
        else:
            assert mine == yours, field
