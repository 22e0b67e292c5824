"""The simulated site, 80 m x 40 m of it flown over, known everywhere without error: an embankment, hills or a plane.

The surface is a height field over a grid of 2.5 cm, bilinear between its nodes: this interpolation *is* the truth, so
the true height of any place and the true hit of any ray can be asked for later. The grid lies in the axes of the site:
``along`` the crest and ``across`` it, turned against east and north by ``AZIMUTH_RAD``. ``make_world`` rebuilds the
same world from its seed, terrain and texture.

Brightness comes from a map of the whole site on the same grid (it holds sun, shadow and all waves longer than 5 cm)
times the fine detail of three materials down to 4 mm (periodic, two layers turned against each other), see
``textures``.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.simulate import noise
from uavkit.simulate.kernels import (
    CELL_M,
    COARSE,
    SIGNAL_RADIUS_M,
    STEEP,
    Field,
    cast_shadows,
    surface_heights,
)
from uavkit.simulate.options import Terrain, Texture
from uavkit.simulate.terrain import SHAPE, make_heights
from uavkit.simulate.textures import OBJECTS, make_surface

AZIMUTH_RAD = float(np.radians(25.0))
"""Direction of the crest, counted from east towards north."""

SUN_AZIMUTH_RAD = float(np.radians(-70.0))
"""From the axis ``along``, towards ``across``."""
SUN_ELEVATION_RAD = float(np.radians(50.0))


class Ground(NamedTuple):
    """The world as bare arrays, as the ray and shading kernels take it."""

    heights_m: Field
    """(rows, columns): rows run across, columns along."""
    bounds: Field
    """(coarse rows, coarse columns, 5): distance to the nearest gradient above ``STEEP`` (rather too small), highest
    surface within 3 m and within 1 m; steepest gradient and highest surface of the cell and its eight neighbours."""
    radiance: Field
    """Mean of red, green and blue without fine detail; its mip levels one after another, flat."""
    levels: NDArray[np.int64]
    """(levels, 3): offset, rows, columns of each level of ``radiance``."""
    weights: NDArray[np.uint8]
    """(rows / 8, columns / 8, 4): shares of grass, gravel, soil in 1 / 255, and contrast of the fine detail."""
    tiles: NDArray[np.uint8]
    """(3, cells): fine detail of each material, 128 + 36 standard deviations; mip levels one after another."""
    tints: Field
    """(3, 3): red, green, blue of each material, mean 1."""
    layers: Array
    """(3, 2): weight of each material's tile as it lies, and of the same tile turned by 37 degrees."""
    signal_index: NDArray[np.int16]
    """(coarse rows, coarse columns): row of ``signals_m`` of the signal that touches a coarse cell, -1 for none."""
    signals_m: Array
    """(n, 2): along, across of the painted signals at control and check points."""


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """A site of which everything is known."""

    seed: int
    ground: Ground

    def height_m(self, east_m: Array, north_m: Array) -> Array:
        """True height in the local system (up), any shape; beyond the site the surface goes on level."""
        east, north = np.broadcast_arrays(np.asarray(east_m, float), np.asarray(north_m, float))
        along, across = along_across(east, north)
        heights = surface_heights(self.ground.heights_m, along.ravel(), across.ravel())
        return np.asarray(heights.reshape(east.shape))

    def with_signals(self, points_m: Array) -> "World":
        """Return the same site with a signal painted at each point, shape (n, 3) in east, north, up."""
        along, across = along_across(points_m[:, 0], points_m[:, 1])
        index = np.full(self.ground.bounds.shape[:2], -1, dtype=np.int16)
        for n, (a, b) in enumerate(zip(along, across, strict=True)):
            columns = [
                int((a + d) / CELL_M + 0.5 * (SHAPE[1] - 1)) // COARSE for d in (-SIGNAL_RADIUS_M, SIGNAL_RADIUS_M)
            ]
            rows = [int((b + d) / CELL_M + 0.5 * (SHAPE[0] - 1)) // COARSE for d in (-SIGNAL_RADIUS_M, SIGNAL_RADIUS_M)]
            index[rows[0] : rows[1] + 1, columns[0] : columns[1] + 1] = n
        ground = self.ground._replace(signal_index=index, signals_m=np.column_stack([along, across]))
        return replace(self, ground=ground)


def along_across(east_m: Array, north_m: Array) -> tuple[Array, Array]:
    """Site coordinates of local east, north."""
    cosine, sine = np.cos(AZIMUTH_RAD), np.sin(AZIMUTH_RAD)
    return cosine * east_m + sine * north_m, -sine * east_m + cosine * north_m


def enu_from_site() -> Array:
    """Rotation matrix: columns are the axes along, across, up in east, north, up."""
    cosine, sine = np.cos(AZIMUTH_RAD), np.sin(AZIMUTH_RAD)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


@lru_cache(maxsize=1)
def make_world(seed: int, terrain: Terrain = Terrain.EMBANKMENT, texture: Texture = Texture.MIXED) -> World:
    """Build the site of this seed; takes some seconds, so the last one is kept."""
    rng = np.random.default_rng([seed, 1])
    heights, rock = make_heights(rng, terrain, 0 if terrain is Terrain.FLAT else OBJECTS[texture])
    bounds = _bounds(heights)
    surface = make_surface(rng, texture, rock)
    light = _light(heights, bounds)
    if surface.sunlight < 1.0:
        light = light.mean() * (1.0 + surface.sunlight * (light / light.mean() - 1.0))
    flat, levels = noise.mip_levels(np.asarray(surface.albedo * light, dtype=np.float32), 5)
    none = np.full(bounds.shape[:2], -1, dtype=np.int16)
    ground = Ground(
        heights_m=heights,
        bounds=bounds,
        radiance=flat,
        levels=levels,
        weights=surface.weights,
        tiles=surface.tiles,
        tints=surface.tints,
        layers=surface.layers,
        signal_index=none,
        signals_m=np.zeros((0, 2)),
    )
    return World(seed=seed, ground=ground)


def _bounds(heights: Field) -> Field:
    """What may hide the ground around each coarse cell, see ``Ground.bounds``."""
    from scipy import ndimage

    rows, columns = (n // COARSE for n in SHAPE)
    across = np.abs(np.diff(heights, axis=0, append=heights[-1:]))
    along = np.abs(np.diff(heights, axis=1, append=heights[:, -1:]))
    blocks = (rows, COARSE, columns, COARSE)
    steepest = (np.hypot(across, along) / CELL_M).reshape(blocks).max(axis=(1, 3))
    gentle = steepest <= STEEP
    if gentle.all():
        distance = np.full(gentle.shape, 1e3)
    else:
        distance = ndimage.distance_transform_edt(gentle) * COARSE * CELL_M
    highest = heights.reshape(blocks).max(axis=(1, 3))
    clearance = np.maximum(distance - 1.5 * COARSE * CELL_M, 0.0)
    far, near, here = (ndimage.maximum_filter(highest, size) for size in (31, 13, 3))
    slope = ndimage.maximum_filter(steepest, 3) * 1.01
    return np.stack([clearance, far, near, slope, here + 1e-5], axis=-1).astype(np.float32)


def _light(heights: Field, bounds: Field) -> Array:
    """Sun and sky upon each node: slopes towards the sun are brighter, shadows hold the sky alone."""
    along, across = np.gradient(heights, CELL_M, axis=1), np.gradient(heights, CELL_M, axis=0)
    horizontal, vertical = np.cos(SUN_ELEVATION_RAD), np.sin(SUN_ELEVATION_RAD)
    sun = np.array([horizontal * np.cos(SUN_AZIMUTH_RAD), horizontal * np.sin(SUN_AZIMUTH_RAD), vertical])
    lit = (vertical - sun[0] * along - sun[1] * across) / np.sqrt(1.0 + along**2 + across**2)
    shadow = np.ones(SHAPE, dtype=np.float32)
    cast_shadows(heights, np.ascontiguousarray(bounds[:, :, 0]), sun, shadow)
    return np.asarray(0.38 + 0.8 * np.maximum(lit, 0.0) * shadow)
