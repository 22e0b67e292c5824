"""The factor by fronts against the dense one, and adjustments of larger blocks by both."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from bundle_blocks import Plan, simulate

from uavkit.core.adjustment import AdjustmentOptions, Datum
from uavkit.core.errors import AdjustmentError
from uavkit.process import bundle_system
from uavkit.process.bundle import adjust_block
from uavkit.process.bundle_system import BundleSystem, build_system, inner_datum, reduced_normals
from uavkit.process.elimination import dissect
from uavkit.process.kernels.bundle_normals import Reduced
from uavkit.process.normal_equations import Pattern, empty_reduced, factor_dense, pattern_of_rays
from uavkit.process.sparse_factor import SparseFactoriser

LARGE = Plan(strips=6, images=20, points=2500, length_m=120.0, width_m=100.0)


def _system(datum: Datum, plan: Plan = LARGE) -> BundleSystem:
    block = simulate(np.random.default_rng(1), plan, start_error=0.02)
    return build_system(block.observations, datum, (2.0, 2.0, 3.0))


def _random_reduced(rng: np.random.Generator, images: int, border: int, d: int = 6) -> tuple[Reduced, Pattern]:
    """Return positive definite equations of a random pattern: images on a chain, some points far apart along it."""
    points = 4 * images
    near = (rng.integers(0, images, points)[:, None] + rng.integers(0, 7, (points, 4))) % images
    rows = [np.unique(row) for row in near]
    start = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    pattern = pattern_of_rays(np.concatenate(rows), start, images)
    reduced = empty_reduced(pattern, border, d)
    for row in rows:
        design = rng.normal(size=(d * len(row) + border + 4, d * len(row) + border))
        normal = design.T @ design
        for a, i in enumerate(row):
            reduced.diagonal_images[i] += np.diag(normal)[d * a : d * a + d]
            reduced.border[i] += normal[d * a : d * a + d, d * len(row) :]
            for b, j in enumerate(row[: a + 1]):
                reduced.blocks[pattern.pairs.place[pattern.pairs.base[i] + j]] += normal[
                    d * a : d * a + d, d * b : d * b + d
                ]
        reduced.corner[:] += normal[d * len(row) :, d * len(row) :]
        reduced.diagonal_border[:] += np.diag(normal)[d * len(row) :]
    return reduced, pattern


@pytest.mark.parametrize(("border", "d"), [(0, 6), (5, 6), (2, 9)])
def test_random_equations(border: int, d: int) -> None:
    rng = np.random.default_rng(border)
    reduced, pattern = _random_reduced(rng, 130, border, d)
    centres = np.column_stack([np.arange(130.0), rng.normal(size=130), np.zeros(130)])
    dense = factor_dense(reduced, 0.0, None)
    sparse = SparseFactoriser(dissect(pattern, centres))(reduced, 0.0, None)
    right = rng.normal(size=(130 * d + border, 3))
    np.testing.assert_allclose(sparse.solve(right), dense.solve(right), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(sparse.solve(right[:, 0]), dense.solve(right[:, 0]), rtol=1e-9, atol=1e-12)
    for name in ("blocks", "border", "corner"):
        a, b = getattr(sparse.inverse(), name), getattr(dense.inverse(), name)
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * float(np.max(np.abs(b), initial=0.0)))


@pytest.mark.parametrize(
    ("datum", "damping", "tolerance"),
    [(Datum.FREE_NETWORK, 0.0, 1e-9), (Datum.CONTROL, 0.0, 1e-8), (Datum.CONTROL, 1e-4, 1e-8)],
)
def test_equations_of_a_block(datum: Datum, damping: float, tolerance: float) -> None:
    """In units of sigma; the equations that control and self-calibration make have a condition of some 1e8."""
    system = _system(datum)
    state, weights = system.start(), system.full_weights()
    reduced, _ = reduced_normals(system, state, weights, damping)
    space = inner_datum(system, state)
    dense, sparse = factor_dense(reduced, damping, space), system.factorise(reduced, damping, space)
    a, b = dense.inverse(), sparse.inverse()
    sigma = np.sqrt(np.einsum("nkk->nk", a.blocks[system.pattern.diagonal]))
    of_border = np.sqrt(np.diag(a.corner))
    unit = sigma[system.pattern.row][:, :, None] * sigma[system.pattern.column][:, None, :]
    np.testing.assert_allclose(b.blocks / unit, a.blocks / unit, atol=tolerance)
    unit = sigma[:, :, None] * of_border
    np.testing.assert_allclose(b.border / unit, a.border / unit, atol=tolerance)
    unit = of_border * of_border[:, None]
    np.testing.assert_allclose(b.corner / unit, a.corner / unit, atol=tolerance)
    right = np.concatenate([reduced.right_images.ravel(), reduced.right_border])
    scale = np.concatenate([sigma.ravel(), of_border])
    x, y = dense.solve(right) / scale, sparse.solve(right) / scale
    np.testing.assert_allclose(y, x, atol=1e-9 * float(np.max(np.abs(x))))


def test_a_front_holds_every_pair_of_images_with_a_point_in_common() -> None:
    system = _system(Datum.CONTROL)
    assert isinstance(system.factorise, SparseFactoriser)
    elimination = system.factorise.elimination
    together = [set(front.own) | set(front.boundary) for front in elimination.fronts]
    assert sorted(i for front in elimination.fronts for i in front.own) == list(range(120))
    assert max(len(images) for images in together) < 100
    for i, j in zip(system.pattern.row, system.pattern.column, strict=True):
        first = min(elimination.front_of_image[i], elimination.front_of_image[j])
        assert {i, j} <= together[first]


def test_adjustment_is_that_of_the_dense_factor(monkeypatch: pytest.MonkeyPatch) -> None:
    block = simulate(np.random.default_rng(4), LARGE, start_error=0.5)
    options = AdjustmentOptions(robust=False, datum=Datum.CONTROL)
    sparse = adjust_block(block.observations, options)
    monkeypatch.setattr(bundle_system, "choose_factoriser", lambda pattern, centres: factor_dense)
    dense = adjust_block(block.observations, options)
    assert sparse.sigma0 == pytest.approx(dense.sigma0, rel=1e-8)
    sigma = np.sqrt(np.einsum("nkk->nk", dense.exterior_covariances))
    moved = np.abs(sparse.projection_centres_m - dense.projection_centres_m)
    assert np.max(moved / sigma[:, :3]) < 2e-3  # both end their iteration at 1e-3 sigma
    np.testing.assert_allclose(
        np.sqrt(np.einsum("nkk->nk", sparse.exterior_covariances)), sigma, rtol=1e-4
    )  # fmt: skip


def test_result_does_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    block = simulate(np.random.default_rng(6), LARGE, start_error=0.1)
    results = []
    for threads in (1, 2):
        with ThreadPoolExecutor(threads) as pool:
            monkeypatch.setattr(bundle_system, "_pool", lambda process, pool=pool: pool)
            results.append(adjust_block(block.observations, AdjustmentOptions(robust=False)))
    for name in ("points_m", "exterior_covariances", "point_covariances_m2", "ray_redundancy", "interior_covariance"):
        np.testing.assert_array_equal(getattr(results[0], name), getattr(results[1], name))
    assert results[0].sigma0 == results[1].sigma0


def test_defect_is_named() -> None:
    block = simulate(np.random.default_rng(5), replace(LARGE, control=2, self_calibration=False))
    observations = replace(block.observations, gnss=None)
    with pytest.raises(AdjustmentError, match=r"leave 1 direction\(s\).*image"):
        adjust_block(observations, AdjustmentOptions(robust=False, datum=Datum.CONTROL))


def test_twice_as_many_images_take_fronts_no_larger() -> None:
    """Fronts grow with the width of a block, not with its length: that is what makes long blocks cheap."""
    sizes = []
    for images in (20, 40):
        plan = replace(LARGE, images=images, length_m=6.0 * images, points=125 * images)
        factorise = _system(Datum.CONTROL, plan).factorise
        assert isinstance(factorise, SparseFactoriser)
        sizes.append(max(len(front.own) + len(front.boundary) for front in factorise.elimination.fronts))
    assert sizes[1] < 1.5 * sizes[0]
