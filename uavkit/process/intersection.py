"""Space intersection of points and space resection of images: the approximations from which a bundle starts."""

from dataclasses import dataclass

import numpy as np

from uavkit.core.angles import rotation_from_vector
from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.camera import InteriorOrientation, ideal_from_pixels
from uavkit.core.collinearity import collinearity_derivatives, image_coordinates
from uavkit.core.errors import AdjustmentError
from uavkit.core.observations import Rays
from uavkit.core.orientation import ExteriorOrientation
from uavkit.process.kernels.bundle_intersection import adjust_points, intersect_robustly
from uavkit.process.kernels.bundle_normals import RayTable, Unknowns, residuals
from uavkit.process.robust import trimmed_scale, tukey_weight

IMAGE_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
"""OpenCV's camera axes are x right, y down, z forward; image space has y up and z towards the viewer."""
TUKEY_C = 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Orientations:
    """Orientations of a block's images, taken as known."""

    interior: InteriorOrientation
    projection_centres_m: Array
    """(n, 3)."""
    R_object_from_image: Array
    """(n, 3, 3)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IntersectedPoints:
    """Object points from their rays, the orientations taken as free of error; NaN where rays do not determine one."""

    points_m: Array
    """(m, 3)."""
    covariances_m2: Array
    """(m, 3, 3) for the stated sigmas, unscaled."""
    sigma0: Array
    """(m,) NaN without redundancy."""
    ray_used: Flags
    """(k,)."""
    ray_residuals_px: Array
    """(k, 2) observed minus computed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResectedImage:
    """An exterior orientation from points taken as free of error."""

    exterior: ExteriorOrientation
    covariance: Array
    """(6, 6) of centre (m) and rotation vector in image space (rad), for the stated sigmas, unscaled."""
    sigma0: float
    used: Flags
    """(k,)."""


def _table(rays: Rays, points: int) -> tuple[RayTable, Indices]:
    """Return rays in the order of their points, and that order."""
    order = np.lexsort((rays.image_index, rays.point_index)).astype(np.int64)
    start = np.searchsorted(rays.point_index[order], np.arange(points + 1)).astype(np.int64)
    table = RayTable(
        start,
        rays.image_index[order].astype(np.int64),
        np.ascontiguousarray(rays.xy_px[order], dtype=np.float64),
        np.ascontiguousarray(rays.sigma_px[order], dtype=np.float64),
    )
    return table, order


def intersect_points(
    rays: Rays, orientations: Orientations, points: int, *, reject_above: float = np.inf, scale: float = 1.0
) -> IntersectedPoints:
    """Intersect the rays of points 0 to ``points``: the best pair of rays, then least squares of all within the cut.

    ``reject_above``: rays with |z| above it, z = v / (scale sigma sqrt(r)), are left out, the worst of a point first;
    infinite keeps all. ``scale`` is the size of misclosures in sigmas, above 1 while orientations are approximate. The
    start tries pairs of rays for the one that most others support (after Rousseeuw's least median of squares 1984).
    """
    table, order = _table(rays, points)
    unknowns = Unknowns(
        orientations.interior.parameters()[None],
        np.ascontiguousarray(orientations.projection_centres_m, dtype=np.float64),
        np.ascontiguousarray(orientations.R_object_from_image, dtype=np.float64),
        np.full((points, 3), np.nan),
        np.zeros(len(orientations.projection_centres_m), dtype=np.int64),
    )
    intersect_robustly(
        table, unknowns, np.ones(points, dtype=np.bool_), np.full(points, scale), 0, points, unknowns.points
    )
    point_of_ray = rays.point_index[order]
    used = _support(table, unknowns, point_of_ray, scale * reject_above)
    covariances, leverage, v = np.empty((points, 3, 3)), np.empty((len(order), 2)), np.empty((len(order), 2))
    for _ in range(10):
        adjust_points(table, unknowns, used, 0, points, unknowns.points, covariances, leverage)
        residuals(table, unknowns, 0, points, v)
        worst = _worst_of_each_point(v / table.sigma_px, leverage, used, point_of_ray, scale * reject_above)
        if not np.any(worst):
            break
        used &= ~worst
    used &= np.isfinite(unknowns.points[point_of_ray, 0])
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    return IntersectedPoints(
        points_m=unknowns.points,
        covariances_m2=covariances,
        sigma0=_sigma0(v / table.sigma_px, used, point_of_ray, points),
        ray_used=used[back],
        ray_residuals_px=v[back],
    )


def _support(table: RayTable, unknowns: Unknowns, point_of_ray: Indices, cut: float) -> Flags:
    """Return which rays lie within twice the cut of the robust start: its points are not yet adjusted."""
    v = np.empty((len(point_of_ray), 2))
    residuals(table, unknowns, 0, len(unknowns.points), v)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.max(np.abs(v / table.sigma_px), axis=1) <= 2.0 * cut)


def _worst_of_each_point(z: Array, leverage: Array, used: Flags, point_of_ray: Indices, cut: float) -> Flags:
    """Return the used rays, one of a point at most, with the largest |z| / sqrt(r) above the cut."""
    normalised = np.max(np.abs(z) / np.sqrt(np.maximum(1.0 - leverage, 1e-3)), axis=1)
    magnitude = np.where(used, np.nan_to_num(normalised, nan=0.0), 0.0)
    largest = np.zeros(int(np.max(point_of_ray, initial=0)) + 1)
    np.maximum.at(largest, point_of_ray, magnitude)
    return np.asarray((magnitude > cut) & (magnitude == largest[point_of_ray]))


def _sigma0(z: Array, used: Flags, point_of_ray: Indices, points: int) -> Array:
    """Return sqrt(sum z^2 / redundancy) of each point, (m,); NaN without redundancy."""
    square_sum = np.bincount(point_of_ray[used], np.sum(z[used] ** 2, axis=1), minlength=points)
    redundancy = 2.0 * np.bincount(point_of_ray[used], minlength=points) - 3.0
    return np.asarray(np.sqrt(np.where(redundancy > 0, square_sum, np.nan) / np.maximum(redundancy, 1.0)))


def resect_image(
    points_m: Array,
    xy_px: Array,
    sigma_px: Array,
    interior: InteriorOrientation,
    start: ExteriorOrientation | None = None,
    reject_above: float = 4.0,
) -> ResectedImage:
    """Orient an image by at least four points, (k, 3), and their image points, (k, 2), of sigma (k, 2), robustly.

    Without a start it comes from minimal sets of points (RANSAC, Fischler and Bolles 1981, with OpenCV's solution);
    then Gauss-Newton with Tukey's weights whose scale sinks, a cut at ``reject_above``, and full weights.
    Raises AdjustmentError where the points do not determine the orientation.
    """
    sigma = np.broadcast_to(sigma_px, xy_px.shape)
    if len(points_m) < 4:
        raise AdjustmentError(f"an image needs at least 4 points for its resection, has {len(points_m)}")
    exterior = start or _resection_start(points_m, xy_px, interior)
    scale = np.inf
    for _ in range(40):
        z, _ = _whitened(points_m, xy_px, sigma, exterior, interior)
        last, scale = scale, max(1.0, trimmed_scale(z, 5.0), scale / 2.0 if np.isfinite(scale) else 0.0)
        weight = tukey_weight(np.max(np.abs(z), axis=1) / scale, TUKEY_C)
        exterior, size = _resection_step(points_m, xy_px, sigma, (exterior, interior), np.nan_to_num(weight))
        if scale == last and size < 1e-3:
            break
    used = np.zeros(len(points_m), dtype=np.bool_)
    for _ in range(10):
        z, _ = _whitened(points_m, xy_px, sigma, exterior, interior)
        inside = np.max(np.abs(z), axis=1) <= reject_above
        if np.array_equal(inside, used):
            break
        used = np.asarray(inside)
        for _ in range(5):
            exterior, _ = _resection_step(points_m, xy_px, sigma, (exterior, interior), used.astype(np.float64))
    return _resected(points_m, xy_px, sigma, (exterior, interior), used)


def _resected(
    points_m: Array, xy_px: Array, sigma: Array, camera: tuple[ExteriorOrientation, InteriorOrientation], used: Flags
) -> ResectedImage:
    """Return the resection of the used points with its precision."""
    if np.count_nonzero(used) < 4:
        raise AdjustmentError(f"only {np.count_nonzero(used)} of {len(used)} points agree on the image's orientation")
    z, design = _whitened(points_m[used], xy_px[used], sigma[used], *camera)
    rows = design.reshape(-1, 6)
    redundancy = len(rows) - 6
    return ResectedImage(
        exterior=camera[0],
        covariance=np.asarray(np.linalg.inv(rows.T @ rows), dtype=np.float64),
        sigma0=float(np.sqrt(np.sum(z**2) / redundancy)),
        used=used,
    )


def _resection_start(points_m: Array, xy_px: Array, interior: InteriorOrientation) -> ExteriorOrientation:
    """Return an orientation from random minimal sets, each judged by how many points it brings within 8 px."""
    import cv2

    ideal = ideal_from_pixels(xy_px, interior)
    middle = np.mean(points_m, axis=0)
    found, vector, shift, _ = cv2.solvePnPRansac(
        points_m - middle,
        ideal,
        np.eye(3),
        None,
        iterationsCount=1000,
        reprojectionError=8.0 / interior.principal_distance_px,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found:
        raise AdjustmentError("no four points agree on the orientation of the image")
    opencv_from_object = cv2.Rodrigues(vector)[0]
    return ExteriorOrientation(
        projection_centre_m=middle - opencv_from_object.T @ shift.ravel(),
        R_object_from_image=opencv_from_object.T @ IMAGE_FROM_OPENCV,
    )


def _whitened(
    points_m: Array, xy_px: Array, sigma: Array, exterior: ExteriorOrientation, interior: InteriorOrientation
) -> tuple[Array, Array]:
    """Return misclosures (k, 2) and derivatives by the orientation (k, 2, 6), both over sigma."""
    z = (xy_px - image_coordinates(points_m, exterior, interior)) / sigma
    by = collinearity_derivatives(points_m, exterior, interior)
    design = np.concatenate([by.by_centre, by.by_rotation], axis=2) / sigma[:, :, None]
    return z, design


def _resection_step(
    points_m: Array, xy_px: Array, sigma: Array, camera: tuple[ExteriorOrientation, InteriorOrientation], weight: Array
) -> tuple[ExteriorOrientation, float]:
    """Return the orientation after a weighted Gauss-Newton step, and the step's size in sigmas."""
    exterior, interior = camera
    z, design = _whitened(points_m, xy_px, sigma, exterior, interior)
    use = (weight > 0) & np.isfinite(z[:, 0])
    rows, root = design[use].reshape(-1, 6), np.repeat(np.sqrt(weight[use]), 2)
    normal = (rows * root[:, None] ** 2).T @ rows
    right = (rows * root[:, None] ** 2).T @ z[use].ravel()
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * scale * scale[:, None]
    if np.count_nonzero(use) < 3 or np.linalg.cond(scaled) > 1e13:
        raise AdjustmentError(f"{np.count_nonzero(use)} points do not determine the orientation of the image")
    step = scale * np.linalg.solve(scaled, scale * right)
    moved = ExteriorOrientation(
        projection_centre_m=exterior.projection_centre_m + step[:3],
        R_object_from_image=exterior.R_object_from_image @ rotation_from_vector(step[3:]),
    )
    return moved, float(np.sqrt(max(step @ right, 0.0)))
