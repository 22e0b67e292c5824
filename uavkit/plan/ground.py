"""The ground as planning sees it: heights over a local map, from an elevation grid or flat."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.frames import WGS84, LocalMap, transformed
from uavkit.core.surface import ElevationGrid
from uavkit.plan.kernels import ground_heights, path_clearance

LATTICE = 13
"""Places on each axis at which the transformation from map to grid is computed; between them a polynomial serves."""
WORST_FIT = 0.05
"""Of that polynomial, in nodes of the grid."""
FARTHEST_M = 20000.0
"""A ray that meets no ground within this horizontal distance meets none."""


@dataclass(frozen=True, kw_only=True)
class Ground:
    """Heights of the ground over a local map; beyond the rim of the grid its last heights go on."""

    local_map: LocalMap
    heights: NDArray[np.float32] = field(repr=False)
    """(rows, columns) above the ellipsoid; nan is a void."""
    grid_from_map: Array = field(repr=False)
    """(2, 10): column and row by a polynomial of third degree of map coordinates, reduced by ``origin``."""
    origin: Array
    """(3,): x, y, and the factor that brings coordinates to about 1."""
    node_m: float
    """Distance of two nodes on the ground; infinite for flat ground."""
    sigma_m: float
    source: str

    @property
    def arrays(self) -> tuple[NDArray[np.float32], Array, Array]:
        """Return what the kernels take."""
        return self.heights, self.grid_from_map, self.origin

    @property
    def is_flat(self) -> bool:
        """Tell whether this is a plane, not a terrain model."""
        return not np.isfinite(self.node_m)

    @cached_property
    def limits(self) -> Array:
        """Return what rays need to know, (5,): least and greatest height, slope, step of a march, farthest distance."""
        heights = self.heights
        low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
        if self.is_flat:
            return np.array([low, high, 0.0, 1.0, FARTHEST_M])
        steepest = max(float(np.nanmax(np.abs(np.diff(heights, axis=axis)), initial=0.0)) for axis in (0, 1))
        return np.array([low, high, np.sqrt(2.0) * steepest / self.node_m, 0.5 * self.node_m, FARTHEST_M])

    def heights_at(self, xy_m: Array) -> Array:
        """Return heights (n,) at map coordinates (n, 2); nan over a void."""
        result = np.empty(len(xy_m))
        ground_heights(*self.arrays, np.ascontiguousarray(xy_m, np.float64), result)
        return result

    def clearances(self, path_m: Array) -> Array:
        """Return least and greatest height above the ground of each leg of a path (k, 3), shape (k - 1, 2).

        Raises InputError where a leg crosses a void, naming the place.
        """
        result = np.empty((max(len(path_m) - 1, 0), 2))
        path_clearance(*self.arrays, np.ascontiguousarray(path_m), self.step_m, result)
        bad = np.flatnonzero(np.isnan(result[:, 0]))
        if len(bad):
            self.refuse_voids(path_m[bad[0]][None, :2], "the path crosses")
        return result

    @property
    def step_m(self) -> float:
        """Return the distance at which paths are compared with the ground."""
        return min(0.25 * self.node_m, 1e6)

    def refuse_voids(self, xy_m: Array, what: str) -> None:
        """Raise an InputError that names a place (n, 2) of a void."""
        latitude, longitude = self.local_map.geographic_from_map(xy_m[:1])[0]
        raise InputError(
            f"{self.source}: {what} a void of the terrain model at latitude {latitude:.6f}, longitude {longitude:.6f}: "
            f"fill it in a GIS, take another model, or leave the place out of the area"
        )


def flat_ground(local_map: LocalMap, height_ellipsoid_m: float) -> Ground:
    """Return a horizontal plane."""
    return Ground(
        local_map=local_map,
        heights=np.full((2, 2), height_ellipsoid_m, np.float32),
        grid_from_map=np.zeros((2, 10)),
        origin=np.array([0.0, 0.0, 1.0]),
        node_m=float("inf"),
        sigma_m=0.0,
        source="",
    )


def ground_from_grid(local_map: LocalMap, grid: ElevationGrid, box_m: tuple[float, float, float, float]) -> Ground:
    """Return the ground of an elevation grid about a box (least x, y, greatest x, y) of the map.

    Raises InputError where the box does not lie in the grid, or is too large for one map.
    """
    low, high = np.array(box_m[:2]), np.array(box_m[2:])
    middle, half = 0.5 * (low + high), max(0.5 * float(np.max(high - low)), 1.0)
    steps = np.linspace(-1.0, 1.0, LATTICE)
    a, b = (axis.ravel() for axis in np.meshgrid(steps, steps))
    nodes = _grid_coordinates(local_map, grid, middle + half * np.column_stack([a, b]))
    basis = np.column_stack([np.ones_like(a), a, b, a * a, a * b, b * b, a**3, a * a * b, a * b * b, b**3])
    coefficients, *_ = np.linalg.lstsq(basis, nodes, rcond=None)
    if float(np.max(np.abs(basis @ coefficients - nodes))) > WORST_FIT:
        raise InputError(f"the area spans {2e-3 * half:.0f} km, too much for one plan: divide it")
    _refuse_outside(local_map, grid, box_m)
    unit = np.hypot(*(coefficients[1:3] / half))  # columns and rows a metre
    return Ground(
        local_map=local_map,
        heights=np.ascontiguousarray(grid.height_ellipsoid_m),
        grid_from_map=np.ascontiguousarray(coefficients.T),
        origin=np.array([*middle, 1.0 / half]),
        node_m=float(1.0 / np.max(unit)),
        sigma_m=grid.sigma_m,
        source=grid.source,
    )


def _grid_coordinates(local_map: LocalMap, grid: ElevationGrid, xy_m: Array) -> Array:
    geographic = local_map.geographic_from_map(xy_m)
    longitude_latitude = np.column_stack([geographic[:, ::-1], np.zeros(len(xy_m))])
    return grid.grid_from_crs(transformed(WGS84, grid.crs, longitude_latitude)[:, :2])


def _refuse_outside(local_map: LocalMap, grid: ElevationGrid, box_m: tuple[float, float, float, float]) -> None:
    x, y = np.array(box_m)[[0, 2, 2, 0]], np.array(box_m)[[1, 1, 3, 3]]
    corners = _grid_coordinates(local_map, grid, np.column_stack([x, y]))
    rows, columns = grid.height_ellipsoid_m.shape
    beyond = np.max(np.concatenate([-corners, corners - [columns - 1.0, rows - 1.0]], axis=1), axis=1)
    if float(np.max(beyond)) > 0.5:
        latitude, longitude = local_map.geographic_from_map(np.column_stack([x, y]))[int(np.argmax(beyond))]
        raise InputError(
            f"{grid.source}: the terrain model ends before latitude {latitude:.6f}, longitude {longitude:.6f}, which "
            f"the flight needs: take a larger model, a smaller area, or look whether latitude and longitude are swapped"
        )
