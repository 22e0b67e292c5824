"""Robust weights and rejection in the bundle: Huber to start, Tukey's biweight, then a cut and full weights.

A ray is judged as a whole by the larger of its two |z|, a GNSS fix or control point by the largest of its three, with
z = v / (s sigma sqrt(r)): r the redundancy number, s the robust scale of the group, which serves the weights only.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from uavkit.core.adjustment import AdjustmentOptions
from uavkit.core.arrays import Array, Flags
from uavkit.core.progress import Progress, silent
from uavkit.process.bundle_system import (
    BundleSystem,
    Precision,
    State,
    Weights,
    gauss_newton_step,
    in_chunks,
    misclosures,
    precision_at,
)
from uavkit.process.kernels.bundle_intersection import intersect_robustly
from uavkit.process.robust import huber_weight, shrunk_scale, trimmed_scale, tukey_weight

WeightFunction = Callable[[Array], Array]

LEAST_REDUNDANCY = 1e-3
"""Redundancy numbers below this say nothing; such residuals are divided by its root."""
HUBER_STEPS = 20
TUKEY_ROUNDS = 6
REJECTION_ROUNDS = 12
RETURNING_ROUNDS = 5
"""Rounds in which rejected observations may come back; later ones only reject, so that the rounds end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalised:
    """Largest |z| of each ray (k,), GNSS fix (g,) and control point (c,), before division by the group's scale."""

    rays: Array
    gnss: Array
    control: Array
    scales: tuple[float, float, float]


def normalised(system: BundleSystem, state: State, weights: Weights, precision: Precision | None) -> Normalised:
    """Return normalised residuals and the scale of each group; without precision all redundancy numbers count as 1."""
    found, given = misclosures(system, state), system.given
    groups = [(found.rays_px, system.rays.sigma_px, weights.rays)]
    if given.gnss is not None:
        groups.append((found.gnss_m, given.gnss.sigma_m, weights.gnss))
    else:
        groups.append((np.zeros((0, 3)), np.ones((0, 3)), np.zeros(0)))
    if given.control is not None:
        groups.append((found.control_m, given.control.sigma_m, weights.control))
    else:
        groups.append((np.zeros((0, 3)), np.ones((0, 3)), np.zeros(0)))
    leverages: list[Array | None] = [None, None, None]
    if precision is not None:
        leverages = [precision.ray_leverage, precision.gnss_leverage, precision.control_leverage]
    largest, scales = [], []
    for (residual, sigma, weight), leverage in zip(groups, leverages, strict=True):
        variance = np.ones_like(residual)
        if leverage is not None:
            # Of a linear estimate: 1 - h at full weight, 1 + h of an observation that took no part.
            variance = np.maximum(1.0 + leverage * (1.0 - 2.0 * weight[:, None]), LEAST_REDUNDANCY)
        z = residual / (sigma * np.sqrt(variance))
        telling = z[variance > 0.05] if leverage is not None else z
        redundancy = float(np.sum(np.minimum(variance, 1.0)[np.isfinite(z)]))
        scales.append(shrunk_scale(trimmed_scale(telling, 5.0), redundancy) if telling.size else 1.0)
        largest.append(np.max(np.abs(z), axis=1, initial=0.0))
    return Normalised(rays=largest[0], gnss=largest[1], control=largest[2], scales=(scales[0], scales[1], scales[2]))


def _weights(system: BundleSystem, z: Normalised, function: WeightFunction) -> Weights:
    full = system.full_weights()
    parts = [
        np.nan_to_num(function(values / scale), nan=0.0) * part
        for values, scale, part in zip(
            (z.rays, z.gnss, z.control), z.scales, (full.rays, full.gnss, full.control), strict=True
        )
    ]
    return Weights(rays=parts[0], gnss=parts[1], control=parts[2])


def reintersected(system: BundleSystem, state: State, scale: float) -> State:
    """Return a state in which points with misclosures above 3 scales (in sigma) are intersected anew, robustly.

    So neither a gross error nor a bad approximate point locks good rays out.
    """
    z = np.max(np.abs(misclosures(system, state).rays_px / system.rays.sigma_px), axis=1)
    suspicious = np.zeros(len(state.points), dtype=np.bool_)
    suspicious[system.point_of_ray[~(z <= 3.0 * scale)]] = True
    suspicious |= ~np.isfinite(state.points[:, 0])
    if system.given.control is not None and system.uses_control:
        suspicious[system.given.control.point_index] = False
    points = state.points.copy()

    def work(first: int, last: int) -> None:
        intersect_robustly(system.rays, state.unknowns, suspicious, scale, first, last, points)

    list(in_chunks(system, work))
    return replace(state, points=points)


def huber_start(system: BundleSystem, state: State) -> tuple[State, Weights]:
    """Return a first solution with Huber's weights, from approximate values that may be bad."""
    weights, damping = system.full_weights(), 1e-3
    z = normalised(system, state, weights, None)
    state = reintersected(system, state, z.scales[0])
    for number in range(HUBER_STEPS):
        z = normalised(system, state, weights, None)
        if number in (3, 7):
            state = reintersected(system, state, z.scales[0])
            z = normalised(system, state, weights, None)
        weights = _weights(system, z, partial(huber_weight, k=1.345))
        step = gauss_newton_step(system, state, weights, damping)
        state, damping = step.state, step.damping
        if number > 7 and step.size < 0.3:
            break
    return state, weights


def tukey_solution(
    system: BundleSystem, state: State, weights: Weights, options: AdjustmentOptions, progress: Progress = silent
) -> tuple[State, Weights]:
    """Return the solution with Tukey's weights, redundancy numbers and scales renewed in each round."""
    damping = 0.0
    for number in range(TUKEY_ROUNDS):
        progress("bundle block adjustment: robust weights", number, TUKEY_ROUNDS)
        precision = precision_at(system, state, weights)
        z = normalised(system, state, weights, precision)
        state = reintersected(system, state, z.scales[0])
        z = normalised(system, state, weights, precision)
        last, weights = weights, _weights(system, z, partial(tukey_weight, c=options.tukey_c))
        for _ in range(4):
            step = gauss_newton_step(system, state, weights, damping)
            state, damping = step.state, step.damping
            if step.size < 0.1:
                break
        if number > 1 and float(np.max(np.abs(weights.rays - last.rays), initial=0.0)) < 0.02:
            break
    return state, weights


def cut_weights(
    system: BundleSystem, z: Normalised, weights: Weights, options: AdjustmentOptions, may_return: bool
) -> Weights:
    """Return weights of 1 within and 0 beyond ``reject_above``; of a point's used rays only the worst goes at once."""
    full = system.full_weights()
    inside = z.rays / z.scales[0] <= options.reject_above
    used = weights.rays > 0.0
    worst = np.zeros(len(system.rays.start) - 1)
    magnitude = np.where(used, np.nan_to_num(z.rays, nan=np.inf), 0.0)
    np.maximum.at(worst, system.point_of_ray, magnitude)
    keep = used & (inside | (magnitude < worst[system.point_of_ray]))
    if may_return:
        keep |= inside
    rest = [
        ((values / scale <= options.reject_above) & (may_return | (before > 0.0))) * part
        for values, scale, before, part in (
            (z.gnss, z.scales[1], weights.gnss, full.gnss),
            (z.control, z.scales[2], weights.control, full.control),
        )
    ]
    return Weights(rays=keep.astype(np.float64), gnss=rest[0], control=rest[1])


def same(a: Weights, b: Weights) -> bool:
    """Tell whether two sets of weights are equal."""
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("rays", "gnss", "control"))


def used_rays(system: BundleSystem, weights: Weights, determined: Flags) -> Flags:
    """Return which rays (sorted order) have weight and a determined point."""
    return np.asarray((weights.rays > 0.0) & determined[system.point_of_ray])
