"""Precision within a block whose position, tilt and scale rest on GNSS alone.

The rays do not change when the whole block is shifted, turned and scaled; only the GNSS positions fix these seven. Let
the shape of the block be what remains once its antennas are fitted to the GNSS positions by such a similarity, weighted
as in the adjustment. Then the weights split into a part for the similarity and one for the shape without a mixed term,
so their errors are independent and

    covariance of a point = J N^-1 J' + covariance within the block,    N = sum over antennas of J' P J,

where J is the derivative of a place by shift, rotation and scale, and P holds the sigmas of the positions and of the
common shift of each flight. With control points in the adjustment this does not hold. Where there is one flight, the
shift after the adjustment is as uncertain as before it; the adjustment's own covariance of it is taken, since it went
through the same rounding as the covariances that it is subtracted from.
"""

from dataclasses import dataclass

import numpy as np

from uavkit.core.adjustment import AdjustmentOptions, Datum
from uavkit.core.arrays import Array, Indices
from uavkit.core.observations import GnssObservations
from uavkit.core.result import OrientedBlock
from uavkit.report.measures import gnss_rows

LEAST_FIXES = 3
ROUNDING = 1e-8
"""Of a variance: what is left of it below this share is rounding."""
MOST_LOST = 0.01
"""Share of places whose variance may be lost in rounding before nothing is stated for them."""
SHIFT_AGREEMENT = 1e-3
"""Relative; a shift whose variance the adjustment changed more than this does not follow the theory above."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativePrecision:
    """Sigmas within the block; XY is both axes together. Empty where rounding leaves nothing to tell."""

    point_xy_m: Array
    point_z_m: Array
    centre_xy_m: Array
    centre_z_m: Array


def relative_precision(result: OrientedBlock) -> RelativePrecision | None:
    """Return the precision without common shift, rotation and scale; None where the result does not tell it."""
    adjusted, gnss, rows = result.adjustment, result.block.gnss, gnss_rows(result)
    known = gnss is not None and adjusted.datum is Datum.GNSS and not np.any(adjusted.control_used)
    if gnss is None or not known or np.any(rows < 0) or np.sum(adjusted.gnss_used) < LEAST_FIXES:
        return None
    middle = adjusted.projection_centres_m.mean(axis=0)
    similarity = _similarity_covariance(result, gnss, middle)
    if similarity is None:
        return None
    centres = _without(adjusted.exterior_covariances[:, :3, :3], adjusted.projection_centres_m - middle, similarity)
    points = _without(adjusted.point_covariances_m2, adjusted.points_m - middle, similarity)
    return RelativePrecision(
        point_xy_m=_told(points[:, 0] + points[:, 1]),
        point_z_m=_told(points[:, 2]),
        centre_xy_m=_told(centres[:, 0] + centres[:, 1]),
        centre_z_m=_told(centres[:, 2]),
    )


def _similarity_covariance(result: OrientedBlock, gnss: GnssObservations, middle_m: Array) -> Array | None:
    """Return the covariance (7, 7) of shift, rotation and scale about a place, as the GNSS positions fix them.

    What the positions of a flight have in common, shift and latency of covariance S, is eliminated: with B their
    derivatives and V = sum of J' P B, the normal matrix loses V (S^-1 + sum of B' P B)^-1 V'.
    """
    adjusted = result.adjustment
    used = gnss_rows(result)[adjusted.gnss_used]
    shifts = _shift_covariances(result, gnss)
    if shifts is None:
        return None
    row_of = {name: row for row, name in enumerate(result.images)}
    image = [row_of[result.block.stills[still].name] for still in gnss.image_index[used]]
    rigid = adjusted.R_object_from_image[image] @ np.array(gnss.lever_arm_m)
    derivative = _similarity_derivative(adjusted.projection_centres_m[image] - middle_m, rigid)
    weight, flight = gnss.sigma_m[used] ** -2.0, gnss.flight[used]
    normal = np.einsum("gai,ga,gaj->ij", derivative, weight, derivative)
    for number in np.unique(flight):
        mine = flight == number
        of_flight, information = _common_unknowns(gnss, used[mine], shifts[number])
        common = np.einsum("gai,ga,gac->ic", derivative[mine], weight[mine], of_flight)
        inner = information + np.einsum("gac,ga,gad->cd", of_flight, weight[mine], of_flight)
        normal -= common @ np.linalg.solve(inner, common.T)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(scale, scale)
    if np.linalg.cond(scaled) > 1e10:  # the antennas lie on one line
        return None
    return np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale))


def _common_unknowns(gnss: GnssObservations, rows: Indices, shift_covariance_m2: Array) -> tuple[Array, Array]:
    """Return the derivatives (k, 3, c) of positions of one flight by shift and latency, and what is known (c, c)."""
    by_shift = np.broadcast_to(np.eye(3), (len(rows), 3, 3))
    of_shift = np.asarray(np.linalg.inv(shift_covariance_m2), dtype=np.float64)
    if gnss.latency_sigma_s is None or gnss.velocity_m_s is None:
        return by_shift, of_shift
    information = np.zeros((4, 4))
    information[:3, :3], information[3, 3] = of_shift, gnss.latency_sigma_s**-2.0
    return np.concatenate([by_shift, gnss.velocity_m_s[rows][:, :, None]], axis=2), information


def _shift_covariances(result: OrientedBlock, gnss: GnssObservations) -> Array | None:
    """Return the covariance of the common shift of each flight, (flights, 3, 3)."""
    stated = np.square(gnss.shift_sigma_m or AdjustmentOptions().default_shift_sigma_m)
    found = result.adjustment.gnss_shift_covariance_m2
    if len(found) > 1:
        return np.tile(np.diag(stated), (len(found), 1, 1))
    agrees = len(found) == 1 and np.allclose(np.diag(found[0]), stated, rtol=SHIFT_AGREEMENT, atol=0.0)
    return found if agrees else None


def _similarity_derivative(arm_m: Array, rigid_m: Array | float = 0.0) -> Array:
    """Return the derivative (n, 3, 7) of places by shift, rotation and scale; ``rigid_m`` turns but does not scale."""
    derivative = np.zeros((len(arm_m), 3, 7))
    derivative[:, :, :3] = np.eye(3)
    x, y, z = (arm_m + rigid_m).T
    derivative[:, 0, 4], derivative[:, 0, 5] = z, -y
    derivative[:, 1, 3], derivative[:, 1, 5] = -z, x
    derivative[:, 2, 3], derivative[:, 2, 4] = y, -x
    derivative[:, :, 6] = arm_m
    return derivative


def _without(covariances_m2: Array, arm_m: Array, similarity: Array) -> Array:
    """Return the variances (k, 3) of the determined places without the similarity's; NaN where it is rounding."""
    if covariances_m2.shape[1:] != (3, 3) or len(covariances_m2) != len(arm_m):
        return np.zeros((0, 3))
    whole = np.diagonal(covariances_m2, axis1=1, axis2=2)
    good = np.all(np.isfinite(whole), axis=1)
    whole, derivative = whole[good], _similarity_derivative(arm_m[good])
    inner = whole - np.einsum("nai,ij,naj->na", derivative, similarity, derivative)
    return np.where(inner > ROUNDING * whole, inner, np.nan)


def _told(variance: Array) -> Array:
    finite = variance[np.isfinite(variance)]
    return np.sqrt(finite) if len(finite) > (1.0 - MOST_LOST) * len(variance) else np.zeros(0)
