"""What a flight log holds, of whatever kind: positions, attitudes, exposures as tables, and what was damaged in it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Indices
from uavkit.core.clock_fit import ClockFit
from uavkit.core.gpstime import NO_TIME
from uavkit.core.heights import HeightDatum
from uavkit.core.records import AttitudeSample, ExposureEvent, GnssFix


class LogKind(Enum):
    """The kinds of log that are read."""

    DATAFLASH = "ArduPilot dataflash"
    DATAFLASH_TEXT = "ArduPilot dataflash as text"
    TLOG = "MAVLink telemetry log"
    ULOG = "PX4 ULog"
    UBX = "u-blox"
    NMEA = "NMEA 0183"
    KML = "KML"
    GPX = "GPX"
    DJI_SRT = "DJI subtitles"
    DJI_MRK = "DJI MRK"
    CSV = "CSV"


@dataclass(frozen=True, slots=True, kw_only=True)
class LostBytes:
    """A span of a file that belongs to no intact message."""

    offset: int
    """Of its first byte in the file."""
    length: int
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Damage:
    """What of a log could not be read."""

    lost_bytes: int = 0
    span_count: int = 0
    spans: tuple[LostBytes, ...] = ()
    """The first of them, in the order of the file: see ``uavkit.formats.log_bytes.MOST_SPANS``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stamps:
    """The times of the rows of a table by three clocks, (n,) each in ns; NO_TIME where a clock does not tell.

    All are the times at which the row was true (a fix's epoch, an exposure), not at which it was written down.
    """

    gps_ns: Indices
    """GPS time."""
    boot_ns: Indices
    """Since the vehicle's start, by its own clock."""
    host_ns: Indices
    """When the computer on the ground received the message: Unix time by its clock, later by the link's delay."""

    @classmethod
    def of(
        cls,
        count: int,
        *,
        gps_ns: Indices | None = None,
        boot_ns: Indices | None = None,
        host_ns: Indices | None = None,
    ) -> "Stamps":
        """Return the stamps of ``count`` rows; a clock that is not given does not tell."""
        columns = (gps_ns, boot_ns, host_ns)
        gps, boot, host = (
            np.full(count, NO_TIME, dtype=np.int64) if column is None else np.asarray(column, dtype=np.int64)
            for column in columns
        )
        return cls(gps_ns=gps, boot_ns=boot, host_ns=host)

    def __post_init__(self) -> None:
        _check_lengths(self, len(self.gps_ns), ("boot_ns", "host_ns"))

    def __len__(self) -> int:
        return len(self.gps_ns)

    def where(self, rows: "NDArray[np.bool_] | Indices") -> "Stamps":
        """Return the rows that a mask or indexes choose."""
        return Stamps(gps_ns=self.gps_ns[rows], boot_ns=self.boot_ns[rows], host_ns=self.host_ns[rows])


class FixType(IntEnum):
    """How a position came about; MAVLink's numbers."""

    NO_GPS = 0
    NO_FIX = 1
    TWO_DIMENSIONAL = 2
    THREE_DIMENSIONAL = 3
    DIFFERENTIAL = 4
    RTK_FLOAT = 5
    RTK_FIXED = 6
    UNKNOWN = 255


@dataclass(frozen=True, slots=True, kw_only=True)
class FixTable:
    """Positions; n of them, in the order of the file. NaN is a value that the source does not tell."""

    when: Stamps
    latitude_deg: Array
    """(n,)."""
    longitude_deg: Array
    """(n,)."""
    height_ellipsoid_m: Array
    """(n,)."""
    height_geoid_m: Array
    """(n,) above mean sea level, by the receiver's own geoid."""
    height_above_home_m: Array
    """(n,) above the take-off point."""
    velocity_m_s: Array
    """(n, 3) east, north, up."""
    sigma_horizontal_m: Array
    """(n,) for each axis, as the receiver states it; makers do not say of what probability."""
    sigma_vertical_m: Array
    """(n,)."""
    fix_type: NDArray[np.uint8]
    """(n,) ``FixType``."""
    satellites: NDArray[np.uint8]
    """(n,) used; 255 where the source does not say."""
    receiver: NDArray[np.uint8]
    """(n,) number of the receiver, from 0."""
    name: tuple[str, ...] = ()
    """(n,) of waypoints; empty where the source has no names."""

    def __post_init__(self) -> None:
        n = len(self.when)
        _check_lengths(
            self,
            n,
            (
                "latitude_deg", "longitude_deg", "height_ellipsoid_m", "height_geoid_m", "height_above_home_m",
                "velocity_m_s", "sigma_horizontal_m", "sigma_vertical_m", "fix_type", "satellites", "receiver",
            ),
        )  # fmt: skip
        if self.velocity_m_s.shape != (n, 3) or len(self.name) not in (0, n):
            raise ValueError("FixTable: velocity_m_s is (n, 3), names are n or none")

    def __len__(self) -> int:
        return len(self.when)


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeTable:
    """Attitudes of the vehicle; n of them. Radians: roll, pitch, yaw from true north, clockwise."""

    when: Stamps
    roll_rad: Array
    """(n,)."""
    pitch_rad: Array
    """(n,)."""
    yaw_rad: Array
    """(n,)."""

    def __post_init__(self) -> None:
        _check_lengths(self, len(self.when), ("roll_rad", "pitch_rad", "yaw_rad"))

    def __len__(self) -> int:
        return len(self.when)


class ExposureKind(IntEnum):
    """What noticed an exposure, the surest first."""

    FEEDBACK = 0
    """The camera's flash contact, seen by the autopilot: the time of the exposure itself."""
    MARK = 1
    """The same, seen by the GNSS receiver (TIM-TM2, MRK)."""
    CAPTURED = 2
    """The camera, or the autopilot for it, reports a picture."""
    TRIGGER = 3
    """The autopilot asked for a picture: the shutter lags behind, and may have failed."""
    LISTED = 4
    """A list of positions of exposures without times."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExposureTable:
    """Exposures; n of them, in the order of the file. NaN is a value that the source does not tell."""

    when: Stamps
    sigma_s: Array
    """(n,) of the time as a time of exposure, the constant part of the delay left out; NaN where nothing says it."""
    kind: NDArray[np.uint8]
    """(n,) ``ExposureKind``."""
    sequence: Indices
    """(n,) the source's own count; -1 where it has none."""
    latitude_deg: Array
    """(n,) of the vehicle (its own estimate), as the columns that follow."""
    longitude_deg: Array
    """(n,)."""
    height_ellipsoid_m: Array
    """(n,)."""
    height_geoid_m: Array
    """(n,)."""
    height_above_home_m: Array
    """(n,)."""
    roll_rad: Array
    """(n,) of the vehicle, like the two that follow; yaw from true north, clockwise."""
    pitch_rad: Array
    """(n,)."""
    yaw_rad: Array
    """(n,)."""
    name: tuple[str, ...] = ()
    """(n,) of images or waypoints; empty where the source has none."""

    def __post_init__(self) -> None:
        n = len(self.when)
        _check_lengths(
            self,
            n,
            (
                "sigma_s", "kind", "sequence", "latitude_deg", "longitude_deg", "height_ellipsoid_m", "height_geoid_m",
                "height_above_home_m", "roll_rad", "pitch_rad", "yaw_rad",
            ),
        )  # fmt: skip
        if len(self.name) not in (0, n):
            raise ValueError(f"ExposureTable: {len(self.name)} names for {n} exposures")

    def __len__(self) -> int:
        return len(self.when)


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightLog:
    """One log. Fills the Protocols ``GnssReceiver`` and ``ExposureSource``."""

    source: str
    """Path, for messages."""
    kind: LogKind
    vehicle: str = ""
    """Firmware or device as the log names it."""
    fix_table: FixTable
    """Of the GNSS receivers."""
    estimate_table: FixTable
    """The autopilot's own estimate of its position, of all its sensors."""
    attitude_table: AttitudeTable
    exposure_table: ExposureTable
    clock: ClockFit | None = None
    """GPS time of the boot clock; None where the log has no boot clock or nothing ties it to GPS time."""
    message_counts: Mapping[str, int] = field(default_factory=dict)
    """Intact messages by name, those that are not decoded included."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    texts: tuple[str, ...] = ()
    """Messages to the pilot."""
    damage: Damage = Damage()
    notes: tuple[str, ...] = ()
    """What was decided or found odd, in words."""

    def fixes(self) -> Iterator[GnssFix]:
        """Yield the positions of the first receiver in the order of the file, those without a fix left out."""
        table = self.fix_table
        good = (table.fix_type >= FixType.TWO_DIMENSIONAL) & (table.receiver == (table.receiver.min(initial=255)))
        good &= np.isfinite(table.latitude_deg) & np.isfinite(table.longitude_deg)
        for row in np.flatnonzero(good).tolist():
            yield _fix(table, row)

    def exposures(self) -> Iterator[ExposureEvent]:
        """Yield the exposures in the order of the file."""
        table = self.exposure_table
        for row in range(len(table)):
            yield ExposureEvent(
                gps_time_ns=time_or_none(table.when.gps_ns[row]),
                sequence=int(table.sequence[row]) if table.sequence[row] >= 0 else None,
                source=ExposureKind(int(table.kind[row])).name.lower(),
                position=_fix(table, row) if np.isfinite(table.latitude_deg[row]) else None,
            )

    def attitudes(self) -> Iterator[AttitudeSample]:
        """Yield the attitudes whose GPS time is known."""
        table = self.attitude_table
        for row in np.flatnonzero(table.when.gps_ns != NO_TIME).tolist():
            yield AttitudeSample(
                gps_time_ns=int(table.when.gps_ns[row]),
                roll_rad=float(table.roll_rad[row]),
                pitch_rad=float(table.pitch_rad[row]),
                yaw_rad=float(table.yaw_rad[row]),
            )


def time_or_none(time_ns: "np.int64 | int") -> int | None:
    """Return a time of a table as an int, None for NO_TIME."""
    return None if int(time_ns) == NO_TIME else int(time_ns)


def _fix(table: "FixTable | ExposureTable", row: int) -> GnssFix:
    """Return a row as a record; of several heights the ellipsoidal one, then the geoid's."""
    heights = (
        (table.height_ellipsoid_m[row], HeightDatum.ELLIPSOID),
        (table.height_geoid_m[row], HeightDatum.GEOID),
        (table.height_above_home_m[row], HeightDatum.GROUND),
    )
    height_m, datum = next(((h, d) for h, d in heights if np.isfinite(h)), (np.nan, HeightDatum.UNKNOWN))
    horizontal, vertical = (
        (table.sigma_horizontal_m[row], table.sigma_vertical_m[row]) if isinstance(table, FixTable) else (np.nan,) * 2
    )
    return GnssFix(
        gps_time_ns=time_or_none(table.when.gps_ns[row]),
        latitude_deg=float(table.latitude_deg[row]),
        longitude_deg=float(table.longitude_deg[row]),
        height_m=float(height_m),
        height_datum=datum,
        sigma_horizontal_m=float(horizontal) if np.isfinite(horizontal) else None,
        sigma_vertical_m=float(vertical) if np.isfinite(vertical) else None,
        name=table.name[row] if table.name else "",
    )


def _check_lengths(table: object, count: int, columns: tuple[str, ...]) -> None:
    for name in columns:
        if len(getattr(table, name)) != count:
            raise ValueError(f"{type(table).__name__}.{name} has {len(getattr(table, name))} rows, not {count}")


def _unknown(count: int) -> Array:
    return np.full(count, np.nan)


def fix_table(when: Stamps, latitude_deg: Array, longitude_deg: Array, **columns: object) -> FixTable:
    """Return a table of positions; columns that are not given are unknown."""
    n = len(when)
    usual: dict[str, object] = {
        "height_ellipsoid_m": _unknown(n),
        "height_geoid_m": _unknown(n),
        "height_above_home_m": _unknown(n),
        "velocity_m_s": np.full((n, 3), np.nan),
        "sigma_horizontal_m": _unknown(n),
        "sigma_vertical_m": _unknown(n),
        "fix_type": np.full(n, FixType.UNKNOWN, dtype=np.uint8),
        "satellites": np.full(n, 255, dtype=np.uint8),
        "receiver": np.zeros(n, dtype=np.uint8),
    }
    return FixTable(when=when, latitude_deg=latitude_deg, longitude_deg=longitude_deg, **(usual | columns))  # type: ignore[arg-type]


def attitude_table(when: Stamps, roll_rad: Array, pitch_rad: Array, yaw_rad: Array) -> AttitudeTable:
    """Return a table of attitudes."""
    return AttitudeTable(when=when, roll_rad=roll_rad, pitch_rad=pitch_rad, yaw_rad=yaw_rad)


def exposure_table(when: Stamps, kind: "NDArray[np.uint8] | ExposureKind", **columns: object) -> ExposureTable:
    """Return a table of exposures; columns that are not given are unknown. ``kind`` is one for all or (n,)."""
    n = len(when)
    names = ("sigma_s", "latitude_deg", "longitude_deg", "height_ellipsoid_m", "height_geoid_m", "height_above_home_m")
    usual: dict[str, object] = {name: _unknown(n) for name in (*names, "roll_rad", "pitch_rad", "yaw_rad")}
    usual["sequence"] = np.full(n, -1, dtype=np.int64)
    kinds = np.broadcast_to(np.asarray(kind, dtype=np.uint8), (n,)).copy()
    return ExposureTable(when=when, kind=kinds, **(usual | columns))  # type: ignore[arg-type]


def no_fixes() -> FixTable:
    """Return a table without rows."""
    return fix_table(Stamps.of(0), np.zeros(0), np.zeros(0))


def no_attitudes() -> AttitudeTable:
    """Return a table without rows."""
    return attitude_table(Stamps.of(0), np.zeros(0), np.zeros(0), np.zeros(0))


def no_exposures() -> ExposureTable:
    """Return a table without rows."""
    return exposure_table(Stamps.of(0), ExposureKind.FEEDBACK)
