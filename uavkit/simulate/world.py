"""The simulated site: an embankment 80 m x 40 m of 10 m relief, known everywhere without error.

The surface is a height field over a grid of 2.5 cm, bilinear between its nodes: this interpolation *is* the truth, so
the true height of any place and the true hit of any ray can be asked for later. The grid lies in the axes of the site:
``along`` the crest and ``across`` it, turned against east and north by ``AZIMUTH_RAD``. ``make_world`` rebuilds the
same world from its seed.

Brightness comes from a map of the whole site on the same grid (it never repeats, and holds sun, shadow and all waves
longer than 5 cm) times the fine detail of three materials down to 4 mm (periodic, two layers turned against each
other).
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
    MATERIAL_CELL_M,
    SIGNAL_RADIUS_M,
    STEEP,
    Field,
    cast_shadows,
    surface_heights,
)

AZIMUTH_RAD = float(np.radians(25.0))
"""Direction of the crest, counted from east towards north."""

SHAPE = (2560, 4800)
"""Nodes across and along: 64 m x 120 m."""

MATERIAL_STRIDE = round(MATERIAL_CELL_M / CELL_M)

CREST_HEIGHT_M = 11.0
CREST_HALF_WIDTH_M = 3.0
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
def make_world(seed: int) -> World:
    """Build the site of this seed; takes some seconds, so the last one is kept."""
    rng = np.random.default_rng([seed, 1])
    terrain = _terrain(rng)
    objects, rock = _objects(rng, terrain)
    heights = np.maximum(terrain, objects)
    bounds = _bounds(heights)
    weights, contrast = _materials(rng)
    radiance = _radiance(rng, heights, bounds, rock, contrast)
    flat, levels = _mip_levels(radiance, 5)
    tints = np.array([[0.88, 1.12, 0.70], [1.04, 1.00, 0.95], [1.20, 1.00, 0.76]], dtype=np.float32)
    none = np.full(bounds.shape[:2], -1, dtype=np.int16)
    ground = Ground(heights, bounds, flat, levels, weights, _tiles(rng), tints, none, np.zeros((0, 2)))
    return World(seed=seed, ground=ground)


def _terrain(rng: np.random.Generator) -> Field:
    """Crest with two slopes, a bench on one side, undulating along, plus natural roughness."""
    rows, columns = SHAPE
    along = ((np.arange(columns) - 0.5 * (columns - 1)) * CELL_M)[None, :]
    across = ((np.arange(rows) - 0.5 * (rows - 1)) * CELL_M)[:, None]
    wander = 0.8 * np.sin(along / 11.0 + rng.uniform(0, 6)) + 0.4 * np.sin(along / 4.3 + rng.uniform(0, 6))
    t = across - wander
    crest = CREST_HEIGHT_M + 0.35 * np.sin(along / 8.0 + rng.uniform(0, 6))
    lower = crest + 0.4 - np.logaddexp(0.0, (t - CREST_HALF_WIDTH_M) / 0.7) * 0.7 / 1.7
    bench = 0.8 * (np.tanh((t - 9.5) / 1.2) - 1.0)
    upper = crest + 0.4 - np.logaddexp(0.0, (-t - CREST_HALF_WIDTH_M) / 0.7) * 0.7 / 1.65
    slopes = -np.logaddexp(-lower - bench, -upper)
    foot = np.logaddexp(0.0, slopes / 0.5) * 0.5
    rough = noise.spectral_noise(rng, SHAPE, CELL_M, 2.2, (0.25, 18.0))
    return np.asarray(foot + 0.16 * rough, dtype=np.float32)


def _objects(rng: np.random.Generator, terrain: Field) -> tuple[Field, NDArray[np.bool_]]:
    """Boulders and boxes with steep flanks: their surface (very low elsewhere) and where they lie."""
    surface = np.full(SHAPE, -1e3, dtype=np.float32)
    for _ in range(90):
        size = rng.uniform(0.2, 0.9) * np.array([1.0, rng.uniform(0.7, 1.0)])
        _place(rng, surface, terrain, size, _boulder(float(rng.uniform(0.5, 0.9) * size[0])))
    for _ in range(14):
        half = rng.uniform(0.35, 1.0, 2)
        _place(rng, surface, terrain, half, _box(float(rng.uniform(0.4, 1.1)), half))
    return surface, surface > terrain


class _Shape(NamedTuple):
    power: float
    height_m: float
    flank_m: float


def _boulder(height_m: float) -> _Shape:
    return _Shape(3.0, height_m, 0.0)


def _box(height_m: float, half_m: Array) -> _Shape:
    return _Shape(0.0, height_m, min(0.15, float(half_m.min()) / 3))


def _place(rng: np.random.Generator, surface: Field, terrain: Field, half_m: Array, shape: _Shape) -> None:
    """Put one object somewhere on the site, turned at random; it stands on the ground at its centre."""
    rows, columns = SHAPE
    reach = int(np.ceil(1.5 * float(half_m.max()) / CELL_M))
    column, row = int(rng.integers(reach, columns - reach)), int(rng.integers(reach, rows - reach))
    if rng.random() < 0.8:  # most of them where the survey flies
        column = int(columns / 2 + rng.uniform(-42, 42) / CELL_M)
        row = int(rows / 2 + rng.uniform(-21, 21) / CELL_M)
    window = np.s_[row - reach : row + reach + 1, column - reach : column + reach + 1]
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1] * CELL_M
    turn = rng.uniform(0, np.pi)
    x, y = np.cos(turn) * u + np.sin(turn) * v, -np.sin(turn) * u + np.cos(turn) * v
    if shape.power:
        radius = np.hypot(x / half_m[0], y / half_m[1]) * (1 + 0.08 * np.sin(3 * np.arctan2(y, x) + rng.uniform(0, 6)))
        height = shape.height_m * (1.0 - radius**shape.power)
    else:
        inside = np.minimum(half_m[0] - np.abs(x), half_m[1] - np.abs(y))
        height = shape.height_m * np.clip(inside / shape.flank_m, -1.0, 1.0)
    standing = float(terrain[row, column]) - 0.03 + height
    surface[window] = np.maximum(surface[window], standing.astype(np.float32))


def _bounds(heights: Field) -> Field:
    """What may hide the ground around each coarse cell, see ``Ground.bounds``."""
    from scipy import ndimage

    rows, columns = (n // COARSE for n in SHAPE)
    across = np.abs(np.diff(heights, axis=0, append=heights[-1:]))
    along = np.abs(np.diff(heights, axis=1, append=heights[:, -1:]))
    blocks = (rows, COARSE, columns, COARSE)
    steepest = (np.hypot(across, along) / CELL_M).reshape(blocks).max(axis=(1, 3))
    distance = ndimage.distance_transform_edt(steepest <= STEEP) * COARSE * CELL_M
    highest = heights.reshape(blocks).max(axis=(1, 3))
    clearance = np.maximum(distance - 1.5 * COARSE * CELL_M, 0.0)
    far, near, here = (ndimage.maximum_filter(highest, size) for size in (31, 13, 3))
    slope = ndimage.maximum_filter(steepest, 3) * 1.01
    return np.stack([clearance, far, near, slope, here + 1e-5], axis=-1).astype(np.float32)


def _materials(rng: np.random.Generator) -> tuple[NDArray[np.uint8], Array]:
    """Patches of grass, gravel and soil with soft borders, and patches of weak contrast."""
    shape = (SHAPE[0] // MATERIAL_STRIDE, SHAPE[1] // MATERIAL_STRIDE)
    cell = CELL_M * MATERIAL_STRIDE
    bands = [noise.spectral_noise(rng, shape, cell, 1.6, (0.5, 14.0)) for _ in range(3)]
    shares = np.stack([np.exp(6.0 * band) for band in bands], axis=-1)
    shares /= shares.sum(axis=-1, keepdims=True)
    weak = noise.spectral_noise(rng, shape, cell, 1.6, (1.5, 10.0))
    contrast = 0.3 + 0.7 / (1.0 + np.exp(-4.0 * (weak + 0.8)))
    table = np.dstack([shares, contrast])
    return np.round(255 * table).astype(np.uint8), contrast


def _radiance(
    rng: np.random.Generator, heights: Field, bounds: Field, rock: NDArray[np.bool_], contrast: Array
) -> Field:
    """Albedo without the fine detail, times sun and sky."""
    from scipy import ndimage

    tone = noise.spectral_noise(rng, SHAPE, CELL_M, 1.0, (2.1 * CELL_M, 30.0))
    wide = noise.spectral_noise(rng, SHAPE, CELL_M, 1.7, (2.0, 40.0))
    zoom = np.repeat(np.repeat(contrast.astype(np.float32), MATERIAL_STRIDE, 0), MATERIAL_STRIDE, 1)
    zoom = ndimage.uniform_filter(zoom, MATERIAL_STRIDE)
    albedo = 0.20 * np.exp(0.36 * zoom * tone + 0.22 * wide)
    albedo[rock] *= 1.35
    along, across = np.gradient(heights, CELL_M, axis=1), np.gradient(heights, CELL_M, axis=0)
    horizontal, vertical = np.cos(SUN_ELEVATION_RAD), np.sin(SUN_ELEVATION_RAD)
    sun = np.array([horizontal * np.cos(SUN_AZIMUTH_RAD), horizontal * np.sin(SUN_AZIMUTH_RAD), vertical])
    lit = (vertical - sun[0] * along - sun[1] * across) / np.sqrt(1.0 + along**2 + across**2)
    shadow = np.ones(SHAPE, dtype=np.float32)
    cast_shadows(heights, np.ascontiguousarray(bounds[:, :, 0]), sun, shadow)
    return np.asarray(albedo * (0.38 + 0.8 * np.maximum(lit, 0.0) * shadow), dtype=np.float32)


def _mip_levels(field: Field, count: int) -> tuple[Field, NDArray[np.int64]]:
    """A map and its halvings, flat, with (offset, rows, columns) of each."""
    fields = [field]
    for _ in range(count - 1):
        fields.append(noise.halved(fields[-1]))
    offsets = np.cumsum([0] + [f.size for f in fields[:-1]])
    levels = np.array([(o, *f.shape) for o, f in zip(offsets, fields, strict=True)], dtype=np.int64)
    return np.concatenate([f.ravel() for f in fields]), levels


def _tiles(rng: np.random.Generator) -> NDArray[np.uint8]:
    """The three materials' fine detail with nine halvings each."""
    tiles = []
    for tile in (noise.grass_tile(rng), noise.gravel_tile(rng), noise.soil_tile(rng)):
        flat, _ = _mip_levels(tile, 9)
        tiles.append(np.clip(np.round(128 + 36 * flat), 0, 255).astype(np.uint8))
    return np.stack(tiles)
