"""Precision of a bundle block adjustment: redundancy, sigma0 of the groups of observations, covariances."""

import numpy as np

from uavkit.core.adjustment import Datum
from uavkit.core.arrays import Array, Flags
from uavkit.process.bundle_system import BundleSystem, Precision, State, Weights, cost, misclosures


def weighted_square_sum(system: BundleSystem, state: State, weights: Weights, determined: Flags) -> float:
    """Return the weighted sum of squared residuals of all observations that take part."""
    return cost(system, state, weights, determined)


def total_redundancy(system: BundleSystem, weights: Weights, determined: Flags) -> float:
    """Return the number of observations that take part (weights 0 or 1) less that of the unknowns."""
    used = 2.0 * float(np.sum(weights.rays * determined[system.point_of_ray]))
    direct = 3.0 * float(np.sum(weights.gnss) + np.sum(weights.control))
    priors = np.concatenate([system.prior_sigma, system.shift_sigma_m.ravel()])
    unknowns = 6 * len(system.given.projection_centres_m) + system.border + 3 * int(np.sum(determined))
    if system.datum is Datum.FREE_NETWORK:
        unknowns -= 7
    return used + direct + float(np.sum(np.isfinite(priors))) - unknowns


def interior_covariance(system: BundleSystem, precision: Precision) -> Array:
    """Return the covariance (10, 10) of the interior orientation; zero where fixed."""
    covariance, q = np.zeros((10, 10)), len(system.free)
    covariance[np.ix_(system.free, system.free)] = precision.inverse.corner[:q, :q]
    return covariance


def group_sigma0(system: BundleSystem, state: State, weights: Weights, precision: Precision) -> dict[str, float]:
    """Return sqrt(sum of squared residuals / sum of redundancy numbers) of each group with redundancy."""
    found, given, q = misclosures(system, state), system.given, len(system.free)
    sums: dict[str, tuple[float, float]] = {}
    used = weights.rays * precision.determined[system.point_of_ray]
    sums["rays"] = _group(found.rays_px / system.rays.sigma_px, used, precision.ray_leverage)
    if given.gnss is not None and system.uses_gnss:
        square, number = _group(found.gnss_m / given.gnss.sigma_m, weights.gnss, precision.gnss_leverage)
        variance = np.diag(precision.inverse.corner)[q:]
        sigma = system.shift_sigma_m.ravel()
        square += float(np.sum((state.shifts.ravel() / sigma) ** 2))
        number += float(np.sum(np.isfinite(sigma) - variance / sigma**2))
        sums["gnss"] = square, number
    if given.control is not None and system.uses_control:
        z = found.control_m / given.control.sigma_m
        sums["control"] = _group(z, weights.control, precision.control_leverage)
    if q:
        z = (state.interior[system.free] - system.prior) / system.prior_sigma
        variance = np.diag(precision.inverse.corner)[:q]
        number = float(np.sum(np.isfinite(system.prior_sigma) - variance / system.prior_sigma**2))
        sums["interior"] = float(z @ z), number
    return {name: float(np.sqrt(square / number)) for name, (square, number) in sums.items() if number > 1e-3}


def _group(z: Array, weight: Array, leverage: Array) -> tuple[float, float]:
    """Return the sum of squares and of redundancy numbers of observations (k, 2 or 3) of weight 1."""
    used = weight > 0.0
    return float(np.sum(z[used] ** 2)), float(np.sum(1.0 - leverage[used]))
