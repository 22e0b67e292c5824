"""From candidates and approximations to adjustments: the rows that the bundle block adjustment takes."""

from dataclasses import dataclass, replace

import numpy as np

from uavkit.core.adjustment import AdjustmentInput, AdjustmentOptions, AdjustmentResult, Datum
from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.block import Block
from uavkit.core.camera import InteriorOrientation, InteriorSigmas
from uavkit.core.observations import ControlObservations, GnssObservations, Rays
from uavkit.core.points import CheckPoint, ControlPoint
from uavkit.process.approximations import GrowingBlock, RayTable, intersect_without_worst, ray_table
from uavkit.process.bundle import adjust_block
from uavkit.process.bundle_system import UndeterminedError
from uavkit.process.candidates import Candidates
from uavkit.process.holding import MOST_LOOSENED, loose_stills
from uavkit.process.options import AdjustmentSection

MISFIT_PX = 15.0
"""Rays farther from their point than this are left out of its approximate position; the adjustment judges them anew."""
LEAST_RAYS = 8
"""Rays to points that other stills see too, for a still to take part in the adjustment."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkedPoints:
    """Rays to control and check points, by hand: c points, control first."""

    points: tuple[ControlPoint | CheckPoint, ...]
    control: int
    """How many of them are control points."""
    point: Indices
    """(k,) row in ``points``."""
    image: Indices
    """(k,)."""
    xy_px: Array
    sigma_px: Array
    """(k, 2)."""


def marked_points(block: Block) -> MarkedPoints:
    """Collect the marks of a block's control and check points; marks in stills not in the block are skipped."""
    points: tuple[ControlPoint | CheckPoint, ...] = (*block.control_points, *block.check_points)
    row_of = {still.name: row for row, still in enumerate(block.stills)}
    rows = [
        (number, row_of[mark.image], mark.column_px, mark.row_px, mark.sigma_px)
        for number, point in enumerate(points)
        for mark in point.marks
        if mark.image in row_of
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return MarkedPoints(
        points=points,
        control=len(block.control_points),
        point=table[:, 0].astype(np.int64),
        image=table[:, 1].astype(np.int64),
        xy_px=table[:, 2:4],
        sigma_px=np.repeat(table[:, 4:5], 2, axis=1),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """Everything to be adjusted, in rows of all stills; object points are the candidates, then the marked points."""

    interior: InteriorOrientation
    centres: Array
    """(n, 3), NaN where a still is not oriented."""
    rotations: Array
    points: Array
    """(m + c, 3), NaN where not known."""
    point: Indices
    image: Indices
    xy_px: Array
    sigma_px: Array
    marks_from: int
    """First row of the marked points."""


def network_of(growing: GrowingBlock, candidates: Candidates, marked: MarkedPoints) -> Network:
    """Join candidates and marks to one network, all points intersected anew."""
    point, image, xy, sigma = candidates.all_rays()
    m = len(candidates)
    point = np.concatenate([point, m + marked.point])
    image = np.concatenate([image, marked.image])
    xy, sigma = np.concatenate([xy, marked.xy_px]), np.concatenate([sigma, marked.sigma_px])
    rays = ray_table(point, image, xy, growing.interior)
    return Network(
        interior=growing.interior,
        centres=growing.centres,
        rotations=growing.rotations,
        points=_robust_points(rays, growing, m + len(marked.points)),
        point=point,
        image=image,
        xy_px=xy,
        sigma_px=sigma,
        marks_from=m,
    )


def without_weak_stills(growing: GrowingBlock, candidates: Candidates, marked: MarkedPoints) -> GrowingBlock:
    """Return the block without stills that share too few points with the other oriented ones to be adjusted.

    One such still would leave the whole adjustment undetermined; it is named with its reason instead.
    """
    point, image, _, _ = candidates.all_rays()
    point = np.concatenate([point, len(candidates) + marked.point])
    image = np.concatenate([image, marked.image])
    centres, reasons = growing.centres.copy(), dict(growing.reasons)
    while True:
        oriented = np.isfinite(centres[:, 0])
        rows = oriented[image]
        shared = np.bincount(point[rows], minlength=len(candidates) + len(marked.points)) >= 2
        count = np.bincount(image[rows & shared[point]], minlength=len(centres))
        weak = np.flatnonzero(oriented & (count < LEAST_RAYS))
        if len(weak) == 0:
            return replace(growing, centres=centres, reasons=reasons)
        worst = int(weak[np.argmin(count[weak])])
        centres[worst] = np.nan
        reasons[worst] = f"only {count[worst]} of its points were found in other stills too ({LEAST_RAYS} needed)"


def _robust_points(rays: RayTable, growing: GrowingBlock, count: int) -> Array:
    """Intersect points from their oriented rays, the worst ray of a point left out while it does not fit."""
    rows = np.flatnonzero(np.isfinite(growing.centres[rays.image, 0]))
    point, image = rays.point[rows], rays.image[rows]
    points, _, fits = intersect_without_worst(
        point,
        growing.centres[image],
        np.einsum("kij,kj->ki", growing.rotations[image], rays.directions[rows]),
        count,
        tolerance=MISFIT_PX / growing.interior.principal_distance_px,
        rounds=4,
    )
    points[np.bincount(point[fits], minlength=count) < 2] = np.nan
    return points


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustedNetwork:
    """A result with the rows that it belongs to."""

    result: AdjustmentResult
    images: Indices
    """Rows of the stills."""
    points: Indices
    """Rows of the network's object points."""
    rays: Rays
    ray_rows: Indices
    """Rows of the network's rays."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldNetwork:
    """An adjusted network without the stills that turned out to be loose."""

    network: Network
    adjusted: AdjustedNetwork
    reasons: dict[int, str]
    """Why each loose still was left out, by its row."""


def adjust_what_holds(
    network: Network,
    block: Block,
    marked: MarkedPoints,
    options: AdjustmentSection,
    datum: Datum | None,
) -> HeldNetwork:
    """Adjust; stills that the rays free of gross errors do not hold are left out, with the reason.

    Raises AdjustmentError where what is left determines nothing.
    """
    reasons: dict[int, str] = {}
    for _ in range(MOST_LOOSENED):
        try:
            adjusted = adjust_network(network, block, marked, options, datum)
            return HeldNetwork(network=network, adjusted=adjusted, reasons=reasons)
        except UndeterminedError as error:
            images = np.flatnonzero(np.isfinite(network.centres[:, 0]))
            rows = _rays_to_use(network, marked, datum is Datum.FREE_NETWORK)[error.used]
            held = np.searchsorted(images, network.image[rows])
            loose = images[loose_stills(held, network.point[rows], len(images))]
            if len(loose) == 0 or len(images) - len(loose) < 2:
                raise
        centres = network.centres.copy()
        centres[loose] = np.nan
        network = replace(network, centres=centres)
        for still in loose.tolist():
            agree = np.count_nonzero(network.image[rows] == still)
            reasons[still] = f"too few of its points agree with the other stills to hold it ({agree} agree at all)"
    adjusted = adjust_network(network, block, marked, options, datum)
    return HeldNetwork(network=network, adjusted=adjusted, reasons=reasons)


def adjust_network(
    network: Network,
    block: Block,
    marked: MarkedPoints,
    options: AdjustmentSection,
    datum: Datum | None,
) -> AdjustedNetwork:
    """Adjust; with ``datum`` FREE_NETWORK neither GNSS nor control take part."""
    images = np.flatnonzero(np.isfinite(network.centres[:, 0]))
    free = datum is Datum.FREE_NETWORK
    rows = _rays_to_use(network, marked, free)
    points, point_index = np.unique(network.point[rows], return_inverse=True)
    rays = Rays(
        image_index=np.searchsorted(images, network.image[rows]),
        point_index=point_index,
        xy_px=network.xy_px[rows],
        sigma_px=network.sigma_px[rows],
    )
    observations = AdjustmentInput(
        interior=network.interior,
        interior_prior=block.interior,
        interior_sigmas=interior_sigmas(block) if options.self_calibration else InteriorSigmas(),
        projection_centres_m=network.centres[images],
        R_object_from_image=network.rotations[images],
        points_m=network.points[points],
        rays=rays,
        gnss=None if free or not options.gnss else _gnss(block, images),
        control=None if free else _control(marked, points, network.marks_from),
    )
    settings = AdjustmentOptions(datum=datum, tukey_c=options.tukey_c, reject_above=options.reject_above)
    joint = _spread_points(observations, points < network.marks_from)
    if not free:
        joint = np.union1d(joint, np.flatnonzero(points >= network.marks_from + marked.control))
    result = adjust_block(observations, settings, joint_points=joint)
    return AdjustedNetwork(result=result, images=images, points=points, rays=rays, ray_rows=rows)


def _spread_points(given: AdjustmentInput, may_serve: Flags) -> Indices:
    """Return the rows of up to 25 points spread over the block: their joint covariance tells how well its shape is
    determined. They are the nearest, of those with most rays, to the middles of 5 x 5 cells seen from the cameras."""
    rays = np.bincount(given.rays.point_index, minlength=len(given.points_m))
    rows = np.flatnonzero(may_serve & (rays >= 3))
    if len(rows) == 0:
        return rows
    view = np.linalg.svd(given.R_object_from_image[:, :, 2].mean(axis=0)[None])[2]
    plane = given.points_m[rows] @ view[1:].T
    least, most = np.quantile(plane, [0.03, 0.97], axis=0)
    cell = np.clip((plane - least) / np.maximum(most - least, 1e-12) * 5.0, 0.0, 4.999)
    number = np.floor(cell).astype(np.int64) @ np.array([5, 1])
    off = np.linalg.norm(cell - np.floor(cell) - 0.5, axis=1) - np.minimum(rays[rows], 6)
    order = np.lexsort((off, number))
    _, first = np.unique(number[order], return_index=True)
    return np.sort(rows[order[first]])


def interior_sigmas(block: Block) -> InteriorSigmas:
    """Return the a priori sigmas of the interior orientation for the size of the block's stills."""
    return block.camera.interior_sigmas.scaled(block.interior.width_px / block.camera.interior.width_px)


def _rays_to_use(network: Network, marked: MarkedPoints, free: bool) -> Indices:
    """Return the rays of oriented stills to known points that have at least two of them (one, for a control point)."""
    usable = np.isfinite(network.centres[network.image, 0]) & np.isfinite(network.points[network.point, 0])
    count = np.bincount(network.point[usable], minlength=len(network.points))
    least = np.full(len(network.points), 2)
    if not free:
        least[network.marks_from : network.marks_from + marked.control] = 1
    return np.flatnonzero(usable & (count >= least)[network.point])


def _gnss(block: Block, images: Indices) -> GnssObservations | None:
    """Return the GNSS observations of the oriented stills, in their rows."""
    gnss = block.gnss
    if gnss is None:
        return None
    keep = np.isin(gnss.image_index, images)
    if not keep.any():
        return None
    return GnssObservations(
        image_index=np.searchsorted(images, gnss.image_index[keep]),
        position_m=gnss.position_m[keep],
        sigma_m=gnss.sigma_m[keep],
        flight=gnss.flight[keep],
        lever_arm_m=gnss.lever_arm_m,
        shift_sigma_m=gnss.shift_sigma_m,
        velocity_m_s=None if gnss.velocity_m_s is None else gnss.velocity_m_s[keep],
        latency_sigma_s=gnss.latency_sigma_s,
    )


def _control(marked: MarkedPoints, points: Indices, marks_from: int) -> ControlObservations | None:
    rows = np.flatnonzero((points >= marks_from) & (points < marks_from + marked.control))
    if len(rows) == 0:
        return None
    chosen = [marked.points[int(points[row]) - marks_from] for row in rows]
    return ControlObservations(
        point_index=rows,
        position_m=np.array([p.position_m for p in chosen]),
        sigma_m=np.array([p.sigma_m for p in chosen]),
    )


def updated(network: Network, adjusted: AdjustedNetwork) -> Network:
    """Return the network with the orientations, points and interior orientation of an adjustment."""
    centres, rotations, points = network.centres.copy(), network.rotations.copy(), np.full_like(network.points, np.nan)
    centres[adjusted.images] = adjusted.result.projection_centres_m
    rotations[adjusted.images] = adjusted.result.R_object_from_image
    points[adjusted.points] = adjusted.result.points_m
    return Network(
        interior=adjusted.result.interior,
        centres=centres,
        rotations=rotations,
        points=points,
        point=network.point,
        image=network.image,
        xy_px=network.xy_px,
        sigma_px=network.sigma_px,
        marks_from=network.marks_from,
    )
