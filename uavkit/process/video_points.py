"""Candidate pass points through the video: from still to still, old points carried on and new ones added.

Anai et al. 2012, figure 7. Both stills take part as pictures of the sequence, reduced to the video's geometry, so an
error of the transformation between still and video cancels.
"""

from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice, pairwise

import cv2
import numpy as np
from scipy.spatial import cKDTree

from uavkit.core.arrays import Array, Flags, Image, Indices, content_hash
from uavkit.core.block import StillInVideo, VideoSync
from uavkit.core.cache import Arrays, StepCache
from uavkit.core.devices import VideoSource
from uavkit.core.errors import InputError
from uavkit.core.progress import Progress, silent
from uavkit.core.result import PointOrigin
from uavkit.core.video import AffineTransformation, fields_of_frame
from uavkit.process.candidates import Candidates
from uavkit.process.contrast import FAINT, contrast, stretched
from uavkit.process.measurement import RayTasks, measure_rays
from uavkit.process.options import CandidateOptions, MeasurementOptions
from uavkit.process.orientation_code import orientation_codes, richness, select_points
from uavkit.process.pictures import PictureStore, PyramidStore
from uavkit.process.pyramid import PyramidOptions, full_from_level, refine_through_pyramid
from uavkit.process.tracking import TimedPicture, square_field, track

_DETECTION_LEVEL = 2
"""Points are chosen on the still at a quarter of its size: texture that the video can still show."""
_VIDEO_RADIUS = 2.5
"""How far a tracked position may be off, in video pixels."""
_EXTENDED_RADIUS = 8.0
"""The same for points whose motion is their neighbours'."""
_LEAST_NEIGHBOURS = 12
_MOST_RAYS_CARRIED = 8
LEAST_THROUGH_VIDEO = 20
"""Verified points that make a gap between two stills bridged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoInput:
    """Everything that tracking through the video needs."""

    video: VideoSource
    sync: VideoSync
    store: PictureStore
    pyramids: PyramidStore
    candidates: CandidateOptions
    measurement: MeasurementOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoCandidates:
    """Points through the video, and the pairs of stills between which it did not lead."""

    candidates: Candidates
    weak_pairs: list[tuple[int, int]]
    matches: dict[int, Array]
    """For each still the (n, 4) points of it that were found in the next one: column, row here and there."""


@dataclass(slots=True, kw_only=True)
class _Carried:
    """Points alive in the present still."""

    point: Indices
    reference_image: Indices
    reference_px: Array
    here_px: Array
    here_from_reference: Array
    """(n, 2, 2)."""
    rays: Indices


def candidates_through_video(
    given: VideoInput, cache: StepCache, *, workers: int, progress: Progress
) -> VideoCandidates:
    """Follow points through all gaps between stills that have a place in the video.

    Several workers match, and decode video and stills ahead, a bounded number of pictures; the result is the same to
    the last bit with any number of them.
    """
    with ThreadPoolExecutor(workers) if workers > 1 else nullcontext() as pool:
        return _through_all_gaps(given, cache, Helpers(given, pool, workers), progress)


def _through_all_gaps(given: VideoInput, cache: StepCache, helpers: "Helpers", progress: Progress) -> VideoCandidates:
    places = given.sync.places
    row_of = {name: row for row, name in enumerate(given.store.names)}
    parts: list[tuple[Indices, Indices, Array, Array]] = []
    references: list[tuple[Indices, Array]] = []
    weak: list[tuple[int, int]] = []
    matches: dict[int, Array] = {}
    total, carried = 0, _nothing_carried()
    for number, (here, there) in enumerate(pairwise(places)):
        progress("tracking through the video", number, len(places) - 1)
        image, target = row_of[here.still], row_of[there.still]
        fresh = _new_points(given, helpers.chosen(image), image, carried.here_px)
        references.append((np.full(len(fresh), image), fresh))
        points = _with_new(carried, fresh, image, total)
        total += len(fresh)
        step = cache.arrays(
            "video",
            _gap_key(given, image, target, (here, there), points),
            lambda here=here, there=there, target=target, points=points: _follow_gap(  # type: ignore[misc]
                given, (here, there), target, points, helpers
            ),
        )
        ok = step["ok"]
        parts.append((points.point[ok], np.full(int(ok.sum()), target), step["xy"][ok], step["sigma"][ok]))
        matches[image] = np.column_stack([points.here_px[ok], step["xy"][ok]])
        if int(ok.sum()) < LEAST_THROUGH_VIDEO:
            weak.append((min(image, target), max(image, target)))
        carried = _carried_on(points, ok, step["xy"], step["warps"])
    progress("tracking through the video", len(places) - 1, len(places) - 1)
    return VideoCandidates(candidates=_collected(references, parts), weak_pairs=weak, matches=matches)


def _nothing_carried() -> _Carried:
    none = np.zeros(0, dtype=np.int64)
    return _Carried(
        point=none,
        reference_image=none,
        reference_px=np.zeros((0, 2)),
        here_px=np.zeros((0, 2)),
        here_from_reference=np.zeros((0, 2, 2)),
        rays=none,
    )


class Helpers:
    """Threads that share the work, and what tracking needs of each still, made once: of the next one ahead of time."""

    def __init__(self, given: VideoInput, pool: Executor | None = None, workers: int = 1) -> None:
        self.pool, self.workers = pool, workers
        self._given = given
        self._coming: tuple[int, Future[object]] | None = None
        self._as_video = lru_cache(maxsize=3)(self._reduce)
        self._chosen = lru_cache(maxsize=3)(lambda image: _choose_points(given, image))

    def _reduce(self, image: int) -> Image:
        info = self._given.video.info()
        shape = info.height_px, info.width_px
        return still_as_video(self._given.store.grey(image), self._given.sync.still_from_video, shape)

    def expect(self, image: int) -> None:
        """Begin to make what will be asked about a still, where there is a thread to do it."""
        if self.pool is not None:
            self._coming = image, self.pool.submit(lambda: (self._as_video(image), self._chosen(image)))

    def _wait_for(self, image: int) -> None:
        if self._coming is not None and self._coming[0] == image:
            self._coming[1].result()
            self._coming = None

    def as_video(self, image: int) -> Image:
        """Return a still as the video would show it."""
        self._wait_for(image)
        return self._as_video(image)

    def chosen(self, image: int) -> Array:
        """Return the points (n, 2) of a still that are worth following."""
        self._wait_for(image)
        return self._chosen(image)


def read_ahead(pictures: Iterable[TimedPicture], pool: Executor | None, at_once: int = 8) -> Iterator[TimedPicture]:
    """Yield pictures while a thread already reads the next few."""
    if pool is None:
        yield from pictures
        return
    source = iter(pictures)
    coming = pool.submit(lambda: list(islice(source, at_once)))
    while batch := coming.result():
        coming = pool.submit(lambda: list(islice(source, at_once)))
        yield from batch


def _cell_px(given: VideoInput, image: int) -> tuple[int, int]:
    """Return the level of the pyramid on which points are chosen, and the side of its cells."""
    pyramid = given.pyramids.get(image)
    level = min(_DETECTION_LEVEL, len(pyramid.grey) - 1)
    return level, max(8, max(pyramid.grey[level].shape) // given.candidates.cells)


def _choose_points(given: VideoInput, image: int) -> Array:
    """Choose points of highest orientation code richness, evenly spread, (n, 2)."""
    level, cell_px = _cell_px(given, image)
    field = richness(orientation_codes(given.pyramids.get(image).grey[level]))
    return full_from_level(select_points(field, cell_px, given.candidates.per_cell, 16), level)


def _new_points(given: VideoInput, chosen: Array, image: int, present_px: Array) -> Array:
    """Of the points chosen in a still (n, 2) those that have no carried point near."""
    if len(present_px) == 0 or len(chosen) == 0:
        return chosen
    level, cell_px = _cell_px(given, image)
    nearest, _ = cKDTree(present_px).query(chosen)
    return np.asarray(chosen[nearest > 0.35 * cell_px * 2.0**level])


def _with_new(carried: _Carried, fresh: Array, image: int, first_number: int) -> _Carried:
    n = len(fresh)
    return _Carried(
        point=np.concatenate([carried.point, first_number + np.arange(n)]),
        reference_image=np.concatenate([carried.reference_image, np.full(n, image)]),
        reference_px=np.concatenate([carried.reference_px, fresh]),
        here_px=np.concatenate([carried.here_px, fresh]),
        here_from_reference=np.concatenate([carried.here_from_reference, np.tile(np.eye(2), (n, 1, 1))]),
        rays=np.concatenate([carried.rays, np.zeros(n, dtype=np.int64)]),
    )


def _carried_on(points: _Carried, ok: Flags, xy_px: Array, warps: Array) -> _Carried:
    keep = ok & (points.rays < _MOST_RAYS_CARRIED)
    return _Carried(
        point=points.point[keep],
        reference_image=points.reference_image[keep],
        reference_px=points.reference_px[keep],
        here_px=xy_px[keep],
        here_from_reference=warps[keep],
        rays=points.rays[keep] + 1,
    )


def _gap_key(
    given: VideoInput, image: int, target: int, places: tuple[StillInVideo, StillInVideo], points: _Carried
) -> str:
    sync = given.sync
    return content_hash(
        [
            "video 5",
            given.video.fingerprint(),
            given.store.fingerprint(image),
            given.store.fingerprint(target),
            repr(places),
            repr((sync.field_order, sync.frame_interval_ns, given.measurement)),
            sync.still_from_video.matrix,
            sync.still_from_video.shift,
            points.reference_image,
            points.reference_px,
            points.here_px,
            points.here_from_reference,
        ]
    )


def _follow_gap(
    given: VideoInput, places: tuple[StillInVideo, StillInVideo], target: int, points: _Carried, helpers: Helpers
) -> Arrays:
    """Track points of one still to the next, descend to its pixels, and measure them against their references."""
    helpers.expect(target)
    (tracked_px, tracked, there_from_here), repeats = _tracked(given, places, points.here_px, helpers)
    helpers.as_video(target)  # waits until the pictures of the target are there: they need not be made twice
    xy, extended = tracked_px, np.zeros_like(tracked)
    if not repeats:  # predictions are off by more than half a period: tie point matching will find these points
        xy, extended, there_from_here = extend_motion(points.here_px, tracked_px, tracked, there_from_here)
    warps = there_from_here @ points.here_from_reference
    found = np.zeros(len(xy), dtype=bool)
    jobs = [
        (radius, reference, np.flatnonzero(group & (points.reference_image == reference)))
        for group, radius in ((tracked, _VIDEO_RADIUS), (extended, _EXTENDED_RADIUS))
        for reference in np.unique(points.reference_image[group]).tolist()
    ]

    def descend(job: tuple[float, int, Indices]) -> None:
        radius, reference, rows = job
        refined = refine_through_pyramid(
            given.pyramids.get(reference),
            given.pyramids.get(target),
            points.reference_px[rows],
            xy[rows],
            warps[rows],
            PyramidOptions(start_radius_px=radius * _still_px_per_video_px(given.sync)),
        )
        xy[rows[refined.ok]], found[rows] = refined.target_px[refined.ok], refined.ok

    for _ in map(descend, jobs) if helpers.pool is None else helpers.pool.map(descend, jobs):
        pass
    return _measured(given, target, points, xy, warps, found, helpers.workers)


def _still_px_per_video_px(sync: VideoSync) -> float:
    return float(np.sqrt(abs(np.linalg.det(sync.still_from_video.matrix))))


def extend_motion(here_px: Array, there_px: Array, tracked: Flags, warps: Array) -> tuple[Array, Flags, Array]:
    """Predict where points (n, 2) went that the video did not show to the end: the finder crops the still's rim.

    Each takes the affine motion of its nearest tracked neighbours, drawn towards that of all. Returns positions
    (n, 2), which points were predicted so, and there_from_here (n, 2, 2); tracked points stay as they are.
    """
    nothing = np.zeros(len(here_px), dtype=bool)
    if int(tracked.sum()) < _LEAST_NEIGHBOURS:
        return there_px, nothing, warps
    here, there = here_px[tracked], there_px[tracked]
    whole, *_ = np.linalg.lstsq(np.column_stack([here, np.ones(len(here))]), there, rcond=None)
    rest = np.flatnonzero(~tracked)
    _, near = cKDTree(here).query(here_px[rest], k=_LEAST_NEIGHBOURS)
    middle = here[near].mean(axis=1)
    offset = here[near] - middle[:, None]
    residual = there[near] - (here[near] @ whole[:2] + whole[2])
    normal = np.einsum("nki,nkj->nij", offset, offset)
    normal += 0.5 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(2)
    extra = np.linalg.solve(normal, np.einsum("nki,nkj->nij", offset, residual))
    xy, turned = there_px.copy(), warps.copy()
    base = here_px[rest] @ whole[:2] + whole[2] + residual.mean(axis=1)
    xy[rest] = base + np.einsum("ni,nij->nj", here_px[rest] - middle, extra)
    turned[rest] = (whole[:2] + extra).transpose(0, 2, 1)
    return xy, np.asarray(~tracked), turned


def _measured(
    given: VideoInput, target: int, points: _Carried, xy: Array, warps: Array, found: Flags, workers: int
) -> Arrays:
    rows = np.flatnonzero(found)
    tasks = RayTasks(
        point=points.point[rows],
        reference_image=points.reference_image[rows],
        reference_px=points.reference_px[rows],
        target_image=np.full(len(rows), target),
        start_px=xy[rows],
        warps=warps[rows],
    )
    rays = measure_rays(given.pyramids, tasks, given.measurement, workers=workers, progress=silent, stage="")
    ok, sigma = np.zeros(len(xy), dtype=bool), np.full((len(xy), 2), np.nan)
    ok[rows] = rays.ok
    sigma[rows] = rays.sigma_px
    xy, warps = xy.copy(), warps.copy()
    xy[rows], warps[rows] = rays.target_px, rays.warps
    return {"ok": ok, "xy": xy, "warps": warps, "sigma": sigma}


def track_between_stills(
    given: VideoInput,
    places: tuple[StillInVideo, StillInVideo],
    here_px: Array,
    helpers: Helpers | None = None,
) -> tuple[Array, Flags, Array]:
    """Follow points (n, 2) of one still through the video to the next one.

    Returns where they are there (n, 2) in still pixels, which were found, and there_from_here (n, 2, 2) about each.
    """
    return _tracked(given, places, here_px, helpers or Helpers(given))[0]


def _tracked(
    given: VideoInput, places: tuple[StillInVideo, StillInVideo], here_px: Array, helpers: Helpers
) -> tuple[tuple[Array, Flags, Array], bool]:
    """Return what ``track_between_stills`` does, and whether the ground repeats itself."""
    nothing = here_px.copy(), np.zeros(len(here_px), dtype=bool), np.tile(np.eye(2), (len(here_px), 1, 1))
    video_from_still = given.sync.still_from_video.inverse()
    info = given.video.info()
    start = video_from_still.apply(here_px)
    inside = np.all((start > 12) & (start < np.array([info.width_px - 13, info.height_px - 13])), axis=1)
    if int(inside.sum()) < 6:
        return nothing, False
    pictures = pictures_between(given, places, helpers)
    try:
        result = track(pictures, start[inside], rng=np.random.default_rng(places[0].last_frame), pool=helpers.pool)
    except InputError:
        return nothing, False
    end_s = places[1].exposure_time_ns * 1e-9
    xy, alive, warps = nothing
    xy[inside] = given.sync.still_from_video.apply(result.points_px)
    alive[inside] = result.alive & (abs(result.time_s - end_s) < 1e-6)
    scale = given.sync.still_from_video.matrix
    warps[inside] = scale @ result.warps @ np.linalg.inv(scale)
    return (xy, alive, warps), result.repeats


def pictures_between(
    given: VideoInput, places: tuple[StillInVideo, StillInVideo], helpers: Helpers
) -> Iterator[TimedPicture]:
    """Yield the first still, all fields between the two shutters, and the second still, all in video geometry.

    All are stretched where the first still shows faint ground.
    """
    here, there = places
    names = given.store.names
    first, last = (helpers.as_video(names.index(place.still)) for place in (here, there))
    fields = _fields_between(given, places)
    if contrast(first) < FAINT:
        first, last, fields = stretched(first), stretched(last), map(_stretched_field, fields)
    yield TimedPicture(image=first, time_s=here.exposure_time_ns * 1e-9)
    yield from read_ahead(fields, helpers.pool)
    yield TimedPicture(image=last, time_s=there.exposure_time_ns * 1e-9)


def _stretched_field(picture: TimedPicture) -> TimedPicture:
    return replace(picture, image=stretched(picture.image))


def _fields_between(given: VideoInput, places: tuple[StillInVideo, StillInVideo]) -> Iterator[TimedPicture]:
    """Yield all fields between two shutters with square pixels."""
    for frame in given.video.frames(places[0].first_frame, places[1].last_frame):
        for field in fields_of_frame(frame, given.sync.field_order, given.sync.frame_interval_ns):
            image = field.lines if field.row_step == 1 else square_field(field.lines, field.first_row)
            yield TimedPicture(image=image, time_s=field.time_ns * 1e-9, usable=not frame.damaged)


def still_as_video(grey: Image, still_from_video: AffineTransformation, shape: tuple[int, int]) -> Image:
    """Return a still as the video would show it: (height, width), averaged over the area of a video pixel."""
    scale = float(np.sqrt(abs(np.linalg.det(still_from_video.matrix))))
    soft = cv2.GaussianBlur(grey, (0, 0), 0.5 * scale) if scale > 1.2 else grey
    matrix = np.column_stack([still_from_video.matrix, still_from_video.shift])
    warped = cv2.warpAffine(
        soft,
        matrix,
        (shape[1], shape[0]),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(warped, dtype=np.uint8)


def _collected(
    references: list[tuple[Indices, Array]], parts: list[tuple[Indices, Indices, Array, Array]]
) -> Candidates:
    reference_image = np.concatenate([r[0] for r in references]) if references else np.zeros(0, np.int64)
    return Candidates(
        reference_image=reference_image,
        reference_px=np.concatenate([r[1] for r in references]) if references else np.zeros((0, 2)),
        origin=np.full(len(reference_image), PointOrigin.VIDEO, dtype=np.int8),
        ray_point=np.concatenate([p[0] for p in parts]) if parts else np.zeros(0, np.int64),
        ray_image=np.concatenate([p[1] for p in parts]) if parts else np.zeros(0, np.int64),
        ray_px=np.concatenate([p[2] for p in parts]) if parts else np.zeros((0, 2)),
        ray_sigma_px=np.concatenate([p[3] for p in parts]) if parts else np.zeros((0, 2)),
    )
