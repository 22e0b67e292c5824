"""The stills of a flight in its logs: each with its exposure and its position there, or the reason why not."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np

from uavkit.core.block import VideoSync
from uavkit.core.errors import InputError
from uavkit.core.exposures import CameraClock, ExposureMatches, StillExposure, StillState, UnusedEvent
from uavkit.core.flight_log import FlightLog
from uavkit.core.gpstime import NO_TIME
from uavkit.core.progress import Progress
from uavkit.core.records import GnssFix, StillInfo
from uavkit.formats.match_file import NONE, MatchRow
from uavkit.ingest.exposure_matching import CameraClock as FoundClock
from uavkit.ingest.exposure_matching import EventState, ExposureMatching, match_exposures
from uavkit.ingest.exposure_stamps import ExposureStamps, MergedExposures, StillStamps, merge_exposures
from uavkit.ingest.log_positions import (
    EventPosition,
    LoggedFlight,
    LogOptions,
    positions_of_events,
    prepare_flights,
    turned_by_attitude,
)
from uavkit.ingest.match_overrides import BY_HAND, apply_overrides
from uavkit.ingest.positions import JoinedPositions, PositionOptions

LEAST_SHOWN, SHARE_SHOWN = 5, 0.8
"""So many stills, and so much of all, must show their shutter in the video for its times to be used."""
OTHER_DAY_S = 36 * 3600.0
"""Local time is at most 14 hours off, and a clock left on the wrong half of the day 12 more."""
MOST_NAMED = 20
"""Stills or events named in a note; the table has them all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedStills:
    """What logs tell of the stills."""

    matches: ExposureMatches | None
    """None where no log tells of exposures with times."""
    joined: JoinedPositions
    notes: tuple[str, ...]
    """What is odd about the logs, and what the matching found."""
    lever_arm_taken_off: bool
    """Whether the positions are those of the camera already."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GivenMatches:
    """What the user says of stills and their exposures."""

    rows: tuple[MatchRow, ...] = ()
    source: str = ""
    """Path, for messages."""


def stills_in_logs(
    infos: Sequence[StillInfo],
    logs: Sequence[FlightLog],
    given: GivenMatches,
    options: LogOptions,
    progress: Progress,
    video: VideoSync | None = None,
) -> LoggedStills:
    """Match the stills with the exposures of logs, and place them by the logs' fixes at these times.

    Where the shutters of most stills show in the video, their times there take the place of EXIF's, which are coarser.
    Raises InputError where what is given by hand names no still or no exposure, or there is none to give.
    """
    flights = prepare_flights(logs)
    notes = [note for flight in flights for note in flight.notes]
    merged = _merged(flights)
    if not len(merged.stamps.gps_ns):
        if given.rows:
            raise InputError(f"{given.source}: no log tells of exposures with times, which stills could be given to")
        if logs:
            notes.append("no log tells of exposures with times: the stills cannot be matched with the logs by time")
        return LoggedStills(matches=None, joined=_nothing(len(infos)), notes=tuple(notes), lever_arm_taken_off=False)
    stamps = _video_stamps(infos, video) if _tells_times(video, len(infos)) else _still_stamps(infos)
    found = match_exposures(stamps, merged.stamps, progress=progress)
    if given.rows:
        found = apply_overrides(found, stamps.name, merged.stamps, given.rows, given.source)
    places = _places(flights, merged, found, options)
    matches = ExposureMatches(
        sources=tuple(flight.log.source for flight in flights),
        stills=tuple(_still(row, info, (merged, found), places.get(row)) for row, info in enumerate(infos)),
        unused=_unused(merged, found),
        events=len(merged.stamps.gps_ns),
        clocks=tuple(_clock(clock, infos) for clock in found.clocks if clock.settled),
        shutter_latency_s=options.shutter_latency_s,
        lever_arm_m=options.lever_arm_m,
    )
    notes += [*merged.notes, *found.notes, *_option_notes(options), *match_notes(matches)]
    joined = _joined(matches, places, len(infos))
    return LoggedStills(
        matches=matches, joined=joined, notes=tuple(notes), lever_arm_taken_off=turned_by_attitude(flights)
    )


def _option_notes(options: LogOptions) -> list[str]:
    """Return what was stated of shutter and antenna, so that a wrong unit is seen."""
    notes = []
    if options.shutter_latency_s:
        notes.append(f"shutter latency as stated: exposures {1e3 * options.shutter_latency_s:g} ms after their events")
    if any(options.lever_arm_m):
        forward, right, down = options.lever_arm_m
        notes.append(
            f"antenna as stated: {forward:g} m ahead of the camera, {right:g} m to its right, {down:g} m below it"
        )
    return notes


def _nothing(count: int) -> JoinedPositions:
    return JoinedPositions(fixes=(None,) * count, probability=np.zeros(count), from_exif=False, discarded=(), notes=())


def _merged(flights: Sequence[LoggedFlight]) -> MergedExposures:
    """Return the exposures of all logs, each once, by corrected GPS time."""
    names = short_names([flight.log.source for flight in flights])
    stamps = [
        ExposureStamps(
            gps_ns=flight.event_gps_ns,
            sigma_s=flight.log.exposure_table.sigma_s[flight.events],
            label=tuple(_label(flight.log, name, row) for row in flight.events.tolist()),
        )
        for flight, name in zip(flights, names, strict=True)
    ]
    return merge_exposures(stamps, [flight.log.source for flight in flights])


def short_names(sources: Sequence[str]) -> list[str]:
    """Return the ends of paths that tell them apart: the files' names, with as many folders as that needs."""
    parts = [source.split("/") for source in sources]
    for depth in range(1, max(map(len, parts), default=0)):
        names = ["/".join(path[-depth:]) for path in parts]
        if len(set(names)) == len(set(sources)):
            return names
    return list(sources)


def _label(log: FlightLog, name: str, row: int) -> str:
    """Return what the user knows an event by: its log, and its number there."""
    sequence = int(log.exposure_table.sequence[row])
    return f"{name} {row + 1}" if sequence in (-1, row + 1) else f"{name} {row + 1} (number {sequence})"


def _still_stamps(infos: Sequence[StillInfo]) -> StillStamps:
    times = [NO_TIME if info.camera_time_ns is None else info.camera_time_ns for info in infos]
    return StillStamps(
        name=tuple(info.name for info in infos),
        time_ns=np.array(times, dtype=np.int64),
        resolution_ns=np.array([info.camera_time_resolution_ns for info in infos], dtype=np.int64),
    )


def _tells_times(video: VideoSync | None, stills: int) -> TypeGuard[VideoSync]:
    shown = 0 if video is None else sum(place.kind != "content" for place in video.places)
    return shown >= max(LEAST_SHOWN, SHARE_SHOWN * stills)


def _video_stamps(infos: Sequence[StillInfo], video: VideoSync) -> StillStamps:
    """Return the times at which the shutters show in the video, on the camera's clock as far as EXIF tells it.

    Each is good to the field in which the picture went. Stills whose shutter does not show have no time.
    """
    field_ns = video.frame_interval_ns // 2
    shown = {p.still: p.exposure_time_ns - field_ns // 2 for p in video.places if p.kind != "content"}
    apart = [
        info.camera_time_ns + info.camera_time_resolution_ns // 2 - shown[info.name]
        for info in infos
        if info.camera_time_ns is not None and info.name in shown
    ]
    zero_ns = int(np.median(apart)) if apart else 0
    return StillStamps(
        name=tuple(info.name for info in infos),
        time_ns=np.array([zero_ns + shown.get(info.name, NO_TIME - zero_ns) for info in infos], dtype=np.int64),
        resolution_ns=np.full(len(infos), field_ns, dtype=np.int64),
    )


def _places(
    flights: Sequence[LoggedFlight], merged: MergedExposures, found: ExposureMatching, options: LogOptions
) -> dict[int, EventPosition]:
    """Return the positions of the stills that have an event, by their rows."""
    rows = found.used().tolist()
    events = []
    for row in rows:
        event = int(found.event[row])
        log, own = int(merged.log[event]), int(merged.row[event])
        events.append((log, int(flights[log].events[own]), int(merged.stamps.gps_ns[event])))
    return dict(zip(rows, positions_of_events(flights, events, options), strict=True))


def _still(
    row: int, info: StillInfo, known: tuple[MergedExposures, ExposureMatching], place: EventPosition | None
) -> StillExposure:
    merged, found = known
    state, event = found.state[row], int(found.event[row])
    if found.reason[row] == BY_HAND:
        state = StillState.GIVEN
    named = event >= 0 and state is not StillState.NO_EVENT
    fix = place.fix if place is not None else None
    if fix is not None and place is not None and found.spread_s[row] > 0:
        fix = _less_certain(fix, place, float(found.spread_s[row]))
    return StillExposure(
        still=info.name,
        state=state,
        probability=float(found.probability[row]) if named else 0.0,
        event=event + 1 if named else None,
        label=merged.stamps.label[event] if named else "",
        event_gps_time_ns=None if place is None else place.event_gps_time_ns,
        gps_time_ns=None if place is None else place.gps_time_ns,
        position=None if fix is None else replace(fix, name=info.name),
        reason=found.reason[row] or ("" if place is None else place.reason),
    )


def _less_certain(fix: GnssFix, place: EventPosition, spread_s: float) -> GnssFix:
    """Return a position with the uncertainty of a time somewhere within ``spread_s``."""
    east, north, up = place.velocity_m_s or (0.0, 0.0, 0.0)
    usual = PositionOptions()
    share_s = spread_s / np.sqrt(12.0)
    horizontal = np.hypot(fix.sigma_horizontal_m or usual.sigma_horizontal_m, np.hypot(east, north) * share_s)
    vertical = np.hypot(fix.sigma_vertical_m or usual.sigma_vertical_m, up * share_s)
    return replace(fix, sigma_horizontal_m=float(horizontal), sigma_vertical_m=float(vertical))


def _unused(merged: MergedExposures, found: ExposureMatching) -> tuple[UnusedEvent, ...]:
    return tuple(
        UnusedEvent(
            event=row + 1,
            gps_time_ns=int(merged.stamps.gps_ns[row]),
            source=merged.stamps.label[row],
            reason=found.event_reason[row],
        )
        for row, state in enumerate(found.event_state)
        if state is not EventState.MATCHED
    )


def _clock(clock: FoundClock, infos: Sequence[StillInfo]) -> CameraClock:
    return CameraClock(
        stills=tuple(infos[row].name for row in clock.stills.tolist()),
        reference_gps_ns=clock.reference_gps_ns,
        offset_s=clock.offset_s,
        offset_sigma_s=clock.sigma_offset_s,
        drift_ppm=clock.drift_ppm,
        drift_sigma_ppm=clock.sigma_drift_ppm,
        residual_s=clock.residual_s,
    )


def _joined(matches: ExposureMatches, places: dict[int, EventPosition], count: int) -> JoinedPositions:
    """Return the matched positions as those of the stills."""
    velocity = np.full((count, 3), np.nan)
    flight = np.zeros(count, dtype=np.int64)
    for row, place in places.items():
        flight[row] = place.flight
        if place.velocity_m_s is not None:
            velocity[row] = place.velocity_m_s
    return JoinedPositions(
        fixes=tuple(entry.position for entry in matches.stills),
        probability=np.array([entry.probability if entry.position else 0.0 for entry in matches.stills]),
        from_exif=False,
        discarded=(),
        notes=(),
        velocity_m_s=velocity if np.isfinite(velocity).any() else None,
        flight=flight,
    )


def match_notes(matches: ExposureMatches) -> tuple[str, ...]:
    """Return in words how many stills and events belong together, and what is left open."""
    matched = [entry for entry in matches.stills if entry.position is not None or entry.gps_time_ns is not None]
    notes = [f"{len(matched)} of {len(matches.stills)} stills matched with {matches.events} exposures of the logs"]
    if any(entry.state is StillState.AMBIGUOUS for entry in matches.stills):
        notes.append(
            "to decide what is ambiguous: fill 'event' in a copy of ingest/exposures.csv and give it as --match"
        )
    for state, what in (
        (StillState.AMBIGUOUS, "ambiguous, their exposures are not used"),
        (StillState.NO_EVENT, "without an exposure in the logs"),
        (StillState.NO_TIME, "without a time"),
    ):
        names = [entry.still for entry in matches.stills if entry.state is state]
        if names:
            notes.append(f"{len(names)} stills {what}: {_named(names)}")
    notes += _doubtful_dates(matches)
    without = [entry.still for entry in matched if entry.position is None]
    if without:
        notes.append(f"{len(without)} stills matched, but the logs tell no position then: {_named(without)}")
    notes += [f"exposure {entry.source} is not used: {entry.reason}" for entry in matches.unused[:MOST_NAMED]]
    if len(matches.unused) > MOST_NAMED:
        notes.append(
            f"{len(matches.unused) - MOST_NAMED} more exposures are not used: see the end of ingest/exposures.csv"
        )
    return tuple(notes)


def _doubtful_dates(matches: ExposureMatches) -> list[str]:
    return [
        f"the dates of {len(clock.stills)} stills from {clock.stills[0]} on are {abs(clock.offset_s) / 86_400.0:.0f} "
        "days from those of the logs: the camera's date was wrong, or they are of another flight of the same pattern"
        for clock in matches.clocks
        if abs(clock.offset_s) > OTHER_DAY_S
    ]


def _named(names: Sequence[str]) -> str:
    return ", ".join(names[:MOST_NAMED]) + (", ..." if len(names) > MOST_NAMED else "")


def rows_of_matches(matches: ExposureMatches) -> tuple[MatchRow, ...]:
    """Return which still has which exposure; what is ambiguous is left open, with the reason beside it."""
    rows = []
    for entry in matches.stills:
        event = entry.label if entry.gps_time_ns is not None else ""
        rows.append(
            MatchRow(
                image=entry.still,
                event=NONE if entry.state is StillState.NO_EVENT else event,
                gps_time=""
                if entry.gps_time_ns is None
                else f"{entry.gps_time_ns // 10**9}.{entry.gps_time_ns % 10**9:09d}",
                state=entry.state.value,
                probability=f"{entry.probability:.5f}",
                reason=entry.reason,
            )
        )
    return tuple(rows)
