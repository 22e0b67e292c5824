"""Turns the messages of a dataflash log, binary or text, into the tables of a flight log.

Sources: ArduPilot, libraries/AP_GPS/LogStructure.h, AP_Camera/LogStructure.h, AP_AHRS/LogStructure.h and the writing
functions beside them; columns of older firmware (TimeMS, Week, T, RelAlt) from LogStructure.h of their time.

* Times. TimeUS is the boot clock. The time of a GPS row is that of its fix, GWk and GMS; the boot clock is tied to it
  by pairs of both, the boot time being SMS of GPA (when the fix came in) where it is there, else TimeUS of GPS, which
  is up to a cycle of the main loop later. The receiver's delay (0.1 to 0.2 s between epoch and arrival) is common to
  all pairs and stays in.
* Exposures. CAM and TRIG tell when by TimeUS alone; their GPSTime is the time of the last fix, up to 0.2 s before. With
  a feedback pin CAM is the flash contact's time and TRIG the command, which the next CAM within two seconds confirms; a
  TRIG that none confirms is kept as a TRIGGER. Without a pin CAM is the command. Firmware before 3.3 wrote no boot time
  in CAM: it lies between those of the rows around it.
* Heights. Alt is above mean sea level, RelAlt and RelHomeAlt above home, AEl above the ellipsoid. Und is the height of
  the ellipsoid above mean sea level (Alt minus ellipsoidal height, the opposite of a geoid height); 0 is "not known".
* Signs. VZ counts downwards, Spd and GCrs are ground speed and course. HAcc, VAcc of 0 or at the greatest number that
  the column holds are not known.
"""

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Indices
from uavkit.core.clock_fit import FAR_S, ClockFit, fit_clock
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
    no_exposures,
    no_fixes,
)
from uavkit.core.gpstime import NO_TIME, WEEK_NS
from uavkit.formats.dataflash_fields import NO_ROWS, VEHICLE, Column, Messages, Rows, joined
from uavkit.formats.dataflash_starts import joined_starts
from uavkit.formats.log_times import with_gps_times

FEEDBACK_SIGMA_S = 0.001
"""The pin is read by an interrupt or, on boards without one for it, 1000 times a second."""
TRIGGER_SIGMA_S = 0.05
"""Consumer cameras lag behind the command by a time that varies so much; its constant part is not in it."""
CONFIRMED_WITHIN_S = 2.0
"""A CAM later than this after a TRIG is of something else: no camera lags so long."""
FIRST_WEEK = 1700
"""Of 2012-08: logs of this kind are not older, so weeks below it are of a receiver that counts them modulo 1024."""
LAST_WEEK = 10_000
_LONGEST_US = 10**15
_NO_ALTITUDE_M = -(2.0**31) / 100.0
_RECEIVERS = {"GPS": (0, "GPA"), "GPS2": (1, "GPA2"), "GPSB": (2, "GPAB")}


def flight_log(messages: Messages, source: str, kind: LogKind) -> FlightLog:
    """Return the tables of a log; those of kinds that it does not hold are empty, and the notes say so.

    The messages are taken out of ``messages``, so that not all of them are held beside the tables.
    """
    with np.errstate(all="ignore"):  # nothing tells a damaged number from an intact one: infinity among others
        return _flight_log(messages, source, kind)


def _flight_log(messages: Messages, source: str, kind: LogKind) -> FlightLog:
    messages, notes_of_starts = joined_starts(messages)
    notes = [*messages.notes, *notes_of_starts]
    gps = _receivers(messages)
    fixes, gps_boot_ns = _fixes(gps, notes)
    clock = fit_clock(gps_boot_ns, fixes.when.gps_ns)
    fixes = with_gps_times(_with_believable_times(fixes, clock, notes), clock)
    parameters = _parameters(messages.take("PARM"))
    exposures = with_gps_times(_exposures(messages, gps, parameters, notes), clock)
    del gps
    texts = tuple(text for text in messages.take("MSG").texts("Message") if text)
    if clock is None:
        notes.append("no fix with a time is in the log: times are those of the boot clock only")
    return FlightLog(
        source=source,
        kind=kind,
        vehicle=next((text for text in texts if VEHICLE.match(text)), ""),
        fix_table=fixes,
        estimate_table=with_gps_times(_estimates(messages.take("POS")), clock),
        attitude_table=with_gps_times(_attitudes(messages.take("ATT")), clock),
        exposure_table=exposures,
        clock=clock,
        message_counts=messages.counts,
        parameters=parameters,
        texts=texts,
        damage=messages.damage,
        notes=tuple(notes),
    )


def boot_ns_of(rows: Rows, *names: str) -> Indices:
    """Return boot times (n,): of TimeUS, else of the first of the named columns in ms, else TimeMS; NO_TIME without."""
    if "TimeUS" in rows.columns:
        time_us = rows.integer("TimeUS", -1)
        known = (time_us >= 0) & (time_us < _LONGEST_US)
        return np.where(known, np.where(known, time_us, 0) * 1000, NO_TIME)
    name = next((name for name in (*names, "TimeMS") if name in rows.columns), "")
    time_ms = rows.integer(name, -1)
    known = (time_ms >= 0) & (time_ms < _LONGEST_US // 1000)
    return np.where(known, np.where(known, time_ms, 0) * 1_000_000, NO_TIME)


def _receivers(messages: Messages) -> Rows:
    """Return the GPS messages of all receivers with what GPA says of each: columns ``receiver`` and GPA's."""
    parts = []
    for name, (number, accuracy) in _RECEIVERS.items():
        rows = messages.take(name)
        if len(rows):
            extra = _accuracies(rows, messages.take(accuracy))
            extra["receiver"] = rows.integer("I", number)
            boot_ns = boot_ns_of(rows, "T")
            parts.append(Rows(places=rows.places, columns={**rows.columns, **extra, "boot_ns": boot_ns}))
    return joined(parts) if parts else NO_ROWS


def _accuracies(gps: Rows, gpa: Rows) -> dict[str, Column]:
    """Return GPA's columns for rows of GPS: those of the same time and receiver, NaN where there are none."""
    names = ("HAcc", "VAcc", "VV", "SMS", "AEl", "Und")
    if len(gpa) == 0 or "TimeUS" not in gps.columns:
        return {name: np.full(len(gps), np.nan) for name in names}
    wanted, given = (rows.integer("TimeUS", -1) * 8 + rows.integer("I", 0) for rows in (gps, gpa))
    order = np.argsort(given, kind="stable")
    at = order[np.minimum(np.searchsorted(given[order], wanted), len(given) - 1)]
    same = given[at] == wanted
    return {name: np.where(same, gpa.number(name)[at], np.nan) for name in names}


def _fixes(gps: Rows, notes: list[str]) -> tuple[FixTable, Indices]:
    """Return the receivers' positions, and the boot times (n,) at which they came in."""
    if len(gps) == 0:
        notes.append("no GPS messages are in the log")
        return no_fixes(), np.zeros(0, dtype=np.int64)
    boot_ns = gps.integer("boot_ns", NO_TIME)
    came_ms = gps.number("SMS")
    near = np.abs(came_ms * 1e6 - boot_ns) < 1e9
    boot_ns = np.where(near, np.where(near, came_ms, 0.0).astype(np.int64) * 1_000_000, boot_ns)
    status = gps.integer("Status", int(FixType.UNKNOWN))
    fix_type = np.where((status < 0) | (status > FixType.RTK_FIXED), FixType.UNKNOWN, status).astype(np.uint8)
    latitude_deg, longitude_deg = _on_earth(gps.number("Lat"), gps.number("Lng"))
    height_m = gps.number("Alt")
    table = fix_table(
        Stamps.of(len(gps), gps_ns=_gps_ns(gps, notes), boot_ns=boot_ns),
        latitude_deg,
        longitude_deg,
        height_geoid_m=height_m,
        height_ellipsoid_m=_height_ellipsoid_m(gps, height_m),
        height_above_home_m=gps.number("RelAlt", "RAlt"),
        velocity_m_s=_velocity_m_s(gps),
        sigma_horizontal_m=_known_accuracy(gps.number("HAcc")),
        sigma_vertical_m=_known_accuracy(gps.number("VAcc")),
        fix_type=fix_type,
        satellites=np.clip(gps.integer("NSats", 255), 0, 255).astype(np.uint8),
        receiver=np.clip(gps.integer("receiver", 0), 0, 255).astype(np.uint8),
    )
    return table, boot_ns


def _gps_ns(gps: Rows, notes: list[str]) -> Indices:
    """Return the GPS time of fixes (n,); a week count that began again is put right."""
    week = gps.integer("GWk" if "GWk" in gps.columns else "Week", 0)
    time_ms = gps.integer("GMS" if "GMS" in gps.columns else "TimeMS", -1)
    old = (week > 0) & (week < FIRST_WEEK)
    if np.any(old) and not np.any(week >= FIRST_WEEK):
        week = np.where(old, FIRST_WEEK + (week - FIRST_WEEK) % 1024, week)
        notes.append(f"the receiver counts weeks modulo 1024: taken as those that begin with {FIRST_WEEK}")
    known = (week >= FIRST_WEEK) & (week < LAST_WEEK) & (time_ms >= 0) & (time_ms < WEEK_NS // 1_000_000)
    return np.where(known, np.where(known, week, 0) * WEEK_NS + np.where(known, time_ms, 0) * 1_000_000, NO_TIME)


def _with_believable_times(fixes: FixTable, clock: ClockFit | None, notes: list[str]) -> FixTable:
    """Return the fixes without GPS times that the clock contradicts: of a receiver that did not know the time yet."""
    if clock is None:
        return fixes
    when = fixes.when
    both = (when.gps_ns != NO_TIME) & (when.boot_ns != NO_TIME)
    difference_ns = np.where(both, when.gps_ns, 0) - np.where(both, clock.gps_ns(when.boot_ns), 0)
    wrong = both & (np.abs(difference_ns) > FAR_S * 1e9)
    if not np.any(wrong):
        return fixes
    notes.append(f"{int(wrong.sum())} fixes have a time that the boot clock contradicts: the clock's is taken")
    columns = {name: getattr(fixes, name) for name in fixes.__dataclass_fields__ if name != "when"}
    gps_ns = np.where(wrong, NO_TIME, when.gps_ns)
    return FixTable(when=Stamps.of(len(fixes), gps_ns=gps_ns, boot_ns=when.boot_ns), **columns)


def _height_ellipsoid_m(gps: Rows, height_geoid_m: Array) -> Array:
    given_m, undulation_m = gps.number("AEl"), gps.number("Und")
    given_m = np.where(given_m <= _NO_ALTITUDE_M, np.nan, given_m)
    by_undulation_m = height_geoid_m - np.where(undulation_m == 0.0, np.nan, undulation_m)
    return np.where(np.isfinite(given_m), given_m, by_undulation_m)


def _velocity_m_s(gps: Rows) -> Array:
    """Return velocities (n, 3) east, north, up; up is NaN where the receiver says that it does not measure it."""
    speed_m_s, course_rad = gps.number("Spd"), np.radians(gps.number("GCrs"))
    down_m_s = np.where(gps.number("VV") == 0.0, np.nan, gps.number("VZ"))
    return np.column_stack([speed_m_s * np.sin(course_rad), speed_m_s * np.cos(course_rad), -down_m_s])


def _known_accuracy(sigma_m: Array) -> Array:
    return np.where((sigma_m <= 0.0) | (sigma_m >= 655.35), np.nan, sigma_m)


def _on_earth(latitude_deg: Array, longitude_deg: Array) -> tuple[Array, Array]:
    """Return positions, NaN where they are none: exactly 0, 0 before the first fix, or out of range."""
    good = (np.abs(latitude_deg) <= 90.0) & (np.abs(longitude_deg) <= 180.0)
    good &= (latitude_deg != 0.0) | (longitude_deg != 0.0)
    return np.where(good, latitude_deg, np.nan), np.where(good, longitude_deg, np.nan)


def _estimates(pos: Rows) -> FixTable:
    latitude_deg, longitude_deg = _on_earth(pos.number("Lat"), pos.number("Lng"))
    return fix_table(
        Stamps.of(len(pos), boot_ns=boot_ns_of(pos)),
        latitude_deg,
        longitude_deg,
        height_geoid_m=pos.number("Alt"),
        height_above_home_m=pos.number("RelHomeAlt", "RelAlt"),
    )


def _attitudes(att: Rows) -> AttitudeTable:
    roll_rad, pitch_rad, yaw_rad = (np.radians(att.number(name)) for name in ("Roll", "Pitch", "Yaw"))
    return attitude_table(Stamps.of(len(att), boot_ns=boot_ns_of(att)), roll_rad, pitch_rad, yaw_rad)


def _parameters(parm: Rows) -> dict[str, float]:
    """Return parameters as last set."""
    return dict(zip(parm.texts("Name"), parm.number("Value").tolist(), strict=True))


def _exposures(messages: Messages, gps: Rows, parameters: dict[str, float], notes: list[str]) -> ExposureTable:
    """Return the exposures of the first camera: CAM, and TRIG where no CAM confirms it."""
    cam, trig, instance = _first_camera(messages.take("CAM"), messages.take("TRIG"), notes)
    if len(cam) + len(trig) == 0:
        return no_exposures()
    timed = _timed_rows(messages, gps)
    cam_ns, cam_half_ns = _boot_or_between(cam, timed, notes)
    trig_ns, trig_half_ns = _boot_or_between(trig, timed, notes)
    by_cam = confirmations(trig_ns, cam_ns)
    pin = parameters.get(f"CAM{instance + 1}_FEEDBAK_PIN", parameters.get("CAM_FEEDBACK_PIN", 0.0)) > 0
    contact = np.full(len(cam), pin)
    contact[by_cam[by_cam >= 0]] = True
    _note_exposures(notes, contact, by_cam)
    alone = by_cam < 0
    both = joined([cam, trig.where(alone)]) if len(cam) and np.any(alone) else (cam if len(cam) else trig)
    places = np.concatenate([cam.places, trig.places[alone]])
    order = np.argsort(places, kind="stable")
    kind = np.where(np.r_[contact, np.zeros(int(alone.sum()), dtype=bool)], ExposureKind.FEEDBACK, ExposureKind.TRIGGER)
    sigma_s = np.where(kind == ExposureKind.FEEDBACK, FEEDBACK_SIGMA_S, TRIGGER_SIGMA_S)
    between_s = np.concatenate([cam_half_ns, trig_half_ns[alone]]) * 1e-9 / np.sqrt(3.0)
    boot_ns = np.concatenate([cam_ns, trig_ns[alone]])[order]
    return _exposure_rows(both, boot_ns, kind[order].astype(np.uint8), np.hypot(sigma_s, between_s)[order])


def _exposure_rows(rows: Rows, boot_ns: Indices, kind: NDArray[np.uint8], sigma_s: Array) -> ExposureTable:
    latitude_deg, longitude_deg = _on_earth(rows.number("Lat"), rows.number("Lng"))
    roll_rad, pitch_rad, yaw_rad = (
        np.radians(rows.number(*names)) for names in (("R", "Roll"), ("P", "Pitch"), ("Y", "Yaw"))
    )
    # Where there is no RelAlt, Alt was above home on copters and above sea level on planes: not known.
    height_m = rows.number("Alt") if "RelAlt" in rows.columns else np.full(len(rows), np.nan)
    return exposure_table(
        Stamps.of(len(rows), boot_ns=boot_ns),
        kind,
        sigma_s=sigma_s,
        sequence=rows.integer("Img", -1),
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        height_geoid_m=height_m,
        height_above_home_m=rows.number("RelAlt"),
        roll_rad=roll_rad,
        pitch_rad=pitch_rad,
        yaw_rad=yaw_rad,
    )


def _first_camera(cam: Rows, trig: Rows, notes: list[str]) -> tuple[Rows, Rows, int]:
    """Return CAM and TRIG of the camera with the lowest number, and that number."""
    numbers = np.unique(np.concatenate([cam.integer("I", 0), trig.integer("I", 0)]))
    if len(numbers) == 0:
        return cam, trig, 0
    first = int(numbers[0])
    if len(numbers) > 1:
        others = ", ".join(str(number + 1) for number in numbers[1:].tolist())
        notes.append(f"several cameras are in the log: the exposures are those of camera {first + 1}, not of {others}")
    return cam.where(cam.integer("I", 0) == first), trig.where(trig.integer("I", 0) == first), first


def confirmations(trig_ns: Indices, cam_ns: Indices) -> Indices:
    """Return for each TRIG the CAM that confirms it, (n,), -1 for none.

    That is the first CAM at or after it, before the next TRIG and within ``CONFIRMED_WITHIN_S``.
    """
    found = np.full(len(trig_ns), -1, dtype=np.int64)
    if len(cam_ns) == 0 or len(trig_ns) == 0:
        return found
    order, trig_order = np.argsort(cam_ns, kind="stable"), np.argsort(trig_ns, kind="stable")
    sorted_cam, sorted_trig = cam_ns[order], trig_ns[trig_order]
    at = np.searchsorted(sorted_cam, sorted_trig, side="left")
    until = np.minimum(
        np.append(sorted_trig[1:], np.iinfo(np.int64).max),
        np.where(sorted_trig == NO_TIME, NO_TIME, sorted_trig + int(CONFIRMED_WITHIN_S * 1e9)),
    )
    first = np.minimum(at, len(cam_ns) - 1)
    good = (at < len(cam_ns)) & (sorted_cam[first] < until) & (sorted_cam[first] != NO_TIME)
    found[trig_order] = np.where(good, order[first], -1)
    return found


def _timed_rows(messages: Messages, gps: Rows) -> tuple[Indices, Indices]:
    """Return places in the file and boot times of frequent messages, in the order of the file."""
    parts = [(rows.places, boot_ns_of(rows)) for rows in (messages.of("ATT"), messages.of("POS"))]
    parts.append((gps.places, gps.integer("boot_ns", NO_TIME)))
    places, boot_ns = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(places, kind="stable")
    order = order[boot_ns[order] != NO_TIME]
    return places[order], boot_ns[order]


def _boot_or_between(rows: Rows, timed: tuple[Indices, Indices], notes: list[str]) -> tuple[Indices, Array]:
    """Return boot times (n,) and half the span that they are known to lie in, both ns: 0 where the row tells."""
    boot_ns = boot_ns_of(rows)
    unknown = boot_ns == NO_TIME
    half_ns = np.zeros(len(rows))
    places, times = timed
    if not np.any(unknown) or len(places) == 0:
        return boot_ns, half_ns
    after = np.clip(np.searchsorted(places, rows.places), 1, max(len(places) - 1, 1))
    before_ns, after_ns = times[after - 1], times[np.minimum(after, len(times) - 1)]
    notes.append(f"{int(unknown.sum())} exposures have no boot time: they lie between the messages around them")
    half_ns = np.where(unknown, np.abs(after_ns - before_ns) / 2.0, 0.0)
    return np.where(unknown, before_ns + (after_ns - before_ns) // 2, boot_ns), half_ns


def _note_exposures(notes: list[str], contact: NDArray[np.bool_], by_cam: Indices) -> None:
    if len(contact) and not np.any(contact):
        notes.append("the camera has no feedback pin: exposures are the autopilot's commands, the shutter lags behind")
    missing = int(np.sum(by_cam < 0))
    if missing and np.any(contact):
        notes.append(f"{missing} commands to the camera (TRIG) were not confirmed by its contact (CAM)")
