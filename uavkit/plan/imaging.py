"""What an image sees: camera as the kernels take it, footprint, air base, and the image's orientation in flight."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.camera import CameraProfile, InteriorOrientation, ideal_from_pixels, image_directions

NODES = 11
"""Places on each axis of an image at which it is asked what the image beside it shows."""
PROBE_NODES = 7
"""The same while strips are being laid."""


@dataclass(frozen=True, kw_only=True)
class Imaging:
    """A camera in flight: how it is mounted and what it sees."""

    profile: CameraProfile
    long_side_across: bool

    @property
    def interior(self) -> InteriorOrientation:
        """Return the camera's interior orientation."""
        return self.profile.interior

    @property
    def rows_along(self) -> bool:
        """Tell whether the rows of the image follow one another along the flight (else the columns do)."""
        return (self.interior.width_px >= self.interior.height_px) == self.long_side_across

    @cached_property
    def parameters(self) -> Array:
        """Return the camera as the kernels take it, (13,)."""
        interior = self.interior
        corners = ideal_from_pixels(_rim(interior, 5), interior)
        radius = 1.05 * float(np.max(np.hypot(corners[:, 0], corners[:, 1])))
        return np.array(
            [interior.width_px, interior.height_px, interior.principal_distance_px, interior.x0_px, interior.y0_px]
            + [interior.k1, interior.k2, interior.k3, interior.p1, interior.p2, interior.b1, interior.b2, radius]
        )

    @cached_property
    def directions(self) -> Array:
        """Return the directions (NODES * NODES, 3) in image space of nodes from rim to rim, row by row."""
        return self._node_directions(NODES)

    @cached_property
    def probe_directions(self) -> Array:
        """Return the same for fewer nodes, (PROBE_NODES * PROBE_NODES, 3)."""
        return self._node_directions(PROBE_NODES)

    def _node_directions(self, nodes: int) -> Array:
        interior = self.interior
        columns = np.linspace(-0.5, interior.width_px - 0.5, nodes)
        rows = np.linspace(-0.5, interior.height_px - 0.5, nodes)
        grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        return np.ascontiguousarray(image_directions(grid, interior))

    @cached_property
    def rim_directions(self) -> Array:
        """Return directions (n, 3) in image space around the rim of the image, for footprints."""
        return np.ascontiguousarray(image_directions(_rim(self.interior, 5), self.interior))

    @cached_property
    def field(self) -> tuple[float, float, float, float]:
        """Return the tangents of the view through the principal point: behind, ahead, left, right; all positive."""
        interior = self.interior
        x0, y0 = interior.x0_px, interior.y0_px
        ends = [[-0.5, y0], [interior.width_px - 0.5, y0], [x0, -0.5], [x0, interior.height_px - 0.5]]
        x, y, _ = image_directions(np.array(ends), interior).T
        if self.rows_along:
            return float(-y.min()), float(y.max()), float(-x.min()), float(x.max())
        return float(-x.min()), float(x.max()), float(-y.min()), float(y.max())

    def length_m(self, height_m: float) -> float:
        """Return how much flat ground an image shows along the flight."""
        return (self.field[0] + self.field[1]) * height_m

    def width_m(self, height_m: float) -> float:
        """Return how much flat ground an image shows across the flight."""
        return (self.field[2] + self.field[3]) * height_m

    def gsd_m(self, height_m: float) -> float:
        """Return the ground distance of a pixel below the camera: height over principal distance."""
        return height_m / self.interior.principal_distance_px

    def height_m(self, gsd_m: float) -> float:
        """Return the height above ground that gives a ground distance of a pixel."""
        return gsd_m * self.interior.principal_distance_px

    def nadir_rotation(self, heading_rad: float) -> Array:
        """Return R_map_from_image (3, 3) looking down, the image's upper (or right) side ahead; heading from north."""
        return self.mounted(level_axes(heading_rad))

    def mounted(self, axes: Array) -> Array:
        """Return R_map_from_image of axes (3, 3): right, ahead, back along the view, as columns."""
        right, ahead, back = axes.T
        if self.rows_along:
            return np.ascontiguousarray(axes)
        return np.column_stack([ahead, -right, back])


def level_axes(heading_rad: float) -> Array:
    """Return right, ahead and up as columns (3, 3) in map axes for a heading from north, clockwise."""
    s, c = np.sin(heading_rad), np.cos(heading_rad)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _rim(interior: InteriorOrientation, number: int) -> Array:
    """Return pixels (4 (number - 1), 2) around the rim of the image."""
    steps = np.linspace(0.0, 1.0, number)[:-1]
    w, h = float(interior.width_px), float(interior.height_px)
    sides = [
        np.column_stack([steps * w, np.zeros_like(steps)]),
        np.column_stack([np.full_like(steps, w), steps * h]),
        np.column_stack([w - steps * w, np.full_like(steps, h)]),
        np.column_stack([np.zeros_like(steps), h - steps * h]),
    ]
    return np.concatenate(sides) - 0.5
