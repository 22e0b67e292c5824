"""Robust estimation: weight functions and scales, each with its source."""

import numpy as np

from uavkit.core.arrays import Array

NORMAL_MAD = 1.482602218505602
"""1 / Phi^-1(0.75): the median of |e| of a normal distribution, times this, is its standard deviation."""


def tukey_weight(z: Array, c: float) -> Array:
    """Return psi(z) / z of Tukey's biweight, (1 - (z / c)^2)^2 within c and 0 beyond (Beaton and Tukey 1974)."""
    share = np.minimum(np.abs(z) / c, 1.0)
    return np.asarray((1.0 - share * share) ** 2)


def tukey_psi(z: Array, c: float) -> Array:
    """Return the influence function of Tukey's biweight, z (1 - (z / c)^2)^2 within c and 0 beyond."""
    return np.asarray(z * tukey_weight(z, c))


def huber_weight(z: Array, k: float = 1.345) -> Array:
    """Return psi(z) / z of Huber's estimator, 1 within k and k / |z| beyond (Huber 1964); 1.345 is 95 % efficient."""
    return np.asarray(k / np.maximum(np.abs(z), k))


def huber_psi(z: Array, k: float = 1.345) -> Array:
    """Return the influence function of Huber's estimator, z within k and k sign(z) beyond."""
    return np.asarray(np.clip(z, -k, k))


def robust_scale(z: Array) -> float:
    """Return the standard deviation of values about zero from their median magnitude (Hampel 1974); 0 of none."""
    finite = z[np.isfinite(z)]
    return NORMAL_MAD * float(np.median(np.abs(finite))) if finite.size else 0.0


def trimmed_scale(z: Array, c: float, passes: int = 4) -> float:
    """Return ``robust_scale`` of the values within c times itself, repeated: gross errors no longer inflate it."""
    scale = robust_scale(z)
    for _ in range(passes):
        scale = robust_scale(z[np.abs(z) <= c * scale])
    return scale


def shrunk_scale(scale: float, redundancy: float, prior_redundancy: float = 10.0) -> float:
    """Return a scale drawn towards 1 (the stated sigma) where a group is too small to tell: pooled variances."""
    return float(np.sqrt((prior_redundancy + redundancy * scale * scale) / (prior_redundancy + redundancy)))


def cut_variance(cut: float) -> float:
    """Return the variance of a standard normal variable of which only |z| <= cut is kept.

    1 - 2 k phi(k) / (2 Phi(k) - 1), k the cut (Johnson, Kotz and Balakrishnan, Continuous univariate distributions,
    sec. 13.10.1); 0.99893 at 4.
    """
    from math import erf, exp, pi, sqrt

    return 1.0 - 2.0 * cut * exp(-0.5 * cut * cut) / sqrt(2.0 * pi) / erf(cut / sqrt(2.0))


def lmeds_scale(residuals: Array, unknowns: int) -> float:
    """Return the scale of least median of squares, 1.4826 (1 + 5 / (n - u)) sqrt(med r^2), Rousseeuw 1987."""
    n = residuals.size
    return NORMAL_MAD * (1.0 + 5.0 / max(n - unknowns, 1)) * float(np.sqrt(np.median(residuals * residuals)))
