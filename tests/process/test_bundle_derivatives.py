"""Derivatives of the bundle's kernels against core.collinearity and finite differences."""

import numpy as np
import pytest

from uavkit.core.angles import rotation_from_omega_phi_kappa, rotation_from_vector
from uavkit.core.camera import InteriorOrientation
from uavkit.core.collinearity import collinearity_derivatives, image_coordinates, object_rays
from uavkit.core.orientation import ExteriorOrientation
from uavkit.process.kernels.bundle_geometry import differentiate, direction, project

INTERIOR = InteriorOrientation(
    width_px=4000, height_px=3000, principal_distance_px=2684.0, x0_px=2010.0, y0_px=1480.0,
    k1=-0.05, k2=0.02, k3=-0.004, p1=2e-3, p2=-1e-3, b1=3e-3, b2=-2e-3,
)  # fmt: skip
EXTERIOR = ExteriorOrientation(
    projection_centre_m=np.array([3.0, -2.0, 15.0]), R_object_from_image=rotation_from_omega_phi_kappa(0.2, -0.3, 2.0)
)


def _random_points(number: int) -> np.ndarray:
    return np.random.default_rng(5).uniform([-3.0, -8.0, -1.0], [9.0, 4.0, 3.0], (number, 3))


def _differentiate(point: np.ndarray) -> tuple[np.ndarray, ...]:
    out, by_point, by_rotation, by_interior = np.empty(2), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 10))
    assert differentiate(
        INTERIOR.parameters(), EXTERIOR.projection_centre_m, EXTERIOR.R_object_from_image, point, out, by_point,
        by_rotation, by_interior,
    )  # fmt: skip
    return out, by_point, by_rotation, by_interior


@pytest.mark.parametrize("point", _random_points(8))
def test_kernel_agrees_with_core(point: np.ndarray) -> None:
    out, by_point, by_rotation, by_interior = _differentiate(point)
    core = collinearity_derivatives(point[None], EXTERIOR, INTERIOR)
    np.testing.assert_allclose(out, image_coordinates(point[None], EXTERIOR, INTERIOR)[0], atol=1e-9)
    np.testing.assert_allclose(by_point, core.by_point[0], rtol=1e-11, atol=1e-9)
    np.testing.assert_allclose(-by_point, core.by_centre[0], rtol=1e-11, atol=1e-9)
    np.testing.assert_allclose(by_rotation, core.by_rotation[0], rtol=1e-11, atol=1e-8)
    np.testing.assert_allclose(by_interior, core.by_interior[0], rtol=1e-11, atol=1e-8)


@pytest.mark.parametrize("point", _random_points(4))
def test_derivatives_are_finite_differences(point: np.ndarray) -> None:
    def computed(interior: np.ndarray, vector: np.ndarray, moved: np.ndarray) -> np.ndarray:
        out = np.empty(2)
        rotation = EXTERIOR.R_object_from_image @ rotation_from_vector(vector)
        assert project(interior, EXTERIOR.projection_centre_m, rotation, moved, out)
        return out

    _, by_point, by_rotation, by_interior = _differentiate(point)
    values, zero = INTERIOR.parameters(), np.zeros(3)
    for axis in range(3):
        h = 1e-5 * np.eye(3)[axis]
        slope = (computed(values, zero, point + h) - computed(values, zero, point - h)) / 2e-5
        np.testing.assert_allclose(by_point[:, axis], slope, rtol=1e-6, atol=1e-4)
        slope = (computed(values, h, point) - computed(values, -h, point)) / 2e-5
        np.testing.assert_allclose(by_rotation[:, axis], slope, rtol=1e-6, atol=1e-3)
    for k in range(10):
        h10 = 1e-4 * np.eye(10)[k]
        slope = (computed(values + h10, zero, point) - computed(values - h10, zero, point)) / 2e-4
        np.testing.assert_allclose(by_interior[:, k], slope, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("point", _random_points(4))
def test_direction_inverts_projection(point: np.ndarray) -> None:
    xy = image_coordinates(point[None], EXTERIOR, INTERIOR)
    out = np.empty(3)
    assert direction(INTERIOR.parameters(), EXTERIOR.R_object_from_image, xy[0, 0], xy[0, 1], out)
    np.testing.assert_allclose(out, object_rays(xy, EXTERIOR, INTERIOR)[0], atol=1e-10)


def test_point_behind_the_camera_is_not_seen() -> None:
    behind = EXTERIOR.projection_centre_m + 5.0 * EXTERIOR.R_object_from_image[:, 2]
    out = np.empty(2)
    assert not project(INTERIOR.parameters(), EXTERIOR.projection_centre_m, EXTERIOR.R_object_from_image, behind, out)
