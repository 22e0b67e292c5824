"""The tables of a flight log from the raw fields of MAVLink messages.

Fields, units and special values are those of MAVLink's message definitions (common.xml, ardupilotmega.xml). What
the definitions leave open was taken from the sources of the autopilots and from recorded flights: GPS_RAW_INT.time_usec
is the boot time of the fix (its epoch, where the receiver's driver corrects for the delay) in ArduPilot and PX4;
CAMERA_FEEDBACK.time_usec is the exposure's time, of either clock; CAMERA_IMAGE_CAPTURED.relative_alt is above home in
ArduPilot and above the ground in PX4.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.flight_log import (
    AttitudeTable,
    ExposureKind,
    ExposureTable,
    FixTable,
    FixType,
    Stamps,
    attitude_table,
    exposure_table,
    fix_table,
)
from uavkit.core.gpstime import NO_TIME, gps_times_ns_from_unix_ns
from uavkit.formats.mavlink_messages import (
    CAMERA_FEEDBACK,
    CAMERA_IMAGE_CAPTURED,
    CAMERA_TRIGGER,
    GPS2_RAW,
    GPS_RAW_INT,
    SYSTEM_TIME,
)
from uavkit.formats.tlog_rows import Rows, first_copies
from uavkit.formats.tlog_times import (
    ClockSource,
    Meaning,
    VehicleTime,
    boot_ns,
    event_times,
    host_lead_ns,
    unix_ns,
)

PX4 = 12
FEEDBACK_SIGMA_S = 0.001
"""Of a flash contact seen by an autopilot, which looks at its pin from an interrupt or once a millisecond."""
TRIGGER_SIGMA_S = 0.05
"""Of a command to the shutter: how its delay differs from one exposure to the next, where nothing measures it."""
RECEPTION_SIGMA_S = 0.5
"""Of an exposure of which no more is known than when the message about it came: the delay of a telemetry radio."""
_FAR_NS = 60_000_000_000
"""A message about an exposure comes sooner; what lies farther from its reception is another clock's time."""
_SAME_NS = 300_000_000
"""Two reports of one exposure are no farther apart, unless they bear the same number."""
_SAME_NUMBER_NS = 1_000_000_000
_FAILED, _SUCCESS = 0, 1
_FIRST_CAMERA = 100
"""MAV_COMP_ID_CAMERA."""
_FIX_TYPES = np.array([0, 1, 2, 3, 4, 5, 6, FixType.THREE_DIMENSIONAL, FixType.DIFFERENTIAL], dtype=np.uint8)
"""By MAVLink's GPS_FIX_TYPE; 7 is a base station's, 8 precise point positioning."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pilot:
    """What of the vehicle decides how its messages are meant."""

    autopilot: int
    parameters: Mapping[str, float]

    @property
    def feedback_pin(self) -> bool:
        """Whether the parameters say that a flash contact is connected (ArduPilot)."""
        names = ("CAM_FEEDBACK_PIN", "CAM1_FEEDBAK_PIN", "CAM_FEEDBAK_PIN")
        return any(self.parameters.get(name, -1.0) > 0 for name in names)


def attitudes(rows: Rows, vehicle: VehicleTime) -> AttitudeTable:
    """Return the table of ATTITUDE messages (radians)."""
    rows = rows.where(first_copies(rows))
    f = rows.fields
    return attitude_table(_boot_stamps(rows, vehicle), _float(f["roll"]), _float(f["pitch"]), _float(f["yaw"]))


def estimates(rows: Rows, vehicle: VehicleTime) -> FixTable:
    """Return the table of GLOBAL_POSITION_INT messages: degrees 1e-7, mm, cm/s north east down."""
    rows = rows.where(first_copies(rows))
    f = rows.fields
    latitude, longitude = _degrees(f["lat"], f["lon"])
    velocity = np.column_stack([_float(f["vy"]), _float(f["vx"]), -_float(f["vz"])]) * 0.01
    nowhere = np.isnan(latitude)
    return fix_table(
        _boot_stamps(rows, vehicle), latitude, longitude,
        height_geoid_m=np.where(nowhere, np.nan, _float(f["alt"]) * 1e-3),
        height_above_home_m=np.where(nowhere, np.nan, _float(f["relative_alt"]) * 1e-3),
        velocity_m_s=velocity,
    )  # fmt: skip


def fixes(rows: Mapping[int, Rows], vehicle: VehicleTime) -> FixTable:
    """Return the table of GPS_RAW_INT (receiver 0) and GPS2_RAW (receiver 1) messages, in the order of the file."""
    first, second = (_receiver_fixes(rows[number], vehicle, k) for k, number in enumerate((GPS_RAW_INT, GPS2_RAW)))
    if len(second[0]) == 0:
        return first[0]
    order = np.argsort(np.concatenate([first[1], second[1]]), kind="stable")
    return _fix_rows(first[0], second[0], order)


def _receiver_fixes(rows: Rows, vehicle: VehicleTime, receiver: int) -> tuple[FixTable, Indices]:
    rows = rows.where(first_copies(rows) | (rows.fields["time_usec"] == 0))
    f = rows.fields
    gps, boot, _ = event_times(f["time_usec"], rows, vehicle)
    latitude, longitude = _degrees(f["lat"], f["lon"])
    nowhere = np.isnan(latitude)
    speed = np.where(f["vel"] == 65535, np.nan, _float(f["vel"]) * 0.01)
    course = np.where(f["cog"] == 65535, np.nan, np.radians(_float(f["cog"]) * 0.01))
    velocity = np.column_stack([speed * np.sin(course), speed * np.cos(course), np.full(len(rows), np.nan)])
    velocity[f["fix_type"] < FixType.TWO_DIMENSIONAL] = np.nan
    kinds = np.minimum(f["fix_type"], len(_FIX_TYPES) - 1)
    table = fix_table(
        Stamps(gps_ns=gps, boot_ns=boot, host_ns=rows.host_ns), latitude, longitude,
        height_ellipsoid_m=np.where(nowhere, np.nan, _told(f["alt_ellipsoid"]) * 1e-3),
        height_geoid_m=np.where(nowhere, np.nan, _float(f["alt"]) * 1e-3),
        velocity_m_s=velocity,
        sigma_horizontal_m=_told(f["h_acc"]) * 1e-3,
        sigma_vertical_m=_told(f["v_acc"]) * 1e-3,
        fix_type=np.where(f["fix_type"] < len(_FIX_TYPES), _FIX_TYPES[kinds], FixType.UNKNOWN).astype(np.uint8),
        satellites=f["satellites_visible"].astype(np.uint8),
        receiver=np.full(len(rows), receiver, dtype=np.uint8),
    )  # fmt: skip
    return table, rows.offset


def _fix_rows(a: FixTable, b: FixTable, order: Indices) -> FixTable:
    def both(name: str) -> NDArray[np.generic]:
        column: NDArray[np.generic] = np.concatenate([getattr(a, name), getattr(b, name)])[order]
        return column

    when = {
        name: np.concatenate([getattr(t.when, name) for t in (a, b)])[order]
        for name in ("gps_ns", "boot_ns", "host_ns")
    }
    names = (
        "latitude_deg", "longitude_deg", "height_ellipsoid_m", "height_geoid_m", "height_above_home_m",
        "velocity_m_s", "sigma_horizontal_m", "sigma_vertical_m", "fix_type", "satellites", "receiver",
    )  # fmt: skip
    return FixTable(when=Stamps(**when), **{name: both(name) for name in names})  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Reports:
    """Reports of exposures by one kind of message."""

    table: ExposureTable
    offset: Indices
    """(n,) of the message."""
    camera: Indices
    """(n,) number."""


def exposures(rows: Mapping[int, Rows], vehicle: VehicleTime, pilot: Pilot, notes: list[str]) -> ExposureTable:
    """Return the exposures of the first camera, each once, in the order of the file; what was decided goes to notes."""
    reports = [_feedback(rows, vehicle, pilot, notes), _captured(rows, vehicle, pilot, notes)]
    reports.append(_triggers(rows, vehicle, notes))
    camera = _first_camera(reports, notes)
    kept = list[_Reports]()
    for report in reports:
        mask = (report.camera == camera) | (report.camera < 0)
        for surer in kept:
            mask[mask] = _not_among(_part(report, mask), surer)
        kept.append(_part(report, mask))
    order = np.argsort(np.concatenate([report.offset for report in kept]), kind="stable")
    return _exposure_rows([report.table for report in kept], order)


def _feedback(rows: Mapping[int, Rows], vehicle: VehicleTime, pilot: Pilot, notes: list[str]) -> _Reports:
    """CAMERA_FEEDBACK: degrees 1e-7, m, degrees. Without a flash contact it tells when the shutter was asked for."""
    part = _once(rows[CAMERA_FEEDBACK], "CAMERA_FEEDBACK", notes)
    f = part.fields
    gps, boot, meaning = event_times(f["time_usec"], part, vehicle)
    # ArduPilot 4.6 counts completed captures and stamps by the boot clock only where a flash contact is set up.
    contact = pilot.feedback_pin | (meaning == Meaning.BOOT) | (f["completed_captures"] > 0)
    kind = np.where(contact, ExposureKind.FEEDBACK, ExposureKind.TRIGGER).astype(np.uint8)
    sigma = np.where(contact, FEEDBACK_SIGMA_S, TRIGGER_SIGMA_S)
    when, sigma = _checked_times(part, (gps, boot), sigma, vehicle, rows, notes)
    _say_meaning("CAMERA_FEEDBACK", meaning, notes)
    latitude, longitude = _degrees(f["lat"], f["lng"])
    nowhere = np.isnan(latitude)
    table = exposure_table(
        when, kind, sigma_s=sigma, sequence=f["img_idx"].astype(np.int64), latitude_deg=latitude,
        longitude_deg=longitude,
        height_geoid_m=np.where(nowhere, np.nan, _float(f["alt_msl"])),
        height_above_home_m=np.where(nowhere, np.nan, _float(f["alt_rel"])),
        roll_rad=np.radians(_float(f["roll"])), pitch_rad=np.radians(_float(f["pitch"])),
        yaw_rad=np.radians(_float(f["yaw"])),
    )  # fmt: skip
    return _Reports(table=table, offset=part.offset, camera=f["cam_idx"].astype(np.int64))


def _captured(rows: Mapping[int, Rows], vehicle: VehicleTime, pilot: Pilot, notes: list[str]) -> _Reports:
    """CAMERA_IMAGE_CAPTURED: degrees 1e-7, mm, a quaternion w x y z from the vehicle's axes to north east down."""
    part = _once(rows[CAMERA_IMAGE_CAPTURED], "CAMERA_IMAGE_CAPTURED", notes)
    failed = part.fields["capture_result"] == _FAILED
    if failed.any():
        notes.append(f"{int(failed.sum())} CAMERA_IMAGE_CAPTURED say that the capture failed: no exposures")
    part = part.where(~failed)
    f = part.fields
    boot = boot_ns(f["time_boot_ms"])
    by_utc = gps_times_ns_from_unix_ns(unix_ns(f["time_utc"]))
    by_clock = vehicle.gps_ns(boot, part.offset)
    gps = _utc_or_clock(by_utc, by_clock)
    kind = np.where(f["capture_result"] == _SUCCESS, ExposureKind.CAPTURED, ExposureKind.TRIGGER).astype(np.uint8)
    sigma_s = np.where(kind == ExposureKind.TRIGGER, TRIGGER_SIGMA_S, np.nan)
    when, sigma = _checked_times(part, (gps, boot), sigma_s, vehicle, rows, notes)
    latitude, longitude = _degrees(f["lat"], f["lon"])
    nowhere = np.isnan(latitude)
    above_home = np.where(nowhere | (pilot.autopilot == PX4), np.nan, _float(f["relative_alt"]) * 1e-3)
    roll, pitch, yaw = _angles(f["q"])
    table = exposure_table(
        when, kind, sigma_s=sigma, sequence=f["image_index"].astype(np.int64), latitude_deg=latitude,
        longitude_deg=longitude,
        height_geoid_m=np.where(nowhere, np.nan, _float(f["alt"]) * 1e-3), height_above_home_m=above_home,
        roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw,
    )  # fmt: skip
    # Cameras are told apart by their components, from 100 on; an autopilot's own have numbers from 1 in the message.
    own = (part.component >= _FIRST_CAMERA) & (part.component < _FIRST_CAMERA + 6)
    number = np.maximum(f["camera_id"].astype(np.int64) - 1, 0)
    camera = np.where(own, part.component.astype(np.int64) - _FIRST_CAMERA, number)
    return _Reports(table=table, offset=part.offset, camera=camera)


def _triggers(rows: Mapping[int, Rows], vehicle: VehicleTime, notes: list[str]) -> _Reports:
    """CAMERA_TRIGGER: time and number only. PX4 begins with one that is all zeros."""
    part = _once(rows[CAMERA_TRIGGER], "CAMERA_TRIGGER", notes)
    empty = part.fields["time_usec"] == 0
    if empty.any():
        notes.append(f"{int(empty.sum())} CAMERA_TRIGGER without a time left out")
    part = part.where(~empty)
    gps, boot, meaning = event_times(part.fields["time_usec"], part, vehicle)
    _say_meaning("CAMERA_TRIGGER", meaning, notes)
    sigma_s = np.full(len(part), TRIGGER_SIGMA_S)
    when, sigma = _checked_times(part, (gps, boot), sigma_s, vehicle, rows, notes)
    sequence = part.fields["seq"].astype(np.int64)
    table = exposure_table(when, ExposureKind.TRIGGER, sigma_s=sigma, sequence=sequence)
    return _Reports(table=table, offset=part.offset, camera=np.full(len(part), -1, dtype=np.int64))


def _once(rows: Rows, name: str, notes: list[str]) -> Rows:
    first = first_copies(rows, anywhere=True)
    if not first.all():
        notes.append(f"{int(np.sum(~first))} repeated {name} counted once")
    return rows.where(first)


def _checked_times(
    part: Rows, times: tuple[Indices, Indices], sigma_s: Array, vehicle: VehicleTime, rows: Mapping[int, Rows],
    notes: list[str],
) -> tuple[Stamps, Array]:  # fmt: skip
    """Return stamps and sigmas of exposures; where no time of their own is to be believed, that of reception."""
    gps, boot = times
    boot_then = vehicle.boot_at_ns(part.offset)
    expected = vehicle.gps_ns(boot_then, part.offset)
    boot_known = (boot != NO_TIME) & (boot_then != NO_TIME)
    far_boot = boot_known & (np.abs(np.where(boot_known, boot - boot_then, 0)) > _FAR_NS)
    both = (gps != NO_TIME) & (expected != NO_TIME)
    far = far_boot | (both & (np.abs(np.where(both, gps, 0) - np.where(both, expected, 0)) > _FAR_NS))
    if far.any():
        notes.append(
            f"{int(far.sum())} exposures bear times of a clock that is not the vehicle's: time of reception used"
        )
    timeless = far | ((gps == NO_TIME) & (boot == NO_TIME))
    boot = np.where(timeless, NO_TIME, boot)
    gps = np.where(timeless, _reception_gps_ns(part, rows), gps)
    if (timeless & ~far).any():
        notes.append(f"{int((timeless & ~far).sum())} exposures bear no time: time of reception used")
    sigma = np.where(timeless, RECEPTION_SIGMA_S, sigma_s)
    by_host = ~timeless & (boot != NO_TIME) & _by_host(part, vehicle)
    sigma = np.where(by_host, np.hypot(np.nan_to_num(sigma), _host_sigma_s(vehicle)), sigma)
    return Stamps(gps_ns=gps, boot_ns=boot, host_ns=part.host_ns), np.asarray(sigma, dtype=np.float64)


def _reception_gps_ns(part: Rows, rows: Mapping[int, Rows]) -> Indices:
    lead = host_lead_ns(rows[SYSTEM_TIME])
    lead_ns = 0 if len(lead) == 0 else int(np.median(lead))
    return gps_times_ns_from_unix_ns(np.where(part.host_ns == NO_TIME, NO_TIME, part.host_ns - lead_ns))


def _by_host(part: Rows, vehicle: VehicleTime) -> Flags:
    """Tell (n,) whether only the receiving computer's clock ties the session of a message to GPS time."""
    sources = np.array([session.source is ClockSource.HOST for session in vehicle.sessions], dtype=np.bool_)
    return np.asarray(sources[vehicle.session(part.offset)], dtype=np.bool_)


def _host_sigma_s(vehicle: VehicleTime) -> float:
    """Return the spread of the link's delay, which is what such times are wrong by from one to the next."""
    spreads = [s.clock.residual_s for s in vehicle.sessions if s.source is ClockSource.HOST and s.clock is not None]
    return max([0.01, *spreads])


def _utc_or_clock(by_utc: Indices, by_clock: Indices) -> Indices:
    """Return the message's own UTC where the vehicle's clock does not contradict it, else the clock's time."""
    both = (by_utc != NO_TIME) & (by_clock != NO_TIME)
    agree = np.abs(np.where(both, by_utc - np.where(both, by_clock, 0), 0)) < _FAR_NS
    return np.where((by_utc != NO_TIME) & agree, by_utc, by_clock)


def _say_meaning(name: str, meaning: NDArray[np.uint8], notes: list[str]) -> None:
    words = {Meaning.BOOT: "the start of the vehicle", Meaning.UNIX: "1970", Meaning.GPS: "1980 (GPS time)"}
    found = [f"{words[m]} ({int(np.sum(meaning == m))})" for m in words if bool(np.any(meaning == m))]
    if found:
        notes.append(f"{name}.time_usec counts from {', '.join(found)}")


def _first_camera(reports: list[_Reports], notes: list[str]) -> int:
    numbers, counts = np.unique(np.concatenate([r.camera[r.camera >= 0] for r in reports]), return_counts=True)
    if len(numbers) == 0:
        return 0
    if len(numbers) > 1:
        told = ", ".join(f"{n + 1} ({c} reports)" for n, c in zip(numbers.tolist(), counts.tolist(), strict=True))
        notes.append(f"exposures of several cameras: {told}; only those of the first are used")
    return int(numbers[0])


def _part(reports: _Reports, rows: Flags) -> _Reports:
    return _Reports(
        table=_exposure_rows([reports.table], np.flatnonzero(rows)),
        offset=reports.offset[rows],
        camera=reports.camera[rows],
    )


def _not_among(reports: _Reports, surer: _Reports) -> Flags:
    """Return a mask (n,) without the reports of exposures that surer ones report as well, each of which takes one."""
    keep = np.ones(len(reports.offset), dtype=np.bool_)
    time, other = (_comparable_ns(table) for table in (reports.table, surer.table))
    taken = np.zeros(len(other), dtype=np.bool_)
    order = np.argsort(other, kind="stable")
    ordered = other[order]
    for row in np.flatnonzero(time != NO_TIME).tolist():
        first, last = np.searchsorted(ordered, [time[row] - _SAME_NUMBER_NS, time[row] + _SAME_NUMBER_NS])
        near = order[first:last]
        near = near[~taken[near] & (other[near] != NO_TIME)]
        apart = np.abs(other[near] - time[row])
        same_number = surer.table.sequence[near] == reports.table.sequence[row]
        near, apart = near[same_number | (apart < _SAME_NS)], apart[same_number | (apart < _SAME_NS)]
        if len(near):
            taken[near[np.argmin(apart)]] = True
            keep[row] = False
    return keep


def _comparable_ns(table: ExposureTable) -> Indices:
    return np.where(table.when.gps_ns != NO_TIME, table.when.gps_ns, table.when.boot_ns)


def _exposure_rows(tables: list[ExposureTable], order: Indices) -> ExposureTable:
    def all_of(name: str) -> NDArray[np.generic]:
        column: NDArray[np.generic] = np.concatenate([getattr(table, name) for table in tables])[order]
        return column

    when = {
        name: np.concatenate([getattr(table.when, name) for table in tables])[order]
        for name in ("gps_ns", "boot_ns", "host_ns")
    }
    names = (
        "sigma_s", "kind", "sequence", "latitude_deg", "longitude_deg", "height_ellipsoid_m", "height_geoid_m",
        "height_above_home_m", "roll_rad", "pitch_rad", "yaw_rad",
    )  # fmt: skip
    return replace(tables[0], when=Stamps(**when), **{name: all_of(name) for name in names})  # type: ignore[arg-type]


def _boot_stamps(rows: Rows, vehicle: VehicleTime) -> Stamps:
    boot = boot_ns(rows.fields["time_boot_ms"])
    return Stamps(gps_ns=vehicle.gps_ns(boot, rows.offset), boot_ns=boot, host_ns=rows.host_ns)


def _angles(quaternion: NDArray[np.float32]) -> tuple[Array, Array, Array]:
    """Return roll, pitch, yaw (n,) of quaternions (n, 4) w x y z, NaN for those that are all zeros."""
    q = quaternion.astype(np.float64).reshape(-1, 4)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    usable = np.isfinite(length) & (length > 0.5)
    w, x, y, z = np.where(usable, q / np.where(usable, length, 1.0), np.nan).T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


def _degrees(latitude: NDArray[np.int32], longitude: NDArray[np.int32]) -> tuple[Array, Array]:
    """Return degrees of degrees 1e-7; NaN where both are 0 or the largest number, which stand for unknown."""
    nowhere = ((latitude == 0) & (longitude == 0)) | (latitude == np.iinfo(np.int32).max)
    nowhere |= (np.abs(latitude.astype(np.int64)) > 900_000_000) | (np.abs(longitude.astype(np.int64)) > 1_800_000_000)
    return np.where(nowhere, np.nan, latitude / 1e7), np.where(nowhere, np.nan, longitude / 1e7)


def _float(column: NDArray[np.generic]) -> Array:
    return column.astype(np.float64)


def _told(column: NDArray[np.generic]) -> Array:
    """Return floats, NaN for 0: an extension that was not sent reads as 0."""
    value = _float(column)
    return np.where(value == 0.0, np.nan, value)
