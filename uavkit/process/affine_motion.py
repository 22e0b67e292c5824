"""How points move from one picture to the next: affine transformation by LMedS, and its continuation in time."""

from cmath import exp, log
from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Flags
from uavkit.core.errors import AdjustmentError
from uavkit.process.kernels.affine import affine_residuals, least_median_affine, least_squares_affine

TRIPLES = 120
MOST_JUDGES = 250
"""Of many points about so many, evenly chosen, make and judge the triples: their median is as good."""
LEAST_SCALE_PX = 0.15
"""Floor of the residuals' scale: of noise-free points the scale is zero and rounding would decide."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AffineMotion:
    """Affine transformation target_from_source (2, 3), the points that obey it and the scale of their residuals."""

    target_from_source: Array
    inliers: Flags
    """(n,)."""
    scale_px: float
    """Robust standard deviation of one coordinate."""


def apply_affine(target_from_source: Array, points_px: Array) -> Array:
    """Transform points (n, 2) by an affine transformation (2, 3)."""
    return np.asarray(points_px @ target_from_source[:, :2].T + target_from_source[:, 2])


def compose(third_from_second: Array, second_from_first: Array) -> Array:
    """third_from_first (2, 3) of two affine transformations."""
    matrix = third_from_second[:, :2] @ second_from_first[:, :2]
    shift = third_from_second[:, :2] @ second_from_first[:, 2] + third_from_second[:, 2]
    return np.column_stack([matrix, shift])


def fit_affine(source_px: Array, target_px: Array, counted: Flags | None = None) -> Array:
    """Least squares affine transformation target_from_source (2, 3) of points (n, 2), or of those that are counted.

    Raises AdjustmentError where they are fewer than three or lie on a line.
    """
    affine = np.zeros((2, 3))
    rows = np.ones(len(source_px), np.bool_) if counted is None else counted
    if not least_squares_affine(np.ascontiguousarray(source_px), np.ascontiguousarray(target_px), rows, affine):
        raise AdjustmentError("the points of an affine motion lie on a line")
    return affine


def residuals_of(affine: Array, source_px: Array, target_px: Array) -> Array:
    """Larger coordinate, without sign, of the residuals of points (n, 2) against an affine transformation, (n,)."""
    largest = np.empty(len(source_px))
    affine_residuals(np.ascontiguousarray(source_px), np.ascontiguousarray(target_px), affine, largest)
    return largest


def fit_affine_robustly(source_px: Array, target_px: Array, rng: np.random.Generator) -> AffineMotion:
    """LMedS over random triples, scale 1.4826 (1 + 5 / (n - 6)) sqrt(med r^2), |r| <= 2.5 s kept, least squares.

    r are single coordinate residuals and n their number, twice the points (Rousseeuw and Leroy 1987). Raises
    AdjustmentError with fewer than 6 points, or if they all lie on a line.
    """
    count = len(source_px)
    if count < 6:
        raise AdjustmentError(f"an affine motion needs at least 6 points, there are {count}")
    best = np.zeros((2, 3))
    source, target = np.ascontiguousarray(source_px), np.ascontiguousarray(target_px)
    some = slice(None, None, max(1, count // MOST_JUDGES))
    triples = rng.integers(0, len(source[some]), (TRIPLES, 3))
    median = least_median_affine(np.ascontiguousarray(source[some]), np.ascontiguousarray(target[some]), triples, best)
    if not np.isfinite(median):
        raise AdjustmentError("the points of an affine motion lie on a line")
    scale = max(LEAST_SCALE_PX, 1.4826 * (1 + 5 / (2 * count - 6)) * float(np.sqrt(median)))
    inliers = residuals_of(best, source, target) <= 2.5 * scale
    for _ in range(2):
        best = fit_affine(source, target, inliers)
        inliers = residuals_of(best, source, target) <= 2.5 * scale
    return AffineMotion(target_from_source=best, inliers=np.asarray(inliers), scale_px=scale)


def similarity_power(target_from_source: Array, exponent: float) -> Array:
    """The motion continued for exponent times its duration: power of the nearest similarity transformation, (2, 3).

    With points as complex numbers a similarity is z -> a z + b, and its power a^t z + b (a^t - 1) / (a - 1).
    """
    A = target_from_source
    a = complex(A[0, 0] + A[1, 1], A[1, 0] - A[0, 1]) / 2
    b = complex(A[0, 2], A[1, 2])
    if abs(a) < 1e-6:
        return np.eye(2, 3)
    power = exp(exponent * log(a))
    factor = exponent if abs(a - 1) < 1e-7 else (power - 1) / (a - 1)
    shift = b * factor
    return np.array([[power.real, -power.imag, shift.real], [power.imag, power.real, shift.imag]])


def nearest_similarity(target_from_source: Array, points_px: Array) -> Array:
    """The similarity transformation (2, 3) that moves the given points most like an affine one."""
    moved = apply_affine(target_from_source, points_px)
    source, target = points_px - points_px.mean(axis=0), moved - moved.mean(axis=0)
    norm = float((source**2).sum()) or 1.0
    real = float((source * target).sum()) / norm
    imaginary = float((source[:, 0] * target[:, 1] - source[:, 1] * target[:, 0]).sum()) / norm
    matrix = np.array([[real, -imaginary], [imaginary, real]])
    return np.column_stack([matrix, moved.mean(axis=0) - matrix @ points_px.mean(axis=0)])
