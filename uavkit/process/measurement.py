"""Measuring many rays by least squares matching, each point in many stills against its one reference still."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags, Image, Indices
from uavkit.core.progress import Progress
from uavkit.process.least_squares_matching import MatchingOptions, MatchingStatus, match_forward_backward, ray_sigma
from uavkit.process.options import MeasurementOptions
from uavkit.process.pictures import PyramidStore
from uavkit.process.pyramid import full_from_level, level_from_full


@dataclass(frozen=True, slots=True, kw_only=True)
class RayTasks:
    """k points to be found in other stills."""

    point: Indices
    """(k,) any number by which the caller knows the point."""
    reference_image: Indices
    reference_px: Array
    """(k, 2)."""
    target_image: Indices
    start_px: Array
    """(k, 2) where it should lie in the target, to about 2 px."""
    warps: Array
    """(k, 2, 2) target_from_reference."""

    def __len__(self) -> int:
        return len(self.point)

    def where(self, keep: "Flags | Indices") -> "RayTasks":
        """Return the rows that a mask or indexes choose."""
        return RayTasks(
            point=self.point[keep],
            reference_image=self.reference_image[keep],
            reference_px=self.reference_px[keep],
            target_image=self.target_image[keep],
            start_px=self.start_px[keep],
            warps=self.warps[keep],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredRays:
    """What became of the tasks, row by row."""

    ok: Flags
    """(k,)."""
    target_px: Array
    """(k, 2)."""
    warps: Array
    """(k, 2, 2)."""
    sigma_px: Array
    """(k, 2) a priori sigma of each of the two rays of the pair."""
    status: NDArray[np.int64]
    """(k,) MatchingStatus."""


def pairs_of(tasks: RayTasks) -> list[tuple[int, int, Indices]]:
    """Return (reference image, target image, rows) of each pair of images in the tasks, in order."""
    order = np.lexsort((tasks.target_image, tasks.reference_image))
    reference, target = tasks.reference_image[order], tasks.target_image[order]
    if len(order) == 0:
        return []
    starts = np.flatnonzero(np.r_[True, (np.diff(reference) != 0) | (np.diff(target) != 0)]).tolist()
    ends = [*starts[1:], len(order)]
    return [
        (int(reference[begin]), int(target[begin]), order[begin:end]) for begin, end in zip(starts, ends, strict=True)
    ]


def measure_rays(
    pyramids: PyramidStore,
    tasks: RayTasks,
    options: MeasurementOptions,
    *,
    workers: int,
    progress: Progress,
    stage: str,
) -> MeasuredRays:
    """Match every task forward and backward; rows keep their order, results the same bits with any workers.

    What fails in the still itself is tried once more in the still at half its size, with twice the sigma: foliage and
    relief that do not correlate pixel by pixel often do so there.
    """
    settings = MatchingOptions(
        window_px=options.window_px,
        least_correlation=options.least_correlation,
        most_return_miss_px=options.most_return_miss_px,
    )
    k = len(tasks)
    rays = MeasuredRays(
        ok=np.zeros(k, dtype=bool),
        target_px=np.full((k, 2), np.nan),
        warps=np.full((k, 2, 2), np.nan),
        sigma_px=np.full((k, 2), np.nan),
        status=np.full(k, int(MatchingStatus.LEFT_IMAGE), dtype=np.int64),
    )
    pairs = pairs_of(tasks)
    for done, (reference, target, rows) in enumerate(pairs):
        progress(stage, done, len(pairs))
        pictures = pyramids.get(reference).grey, pyramids.get(target).grey
        for level in range(min(options.coarse_levels + 1, len(pictures[0]))):
            left = rows[~rays.ok[rows]]
            _measure_pair((pictures[0][level], pictures[1][level]), level, tasks, left, rays, settings, workers)
    progress(stage, len(pairs), len(pairs))
    return rays


def _measure_pair(
    pictures: tuple[Image, Image],
    level: int,
    tasks: RayTasks,
    rows: Indices,
    rays: MeasuredRays,
    settings: MatchingOptions,
    workers: int,
) -> None:
    """Match some tasks of a pair of stills on one level of their pyramids, and write what succeeds into ``rays``."""
    both = match_forward_backward(
        *pictures,
        level_from_full(tasks.reference_px[rows], level),
        level_from_full(tasks.start_px[rows], level),
        tasks.warps[rows],
        settings,
        workers=workers,
    )
    forward, ok = both.forward, both.forward.ok
    good = rows[ok]
    rays.target_px[good] = full_from_level(forward.target_px[ok], level)
    rays.warps[good] = forward.warps[ok]
    rays.sigma_px[good] = ray_sigma(forward, both.return_miss_px)[ok] * 2.0**level
    rays.ok[good] = True
    rays.status[rows] = forward.status
