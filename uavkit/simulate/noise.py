"""Random fields with natural statistics, and the fine periodic textures of the ground.

Natural pictures have an amplitude spectrum of about 1 / f. The fields here are white noise shaped in the frequency
domain, and so are periodic; ``cell_m`` is the distance of neighbouring values.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from uavkit.simulate.kernels import Field, add_stones, lay_blades

TILE_CELLS = 2048
TILE_CELL_M = 0.002
TILE_LONGEST_M = 0.08
"""Longer waves belong to the map of the whole site, which does not repeat."""


def spectral_noise(
    rng: np.random.Generator, shape: tuple[int, int], cell_m: float, exponent: float, band_m: tuple[float, float]
) -> Field:
    """Noise whose amplitude falls with frequency to the power ``-exponent``, of mean 0 and standard deviation 1.

    ``band_m`` holds the shortest and the longest wavelength in metres.
    """
    white = rng.standard_normal(shape, dtype=np.float32)
    spectrum = fft.rfft2(white, overwrite_x=True)
    spectrum *= _filter(shape, cell_m, exponent, band_m)
    field = fft.irfft2(spectrum, s=shape, overwrite_x=True)
    field /= field.std()
    return np.asarray(field, dtype=np.float32)


def _filter(shape: tuple[int, int], cell_m: float, exponent: float, band_m: tuple[float, float]) -> Field:
    """Amplitude response over the half plane of frequencies; its flanks are soft, so that nothing rings."""
    rows = fft.fftfreq(shape[0], cell_m).astype(np.float32)[:, None]
    columns = fft.rfftfreq(shape[1], cell_m).astype(np.float32)[None, :]
    frequency = np.sqrt(rows**2 + columns**2)
    frequency[0, 0] = 1.0
    shortest_m, longest_m = band_m
    response = frequency**-exponent
    response /= 1.0 + np.minimum(frequency * shortest_m, np.float32(200.0)) ** 16  # no overflow in float32
    response *= 1.0 - np.exp(-((frequency * longest_m) ** 4))
    response[0, 0] = 0.0
    return np.asarray(response, dtype=np.float32)


def soil_tile(rng: np.random.Generator) -> Field:
    """Bare soil: 1 / f noise down to the cell."""
    return spectral_noise(rng, (TILE_CELLS, TILE_CELLS), TILE_CELL_M, 1.0, (2.2 * TILE_CELL_M, TILE_LONGEST_M))


def gravel_tile(rng: np.random.Generator) -> Field:
    """Gravel: stones of 3 cm and of 1.2 cm, each of its own brightness, with dark gaps, and grain upon them."""
    field = np.zeros((TILE_CELLS, TILE_CELLS), dtype=np.float32)
    for stones, weight in ((128, 1.0), (340, 0.7)):
        offsets = rng.random((stones, stones, 2), dtype=np.float32)
        brightness = rng.normal(0.0, 0.5, (stones, stones)).astype(np.float32)
        add_stones(field, offsets, brightness, np.float32(weight))
    return _finish(field + 0.35 * soil_tile(rng))


def grass_tile(rng: np.random.Generator) -> Field:
    """Short grass: blades of 2 to 7 cm and 3 to 6 mm, laid over one another, darker between them."""
    field = np.full((TILE_CELLS, TILE_CELLS), -1.2, dtype=np.float32)
    blades = 90_000
    columns = [
        rng.random(blades) * TILE_CELLS,
        rng.random(blades) * TILE_CELLS,
        rng.random(blades) * np.pi,
        rng.uniform(5.0, 17.0, blades),
        rng.uniform(0.7, 1.6, blades),
        rng.normal(0.0, 0.8, blades),
    ]
    lay_blades(field, np.column_stack(columns).astype(np.float32))
    return _finish(field + 0.3 * soil_tile(rng))


def split_tile(field: Field) -> tuple[Field, Field]:
    """A periodic tile's waves that belong to the map of the site, without their mean, and its fine detail."""
    spectrum = fft.rfft2(field - field.mean())
    spectrum *= _filter(field.shape, TILE_CELL_M, 0.0, (2.0 * TILE_CELL_M, TILE_LONGEST_M))
    fine = np.asarray(fft.irfft2(spectrum, s=field.shape), dtype=np.float32)
    return np.asarray(field - field.mean() - fine, dtype=np.float32), fine


def _finish(field: Field) -> Field:
    """Take away the waves that the map of the site holds; mean 0, standard deviation 1."""
    spectrum = fft.rfft2(field)
    spectrum *= _filter(field.shape, TILE_CELL_M, 0.0, (2.0 * TILE_CELL_M, TILE_LONGEST_M))
    result = fft.irfft2(spectrum, s=field.shape)
    return np.asarray(result / result.std(), dtype=np.float32)


def halved(field: Field) -> Field:
    """Means of 2 x 2 cells; a last odd row or column is dropped."""
    rows, columns = field.shape[0] // 2 * 2, field.shape[1] // 2 * 2
    f = field[:rows, :columns]
    return (f[0::2, 0::2] + f[1::2, 0::2] + f[0::2, 1::2] + f[1::2, 1::2]) * np.float32(0.25)


def mip_levels(field: Field, count: int) -> tuple[Field, NDArray[np.int64]]:
    """A map and its halvings, flat, with (offset, rows, columns) of each."""
    fields = [field]
    for _ in range(count - 1):
        fields.append(halved(fields[-1]))
    offsets = np.cumsum([0] + [f.size for f in fields[:-1]])
    levels = np.array([(o, *f.shape) for o, f in zip(offsets, fields, strict=True)], dtype=np.int64)
    return np.concatenate([f.ravel() for f in fields]), levels
