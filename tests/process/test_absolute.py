"""Absolute orientation: exact on exact data, within its noise on noisy, untouched by gross outliers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.process.made_blocks import stations
from uavkit.core.angles import rotation_from_vector, vector_from_rotation
from uavkit.core.arrays import Array
from uavkit.core.errors import AdjustmentError
from uavkit.process.absolute import Similarity, fit_similarity, robust_similarity

UP = np.array([0.0, 0.0, 1.0])


def _turned(vector: tuple[float, float, float], scale: float, shift: tuple[float, float, float]) -> Similarity:
    return Similarity(scale=scale, R_object_from_model=rotation_from_vector(np.array(vector)), shift_m=np.array(shift))


def _to_model(object_from_model: Similarity, points: Array) -> Array:
    return (points - object_from_model.shift_m) @ object_from_model.R_object_from_model / object_from_model.scale


def _centres(strips: int, per_strip: int) -> Array:
    return np.array([s.projection_centre_m for s in stations(strips, per_strip, np.random.default_rng(3))])


turns = st.tuples(*[st.floats(-1.8, 1.8)] * 3)
shifts = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


@settings(max_examples=60, deadline=None)
@given(vector=turns, scale=st.floats(0.02, 50.0), shift=shifts, seed=st.integers(0, 10**6))
def test_any_similarity_is_found_exactly(
    vector: tuple[float, float, float], scale: float, shift: tuple[float, float, float], seed: int
) -> None:
    truth = _turned(vector, scale, shift)
    model = np.random.default_rng(seed).normal(0, 1, (6, 3))
    found = fit_similarity(model, truth.apply(model))
    np.testing.assert_allclose(found.scale, truth.scale, rtol=1e-9)
    np.testing.assert_allclose(found.R_object_from_model, truth.R_object_from_model, atol=1e-8)
    np.testing.assert_allclose(found.apply(model), truth.apply(model), atol=1e-9 * (1e3 + 10 * scale))


def test_a_mirrored_model_gets_a_rotation_all_the_same() -> None:
    model = np.random.default_rng(1).normal(0, 1, (8, 3))
    found = fit_similarity(model, model * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.R_object_from_model) == pytest.approx(1.0)


def test_points_in_one_place_are_refused() -> None:
    with pytest.raises(AdjustmentError, match="one place"):
        fit_similarity(np.ones((4, 3)), np.random.default_rng(0).normal(0, 1, (4, 3)))
    with pytest.raises(AdjustmentError, match="coincide"):
        robust_similarity(
            np.random.default_rng(0).normal(0, 1, (4, 3)), np.ones((4, 3)), np.ones((4, 3)), UP,
            np.random.default_rng(0),
        )  # fmt: skip


def test_fewer_than_three_positions_are_refused() -> None:
    two = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    with pytest.raises(AdjustmentError, match="at least 3 positions, there are 2"):
        robust_similarity(two, two, np.ones((2, 3)), UP, np.random.default_rng(0))


def test_sbas_positions_with_gross_outliers_orient_within_their_noise() -> None:
    """33 positions of 1.0, 1.0, 1.5 m, three of them off by 10 to 80 m: over 10 cases the seven parameters' errors,
    normalised by the least squares precision of the 30 good positions, must be chi-square of 7 degrees of freedom."""
    truth = _turned((0.3, -0.2, 2.5), 9.0, (120.0, -40.0, 60.0))
    centres = _centres(3, 11)
    model = _to_model(truth, centres)
    up = truth.R_object_from_model.T @ UP
    sigma = np.full((33, 3), 1.0)
    squares = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        fixes = centres + rng.normal(0, 1, (33, 3)) * sigma
        bad = rng.choice(33, 3, replace=False)
        direction = rng.normal(0, 1, (3, 3))
        fixes[bad] += direction / np.linalg.norm(direction, axis=1)[:, None] * rng.uniform(10, 80, (3, 1))
        found, agrees = robust_similarity(model, fixes, sigma, up, rng)
        assert not agrees[bad].any()
        assert agrees.sum() >= 27  # chi-square of 3 beyond 3.4^2: 1 %
        good = np.setdiff1d(np.arange(33), bad)
        squares.append(_normalised_error(truth, found, model[good], centres[good]))
    # Positions that the 3.4 sigma limit drops although they are good cost little: mean of 10 values of 7 +- 1.2.
    assert 3.5 < np.mean(squares) < 11.5


def _normalised_error(truth: Similarity, found: Similarity, model: Array, centres: Array) -> float:
    """Squared error of scale, rotation and shift at the middle, in the precision that sigma 1 m gives."""
    about = centres - centres.mean(axis=0)
    design = np.zeros((len(about), 3, 7))
    design[:, :, 0] = about
    for axis in range(3):
        design[:, :, 1 + axis] = np.cross(np.eye(3)[axis], about)
        design[:, axis, 4 + axis] = 1.0
    normal = np.einsum("nij,nik->jk", design, design)
    error = np.concatenate(
        [
            [found.scale / truth.scale - 1.0],
            vector_from_rotation(found.R_object_from_model @ truth.R_object_from_model.T),
            found.apply(model).mean(axis=0) - truth.apply(model).mean(axis=0),
        ]
    )
    return float(error @ normal @ error)


def test_a_single_straight_strip_takes_its_roll_from_the_images() -> None:
    truth = _turned((0.1, 0.4, -2.0), 4.0, (5.0, 6.0, 7.0))
    centres = np.column_stack([np.linspace(0, 70, 11), np.zeros(11), np.full(11, 15.0)])
    rng = np.random.default_rng(2)
    fixes = centres + rng.normal(0, 0.05, centres.shape)
    up = truth.R_object_from_model.T @ UP
    found, agrees = robust_similarity(_to_model(truth, centres), fixes, np.full((11, 3), 0.05), up, rng)
    error = vector_from_rotation(found.R_object_from_model @ truth.R_object_from_model.T)
    assert agrees.sum() >= 10
    # Along the strip 11 positions over 70 m; the roll is as good as the up, here exact.
    assert np.abs(error).max() < 3 * 0.05 / np.sqrt(np.sum((centres - centres.mean(axis=0)) ** 2))
    found, _ = robust_similarity(_to_model(truth, centres), fixes, np.full((11, 3), 0.05), -up, rng)
    about_strip = vector_from_rotation(found.R_object_from_model @ truth.R_object_from_model.T)
    assert abs(abs(about_strip[0]) - np.pi) < 0.05  # up side down, because the images said so


def test_three_positions_suffice() -> None:
    truth = _turned((0.5, 0.1, 1.0), 3.0, (1.0, 2.0, 3.0))
    model = np.array([[0.0, 0.0, 0.0], [8.0, 1.0, 0.5], [3.0, 9.0, -0.4]])
    up = truth.R_object_from_model.T @ UP
    found, agrees = robust_similarity(model, truth.apply(model), np.full((3, 3), 0.1), up, np.random.default_rng(0))
    assert agrees.all()
    np.testing.assert_allclose(found.apply(model), truth.apply(model), atol=1e-9)
