"""A priori sigmas of a block's measured rays, from the residuals of its free network."""

from dataclasses import replace

import numpy as np

from uavkit.core.arrays import Array
from uavkit.process.network import AdjustedNetwork, Network
from uavkit.process.ray_sigma import SigmaCalibration, calibrate_sigmas


def calibrated(network: Network, adjusted: AdjustedNetwork) -> tuple[Network, SigmaCalibration]:
    """Return the network with the sigmas of its measured rays calibrated by variance components.

    ``adjusted`` is the network adjusted without GNSS and control. Marks keep the sigmas that their maker stated.
    """
    result, rows = adjusted.result, adjusted.ray_rows
    measured = network.point[rows] < network.marks_from
    calibration = calibrate_sigmas(
        result.ray_residuals_px[measured],
        adjusted.rays.sigma_px[measured],
        result.ray_redundancy[measured],
        angles_to_mean(network)[rows][measured],
        result.ray_used[measured],
    )
    sigma = network.sigma_px.copy()
    pooled = float(np.median(calibration.factor)) if len(calibration.factor) else 1.0
    sigma[network.point < network.marks_from] *= pooled
    sigma[rows[measured]] = adjusted.rays.sigma_px[measured] * calibration.factor[:, None]
    return replace(network, sigma_px=sigma), calibration


def angles_to_mean(network: Network) -> Array:
    """Return the angle (k,) of each ray to the mean direction of its point's rays, radians; 0 where not known."""
    to_camera = network.centres[network.image] - network.points[network.point]
    to_camera /= np.linalg.norm(to_camera, axis=1)[:, None]
    known = np.isfinite(to_camera[:, 0])
    mean = np.zeros((len(network.points), 3))
    np.add.at(mean, network.point[known], to_camera[known])
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    cosine = np.sum(np.nan_to_num(to_camera) * mean[network.point], axis=1)
    return np.asarray(np.where(known, np.arccos(np.clip(cosine, -1.0, 1.0)), 0.0))
