"""Approximate orientation of a block from candidate points alone, in arbitrary position, rotation and scale.

Relative orientation of a strong pair, then resection of one still after the other, intersection of new points, and
an adjustment of what there is so far (incremental block formation, Mikhail, Bethel, McGlone 2001, sec. 5.8).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from uavkit.core.adjustment import AdjustmentInput, AdjustmentOptions, AdjustmentResult, Datum
from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.camera import InteriorOrientation, InteriorSigmas, ideal_from_pixels
from uavkit.core.errors import AdjustmentError
from uavkit.core.observations import Rays
from uavkit.core.progress import Progress
from uavkit.process.bundle import adjust_block
from uavkit.process.bundle_system import UndeterminedError
from uavkit.process.holding import MOST_LOOSENED, loose_stills

RESECTION_TOLERANCE_PX = 10.0
"""A point agrees with a resection within this: lens distortion is not yet known."""
LEAST_RESECTION_POINTS = 12
LEAST_PAIR_POINTS = 25
LEAST_SCALE_POINTS = 3
"""A still with too few known points for a resection is attached by relative orientation and a scale."""
LEAST_ANGLE_RAD = np.radians(2.0)
"""Rays that meet at less do not fix a point's depth."""
_IMAGE_FROM_VISION = np.diag([1.0, -1.0, -1.0])
_ROUGH_SIGMA_PX = 1.0
_MOST_POINTS_PER_STILL = 300
GROWTH = 1.5
"""The block is adjusted each time it has grown by this factor."""
CLEAN = 0.9
"""With a smaller share of good rays it is adjusted after each still: gross errors show in a block that is right."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RayTable:
    """All rays of all candidates, in numbers of stills and points of the whole survey."""

    point: Indices
    image: Indices
    xy_px: Array
    directions: Array
    """(k, 3) unit vectors in image space."""


@dataclass(slots=True, kw_only=True)
class GrowingBlock:
    """State of the incremental orientation; rows of all stills and points, NaN where not known yet."""

    interior: InteriorOrientation
    centres: Array
    rotations: Array
    points: Array
    reasons: dict[int, str]
    result: AdjustmentResult | None = None

    @property
    def oriented(self) -> Flags:
        """Tell which stills are oriented, shape (n,)."""
        return np.asarray(np.isfinite(self.centres[:, 0]))

    @property
    def known(self) -> Flags:
        """Tell which points are intersected, shape (m,)."""
        return np.asarray(np.isfinite(self.points[:, 0]))


def ray_table(point: Indices, image: Indices, xy_px: Array, interior: InteriorOrientation) -> RayTable:
    """Return a table of rays with their directions under an interior orientation."""
    ideal = ideal_from_pixels(xy_px, interior)
    directions = np.column_stack([ideal[:, 0], -ideal[:, 1], -np.ones(len(ideal))])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return RayTable(point=point, image=image, xy_px=xy_px, directions=directions)


def orient_approximately(
    rays: RayTable,
    counts: tuple[int, int],
    interior: InteriorOrientation,
    sigmas: InteriorSigmas,
    progress: Progress,
    first: Flags | None = None,
) -> GrowingBlock:
    """Orient as many of the stills as hang together; ``counts`` is the number of stills and of points.

    The block begins with two of the stills that ``first`` (n,) allows. Raises AdjustmentError where not even two of
    them can be oriented to each other.
    """
    block = GrowingBlock(
        interior=interior,
        centres=np.full((counts[0], 3), np.nan),
        rotations=np.full((counts[0], 3, 3), np.nan),
        points=np.full((counts[1], 3), np.nan),
        reasons={},
    )
    _start_with_pair(block, rays, np.ones(counts[0], dtype=bool) if first is None else first)
    _intersect(block, rays)
    next_adjustment, failed = 3, dict[int, int]()
    while True:
        image = _next_still(block, rays, failed)
        if image is not None and not _resect(block, rays, image):
            failed[image] = _known_points_in(block, rays)[image]
            continue
        if image is None:
            image = _attach(block, rays, [still for still, count in failed.items() if count == GIVEN_UP])
            if image is None:
                break
        _intersect(block, rays, image)
        if int(block.oriented.sum()) >= next_adjustment:
            rays, clean = _adjust(block, rays, sigmas, failed)
            next_adjustment = int(np.ceil((GROWTH if clean else 1.0) * block.oriented.sum()))
        progress("approximate orientation", int(block.oriented.sum()), counts[0])
    rays, _ = _adjust(block, rays, sigmas, failed)
    _explain(block, rays)
    return block


def _known_points_in(block: GrowingBlock, rays: RayTable) -> Indices:
    """Return how many intersected points each still sees, shape (n,)."""
    return np.bincount(rays.image[block.known[rays.point]], minlength=len(block.centres))


def _next_still(block: GrowingBlock, rays: RayTable, failed: dict[int, int]) -> int | None:
    """Return the unoriented still that sees most known points; one that failed waits for 1.3 times as many."""
    seen = _known_points_in(block, rays)
    seen[block.oriented] = 0
    for image, count in failed.items():
        if seen[image] < 1.3 * count:
            seen[image] = 0
    best = int(np.argmax(seen))
    return best if seen[best] >= LEAST_RESECTION_POINTS else None


def common_points(rays: RayTable, images: int) -> Array:
    """Return how many points each pair of stills has in common, shape (images, images)."""
    from scipy.sparse import coo_matrix

    shape = (images, int(rays.point.max(initial=-1)) + 1)
    seen = coo_matrix((np.ones(len(rays.point), np.float64), (rays.image, rays.point)), shape=shape).tocsr()
    full = np.asarray((seen @ seen.T).toarray())
    np.fill_diagonal(full, 0.0)
    return full


def _largest_part(common: Array) -> Array:
    """Return the counts (n, n) of common points within the largest part of the stills that hang together, else 0."""
    from scipy.sparse.csgraph import connected_components

    _, label = connected_components(common >= LEAST_RESECTION_POINTS, directed=False)
    largest = label == np.argmax(np.bincount(label))
    return np.asarray(np.where(largest[:, None] & largest[None, :], common, 0.0))


def _start_with_pair(block: GrowingBlock, rays: RayTable, allowed: Flags) -> None:
    """Orient the pair with the most well-intersecting points, out of the twenty richest pairs of the largest part."""
    common = common_points(rays, len(block.centres)) * (allowed[:, None] & allowed[None, :])
    common = np.triu(_largest_part(common))
    richest = np.argsort(-common, axis=None, kind="stable")[:20]
    best: tuple[float, int, int, Array, Array] | None = None
    for flat in richest.tolist():
        i, j = divmod(flat, len(common))
        if common[i, j] < LEAST_RESECTION_POINTS:
            continue
        rotation, base, score = _relative_orientation(rays, i, j, block.interior)
        if best is None or score > best[0]:
            best = (score, i, j, rotation, base)
    if best is None or best[0] <= 0:
        raise AdjustmentError(
            "no two stills have enough points in common that intersect well: the images do not overlap, are too "
            "blurred, or were all taken from one place"
        )
    _, i, j, rotation, base = best
    block.centres[i], block.rotations[i] = 0.0, np.eye(3)
    block.centres[j], block.rotations[j] = base, rotation


def _pair_rays(rays: RayTable, i: int, j: int) -> tuple[Indices, Indices]:
    """Return the rows of the rays of the common points in still i and in still j."""
    rows_i, rows_j = np.flatnonzero(rays.image == i), np.flatnonzero(rays.image == j)
    _, at_i, at_j = np.intersect1d(rays.point[rows_i], rays.point[rows_j], return_indices=True)
    return rows_i[at_i], rows_j[at_j]


def _relative_orientation(rays: RayTable, i: int, j: int, interior: InteriorOrientation) -> tuple[Array, Array, float]:
    """Return R_i_from_j, the base in image space of i (unit length), and a score: points that intersect well."""
    rows_i, rows_j = _pair_rays(rays, i, j)
    vision = [rays.directions[rows] @ _IMAGE_FROM_VISION for rows in (rows_i, rows_j)]
    first, second = (v[:, :2] / v[:, 2:] for v in vision)
    tolerance = RESECTION_TOLERANCE_PX / interior.principal_distance_px
    essential, mask = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.9999, 0.5 * tolerance)
    if essential is None or essential.shape != (3, 3):
        return np.eye(3), np.zeros(3), 0.0
    _, r_vision, t_vision, mask = cv2.recoverPose(essential, first, second, np.eye(3), mask=mask)
    # x_j = R x_i + t in vision axes (y down, z forward): turn both ends to image space.
    r_j_from_i = _IMAGE_FROM_VISION @ r_vision @ _IMAGE_FROM_VISION
    base = -r_j_from_i.T @ (_IMAGE_FROM_VISION @ t_vision.ravel())
    inliers = mask.ravel() > 0
    to_j = rays.directions[rows_j] @ r_j_from_i
    angle = np.arccos(np.clip(np.sum(rays.directions[rows_i] * to_j, axis=1), -1.0, 1.0))
    if inliers.sum() < LEAST_RESECTION_POINTS:
        return np.eye(3), np.zeros(3), 0.0
    score = float(np.sum(np.minimum(angle[inliers], np.radians(20.0)) / np.radians(20.0)))
    return r_j_from_i.T, base, score if float(np.median(angle[inliers])) > LEAST_ANGLE_RAD else 0.0


def _resect(block: GrowingBlock, rays: RayTable, image: int) -> bool:
    """Orient a still from the known points that it sees; tell whether that went well."""
    rows = np.flatnonzero((rays.image == image) & block.known[rays.point])
    vision = rays.directions[rows] @ _IMAGE_FROM_VISION
    objects = np.ascontiguousarray(block.points[rays.point[rows]])
    pixels = np.ascontiguousarray(vision[:, :2] / vision[:, 2:])
    tolerance = RESECTION_TOLERANCE_PX / block.interior.principal_distance_px
    done, vector, shift, inliers = cv2.solvePnPRansac(
        objects,
        pixels,
        np.eye(3),
        None,
        iterationsCount=2000,
        reprojectionError=tolerance,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not done or inliers is None or len(inliers) < LEAST_RESECTION_POINTS:
        return False
    chosen = inliers.ravel()
    vector, shift = cv2.solvePnPRefineLM(objects[chosen], pixels[chosen], np.eye(3), None, vector, shift)
    rotation = cv2.Rodrigues(vector)[0]
    block.centres[image] = (-rotation.T @ shift).ravel()
    block.rotations[image] = rotation.T @ _IMAGE_FROM_VISION
    return True


def _attach(block: GrowingBlock, rays: RayTable, given_up: list[int]) -> int | None:
    """Orient a still by relative orientation to an oriented one, its base scaled by a few points known already.

    The way of the aeropolygon: where stills overlap little more than half, hardly a point is seen in three, too few
    for a resection; but a scale needs only some.
    """
    common = common_points(rays, len(block.centres))
    common[~block.oriented] = 0
    common[:, block.oriented] = 0
    common[:, given_up] = 0
    for flat in np.argsort(-common, axis=None, kind="stable")[:40].tolist():
        here, image = divmod(flat, len(common))
        if common[here, image] < LEAST_PAIR_POINTS:
            return None
        rotation, base, score = _relative_orientation(rays, here, image, block.interior)
        scale = _base_scale(block, rays, (here, image), rotation, base) if score > 0 else 0.0
        if scale > 0:
            block.rotations[image] = block.rotations[here] @ rotation
            block.centres[image] = block.centres[here] + scale * block.rotations[here] @ base
            return int(image)
    return None


def _base_scale(block: GrowingBlock, rays: RayTable, pair: tuple[int, int], rotation: Array, base: Array) -> float:
    """Return the length of the base between two stills from the distances of known points; 0 where they disagree."""
    rows_here, rows_there = _pair_rays(rays, *pair)
    known = block.known[rays.point[rows_here]]
    rows_here, rows_there = rows_here[known], rows_there[known]
    if len(rows_here) < LEAST_SCALE_POINTS:
        return 0.0
    number = np.tile(np.arange(len(rows_here)), 2)
    origins = np.vstack([np.zeros((len(rows_here), 3)), np.tile(base, (len(rows_here), 1))])
    directions = np.vstack([rays.directions[rows_here], rays.directions[rows_there] @ rotation.T])
    model, angle = intersect_linearly(number, origins, directions, len(rows_here))
    true = np.linalg.norm(block.points[rays.point[rows_here]] - block.centres[pair[0]], axis=1)
    ratio = true[angle > LEAST_ANGLE_RAD] / np.linalg.norm(model[angle > LEAST_ANGLE_RAD], axis=1)
    if len(ratio) < LEAST_SCALE_POINTS:
        return 0.0
    middle = float(np.median(ratio))
    return middle if float(np.median(np.abs(ratio - middle))) < 0.05 * middle else 0.0


def intersect_linearly(point: Indices, origins: Array, directions: Array, count: int) -> tuple[Array, Array]:
    """Return the points (count, 3) nearest to their rays, and the angle at which the rays meet (approximate).

    Normal equations of the distances to the rays. n unit vectors spread by an angle a have a mean of length cos(a / 2)
    (exact for two rays). Points of less than two rays, or of parallel ones, are NaN.
    """

    def total(values: Array) -> Array:
        return np.asarray(np.bincount(point, values, count), dtype=np.float64)

    x, y, z = directions.T
    projectors = [1.0 - x * x, -x * y, -x * z, 1.0 - y * y, -y * z, 1.0 - z * z]
    normal = np.stack([total(values) for values in projectors], axis=1)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]]
    along = np.sum(origins * directions, axis=1)
    right = np.stack([total(origins[:, axis] - along * directions[:, axis]) for axis in range(3)], axis=1)
    rays = np.bincount(point, minlength=count)
    length = np.linalg.norm(np.stack([total(x), total(y), total(z)], axis=1), axis=1) / np.maximum(rays, 1)
    angle = np.where(rays >= 2, 2.0 * np.arccos(np.clip(length, 0.0, 1.0)), 0.0)
    points = np.full((count, 3), np.nan)
    good = angle > 1e-4
    points[good] = np.linalg.solve(normal[good].reshape(-1, 3, 3), right[good][:, :, None])[:, :, 0]
    return points, angle


def intersect_without_worst(
    point: Indices, origins: Array, directions: Array, count: int, *, tolerance: float, rounds: int
) -> tuple[Array, Array, Flags]:
    """Return points (count, 3), their angles, and which rays fit; in each round a point's worst misfit is left out.

    ``tolerance`` is the distance of point and ray over the distance of the point; a ray away from its point misfits.
    """
    fits, misfit = np.ones(len(point), dtype=bool), np.zeros(len(point), dtype=bool)
    points, angle = np.full((count, 3), np.nan), np.zeros(count)
    for _ in range(rounds):
        points, angle = intersect_linearly(point[fits], origins[fits], directions[fits], count)
        to_point = points[point] - origins
        depth = np.sum(to_point * directions, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            miss = np.linalg.norm(to_point - depth[:, None] * directions, axis=1) / depth
        miss = np.where(np.isfinite(miss) & (depth > 0), miss, 1e9)
        misfit = miss > tolerance
        worst = np.zeros(count)
        np.maximum.at(worst, point[fits], miss[fits])
        drop = fits & misfit & (miss >= worst[point])
        if not drop.any():
            break
        fits &= ~drop
    return points, angle, np.asarray(fits & ~misfit)


def _intersect(block: GrowingBlock, rays: RayTable, image: int | None = None) -> None:
    """Intersect the points of a still (or all) that two oriented stills see, leaving out rays that do not fit."""
    wanted = np.full(len(block.points), image is None)
    if image is not None:
        wanted[rays.point[rays.image == image]] = True
    rows = np.flatnonzero(block.oriented[rays.image] & wanted[rays.point])
    numbers, point = np.unique(rays.point[rows], return_inverse=True)
    points, angle, fits = intersect_without_worst(
        point,
        block.centres[rays.image[rows]],
        np.einsum("kij,kj->ki", block.rotations[rays.image[rows]], rays.directions[rows]),
        len(numbers),
        tolerance=RESECTION_TOLERANCE_PX / block.interior.principal_distance_px,
        rounds=3,
    )
    enough = np.bincount(point[fits], minlength=len(numbers)) >= 2
    points[~(enough & (angle > LEAST_ANGLE_RAD))] = np.nan
    block.points[wanted] = np.nan
    block.points[numbers] = points


def _adjust(
    block: GrowingBlock, rays: RayTable, sigmas: InteriorSigmas, failed: dict[int, int]
) -> tuple[RayTable, bool]:
    """Adjust the block so far as a free network, without stills that nothing holds: those count as ``failed``.

    Returns the rays with directions of the new interior orientation, and whether most of them are free of gross errors.
    """
    for _ in range(MOST_LOOSENED):
        images = np.flatnonzero(block.oriented)
        rows = np.flatnonzero(block.oriented[rays.image] & block.known[rays.point])
        rows = rows[_well_spread(rays.image[rows], rays.point[rows], len(block.points))]
        try:
            result = _adjusted(block, rays, (images, rows), sigmas)
        except UndeterminedError as error:
            held = rows[error.used]
            loose = loose_stills(np.searchsorted(images, rays.image[held]), rays.point[held], len(images))
            if len(loose) == 0 or len(images) - len(loose) < 2:
                break
            block.centres[images[loose]] = np.nan
            _intersect(block, rays)
            seen = _known_points_in(block, rays)
            failed.update(
                {still: GIVEN_UP if still in failed else int(seen[still]) for still in images[loose].tolist()}
            )
            continue
        except AdjustmentError:  # a still that hangs by few points yet: the next ones will hold it, or leave it out
            break
        block.interior = result.interior
        block.centres[images], block.rotations[images] = result.projection_centres_m, result.R_object_from_image
        rays = ray_table(rays.point, rays.image, rays.xy_px, block.interior)
        _intersect(block, rays)
        return rays, float(np.mean(result.ray_used)) >= CLEAN
    return rays, False


GIVEN_UP = 1 << 30
"""Known points that a still waits for which turned out to be loose after another failure."""


def _adjusted(
    block: GrowingBlock, rays: RayTable, chosen: tuple[Indices, Indices], sigmas: InteriorSigmas
) -> AdjustmentResult:
    """Return the adjustment of chosen stills and rays as a free network."""
    images, rows = chosen
    points, point_index = np.unique(rays.point[rows], return_inverse=True)
    observations = AdjustmentInput(
        interior=block.interior,
        interior_sigmas=sigmas if len(images) >= 3 else InteriorSigmas(),
        projection_centres_m=block.centres[images],
        R_object_from_image=block.rotations[images],
        points_m=block.points[points],
        rays=Rays(
            image_index=np.searchsorted(images, rays.image[rows]),
            point_index=point_index,
            xy_px=rays.xy_px[rows],
            sigma_px=np.full((len(rows), 2), _ROUGH_SIGMA_PX),
        ),
    )
    options = AdjustmentOptions(datum=Datum.FREE_NETWORK, most_iterations=15, convergence=0.05, point_covariances=False)
    return adjust_block(observations, options)


def _well_spread(image: Indices, point: Indices, count: int) -> Indices:
    """Return rows of rays such that each still keeps its points of most rays, at most so many, and they all rays."""
    rays_of = np.bincount(point, minlength=count)
    order = np.lexsort((point, -rays_of[point], image))
    starts = np.searchsorted(image[order], np.arange(int(image.max(initial=0)) + 1))
    rank = np.arange(len(order)) - starts[image[order]]
    chosen = np.zeros(count, dtype=bool)
    chosen[point[order][rank < _MOST_POINTS_PER_STILL]] = True
    return np.flatnonzero(chosen[point] & (rays_of[point] >= 2))


def _explain(block: GrowingBlock, rays: RayTable) -> None:
    """Say for each still why it is not oriented."""
    seen, total = _known_points_in(block, rays), np.bincount(rays.image, minlength=len(block.centres))
    for image in np.flatnonzero(~block.oriented).tolist():
        if total[image] == 0:
            block.reasons[image] = "no point of it was found in any other still: no overlap, blur, or no texture"
        elif seen[image] < LEAST_RESECTION_POINTS:
            block.reasons[image] = (
                f"only {seen[image]} of its points are tied to the rest of the block ({LEAST_RESECTION_POINTS} needed)"
            )
        else:
            block.reasons[image] = f"its {seen[image]} points do not agree on one orientation"
