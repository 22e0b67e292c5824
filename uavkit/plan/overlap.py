"""How much of each image the images beside it show, on the ground as it is."""

import math
from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array
from uavkit.plan.ground import Ground
from uavkit.plan.imaging import Imaging
from uavkit.plan.kernels import forward_shares, ground_points, side_shares
from uavkit.plan.lines import StationLine

REACH = 6
"""Images of the line beside, to each side of the nearest one, that are tried for a ground point that none has shown."""


def points_on_ground(imaging: Imaging, ground: Ground, line: StationLine, directions: Array | None = None) -> Array:
    """Return the ground points (n, m, 3) of all nodes of the images of a line; nan where a ray meets no ground."""
    rays = imaging.directions if directions is None else directions
    result = np.empty((len(line), len(rays), 3))
    ground_points(*ground.arrays, ground.limits, line.centres_m, line.rotations, rays, result)
    return result


def _nodes(points: Array) -> tuple[int, int]:
    """Return rows and columns of the nodes of ground points (n, m, 3): as many of each."""
    side = math.isqrt(points.shape[1])
    return side, side


def forward_overlaps(imaging: Imaging, line: StationLine, points: Array) -> Array:
    """Return the share (n,) of each image that the next one shows, of its ground points (n, m, 3); the last: nan."""
    result = np.empty(len(line))
    shape = _nodes(points)
    forward_shares(points, line.centres_m, line.rotations, imaging.parameters, shape, result)
    return result


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """All images of one side of a line, sorted along it."""

    direction: Array
    along_m: Array
    centres_m: Array
    rotations: Array

    @classmethod
    def of(cls, direction: Array, lines: list[StationLine]) -> "Neighbours":
        """Return the images of lines, sorted along a direction (2,)."""
        centres = np.concatenate([line.centres_m for line in lines])
        along = centres[:, :2] @ direction
        order = np.argsort(along, kind="stable")
        return cls(
            direction=np.ascontiguousarray(direction),
            along_m=along[order],
            centres_m=centres[order],
            rotations=np.concatenate([line.rotations for line in lines])[order],
        )


def side_overlaps(imaging: Imaging, points: Array, beside: Neighbours) -> Array:
    """Return the share (n,) of images, given by their ground points (n, m, 3), that any image beside them shows."""
    result = np.empty(len(points))
    shape = _nodes(points)
    side_shares(
        points,
        beside.direction,
        beside.along_m,
        beside.centres_m,
        beside.rotations,
        imaging.parameters,
        shape,
        REACH,
        result,
    )
    return result
