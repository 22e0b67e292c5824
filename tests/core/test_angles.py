"""Rotations: any of them goes there and back, and the axes are the ones that the conventions state."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavkit.core.angles import (
    nearest_rotation,
    omega_phi_kappa_from_rotation,
    omega_phi_kappa_jacobian,
    rotation_from_omega_phi_kappa,
    rotation_from_vector,
    skew,
    vector_from_rotation,
)
from uavkit.core.arrays import Array

ANGLE = st.floats(-np.pi, np.pi)
NEAR_ZERO = st.floats(-1e-7, 1e-7)
FACADE = st.builds(lambda sign, off: sign * np.pi / 2 + off, st.sampled_from([-1.0, 1.0]), NEAR_ZERO)


def axis_rotation(axis: int, angle: float) -> Array:
    """Turn about one axis, written out by hand: the twin of the product in ``angles``."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    r = np.eye(3)
    r[i, i] = r[j, j] = c
    r[i, j], r[j, i] = -s, s
    return r


@given(ANGLE, ANGLE, ANGLE)
def test_omega_phi_kappa_is_the_product_of_three_axis_rotations(omega: float, phi: float, kappa: float) -> None:
    product = axis_rotation(0, omega) @ axis_rotation(1, phi) @ axis_rotation(2, kappa)
    assert rotation_from_omega_phi_kappa(omega, phi, kappa) == pytest.approx(product, abs=1e-15)


@given(ANGLE, st.one_of(ANGLE, FACADE), ANGLE)
def test_any_rotation_goes_to_angles_and_back_facades_too(omega: float, phi: float, kappa: float) -> None:
    rotation = rotation_from_omega_phi_kappa(omega, phi, kappa)
    again = rotation_from_omega_phi_kappa(*omega_phi_kappa_from_rotation(rotation))
    assert np.abs(again - rotation).max() < 3e-12  # where cos phi is below 1e-12, omega is set to zero


@given(ANGLE, FACADE, ANGLE, st.lists(ANGLE, min_size=3, max_size=3))
def test_rotations_near_a_facade_that_come_from_a_product_go_to_angles_and_back(
    omega: float, phi: float, kappa: float, turn: list[float]
) -> None:
    """Products carry rounding errors of 1e-16, which tell omega from kappa apart by 1e-16 / cos phi only."""
    turned = rotation_from_vector(np.array(turn))
    rotation = turned @ (turned.T @ rotation_from_omega_phi_kappa(omega, phi, kappa))
    again = rotation_from_omega_phi_kappa(*omega_phi_kappa_from_rotation(rotation))
    assert np.abs(again - rotation).max() < 3e-12


@given(ANGLE, st.floats(-1.5, 1.5), ANGLE)
def test_angles_go_to_a_rotation_and_back(omega: float, phi: float, kappa: float) -> None:
    angles = np.array(omega_phi_kappa_from_rotation(rotation_from_omega_phi_kappa(omega, phi, kappa)))
    difference = angles - [omega, phi, kappa]
    assert np.abs(np.sin(difference / 2.0)).max() < 1e-13


def test_at_a_facade_omega_is_zero() -> None:
    omega, phi, kappa = omega_phi_kappa_from_rotation(rotation_from_omega_phi_kappa(0.0, np.pi / 2, 0.3))
    assert (omega, phi, kappa) == pytest.approx((0.0, np.pi / 2, 0.3), abs=1e-9)


@given(st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3), st.floats(0.0, np.pi))
def test_a_rotation_vector_goes_to_a_rotation_and_back(axis: list[float], angle: float) -> None:
    length = float(np.linalg.norm(axis))
    vector = np.array(axis) / length * angle if length > 1e-3 else np.array([0.0, 0.0, angle])
    rotation = rotation_from_vector(vector)
    assert np.abs(rotation_from_vector(vector_from_rotation(rotation)) - rotation).max() < 1e-9
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-14


@pytest.mark.parametrize("short_of_half_a_turn", [0.0, 1e-12, 1e-9, 1e-7, 9e-7, 2e-6, 1e-3])
def test_rotation_vector_of_nearly_half_a_turn_keeps_its_sense(short_of_half_a_turn: float) -> None:
    for axis in np.array([[-0.6, 0.0, 0.8], [0.6, 0.0, -0.8], [0.0, -1.0, 0.0], [1.0, 2.0, -2.0]]):
        vector = axis / np.linalg.norm(axis) * (np.pi - short_of_half_a_turn)
        rotation = rotation_from_vector(vector)
        assert np.abs(rotation_from_vector(vector_from_rotation(rotation)) - rotation).max() < 1e-9


def test_rotation_vectors_turn_counter_clockwise_and_many_at_once() -> None:
    quarter = np.pi / 2
    rotations = rotation_from_vector(np.array([[0.0, 0.0, quarter], [quarter, 0.0, 0.0]]))
    assert rotations[0] @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-15)
    assert rotations[1] @ [0.0, 1.0, 0.0] == pytest.approx([0.0, 0.0, 1.0], abs=1e-15)


def test_skew_is_the_cross_product() -> None:
    a, b = np.array([1.0, -2.0, 3.0]), np.array([0.5, 4.0, -1.0])
    assert skew(a) @ b == pytest.approx(np.cross(a, b))


def test_nearest_rotation_mends_noise_and_is_never_a_reflection() -> None:
    rng = np.random.default_rng(4)
    rotation = rotation_from_omega_phi_kappa(0.2, -0.4, 2.0)
    mended = nearest_rotation(rotation + rng.normal(0.0, 1e-3, (3, 3)))
    assert np.abs(mended @ mended.T - np.eye(3)).max() < 1e-14
    assert np.abs(mended - rotation).max() < 5e-3
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)


@given(ANGLE, st.floats(-1.3, 1.3), ANGLE)
def test_jacobian_of_omega_phi_kappa_against_differences(omega: float, phi: float, kappa: float) -> None:
    rotation = rotation_from_omega_phi_kappa(omega, phi, kappa)
    step = 1e-6
    numeric = np.empty((3, 3))
    for column, unit in enumerate(np.eye(3)):
        ends = [
            np.array(omega_phi_kappa_from_rotation(rotation @ rotation_from_vector(sign * step * unit)))
            for sign in (1, -1)
        ]
        numeric[:, column] = np.sin(ends[0] - ends[1]) / (2.0 * step)
    assert omega_phi_kappa_jacobian(rotation) == pytest.approx(numeric, abs=1e-7)
