"""Surfaces over the ground as regular grids."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class ElevationGrid:
    """Heights of the ground at the nodes of a regular grid in a CRS; between nodes they are interpolated bilinearly."""

    height_ellipsoid_m: NDArray[np.float32]
    """(rows, columns) above the ellipsoid of WGS 84; nan is a void."""
    crs: str
    """Horizontal CRS of ``crs_from_grid``: EPSG code, PROJ text or WKT."""
    crs_from_grid: Array
    """(2, 3): easting (longitude) and northing (latitude) in units of the CRS of (column, row, 1); (0, 0) is the node
    of the first height, the *centre* of its pixel where the file speaks of pixels."""
    sigma_m: float
    """Stated standard deviation of a height."""
    source: str

    def __post_init__(self) -> None:
        if self.height_ellipsoid_m.ndim != 2 or min(self.height_ellipsoid_m.shape) < 2:
            raise ValueError(f"an elevation grid needs 2 x 2 nodes, has {self.height_ellipsoid_m.shape}")
        if self.crs_from_grid.shape != (2, 3) or abs(np.linalg.det(self.crs_from_grid[:, :2])) == 0.0:
            raise ValueError("crs_from_grid is an affine transformation (2, 3) that can be inverted")
        if not self.sigma_m >= 0.0:
            raise ValueError(f"sigma_m must be >= 0, is {self.sigma_m}")

    def grid_from_crs(self, coordinates: Array) -> Array:
        """Return column, row (n, 2) of easting, northing (n, 2) in the CRS of the grid."""
        inverse = np.linalg.inv(self.crs_from_grid[:, :2])
        return np.asarray((coordinates - self.crs_from_grid[:, 2]) @ inverse.T)
