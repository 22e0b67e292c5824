"""From an adjusted network to the result that is handed on: kinds of points, differences, counts, pictures."""

import resource
import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.adjustment import Datum
from uavkit.core.arrays import Array, Indices
from uavkit.core.block import Block
from uavkit.core.devices import StillSource
from uavkit.core.observations import Rays
from uavkit.core.points import PointKind
from uavkit.core.result import CandidateCount, CodePictures, OrientedBlock, PointDifference, PointOrigin
from uavkit.process.candidates import Candidates
from uavkit.process.network import AdjustedNetwork, MarkedPoints, Network
from uavkit.process.orientation_code import orientation_codes, richness
from uavkit.process.pictures import PyramidStore
from uavkit.process.pyramid import level_from_full

_ORIGINS = (("video", PointOrigin.VIDEO), ("features", PointOrigin.FEATURES), ("filling", PointOrigin.FILLING))
_TURN_COSINE = np.cos(np.radians(50.0))
_PICTURE_LEVEL = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Everything that the steps of processing leave behind."""

    block: Block
    reasons: dict[int, str]
    """Why stills are not oriented."""
    candidates: Candidates
    """As first found."""
    tied: Candidates
    """With the rays of tie point matching."""
    network: Network
    marked: MarkedPoints
    adjusted: AdjustedNetwork


def summarise(found: Findings, stills: StillSource, pyramids: PyramidStore) -> OrientedBlock:
    """Return the oriented block; ``seconds``, memory and notes are added by the caller."""
    adjusted, block = found.adjusted, found.block
    result, images = adjusted.result, adjusted.images
    strips = strips_of(result.projection_centres_m)
    names = tuple(block.stills[row].name for row in images.tolist())
    kinds, origins = _kinds(found, strips), _origins(found)
    gsd = _ground_sampling_distances(adjusted)
    control, _ = _differences(found, gsd, PointKind.CONTROL)
    check, check_covariance = _differences(found, gsd, PointKind.CHECK)
    used = np.isfinite(result.points_m[:, 0])
    return OrientedBlock(
        block=block,
        images=names,
        unoriented={block.stills[row].name: reason for row, reason in sorted(found.reasons.items())},
        adjustment=result,
        rays=adjusted.rays,
        point_kinds=kinds,
        point_origins=origins,
        point_colours=_colours(found, stills),
        strips=strips,
        control=control,
        check=check,
        check_covariance_m2=check_covariance,
        candidates=_candidate_counts(found, used),
        video_share=_video_share(kinds, origins, used),
        gsd_m=float(np.nanmedian(gsd[used])) if used.any() else float("nan"),
        pictures=_code_pictures(names, images, adjusted.rays, result.ray_used, pyramids),
    )


def strips_of(centres_m: Array) -> Indices:
    """Return the strip number (n,) of stations (n, 3) in the order of flight: a strip ends where the course turns."""
    n = len(centres_m)
    strips = np.zeros(n, dtype=np.int64)
    if n < 3:
        return strips
    course = np.diff(centres_m[:, :2], axis=0)
    course /= np.maximum(np.linalg.norm(course, axis=1), 1e-12)[:, None]
    straight = np.sum(course[1:] * course[:-1], axis=1) > _TURN_COSINE
    number = 0
    for still in range(1, n):
        before = still >= 2 and bool(straight[still - 2])
        after = still <= n - 2 and bool(straight[still - 1])
        previous_new = still >= 2 and strips[still - 1] != strips[still - 2]
        # The leg into this still starts a strip where it continues neither the last course nor leads into the next.
        if still >= 2 and not before and not (after and previous_new) and not (still == n - 1 and previous_new):
            number += 1
        strips[still] = number
    return strips


def _kinds(found: Findings, strips: Indices) -> NDArray[np.int8]:
    """Return the PointKind (m,): points seen in two strips are tie points."""
    adjusted, network = found.adjusted, found.network
    point, strip = adjusted.rays.point_index, strips[adjusted.rays.image_index]
    rows = adjusted.result.ray_used
    m = len(adjusted.points)
    lowest, highest = np.full(m, 1_000_000), np.full(m, -1)
    np.minimum.at(lowest, point[rows], strip[rows])
    np.maximum.at(highest, point[rows], strip[rows])
    kinds = np.where(highest > lowest, PointKind.TIE, PointKind.PASS).astype(np.int8)
    kinds[adjusted.points >= network.marks_from] = PointKind.CONTROL
    kinds[adjusted.points >= network.marks_from + found.marked.control] = PointKind.CHECK
    return kinds


def _origins(found: Findings) -> NDArray[np.int8]:
    origins = np.full(len(found.adjusted.points), PointOrigin.MARK, dtype=np.int8)
    rows = found.adjusted.points < found.network.marks_from
    origins[rows] = found.tied.origin[found.adjusted.points[rows]]
    return origins


def _ground_sampling_distances(adjusted: AdjustedNetwork) -> Array:
    """Return the mean GSD (m,) of the images that see each point: depth over principal distance."""
    result, rays = adjusted.result, adjusted.rays
    to_point = result.points_m[rays.point_index] - result.projection_centres_m[rays.image_index]
    depth = -np.sum(to_point * result.R_object_from_image[rays.image_index][:, :, 2], axis=1)
    used = result.ray_used & np.isfinite(depth)
    count = np.bincount(rays.point_index[used], minlength=len(result.points_m))
    total = np.bincount(rays.point_index[used], depth[used], minlength=len(result.points_m))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(total / count / result.interior.principal_distance_px)


def _differences(found: Findings, gsd: Array, kind: PointKind) -> tuple[tuple[PointDifference, ...], Array]:
    """Return block minus survey of control or check points, and the joint covariance of all these differences."""
    adjusted, marks_from = found.adjusted, found.network.marks_from
    result, marked = adjusted.result, found.marked
    span = (0, marked.control) if kind is PointKind.CONTROL else (marked.control, len(marked.points))
    rays = np.bincount(adjusted.rays.point_index[result.ray_used], minlength=len(result.points_m))
    rows = np.flatnonzero((adjusted.points >= marks_from + span[0]) & (adjusted.points < marks_from + span[1]))
    rows = rows[np.isfinite(result.points_m[rows, 0]) & (rays[rows] > 0)]
    if result.datum is Datum.FREE_NETWORK:  # the model's own axes and scale: nothing to compare with a survey
        rows = rows[:0]
    joint = _joint_covariance(adjusted, rows)
    differences = []
    for number, row in enumerate(rows.tolist()):
        surveyed = marked.points[int(adjusted.points[row]) - marks_from]
        own = slice(3 * number, 3 * number + 3)
        if kind is PointKind.CHECK:
            joint[own, own] += np.diag(np.square(surveyed.sigma_m))
            sigma = np.sqrt(np.diag(joint[own, own]))
        else:  # adjusted minus observed: its covariance is survey minus block
            sigma = np.sqrt(np.maximum(np.square(surveyed.sigma_m) - np.diag(joint[own, own]), 0.0))
        difference = result.points_m[row] - np.array(surveyed.position_m)
        differences.append(
            PointDifference(
                name=surveyed.name,
                difference_m=(float(difference[0]), float(difference[1]), float(difference[2])),
                sigma_m=(float(sigma[0]), float(sigma[1]), float(sigma[2])),
                rays=int(rays[row]),
                gsd_m=float(gsd[row]),
            )
        )
    return tuple(differences), joint


def _joint_covariance(adjusted: AdjustedNetwork, rows: Indices) -> Array:
    """Return the covariance (3 c, 3 c) of points: joint where the adjustment gave it, else block by block."""
    result = adjusted.result
    joint = np.zeros((3 * len(rows), 3 * len(rows)))
    place = {int(row): number for number, row in enumerate(result.joint_points.tolist())}
    if len(rows) and all(int(row) in place for row in rows):
        at = np.concatenate([3 * place[int(row)] + np.arange(3) for row in rows])
        return np.asarray(result.joint_covariance_m2[np.ix_(at, at)].copy())
    for number, row in enumerate(rows.tolist()):
        joint[3 * number : 3 * number + 3, 3 * number : 3 * number + 3] = result.point_covariances_m2[row]
    return joint


def _candidate_counts(found: Findings, used: NDArray[np.bool_]) -> dict[str, CandidateCount]:
    survived = np.zeros(len(found.tied), dtype=bool)
    rows = found.adjusted.points[used]
    survived[rows[rows < found.network.marks_from]] = True
    seen = np.bincount(found.candidates.ray_point, minlength=len(found.candidates)) > 0
    counts = {}
    for name, origin in _ORIGINS:
        of_origin = found.candidates.origin == origin
        counts[name] = CandidateCount(
            found=int((of_origin & seen).sum()), survived=int((survived & (found.tied.origin == origin)).sum())
        )
    return counts


def _video_share(kinds: NDArray[np.int8], origins: NDArray[np.int8], used: NDArray[np.bool_]) -> float:
    passes = used & ((kinds == PointKind.PASS) | (kinds == PointKind.TIE))
    return float((origins[passes] == PointOrigin.VIDEO).mean()) if passes.any() else 0.0


def _colours(found: Findings, stills: StillSource) -> NDArray[np.uint8]:
    """Return each point's colour (m, 3) at its first ray."""
    rays = found.adjusted.rays
    colours = np.full((len(found.adjusted.points), 3), 128, dtype=np.uint8)
    point, first = np.unique(rays.point_index, return_index=True)
    image = rays.image_index[first]
    column, row = np.rint(rays.xy_px[first]).astype(np.int64).T
    for number in np.unique(image).tolist():
        at = image == number
        picture = stills.colour(found.block.stills[int(found.adjusted.images[number])].name)
        inside = np.clip(row[at], 0, picture.shape[0] - 1), np.clip(column[at], 0, picture.shape[1] - 1)
        colours[point[at]] = picture[inside]
    return colours


def _code_pictures(
    names: tuple[str, ...],
    images: Indices,
    rays: Rays,
    used: NDArray[np.bool_],
    pyramids: PyramidStore,
) -> CodePictures | None:
    """Return the pictures of the middle still of the block and its matches with the next one."""
    if len(names) < 2:
        return None
    here = min(len(names) // 2, len(names) - 2)
    first, second = pyramids.get(int(images[here])), pyramids.get(int(images[here + 1]))
    level = min(_PICTURE_LEVEL, len(first.grey) - 1)
    rows = [np.flatnonzero((rays.image_index == at) & used) for at in (here, here + 1)]
    _, at_first, at_second = np.intersect1d(rays.point_index[rows[0]], rays.point_index[rows[1]], return_indices=True)
    codes = orientation_codes(first.grey[level])
    return CodePictures(
        still=names[here],
        grey=first.grey[level],
        codes=codes,
        richness=richness(codes),
        matches=np.column_stack(
            [
                level_from_full(rays.xy_px[rows[0][at_first]], level),
                level_from_full(rays.xy_px[rows[1][at_second]], level),
            ]
        ),
        next_still=names[here + 1],
        next_grey=second.grey[level],
    )


def peak_memory_mb() -> float:
    """Return the largest resident memory of this process so far."""
    bytes_per_unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * bytes_per_unit / 1024.0**2
