"""Interior orientation: distortion there and back, resampled images keep their rays, nonsense is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavkit.core.arrays import Array
from uavkit.core.camera import (
    INTERIOR_PARAMETERS,
    CameraProfile,
    InteriorOrientation,
    InteriorSigmas,
    distort,
    distortion_jacobian,
    ideal_from_pixels,
    image_directions,
    pixels_from_ideal,
    undistort,
)

CAMERA = InteriorOrientation(
    width_px=4000, height_px=3000, principal_distance_px=2684.0, x0_px=2010.5, y0_px=1490.25,
    k1=-0.06, k2=0.05, k3=-0.01, p1=4e-4, p2=-3e-4, b1=2e-3, b2=-1e-3,
)  # fmt: skip


def pixel_grid(camera: InteriorOrientation) -> Array:
    columns, rows = np.meshgrid(np.linspace(0, camera.width_px - 1, 9), np.linspace(0, camera.height_px - 1, 7))
    return np.column_stack([columns.ravel(), rows.ravel()])


@given(
    st.floats(-0.08, 0.12), st.floats(-0.03, 0.05), st.floats(-0.01, 0.02), st.floats(-2e-3, 2e-3),
    st.floats(-2e-3, 2e-3), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01),
)  # fmt: skip
def test_pixels_go_to_rays_and_back(
    k1: float, k2: float, k3: float, p1: float, p2: float, b1: float, b2: float
) -> None:
    camera = replace(CAMERA, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2, b1=b1, b2=b2)
    xy = pixel_grid(camera)
    assert np.abs(pixels_from_ideal(ideal_from_pixels(xy, camera), camera) - xy).max() < 1e-8


def test_distortion_hand_worked() -> None:
    camera = replace(CAMERA, k1=0.1, k2=0.0, k3=0.0, p1=0.01, p2=0.02)
    # r2 = 0.05: radial 1.005; x: 0.1 * 1.005 + 0.01 * 2 * 0.02 + 0.02 * (0.05 + 0.02); y: P1 and P2 exchanged.
    assert distort(np.array([[0.1, 0.2]]), camera)[0] == pytest.approx([0.1023, 0.2031])


def test_distortion_jacobian_against_differences() -> None:
    ideal = np.random.default_rng(1).uniform(-0.7, 0.7, (20, 2))
    step = 1e-6
    for column in (0, 1):
        offset = step * np.eye(2)[column]
        numeric = (distort(ideal + offset, CAMERA) - distort(ideal - offset, CAMERA)) / (2.0 * step)
        assert distortion_jacobian(ideal, CAMERA)[:, :, column] == pytest.approx(numeric, abs=1e-9)


@pytest.mark.parametrize("radius", [0.72, 0.75, 0.9, 1.5])
def test_a_distortion_that_folds_over_is_refused_and_not_inverted_on_the_wrong_side(radius: float) -> None:
    barrel = replace(CAMERA, k1=-0.3, k2=0.0, k3=0.0, p1=0.0, p2=0.0)  # r (1 - 0.3 r^2) never exceeds 0.703
    directions = np.linspace(0.0, 2.0 * np.pi, 12)
    distorted = radius * np.column_stack([np.cos(directions), np.sin(directions)])
    for point in distorted:
        with pytest.raises(ValueError, match="folds over"):
            undistort(point[None, :], barrel)


def test_undistort_up_to_just_inside_the_fold() -> None:
    barrel = replace(CAMERA, k1=-0.3, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
    ideal = np.array([[0.95, 0.0], [0.0, -0.95], [0.6, 0.7]])
    assert undistort(distort(ideal, barrel), barrel) == pytest.approx(ideal, abs=1e-9)


@pytest.mark.parametrize("size", [(2000, 1500), (500, 375), (640, 480), (1000, 1500)])
def test_resampled_images_see_the_same_rays(size: tuple[int, int]) -> None:
    scaled = CAMERA.scaled(*size)
    corners = np.array([[-0.5, -0.5], [3999.5, -0.5], [3999.5, 2999.5], [-0.5, 2999.5], [1700.0, 900.0]])
    in_scaled = (corners + 0.5) * [size[0] / 4000, size[1] / 3000] - 0.5
    assert image_directions(in_scaled, scaled) == pytest.approx(image_directions(corners, CAMERA), abs=1e-12)


def test_rays_of_the_principal_point_and_of_a_point_above_right_of_it() -> None:
    camera = replace(CAMERA, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0, b1=0.0, b2=0.0)
    xy = np.array([[2010.5, 1490.25], [2010.5 + 268.4, 1490.25 - 134.2]])
    assert image_directions(xy, camera) == pytest.approx(np.array([[0.0, 0.0, -1.0], [0.1, 0.05, -1.0]]))


def test_parameters_go_out_and_in_by_name_and_order() -> None:
    values = np.arange(1.0, 11.0)
    camera = CAMERA.with_parameters(values)
    assert [getattr(camera, name) for name in INTERIOR_PARAMETERS] == list(values)
    assert camera.parameters() == pytest.approx(values)
    assert (camera.width_px, camera.height_px) == (4000, 3000)


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="principal_distance_px"):
        replace(CAMERA, principal_distance_px=float("nan"))
    with pytest.raises(ValueError, match="image size"):
        replace(CAMERA, width_px=0)
    with pytest.raises(ValueError, match="sigma of k1"):
        InteriorSigmas(k1=-1.0)
    with pytest.raises(ValueError, match="sigma of p2"):
        InteriorSigmas(p2=float("nan"))


def test_pixel_size_of_a_profile() -> None:
    profile = CameraProfile(
        name="x", maker="y", models=(), sensor_width_mm=7.6, focal_length_mm=5.1, interior=CAMERA,
        interior_sigmas=InteriorSigmas(),
    )  # fmt: skip
    assert profile.pixel_size_mm == pytest.approx(0.0019)
