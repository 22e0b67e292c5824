"""What a plan gives, measured on the ground: overlaps and ground distances of images, and the images of each place."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags
from uavkit.core.flightplan import CoverageMap
from uavkit.plan.ground import Ground
from uavkit.plan.imaging import Imaging
from uavkit.plan.kernels import count_images
from uavkit.plan.lines import StationLine
from uavkit.plan.overlap import Neighbours, forward_overlaps, points_on_ground, side_overlaps
from uavkit.plan.patterns import LaidSet

CELLS = 300_000
"""Of a coverage map, about."""
LEAST_CELL_M = 0.05


@dataclass(frozen=True, kw_only=True)
class LineMeasures:
    """Of each image of a line, in the order of the line."""

    forward: Array
    side: Array
    """Shares (n,); nan where there is nothing to compare."""
    gsd_m: Array
    """(n, 3): least, mean, greatest."""
    sees_area: Flags
    middle_in_area: Flags


def measure_lines(laid: LaidSet, lines: Sequence[StationLine], workers: int) -> list[LineMeasures]:
    """Return the measures of lines of one set, each against the next images and the lines beside it.

    The threads share the lines; the result does not depend on their number.
    """
    rows: dict[int, list[StationLine]] = {}
    for line in lines:
        rows.setdefault(line.row, []).append(line)

    def look(line: StationLine) -> _Looked:
        beside = [_near(rows.get(line.row + step, []), line) for step in (-1, 1)]
        return _look(laid, line, [found for found in beside if found])

    with ThreadPoolExecutor(max_workers=workers) as pool:
        looked = list(pool.map(look, lines))
    area = _PreparedArea(laid.area)  # shapely's prepared shapes are not for threads
    return [_measures(found, area) for found in looked]


@dataclass(frozen=True, kw_only=True)
class _Looked:
    """What the images of a line see, without regard to the area."""

    forward: Array
    sides: Array
    """(sides with a line beside, n)."""
    gsd_m: Array
    middles_m: Array
    """(n, 2)."""
    rims_m: Array
    """(n, m, 3)."""


def _look(laid: LaidSet, line: StationLine, beside: list[list[StationLine]]) -> _Looked:
    imaging, ground = laid.mounting.imaging, laid.mounting.ground
    points = (
        points_on_ground(imaging, ground, line) if laid.target_m is None else _points_about(laid.target_m, laid, line)
    )
    beside = beside if laid.target_m is None else []
    return _Looked(
        forward=forward_overlaps(imaging, line, points),
        sides=_sides(imaging, line, points, beside),
        gsd_m=_ground_distances(imaging, line, points),
        middles_m=points_on_ground(imaging, ground, line, np.array([[0.0, 0.0, -1.0]]))[:, 0, :2],
        rims_m=points_on_ground(imaging, ground, line, imaging.rim_directions),
    )


def _points_about(target_m: Array, laid: LaidSet, line: StationLine) -> Array:
    """Return where the nodes (n, m, 3) of images lie on the plane across each view through a target (3,)."""
    views = -line.rotations[:, :, 2]
    depths = np.einsum("nk,nk->n", target_m - line.centres_m, views)
    rays = np.einsum("nij,mj->nmi", line.rotations, laid.mounting.imaging.directions)
    return np.ascontiguousarray(line.centres_m[:, None, :] + depths[:, None, None] * rays)


def _measures(looked: _Looked, area: "_PreparedArea") -> LineMeasures:
    middle_in_area = area.contains(looked.middles_m)
    sees_area = area.meets(looked.rims_m) | middle_in_area
    side = np.full(len(looked.forward), np.nan)
    if len(looked.sides):
        rim_only = np.where(sees_area, looked.sides.max(axis=0), np.nan)
        side = np.where(middle_in_area, looked.sides.min(axis=0), rim_only)
    return LineMeasures(
        forward=looked.forward,
        side=side,
        gsd_m=looked.gsd_m,
        sees_area=sees_area,
        middle_in_area=middle_in_area,
    )


def are_beside(line: StationLine, other: StationLine) -> bool:
    """Tell whether two lines of neighbouring rows run beside one another somewhere."""
    direction = _direction(line)
    ours, theirs = line.centres_m[:, :2] @ direction, other.centres_m[:, :2] @ direction
    spare = max(line.base_m, other.base_m)
    return bool(ours.min() - spare <= theirs.max() and theirs.min() - spare <= ours.max())


def _direction(line: StationLine) -> Array:
    """Return the direction of a line, (2,)."""
    step = line.centres_m[-1, :2] - line.centres_m[0, :2]
    length = float(np.hypot(*step))
    return np.asarray(step / length) if length > 0.0 else np.array([0.0, 1.0])


def _near(others: list[StationLine], line: StationLine) -> list[StationLine]:
    return [other for other in others if are_beside(line, other)]


class _PreparedArea:
    """Where the middle of an image, or any part of it, counts."""

    def __init__(self, area: Any) -> None:
        import shapely

        self.area = area
        if area is not None:
            shapely.prepare(area)

    def contains(self, xy_m: Array) -> Flags:
        import shapely

        if self.area is None:
            return np.ones(len(xy_m), np.bool_)
        return np.asarray(shapely.contains_xy(self.area, xy_m[:, 0], xy_m[:, 1]))

    def meets(self, rims_m: Array) -> Flags:
        """Tell for rims (n, m, 3) whether the ground inside meets the area."""
        import shapely

        if self.area is None:
            return np.ones(len(rims_m), np.bool_)
        rims = np.where(
            np.isnan(rims_m[:, :, :2]), np.nanmean(rims_m[:, :, :2], axis=1, keepdims=True), rims_m[:, :, :2]
        )
        rims = np.where(np.isnan(rims), 0.0, rims)
        hulls = shapely.convex_hull(shapely.linestrings(rims))
        return np.asarray(shapely.intersects(self.area, hulls))


def _sides(imaging: Imaging, line: StationLine, points: Array, beside: list[list[StationLine]]) -> Array:
    """Return the shares (sides, n) that the lines of each side show."""
    direction = _direction(line)
    shares = [side_overlaps(imaging, points, Neighbours.of(direction, lines)) for lines in beside]
    return np.array(shares).reshape(len(shares), len(line))


def _ground_distances(imaging: Imaging, line: StationLine, points: Array) -> Array:
    """Return the ground distance of a pixel: depth along the view over the principal distance."""
    view = -line.rotations[:, :, 2]
    depth = np.einsum("nmk,nk->nm", points - line.centres_m[:, None, :], view)
    gsd = depth / imaging.interior.principal_distance_px
    return np.column_stack([np.nanmin(gsd, axis=1), np.nanmean(gsd, axis=1), np.nanmax(gsd, axis=1)])


def coverage_map(ground: Ground, shape: Any, images: Sequence[tuple[Imaging, StationLine]]) -> CoverageMap:
    """Return how many images see each cell of the ground over an area (shapely's, in the axes of the ground)."""
    import shapely

    west, south, east, north = shape.bounds
    cell = max(LEAST_CELL_M, float(np.sqrt((east - west) * (north - south) / CELLS)))
    columns, rows = (max(2, int(np.ceil(size / cell))) for size in (east - west, north - south))
    first = np.array(
        [west + 0.5 * ((east - west) - (columns - 1) * cell), south + 0.5 * ((north - south) - (rows - 1) * cell)]
    )
    x, y = first[0] + cell * np.arange(columns), first[1] + cell * np.arange(rows)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    heights = np.nan_to_num(ground.heights_at(grid), nan=float(ground.limits[0])).reshape(rows, columns)
    counts = np.zeros((rows, columns), np.uint16)
    for imaging, line in images:
        rims = points_on_ground(imaging, ground, line, imaging.rim_directions)
        count_images(heights, first, cell, rims, line.centres_m, line.rotations, imaging.parameters, counts)
    shapely.prepare(shape)
    inside = shapely.contains_xy(shape, grid[:, 0], grid[:, 1]).reshape(rows, columns)
    return CoverageMap(
        images=counts, in_area=np.asarray(inside), first_xy_m=(float(first[0]), float(first[1])), cell_m=cell
    )


def covered_shares(coverage: CoverageMap, least: int) -> tuple[int, float, float]:
    """Return the fewest images of a cell of the area, and the shares of it seen by one and by ``least`` images."""
    counts = coverage.images[coverage.in_area]
    if counts.size == 0:
        return 0, float("nan"), float("nan")
    return int(counts.min()), float(np.mean(counts >= 1)), float(np.mean(counts >= least))


def least_and_mean(shares: Array) -> tuple[float, float]:
    """Return the least and the mean of shares (n,) without nan; nan where there is none."""
    known = shares[~np.isnan(shares)]
    return (float(known.min()), float(known.mean())) if len(known) else (float("nan"), float("nan"))


def stations_of(lines: Sequence[StationLine]) -> NDArray[np.int64]:
    """Return the number of the first station of each line, (lines,)."""
    return np.concatenate([[0], np.cumsum([len(line) for line in lines])[:-1]]).astype(np.int64)
