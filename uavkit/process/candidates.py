"""Candidate points: each has one reference image, and rays in other images measured against that reference."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.result import PointOrigin
from uavkit.process.measurement import MeasuredRays, RayTasks


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """m points with their references, and k rays to them; the reference itself is not among the rays."""

    reference_image: Indices
    """(m,) row of the still in which the point was chosen."""
    reference_px: Array
    """(m, 2) column and row there."""
    origin: NDArray[np.int8]
    """(m,) PointOrigin."""
    ray_point: Indices
    """(k,)."""
    ray_image: Indices
    """(k,)."""
    ray_px: Array
    """(k, 2)."""
    ray_sigma_px: Array
    """(k, 2) a priori sigma of the ray."""

    def __len__(self) -> int:
        return len(self.reference_image)

    def all_rays(self) -> tuple[Indices, Indices, Array, Array]:
        """Return points, images, coordinates and sigmas of all rays, references included, ordered by point and image.

        The reference ray has the mean sigma of the rays measured against it: half of a pair's variance belongs to it.
        """
        count = np.bincount(self.ray_point, minlength=len(self))
        seen = np.flatnonzero(count)
        mean = (
            np.column_stack([np.bincount(self.ray_point, self.ray_sigma_px[:, axis], len(self)) for axis in range(2)])[
                seen
            ]
            / count[seen, None]
        )
        points = np.concatenate([seen, self.ray_point])
        images = np.concatenate([self.reference_image[seen], self.ray_image])
        order = np.lexsort((images, points))
        xy = np.concatenate([self.reference_px[seen], self.ray_px])
        sigma = np.concatenate([mean, self.ray_sigma_px])
        return points[order], images[order], xy[order], sigma[order]

    def with_rays(self, keep: Flags) -> "Candidates":
        """Return the same points with the rays that a mask (k,) chooses."""
        return Candidates(
            reference_image=self.reference_image,
            reference_px=self.reference_px,
            origin=self.origin,
            ray_point=self.ray_point[keep],
            ray_image=self.ray_image[keep],
            ray_px=self.ray_px[keep],
            ray_sigma_px=self.ray_sigma_px[keep],
        )

    def only_points(self, keep: Flags) -> "Candidates":
        """Return the points that a mask (m,) chooses, with their rays; points are numbered anew."""
        number = np.cumsum(keep) - 1
        rays = keep[self.ray_point]
        return Candidates(
            reference_image=self.reference_image[keep],
            reference_px=self.reference_px[keep],
            origin=self.origin[keep],
            ray_point=number[self.ray_point[rays]],
            ray_image=self.ray_image[rays],
            ray_px=self.ray_px[rays],
            ray_sigma_px=self.ray_sigma_px[rays],
        )


def join(parts: list[Candidates]) -> Candidates:
    """Return all points of several sets, one after the other."""
    if not parts:
        return empty()
    first = np.cumsum([0] + [len(part) for part in parts[:-1]])
    return Candidates(
        reference_image=np.concatenate([part.reference_image for part in parts]),
        reference_px=np.concatenate([part.reference_px for part in parts]),
        origin=np.concatenate([part.origin for part in parts]),
        ray_point=np.concatenate([part.ray_point + start for part, start in zip(parts, first, strict=True)]),
        ray_image=np.concatenate([part.ray_image for part in parts]),
        ray_px=np.concatenate([part.ray_px for part in parts]),
        ray_sigma_px=np.concatenate([part.ray_sigma_px for part in parts]),
    )


def empty() -> Candidates:
    """Return a set of no points."""
    none = np.zeros(0, dtype=np.int64)
    return Candidates(
        reference_image=none,
        reference_px=np.zeros((0, 2)),
        origin=np.zeros(0, dtype=np.int8),
        ray_point=none,
        ray_image=none,
        ray_px=np.zeros((0, 2)),
        ray_sigma_px=np.zeros((0, 2)),
    )


def from_measurements(tasks: RayTasks, rays: MeasuredRays, origin: PointOrigin) -> Candidates:
    """Return the points of tasks of which at least one was measured; points are numbered anew."""
    ok = rays.ok
    numbers, first, point = np.unique(tasks.point[ok], return_index=True, return_inverse=True)
    return Candidates(
        reference_image=tasks.reference_image[ok][first],
        reference_px=tasks.reference_px[ok][first],
        origin=np.full(len(numbers), origin, dtype=np.int8),
        ray_point=point.astype(np.int64),
        ray_image=tasks.target_image[ok],
        ray_px=rays.target_px[ok],
        ray_sigma_px=rays.sigma_px[ok],
    )
