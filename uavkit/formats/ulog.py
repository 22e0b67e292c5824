"""Flight logs of PX4 (ULog, ``.ulg``): positions, attitudes and exposures from its topics.

Sources: the topics' definitions in PX4 (CameraCapture, CameraTrigger, SensorGps and the older vehicle_gps_position,
VehicleGlobalPosition, VehicleLocalPosition, VehicleAttitude) and the modules that write them (camera_trigger,
camera_capture, camera_feedback). The format itself is read by ``uavkit.formats.ulog_file``.

* Times are of the sample where the log gives it (``timestamp_sample``), not of the publication. The boot clock is tied
  to GPS time by the pairs that the receiver gives; where there are none, by the vehicle's calendar as stamped on the
  exposures, which is noted.
* Several topics tell of the receivers: ``sensor_gps`` of each one, but PX4 by default writes it once in a second, and
  ``vehicle_gps_position`` (the receiver in use, or the mean of several) at the full rate. The denser one is taken.
* A picture stands in ``camera_capture``; its time is that of the ``camera_trigger`` that it answers. Where that one has
  feedback, the camera's flash contact was seen. Triggers without a capture are listed as such. The attitude is the
  vehicle's, but a gimbal's where there is one: then it is left out, and noted.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Indices
from uavkit.core.clock_fit import FAR_S, ClockFit, fit_clock
from uavkit.core.errors import InputError
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
    no_attitudes,
    no_exposures,
    no_fixes,
)
from uavkit.core.gpstime import NO_TIME, gps_times_ns_from_unix_ns
from uavkit.core.progress import Progress
from uavkit.formats.log_times import with_gps_times
from uavkit.formats.ulog_file import MAGIC, Rows, Topic, UlogContent, count_definitions, read_ulog

NEAR_S = 0.1
"""The estimate of the velocity is taken from as near as this."""
ANSWER_S = 2.0
"""A picture answers a trigger no later than this."""
GIMBAL_DEG = 15.0
"""Attitudes of pictures that differ by more than this from the vehicle's at the time are a gimbal's."""
GIMBAL_NEAR_S = 0.2
EARLIEST_UNIX_S = 1_234_567_890
"""PX4 sets its calendar by a receiver only after this instant (2009); receivers without time are before it."""
LATEST_UNIX_S = 7_258_118_400
"""The year 2200."""
LONGEST_BOOT_S = 10 * 365 * 86_400
UNKNOWN_SIGMA_M = 100_000.0
"""Receivers without an estimate of their precision state thousands of kilometres."""
_RECEIVER = (
    "timestamp", "timestamp_sample", "timestamp_time_relative", "time_utc_usec", "lat", "lon", "alt", "alt_ellipsoid",
    "latitude_deg", "longitude_deg", "altitude_msl_m", "altitude_ellipsoid_m", "eph", "epv", "fix_type",
    "vel_n_m_s", "vel_e_m_s", "vel_d_m_s", "vel_ned_valid", "satellites_used",
)  # fmt: skip
WANTED: Mapping[str, tuple[str, ...]] = {
    "camera_capture": ("timestamp", "timestamp_utc", "seq", "lat", "lon", "alt", "q[4]", "result"),
    "camera_trigger": ("timestamp", "timestamp_utc", "seq", "feedback"),
    "sensor_gps": _RECEIVER,
    "vehicle_gps_position": _RECEIVER,
    "vehicle_global_position": (
        "timestamp", "timestamp_sample", "lat", "lon", "alt", "alt_ellipsoid", "eph", "epv", "vel_n", "vel_e", "vel_d",
        "lat_lon_valid", "alt_valid", "alt_ellipsoid_valid",
    ),
    "vehicle_local_position": ("timestamp", "timestamp_sample", "vx", "vy", "vz", "v_xy_valid", "v_z_valid"),
    "vehicle_attitude": ("timestamp", "timestamp_sample", "q[4]"),
}  # fmt: skip
"""Topics and fields that are read; a log has those of its own time."""
LEAST_DEFINITIONS = 3
_WORDS = (b"uint64_t timestamp", b"int32_t ", b"float ")
"""Some of them stand in the definitions of every log."""


def recognises(head: bytes) -> bool:
    """Tell whether the first bytes are of a ULog; one whose header is damaged is known by its definitions."""
    if head.startswith(MAGIC):
        return True
    return any(word in head for word in _WORDS) and count_definitions(head) >= LEAST_DEFINITIONS


def read_log(path: Path, progress: Progress) -> FlightLog:
    """Read a ULog. Raises InputError where it cannot be read, or where no message in it is intact."""
    content = read_ulog(path, WANTED, progress)
    if not content.message_counts:
        raise InputError(f"{path}: no intact message of a PX4 log (ULog) is in it: download it again")
    with np.errstate(over="ignore", invalid="ignore"):  # damaged values are any bits whatsoever
        return _flight_log(path, content)


def _flight_log(path: Path, content: UlogContent) -> FlightLog:
    notes = list(content.notes)
    receivers, words = _receivers(content)
    fixes = _fixes(receivers)
    exposures, utc_ns, more = _exposures(content)
    clock, odd = _clock(receivers, exposures, utc_ns)
    notes += words + more + odd
    return FlightLog(
        source=str(path),
        kind=LogKind.ULOG,
        vehicle=_vehicle(content),
        fix_table=with_gps_times(_without_wrong_times(fixes, clock), clock),
        estimate_table=with_gps_times(_estimates(content), clock),
        attitude_table=with_gps_times(_attitudes(content), clock),
        exposure_table=with_gps_times(exposures, clock),
        clock=clock,
        message_counts=content.message_counts,
        parameters=content.parameters,
        texts=content.texts,
        damage=content.damage,
        notes=tuple(notes),
    )


def _vehicle(content: UlogContent) -> str:
    """Return system, release, hardware and the firmware's revision, as far as the log says them."""
    told = content.information
    release = told.get("ver_sw_release")
    version = f"{release >> 24}.{release >> 16 & 255}.{release >> 8 & 255}" if isinstance(release, int) else ""
    revision = str(told.get("ver_sw", ""))[:10]
    parts = (str(told.get("sys_name", "")), version, str(told.get("ver_hw", "")), revision)
    return " ".join(part.strip() for part in parts if part.strip())


def _boot_ns(rows: Rows) -> Indices:
    """Return the boot times of rows: of their samples where they are stated; NO_TIME where there is none."""
    stamp = rows["timestamp"]
    sample = _whole(rows, "timestamp_sample", 0).astype(np.uint64)
    return _boot_ns_of(np.where((sample > 0) & (sample <= stamp), sample, stamp))


def _boot_ns_of(microseconds: NDArray[np.uint64]) -> Indices:
    good = (microseconds > 0) & (microseconds < LONGEST_BOOT_S * 1_000_000)
    return np.where(good, np.where(good, microseconds, 0).astype(np.int64) * 1000, NO_TIME)


def _names(rows: Rows) -> tuple[str, ...]:
    return rows.dtype.names or ()


def _column(rows: Rows, *names: str) -> Array:
    """Return the first of the columns that the rows have, (n,), as float64; NaN for none."""
    name = next((name for name in names if name in _names(rows)), None)
    if name is None:
        return np.full(len(rows), np.nan)
    values = rows[name].astype(np.float64)
    return np.where(np.isfinite(values), values, np.nan)


def _whole(rows: Rows, name: str, unknown: int) -> Indices:
    """Return a column of whole numbers, (n,), all ``unknown`` where the rows have none."""
    if name not in _names(rows) or not np.issubdtype(rows[name].dtype, np.integer):
        return np.full(len(rows), unknown, dtype=np.int64)
    return rows[name].astype(np.int64)


def _scaled(rows: Rows, name: str, older: str, scale: float) -> Array:
    """Return a column in its unit, or an older one that is multiplied by ``scale`` where it is an integer."""
    if name in _names(rows) or older not in _names(rows):
        return _column(rows, name)
    whole = np.issubdtype(rows[older].dtype, np.integer)
    return _column(rows, older) * scale if whole else _column(rows, older)


def _holds(rows: Rows, name: str) -> NDArray[np.bool_]:
    """Return a flag's column, all true where the log has none."""
    return rows[name] != 0 if name in _names(rows) else np.ones(len(rows), dtype=np.bool_)


def _sigma(rows: Rows, name: str) -> Array:
    sigma_m = _column(rows, name)
    return np.where((sigma_m > 0.0) & (sigma_m < UNKNOWN_SIGMA_M), sigma_m, np.nan)


def _place(rows: Rows) -> tuple[Array, Array]:
    """Return latitude and longitude in degrees, NaN where they are no place."""
    latitude_deg = _scaled(rows, "latitude_deg", "lat", 1e-7)
    longitude_deg = _scaled(rows, "longitude_deg", "lon", 1e-7)
    nowhere = (latitude_deg == 0.0) & (longitude_deg == 0.0)
    good = (np.abs(latitude_deg) <= 90.0) & (np.abs(longitude_deg) <= 180.0) & ~nowhere
    return np.where(good, latitude_deg, np.nan), np.where(good, longitude_deg, np.nan)


def _receivers(content: UlogContent) -> tuple[tuple[Topic, ...], list[str]]:
    """Return the topic's instances that tell of the receivers, and a note where one had to be chosen."""
    each, chosen = content.of("sensor_gps"), content.of("vehicle_gps_position")
    if not each or not chosen:
        return each or chosen, []
    rows_each, rows_chosen = (max(len(topic.rows) for topic in topics) for topics in (each, chosen))
    if rows_chosen > 1.2 * rows_each:
        return chosen, [f"positions are those of vehicle_gps_position; sensor_gps has {rows_each} of {rows_chosen}"]
    return each, []


def _fixes(receivers: tuple[Topic, ...]) -> FixTable:
    """Return the positions of all receivers in the order of time."""
    if not receivers:
        return no_fixes()
    tables = [_fixes_of(topic) for topic in receivers]
    if len(tables) == 1:
        return tables[0]
    order = np.argsort(np.concatenate([table.when.boot_ns for table in tables]), kind="stable")

    def merged(name: str) -> Any:
        return np.concatenate([getattr(table, name) for table in tables])[order]

    gps_ns = np.concatenate([table.when.gps_ns for table in tables])[order]
    boot_ns = np.concatenate([table.when.boot_ns for table in tables])[order]
    names = (
        "height_ellipsoid_m", "height_geoid_m", "velocity_m_s", "sigma_horizontal_m", "sigma_vertical_m", "fix_type",
        "satellites", "receiver",
    )  # fmt: skip
    return fix_table(
        Stamps.of(len(order), gps_ns=gps_ns, boot_ns=boot_ns),
        merged("latitude_deg"),
        merged("longitude_deg"),
        **{name: merged(name) for name in names},
    )


def _fixes_of(topic: Topic) -> FixTable:
    rows = topic.rows
    latitude_deg, longitude_deg = _place(rows)
    velocity_m_s = np.column_stack(
        [_column(rows, "vel_e_m_s"), _column(rows, "vel_n_m_s"), -_column(rows, "vel_d_m_s")]
    )
    velocity_m_s[~_holds(rows, "vel_ned_valid")] = np.nan
    ellipsoid_m = _scaled(rows, "altitude_ellipsoid_m", "alt_ellipsoid", 1e-3)
    boot_ns = _boot_ns(rows)
    told_boot_ns, gps_ns = _time_pairs(rows)
    both = (boot_ns != NO_TIME) & (told_boot_ns != NO_TIME) & (gps_ns != NO_TIME)
    own_ns = np.where(both, gps_ns + np.where(both, boot_ns - told_boot_ns, 0), NO_TIME)
    return fix_table(
        Stamps.of(len(rows), boot_ns=boot_ns, gps_ns=own_ns),
        latitude_deg,
        longitude_deg,
        height_ellipsoid_m=np.where(ellipsoid_m == 0.0, np.nan, ellipsoid_m),
        height_geoid_m=_scaled(rows, "altitude_msl_m", "alt", 1e-3),
        velocity_m_s=velocity_m_s,
        sigma_horizontal_m=_sigma(rows, "eph"),
        sigma_vertical_m=_sigma(rows, "epv"),
        fix_type=_fix_types(rows),
        satellites=np.clip(_whole(rows, "satellites_used", 255), 0, 255).astype(np.uint8),
        receiver=np.full(len(rows), topic.instance, dtype=np.uint8),
    )


def _fix_types(rows: Rows) -> NDArray[np.uint8]:
    """Return MAVLink's numbers of PX4's, which are the same but for 8: extrapolated, so nothing was measured."""
    told = _whole(rows, "fix_type", int(FixType.UNKNOWN))
    known = np.where((told >= 0) & (told <= FixType.RTK_FIXED), told, FixType.UNKNOWN)
    return np.where(told == 8, FixType.NO_FIX, known).astype(np.uint8)


def _clock(
    receivers: tuple[Topic, ...], exposures: ExposureTable, utc_ns: Indices
) -> tuple[ClockFit | None, list[str]]:
    """Return what ties the boot clock to GPS time, and what was found odd."""
    pairs = [_time_pairs(topic.rows) for topic in receivers]
    boot_ns = np.concatenate([np.zeros(0, dtype=np.int64), *(boot for boot, _ in pairs)])
    gps_ns = np.concatenate([np.zeros(0, dtype=np.int64), *(gps for _, gps in pairs)])
    clock = fit_clock(boot_ns, gps_ns)
    if clock is not None:
        odd = f"{clock.rejected} times of the receiver are not those of the others: left out"
        return clock, [odd] if clock.rejected else []
    clock = fit_clock(exposures.when.boot_ns, utc_ns)
    if clock is None:
        return None, ["no receiver's time is in the log: GPS times are unknown"]
    return clock, ["no receiver's time is in the log: GPS times are those of the vehicle's calendar"]


def _time_pairs(rows: Rows) -> tuple[Indices, Indices]:
    """Return boot times and GPS times of the same instants, (n,) each.

    The UTC of a row is that of ``timestamp`` plus ``timestamp_time_relative``.
    """
    boot_ns, own_ns = _boot_ns(rows), _boot_ns_of(rows["timestamp"])
    relative_ns = _whole(rows, "timestamp_time_relative", 0) * 1000
    moved = (relative_ns != 0) & (own_ns != NO_TIME)
    return np.where(moved, own_ns + np.where(moved, relative_ns, 0), boot_ns), _calendar(rows, "time_utc_usec")


def _without_wrong_times(table: FixTable, clock: ClockFit | None) -> FixTable:
    """Return positions without the receiver's times that are far from the clock's: it did not know the time yet."""
    if clock is None:
        return table
    when = table.when
    both = (when.gps_ns != NO_TIME) & (when.boot_ns != NO_TIME)
    away_ns = np.where(both, when.gps_ns - clock.gps_ns(when.boot_ns), 0)
    gps_ns = np.where(np.abs(away_ns) > FAR_S * 1e9, NO_TIME, when.gps_ns)
    return replace(table, when=replace(when, gps_ns=gps_ns))


def _estimates(content: UlogContent) -> FixTable:
    """Return the autopilot's estimates, their velocity from the local position of nearly the same time."""
    topics = content.of("vehicle_global_position")
    if not topics:
        return no_fixes()
    rows = topics[0].rows
    latitude_deg, longitude_deg = _place(rows)
    nowhere = ~_holds(rows, "lat_lon_valid")
    when = Stamps.of(len(rows), boot_ns=_boot_ns(rows))
    ellipsoid_m = _column(rows, "alt_ellipsoid")
    known = _holds(rows, "alt_ellipsoid_valid") & (ellipsoid_m != 0.0)
    velocity_m_s = np.column_stack([_column(rows, "vel_e"), _column(rows, "vel_n"), -_column(rows, "vel_d")])
    if "vel_n" not in _names(rows):
        velocity_m_s = _velocities(content, when.boot_ns)
    return fix_table(
        when,
        np.where(nowhere, np.nan, latitude_deg),
        np.where(nowhere, np.nan, longitude_deg),
        height_ellipsoid_m=np.where(known, ellipsoid_m, np.nan),
        height_geoid_m=np.where(_holds(rows, "alt_valid"), _column(rows, "alt"), np.nan),
        velocity_m_s=velocity_m_s,
        sigma_horizontal_m=_sigma(rows, "eph"),
        sigma_vertical_m=_sigma(rows, "epv"),
    )


def _velocities(content: UlogContent, boot_ns: Indices) -> Array:
    """Return the velocities east, north, up of the local position nearest in time, (n, 3); NaN where none is near."""
    topics = content.of("vehicle_local_position")
    if not topics:
        return np.full((len(boot_ns), 3), np.nan)
    rows = topics[0].rows
    east = np.where(_holds(rows, "v_xy_valid"), _column(rows, "vy"), np.nan)
    north = np.where(_holds(rows, "v_xy_valid"), _column(rows, "vx"), np.nan)
    up = np.where(_holds(rows, "v_z_valid"), -_column(rows, "vz"), np.nan)
    row, near = _nearest(_boot_ns(rows), boot_ns, NEAR_S)
    velocity_m_s = np.column_stack([east, north, up])[row]
    velocity_m_s[~near] = np.nan
    return velocity_m_s


def _nearest(times_ns: Indices, asked_ns: Indices, most_s: float) -> tuple[Indices, NDArray[np.bool_]]:
    """Return the rows of ``times_ns``, (m,) in any order, nearest to those asked, (n,), and whether they are near."""
    order = np.argsort(times_ns, kind="stable")
    ordered = times_ns[order]
    after = np.clip(np.searchsorted(ordered, asked_ns), 1, max(len(ordered) - 1, 1))
    before, after = np.minimum(after - 1, len(ordered) - 1), np.minimum(after, len(ordered) - 1)
    sooner = np.abs(asked_ns - ordered[before]) <= np.abs(ordered[after] - asked_ns)
    place = np.where(sooner, before, after)
    known = (ordered[place] != NO_TIME) & (asked_ns != NO_TIME)
    return order[place], known & (np.abs(ordered[place] - asked_ns) <= most_s * 1e9)


def _attitudes(content: UlogContent) -> AttitudeTable:
    topics = content.of("vehicle_attitude")
    if not topics or "q" not in _names(topics[0].rows):
        return no_attitudes()
    rows = topics[0].rows
    roll_rad, pitch_rad, yaw_rad = _angles(rows["q"])
    return attitude_table(Stamps.of(len(rows), boot_ns=_boot_ns(rows)), roll_rad, pitch_rad, yaw_rad)


def _angles(quaternions: NDArray[np.float32]) -> tuple[Array, Array, Array]:
    """Return roll, pitch, yaw, (n,) rad, of quaternions w x y z, (n, 4), from forward-right-down to north-east-down.

    R = Rz(yaw) Ry(pitch) Rx(roll); NaN where a quaternion is not of unit length.
    """
    q = quaternions.astype(np.float64)
    length = np.sqrt(np.sum(q**2, axis=1))
    q = np.where((np.abs(length - 1.0) < 0.01)[:, None], q / np.where(length > 0.0, length, 1.0)[:, None], np.nan)
    w, x, y, z = q.T
    roll_rad = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch_rad = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw_rad = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll_rad, pitch_rad, yaw_rad


@dataclass(frozen=True, slots=True, kw_only=True)
class _Events:
    """Rows of camera_capture or camera_trigger that are one exposure each."""

    rows: Rows
    boot_ns: Indices
    notes: list[str]


def _events(content: UlogContent, name: str) -> _Events:
    """Return a topic's rows without empty and repeated ones, in the order of the file."""
    topics = content.of(name)
    if not topics:
        return _Events(rows=np.zeros(0, dtype=[("timestamp", "<u8")]), boot_ns=np.zeros(0, dtype=np.int64), notes=[])
    rows = np.concatenate([topic.rows for topic in topics]) if len(topics) > 1 else topics[0].rows
    boot_ns = _boot_ns(rows)
    timeless = boot_ns == NO_TIME
    first = np.zeros(len(rows), dtype=np.bool_)
    first[np.unique(boot_ns, return_index=True)[1]] = True
    notes = [f"{name}: {int(timeless.sum())} without a time (PX4 begins with an empty one): left out"]
    twice = int(np.sum(~first & ~timeless))
    notes = (notes if timeless.any() else []) + ([f"{name}: {twice} repeated: listed once"] if twice else [])
    good = first & ~timeless
    return _Events(rows=rows[good], boot_ns=boot_ns[good], notes=notes)


def _exposures(content: UlogContent) -> tuple[ExposureTable, Indices, list[str]]:
    """Return the exposures in the order of time, the vehicle's calendar for each as GPS time, and notes."""
    captured, asked = _events(content, "camera_capture"), _events(content, "camera_trigger")
    notes = captured.notes + asked.notes
    failed = _whole(captured.rows, "result", 1) == 0
    if failed.any():
        notes.append(f"camera_capture: {int(failed.sum())} failed: no exposures")
    taken = captured.rows[~failed]
    taken_ns = captured.boot_ns[~failed]
    left = _unanswered(asked, captured.boot_ns)
    if not len(taken) and not left.any():
        return no_exposures(), np.zeros(0, dtype=np.int64), notes
    if len(taken) and left.any():
        notes.append(f"camera_trigger: {int(left.sum())} without a picture in camera_capture: listed too")
    kinds = np.concatenate([_kinds_captured(taken, taken_ns, asked), _kinds_asked(asked.rows[left])])
    boot_ns = np.concatenate([taken_ns, asked.boot_ns[left]])
    order = np.argsort(boot_ns, kind="stable")
    captures = _capture_columns(taken)
    if _is_of_gimbal(content, taken, taken_ns):
        notes.append("camera_capture: attitudes are not the vehicle's but a gimbal's: left out")
        captures |= {name: np.full(len(taken), np.nan) for name in ("roll_rad", "pitch_rad", "yaw_rad")}
    columns = {
        name: np.concatenate([values, np.full(int(left.sum()), np.nan)])[order] for name, values in captures.items()
    }
    counted = np.concatenate([_whole(taken, "seq", -1), _whole(asked.rows[left], "seq", -1)])[order]
    calendar = np.concatenate([_calendar(taken, "timestamp_utc"), _calendar(asked.rows[left], "timestamp_utc")])[order]
    when = Stamps.of(len(order), boot_ns=boot_ns[order])
    return exposure_table(when, kinds[order], sequence=counted, **columns), calendar, notes


def _is_of_gimbal(content: UlogContent, taken: Rows, taken_ns: Indices) -> bool:
    """Tell whether the attitudes of the pictures are other than the vehicle's: PX4 writes a gimbal's where it has one.

    The angle between both is 2 acos |q1 . q2|; the median over the pictures counts.
    """
    topics = content.of("vehicle_attitude")
    if not topics or not len(taken) or "q" not in _names(taken) or "q" not in _names(topics[0].rows):
        return False
    row, near = _nearest(_boot_ns(topics[0].rows), taken_ns, GIMBAL_NEAR_S)
    dot = np.abs(np.sum(topics[0].rows["q"][row].astype(np.float64) * taken["q"].astype(np.float64), axis=1))
    angle_deg = np.degrees(2.0 * np.arccos(np.clip(dot[near], 0.0, 1.0)))
    return bool(len(angle_deg) and np.median(angle_deg) > GIMBAL_DEG)


def _unanswered(asked: _Events, taken_ns: Indices) -> NDArray[np.bool_]:
    """Return which triggers no picture answers, (t,).

    A picture has the time of the trigger that it answers. With feedback that is the flash contact's, and the request
    before it, listed too by older firmware, is answered by it as well: the last one before it within ANSWER_S.
    """
    answered = np.isin(asked.boot_ns, taken_ns)
    feedback = _feedback(asked.rows)
    requests = np.flatnonzero(~feedback & ~answered)
    requests = requests[np.argsort(asked.boot_ns[requests], kind="stable")]
    times = asked.boot_ns[requests]
    exact = asked.boot_ns[~feedback & answered]
    seen = np.unique(np.concatenate([asked.boot_ns[feedback], taken_ns[~np.isin(taken_ns, exact)]]))
    before = np.searchsorted(times, seen, side="right") - 1
    near = (before >= 0) & (seen - times[np.maximum(before, 0)] <= ANSWER_S * 1e9) if len(times) else before >= 0
    answered[requests[before[near]]] = True
    return ~answered


def _feedback(rows: Rows) -> NDArray[np.bool_]:
    return np.asarray(_whole(rows, "feedback", 0) != 0, dtype=np.bool_)


def _kinds_captured(rows: Rows, boot_ns: Indices, asked: _Events) -> NDArray[np.uint8]:
    """Return the kinds of pictures: FEEDBACK where their trigger is the flash contact's, TRIGGER without an answer."""
    contact = np.isin(boot_ns, asked.boot_ns[_feedback(asked.rows)])
    blind = _whole(rows, "result", 1) < 0
    kinds = np.where(blind, ExposureKind.TRIGGER, ExposureKind.CAPTURED)
    return np.where(contact, ExposureKind.FEEDBACK, kinds).astype(np.uint8)


def _kinds_asked(rows: Rows) -> NDArray[np.uint8]:
    return np.where(_feedback(rows), ExposureKind.FEEDBACK, ExposureKind.TRIGGER).astype(np.uint8)


def _capture_columns(rows: Rows) -> dict[str, Array]:
    """Return where the vehicle was, and how it lay, at the pictures."""
    latitude_deg, longitude_deg = _place(rows)
    q = rows["q"] if "q" in _names(rows) else np.zeros((len(rows), 4), dtype=np.float32)
    roll_rad, pitch_rad, yaw_rad = _angles(q)
    return {
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "height_geoid_m": _column(rows, "alt"),
        "roll_rad": roll_rad,
        "pitch_rad": pitch_rad,
        "yaw_rad": yaw_rad,
    }


def _calendar(rows: Rows, name: str) -> Indices:
    """Return the GPS times of a column of UTC in microseconds of Unix time, (n,); NO_TIME where it was not set yet."""
    utc_us = _whole(rows, name, 0)
    good = (utc_us > EARLIEST_UNIX_S * 1_000_000) & (utc_us < LATEST_UNIX_S * 1_000_000)
    return gps_times_ns_from_unix_ns(np.where(good, np.where(good, utc_us, 0) * 1000, NO_TIME))
