"""The numbers of a report: root mean square errors, tests against the prediction, doming, correlation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uavkit.core.adjustment import Datum
from uavkit.core.angles import omega_phi_kappa_jacobian
from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.camera import INTERIOR_PARAMETERS, InteriorOrientation
from uavkit.core.points import CheckPoint, ControlPoint
from uavkit.core.result import OrientedBlock, PointDifference


@dataclass(frozen=True, slots=True, kw_only=True)
class LengthUnit:
    """How lengths are written: metres and millimetres, or units of the model where nothing gives a scale."""

    whole: str
    thousandth: str


METRIC = LengthUnit(whole="m", thousandth="mm")
MODEL_UNITS = LengthUnit(whole="model units", thousandth="milli-units")


def length_unit(result: OrientedBlock) -> LengthUnit:
    """Return the unit of a block's lengths: a free network has no scale."""
    return MODEL_UNITS if result.adjustment.datum is Datum.FREE_NETWORK else METRIC


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Root mean square differences of control or check points; NaN where there is no point."""

    points: int
    left_out: int
    """Points without a finite difference."""
    rmse_xy_m: float
    """Both axes together: the root of the mean of dx^2 + dy^2."""
    rmse_z_m: float
    gsd_m: float
    """Mean of the points."""

    @property
    def rmse_xy_gsd(self) -> float:
        """Return the horizontal RMSE in ground sampling distances."""
        return self.rmse_xy_m / self.gsd_m if self.gsd_m > 0 else float("nan")

    @property
    def rmse_z_gsd(self) -> float:
        """Return the vertical RMSE in ground sampling distances."""
        return self.rmse_z_m / self.gsd_m if self.gsd_m > 0 else float("nan")


def differences_m(points: Sequence[PointDifference]) -> Array:
    """Return the differences of points, shape (n, 3)."""
    return np.array([point.difference_m for point in points], dtype=np.float64).reshape(-1, 3)


def sigmas_m(points: Sequence[PointDifference]) -> Array:
    """Return the predicted sigmas of the differences of points, shape (n, 3)."""
    return np.array([point.sigma_m for point in points], dtype=np.float64).reshape(-1, 3)


def accuracy(points: Sequence[PointDifference]) -> Accuracy:
    """Return the root mean square differences of points; points that were not determined are counted, not used."""
    difference = differences_m(points)
    finite = np.all(np.isfinite(difference), axis=1)
    d = difference[finite]
    nan = float("nan")
    if not len(d):
        return Accuracy(points=0, left_out=len(points), rmse_xy_m=nan, rmse_z_m=nan, gsd_m=nan)
    gsd = np.array([point.gsd_m for point in points])[finite]
    return Accuracy(
        points=len(d),
        left_out=len(points) - len(d),
        rmse_xy_m=float(np.sqrt(np.mean(d[:, 0] ** 2 + d[:, 1] ** 2))),
        rmse_z_m=float(np.sqrt(np.mean(d[:, 2] ** 2))),
        gsd_m=float(np.mean(gsd[np.isfinite(gsd)])) if np.any(np.isfinite(gsd)) else nan,
    )


def chi_square_bounds(degrees: float) -> tuple[float, float]:
    """Return the bounds between which chi-square lies with 95 % probability (Wilson and Hilferty 1931)."""
    spread = 2.0 / (9.0 * degrees)
    low, high = (max(1.0 - spread + z * np.sqrt(spread), 0.0) for z in (-1.96, 1.96))
    return float(degrees * low**3), float(degrees * high**3)


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictionTest:
    """Whether differences are as large as predicted: factor is their RMS in predicted sigmas, all axes jointly."""

    coordinates: int
    factor: float
    low: float
    high: float
    """95 % of truthful predictions give a factor between low and high."""


def prediction_test(points: Sequence[PointDifference], covariance_m2: Array) -> PredictionTest:
    """Test check-point differences against their joint covariance (3 c, 3 c): d' C^-1 d is chi-square.

    A covariance of another shape, or a singular one, is replaced by the points' own sigmas.
    """
    difference, sigma = differences_m(points), sigmas_m(points)
    use = np.all(np.isfinite(difference) & np.isfinite(sigma) & (sigma > 0), axis=1)
    d, rows = difference[use].ravel(), np.repeat(use, 3)
    nan = float("nan")
    if not len(d):
        return PredictionTest(coordinates=0, factor=nan, low=nan, high=nan)
    weighted = float(np.sum((d / sigma[use].ravel()) ** 2))
    if covariance_m2.shape == (3 * len(points),) * 2:
        covariance = covariance_m2[np.ix_(rows, rows)]
        if np.all(np.isfinite(covariance)) and np.linalg.eigvalsh(covariance)[0] > 0:
            weighted = float(d @ np.linalg.solve(covariance, d))
    low, high = chi_square_bounds(len(d))
    n = len(d)
    return PredictionTest(
        coordinates=n, factor=float(np.sqrt(weighted / n)), low=float(np.sqrt(low / n)), high=float(np.sqrt(high / n))
    )


def determined_points(result: OrientedBlock) -> Flags:
    """Tell which object points have coordinates, shape (m,)."""
    return np.asarray(np.all(np.isfinite(result.adjustment.points_m), axis=1))


def rays_of_points(result: OrientedBlock) -> Indices:
    """Return the number of used rays of each object point, shape (m,)."""
    used = result.rays.point_index[result.adjustment.ray_used]
    return np.bincount(used, minlength=len(result.adjustment.points_m)).astype(np.int64)


def rays_of_images(result: OrientedBlock) -> Indices:
    """Return the number of used rays of each oriented still, shape (n,)."""
    used = result.rays.image_index[result.adjustment.ray_used]
    return np.bincount(used, minlength=len(result.images)).astype(np.int64)


def point_sigmas_m(result: OrientedBlock) -> tuple[Array, Array]:
    """Return sigma XY (both axes together) and sigma Z of the determined points, each (p,); empty if unknown."""
    covariance = result.adjustment.point_covariances_m2
    if covariance.shape[1:] != (3, 3) or not len(covariance):
        return np.zeros(0), np.zeros(0)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    variance = variance[np.all(np.isfinite(variance) & (variance >= 0), axis=1)]
    return np.sqrt(variance[:, 0] + variance[:, 1]), np.sqrt(variance[:, 2])


def exterior_sigmas(result: OrientedBlock) -> tuple[Array, Array]:
    """Return sigmas of the projection centres in metres and of omega, phi, kappa in radians, each (n, 3)."""
    covariances = result.adjustment.exterior_covariances
    angles = np.full((len(result.images), 3), np.nan)
    centres = np.sqrt(np.maximum(np.diagonal(covariances[:, :3, :3], axis1=1, axis2=2), 0.0))
    for row, (rotation, covariance) in enumerate(zip(result.adjustment.R_object_from_image, covariances, strict=True)):
        jacobian = omega_phi_kappa_jacobian(rotation)
        angles[row] = np.sqrt(np.maximum(np.diag(jacobian @ covariance[3:, 3:] @ jacobian.T), 0.0))
    return np.asarray(centres), angles


@dataclass(frozen=True, slots=True, kw_only=True)
class RadialProfile:
    """Mean of the radial component of the residuals in rings about the principal point, outwards positive."""

    radius_px: Array
    mean_px: Array
    standard_error_px: Array
    rays: Indices


def radial_profile(result: OrientedBlock, rings: int = 12) -> RadialProfile:
    """Return the radial residuals of the used rays by distance from the principal point; rings under 10 rays left out.

    A distortion that the interior orientation does not take up shows as a curve; such a curve goes with doming
    (James and Robson 2014, Earth Surface Processes and Landforms 39).
    """
    interior, used = result.adjustment.interior, result.adjustment.ray_used
    arm = result.rays.xy_px[used] - np.array([interior.x0_px, interior.y0_px])
    radius = np.maximum(np.hypot(*arm.T), 1e-9)
    radial = np.sum(result.adjustment.ray_residuals_px[used] * arm, axis=1) / radius
    good = np.isfinite(radial)
    radius, radial = radius[good], radial[good]
    ring = np.minimum((radius / max(image_radius_px(interior), 1.0) * rings).astype(np.int64), rings - 1)
    count = np.bincount(ring, minlength=rings)
    keep = count >= 10
    safe = np.maximum(count, 1)
    mean = np.bincount(ring, radial, rings) / safe
    spread = np.sqrt(np.bincount(ring, (radial - mean[ring]) ** 2, rings) / np.maximum(count - 1, 1))
    return RadialProfile(
        radius_px=(np.bincount(ring, radius, rings) / safe)[keep],
        mean_px=mean[keep],
        standard_error_px=(spread / np.sqrt(safe))[keep],
        rays=count[keep].astype(np.int64),
    )


def image_radius_px(interior: InteriorOrientation) -> float:
    """Return the distance from the principal point to the farthest corner of the image."""
    width = max(interior.x0_px, interior.width_px - 1 - interior.x0_px)
    height = max(interior.y0_px, interior.height_px - 1 - interior.y0_px)
    return float(np.hypot(width, height))


@dataclass(frozen=True, slots=True, kw_only=True)
class DomingTest:
    """A bow of the block: height differences follow a + b r^2 about its centre."""

    bow_m: float
    """Height of the edge of the block against its centre; NaN with fewer than four points."""
    sigma_m: float
    points: int


def doming_test(distance_m: Array, difference_z_m: Array, sigma_z_m: Array, edge_m: float) -> DomingTest:
    """Fit a bow to height differences (n,) at distances (n,) from the block's centre; edge_m is its radius."""
    use = np.isfinite(distance_m) & np.isfinite(difference_z_m) & np.isfinite(sigma_z_m) & (sigma_z_m > 0)
    d, z, s = distance_m[use], difference_z_m[use], sigma_z_m[use]
    nothing = DomingTest(bow_m=float("nan"), sigma_m=float("nan"), points=len(d))
    if len(d) < 4 or not edge_m > 0 or np.ptp(d) < 0.2 * edge_m:
        return nothing
    design = np.column_stack([np.ones_like(d), (d / edge_m) ** 2]) / s[:, None]
    covariance = np.linalg.pinv(design.T @ design)
    bow = float((covariance @ design.T @ (z / s))[1])
    return DomingTest(bow_m=bow, sigma_m=float(np.sqrt(covariance[1, 1])), points=len(d))


def block_centre_and_radius_m(result: OrientedBlock) -> tuple[Array, float]:
    """Return the horizontal centre (2,) of the block's points and the distance within which 95 % of them lie."""
    points = result.adjustment.points_m[determined_points(result)][:, :2]
    if not len(points):
        points = result.adjustment.projection_centres_m[:, :2]
    centre = np.median(points, axis=0)
    return centre, float(np.percentile(np.hypot(*(points - centre).T), 95.0))


def surveyed_distances_m(result: OrientedBlock, points: Sequence[PointDifference]) -> Array:
    """Return the horizontal distance of control or check points from the block's centre, (n,); NaN if not surveyed."""
    centre, _ = block_centre_and_radius_m(result)
    surveyed = (*result.block.control_points, *result.block.check_points)
    places = {point.name: np.hypot(*(np.array(point.position_m[:2]) - centre)) for point in surveyed}
    return np.array([places.get(point.name, np.nan) for point in points], dtype=np.float64)


def check_point_doming(result: OrientedBlock) -> DomingTest:
    """Test the check points' heights for a bow of the block."""
    _, edge = block_centre_and_radius_m(result)
    z, s = differences_m(result.check)[:, 2], sigmas_m(result.check)[:, 2]
    return doming_test(surveyed_distances_m(result, result.check), z, s, edge)


def predicted_bow_sigma_m(result: OrientedBlock) -> float:
    """Return the predicted sigma of a bow of the heights from the centre of the block to its edge; NaN if not known.

    The bow is d in the plane with a bow, a + b x + c y + d (r / edge)^2, fitted by least squares to the heights of the
    points whose joint covariance the adjustment gave: its sigma follows from that covariance. It says how well the
    observations determine the curvature of the block, whether or not anything checks it.
    """
    adjusted = result.adjustment
    good = np.isfinite(adjusted.points_m[adjusted.joint_points, 0])
    rows = adjusted.joint_points[good]
    if len(rows) < 8:
        return float("nan")
    axes = np.linalg.svd(adjusted.R_object_from_image[:, :, 2].mean(axis=0)[None])[2]
    place = adjusted.points_m[rows] @ axes[1:].T
    place = place - np.median(place, axis=0)
    edge = float(np.percentile(np.linalg.norm(place, axis=1), 95.0))
    design = np.column_stack([np.ones(len(rows)), place / edge, np.sum((place / edge) ** 2, axis=1)])
    bow = np.linalg.pinv(design)[3]
    joint = adjusted.joint_covariance_m2.reshape(len(good), 3, len(good), 3)[good][:, :, good]
    heights = np.einsum("iajb,a,b->ij", joint, axes[0], axes[0])
    return float(np.sqrt(max(bow @ heights @ bow, 0.0)))


def interior_correlation(result: OrientedBlock) -> tuple[tuple[str, ...], Array]:
    """Return the names of the free interior parameters and their correlation matrix."""
    covariance = result.adjustment.interior_covariance
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    free = np.flatnonzero(sigma > 0)
    names = tuple(INTERIOR_PARAMETERS[row] for row in free)
    return names, covariance[np.ix_(free, free)] / np.outer(sigma[free], sigma[free])


def interior_prior_sigmas(result: OrientedBlock) -> Array:
    """Return the a priori sigmas (10,) of the interior orientation for the size of these stills."""
    camera, interior = result.block.camera, result.block.interior
    sigma = camera.interior_sigmas.values()
    sigma[:3] *= interior.height_px / camera.interior.height_px
    return sigma


def view_tilts_deg(result: OrientedBlock) -> Array:
    """Return the angle between viewing direction and the vertical of each oriented still, (n,)."""
    return np.asarray(np.degrees(np.arccos(np.clip(result.adjustment.R_object_from_image[:, 2, 2], -1.0, 1.0))))


def strip_ties(result: OrientedBlock) -> tuple[Indices, Indices]:
    """Return the numbers of the strips (s,) and how many points each two strips share, (s, s); diagonal: own points."""
    used = result.adjustment.ray_used & (result.strips[result.rays.image_index] >= 0)
    strip, point = result.strips[result.rays.image_index[used]], result.rays.point_index[used]
    numbers = np.unique(result.strips[result.strips >= 0])
    seen = np.zeros((len(result.adjustment.points_m), len(numbers)), dtype=np.float32)
    seen[point, np.searchsorted(numbers, strip)] = 1.0
    return numbers, np.rint(seen.T @ seen).astype(np.int64)


def gnss_rows(result: OrientedBlock) -> Indices:
    """Return the row of ``block.gnss`` of each GNSS observation of the adjustment; -1 where the numbers do not agree.

    The adjustment holds the observations of the oriented stills, in their order.
    """
    gnss, count = result.block.gnss, len(result.adjustment.gnss_used)
    if gnss is not None:
        oriented = set(result.images)
        kept = [row for row, i in enumerate(gnss.image_index) if result.block.stills[i].name in oriented]
        if len(kept) == count:
            return np.array(kept, dtype=np.int64)
    return np.full(count, -1, dtype=np.int64)


def gnss_stations(result: OrientedBlock) -> tuple[str, ...]:
    """Return the still of each GNSS observation of the adjustment; numbers where they cannot be told apart."""
    gnss, rows = result.block.gnss, gnss_rows(result)
    if gnss is None or np.any(rows < 0):
        return tuple(f"fix {number + 1}" for number in range(len(rows)))
    return tuple(result.block.stills[gnss.image_index[row]].name for row in rows)


def without_result(surveyed: Sequence[ControlPoint | CheckPoint], found: Sequence[PointDifference]) -> tuple[str, ...]:
    """Return the names of surveyed points that the block has no coordinates of."""
    names = {point.name for point in found}
    return tuple(point.name for point in surveyed if point.name not in names)
