"""The latency of GNSS positions as an unknown of the bundle."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_blocks import Plan, SimulatedBlock, simulate
from made_blocks import SMALL as SMALL_CAMERA
from made_blocks import block_of

from uavkit.core.adjustment import AdjustmentInput, AdjustmentOptions, AdjustmentResult, Datum
from uavkit.core.observations import GnssObservations
from uavkit.formats.record_codec import InlineArrays, decode, encode
from uavkit.process import network
from uavkit.process.bundle import adjust_block
from uavkit.process.bundle_system import (
    BundleSystem,
    Change,
    Precision,
    State,
    border_priors,
    build_system,
    gauss_newton_step,
    misclosures,
    moved,
    precision_at,
    reduced_normals,
)
from uavkit.process.elimination import dissect
from uavkit.process.normal_equations import dense_matrix, factor_dense
from uavkit.process.precision import group_sigma0
from uavkit.process.sparse_factor import SparseFactoriser

PLAIN = AdjustmentOptions(robust=False)
ROBUST = AdjustmentOptions()
LATENCY_S, SPEED_M_S = 0.1, 5.0
WITH_CONTROL = Plan(strips=2, images=5, points=150, length_m=40.0, width_m=26.0, gnss_sigma_m=0.05)
GNSS_ONLY = replace(WITH_CONTROL, control=0, gnss_sigma_m=0.03)


def _flown(block: SimulatedBlock, latency_s: float, sigma_s: float | None = 0.3) -> AdjustmentInput:
    """Return observations of strips flown to and fro, whose positions are late by a latency."""
    gnss = block.observations.gnss
    assert gnss is not None
    rng = np.random.default_rng(99)
    along = -block.rotations[:, :, 1]  # the camera's lower edge goes first
    along[:, 2] = 0.0
    velocity = SPEED_M_S * along / np.linalg.norm(along, axis=1)[:, None] + rng.normal(0, 0.2, along.shape)
    late = replace(
        gnss, position_m=gnss.position_m + latency_s * velocity, velocity_m_s=velocity, latency_sigma_s=sigma_s
    )
    return replace(block.observations, gnss=late)


def _gnss(observations: AdjustmentInput) -> GnssObservations:
    assert observations.gnss is not None
    return observations.gnss


def _chi(block: SimulatedBlock, result: AdjustmentResult) -> tuple[float, float, float]:
    """Return squared errors over their variances: latency, shift, and points (mean of three axes)."""
    latency = (result.gnss_latency_s[0] - LATENCY_S) / result.gnss_latency_sigma_s[0]
    error = (result.gnss_shift_m - block.shift_m)[0]
    shift = float(error @ np.linalg.solve(result.gnss_shift_covariance_m2[0], error)) / 3.0
    point = result.points_m - block.points_m
    variance = np.einsum("maa->ma", result.point_covariances_m2)
    return latency**2, shift, float(np.nanmean(point**2 / variance))


@pytest.mark.parametrize("plan", [WITH_CONTROL, GNSS_ONLY], ids=["control", "gnss"])
@pytest.mark.parametrize("options", [PLAIN, ROBUST], ids=["plain", "robust"])
def test_latency_is_found_within_its_sigma(plan: Plan, options: AdjustmentOptions) -> None:
    values, number = [], 16
    for seed in range(number):
        block = simulate(np.random.default_rng(seed), plan, start_error=0.1)
        result = adjust_block(_flown(block, LATENCY_S), options)
        values.append(_chi(block, result))
        # Twelve positions of 5 cm, half of them each way at 5 m/s: 5 cm / sqrt(12) / 5 m/s is 3 ms.
        assert 0.0005 < result.gnss_latency_sigma_s[0] < 0.006
        assert result.gnss_used.mean() > 0.8
    # Robust weights leave out one observation in some hundred: the scatter grows by next to nothing.
    for mean, freedom in zip(np.mean(values, axis=0), (1, 3, 3), strict=True):
        assert abs(mean - 1.0) < 3.5 * np.sqrt(2.0 / (freedom * number))


@pytest.mark.slow
def test_errors_of_the_latency_are_standard_normal_over_many_blocks() -> None:
    z = []
    for seed in range(150):
        block = simulate(np.random.default_rng(seed), WITH_CONTROL, start_error=0.1)
        result = adjust_block(_flown(block, LATENCY_S), PLAIN)
        z.append((result.gnss_latency_s[0] - LATENCY_S) / result.gnss_latency_sigma_s[0])
    assert abs(np.mean(z)) < 3.5 / np.sqrt(len(z))
    assert abs(np.mean(np.square(z)) - 1.0) < 3.5 * np.sqrt(2.0 / len(z))


def test_a_late_position_lies_ahead() -> None:
    """The sign: positions stamped 0.1 s too early are those of 0.5 m farther on, and the latency is positive."""
    block = simulate(np.random.default_rng(0), WITH_CONTROL, start_error=0.1)
    observations = _flown(block, 0.0)
    gnss = _gnss(observations)
    assert gnss.velocity_m_s is not None
    ahead = replace(gnss, position_m=gnss.position_m + 0.1 * gnss.velocity_m_s)
    result = adjust_block(replace(observations, gnss=ahead), PLAIN)
    assert result.gnss_latency_s[0] == pytest.approx(0.1, abs=4 * result.gnss_latency_sigma_s[0])


def test_wrong_fixes_are_found_beside_the_latency() -> None:
    for seed in range(3):
        block = simulate(np.random.default_rng(seed), WITH_CONTROL, start_error=0.1)
        observations = _flown(block, LATENCY_S)
        position = _gnss(observations).position_m.copy()
        position[3] += [4.0, -3.0, 2.0]
        result = adjust_block(replace(observations, gnss=replace(_gnss(observations), position_m=position)))
        assert not result.gnss_used[3]
        assert abs(result.gnss_latency_s[0] - LATENCY_S) < 4.0 * result.gnss_latency_sigma_s[0]


def test_without_an_a_priori_sigma_velocities_change_nothing() -> None:
    block = simulate(np.random.default_rng(2), WITH_CONTROL, start_error=0.1)
    plain = adjust_block(block.observations)
    known = adjust_block(_flown(block, 0.0, sigma_s=None))
    assert plain.gnss_latency_s.shape == known.gnss_latency_s.shape == (0,)
    for name in ("points_m", "point_covariances_m2", "exterior_covariances", "gnss_shift_m", "ray_redundancy"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(known, name))
    assert plain.sigma0 == known.sigma0
    assert plain.redundancy == known.redundancy


def test_one_direction_leaves_latency_and_shift_together() -> None:
    """The latency keeps its a priori sigma, the shift along the track gets that times the speed; a note says so."""
    plan = replace(WITH_CONTROL, strips=2)
    block = simulate(np.random.default_rng(4), plan, start_error=0.1)
    observations = _flown(block, 0.0, sigma_s=0.2)
    east = np.tile([SPEED_M_S, 0.0, 0.0], (len(_gnss(observations)), 1))
    result = adjust_block(replace(observations, gnss=replace(_gnss(observations), velocity_m_s=east)), PLAIN)
    assert result.gnss_latency_sigma_s[0] == pytest.approx(0.2, rel=1e-3)
    assert result.gnss_latency_s[0] == pytest.approx(0.0, abs=1e-6)
    assert np.sqrt(result.gnss_shift_covariance_m2[0, 0, 0]) == pytest.approx(1.0, rel=1e-2)
    assert np.sqrt(result.gnss_shift_covariance_m2[0, 1, 1]) < 0.05
    assert "latency of the positions of flight 1 is not determined" in result.notes[-1]


def test_each_flight_has_its_own_latency() -> None:
    plan = replace(WITH_CONTROL, strips=4, width_m=40.0, points=300)
    block = simulate(np.random.default_rng(5), plan, start_error=0.1)
    observations = _flown(block, 0.0)
    gnss = _gnss(observations)
    assert gnss.velocity_m_s is not None
    flight = (np.arange(len(gnss)) >= len(gnss) // 2).astype(np.int64)
    truth = np.array([0.1, -0.06])
    late = gnss.position_m + truth[flight][:, None] * gnss.velocity_m_s
    result = adjust_block(replace(observations, gnss=replace(gnss, flight=flight, position_m=late)), PLAIN)
    assert np.all(np.abs(result.gnss_latency_s - truth) < 4.0 * result.gnss_latency_sigma_s)
    assert np.all(result.gnss_latency_sigma_s < 0.01)


@pytest.fixture(scope="module")
def system() -> BundleSystem:
    """Two flights, a lever arm, three shifts and a latency each, away from the solution."""
    block = simulate(np.random.default_rng(6), GNSS_ONLY, start_error=0.1)
    observations = _flown(block, LATENCY_S)
    gnss = replace(_gnss(observations), flight=np.arange(len(_gnss(observations)), dtype=np.int64) % 2)
    return build_system(replace(observations, gnss=gnss), Datum.GNSS, (2.0, 2.0, 3.0))


def _off(system: BundleSystem) -> State:
    return replace(
        system.start(), shifts=np.array([[0.3, -0.2, 0.5], [0.1, 0.4, -0.6]]), latencies=np.array([0.05, -0.02])
    )


def _numerical_design(system: BundleSystem, state: State) -> np.ndarray:
    """Return the derivatives (3 g, u) of computed antenna positions by all unknowns but the points."""
    n, d = len(state.centres), system.image_unknowns
    columns, step = [], 1e-5
    for index in range(d * n + system.border):
        ends = []
        for sign in (1.0, -1.0):
            vector = np.zeros(d * n + system.border)
            vector[index] = sign * step
            change = Change(
                images=vector[: d * n].reshape(n, d),
                border=vector[d * n :],
                points=np.zeros_like(state.points),
                product=0,
            )
            ends.append(misclosures(system, moved(system, state, change, 1.0)).gnss_m.ravel())
        columns.append((ends[1] - ends[0]) / (2.0 * step))
    return np.column_stack(columns)


def test_normal_equations_are_those_of_finite_differences(system: BundleSystem) -> None:
    state = _off(system)
    weights = system.full_weights()
    reduced, _ = reduced_normals(system, state, replace(weights, rays=0.0 * weights.rays), 0.0)
    design, p = _numerical_design(system, state), 1.0 / _gnss_sigma(system).ravel() ** 2
    expected = design.T @ (p[:, None] * design)
    information, value = border_priors(system, state)
    border = slice(len(expected) - system.border, None)
    expected[border, border] += np.diag(information)
    right = design.T @ (p * misclosures(system, state).gnss_m.ravel())
    right[border] -= information * value
    found = np.concatenate([reduced.right_images.ravel(), reduced.right_border])
    # Scaled to unit diagonal, so that no block is judged by the largest one.
    scale = np.sqrt(np.maximum(np.diag(expected), 1.0))
    np.testing.assert_allclose(
        dense_matrix(reduced) / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-6
    )
    np.testing.assert_allclose(found / scale, right / scale, rtol=1e-6, atol=1e-6 * np.abs(right / scale).max())
    diagonal = np.concatenate([reduced.diagonal_images.ravel(), reduced.diagonal_border])
    np.testing.assert_allclose(diagonal, np.diag(expected), rtol=1e-6, atol=1e-3)


def _gnss_sigma(system: BundleSystem) -> np.ndarray:
    assert system.given.gnss is not None
    return system.given.gnss.sigma_m


def test_leverage_of_positions_is_that_of_the_whole_inverse(system: BundleSystem) -> None:
    state, weights = _off(system), system.full_weights()
    precision = precision_at(system, state, weights)
    design = _numerical_design(system, state)
    variance = np.einsum("ij,ji->i", design, precision.factor.solve(np.ascontiguousarray(design.T)))
    expected = variance.reshape(-1, 3) / _gnss_sigma(system) ** 2
    np.testing.assert_allclose(precision.gnss_leverage, expected, rtol=1e-5)
    assert np.all((expected > 0.01) & (expected < 1.0))


def _sigmas(precision: Precision) -> np.ndarray:
    return np.sqrt(np.diag(precision.inverse.corner))


def test_sparse_and_dense_equations_agree(system: BundleSystem) -> None:
    state, weights = _off(system), system.full_weights()
    sparse = SparseFactoriser(dissect(system.pattern, state.centres))
    results = [
        precision_at(replace(system, factorise=factorise), state, weights) for factorise in (factor_dense, sparse)
    ]
    corners = [result.inverse.corner / _sigmas(results[0]) / _sigmas(results[0])[:, None] for result in results]
    np.testing.assert_allclose(corners[0], corners[1], atol=1e-6)
    np.testing.assert_allclose(results[0].gnss_leverage, results[1].gnss_leverage, rtol=1e-6)


def test_a_step_gains_what_it_promises(system: BundleSystem) -> None:
    """The a priori observation of the latency, far from its value, is in the sum of squares and in the promise."""
    gnss = replace(_gnss(system.given), latency_sigma_s=0.002)
    block = simulate(np.random.default_rng(6), replace(GNSS_ONLY, self_calibration=False), start_error=0.001)
    held = build_system(replace(_flown(block, LATENCY_S), gnss=gnss), Datum.GNSS, (2.0, 2.0, 3.0))
    start = replace(held.start(), shifts=np.tile(block.shift_m, (2, 1)), latencies=np.array([0.1, -0.1]))
    step = gauss_newton_step(held, start, held.full_weights(), 0.0)
    assert step.gain == pytest.approx(1.0, abs=0.02)
    # Most of the promise is made by the latencies: 5000 for leaving what is stated of them, as much by the positions.
    assert step.size**2 < 2e4


def test_sigma0_of_the_positions_holds_shifts_and_latencies(system: BundleSystem) -> None:
    state, weights = _off(system), system.full_weights()
    precision = precision_at(system, state, weights)
    priors = np.concatenate([np.tile([2.0, 2.0, 3.0], 2), [0.3, 0.3]])
    values = np.concatenate([state.shifts.ravel(), state.latencies])
    z = misclosures(system, state).gnss_m / _gnss_sigma(system)
    square = np.sum(z**2) + np.sum((values / priors) ** 2)
    variance = np.diag(precision.inverse.corner)[-8:]
    number = np.sum(1.0 - precision.gnss_leverage) + np.sum(1.0 - variance / priors**2)
    found = group_sigma0(system, state, weights, precision)["gnss"]
    assert found == pytest.approx(np.sqrt(square / number), rel=1e-9)


def test_velocities_of_stills_that_are_not_oriented_are_left_out() -> None:
    gnss = _gnss(_flown(simulate(np.random.default_rng(3), WITH_CONTROL), 0.0))
    assert gnss.velocity_m_s is not None
    block = block_of(len(gnss), SMALL_CAMERA, gnss=gnss)
    chosen = np.array([0, 1, 3, 4, 5, 8])
    kept = network._gnss(block, chosen)
    assert kept is not None
    np.testing.assert_array_equal(kept.velocity_m_s, gnss.velocity_m_s[chosen])
    assert kept.latency_sigma_s == gnss.latency_sigma_s


def test_redundancy_counts_the_latency_and_what_is_known_of_it() -> None:
    block = simulate(np.random.default_rng(7), WITH_CONTROL, start_error=0.1)
    without, with_latency = adjust_block(block.observations, PLAIN), adjust_block(_flown(block, 0.0), PLAIN)
    assert with_latency.redundancy == without.redundancy  # one unknown more, and its a priori observation


def test_impossible_observations_are_refused() -> None:
    block = simulate(np.random.default_rng(8), WITH_CONTROL)
    gnss = _gnss(_flown(block, 0.0))
    assert gnss.velocity_m_s is not None
    with pytest.raises(ValueError, match="needs velocity"):
        replace(gnss, velocity_m_s=None)
    with pytest.raises(ValueError, match="must be > 0"):
        replace(gnss, latency_sigma_s=0.0)
    with pytest.raises(ValueError, match="must be finite"):
        replace(gnss, velocity_m_s=np.full_like(gnss.velocity_m_s, np.nan))
    with pytest.raises(ValueError, match="velocity_m_s has shape"):
        replace(gnss, velocity_m_s=gnss.velocity_m_s[:-1])


def test_observations_with_velocities_are_written_and_read() -> None:
    gnss = _gnss(_flown(simulate(np.random.default_rng(9), WITH_CONTROL), 0.0))
    store = InlineArrays()
    back = decode(GnssObservations, encode(gnss, store), store, "here")
    np.testing.assert_array_equal(back.velocity_m_s, gnss.velocity_m_s)
    assert back.latency_sigma_s == gnss.latency_sigma_s
