"""A small interlaced video of known truth: textured ground, plane or with relief, under a moving camera."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from uavkit.core.arrays import Array, Image

SHAPE = (480, 640)
FIELD_S = 1 / 59.94
MARGIN = 400
OVER = 2  # texture pixels a video pixel


@dataclass(frozen=True)
class Scene:
    """Ground coordinates are pixels of the first picture; parallax (relative) multiplies the camera's own path."""

    grey: np.ndarray
    parallax: np.ndarray

    def parallax_at(self, q: Array) -> Array:
        x, y = ((q + MARGIN).astype(np.float32)).T
        return cv2.remap(self.parallax, x.reshape(-1, 1), y.reshape(-1, 1), cv2.INTER_LINEAR).reshape(-1).astype(float)


Pose = Callable[[float], tuple[Array, Array]]
"""time -> (similarity picture_from_ground (2, 3), parallax vector (2,))."""


def make_scene(rng: np.random.Generator, relief: float = 0.0) -> Scene:
    """Texture of several scales; relief is the largest parallax ratio (0.5: the top moves half as fast again)."""
    size = ((SHAPE[0] + 2 * MARGIN) * OVER, (SHAPE[1] + 2 * MARGIN) * OVER)
    grey = np.zeros(size, np.float32)
    for sigma, weight in ((1.5, 0.8), (3.5, 1.0), (9.0, 1.0), (25.0, 0.7)):
        layer = cv2.GaussianBlur(rng.normal(0, 1, size).astype(np.float32), (0, 0), sigma * OVER / 2)
        grey += weight * layer / layer.std()
    grey = 120 + 38 * grey / grey.std()
    y, x = np.indices((SHAPE[0] + 2 * MARGIN, SHAPE[1] + 2 * MARGIN), dtype=np.float32)
    # an embankment: a ramp from low to high over 150 px, oblique
    along = (x - MARGIN - 320) * 0.6 + (y - MARGIN - 240) * 0.8
    ramp = 1 / (1 + np.exp(-along / 35.0))
    return Scene(grey, (relief * ramp).astype(np.float32))


def positions(scene: Scene, ground_px: Array, pose: tuple[Array, Array]) -> Array:
    """Where ground points (n, 2) lie in the picture of a pose."""
    A, b = pose
    q = ground_px + scene.parallax_at(ground_px)[:, None] * b
    return q @ A[:, :2].T + A[:, 2]


def render(scene: Scene, pose: tuple[Array, Array]) -> np.ndarray:
    """Float picture of a pose."""
    A, b = pose
    inverse = np.linalg.inv(A[:, :2])
    y, x = np.indices(SHAPE, dtype=np.float64)
    p = np.stack([x - A[0, 2], y - A[1, 2]], -1) @ inverse.T
    q = p.copy()
    if scene.parallax.any():
        for _ in range(8):
            qx, qy = (q + MARGIN).astype(np.float32).transpose(2, 0, 1)
            k = cv2.remap(scene.parallax, qx, qy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            q = p - k[..., None] * b
    gx, gy = ((q + MARGIN) * OVER).astype(np.float32).transpose(2, 0, 1)
    return cv2.remap(scene.grey, gx, gy, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def straight(
    shift_px: tuple[float, float], seconds: float, *, turn_deg: float = 0.0, scale: float = 1.0, sway_px: float = 3.0
) -> Pose:
    """Move by shift_px in all, turn about the middle, with a sway of 0.7 Hz."""

    def pose(t: float) -> tuple[Array, Array]:
        s = t / seconds
        a = np.radians(turn_deg) * (s * s * (3 - 2 * s))
        k = scale**s
        M = k * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        middle = np.array([320.0, 240.0])
        path = np.array(shift_px) * s + sway_px * np.array([np.sin(4.4 * t), np.cos(3.7 * t) - 1])
        return np.column_stack([M, middle - M @ middle + M @ path]), path

    return pose


def fields(
    scene: Scene,
    pose: Pose,
    count: int,
    rng: np.random.Generator,
    *,
    noise: float = 2.5,
    jpeg: int = 70,
    gain: Callable[[int], float] = lambda i: 1.0,
    every: int = 1,
) -> Iterator[tuple[int, Image, float]]:
    """(parity, lines (240, 640), time) of count fields, top field first; every: only each so many-th is rendered."""
    for i in range(count):
        if i % every and i != count - 1:
            continue
        t = i * FIELD_S
        frame = gain(i) * render(scene, pose(t))[i % 2 :: 2]
        lines = np.clip(np.round(frame + rng.normal(0, noise, frame.shape)), 0, 255).astype(np.uint8)
        yield i % 2, cv2.imdecode(cv2.imencode(".jpg", lines, [cv2.IMWRITE_JPEG_QUALITY, jpeg])[1], 0), t
