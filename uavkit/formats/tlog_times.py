"""GPS time of what a MAVLink log records: the vehicle's boot clock, tied to GPS time session by session."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.clock_fit import ClockFit, fit_clock
from uavkit.core.gpstime import NO_TIME, UNIX_EPOCH_NS, gps_times_ns_from_unix_ns
from uavkit.formats.mavlink_messages import ATTITUDE, CAMERA_IMAGE_CAPTURED, GLOBAL_POSITION_INT, SYSTEM_TIME
from uavkit.formats.tlog_rows import Rows

SET_SINCE_US = 1_230_768_000_000_000
"""2009-01-01 in Unix time, before MAVLink: what a clock shows earlier was never set."""
LAST_US = 4_102_444_800_000_000
"""2100-01-01 in Unix time."""
LONGEST_BOOT_US = 100_000_000_000_000
"""Three years: time since boot is less, time since an epoch more."""
GPS_EPOCH_BEFORE_US = 1_600_000_000_000_000
"""Where nothing else tells: what is less counts from 1980 (it is 2030-09 there), else from 1970 (2020-09)."""
_FALL_NS = 5_000_000_000
"""Messages of one session come in order but for the delays of links."""
_ROWS_BEHIND, _FEWEST_BEHIND = 4, 3
_MOST_SESSIONS = 1000
_MOST_PAIRS = 5_000
_FEWEST_PAIRS = 5


class Meaning(IntEnum):
    """What a time stamp of a message counts from."""

    NOTHING = 0
    BOOT = 1
    UNIX = 2
    GPS = 3


class ClockSource(Enum):
    """What ties a session's boot clock to GPS time."""

    NONE = "nothing"
    SYSTEM_TIME = "SYSTEM_TIME"
    CAPTURED = "CAMERA_IMAGE_CAPTURED"
    CAPTURED_AND_HOST = "CAMERA_IMAGE_CAPTURED, between them the receiving computer's clock"
    HOST = "the receiving computer's clock"


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """From one start of the vehicle to the next."""

    first_boot_ns: int
    last_boot_ns: int
    clock: ClockFit | None
    source: ClockSource


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleTime:
    """The vehicle's clocks over a log."""

    sessions: tuple[Session, ...]
    begins: Indices
    """(sessions,) offset in the file of each one's first message; the first is 0."""
    offset: Indices
    """(m,) of messages that tell the boot time, ascending."""
    boot_ns: Indices
    """(m,) boot time in them."""

    def session(self, offset: Indices) -> Indices:
        """Return the session (n,) of places in the file."""
        return np.asarray(np.searchsorted(self.begins, offset, side="right") - 1, dtype=np.int64)

    def gps_ns(self, boot_ns: Indices, offset: Indices) -> Indices:
        """Return the GPS time (n,) of boot times in messages at places in the file."""
        number = self.session(offset)
        result = np.full(len(boot_ns), NO_TIME, dtype=np.int64)
        for k, session in enumerate(self.sessions):
            mask = number == k
            if session.clock is not None and mask.any():
                result[mask] = session.clock.gps_ns(boot_ns[mask])
        return result

    def boot_at_ns(self, offset: Indices) -> Indices:
        """Return the boot time (n,) when the messages at places in the file came; NO_TIME where none tells."""
        result = np.full(len(offset), NO_TIME, dtype=np.int64)
        if len(self.offset) == 0:
            return result
        place = np.searchsorted(self.offset, offset, side="right") - 1
        place = np.where(place < 0, 0, place)
        behind = np.minimum(place + 1, len(self.offset) - 1)
        number = self.session(offset)
        place = np.where(self.session(self.offset[place]) == number, place, behind)
        same = self.session(self.offset[place]) == number
        result[same] = self.boot_ns[place[same]]
        return result

    @property
    def longest(self) -> Session | None:
        """The longest session whose clock is known, else the longest one."""
        ranked = sorted(self.sessions, key=lambda s: (s.clock is not None, s.last_boot_ns - s.first_boot_ns))
        return ranked[-1] if ranked else None


def boot_ns(time_boot_ms: NDArray[np.uint32]) -> Indices:
    """Return boot times (n,) in ns; 0 is a clock that does not tell."""
    ms = time_boot_ms.astype(np.int64)
    return np.where(ms == 0, NO_TIME, ms * 1_000_000)


def unix_ns(time_usec: NDArray[np.uint64]) -> Indices:
    """Return Unix times (n,) in ns; NO_TIME for a clock that was never set."""
    known = (time_usec >= SET_SINCE_US) & (time_usec < LAST_US)
    return np.where(known, np.where(known, time_usec, 0).astype(np.int64) * 1000, NO_TIME)


def vehicle_time(rows: Mapping[int, Rows]) -> VehicleTime:
    """Return the clocks of a vehicle from its messages."""
    telling = [rows[number] for number in (ATTITUDE, GLOBAL_POSITION_INT, SYSTEM_TIME)]
    offset = np.concatenate([part.offset for part in telling])
    boot = np.concatenate([boot_ns(part.fields["time_boot_ms"]) for part in telling])
    host = np.concatenate([part.host_ns for part in telling])
    known = np.flatnonzero(boot != NO_TIME)
    order = known[np.argsort(offset[known], kind="stable")]
    offset, boot, host = offset[order], boot[order], host[order]
    starts = _session_starts(boot)
    begins = np.concatenate([[0], offset[starts[1:]]]).astype(np.int64)
    bounds = [*starts, len(boot)]
    lead = host_lead_ns(rows[SYSTEM_TIME])
    lead_ns = 0 if len(lead) == 0 else int(np.median(lead))
    sessions = list[Session]()
    for k, start in enumerate(starts):
        stop = bounds[k + 1]
        end = int(begins[k + 1]) if k + 1 < len(begins) else np.iinfo(np.int64).max
        span = boot[start:stop]
        clock, source = _session_clock(rows, int(begins[k]), end)
        if clock is None:
            clock, source = _host_clock(span, host[start:stop], lead_ns)
        elif source is ClockSource.CAPTURED:
            clock, source = _bent_clock(clock, rows[CAMERA_IMAGE_CAPTURED], span, host[start:stop])
        first, last = (int(span.min()), int(span.max())) if len(span) else (0, 0)
        sessions.append(Session(first_boot_ns=first, last_boot_ns=last, clock=clock, source=source))
    return VehicleTime(sessions=tuple(sessions), begins=begins, offset=offset, boot_ns=boot)


def host_lead_ns(system_time: Rows) -> Indices:
    """Return by how much the computer's clock leads the vehicle's (k,), the link's delay included."""
    unix = unix_ns(system_time.fields["time_unix_usec"])
    known = (unix != NO_TIME) & (system_time.host_ns != NO_TIME)
    return np.asarray(system_time.host_ns[known] - unix[known], dtype=np.int64)


def _session_starts(boot: Indices) -> list[int]:
    """Return the rows (of boot times in the order of the file) at which the clock begins anew; the first is 0."""
    starts = [0]
    for row in (np.flatnonzero(np.diff(boot) < -_FALL_NS) + 1).tolist():
        before = int(boot[max(starts[-1], row - 50) : row].max())
        behind = boot[row : row + 1 + _ROWS_BEHIND]
        lasting = len(behind) >= _FEWEST_BEHIND and int(behind.min()) >= int(boot[row]) - _FALL_NS
        if lasting and int(behind.max()) < before - _FALL_NS and len(starts) < _MOST_SESSIONS:
            starts.append(row)
    return starts


def _session_clock(rows: Mapping[int, Rows], begin: int, end: int) -> tuple[ClockFit | None, ClockSource]:
    """Return the fit to what the vehicle itself tells of time between two places in the file."""
    pairs = (
        (SYSTEM_TIME, "time_unix_usec", ClockSource.SYSTEM_TIME),
        (CAMERA_IMAGE_CAPTURED, "time_utc", ClockSource.CAPTURED),
    )
    for number, name, source in pairs:
        part = rows[number]
        inside = part.where((part.offset >= begin) & (part.offset < end))
        gps = gps_times_ns_from_unix_ns(unix_ns(inside.fields[name]))
        clock = fit_clock(boot_ns(inside.fields["time_boot_ms"]), gps)
        if clock is not None:
            return clock, source
    return None, ClockSource.NONE


def _host_clock(boot: Indices, host: Indices, lead_ns: int) -> tuple[ClockFit | None, ClockSource]:
    """Return the fit to the times of reception, less what the computer's clock leads elsewhere in the log."""
    usable = np.flatnonzero((host != NO_TIME) & (host // 1000 >= SET_SINCE_US))
    chosen = usable[:: max(1, len(usable) // _MOST_PAIRS)]
    clock = fit_clock(boot[chosen], gps_times_ns_from_unix_ns(host[chosen] - lead_ns))
    return clock, ClockSource.NONE if clock is None else ClockSource.HOST


def _bent_clock(clock: ClockFit, captured: Rows, boot: Indices, host: Indices) -> tuple[ClockFit, ClockSource]:
    """Return a fit to times of reception, moved to the few pairs of exposures, where it is twice as close to them.

    The boot clock of a simulated vehicle does not run evenly; a few exposures do not show how.
    """
    pairs_boot = boot_ns(captured.fields["time_boot_ms"])
    pairs_gps = gps_times_ns_from_unix_ns(unix_ns(captured.fields["time_utc"]))
    inside = (pairs_gps != NO_TIME) & (pairs_boot >= boot.min(initial=0)) & (pairs_boot <= boot.max(initial=0))
    dense, _ = _host_clock(boot, host, 0)
    if dense is None or int(inside.sum()) < _FEWEST_PAIRS:
        return clock, ClockSource.CAPTURED
    off = (dense.gps_ns(pairs_boot[inside]) - pairs_gps[inside]).astype(np.float64)
    lead = float(np.median(off))
    own = (clock.gps_ns(pairs_boot[inside]) - pairs_gps[inside]).astype(np.float64)
    if 2.0 * np.median(np.abs(off - lead)) > np.median(np.abs(own)):
        return clock, ClockSource.CAPTURED
    moved = tuple(replace(segment, offset_ns=segment.offset_ns - round(lead)) for segment in dense.segments)
    return ClockFit(segments=moved, rejected=dense.rejected), ClockSource.CAPTURED_AND_HOST


def event_times(
    time_usec: NDArray[np.uint64], rows: Rows, vehicle: VehicleTime
) -> tuple[Indices, Indices, NDArray[np.uint8]]:
    """Return GPS time (n,), boot time (n,) and ``Meaning`` (n,) of stamps in microseconds of unknown meaning.

    They count from boot, from 1970 or from 1980, by firmware, version and settings. Since GPS time of today is Unix
    time of ten years ago, that is chosen which comes nearest to the time of reception by the vehicle's clock, without
    which the receiving computer's.
    """
    from_boot = (time_usec > 0) & (time_usec < LONGEST_BOOT_US)
    from_epoch = (time_usec >= LONGEST_BOOT_US) & (time_usec < LAST_US)
    ns = np.where(from_boot | from_epoch, np.where(time_usec < LAST_US, time_usec, 0), 0).astype(np.int64) * 1000
    boot = np.where(from_boot, ns, NO_TIME)
    as_unix = gps_times_ns_from_unix_ns(np.where(from_epoch & (ns >= UNIX_EPOCH_NS), ns, NO_TIME))
    expected = _expected_gps_ns(rows, vehicle)
    gps_time = from_epoch & _is_gps_time(ns, as_unix, expected)
    meaning = np.where(from_boot, Meaning.BOOT, np.where(gps_time, Meaning.GPS, Meaning.UNIX)).astype(np.uint8)
    meaning[~(from_boot | from_epoch)] = Meaning.NOTHING
    gps = np.where(meaning == Meaning.GPS, ns, np.where(meaning == Meaning.UNIX, as_unix, NO_TIME))
    by_clock = vehicle.gps_ns(boot, rows.offset)
    return np.where(from_boot, by_clock, gps), boot, meaning


def _expected_gps_ns(rows: Rows, vehicle: VehicleTime) -> Indices:
    by_vehicle = vehicle.gps_ns(vehicle.boot_at_ns(rows.offset), rows.offset)
    host = np.where(rows.host_ns < SET_SINCE_US * 1000, NO_TIME, rows.host_ns)
    return np.where(by_vehicle == NO_TIME, gps_times_ns_from_unix_ns(host), by_vehicle)


def _is_gps_time(ns: Indices, as_unix: Indices, expected: Indices) -> Flags:
    known = (expected != NO_TIME) & (as_unix != NO_TIME)
    seconds = [np.where(known, column, 0) * 1e-9 for column in (ns, as_unix, expected)]
    nearer: Flags = np.abs(seconds[0] - seconds[2]) < np.abs(seconds[1] - seconds[2])
    return np.where(known, nearer, (ns < GPS_EPOCH_BEFORE_US * 1000) | (as_unix == NO_TIME))


def spread_s(values_ns: Indices) -> tuple[float, float]:
    """Return median and spread (1.48 times the median absolute deviation) in seconds."""
    seconds: Array = values_ns.astype(np.float64) * 1e-9
    middle = float(np.median(seconds))
    return middle, 1.48 * float(np.median(np.abs(seconds - middle)))
