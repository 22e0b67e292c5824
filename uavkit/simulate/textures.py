"""What the simulated ground looks like: materials, brightness of the whole site, fine detail.

A texture is a map of the whole site on the grid of the heights (it holds all waves longer than 5 to 8 cm) times the
fine detail of up to three materials in periodic tiles of 4.1 m. The crop is periodic on purpose, and its tile agrees
with its map: row by row and plant by plant the same picture comes again.

How hard they are (OpenCV's SIFT, ratio test 0.8, fundamental matrix by RANSAC at 1.5 px; neighbouring stills of a trace
flight over the embankment, scale 0.25, medians of five pairs; true: within 2 px of the truth):

    texture        keypoints   past the ratio test   of these true   true after RANSAC
    mixed               2171                   635             607                 607
    repetitive          6341                   391              60                  53
    low_contrast          54                    16               0                   0
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from uavkit.core.arrays import Array
from uavkit.simulate import noise
from uavkit.simulate.kernels import CELL_M, MATERIAL_CELL_M, TILE_CELL_M, Field, lay_blades
from uavkit.simulate.options import Texture
from uavkit.simulate.terrain import SHAPE

MATERIAL_STRIDE = round(MATERIAL_CELL_M / CELL_M)
MATERIAL_SHAPE = (SHAPE[0] // MATERIAL_STRIDE, SHAPE[1] // MATERIAL_STRIDE)

TILE_M = noise.TILE_CELLS * TILE_CELL_M
ROW_WAVE = np.array([1, 8])
"""Waves of the crop's rows over a tile, along and across: rows 0.508 m apart, 7 degrees off the axis ``along``."""
PLANT_WAVE = np.array([16, -2])
"""The same of the plants within the rows, at right angles to them: 0.254 m apart."""
LEAVES = 14

ROW_PERIOD_M = float(TILE_M / np.hypot(*ROW_WAVE))
PLANT_PERIOD_M = float(TILE_M / np.hypot(*PLANT_WAVE))


class Surface(NamedTuple):
    """How the ground reflects light."""

    albedo: Field
    """(rows, columns) without fine detail."""
    weights: NDArray[np.uint8]
    tiles: NDArray[np.uint8]
    tints: Field
    layers: Array
    """See ``world.Ground`` for these four."""
    sunlight: float
    """Share of the direct light's contrast: 1 in the sun, near 0 under an overcast sky."""


def make_surface(rng: np.random.Generator, texture: Texture, rock: NDArray[np.bool_]) -> Surface:
    """Surface of a texture; ``rock`` marks objects, shape ``SHAPE``."""
    makers: dict[Texture, Callable[[], Surface]] = {
        Texture.MIXED: lambda: _mixed(rng, rock),
        Texture.REPETITIVE: lambda: _crop(rng),
        Texture.LOW_CONTRAST: lambda: _sand(rng),
    }
    return makers[texture]()


OBJECTS = {Texture.MIXED: 104, Texture.REPETITIVE: 0, Texture.LOW_CONTRAST: 0}
"""Boulders and boxes on the site; none stand on a field or on raked sand."""


def _mixed(rng: np.random.Generator, rock: NDArray[np.bool_]) -> Surface:
    """Grass, gravel and soil in the sun."""
    weights, contrast = _materials(rng)
    tone = noise.spectral_noise(rng, SHAPE, CELL_M, 1.0, (2.1 * CELL_M, 30.0))
    wide = noise.spectral_noise(rng, SHAPE, CELL_M, 1.7, (2.0, 40.0))
    zoom = np.repeat(np.repeat(contrast.astype(np.float32), MATERIAL_STRIDE, 0), MATERIAL_STRIDE, 1)
    zoom = ndimage.uniform_filter(zoom, MATERIAL_STRIDE)
    albedo = 0.20 * np.exp(0.36 * zoom * tone + 0.22 * wide)
    albedo[rock] *= 1.35
    tiles = _tiles(noise.grass_tile(rng), noise.gravel_tile(rng), noise.soil_tile(rng))
    tints = np.array([[0.88, 1.12, 0.70], [1.04, 1.00, 0.95], [1.20, 1.00, 0.76]], dtype=np.float32)
    return Surface(albedo, weights, tiles, tints, np.array([[0.75, 0.66]] * 3), 1.0)


def _materials(rng: np.random.Generator) -> tuple[NDArray[np.uint8], Array]:
    """Patches of grass, gravel and soil with soft borders, and patches of weak contrast."""
    cell = CELL_M * MATERIAL_STRIDE
    bands = [noise.spectral_noise(rng, MATERIAL_SHAPE, cell, 1.6, (0.5, 14.0)) for _ in range(3)]
    shares = np.stack([np.exp(6.0 * band) for band in bands], axis=-1)
    shares /= shares.sum(axis=-1, keepdims=True)
    weak = noise.spectral_noise(rng, MATERIAL_SHAPE, cell, 1.6, (1.5, 10.0))
    contrast = 0.3 + 0.7 / (1.0 + np.exp(-4.0 * (weak + 0.8)))
    table = np.dstack([shares, contrast])
    return np.round(255 * table).astype(np.uint8), contrast


def _crop(rng: np.random.Generator) -> Surface:
    """Rows of nearly identical plants on bare soil under an overcast sky; what does not repeat is faint."""
    field = _crop_tile(rng)
    coarse, fine = noise.split_tile(field)
    spread = float(field.std())
    periodic = _sampled(coarse / spread)
    tone = noise.spectral_noise(rng, SHAPE, CELL_M, 1.0, (2.1 * CELL_M, 4.0))
    wide = noise.spectral_noise(rng, SHAPE, CELL_M, 1.7, (2.0, 40.0))
    albedo = 0.20 * np.exp(0.40 * periodic + 0.02 * tone + 0.08 * wide)
    tiles = _tiles(fine / fine.std(), noise.soil_tile(rng), noise.soil_tile(rng))
    tints = np.array([[0.94, 1.08, 0.76], [1.10, 1.00, 0.80], [1.10, 1.00, 0.80]], dtype=np.float32)
    contrast = 0.40 * float(fine.std()) / spread / 0.36
    layers = np.array([[1.0, 0.0], [0.0, 1.2], [0.0, 0.0]])
    return Surface(np.asarray(albedo, dtype=np.float32), _uniform(0.88, 0.12, contrast), tiles, tints, layers, 0.1)


def _crop_tile(rng: np.random.Generator) -> Field:
    """Relative brightness of the crop over one tile: furrows, and the same plant at each place."""
    cells = noise.TILE_CELLS
    steps = (np.arange(cells) + 0.5) / cells
    furrow = np.cos(2 * np.pi * (ROW_WAVE[0] * steps[None, :] + ROW_WAVE[1] * steps[:, None]))
    field = np.asarray(0.25 * furrow - 0.6, dtype=np.float32)
    leaves = np.column_stack(
        [
            np.linspace(0.0, 2 * np.pi, LEAVES, endpoint=False) + rng.normal(0.0, 0.15, LEAVES),
            rng.uniform(16.0, 26.0, LEAVES),
            rng.uniform(4.0, 8.0, LEAVES),
            rng.normal(0.9, 0.5, LEAVES),
        ]
    )
    blades = [_plant(rng, place, leaves) for place in _plant_places()]
    lay_blades(field, np.vstack(blades).astype(np.float32))
    return field


def _plant_places() -> Array:
    """Rows and columns of the plants within a tile, cells: all places where both waves have a whole phase."""
    waves = np.array([ROW_WAVE, PLANT_WAVE], dtype=np.float64)
    n = np.arange(-40, 41)
    phases = np.stack(np.meshgrid(n, n), axis=-1).reshape(-1, 2)
    along, across = np.linalg.solve(waves, phases.T)
    inside = (along > -1e-9) & (along < 1 - 1e-9) & (across > -1e-9) & (across < 1 - 1e-9)
    return np.column_stack([across[inside], along[inside]]) * noise.TILE_CELLS


def _plant(rng: np.random.Generator, place: Array, leaves: Array) -> Array:
    """Blades (see ``lay_blades``) of one plant: leaves around a centre, hardly different from plant to plant."""
    turn, half_length, half_width, brightness = (leaves * rng.normal(1.0, [0.0, 0.02, 0.02, 0.03], leaves.shape)).T
    turn = leaves[:, 0] + rng.normal(0.0, 0.02, len(leaves))
    rows = place[0] + half_length * np.sin(turn) + rng.normal(0.0, 0.4, len(leaves))
    columns = place[1] + half_length * np.cos(turn) + rng.normal(0.0, 0.4, len(leaves))
    return np.column_stack([rows, columns, turn, half_length, half_width, brightness])


def _sand(rng: np.random.Generator) -> Surface:
    """Raked sand, bright and even under an overcast sky: fine wavy grooves, grain, hardly any tone."""
    tone = noise.spectral_noise(rng, SHAPE, CELL_M, 1.0, (2.1 * CELL_M, 10.0))
    wide = noise.spectral_noise(rng, SHAPE, CELL_M, 1.7, (4.0, 40.0))
    albedo = 0.40 * np.exp(0.035 * tone + 0.03 * wide)
    tiles = _tiles(_groove_tile(rng), noise.soil_tile(rng), noise.soil_tile(rng))
    tints = np.array([[1.06, 1.00, 0.88]] * 3, dtype=np.float32)
    layers = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    return Surface(np.asarray(albedo, dtype=np.float32), _uniform(0.5, 0.5, 0.22), tiles, tints, layers, 0.04)


def _groove_tile(rng: np.random.Generator) -> Field:
    """Grooves of a rake, 5.1 cm apart, that wander by a centimetre."""
    cells = noise.TILE_CELLS
    wander = noise.spectral_noise(rng, (cells, cells), TILE_CELL_M, 1.5, (0.3, 2.0))
    steps = (np.arange(cells) + 0.5) / cells
    grooves = np.cos(2 * np.pi * (80 * steps[:, None] + 11 * steps[None, :] + 0.2 * wander))
    return np.asarray(grooves / grooves.std(), dtype=np.float32)


def _uniform(first: float, second: float, contrast: float) -> NDArray[np.uint8]:
    """The same shares of two materials and the same contrast of the fine detail all over the site."""
    shares = np.round(255 * np.array([first, second, 0.0, min(contrast, 1.0)])).astype(np.uint8)
    return np.tile(shares, (*MATERIAL_SHAPE, 1))


def _sampled(tile: Field) -> Field:
    """A periodic tile, free of short waves, at the nodes of the site's map."""
    rows, columns = SHAPE
    u = (np.arange(columns) - 0.5 * (columns - 1)) * CELL_M / TILE_CELL_M - 0.5
    v = (np.arange(rows) - 0.5 * (rows - 1)) * CELL_M / TILE_CELL_M - 0.5
    period = noise.TILE_CELLS
    spectrum = fft.rfft2(tile)
    keep = 128  # waves of 3.2 cm and longer; those of the tile's map end at 5 cm
    waves_v = np.concatenate([np.arange(keep), np.arange(-keep, 0)])
    part = np.concatenate([spectrum[:keep, :keep], spectrum[-keep:, :keep]])
    part[:, 1:] *= 2.0
    across = np.exp(2j * np.pi / period * np.outer(v, waves_v)).astype(np.complex64)
    along = np.exp(2j * np.pi / period * np.outer(np.arange(keep), u)).astype(np.complex64)
    return np.asarray((across @ part.astype(np.complex64) @ along).real / period**2, dtype=np.float32)


def _tiles(*fields: Field) -> NDArray[np.uint8]:
    """The three materials' fine detail with nine halvings each."""
    tiles = []
    for tile in fields:
        flat, _ = noise.mip_levels(tile, 9)
        tiles.append(np.clip(np.round(128 + 36 * flat), 0, 255).astype(np.uint8))
    return np.stack(tiles)
