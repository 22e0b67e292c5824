"""Precision: the block-wise covariances against the inverse of the whole normal matrix."""

import numpy as np
from bundle_blocks import INTERIOR_SIGMAS, Plan, SimulatedBlock, simulate

from uavkit.core.adjustment import AdjustmentOptions
from uavkit.core.collinearity import collinearity_derivatives
from uavkit.core.orientation import ExteriorOrientation
from uavkit.process.bundle import adjust_block


def _design(block: SimulatedBlock) -> tuple[np.ndarray, np.ndarray]:
    """Return the whitened design matrix of all observations, unknowns in full, and its rows of rays."""
    given = block.observations
    n, m, q = len(block.centres_m), len(block.points_m), int(np.sum(INTERIOR_SIGMAS.values() > 0))
    free = np.flatnonzero(INTERIOR_SIGMAS.values() > 0)
    size = 6 * n + q + 3 * m + 3
    result = adjust_block(given, AdjustmentOptions(robust=False))
    rows = []
    for k in range(len(given.rays)):
        i, p = int(given.rays.image_index[k]), int(given.rays.point_index[k])
        exterior = ExteriorOrientation(
            projection_centre_m=result.projection_centres_m[i], R_object_from_image=result.R_object_from_image[i]
        )
        by = collinearity_derivatives(result.points_m[p : p + 1], exterior, result.interior)
        row = np.zeros((2, size))
        row[:, 6 * i : 6 * i + 6] = np.hstack([by.by_centre[0], by.by_rotation[0]])
        row[:, 6 * n : 6 * n + q] = by.by_interior[0][:, free]
        row[:, 6 * n + q + 3 * p : 6 * n + q + 3 * p + 3] = by.by_point[0]
        rows.append(row / given.rays.sigma_px[k][:, None])
    extra = []
    assert given.gnss is not None
    assert given.control is not None
    from uavkit.core.angles import skew

    for g in range(len(given.gnss)):
        i = int(given.gnss.image_index[g])
        row = np.zeros((3, size))
        row[:, 6 * i : 6 * i + 3] = np.eye(3)
        row[:, 6 * i + 3 : 6 * i + 6] = -result.R_object_from_image[i] @ skew(np.array(given.gnss.lever_arm_m))
        row[:, -3:] = np.eye(3)
        extra.append(row / given.gnss.sigma_m[g][:, None])
    for c in range(len(given.control)):
        row, start = np.zeros((3, size)), 6 * n + q + 3 * int(given.control.point_index[c])
        row[:, start : start + 3] = np.eye(3)
        extra.append(row / given.control.sigma_m[c][:, None])
    prior = np.zeros((q, size))
    prior[:, 6 * n : 6 * n + q] = np.diag(1.0 / INTERIOR_SIGMAS.values()[free])
    return np.vstack([*rows, *extra, prior]), np.vstack(rows)


def test_all_covariances_are_those_of_the_whole_normal_matrix() -> None:
    block = simulate(np.random.default_rng(2), Plan(strips=2, images=4, points=90, length_m=34.0, width_m=26.0))
    result = adjust_block(block.observations, AdjustmentOptions(robust=False), joint_points=block.check)
    design, rays = _design(block)
    scale = 1.0 / np.linalg.norm(design, axis=0)
    whole = np.linalg.inv((design * scale).T @ (design * scale)) * scale * scale[:, None]
    n, m = len(block.centres_m), len(block.points_m)
    q = int(np.sum(INTERIOR_SIGMAS.values() > 0))
    free = np.flatnonzero(INTERIOR_SIGMAS.values() > 0)
    first = 6 * n + q

    def agree(found: np.ndarray, expected: np.ndarray) -> None:
        root = np.sqrt(np.abs(np.diag(expected)))
        np.testing.assert_allclose(found / root / root[:, None], expected / root / root[:, None], atol=1e-5)

    for i in range(n):
        agree(result.exterior_covariances[i], whole[6 * i : 6 * i + 6, 6 * i : 6 * i + 6])
    for p in range(m):
        rows = slice(first + 3 * p, first + 3 * p + 3)
        agree(result.point_covariances_m2[p], whole[rows, rows])
    agree(result.interior_covariance[np.ix_(free, free)], whole[6 * n : first, 6 * n : first])
    agree(result.gnss_shift_covariance_m2[0], whole[-3:, -3:])
    joint = np.concatenate([np.arange(first + 3 * p, first + 3 * p + 3) for p in block.check])
    agree(result.joint_covariance_m2, whole[np.ix_(joint, joint)])
    redundancy = 1.0 - np.einsum("ij,jk,ik->i", rays, whole, rays).reshape(-1, 2)
    np.testing.assert_allclose(result.ray_redundancy, redundancy, atol=1e-6)
    assert result.redundancy == len(design) - design.shape[1]
