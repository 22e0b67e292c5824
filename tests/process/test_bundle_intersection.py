"""Space intersection and resection against simulated truth."""

import numpy as np
import pytest

from uavkit.core.angles import rotation_from_omega_phi_kappa, vector_from_rotation
from uavkit.core.camera import InteriorOrientation
from uavkit.core.collinearity import image_coordinates
from uavkit.core.errors import AdjustmentError
from uavkit.core.observations import Rays
from uavkit.core.orientation import ExteriorOrientation
from uavkit.process.intersection import Orientations, intersect_points, resect_image

INTERIOR = InteriorOrientation(
    width_px=4000, height_px=3000, principal_distance_px=2684.0, x0_px=2005.0, y0_px=1493.0, k1=-0.03, k2=0.01, p1=1e-4
)
SIGMA_PX = 0.5


def _images(rng: np.random.Generator) -> list[ExteriorOrientation]:
    return [
        ExteriorOrientation(
            projection_centre_m=np.array([3.0 * i, rng.normal(0, 1.5), 15.0 + rng.normal(0, 0.5)]),
            R_object_from_image=rotation_from_omega_phi_kappa(*rng.normal(0, 0.1, 2), rng.uniform(-3, 3)),
        )
        for i in range(6)
    ]


def _observe(rng: np.random.Generator, points: np.ndarray, images: list[ExteriorOrientation]) -> Rays:
    exact = np.concatenate([image_coordinates(points, image, INTERIOR) for image in images])
    n, m = len(images), len(points)
    return Rays(
        image_index=np.repeat(np.arange(n), m),
        point_index=np.tile(np.arange(m), n),
        xy_px=exact + rng.normal(0, SIGMA_PX, exact.shape),
        sigma_px=np.full(exact.shape, SIGMA_PX),
    )


def _orientations(images: list[ExteriorOrientation]) -> Orientations:
    return Orientations(
        interior=INTERIOR,
        projection_centres_m=np.array([image.projection_centre_m for image in images]),
        R_object_from_image=np.array([image.R_object_from_image for image in images]),
    )


def test_intersection_error_follows_its_covariance() -> None:
    rng = np.random.default_rng(3)
    images, points = _images(rng), rng.uniform([4, -2, -1], [11, 2, 2], (800, 3))
    found = intersect_points(_observe(rng, points, images), _orientations(images), len(points))
    error = found.points_m - points
    chi = np.einsum("ma,ma->m", error, np.linalg.solve(found.covariances_m2, error[:, :, None])[:, :, 0])
    # Mean of 800 chi-square values with 3 degrees of freedom: 3 +- sqrt(6 / 800) = 0.087; four sigma.
    assert abs(np.mean(chi) - 3.0) < 0.35
    # Redundancy 9 a point.
    assert abs(np.mean(found.sigma0**2) - 1.0) < 4.0 * np.sqrt(2.0 / 9.0 / 800)
    assert np.all(found.ray_used)


def test_intersection_rejects_wrong_rays() -> None:
    rng = np.random.default_rng(4)
    images, points = _images(rng), rng.uniform([4, -2, -1], [11, 2, 2], (300, 3))
    rays = _observe(rng, points, images)
    wrong = np.zeros(len(rays), dtype=bool)
    wrong[:600] = rng.random(600) < 0.5  # in two images of six
    rays.xy_px[wrong] = rng.uniform(0, 1, (np.sum(wrong), 2)) * [3999, 2999]
    found = intersect_points(rays, _orientations(images), len(points), reject_above=4.0)
    assert np.mean(~found.ray_used[wrong]) > 0.99
    assert np.mean(found.ray_used[~wrong]) > 0.99
    z = (found.points_m - points) / np.sqrt(np.einsum("maa->ma", found.covariances_m2))
    assert abs(np.std(z) - 1.0) < 0.1


def test_point_of_one_ray_is_nan() -> None:
    rng = np.random.default_rng(5)
    images = _images(rng)
    rays = _observe(rng, np.array([[7.0, 0.0, 0.0]]), images).where(np.array([0]))
    assert np.all(np.isnan(intersect_points(rays, _orientations(images), 1).points_m))


@pytest.mark.parametrize("with_start", [True, False])
def test_resection_error_follows_its_covariance(with_start: bool) -> None:
    rng, chi = np.random.default_rng(6), []
    for _ in range(60):
        image = _images(rng)[2]
        points = rng.uniform([0, -6, -1], [12, 6, 3], (40, 3))
        xy = image_coordinates(points, image, INTERIOR) + rng.normal(0, SIGMA_PX, (40, 2))
        xy[:8] += rng.uniform(4, 400, (8, 2))
        start = ExteriorOrientation(
            projection_centre_m=image.projection_centre_m + rng.normal(0, 0.5, 3),
            R_object_from_image=image.R_object_from_image @ rotation_from_omega_phi_kappa(*rng.normal(0, 0.03, 3)),
        )
        found = resect_image(points, xy, np.full((40, 2), SIGMA_PX), INTERIOR, start if with_start else None)
        assert not np.any(found.used[:8])
        error = np.concatenate([
            found.exterior.projection_centre_m - image.projection_centre_m,
            vector_from_rotation(image.R_object_from_image.T @ found.exterior.R_object_from_image),
        ])  # fmt: skip
        chi.append(error @ np.linalg.solve(found.covariance, error))
    # 60 chi-square values with 6 degrees of freedom; their mean has sigma sqrt(12 / 60) = 0.45.
    assert abs(np.mean(chi) - 6.0) < 1.8


def test_resection_of_three_points_is_refused() -> None:
    with pytest.raises(AdjustmentError, match="at least 4"):
        resect_image(np.zeros((3, 3)), np.zeros((3, 2)), np.ones((3, 2)), INTERIOR)
