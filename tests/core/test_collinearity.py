"""Collinearity: hand-worked values that fail for a wrong sign or axis, and every derivative against differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavkit.core.angles import rotation_from_vector
from uavkit.core.arrays import Array
from uavkit.core.camera import InteriorOrientation, pixels_from_ideal
from uavkit.core.collinearity import collinearity_derivatives, image_coordinates, inside_image, object_rays
from uavkit.core.orientation import ExteriorOrientation, image_space_coordinates

PLAIN = InteriorOrientation(width_px=4000, height_px=3000, principal_distance_px=2000.0, x0_px=1999.5, y0_px=1499.5)
CAMERA = InteriorOrientation(
    width_px=4000, height_px=3000, principal_distance_px=2684.0, x0_px=2010.5, y0_px=1490.25,
    k1=-0.06, k2=0.05, k3=-0.01, p1=4e-4, p2=-3e-4, b1=2e-3, b2=-1e-3,
)  # fmt: skip
TILTED = ExteriorOrientation.from_omega_phi_kappa(np.array([3.0, -2.0, 15.0]), 0.1, -0.2, 2.5)


def at_100_m(omega: float = 0.0, phi: float = 0.0, kappa: float = 0.0) -> ExteriorOrientation:
    return ExteriorOrientation.from_omega_phi_kappa(np.array([0.0, 0.0, 100.0]), omega, phi, kappa)


@pytest.mark.parametrize(
    ("point_m", "expected_px"),
    [
        ((0.0, 0.0, 0.0), (1999.5, 1499.5)),
        ((10.0, 0.0, 0.0), (2199.5, 1499.5)),  # east: right
        ((0.0, 10.0, 0.0), (1999.5, 1299.5)),  # north: up, a smaller row
        ((10.0, 10.0, 50.0), (2399.5, 1099.5)),  # higher: farther from the middle
    ],
)
def test_a_nadir_image_at_100_m_shows_east_right_and_north_up(
    point_m: tuple[float, float, float], expected_px: tuple[float, float]
) -> None:
    assert image_coordinates(np.array([point_m]), at_100_m(), PLAIN)[0] == pytest.approx(expected_px)


def test_kappa_turns_the_camera_counter_clockwise() -> None:
    # Turned by +90 degrees its right side points north, so north appears right and east appears down.
    seen = image_coordinates(np.array([[0.0, 10.0, 0.0], [10.0, 0.0, 0.0]]), at_100_m(kappa=np.pi / 2), PLAIN)
    assert seen == pytest.approx(np.array([[2199.5, 1499.5], [1999.5, 1699.5]]))


def test_phi_and_omega_tilt_the_view() -> None:
    # phi > 0 turns the view (-z) to the west; omega > 0 turns it to the north.
    west = np.array([[-100.0 * np.tan(0.2), 0.0, 0.0]])
    north = np.array([[0.0, 100.0 * np.tan(0.2), 0.0]])
    assert image_coordinates(west, at_100_m(phi=0.2), PLAIN)[0] == pytest.approx([1999.5, 1499.5])
    assert image_coordinates(north, at_100_m(omega=0.2), PLAIN)[0] == pytest.approx([1999.5, 1499.5])


def test_points_behind_the_camera_are_not_a_number() -> None:
    seen = image_coordinates(np.array([[0.0, 0.0, 200.0], [1.0, 1.0, 100.0], [0.0, 0.0, 99.0]]), at_100_m(), CAMERA)
    assert np.isnan(seen[:2]).all()
    assert np.isfinite(seen[2]).all()


def test_inside_image_counts_pixel_centres_and_leaves_out_what_is_behind() -> None:
    xy = np.array([[0.0, 0.0], [3999.0, 2999.0], [3999.5, 5.0], [5.0, -0.1], [np.nan, np.nan]])
    assert list(inside_image(xy, PLAIN)) == [True, True, False, False, False]
    assert list(inside_image(np.array([[9.0, 9.0], [10.0, 2989.0]]), PLAIN, 10.0)) == [False, True]


@given(st.floats(0.0, 3999.0), st.floats(0.0, 2999.0), st.floats(1.0, 200.0))
def test_a_ray_meets_its_own_image_point(column: float, row: float, distance_m: float) -> None:
    xy = np.array([[column, row]])
    point = TILTED.projection_centre_m + distance_m * object_rays(xy, TILTED, CAMERA)
    assert image_coordinates(point, TILTED, CAMERA) == pytest.approx(xy, abs=1e-7)
    assert np.linalg.norm(point - TILTED.projection_centre_m) == pytest.approx(distance_m)


def _points() -> Array:
    xy = np.random.default_rng(2).uniform([0, 0], [3999, 2999], (25, 2))
    distances = np.random.default_rng(3).uniform(8, 20, (25, 1))
    return np.asarray(TILTED.projection_centre_m + distances * object_rays(xy, TILTED, CAMERA))


def test_derivatives_by_point_and_centre_against_differences() -> None:
    points, step = _points(), 1e-5
    derivatives = collinearity_derivatives(points, TILTED, CAMERA)
    for axis, unit in enumerate(step * np.eye(3)):
        ends = [image_coordinates(points + sign * unit, TILTED, CAMERA) for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2.0 * step)
        assert derivatives.by_point[:, :, axis] == pytest.approx(numeric, rel=1e-6, abs=1e-5)
        moved = [_moved(sign * unit, np.zeros(3)) for sign in (1, -1)]
        ends = [image_coordinates(points, exterior, CAMERA) for exterior in moved]
        numeric = (ends[0] - ends[1]) / (2.0 * step)
        assert derivatives.by_centre[:, :, axis] == pytest.approx(numeric, rel=1e-6, abs=1e-5)


def _moved(shift_m: Array, turn: Array) -> ExteriorOrientation:
    return ExteriorOrientation(
        projection_centre_m=TILTED.projection_centre_m + shift_m,
        R_object_from_image=TILTED.R_object_from_image @ rotation_from_vector(turn),
    )


def test_derivatives_by_rotation_against_differences() -> None:
    points, step = _points(), 1e-6
    derivatives = collinearity_derivatives(points, TILTED, CAMERA)
    for axis, unit in enumerate(step * np.eye(3)):
        turned = [_moved(np.zeros(3), sign * unit) for sign in (1, -1)]
        ends = [image_coordinates(points, exterior, CAMERA) for exterior in turned]
        numeric = (ends[0] - ends[1]) / (2.0 * step)
        assert derivatives.by_rotation[:, :, axis] == pytest.approx(numeric, rel=1e-6, abs=1e-3)


def test_derivatives_by_interior_orientation_against_differences() -> None:
    points = _points()
    derivatives = collinearity_derivatives(points, TILTED, CAMERA)
    values = CAMERA.parameters()
    for column, step in enumerate([1e-2] * 3 + [1e-5] * 7):
        offset = step * np.eye(10)[column]
        ends = [image_coordinates(points, TILTED, CAMERA.with_parameters(values + sign * offset)) for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2.0 * step)
        assert derivatives.by_interior[:, :, column] == pytest.approx(numeric, rel=1e-7, abs=1e-6)


def test_image_space_looks_along_minus_z() -> None:
    assert image_space_coordinates(np.array([[1.0, 2.0, 0.0]]), at_100_m())[0] == pytest.approx([1.0, 2.0, -100.0])


def test_an_orientation_refuses_what_is_no_rotation() -> None:
    with pytest.raises(ValueError, match="orthonormal"):
        ExteriorOrientation(projection_centre_m=np.zeros(3), R_object_from_image=2.0 * np.eye(3))
    with pytest.raises(ValueError, match="reflection"):
        ExteriorOrientation(projection_centre_m=np.zeros(3), R_object_from_image=np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(ValueError, match="shape"):
        ExteriorOrientation(projection_centre_m=np.zeros(2), R_object_from_image=np.eye(3))


def test_angles_of_an_orientation_are_those_that_made_it() -> None:
    assert TILTED.omega_phi_kappa == pytest.approx((0.1, -0.2, 2.5))


def test_points_far_outside_are_not_folded_back_into_the_image() -> None:
    """With k1 < 0 the distorted radius falls again beyond a limit: 75 degrees off the axis it would be in the image."""
    interior = InteriorOrientation(
        width_px=4000, height_px=3000, principal_distance_px=2684.0, x0_px=1999.5, y0_px=1499.5, k1=-0.06
    )
    down = ExteriorOrientation(projection_centre_m=np.array([0.0, 0.0, 15.0]), R_object_from_image=np.eye(3))
    tangents = np.array([0.3, 0.7, 3.9])
    points = np.column_stack([15.0 * tangents, np.zeros(3), np.zeros(3)])
    folded = pixels_from_ideal(np.column_stack([tangents, np.zeros(3)]), interior)
    assert inside_image(folded, interior).tolist() == [True, True, True]
    xy = image_coordinates(points, down, interior)
    np.testing.assert_allclose(xy[:2], folded[:2])
    assert np.isnan(xy[2]).all()
