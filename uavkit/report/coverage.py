"""The ground under a block: its surface, the footprints of the stills, and how many stills see each place."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.core.camera import InteriorOrientation, ideal_from_pixels
from uavkit.core.collinearity import image_coordinates, inside_image, object_rays
from uavkit.core.orientation import ExteriorOrientation, image_space_coordinates
from uavkit.core.result import OrientedBlock
from uavkit.report.measures import determined_points

MOST_POINTS = 20_000
"""Points from which the surface is made; more change nothing that a figure can show."""

NEAREST_POINTS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """Heights on a regular grid."""

    east_m: Array
    """(c,) middles of the columns."""
    north_m: Array
    """(r,) middles of the rows, from south to north."""
    height_m: Array
    """(r, c)."""

    def height_at_m(self, xy_m: Array) -> Array:
        """Return the height of the nearest cell at positions (n, 2), shape (n,)."""
        columns = _nearest(self.east_m, xy_m[:, 0])
        return np.asarray(self.height_m[_nearest(self.north_m, xy_m[:, 1]), columns])

    def nodes_m(self) -> Array:
        """Return all cells as points, shape (r c, 3), row by row."""
        east, north = np.meshgrid(self.east_m, self.north_m)
        return np.column_stack([east.ravel(), north.ravel(), self.height_m.ravel()])


def _nearest(axis_m: Array, values_m: Array) -> Indices:
    step = (axis_m[-1] - axis_m[0]) / max(len(axis_m) - 1, 1)
    position = (np.nan_to_num(values_m) - axis_m[0]) / (step if step > 0 else 1.0)
    return np.asarray(np.clip(np.rint(position), 0, len(axis_m) - 1), dtype=np.int64)


def extent_m(result: OrientedBlock) -> tuple[float, float, float, float]:
    """Return west, east, south, north of the block: nearly all points and every station, with a margin.

    A handful of points far outside does not widen it.
    """
    stations = result.adjustment.projection_centres_m[:, :2]
    points = result.adjustment.points_m[determined_points(result)][:, :2]
    corners = [stations.min(axis=0), stations.max(axis=0)] if len(stations) else []
    if len(points):
        corners += list(np.percentile(points, [0.5, 99.5], axis=0))
    if not corners:
        return 0.0, 1.0, 0.0, 1.0
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    margin = max(0.06 * float(np.max(high - low)), 1e-3)
    return float(low[0] - margin), float(high[0] + margin), float(low[1] - margin), float(high[1] + margin)


def ground_surface(result: OrientedBlock, cells: int = 100) -> Ground:
    """Return the surface through the block's points on a grid of ``cells`` along its longer side."""
    west, east, south, north = extent_m(result)
    size = max(east - west, north - south) / cells
    columns = west + size * (np.arange(max(int((east - west) / size), 1), dtype=np.float64) + 0.5)
    rows = south + size * (np.arange(max(int((north - south) / size), 1), dtype=np.float64) + 0.5)
    grid_east, grid_north = np.meshgrid(columns, rows)
    points = result.adjustment.points_m[determined_points(result)]
    points = points[:: max(len(points) // MOST_POINTS, 1)]
    return Ground(east_m=columns, north_m=rows, height_m=_interpolated(points, grid_east, grid_north))


def _interpolated(points_m: Array, east_m: Array, north_m: Array) -> Array:
    """Return the median height of the points nearest to each node: one bad point among them does no harm."""
    from scipy.spatial import cKDTree

    if not len(points_m):
        return np.zeros(east_m.shape)
    near = min(NEAREST_POINTS, len(points_m))
    _, rows = cKDTree(points_m[:, :2]).query(np.column_stack([east_m.ravel(), north_m.ravel()]), k=near)
    return np.asarray(np.median(points_m[rows.reshape(-1, near), 2], axis=1).reshape(east_m.shape))


def exteriors(result: OrientedBlock) -> Iterator[ExteriorOrientation]:
    """Yield the exterior orientation of each oriented still."""
    adjusted = result.adjustment
    for centre, rotation in zip(adjusted.projection_centres_m, adjusted.R_object_from_image, strict=True):
        yield ExteriorOrientation(projection_centre_m=centre, R_object_from_image=rotation)


def footprint_m(exterior: ExteriorOrientation, interior: InteriorOrientation, ground: Ground) -> Array:
    """Return the outline of a still on the ground, shape (n, 2); NaN where it looks at or above the horizon.

    Raises ValueError where the distortion cannot be inverted at the image's border.
    """
    directions = object_rays(_border_px(interior), exterior, interior)
    centre = exterior.projection_centre_m
    fall = np.where(directions[:, 2] < -0.05, directions[:, 2], np.nan)
    xy = np.tile(centre[:2], (len(directions), 1))
    for _ in range(6):
        xy = centre[:2] + directions[:, :2] * ((ground.height_at_m(xy) - centre[2]) / fall)[:, None]
    return np.asarray(xy)


def _border_px(interior: InteriorOrientation, steps: int = 6) -> Array:
    right, bottom = interior.width_px - 1.0, interior.height_px - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom], [0.0, 0.0]])
    share = np.arange(steps)[:, None] / steps
    sides = [start + share * (end - start) for start, end in pairwise(corners)]
    return np.vstack([*sides, corners[-1:]])


def overlap_counts(result: OrientedBlock, ground: Ground) -> Indices:
    """Return how many stills see each cell of the ground, (r, c); hidden places are not looked for."""
    nodes, interior = ground.nodes_m(), result.adjustment.interior
    widest = _widest_ideal_radius(interior)
    count = np.zeros(len(nodes), dtype=np.int64)
    for exterior in exteriors(result):
        u, v, w = image_space_coordinates(nodes, exterior).T
        # Far outside the image the distortion polynomial may fold back into it.
        near = (w < 0) & (np.hypot(u, v) < -w * widest)
        xy = image_coordinates(nodes[near], exterior, interior)
        count[near] += inside_image(xy, interior)
    return count.reshape(ground.height_m.shape)


def _widest_ideal_radius(interior: InteriorOrientation) -> float:
    try:
        radius = np.hypot(*ideal_from_pixels(_border_px(interior), interior).T)
    except ValueError:
        offset = _border_px(interior) - [interior.x0_px, interior.y0_px]
        radius = np.hypot(*offset.T) / interior.principal_distance_px
    return 1.02 * float(np.max(radius))


def heights_above_ground_m(result: OrientedBlock, ground: Ground) -> Array:
    """Return the height of each station above the surface below it, (n,)."""
    centres = result.adjustment.projection_centres_m
    return np.asarray(centres[:, 2] - ground.height_at_m(centres[:, :2]))
