"""Measuring many rays by least squares matching, each point in many stills against its one reference still."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.progress import Progress
from uavkit.process.least_squares_matching import MatchingOptions, MatchingStatus, match_forward_backward, ray_sigma
from uavkit.process.options import MeasurementOptions
from uavkit.process.pictures import PictureStore


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
    store: PictureStore, tasks: RayTasks, options: MeasurementOptions, *, workers: int, progress: Progress, stage: str
) -> MeasuredRays:
    """Match every task forward and backward; rows keep their order, results the same bits with any workers."""
    settings = MatchingOptions(
        window_px=options.window_px,
        least_correlation=options.least_correlation,
        most_return_miss_px=options.most_return_miss_px,
    )
    k = len(tasks)
    target_px, sigma_px, warps = np.full((k, 2), np.nan), np.full((k, 2), np.nan), np.full((k, 2, 2), np.nan)
    status = np.full(k, int(MatchingStatus.LEFT_IMAGE), dtype=np.int64)
    pairs = pairs_of(tasks)
    for done, (reference, target, rows) in enumerate(pairs):
        progress(stage, done, len(pairs))
        both = match_forward_backward(
            store.grey(reference),
            store.grey(target),
            tasks.reference_px[rows],
            tasks.start_px[rows],
            tasks.warps[rows],
            settings,
            workers=workers,
        )
        forward = both.forward
        target_px[rows], warps[rows], status[rows] = forward.target_px, forward.warps, forward.status
        sigma_px[rows] = ray_sigma(forward, both.return_miss_px)
    progress(stage, len(pairs), len(pairs))
    return MeasuredRays(
        ok=np.asarray(status == MatchingStatus.OK),
        target_px=target_px,
        warps=warps,
        sigma_px=sigma_px,
        status=status,
    )
