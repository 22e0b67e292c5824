"""Positions of the stills from flight logs: exposures matched with stills, and the receiver's track at their times.

The time of an exposure is that of its event, plus the delay of the receiver's messages where the boot clock tied the
event to GPS time (see ``gnss_delay``), plus the shutter's configured latency. What is left of a latency is an unknown
of the adjustment.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.core.errors import InputError
from uavkit.core.flight_log import ExposureKind, FlightLog
from uavkit.core.frames import ellipsoid_heights_m
from uavkit.core.gpstime import NO_TIME
from uavkit.core.heights import HeightDatum
from uavkit.core.records import ExposureEvent, GnssFix
from uavkit.ingest.camera_position import AttitudeTrack, build_attitudes, camera_positions
from uavkit.ingest.gnss_delay import estimate_gnss_delay
from uavkit.ingest.trajectory import Trajectory, build_trajectory

LEAST_DELAY_SIGMAS = 3.0
"""A delay that its own scatter may explain is not applied."""
LONGEST_ARM_M = 10.0
LONGEST_DELAY_S = 1.0
"""No receiver's message takes longer: such a value tells of other clocks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogOptions:
    """What is known of camera and antenna."""

    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Antenna minus camera in the vehicle's axes: forward, right, down."""
    shutter_latency_s: float = 0.0
    """From the event to the exposure."""

    def __post_init__(self) -> None:
        if not all(abs(length) <= LONGEST_ARM_M for length in self.lever_arm_m):
            raise InputError(
                f"a lever arm of {self.lever_arm_m}: forward, right, down in metres, at most {LONGEST_ARM_M:g}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedFlight:
    """A log made ready: its track, attitudes and events."""

    log: FlightLog
    number: int
    """Of the flight: logs of the same time belong to the same one."""
    trajectory: Trajectory | None
    attitudes: AttitudeTrack | None
    events: Indices
    """Rows of the exposure table that have a time, in its order."""
    event_gps_ns: Indices
    """The delay of the receiver's messages put right."""
    notes: tuple[str, ...]


def prepare_flights(logs: Sequence[FlightLog]) -> tuple[LoggedFlight, ...]:
    """Return the logs ready to be used, in the order given, those of one time numbered alike."""
    return _numbered([_prepared(log) for log in logs])


def _prepared(log: FlightLog) -> LoggedFlight:
    notes = [f"{log.source}: {note}" for note in log.notes]
    if log.damage.lost_bytes:
        notes.append(f"{log.source}: {log.damage.lost_bytes} bytes in {log.damage.span_count} places are damaged")
    trajectory = _trajectory(log, notes)
    attitudes = build_attitudes(log.attitude_table) if np.sum(log.attitude_table.when.gps_ns != NO_TIME) > 1 else None
    times = log.exposure_table.when.gps_ns
    events = np.flatnonzero(times != NO_TIME)
    return LoggedFlight(
        log=log,
        number=0,
        trajectory=trajectory,
        attitudes=attitudes,
        events=events,
        event_gps_ns=times[events] + _delay_ns(log, trajectory, notes),
        notes=tuple(notes),
    )


def _trajectory(log: FlightLog, notes: list[str]) -> Trajectory | None:
    """Return the receiver's track, the autopilot's own where there is none of a receiver."""
    for table, what in ((log.fix_table, "receiver"), (log.estimate_table, "autopilot")):
        try:
            found = build_trajectory(table)
        except InputError:
            continue
        if what == "autopilot":
            notes.append(f"{log.source}: no fixes of a receiver: positions are the autopilot's own estimate")
        notes.extend(f"{log.source}: {note}" for note in found.notes)
        return found
    return None


def _delay_ns(log: FlightLog, trajectory: Trajectory | None, notes: list[str]) -> int:
    """Return what is to be added to times that come from the boot clock."""
    if log.clock is None or trajectory is None or not len(log.fix_table) or not len(log.estimate_table):
        return 0
    try:
        found = estimate_gnss_delay(build_trajectory(log.estimate_table), trajectory)
    except InputError:
        return 0
    if not LEAST_DELAY_SIGMAS * found.scatter_s < abs(found.delay_s) < LONGEST_DELAY_S:
        return 0
    notes.append(
        f"{log.source}: the receiver's messages reach the autopilot {found.delay_s:.3f} s (sigma {found.sigma_s:.3f} "
        "s) after their epochs: times of exposures are put right by that"
    )
    return round(found.delay_s * 1e9)


def _numbered(flights: list[LoggedFlight]) -> tuple[LoggedFlight, ...]:
    """Number the flights by time; logs whose times overlap are of one flight."""
    spans = [_span(flight) for flight in flights]
    order = sorted(range(len(flights)), key=lambda n: spans[n][0])
    number, last, numbers = -1, -np.inf, [0] * len(flights)
    for n in order:
        if spans[n][0] > last:
            number += 1
        last = max(last, spans[n][1])
        numbers[n] = max(number, 0)
    return tuple(replace(flight, number=n) for flight, n in zip(flights, numbers, strict=True))


def _span(flight: LoggedFlight) -> tuple[float, float]:
    times = list(flight.event_gps_ns)
    if flight.trajectory is not None:
        times += [flight.trajectory.gps_ns[0], flight.trajectory.gps_ns[-1]]
    return (float(min(times)), float(max(times))) if times else (np.inf, np.inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class EventPosition:
    """Where the antenna (the camera, if a lever arm was taken off) was at an exposure."""

    event_gps_time_ns: int
    gps_time_ns: int
    """Of the exposure."""
    fix: GnssFix | None
    velocity_m_s: tuple[float, float, float] | None
    flight: int
    reason: str = ""
    """Why there is no position."""


def positions_of_events(
    flights: Sequence[LoggedFlight], events: Sequence[tuple[int, int, int]], options: LogOptions
) -> tuple[EventPosition, ...]:
    """Return the positions at exposures given as (flight's index, row of its exposure table, GPS time in ns).

    By the track of the event's own log, else by that of another log of the time, else as the log itself places it.
    """
    latency_ns = round(options.shutter_latency_s * 1e9)
    result: dict[int, EventPosition] = {}
    for index, flight in enumerate(flights):
        mine = [n for n, event in enumerate(events) if event[0] == index]
        if not mine:
            continue
        times = np.array([events[n][2] + latency_ns for n in mine], dtype=np.int64)
        others = [other for other in flights if other is not flight and other.number == flight.number]
        logged = list(flight.log.exposures())
        for n, time_ns, place in zip(mine, times.tolist(), _places([flight, *others], times, options), strict=True):
            fix, velocity, reason = place or _as_logged(logged[events[n][1]], options)
            result[n] = EventPosition(
                event_gps_time_ns=events[n][2],
                gps_time_ns=time_ns,
                fix=fix,
                velocity_m_s=velocity,
                flight=flight.number,
                reason=reason,
            )
    return _of_one_datum([result[n] for n in range(len(events))])


def _of_one_datum(places: list[EventPosition]) -> tuple[EventPosition, ...]:
    """Return the positions with heights of one datum: mixed ones become ellipsoidal, others that cannot are left out.

    The track of one log may tell ellipsoidal heights, an event of another only that above the geoid.
    """
    datums = {place.fix.height_datum for place in places if place.fix is not None}
    if len(datums) < 2:
        return tuple(places)
    return tuple(place if place.fix is None else _ellipsoidal(place, place.fix) for place in places)


def _ellipsoidal(place: EventPosition, fix: GnssFix) -> EventPosition:
    if fix.height_datum not in (HeightDatum.ELLIPSOID, HeightDatum.GEOID):
        reason = f"its height is of another datum ({fix.height_datum.value}) than the others'"
        return replace(place, fix=None, reason=reason)
    where = np.array([fix.latitude_deg]), np.array([fix.longitude_deg])
    height_m = ellipsoid_heights_m(*where, np.array([fix.height_m]), fix.height_datum)
    return replace(place, fix=replace(fix, height_m=float(height_m[0]), height_datum=HeightDatum.ELLIPSOID))


_Place = tuple[GnssFix | None, tuple[float, float, float] | None, str]


def _places(flights: Sequence[LoggedFlight], times_ns: Indices, options: LogOptions) -> list[_Place | None]:
    """Return positions by the tracks, in the order of the logs; None where no track reaches."""
    places: list[_Place | None] = [None] * len(times_ns)
    for flight in flights:
        if flight.trajectory is None:
            continue
        antenna = flight.trajectory.at(times_ns)
        found = camera_positions(antenna, flight.attitudes, options.lever_arm_m) if flight.attitudes else antenna
        for n, (fix, velocity) in enumerate(zip(found.fixes(), found.velocity_m_s, strict=True)):
            if places[n] is None and fix is not None:
                places[n] = (fix, _velocity(velocity), "")
    return places


def _velocity(velocity_m_s: Array) -> tuple[float, float, float] | None:
    east, north, up = velocity_m_s.tolist()
    return (east, north, up) if np.isfinite([east, north, up]).all() else None


def _as_logged(event: ExposureEvent, options: LogOptions) -> _Place:
    """Return the position that the event itself tells, if any, and if nothing has to move it along a track."""
    if options.shutter_latency_s or any(options.lever_arm_m):
        return None, None, "the track does not reach it, along which latency and lever arm would move it"
    if event.position is not None:
        return event.position, None, ""
    return None, None, "the log tells no position at that time"


def turned_by_attitude(flights: Sequence[LoggedFlight]) -> bool:
    """Tell whether the logs' attitudes turn a lever arm, so that the adjustment must not do it again."""
    return all(flight.attitudes is not None for flight in flights if len(flight.events))


def listed_fixes(logs: Sequence[FlightLog]) -> list[GnssFix]:
    """Return the positions of exposures that logs list without times (waypoints)."""
    return [
        event.position
        for log in logs
        for event, kind in zip(log.exposures(), log.exposure_table.kind, strict=True)
        if kind == ExposureKind.LISTED and event.gps_time_ns is None and event.position is not None
    ]
