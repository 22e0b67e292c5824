"""The ingest stage: stills, video, positions and surveyed points become a block."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.block import Block, PositionFacts, PositionSource, VideoSync
from uavkit.core.camera import CameraProfile
from uavkit.core.devices import GnssReceiver, StillSource, VideoSource
from uavkit.core.errors import InputError
from uavkit.core.flight_log import FlightLog
from uavkit.core.frames import LocalFrame, ellipsoid_heights_m, geographic_from_crs, parse_crs
from uavkit.core.heights import HeightDatum
from uavkit.core.observations import GnssObservations
from uavkit.core.points import CheckPoint, ControlPoint
from uavkit.core.progress import Progress, silent
from uavkit.core.records import GnssFix, StillInfo
from uavkit.formats.control_file import SurveyedPoints
from uavkit.formats.positions_file import ImagePositions
from uavkit.ingest.control import MarkedPoints, height_notes, local_points, match_marks
from uavkit.ingest.log_positions import LogOptions, listed_fixes
from uavkit.ingest.logged_stills import GivenMatches, LoggedStills, stills_in_logs
from uavkit.ingest.planned import planned_notes
from uavkit.ingest.positions import (
    JoinedPositions,
    PositionOptions,
    common_sigma,
    exif_positions,
    fix_sigmas,
    join_named,
    join_positions,
)
from uavkit.ingest.still_matching import PreparedStills, prepare_stills
from uavkit.ingest.stills import camera_of_stills, check_one_camera, check_overlap
from uavkit.ingest.video_sync import SyncOptions, synchronise_prepared

OVERVIEW_WIDTH_PX = 640
"""Width to which stills are reduced where no video tells its own."""
LEAST_FOR_DATUM = 3
"""Positions or control points that fix where the block lies."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sources:
    """What a flight brings home."""

    stills: StillSource
    video: VideoSource | None = None
    logs: tuple[FlightLog, ...] = ()
    """Flight logs: the stills are matched with their exposures, and placed by their fixes."""
    positions: GnssReceiver | ImagePositions | None = None
    """Listed positions; they go before those of logs, which go before those of EXIF. Those that name their images are
    joined by these names alone."""
    given: GivenMatches = field(default_factory=GivenMatches)
    """What the user says of stills and exposures."""
    planned: tuple[GnssFix, ...] = ()
    """Where the plan takes pictures: told against what was taken."""
    control: SurveyedPoints | None = None
    check: SurveyedPoints | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class IngestOptions:
    """Options of ``build_block``."""

    crs: str = ""
    """CRS of the survey's files; empty: that of the control file, else the UTM zone of the place."""
    height_datum: HeightDatum | None = None
    """Of all listed and EXIF positions, whatever their source says; None: as the source says."""
    unknown_datum_sigma_m: float = 100.0
    """A priori sigma of the vertical shift of positions whose height datum is unknown."""
    known_datum_sigma_m: float = 2.0
    """The same of the horizontal shift, beside an unknown height datum."""
    logs: LogOptions = field(default_factory=LogOptions)
    latency_sigma_s: float = 0.1
    """A priori sigma of what the stated shutter latency may be off, where velocities are known; 0 holds it."""
    positions: PositionOptions = field(default_factory=PositionOptions)
    sync: SyncOptions = field(default_factory=SyncOptions)

    def __post_init__(self) -> None:
        if not min(self.unknown_datum_sigma_m, self.known_datum_sigma_m) > 0:
            raise ValueError("sigmas of shifts must be > 0")
        if self.height_datum is HeightDatum.GROUND:
            raise ValueError("height_datum must be ellipsoid, geoid or unknown: heights above ground are relative")


def build_block(
    sources: Sources,
    camera: CameraProfile | None = None,
    options: IngestOptions = IngestOptions(),
    progress: Progress = silent,
) -> Block:
    """Return the block of a flight; its notes tell every degradation and decision.

    Raises InputError where stills are mixed or do not overlap, the camera does not fit, control lies far away.
    """
    listed = sources.stills.stills()
    missing = _unreadable_headers(sources.stills)
    if not listed:
        raise InputError(f"no still can be read: {_reasons(missing) or 'the source is empty'}")
    check_one_camera(listed)
    profile, notes = camera_of_stills(listed, camera)
    width_px = sources.video.info().width_px if sources.video is not None else OVERVIEW_WIDTH_PX
    prepared = prepare_stills(sources.stills, listed, width_px, progress)
    missing |= prepared.unreadable
    stills = tuple(info for info in listed if info.name in prepared.pictures)
    if missing:
        notes += (f"{len(missing)} stills cannot be read and are left out: {_reasons(missing)}",)
    notes += check_overlap(stills, prepared.pictures, sources.video)
    sync, sync_notes = _video(sources.video, stills, prepared, options, progress)
    logged = stills_in_logs(stills, sources.logs, sources.given, options.logs, progress, sync)
    joined = _positions(sources, stills, tuple(missing), logged, options)
    control = _marked(sources.control, stills, tuple(missing))
    check = _marked(sources.check, stills, tuple(missing))
    block = Block(
        camera=profile,
        interior=profile.interior,
        stills=stills,
        frame=_frame(joined, control.surveyed, check.surveyed, options),
        video=sync,
        exposures=logged.matches,
        notes=(*notes, *sync_notes, *logged.notes, *joined.notes, *joined.discarded, *control.notes, *check.notes),
    )
    arm_m, arm_notes = _lever_arm(logged, joined, options)
    block = _with_positions(
        replace(block, notes=(*block.notes, *arm_notes)), joined, arm_m, options, len(control.surveyed.points)
    )
    stated = sources.positions.shift_sigma_m if isinstance(sources.positions, ImagePositions) else None
    block = _with_common_sigma(block, joined, stated, len(control.surveyed.points))
    return _with_points(block, control, check)


def _unreadable_headers(stills: StillSource) -> dict[str, str]:
    """Return the stills that the source itself found unreadable, where it tells."""
    told = getattr(stills, "unreadable", None)
    return dict(told()) if callable(told) else {}


def _reasons(unreadable: dict[str, str]) -> str:
    return "; ".join(f"{name}: {why}" for name, why in sorted(unreadable.items()))


def _video(
    video: VideoSource | None,
    stills: tuple[StillInfo, ...],
    prepared: PreparedStills,
    options: IngestOptions,
    progress: Progress,
) -> tuple[VideoSync | None, tuple[str, ...]]:
    if video is None:
        return None, ("no video: pass points are matched between the stills directly",)
    outcome = synchronise_prepared(prepared.pictures, stills, video, progress, options.sync)
    return outcome.sync, outcome.notes


def _positions(
    sources: Sources,
    stills: Sequence[StillInfo],
    absent: Sequence[str],
    logged: LoggedStills,
    options: IngestOptions,
) -> JoinedPositions:
    """Return listed positions, else those of logs, of EXIF; with the height datum that counts."""
    joined = _best_positions(sources, stills, absent, logged, options)
    if sources.planned:
        joined = replace(joined, notes=(*joined.notes, *planned_notes(sources.planned, joined)))
    return _with_datum(joined, options)


def _best_positions(
    sources: Sources,
    stills: Sequence[StillInfo],
    absent: Sequence[str],
    logged: LoggedStills,
    options: IngestOptions,
) -> JoinedPositions:
    if isinstance(sources.positions, ImagePositions):
        return join_named(stills, sources.positions, absent)
    fixes = list(sources.positions.fixes()) if sources.positions is not None else listed_fixes(sources.logs)
    joined = join_positions(stills, fixes, absent, options.positions) if fixes else None
    if joined is not None and joined.count:
        return joined
    notes, discarded = (joined.notes, joined.discarded) if joined is not None else ((), ())
    from_log = replace(logged.joined, source=PositionSource.LOG)
    found = from_log if logged.joined.count else exif_positions(stills)
    return replace(found, notes=(*notes, *found.notes), discarded=(*discarded, *found.discarded))


def _with_datum(joined: JoinedPositions, options: IngestOptions) -> JoinedPositions:
    if options.height_datum is None:
        return joined
    datum = options.height_datum
    told = tuple(None if fix is None else replace(fix, height_datum=datum) for fix in joined.fixes)
    return replace(joined, fixes=told)


def _marked(surveyed: SurveyedPoints | None, stills: Sequence[StillInfo], unreadable: Sequence[str]) -> MarkedPoints:
    if surveyed is None:
        return MarkedPoints(surveyed=_no_points(), notes=())
    return match_marks(surveyed, stills, unreadable)


def _no_points() -> SurveyedPoints:
    from uavkit.formats.control_file import PixelOrigin

    return SurveyedPoints(crs="EPSG:4326", vertical=HeightDatum.UNKNOWN, pixel_origin=PixelOrigin.CENTRE, points=())


def _geographic(fixes: Sequence[GnssFix]) -> Array:
    """Return latitude, longitude in degrees and ellipsoidal height (n, 3); heights above ground become NaN.

    Raises InputError where heights of different datums are mixed.
    """
    datums = {fix.height_datum for fix in fixes}
    if len(datums) > 1:
        names = ", ".join(sorted(datum.value for datum in datums))
        raise InputError(f"the positions mix heights of different datums ({names}): state one with --height-datum")
    table = np.array([[fix.latitude_deg, fix.longitude_deg, fix.height_m] for fix in fixes], dtype=np.float64)
    datum = datums.pop()
    if datum is HeightDatum.GROUND:
        table[:, 2] = np.nan
    else:
        table[:, 2] = ellipsoid_heights_m(table[:, 0], table[:, 1], table[:, 2], datum)
    return table


def _frame(
    joined: JoinedPositions, control: SurveyedPoints, check: SurveyedPoints, options: IngestOptions
) -> LocalFrame | None:
    """Return a local frame about the positions, else about the surveyed points; None where neither is known."""
    surveyed = control if control.points else check
    crs = options.crs
    if not crs and surveyed.points and not parse_crs(surveyed.crs).is_geographic:
        crs = surveyed.crs
    fixes = [fix for fix in joined.fixes if fix is not None]
    if fixes:
        place = _geographic(fixes)
    elif surveyed.points:
        coordinates = np.nan_to_num(np.array([point.coordinates for point in surveyed.points]))
        place = geographic_from_crs(coordinates, surveyed.crs)
    else:
        return None
    # rounded, so that the origin of the frame can be written down
    latitude, longitude = (round(float(np.median(column)), 7) for column in place.T[:2])
    heights = place[np.isfinite(place[:, 2]), 2]
    return LocalFrame.at(latitude, longitude, round(float(np.median(heights)), 2) if len(heights) else 0.0, crs)


def _with_positions(
    block: Block, joined: JoinedPositions, lever_arm_m: tuple[float, float, float], options: IngestOptions, control: int
) -> Block:
    """Add the positions as observations; the lever arm is in image space, zero where attitudes took it off."""
    rows = [index for index, fix in enumerate(joined.fixes) if fix is not None]
    if not rows or block.frame is None:
        return block
    fixes = [fix for fix in joined.fixes if fix is not None]
    place = _geographic(fixes)
    sigma_m = np.array([fix_sigmas(fix, joined.from_exif, options.positions) for fix in fixes])
    datum, notes = fixes[0].height_datum, list[str]()
    shift: tuple[float, float, float] | None = None
    if datum is HeightDatum.GROUND:
        place[:, 2] = block.frame.height_ellipsoid_m
        sigma_m[:, 2] = options.unknown_datum_sigma_m
        notes.append("the positions' heights count from the ground or are missing: only their horizontal part is used")
    elif datum is HeightDatum.UNKNOWN:
        notes.append("the datum of the positions' heights is unknown: taken as ellipsoidal, state it by --height-datum")
        if not control:
            shift = (options.known_datum_sigma_m, options.known_datum_sigma_m, options.unknown_datum_sigma_m)
            notes.append(
                f"without control, all heights may be off by some {options.unknown_datum_sigma_m:g} m together"
            )
    single = np.zeros(len(rows), dtype=np.int64)
    velocity = np.nan_to_num(joined.velocity_m_s[rows]) if joined.velocity_m_s is not None else None
    gnss = GnssObservations(
        image_index=np.array(rows, dtype=np.int64),
        position_m=block.frame.enu_from_geographic(*place.T),
        sigma_m=sigma_m,
        flight=np.unique(joined.flight[rows], return_inverse=True)[1] if joined.flight is not None else single,
        lever_arm_m=lever_arm_m,
        shift_sigma_m=shift,
        velocity_m_s=velocity,
        latency_sigma_s=options.latency_sigma_s if velocity is not None and options.latency_sigma_s > 0 else None,
    )
    facts = PositionFacts(
        source=joined.source,
        height_datum=datum,
        probability=joined.probability[rows],
        sigma_stated=np.array([fix.sigma_horizontal_m is not None for fix in fixes], dtype=np.bool_),
    )
    return replace(block, gnss=gnss, positions=facts, notes=(*block.notes, *notes))


def _lever_arm(
    logged: LoggedStills, joined: JoinedPositions, options: IngestOptions
) -> tuple[tuple[float, float, float], tuple[str, ...]]:
    """Return the lever arm that the adjustment has to turn, in image space, and notes.

    Attitudes of a log turn it at once. Without them the camera is taken to be fixed to the vehicle, looking down with
    the top of its image forward: right, forward, up are then x, y, z of image space.
    """
    forward, right, down = options.logs.lever_arm_m
    if not any((forward, right, down)):
        return (0.0, 0.0, 0.0), ()
    if joined.flight is not None and logged.lever_arm_taken_off:
        return (0.0, 0.0, 0.0), ("lever arm turned by the logged attitudes and taken off the positions",)
    note = "lever arm turned with the camera, taken as fixed to the vehicle, looking down with its top forward"
    return (right, forward, -down), (note,)


def _with_common_sigma(
    block: Block, joined: JoinedPositions, stated: tuple[float, float, float] | None, control_points: int
) -> Block:
    """Set the a priori sigma of the positions' common shift: what the file states, else that of RTK and PPK.

    The latter only where control does not fix the datum: there the shift is free, and a base station whose coordinates
    are off does no harm.
    """
    if block.gnss is None or block.gnss.shift_sigma_m is not None:
        return block
    if stated is not None:
        return replace(block, gnss=replace(block.gnss, shift_sigma_m=stated))
    found = common_sigma(joined) if control_points < LEAST_FOR_DATUM else None
    if found is None:
        return block
    note = (
        f"the positions state sigmas of RTK: their common shift is held to zero within {max(found):.3g} m; where the "
        "base station is known less well, state '# shift_sigma_m:' in the file of positions, or give control points"
    )
    return replace(block, gnss=replace(block.gnss, shift_sigma_m=found), notes=(*block.notes, note))


def _with_points(block: Block, control: MarkedPoints, check: MarkedPoints) -> Block:
    """Add control and check points, and say what fixes the block."""
    stations_m = block.gnss.position_m if block.gnss is not None else np.zeros((0, 3))
    if block.frame is not None:
        used = local_points(control.surveyed, block.frame, ControlPoint, stations_m)
        held = local_points(check.surveyed, block.frame, CheckPoint, stations_m)
        both = {point.name for point in used} & {point.name for point in held}
        if both:
            raise InputError(
                f"points that are both control and check: {', '.join(sorted(both))}: hold each back or use it"
            )
        notes = (*block.notes, *height_notes(used, held, stations_m))
        block = replace(block, control_points=used, check_points=held, notes=notes)
    return replace(block, notes=(*block.notes, *_datum_notes(block)))


def _datum_notes(block: Block) -> tuple[str, ...]:
    positions = 0 if block.gnss is None else len(block.gnss)
    control = len(block.control_points)
    if positions >= LEAST_FOR_DATUM or control >= LEAST_FOR_DATUM:
        return ()
    return (
        f"{control} control points and {positions} positions do not fix the block (3 of one kind do): it becomes a "
        "free network, of arbitrary position, direction and scale",
    )
