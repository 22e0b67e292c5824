"""The shapes of the simulated sites: heights over a grid, and what stands on it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.simulate import noise
from uavkit.simulate.kernels import CELL_M, Field
from uavkit.simulate.options import Terrain

SHAPE = (2560, 4800)
"""Nodes across and along: 64 m x 120 m."""

FLOWN_M = (21.0, 42.0)
"""Half extents across and along of the part that surveys fly over; relief is stated for it."""

CREST_HEIGHT_M = 11.0
CREST_HALF_WIDTH_M = 3.0
HILLS_RELIEF_M = (6.2, 7.8)
"""Least and greatest difference between the highest and the lowest ground of the hills, without objects."""
FLAT_RELIEF_M = 0.25
"""The same of the flat site, over all of it."""


def make_heights(rng: np.random.Generator, terrain: Terrain, objects: int) -> tuple[Field, NDArray[np.bool_]]:
    """Heights of a site with a number of objects on it, and where these lie; both of shape ``SHAPE``."""
    ground = {Terrain.EMBANKMENT: _embankment, Terrain.HILLS: _hills, Terrain.FLAT: _flat}[terrain](rng)
    surface = _objects(rng, ground, objects)
    return np.maximum(ground, surface), surface > ground


def _embankment(rng: np.random.Generator) -> Field:
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


def _hills(rng: np.random.Generator) -> Field:
    """Rolling ground without a straight line in it: waves of 15 m and more, plus natural roughness."""
    waves = noise.spectral_noise(rng, SHAPE, CELL_M, 3.0, (15.0, 70.0))
    rough = noise.spectral_noise(rng, SHAPE, CELL_M, 2.2, (0.25, 12.0))
    relief_m = rng.uniform(*HILLS_RELIEF_M)
    bare = waves / np.ptp(flown(waves)) * (relief_m - 0.4) + 0.08 * rough
    return np.asarray((bare - flown(bare).min()) * (relief_m / np.ptp(flown(bare))), dtype=np.float32)


def _flat(rng: np.random.Generator) -> Field:
    """A field that only its roughness tells from a plane."""
    rough = noise.spectral_noise(rng, SHAPE, CELL_M, 2.2, (0.25, 18.0))
    return np.asarray(rough * (FLAT_RELIEF_M / np.ptp(rough)), dtype=np.float32)


def flown(field: Field) -> Field:
    """The part of a map of the site that surveys fly over."""
    rows, columns = (round(half / CELL_M) for half in FLOWN_M)
    middle_row, middle_column = SHAPE[0] // 2, SHAPE[1] // 2
    return field[middle_row - rows : middle_row + rows, middle_column - columns : middle_column + columns]


def _objects(rng: np.random.Generator, terrain: Field, count: int) -> Field:
    """Surface of boulders and boxes with steep flanks (one box for six boulders), very low elsewhere."""
    surface = np.full(SHAPE, -1e3, dtype=np.float32)
    boxes = round(14 / 104 * count)
    for _ in range(count - boxes):
        size = rng.uniform(0.2, 0.9) * np.array([1.0, rng.uniform(0.7, 1.0)])
        _place(rng, surface, terrain, size, _boulder(float(rng.uniform(0.5, 0.9) * size[0])))
    for _ in range(boxes):
        half = rng.uniform(0.35, 1.0, 2)
        _place(rng, surface, terrain, half, _box(float(rng.uniform(0.4, 1.1)), half))
    return surface


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
