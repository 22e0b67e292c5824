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
    priors = np.concatenate([np.tile(system.prior_sigma, len(system.interior)), system.gnss_prior_sigma])
    images = system.image_unknowns * len(system.given.projection_centres_m)
    unknowns = images + system.border + 3 * int(np.sum(determined))
    if system.datum is Datum.FREE_NETWORK:
        unknowns -= 7
    return used + direct + float(np.sum(np.isfinite(priors))) - unknowns


def interior_covariances(system: BundleSystem, precision: Precision) -> Array:
    """Return the covariances (g, 10, 10) of the interior orientations; zero where fixed."""
    g, q = len(system.interior), len(system.parameters)
    covariances = np.zeros((g, 10, 10))
    if len(system.free.own):
        own = np.empty((g, q, q))
        own[system.camera] = precision.inverse.blocks[system.pattern.diagonal, 6:, 6:]
    else:
        corner = precision.inverse.corner[: g * q, : g * q].reshape(g, q, g, q)
        own = np.einsum("gkgm->gkm", corner)
    covariances[np.ix_(np.arange(g), system.parameters, system.parameters)] = own
    return covariances


def group_sigma0(system: BundleSystem, state: State, weights: Weights, precision: Precision) -> dict[str, float]:
    """Return sqrt(sum of squared residuals / sum of redundancy numbers) of each group with redundancy."""
    found, given, q = misclosures(system, state), system.given, system.shared
    sums: dict[str, tuple[float, float]] = {}
    used = weights.rays * precision.determined[system.point_of_ray]
    sums["rays"] = _group(found.rays_px / system.rays.sigma_px, used, precision.ray_leverage)
    if given.gnss is not None and system.uses_gnss:
        square, number = _group(found.gnss_m / given.gnss.sigma_m, weights.gnss, precision.gnss_leverage)
        variance = np.diag(precision.inverse.corner)[q:]
        sigma = system.gnss_prior_sigma
        square += float(np.sum((np.concatenate([state.shifts.ravel(), state.latencies]) / sigma) ** 2))
        number += float(np.sum(np.isfinite(sigma) - variance / sigma**2))
        sums["gnss"] = square, number
    if given.control is not None and system.uses_control:
        z = found.control_m / given.control.sigma_m
        sums["control"] = _group(z, weights.control, precision.control_leverage)
    if len(system.parameters):
        z = (state.interior[:, system.parameters] - system.prior) / system.prior_sigma
        covariances = interior_covariances(system, precision)
        variance = covariances[:, system.parameters, system.parameters]
        number = float(np.sum(np.isfinite(system.prior_sigma) - variance / system.prior_sigma**2))
        sums["interior"] = float(np.sum(z**2)), number
    return {name: float(np.sqrt(square / number)) for name, (square, number) in sums.items() if number > 1e-3}


def _group(z: Array, weight: Array, leverage: Array) -> tuple[float, float]:
    """Return the sum of squares and of redundancy numbers of observations (k, 2 or 3) of weight 1."""
    used = weight > 0.0
    return float(np.sum(z[used] ** 2)), float(np.sum(1.0 - leverage[used]))
