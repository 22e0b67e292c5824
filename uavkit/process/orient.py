"""From stills, video, positions and control to an oriented block: the processing core, step by step.

Candidates (through the video, by features) -> approximate orientation -> tie point matching by back-projection ->
variance components of the rays -> absolute orientation -> robust bundle block adjustment.
"""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from uavkit.core.adjustment import Datum
from uavkit.core.arrays import Array
from uavkit.core.block import Block
from uavkit.core.cache import NoCache, StepCache
from uavkit.core.devices import StillSource, VideoSource
from uavkit.core.errors import InputError
from uavkit.core.progress import Progress, silent
from uavkit.core.result import OrientedBlock, PointOrigin
from uavkit.process.absolute import robust_similarity
from uavkit.process.approximations import GrowingBlock, ray_table
from uavkit.process.calibration import calibrated
from uavkit.process.candidates import Candidates, empty, from_measurements, join
from uavkit.process.features import feature_tasks, match_features, pairs_to_compare
from uavkit.process.filling import RichPlaces, fill, rich_places
from uavkit.process.measurement import measure_rays
from uavkit.process.network import (
    HeldNetwork,
    MarkedPoints,
    Network,
    adjust_what_holds,
    interior_sigmas,
    marked_points,
    network_of,
    updated,
    without_weak_stills,
)
from uavkit.process.options import CandidateSource, ProcessOptions
from uavkit.process.parts import Pairs, joined_by_features, orient_in_parts
from uavkit.process.pictures import PictureStore, PyramidStore, return_freed_memory
from uavkit.process.ray_sigma import SigmaCalibration
from uavkit.process.summary import Findings, peak_memory_mb, summarise
from uavkit.process.thinning import points_apart
from uavkit.process.tie_points import ObjectGeometry, TiePointMatching, object_geometry, surface_normals
from uavkit.process.video_points import VideoInput, candidates_through_video

FILLING_ROUNDS = (1, 2, 3, 3)
"""Points that are tried in each empty cell, in one round after the other."""


@dataclass(kw_only=True)
class Workplace:
    """What every step needs besides its data; collects times and notes."""

    block: Block
    store: PictureStore
    pyramids: PyramidStore
    stills: StillSource
    video: VideoSource | None
    options: ProcessOptions
    cache: StepCache
    workers: int
    progress: Progress
    now_s: Callable[[], float]
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time a step."""
        begin = self.now_s()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + self.now_s() - begin


def orient_block(
    block: Block,
    stills: StillSource,
    video: VideoSource | None,
    options: ProcessOptions | None = None,
    *,
    cache: StepCache | None = None,
    workers: int = 1,
    progress: Progress = silent,
    now_s: Callable[[], float] = time.perf_counter,
) -> OrientedBlock:
    """Orient the stills of a block and adjust it; the result is the same to the last bit with any number of workers.

    Raises InputError for stills that cannot be read or do not overlap, AdjustmentError where the observations do not
    determine the block.
    """
    names = tuple(still.name for still in block.stills)
    if len(names) < 2:
        raise InputError(f"a block needs at least 2 stills, there are {len(names)}")
    return_freed_memory()
    store = PictureStore(stills, names)
    place = Workplace(
        block=block,
        store=store,
        pyramids=PyramidStore(store),
        stills=stills,
        video=video,
        options=options or ProcessOptions(),
        cache=cache or NoCache(),
        workers=workers,
        progress=progress,
        now_s=now_s,
    )
    candidates, growing = _approximate_block(place)
    marked = marked_points(block)
    tied = _tie(place, candidates, growing, marked)
    with place.step("absolute orientation"):
        network, oriented_absolutely = _to_object_space(place, tied.network, marked)
    with place.step("adjustment"):
        place.progress("adjustment", 0, 1)
        datum = None if oriented_absolutely else Datum.FREE_NETWORK
        held = adjust_what_holds(network, block, marked, place.options.adjustment, datum)
        place.progress("adjustment", 1, 1)
    with place.step("summary"):
        found = Findings(
            block=block,
            reasons={**tied.reasons, **held.reasons},
            candidates=tied.found,
            tied=tied.tied,
            network=held.network,
            marked=marked,
            adjusted=held.adjusted,
        )
        result = summarise(found, stills, place.pyramids)
    notes = (*place.notes, *held.adjusted.result.notes)
    return replace(result, seconds=place.seconds, notes=notes, peak_memory_mb=peak_memory_mb())


def _approximate_block(place: Workplace) -> tuple[Candidates, GrowingBlock]:
    """Find candidates and orient them; features join what the video leaves in parts."""
    through, pairs = _first_candidates(place)
    joined = joined_by_features(
        through,
        pairs,
        place.block.interior,
        lambda pairs: _feature_candidates(place, pairs),
        lambda candidates: _in_parts(place, candidates),
    )
    place.notes.extend(joined.notes)
    return joined.candidates, joined.block


def _first_candidates(place: Workplace) -> tuple[Candidates, tuple[Pairs, Pairs]]:
    """Return candidates through the video; the pairs to try features on at once, and those that may be tried later."""
    source = place.options.candidates.source
    sync = place.block.video
    pairs = pairs_to_compare(len(place.store), _positions(place.block), place.options.candidates.neighbours)
    if place.video is None or sync is None or len(sync.places) < 2:
        if source is CandidateSource.VIDEO:
            raise InputError("candidates.source=video, but the block has no video that is synchronised with its stills")
        return empty(), (pairs, [])
    if source is CandidateSource.FEATURES:
        return empty(), (pairs, [])
    with place.step("tracking through the video"):
        given = VideoInput(
            video=place.video,
            sync=sync,
            store=place.store,
            pyramids=place.pyramids,
            candidates=place.options.candidates,
            measurement=place.options.measurement,
        )
        through = candidates_through_video(given, place.cache, workers=place.workers, progress=place.progress)
    if source is CandidateSource.BOTH:
        return through.candidates, (pairs, [])
    if source is CandidateSource.VIDEO:
        return through.candidates, ([], [])
    gaps = sorted({*through.weak_pairs, *_unplaced_pairs(place)})
    if gaps:
        place.notes.append(f"gaps in the video: {len(gaps)}; features bridge them")
    return through.candidates, (gaps, [pair for pair in pairs if pair not in gaps])


def _unplaced_pairs(place: Workplace) -> set[tuple[int, int]]:
    """Return pairs of neighbouring stills of which one has no place in the video."""
    sync = place.block.video
    placed = {p.still for p in sync.places} if sync is not None else set()
    return {
        (row, row + 1)
        for row in range(len(place.store) - 1)
        if not {place.store.names[row], place.store.names[row + 1]} <= placed
    }


def _positions(block: Block) -> Array | None:
    """Return a position for each still (n, 3), NaN where there is none."""
    if block.gnss is None:
        return None
    positions = np.full((len(block.stills), 3), np.nan)
    positions[block.gnss.image_index] = block.gnss.position_m
    return positions


def _feature_candidates(place: Workplace, pairs: Pairs) -> Candidates:
    """Match features on pairs of stills and measure the points by least squares matching."""
    if not pairs:
        return empty()
    options, block = place.options, place.block
    with place.step("features"):
        matches = match_features(
            place.store,
            pairs,
            block.interior,
            options.candidates,
            place.cache,
            workers=place.workers,
            progress=place.progress,
        )
        tasks = feature_tasks(matches, block.interior)
    if len(tasks) == 0:
        return empty()
    with place.step("least squares matching"):
        rays = measure_rays(
            place.pyramids,
            tasks,
            options.measurement,
            workers=place.workers,
            progress=place.progress,
            stage="least squares matching",
        )
    return from_measurements(tasks, rays, PointOrigin.FEATURES)


def _in_parts(place: Workplace, candidates: Candidates) -> list[GrowingBlock]:
    """Orient approximately, the largest part first."""
    point, image, xy, _ = candidates.all_rays()
    block, marked, m = place.block, marked_points(place.block), len(candidates)
    point, image = np.concatenate([point, m + marked.point]), np.concatenate([image, marked.image])
    with place.step("approximate orientation"):
        parts = orient_in_parts(
            ray_table(point, image, np.concatenate([xy, marked.xy_px]), block.interior),
            (len(block.stills), m + len(marked.points)),
            block.interior,
            interior_sigmas(block),
            place.progress,
        )
    for part in parts:
        part.points = part.points[:m]
    return parts


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tied:
    """A free network whose points were looked for in all stills."""

    found: Candidates
    """Before tie point matching."""
    tied: Candidates
    network: Network
    reasons: dict[int, str]
    """Why stills are not oriented."""


def _tie(place: Workplace, candidates: Candidates, growing: GrowingBlock, marked: MarkedPoints) -> _Tied:
    """Find every point in every still that should see it, twice: in between, points are added where there are none."""
    matching = TiePointMatching(
        pyramids=place.pyramids,
        options=place.options.measurement,
        workers=place.workers,
        progress=place.progress,
    )
    found, tied, known, dropped = candidates, candidates, None, 0
    for turn in (1, 2):
        with place.step("free network"):
            growing = without_weak_stills(growing, tied, marked)
            held = _free_network(place, network_of(growing, tied, marked), marked)
            growing = _regrown(growing, held)
        geometry = object_geometry(growing, held.adjusted, len(candidates), candidates.reference_image)
        with place.step("tie points"):
            tied = matching.match(candidates, geometry, known)
            apart = points_apart(tied, 0.5 * place.options.measurement.window_px)
            candidates, tied = candidates.only_points(apart), tied.only_points(apart)
            dropped += int(np.sum(~apart))
        if turn == 1:
            with place.step("filling"):
                fresh = _filling(place, matching, growing, tied, geometry.only_points(apart))
            found, candidates, known = join([found, fresh]), join([candidates, fresh]), join([tied, fresh])
            tied = known
    with place.step("free network"):
        growing = without_weak_stills(growing, tied, marked)
        held = _free_network(place, network_of(growing, tied, marked), marked)
        network, calibration = calibrated(updated(held.network, held.adjusted), held.adjusted)
        _note_calibration(place, calibration)
    if dropped:
        place.notes.append(f"points left out because their matching windows overlap others': {dropped}")
    return _Tied(found=found, tied=tied, network=network, reasons={**growing.reasons, **held.reasons})


def _filling(
    place: Workplace, matching: TiePointMatching, growing: GrowingBlock, tied: Candidates, geometry: ObjectGeometry
) -> Candidates:
    """Return new points with one measured ray each, where the block has none; found ones lead on to farther ones."""

    def places_in(image: int) -> RichPlaces:
        return rich_places(place.pyramids.get(image), place.options.candidates, matching.margin_px)

    with ThreadPoolExecutor(max(1, place.workers)) as pool:
        places = list(pool.map(places_in, range(len(place.store))))
    fresh = empty()
    for per_cell in FILLING_ROUNDS:
        filled = fill(geometry, places, per_cell)
        more = matching.match_in_one(filled.candidates, filled.geometry)
        fresh = join([fresh, more.only_points(np.bincount(more.ray_point, minlength=len(more)) > 0)])
        every = join([tied, fresh])
        points = network_of(growing, every, marked_points(place.block)).points[: len(every)]
        view = growing.centres[every.reference_image] - points
        normals = surface_normals(points, np.where(np.isfinite(view), view, 1.0))
        geometry = replace(geometry, points=points, normals=normals)
    return fresh


def _free_network(place: Workplace, network: Network, marked: MarkedPoints) -> HeldNetwork:
    place.progress("free network adjustment", 0, 1)
    held = adjust_what_holds(network, place.block, marked, place.options.adjustment, Datum.FREE_NETWORK)
    place.progress("free network adjustment", 1, 1)
    return held


def _regrown(growing: GrowingBlock, held: HeldNetwork) -> GrowingBlock:
    network = updated(held.network, held.adjusted)
    return GrowingBlock(
        interior=network.interior,
        centres=network.centres,
        rotations=network.rotations,
        points=network.points[: network.marks_from],
        reasons={**growing.reasons, **held.reasons},
    )


def _note_calibration(place: Workplace, calibration: SigmaCalibration) -> None:
    if not calibration.classes:
        return
    factors = [factor for _, _, factor in calibration.classes]
    place.notes.append(
        f"sigmas of least squares matching calibrated by variance components in a free network: factors "
        f"{min(factors):.2f} to {max(factors):.2f} in {len(factors)} classes of texture and angle"
    )


def _to_object_space(place: Workplace, network: Network, marked: MarkedPoints) -> tuple[Network, bool]:
    """Transform the free network to object space by control, else by GNSS; tells whether that was possible."""
    oriented = np.flatnonzero(np.isfinite(network.centres[:, 0]))
    up = network.rotations[oriented][:, :, 2].mean(axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    model, target, sigma = _control_pairs(network, marked)
    by_control = len(model) >= 3 and np.linalg.svd(target - target.mean(axis=0), compute_uv=False)[1] > 1.0
    block = place.block
    if not by_control:
        if block.gnss is None or not place.options.adjustment.gnss:
            return network, False
        rows = np.isin(block.gnss.image_index, oriented)
        model = network.centres[block.gnss.image_index[rows]]
        target, sigma = block.gnss.position_m[rows], block.gnss.sigma_m[rows]
        if len(model) < 3:
            place.notes.append(f"only {len(model)} positions belong to oriented stills: position and scale stay free")
            return network, False
    similarity, _ = robust_similarity(model, target, sigma, up, np.random.default_rng(0))
    moved = replace(
        network,
        centres=similarity.apply(network.centres),
        rotations=similarity.R_object_from_model @ network.rotations,
        points=similarity.apply(network.points),
    )
    return _with_single_ray_control(moved, marked), True


def _control_pairs(network: Network, marked: MarkedPoints) -> tuple[Array, Array, Array]:
    """Return control points in the model (c, 3), as surveyed (c, 3), and their sigmas (c, 3), where intersected."""
    model = network.points[network.marks_from : network.marks_from + marked.control]
    known = np.isfinite(model[:, 0])
    chosen = [point for point, good in zip(marked.points[: marked.control], known, strict=True) if good]
    target = np.array([p.position_m for p in chosen]).reshape(-1, 3)
    return model[known], target, np.array([p.sigma_m for p in chosen]).reshape(-1, 3)


def _with_single_ray_control(network: Network, marked: MarkedPoints) -> Network:
    """Give control points that could not be intersected (one mark) their surveyed position as approximation."""
    points = network.points.copy()
    for number, point in enumerate(marked.points[: marked.control]):
        if not np.isfinite(points[network.marks_from + number, 0]):
            points[network.marks_from + number] = point.position_m
    return replace(network, points=points)
