"""The bundle block adjustment: least squares of all observations of a block, robust, with the precision of its results.

Method: Brown (1958, 1976); M-estimation by Tukey's biweight, a cut at ``reject_above``, and a last pass at the sigmas
stated beforehand, from which sigma0 and all covariances come.
"""

from typing import TypeVar

import numpy as np

from uavkit.core.adjustment import AdjustmentInput, AdjustmentOptions, AdjustmentResult, Datum
from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.camera import INTERIOR_PARAMETERS
from uavkit.core.errors import AdjustmentError
from uavkit.core.progress import Progress, silent
from uavkit.process.bundle_robust import (
    REJECTION_ROUNDS,
    RETURNING_ROUNDS,
    CutRule,
    cut_weights,
    notes_on_rejection,
    robust_start,
    same,
    tukey_solution,
    used_rays,
    with_lost_points,
    without_unchecked,
)
from uavkit.process.bundle_system import (
    BundleSystem,
    Precision,
    State,
    Step,
    Weights,
    build_system,
    gauss_newton_step,
    joint_covariance,
    misclosures,
    precision_at,
)
from uavkit.process.precision import group_sigma0, interior_covariances, total_redundancy, weighted_square_sum
from uavkit.process.robust import cut_variance

Values = TypeVar("Values", Array, Flags)
UNDETERMINED_SHARE = 0.9
GOOD_GAIN = 0.25
"""Of a step that was about right: the next one may be damped less."""
POOR_GAIN = 0.1
"""Steps of a gain below this were much too long: damping grows although they lessened the sum of squares."""


def adjust_block(
    observations: AdjustmentInput,
    options: AdjustmentOptions | None = None,
    *,
    joint_points: Indices | None = None,
    progress: Progress = silent,
) -> AdjustmentResult:
    """Adjust a block: see ``AdjustmentInput``, ``AdjustmentOptions`` and ``AdjustmentResult``.

    Raises AdjustmentError where the observations do not determine the unknowns, saying which; UndeterminedError, with
    the rays that were left, where they did before robust weights were found.
    """
    options = options or AdjustmentOptions()
    datum = options.datum or choose_datum(observations)
    check_input(observations, datum)
    system = build_system(observations, datum, options.default_shift_sigma_m)
    state, weights = system.start(), system.full_weights()
    rounds = 0
    if options.robust:
        state, weights = robust_start(system, state)
        state, weights = tukey_solution(system, state, weights, options, progress)
        # Wide at first: what took no part so far is judged by redundancy numbers that are only nearly right.
        wide = max(options.tukey_c, options.reject_above)
        # Control is not judged before the block has converged with all of it at full weight.
        every = system.full_weights().control.size
        rule = CutRule(reject_above=wide, may_return=True, gross_above=wide, least_control=every)
        state, weights = with_lost_points(system, state, weights)
        weights = cut_weights(system, state, weights, precision_at(system, state, weights), rule)
    while True:
        state, iterations, converged = solve(system, state, weights, options)
        precision = precision_at(system, state, weights)
        rounds += 1
        if not options.robust or rounds >= REJECTION_ROUNDS:
            break
        rule = CutRule(reject_above=options.reject_above, may_return=rounds < RETURNING_ROUNDS)
        next_weights = cut_weights(system, state, weights, precision, rule)
        if same(next_weights, weights):
            next_weights = without_unchecked(system, state, weights)
            if same(next_weights, weights):
                break
            rounds = max(rounds, RETURNING_ROUNDS)
        weights = next_weights
        progress("bundle block adjustment: rejection", rounds, REJECTION_ROUNDS)
    notes = notes_on_rejection(system, state, weights, rounds) if options.robust else ()
    return _result(system, state, weights, precision, _Run(options, iterations, converged, joint_points, notes))


def choose_datum(observations: AdjustmentInput) -> Datum:
    """Return CONTROL with at least 3 control points (or 1 beside GNSS), else GNSS with 3 fixes, else FREE_NETWORK."""
    control = 0 if observations.control is None else len(np.unique(observations.control.point_index))
    fixes = 0 if observations.gnss is None else len(observations.gnss)
    if control >= 3 or (control >= 1 and fixes >= 3):
        return Datum.CONTROL
    return Datum.GNSS if fixes >= 3 else Datum.FREE_NETWORK


def check_input(observations: AdjustmentInput, datum: Datum) -> None:
    """Raise AdjustmentError where images or the datum lack observations."""
    rays, images = observations.rays, len(observations.projection_centres_m)
    shared = np.bincount(rays.point_index, minlength=len(observations.points_m)) >= 2
    if observations.control is not None and datum is not Datum.FREE_NETWORK:
        shared[observations.control.point_index] = True
    count = np.bincount(rays.image_index[shared[rays.point_index]], minlength=images)
    poor = np.flatnonzero(count < 3)
    if len(poor):
        listed = ", ".join(f"image {i} ({count[i]})" for i in poor[:5])
        raise AdjustmentError(
            f"{len(poor)} image(s) have fewer than 3 rays to points that others see too: {listed}; leave them out"
        )
    if datum is Datum.CONTROL and (observations.control is None or len(observations.control) == 0):
        raise AdjustmentError("the datum is to be fixed by control points, but there is none")
    if datum is Datum.GNSS and (observations.gnss is None or len(observations.gnss) < 3):
        raise AdjustmentError("the datum is to be fixed by GNSS, but there are fewer than 3 fixes")


def solve(system: BundleSystem, state: State, weights: Weights, options: AdjustmentOptions) -> tuple[State, int, bool]:
    """Iterate Gauss-Newton steps at fixed weights; return the state, the number of steps and whether it converged."""
    damping = 0.0 if options.robust else 1e-4
    for number in range(1, options.most_iterations + 1):
        step = gauss_newton_step(system, state, weights, damping)
        state = step.state
        if step.size < options.convergence:
            return state, number, True
        damping = next_damping(step)
    return state, options.most_iterations, False


def next_damping(step: Step) -> float:
    """Return the damping of the step after this one: less where the last one did what it promised.

    Levenberg-Marquardt's rule (Marquardt 1963) with the gain of the step as its measure (Nielsen 1999).
    """
    if step.damping == 0.0 or step.gain > GOOD_GAIN:
        return step.damping
    used = 10.0 * step.damping
    return used if step.gain > POOR_GAIN else 10.0 * used


class _Run:
    """What the result tells of the run."""

    __slots__ = ("converged", "iterations", "joint_points", "notes", "options")

    def __init__(
        self,
        options: AdjustmentOptions,
        iterations: int,
        converged: bool,
        joint: Indices | None,
        notes: tuple[str, ...],
    ) -> None:
        self.options, self.iterations, self.converged = options, iterations, converged
        self.notes = notes
        if not converged:
            self.notes += (f"the adjustment had not converged after {iterations} steps: its results are provisional",)
        self.joint_points = np.zeros(0, dtype=np.int64) if joint is None else np.asarray(joint, dtype=np.int64)


def _unsorted(system: BundleSystem, values: Values) -> Values:
    """Return values of sorted rays in the order of the input."""
    result = np.empty_like(values)
    result[system.order] = values
    return result


def _notes_on_latency(system: BundleSystem, sigma_s: Array) -> tuple[str, ...]:
    """Return in words which flights do not determine their latency."""
    return tuple(
        f"the latency of the positions of flight {flight + 1} is not determined (sigma {after:.2g} s, a priori "
        f"{before:.2g} s): velocities must vary, as on strips flown to and fro"
        for flight, (after, before) in enumerate(zip(sigma_s, system.latency_sigma_s, strict=True))
        if after > UNDETERMINED_SHARE * before
    )


def _result(system: BundleSystem, state: State, weights: Weights, precision: Precision, run: _Run) -> AdjustmentResult:
    determined, given = precision.determined, system.given
    used = used_rays(system, weights, determined)
    points = np.where(determined[:, None], state.points, np.nan)
    found = misclosures(system, state)
    residuals = np.where(determined[system.point_of_ray][:, None], found.rays_px, np.nan)
    square_sum, redundancy = (
        weighted_square_sum(system, state, weights, determined),
        total_redundancy(system, weights, determined),
    )
    if redundancy <= 0:
        raise AdjustmentError(f"the block has no redundancy ({redundancy:.0f}): sigma0 cannot be told")
    cut = cut_variance(run.options.reject_above) if run.options.robust else 1.0
    interiors = interior_covariances(system, precision)
    sigmas, prior = np.sqrt(np.einsum("gkk->gk", interiors)).max(axis=0), given.interior_sigmas.values()
    q, last = system.shared, system.first_latency
    shift_covariance = precision.inverse.corner[q:last, q:last].reshape(len(state.shifts), 3, len(state.shifts), 3)
    latency_sigma_s = np.sqrt(np.diag(precision.inverse.corner)[last:])
    return AdjustmentResult(
        interior=given.interior.with_parameters(state.interior[0]),
        interior_covariance=interiors[0],
        interiors=tuple(
            interior.with_parameters(values)
            for interior, values in zip(given.interiors or (given.interior,), state.interior, strict=True)
        ),
        interior_covariances=interiors,
        undetermined_interior=tuple(
            name
            for name, after, before in zip(INTERIOR_PARAMETERS, sigmas, prior, strict=True)
            if before > 0 and after > UNDETERMINED_SHARE * before
        ),
        projection_centres_m=state.centres,
        R_object_from_image=state.rotations,
        exterior_covariances=np.ascontiguousarray(precision.inverse.blocks[system.pattern.diagonal, :6, :6]),
        points_m=points,
        point_covariances_m2=precision.point_covariances_m2,
        ray_used=_unsorted(system, used),
        ray_residuals_px=_unsorted(system, residuals),
        ray_redundancy=_unsorted(system, np.where(used[:, None], 1.0 - precision.ray_leverage, np.nan)),
        gnss_used=weights.gnss > 0.0,
        gnss_residuals_m=found.gnss_m,
        gnss_shift_m=state.shifts,
        gnss_shift_covariance_m2=np.einsum("fafb->fab", shift_covariance),
        gnss_latency_s=state.latencies,
        gnss_latency_sigma_s=latency_sigma_s,
        control_used=weights.control > 0.0,
        control_residuals_m=found.control_m,
        sigma0=float(np.sqrt(square_sum / redundancy / cut)),
        redundancy=redundancy,
        group_sigma0=group_sigma0(system, state, weights, precision),
        datum=system.datum,
        iterations=run.iterations,
        converged=run.converged,
        joint_points=run.joint_points,
        notes=run.notes + _notes_on_latency(system, latency_sigma_s),
        joint_covariance_m2=joint_covariance(system, state, weights, precision.factor, run.joint_points),
    )
