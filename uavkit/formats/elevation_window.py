"""Which part of an elevation model lies about an area, and the shift from its heights to ellipsoidal ones."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.frames import LocalFrame, geographic_from_crs, geoid_undulation_m, parse_crs

MARGIN_NODES = 2
LATTICE_M = 250.0
"""Spacing of the lattice on which the shift of heights is evaluated. EGM96 is bilinear in cells of 15 minutes here;
its slope changes from cell to cell by 2.2e-4 at most (up to 70 degrees of latitude), and where it does, interpolation
over a lattice of s is wrong by 2.2e-4 s / 4 = 0.014 m, in each direction."""
_DEGREE_M = 111320.0
_EDGE_POINTS = 33


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """A part of a grid."""

    row: int
    column: int
    rows: int
    columns: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Return the index of an array that gives the part."""
        return slice(self.row, self.row + self.rows), slice(self.column, self.column + self.columns)


@dataclass(frozen=True, slots=True, kw_only=True)
class GridExtent:
    """Where the nodes of a grid lie."""

    crs: str
    crs_from_grid: Array
    """(2, 3), as that of ``ElevationGrid``."""
    shape: tuple[int, ...]
    """Rows, columns."""

    @property
    def cell_m(self) -> float:
        """Return the side of a square of a cell's area, in metres at the middle of the grid."""
        side = math.sqrt(abs(float(np.linalg.det(self.crs_from_grid[:, :2]))))
        if self.is_geographic:
            latitude = self.geographic(np.array([[0.5 * (self.shape[1] - 1), 0.5 * (self.shape[0] - 1)]]))[0, 0]
            return float(side * _DEGREE_M * math.sqrt(abs(math.cos(math.radians(latitude)))))
        return side

    @property
    def is_geographic(self) -> bool:
        """Tell whether the CRS counts in degrees."""
        return bool(parse_crs(self.crs).is_geographic)

    def whole(self) -> Window:
        """Return the window of all nodes."""
        return Window(row=0, column=0, rows=self.shape[0], columns=self.shape[1])

    def geographic(self, column_row: Array) -> Array:
        """Return latitude, longitude (n, 2) on WGS 84 of grid coordinates (n, 2)."""
        xy = column_row @ self.crs_from_grid[:, :2].T + self.crs_from_grid[:, 2]
        return geographic_from_crs(np.column_stack([xy, np.zeros(len(xy))]), self.crs)[:, :2]

    def grid(self, latitude_longitude_deg: Array) -> Array:
        """Return column, row (n, 2) of latitude, longitude (n, 2) near the grid."""
        middle = latitude_longitude_deg.mean(axis=0)
        frame = LocalFrame.at(float(middle[0]), float(middle[1]), 0.0, self.crs)
        latitude, longitude = latitude_longitude_deg.T
        xy = frame.crs_from_enu(frame.enu_from_geographic(latitude, longitude, np.zeros_like(latitude)))[:, :2]
        return np.asarray(np.linalg.solve(self.crs_from_grid[:, :2], (xy - self.crs_from_grid[:, 2]).T).T)

    def crs_from_window(self, window: Window) -> Array:
        """Return ``crs_from_grid`` of a part."""
        affine = self.crs_from_grid.copy()
        affine[:, 2] += affine[:, :2] @ [window.column, window.row]
        return affine

    def bounds_deg(self) -> tuple[float, float, float, float]:
        """Return south, west, north, east of the nodes; east is greater than west, also across the antimeridian."""
        rim = self.geographic(_rim(0.0, 0.0, self.shape[0] - 1.0, self.shape[1] - 1.0)[:, ::-1])
        latitude, longitude = rim[:, 0], np.unwrap(rim[:, 1], period=360.0)
        return float(latitude.min()), float(longitude.min()), float(latitude.max()), float(longitude.max())

    def place(self, column: float, row: float) -> str:
        """Return a node's place in words."""
        latitude, longitude = self.geographic(np.array([[column, row]]))[0]
        return f"latitude {latitude:.6f}, longitude {longitude:.6f}"


def _rim(first_low: float, second_low: float, first_high: float, second_high: float) -> Array:
    """Return points (n, 2) along the sides of a rectangle, in one turn."""
    share = np.linspace(0.0, 1.0, _EDGE_POINTS)
    first, second = (
        np.concatenate([share, np.ones_like(share), share[::-1], np.zeros_like(share)]),
        np.concatenate([np.zeros_like(share), share, np.ones_like(share), share[::-1]]),
    )
    low, high = np.array([first_low, second_low]), np.array([first_high, second_high])
    return np.asarray(low + np.column_stack([first, second]) * (high - low))


def window_around(extent: GridExtent, around: tuple[float, float, float, float]) -> Window:
    """Return the part of a grid about (south, west, north, east) in degrees, with a margin; raises InputError."""
    south, west, north, east = around
    if not (np.all(np.isfinite(around)) and -90.0 <= south <= north <= 90.0 and west <= east):
        raise InputError(f"the window to read is south, west, north, east in degrees, not {around}")
    bounds = extent.bounds_deg()
    turn = 360.0 * round((0.5 * (bounds[1] + bounds[3]) - 0.5 * (west + east)) / 360.0)
    low = np.maximum([south, west + turn], bounds[:2])
    high = np.minimum([north, east + turn], bounds[2:])
    if np.any(low > high):
        raise _outside(bounds, around)
    column_row = extent.grid(_rim(low[0], low[1], high[0], high[1]))
    last = np.array([extent.shape[1], extent.shape[0]]) - 1
    least, greatest = column_row.min(axis=0), column_row.max(axis=0)
    if np.any(greatest < -1e-6) or np.any(least > last + 1e-6):
        raise _outside(bounds, around)
    first = np.clip(np.floor(least).astype(int) - MARGIN_NODES, 0, last)
    end = np.clip(np.ceil(greatest).astype(int) + MARGIN_NODES, 0, last) + 1
    return Window(row=int(first[1]), column=int(first[0]), rows=int(end[1] - first[1]), columns=int(end[0] - first[0]))


def _outside(bounds: tuple[float, ...], around: tuple[float, float, float, float]) -> InputError:
    latitude, longitude = 0.5 * (around[0] + around[2]), 0.5 * (around[1] + around[3])
    swapped = bounds[0] <= longitude <= bounds[2] and bounds[1] <= latitude <= bounds[3]
    hint = "latitude and longitude swapped?" if swapped else "give a model of the right region"
    return InputError(
        f"the elevation model covers latitude {bounds[0]:.6f} to {bounds[2]:.6f}, longitude {bounds[1]:.6f} to "
        f"{bounds[3]:.6f}; the area lies outside, at latitude {latitude:.6f}, longitude {longitude:.6f}: {hint}"
    )


def add_height_shift(heights: NDArray[np.float32], crs: str, crs_from_grid: Array, crs3d: str) -> None:
    """Make heights (rows, columns) ellipsoidal in place: from the geoid, or from the ellipsoid of a ``crs3d``.

    The shift is evaluated on a lattice of about ``LATTICE_M`` and interpolated bilinearly.
    """
    extent = GridExtent(crs=crs, crs_from_grid=crs_from_grid, shape=heights.shape)
    rows, columns = (_lattice(count, extent.cell_m) for count in heights.shape)
    column_row = np.column_stack([axis.ravel() for axis in np.meshgrid(columns, rows)])
    if crs3d:
        xy = column_row @ crs_from_grid[:, :2].T + crs_from_grid[:, 2]
        shift = geographic_from_crs(np.column_stack([xy, np.zeros(len(xy))]), crs3d)[:, 2]
    else:
        shift = geoid_undulation_m(*extent.geographic(column_row).T)
    _add_interpolated(heights, rows, columns, shift.reshape(len(rows), len(columns)))


def _lattice(count: int, cell_m: float) -> Array:
    """Return grid coordinates from the first to the last of ``count`` nodes, about ``LATTICE_M`` apart."""
    return np.linspace(0.0, count - 1.0, max(2, int(np.ceil((count - 1) * cell_m / LATTICE_M)) + 1))


def _add_interpolated(heights: NDArray[np.float32], rows: Array, columns: Array, lattice: Array) -> None:
    """Add a bilinear surface, given on a lattice, row by row: no array of the grid's size is made."""
    all_columns = np.arange(heights.shape[1], dtype=np.float64)
    along = np.array([np.interp(all_columns, columns, line) for line in lattice])
    below = np.clip(np.searchsorted(rows, np.arange(heights.shape[0]), side="right") - 1, 0, len(rows) - 2)
    for row, first in enumerate(below.tolist()):
        share = (row - rows[first]) / (rows[first + 1] - rows[first])
        heights[row] += (1.0 - share) * along[first] + share * along[first + 1]
