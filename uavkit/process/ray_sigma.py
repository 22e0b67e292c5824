"""Variance components: what a block says of the a priori sigmas of its rays, by texture and angle.

Sigmas are the same along the epipolar line and across it. Relief within the matching window does move a match along
the epipolar line, by twice the matching error in stills of 4 mm on the ground; but all rays of a point are matched
against one window, which sees the ground at one mean depth, and so they move together: the implied depths correlate by
0.7 to 0.95 between rays of a point, whatever their directions, and with the truth of orientation given the residuals of
points of three and more rays have the same variance factor along the epipolar line as across it (0.97 and 0.97).
What remains is no error of rays: the point lies where the window sees the ground, not at the ground in its centre.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags, Indices

_LEAST_IN_CLASS = 300
_MOST_FACTOR = 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SigmaCalibration:
    """Factors by which the stated sigmas of classes of rays are multiplied."""

    factor: Array
    """(k,) of each ray."""
    classes: tuple[tuple[str, int, float], ...]
    """Name, number of rays and factor of each class, for the report."""


def calibrate_sigmas(
    residuals_px: Array, sigma_px: Array, redundancy: Array, angle_rad: Array, used: Flags
) -> SigmaCalibration:
    """Estimate variance components of rays by class of texture (stated sigma) and of angle to the reference's ray.

    ``residuals_px``, ``sigma_px``, ``redundancy`` have shape (k, 2); ``angle_rad``, ``used`` (k,). The adjustment must
    be one without control and GNSS, so that only the rays judge one another. The factor of a class is the root of the
    sum of v^2 / sigma^2 over the sum of redundancy numbers (Foerstner 1979); small classes share one factor.
    """
    good = used & np.isfinite(redundancy).all(axis=1)
    names, number = _classes(sigma_px.mean(axis=1), angle_rad, good)
    squares = np.where(good[:, None], (residuals_px / sigma_px) ** 2, 0.0).sum(axis=1)
    freedom = np.where(good[:, None], redundancy, 0.0).sum(axis=1)
    pooled = _factor(squares[good].sum(), freedom[good].sum())
    factors = np.full(len(names), pooled)
    counts = np.bincount(number[good], minlength=len(names))
    for index in range(len(names)):
        rows = good & (number == index)
        if counts[index] >= _LEAST_IN_CLASS:
            factors[index] = _factor(squares[rows].sum(), freedom[rows].sum())
    return SigmaCalibration(
        factor=factors[number],
        classes=tuple((names[i], int(counts[i]), float(factors[i])) for i in range(len(names)) if counts[i]),
    )


def _factor(squares: float, freedom: float) -> float:
    return float(np.clip(np.sqrt(squares / freedom), 1.0 / _MOST_FACTOR, _MOST_FACTOR)) if freedom > 0 else 1.0


def _classes(sigma_px: Array, angle_rad: Array, good: Flags) -> tuple[list[str], "Indices | NDArray[np.intp]"]:
    """Return names and numbers of three classes of texture times three of angle."""
    limits = np.quantile(sigma_px[good], [1 / 3, 2 / 3]) if good.any() else np.array([0.1, 0.2])
    texture = np.searchsorted(limits, sigma_px)
    angle = np.searchsorted(np.radians([12.0, 25.0]), angle_rad)
    names = [f"{t} texture, {a}" for t in ("strong", "middle", "weak") for a in ("< 12 deg", "12-25 deg", "> 25 deg")]
    return names, texture * 3 + angle
