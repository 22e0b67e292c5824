"""Pictures of known truth: a texture that is a continuous function, evaluated where a picture's pixels lie."""

from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array


@dataclass(frozen=True)
class WaveTexture:
    """A sum of plane waves, band-limited: exact at any position, so that no resampling enters the truth."""

    frequency: Array  # (k, 2), radians a pixel
    phase: Array
    amplitude: Array

    def grey(self, x: Array, y: Array) -> Array:
        """Mean 0, standard deviation 1."""
        total = np.zeros(np.shape(x))
        for (fx, fy), phase, amplitude in zip(self.frequency, self.phase, self.amplitude, strict=True):
            total += amplitude * np.cos(fx * x + fy * y + phase)
        return total


def wave_texture(
    rng: np.random.Generator, waves: int = 120, shortest_px: float = 4.0, longest_px: float = 60.0
) -> WaveTexture:
    """Waves with log-uniform wavelengths, amplitude proportional to the square root of the wavelength."""
    length = np.exp(rng.uniform(np.log(shortest_px), np.log(longest_px), waves))
    angle = rng.uniform(0, 2 * np.pi, waves)
    amplitude = np.sqrt(length)
    amplitude *= np.sqrt(2.0 / np.sum(amplitude**2))
    frequency = (2 * np.pi / length)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return WaveTexture(frequency, rng.uniform(0, 2 * np.pi, waves), amplitude)


def picture(
    texture: WaveTexture,
    shape: tuple[int, int],
    texture_from_picture: Array | None = None,
    *,
    gain: float = 40.0,
    offset: float = 125.0,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """An 8-bit picture (h, w) of the texture through an affine transformation (2, 3)."""
    rows, columns = np.indices(shape, dtype=np.float64)
    A = np.eye(2, 3) if texture_from_picture is None else texture_from_picture
    x = A[0, 0] * columns + A[0, 1] * rows + A[0, 2]
    y = A[1, 0] * columns + A[1, 1] * rows + A[1, 2]
    grey = offset + gain * texture.grey(x, y)
    if rng is not None:
        grey = grey + rng.normal(0, noise, shape)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)
