"""MAVLink telemetry logs (``.tlog``), and raw MAVLink streams without the receiving computer's time stamps (``.raw``).

A record is a stamp (8 bytes, Unix microseconds of the receiving computer, most significant byte first) and a MAVLink
frame of version 1 or 2 (QGroundControl's developer guide, "MAVLink Log Format"). The rule by which messages are told
from damage:

* A message is accepted where its checksum is right, which covers all but stamp, first byte and signature. What is
  neither where the message before ends, nor stamped, nor followed by a message, must not hide another one; a signed
  message must not reach into the next one (its signature was cut short then).
* Its stamp belongs to it where no other message reaches into it and where it is a time between 1970 and 2095; else
  the 8 bytes are lost and the message has no time of reception.
* A message of unknown number is accepted where some checksum byte makes it right, a stamp (in a raw stream: the end
  of the message before) stands before it, and a known message or the end of the file follows, unknown ones between.
* All other bytes are lost. The search for the next message goes on at the byte after the last accepted one.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from uavkit.core.errors import InputError
from uavkit.core.flight_log import FixTable, FlightLog, LogKind
from uavkit.core.progress import Progress, silent
from uavkit.formats.mavlink_messages import (
    ATTITUDE,
    AUTOPILOT_VERSION,
    CAMERA_FEEDBACK,
    CAMERA_IMAGE_CAPTURED,
    CAMERA_TRIGGER,
    GLOBAL_POSITION_INT,
    GPS2_RAW,
    GPS_RAW_INT,
    HEARTBEAT,
    PARAM_VALUE,
    STATUSTEXT,
    SYSTEM_TIME,
    dialect,
)
from uavkit.formats.tlog_rows import RawLog, Rows, first_copies, frames_in, host_jumps, scan_log, without_stray_stamps
from uavkit.formats.tlog_tables import PX4, Pilot, attitudes, estimates, exposures, fixes
from uavkit.formats.tlog_times import ClockSource, VehicleTime, host_lead_ns, spread_s, vehicle_time

_NO_AUTOPILOT = 8
_EXPOSURES = (CAMERA_FEEDBACK, CAMERA_IMAGE_CAPTURED, CAMERA_TRIGGER)
_OF_AUTOPILOT = (SYSTEM_TIME, PARAM_VALUE, GPS_RAW_INT, ATTITUDE, GLOBAL_POSITION_INT, GPS2_RAW, AUTOPILOT_VERSION)
_AUTOPILOT_NAMES = {3: "ArduPilot", 12: "PX4"}
_FIRMWARE = re.compile(r"^(Ardu\w+|APM:\w+|Rover|Blimp|AntennaTracker) V\d[^()]*")
_INTEGERS = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4"}
"""MAV_PARAM_TYPE of integers."""
_BYTEWISE = 1 << 4
"""MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE."""
_CHAINED = 2
"""Messages that follow one another without a gap by which a file is recognised; chance does not bring that about."""
_SHORT_HEAD = 1024
_FEWEST_SAME = 10


def recognises(head: bytes) -> bool:
    """Tell whether intact MAVLink messages follow one another in the first bytes of a file."""
    frames = frames_in(head)
    if len(frames) == 0:
        return False
    begins, ends, stamps = frames.T
    if len(head) <= _SHORT_HEAD and (begins[0] == 0 or (begins[0] == 8 and stamps[0] >= 0)):
        return True
    gaps = begins[1:] - ends[:-1]
    return int(np.sum((gaps == 0) | ((gaps == 8) & (stamps[1:] >= 0)))) >= _CHAINED - 1


def read_log(path: Path, progress: Progress = silent) -> FlightLog:
    """Read a log; InputError where no intact message is in it.

    Of several vehicles the one with the most exposures (then fixes) is read. GPS times come from the vehicle's clock,
    fitted to its SYSTEM_TIME messages; those of the receiving computer only where the vehicle tells no time.
    """
    raw = scan_log(path, progress)
    if not raw.message_counts:
        raise InputError(f"{path}: no intact MAVLink message in it: record or download the log again")
    notes = list[str]()
    system, component = _vehicle(raw, notes)
    rows = {number: _of_vehicle(number, part, system, component) for number, part in raw.rows.items()}
    raw = replace(raw, rows={})  # so that what is done with can be given back: logs are long
    vehicle = vehicle_time(rows)
    pilot = Pilot(autopilot=_autopilot(rows[HEARTBEAT], component), parameters=_parameters(rows, component))
    texts = _texts(rows[STATUSTEXT])
    name = _vehicle_name(rows, component, texts)
    exposure_table = exposures(rows, vehicle, pilot, notes)
    notes += _time_notes(raw.stamped, rows, vehicle)
    attitude_table = attitudes(rows.pop(ATTITUDE), vehicle)
    estimate_table = estimates(rows.pop(GLOBAL_POSITION_INT), vehicle)
    fix_table = fixes(rows, vehicle)
    notes += _height_notes(fix_table)
    longest = vehicle.longest
    return FlightLog(
        source=str(path),
        kind=LogKind.TLOG,
        vehicle=name,
        fix_table=fix_table,
        estimate_table=estimate_table,
        attitude_table=attitude_table,
        exposure_table=exposure_table,
        clock=longest.clock if longest is not None else None,
        message_counts=raw.message_counts,
        parameters=pilot.parameters,
        texts=texts,
        damage=raw.damage,
        notes=tuple(notes),
    )


def _of_vehicle(number: int, part: Rows, system: int, component: int) -> Rows:
    mask = part.system == system
    if number in _OF_AUTOPILOT:
        mask &= part.component == component
    return without_stray_stamps(part.where(mask))


def _vehicle(raw: RawLog, notes: list[str]) -> tuple[int, int]:
    """Return system and component of the autopilot whose log this is."""
    beats = raw.rows[HEARTBEAT]
    beats = beats.where(beats.fields["autopilot"] != _NO_AUTOPILOT)
    pilots = beats if len(beats) else _joined_senders(raw)
    if len(pilots) == 0:
        notes.append("no vehicle in this log: nothing but messages of ground stations or devices")
        return 0, 0
    systems = np.unique(pilots.system).tolist()
    rank = {
        system: tuple(
            sum(int(np.sum(raw.rows[number].system == system)) for number in numbers)
            for numbers in (_EXPOSURES, (GPS_RAW_INT, GPS2_RAW), (HEARTBEAT, ATTITUDE))
        )
        for system in systems
    }
    chosen = max(systems, key=lambda system: rank[system])
    for system in systems:
        if system != chosen:
            notes.append(
                f"vehicle {system} left out ({raw.system_counts.get(system, 0)} messages, {rank[system][0]} about "
                f"exposures, {rank[system][1]} fixes): vehicle {chosen} is read"
            )
    components, counts = np.unique(pilots.component[pilots.system == chosen], return_counts=True)
    return int(chosen), int(components[np.argmax(counts)])


def _joined_senders(raw: RawLog) -> Rows:
    """Return the messages of that kind that only a vehicle sends, of which there are most."""
    return max((raw.rows[number] for number in (GPS_RAW_INT, ATTITUDE, GLOBAL_POSITION_INT, *_EXPOSURES)), key=len)


def _autopilot(beats: Rows, component: int) -> int:
    kinds = beats.fields["autopilot"][beats.component == component]
    return int(kinds[-1]) if len(kinds) else _NO_AUTOPILOT


def _parameters(rows: Mapping[int, Rows], component: int) -> dict[str, float]:
    """Return the last value of each parameter; integers travel as such in the bytes of a float, or cast to one."""
    f = rows[PARAM_VALUE].fields
    versions = rows[AUTOPILOT_VERSION].fields
    told = bool(np.any(versions["capabilities"] & np.uint64(_BYTEWISE)))
    bytewise = told or _autopilot(rows[HEARTBEAT], component) == PX4
    parameters = dict[str, float]()
    for name, value, kind in zip(f["param_id"].tolist(), f["param_value"], f["param_type"].tolist(), strict=True):
        whole = bytewise and kind in _INTEGERS
        number = value.tobytes() if whole else b""
        parameters[_text(name)] = float(np.frombuffer(number, dtype=_INTEGERS[kind])[0]) if whole else float(value)
    return parameters


def _texts(rows: Rows) -> tuple[str, ...]:
    """Return the messages to the pilot, those sent in chunks put together."""
    rows = rows.where(first_copies(rows))
    texts, open_chunks = list[str](), dict[tuple[int, int], int]()
    f = rows.fields
    columns = (f["text"].tolist(), f["id"].tolist(), f["chunk_seq"].tolist(), rows.component.tolist())
    for text, number, chunk, component in zip(*columns, strict=True):
        key = (component, number)
        if number and chunk and key in open_chunks:
            texts[open_chunks[key]] += _text(text)
            continue
        texts.append(_text(text))
        if number:
            open_chunks[key] = len(texts) - 1
    return tuple(text.strip() for text in texts)


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode("utf-8", errors="replace")


def _vehicle_name(rows: Mapping[int, Rows], component: int, texts: tuple[str, ...]) -> str:
    """Return what firmware and vehicle call themselves, e.g. "ArduPilot quadrotor 4.6.3"."""
    named = next((match.group().strip() for text in texts if (match := _FIRMWARE.match(text))), "")
    if named:
        return named
    beats = rows[HEARTBEAT].where(rows[HEARTBEAT].component == component).fields
    if len(beats) == 0:
        return ""
    autopilot, kind = int(beats["autopilot"][-1]), int(beats["type"][-1])
    known = dialect()
    words = [
        _AUTOPILOT_NAMES.get(autopilot, known.autopilots.get(autopilot, f"autopilot {autopilot}")),
        known.vehicle_types.get(kind, f"vehicle type {kind}"),
    ]
    versions = rows[AUTOPILOT_VERSION].fields["flight_sw_version"]
    if len(versions) and int(versions[-1]):
        version = int(versions[-1])
        words.append(f"{version >> 24}.{version >> 16 & 255}.{version >> 8 & 255}")
    return " ".join(words)


def _height_notes(fixes: FixTable) -> list[str]:
    if len(fixes) == 0:
        return ["no positions of a GNSS receiver in this log"]
    both = np.isfinite(fixes.height_ellipsoid_m) & np.isfinite(fixes.height_geoid_m)
    same = fixes.height_ellipsoid_m[both] == fixes.height_geoid_m[both]
    if len(same) >= _FEWEST_SAME and same.all():
        return [
            "the receiver states the same heights above ellipsoid and mean sea level: it knows no geoid (or is "
            "simulated), one of the two is wrong by the geoid's height"
        ]
    return []


def _time_notes(stamped: bool, rows: Mapping[int, Rows], vehicle: VehicleTime) -> list[str]:
    notes = list[str]()
    if not stamped:
        notes.append("a raw stream without times of reception")
    sessions = vehicle.sessions
    if len(sessions) > 1:
        notes.append(
            f"the vehicle was started {len(sessions)} times: each session has its own clock, the longest's is told"
        )
    sources = [session.source for session in sessions]
    for source in (ClockSource.CAPTURED, ClockSource.CAPTURED_AND_HOST):
        if source in sources:
            notes.append(f"no SYSTEM_TIME: the vehicle's clock is fitted to the times in {source.value}")
    if ClockSource.HOST in sources:
        notes.append(
            "the vehicle tells no time (no SYSTEM_TIME with a time set): GPS times are those of the receiving "
            "computer's clock, late by the link's delay and wrong by as much as that clock was"
        )
    lead = host_lead_ns(rows[SYSTEM_TIME])
    if len(lead):
        middle_s, spread = spread_s(lead)
        notes.append(
            f"the receiving computer's clock leads the vehicle's UTC by {middle_s:.3f} s (median of {len(lead)}, "
            f"spread {spread:.3f} s, the link's delay included)"
        )
    jumps = max(host_jumps(part) for part in rows.values())
    if jumps:
        notes.append(f"the receiving computer's clock was set {jumps} times during the log")
    return notes
