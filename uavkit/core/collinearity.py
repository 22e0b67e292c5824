"""The collinearity equations and their derivatives."""

from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Flags
from uavkit.core.camera import (
    InteriorOrientation,
    distort,
    distortion_jacobian,
    image_directions,
    pixels_from_ideal,
)
from uavkit.core.orientation import ExteriorOrientation, image_space_coordinates

FARTHEST = 2.0
"""Times the distance of the farthest corner from the principal point."""


def image_coordinates(points_m: Array, exterior: ExteriorOrientation, interior: InteriorOrientation) -> Array:
    """Project object points, shape (n, 3), to (column, row) in pixels, shape (n, 2).

    NaN behind the camera, and beyond ``FARTHEST`` times the corner of the image: out there the polynomial of the
    distortion holds no longer, and may fold points back into the image.
    """
    u, v, w = image_space_coordinates(points_m, exterior).T
    corner_px = np.hypot(
        max(interior.x0_px, interior.width_px - 1 - interior.x0_px),
        max(interior.y0_px, interior.height_px - 1 - interior.y0_px),
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        ideal = np.column_stack([-u / w, v / w])
        ideal[(w >= 0) | (np.hypot(*ideal.T) > FARTHEST * corner_px / interior.principal_distance_px)] = np.nan
    return pixels_from_ideal(ideal, interior)


def inside_image(xy_px: Array, interior: InteriorOrientation, margin_px: float = 0.0) -> Flags:
    """Tell which image points (n, 2) lie in the image, at least margin_px from its border; shape (n,)."""
    column, row = xy_px.T
    with np.errstate(invalid="ignore"):
        inside = (column >= margin_px) & (column <= interior.width_px - 1 - margin_px)
        inside &= (row >= margin_px) & (row <= interior.height_px - 1 - margin_px)
    return np.asarray(inside)


def object_rays(xy_px: Array, exterior: ExteriorOrientation, interior: InteriorOrientation) -> Array:
    """Return unit vectors in object space, shape (n, 3), from the projection centre through image points (n, 2)."""
    directions = image_directions(xy_px, interior) @ exterior.R_object_from_image.T
    return np.asarray(directions / np.linalg.norm(directions, axis=1)[:, None])


@dataclass(frozen=True, slots=True, kw_only=True)
class CollinearityDerivatives:
    """Partial derivatives of (column, row) of n image points."""

    by_point: Array
    """(n, 2, 3), by the object point in metres."""
    by_centre: Array
    """(n, 2, 3), by the projection centre in metres."""
    by_rotation: Array
    """(n, 2, 3), by a small rotation vector in image space, R <- R exp(skew(vector)), radians."""
    by_interior: Array
    """(n, 2, 10), by the parameters of the interior orientation."""


def collinearity_derivatives(
    points_m: Array, exterior: ExteriorOrientation, interior: InteriorOrientation
) -> CollinearityDerivatives:
    """Differentiate the image coordinates of object points (n, 3) by all unknowns (Kraus, vol. 1, app. 2.1)."""
    uvw = image_space_coordinates(points_m, exterior)
    u, v, w = uvw.T
    ideal = np.column_stack([-u / w, v / w])
    n = len(points_m)
    ideal_by_uvw = np.zeros((n, 2, 3))
    ideal_by_uvw[:, 0, 0], ideal_by_uvw[:, 0, 2] = -1.0 / w, u / w**2
    ideal_by_uvw[:, 1, 1], ideal_by_uvw[:, 1, 2] = 1.0 / w, -v / w**2
    pixel_by_distorted = interior.principal_distance_px * np.array([[1.0 + interior.b1, interior.b2], [0.0, 1.0]])
    pixel_by_uvw = pixel_by_distorted @ distortion_jacobian(ideal, interior) @ ideal_by_uvw
    by_point = pixel_by_uvw @ exterior.R_object_from_image.T
    # d(uvw) = skew(uvw) vector, since uvw = R^T d and R exp(skew(vector)) turns it by -vector.
    skew_uvw = np.zeros((n, 3, 3))
    skew_uvw[:, 0, 1], skew_uvw[:, 0, 2] = -w, v
    skew_uvw[:, 1, 0], skew_uvw[:, 1, 2] = w, -u
    skew_uvw[:, 2, 0], skew_uvw[:, 2, 1] = -v, u
    return CollinearityDerivatives(
        by_point=by_point,
        by_centre=-by_point,
        by_rotation=pixel_by_uvw @ skew_uvw,
        by_interior=_interior_derivatives(ideal, interior),
    )


def _interior_derivatives(ideal: Array, interior: InteriorOrientation) -> Array:
    """Return d(column, row) / d(INTERIOR_PARAMETERS), shape (n, 2, 10)."""
    x, y = ideal.T
    xd, yd = distort(ideal, interior).T
    r2 = x * x + y * y
    c, b1, b2 = interior.principal_distance_px, interior.b1, interior.b2
    result = np.zeros((len(ideal), 2, 10))
    result[:, 0, 0], result[:, 1, 0] = (1.0 + b1) * xd + b2 * yd, yd
    result[:, 0, 1] = result[:, 1, 2] = 1.0
    terms = [
        (x * r2, y * r2),
        (x * r2**2, y * r2**2),
        (x * r2**3, y * r2**3),
        (2.0 * x * y, r2 + 2.0 * y * y),
        (r2 + 2.0 * x * x, 2.0 * x * y),
    ]
    for column, (dx, dy) in enumerate(terms, start=3):
        result[:, 0, column], result[:, 1, column] = c * ((1.0 + b1) * dx + b2 * dy), c * dy
    result[:, 0, 8], result[:, 0, 9] = c * xd, c * yd
    return result
