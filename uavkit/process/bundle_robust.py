"""Robust weights and rejection in the bundle: a start that gross errors cannot spoil, Tukey's biweight, then a cut.

A ray is judged as a whole by the larger of its two |z|, a GNSS fix or control point by the largest of its three, with
z = v / (s sigma sqrt(r)): r the redundancy number, s the robust scale of the group, which serves the weights only.

Control points fix the datum, so robust weights must not throw it away: they keep Huber's weights until the block has
converged, then go one at a time, the worst first, and as many stay as fix the datum (``LEAST_CONTROL``).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from uavkit.core.adjustment import AdjustmentOptions
from uavkit.core.arrays import Array, Flags
from uavkit.core.progress import Progress, silent
from uavkit.process.bundle_system import (
    Anchor,
    BundleSystem,
    Precision,
    State,
    Weights,
    gauss_newton_step,
    in_chunks,
    local_leverage,
    misclosures,
    precision_at,
)
from uavkit.process.kernels.bundle_intersection import intersect_robustly, refine
from uavkit.process.robust import huber_weight, shrunk_scale, trimmed_scale, tukey_weight

WeightFunction = Callable[[Array], Array]

LEAST_REDUNDANCY = 0.02
"""Redundancy numbers below this say nothing; such residuals are divided by its root."""
TELLING_REDUNDANCY = 0.05
"""Residuals of less redundancy do not count in the scale of their group."""
START_REDUNDANCY = 0.3
"""The same at the start, where residuals without redundancy are not yet small."""
START_STEPS = 40
CAUCHY_C = 2.385
"""Constant of Cauchy's weights in intersections, 95 % efficient (Holland and Welsch 1977)."""
START_C = 6.0
SHRINK = 2.0
"""The scale of the start sinks at most by this factor a step, so that no image is locked out on the way."""
SETTLED = 0.97
"""Scales that no longer sink below this share of what they were have found their level."""
ANCHOR = 0.5
"""Sigma of the approximate orientations at the start, as a share of what the first misclosures amount to."""
FAR_OFF = 50.0
"""A ray rejected at more sigmas than this cannot be the good one that two wrong ones outvoted."""
CONTAMINATED = 0.05
"""Above this share of wrong rays, one point of two rays in ten is wrong, and half of those without a sign of it."""
LEAST_SURE_RAYS = 10
"""An image that would keep fewer rays keeps its doubtful points."""
TUKEY_ROUNDS = 8
STILL = 0.01
"""Steps whose unknowns change by less than this many of their sigmas, RMS, need no other before weights are renewed."""
SETTLED_SHARE = 1e-3
"""Robust weights are settled where no more than this share of them still changes by 0.05."""
HUBER_K = 1.345
LEAST_GAIN = 1.0
"""A control point is not moved to another place for less than this of Cauchy cost, which near misses may make up."""
LEAST_CONTROL = 3
"""So many control points fix the datum without trust in GNSS; the cut leaves at least these, or all of fewer."""
MOST_CONTROL_SCALE = 2.0
"""Control counts at its stated sigmas, twice these at most: a group so small would hide a wrong point in its scale."""
CHI_SHARE = 0.9
"""The root of chi-square with 3 degrees of freedom, times this, passes 4 as rarely as the largest of three |z| does."""
REJECTION_ROUNDS = 14
RETURNING_ROUNDS = 6
"""Rounds in which rejected observations may come back; later ones only reject, so that the rounds end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalised:
    """v / (sigma sqrt(r)) of rays (k, 2), GNSS fixes (g, 3), control points (c, 3); the variances r, or 1 + h."""

    z: tuple[Array, Array, Array]
    variance: tuple[Array, Array, Array]

    @property
    def largest(self) -> tuple[Array, Array, Array]:
        """Return the largest |z| of each ray, fix and control point; NaN where it cannot be told."""
        rays, gnss, control = (np.max(np.abs(z), axis=1, initial=0.0) for z in self.z)
        return rays, gnss, control

    def scale(self, group: int) -> float:
        """Return the robust scale of a group: 0 rays, 1 GNSS, 2 control; drawn towards 1 in a small one."""
        z, variance = self.z[group], self.variance[group]
        telling = z[(variance > TELLING_REDUNDANCY) & np.isfinite(z)]
        redundancy = float(np.sum(np.minimum(variance, 1.0)[np.isfinite(z)]))
        return shrunk_scale(trimmed_scale(telling, 5.0), redundancy) if telling.size else 1.0

    @property
    def scales(self) -> tuple[float, float, float]:
        """Return the scales of rays, GNSS and control."""
        return self.scale(0), self.scale(1), self.scale(2)

    @property
    def trusted_scales(self) -> tuple[float, float, float]:
        """Return the scales, that of control not above ``MOST_CONTROL_SCALE``."""
        return self.scale(0), self.scale(1), min(self.scale(2), MOST_CONTROL_SCALE)


def normalised(
    system: BundleSystem,
    state: State,
    weights: Weights,
    leverages: tuple[Array, Array, Array],
    least_redundancy: float = LEAST_REDUNDANCY,
) -> Normalised:
    """Return normalised residuals; ``leverages`` (variance of adjusted over observed) belong to ``weights``.

    The variance of a residual is 1 - h at full weight and 1 + h of an observation that took no part.
    """
    found, given = misclosures(system, state), system.given
    residuals = (found.rays_px, found.gnss_m, found.control_m)
    sigmas = (
        system.rays.sigma_px,
        np.ones((0, 3)) if given.gnss is None else given.gnss.sigma_m,
        np.ones((0, 3)) if given.control is None else given.control.sigma_m,
    )
    z, variances = [], []
    for residual, sigma, leverage, weight, scale in zip(
        residuals, sigmas, leverages, (weights.rays, weights.gnss, weights.control), weights.scales, strict=True
    ):
        squared = np.broadcast_to(np.asarray(scale) ** 2, weight.shape)[:, None]
        variance = 1.0 + leverage / squared * (1.0 - 2.0 * squared * weight[:, None])
        variances.append(np.maximum(variance, least_redundancy))
        z.append(residual / (sigma * np.sqrt(variances[-1])))
    return Normalised(z=(z[0], z[1], z[2]), variance=(variances[0], variances[1], variances[2]))


def _leverages(precision: Precision) -> tuple[Array, Array, Array]:
    return precision.ray_leverage, precision.gnss_leverage, precision.control_leverage


def _weighted(
    system: BundleSystem,
    found: Normalised,
    scales: tuple[Array | float, float, float],
    functions: tuple[WeightFunction, WeightFunction, WeightFunction],
) -> Weights:
    """Return weight functions, of rays, GNSS and control, at the residuals over their scales."""
    full, largest = system.full_weights(), found.largest
    parts = [
        np.nan_to_num(function(values / scale), nan=0.0) * part / np.asarray(scale) ** 2
        for function, values, scale, part in zip(
            functions,
            largest,
            scales,
            (full.rays, full.gnss, full.control),
            strict=True,
        )
    ]
    return Weights(rays=parts[0], gnss=parts[1], control=parts[2], scales=scales)


def lost_points(system: BundleSystem, weights: Weights) -> Flags:
    """Return which points (m,) have less than one and a half rays' weight left; of control points, less than half."""
    full = np.broadcast_to(np.asarray(weights.scales[0]) ** -2.0, weights.rays.shape)
    number = len(system.rays.start) - 1
    share = np.bincount(system.point_of_ray, weights.rays / full, minlength=number).astype(np.float64)
    if system.given.control is not None and system.uses_control:
        share = share + np.isin(np.arange(len(share)), system.given.control.point_index[weights.control > 0.0])
    return np.asarray(share < 1.5)


def reintersected(system: BundleSystem, state: State, scale: Array | float, lost: Flags) -> State:
    """Return a state in which lost points and those with misclosures above 2 scales are intersected anew, robustly.

    So neither a gross error nor a bad approximate point locks good rays out. The scale is one, or one for each ray.
    """
    z = np.max(np.abs(misclosures(system, state).rays_px / system.rays.sigma_px), axis=1)
    suspicious = lost.copy()
    suspicious[system.point_of_ray[~(z <= 2.0 * np.asarray(scale))]] = True
    suspicious |= ~np.isfinite(state.points[:, 0])
    points = state.points.copy()
    of_point = np.ones(len(points))
    np.maximum.at(of_point, system.point_of_ray, CAUCHY_C * np.broadcast_to(scale, z.shape))

    def work(first: int, last: int) -> None:
        intersect_robustly(system.rays, state.unknowns, suspicious, of_point, first, last, points)

    list(in_chunks(system, work))
    _let_control_speak(system, state, of_point, points)
    return replace(state, points=points)


def _let_control_speak(system: BundleSystem, state: State, scales: Array, points: Array) -> None:
    """Move control points to where their surveyed place and their rays together have the smaller Cauchy cost.

    Two wrong rays may meet as well as two right ones do; the survey tells them apart, and it is one voice among them.
    """
    control, start = system.given.control, system.rays.start
    if control is None or not system.uses_control:
        return
    for p, surveyed, sigma in zip(control.point_index, control.position_m, control.sigma_m, strict=True):
        first, last, scale, costs = int(start[p]), int(start[p + 1]), float(scales[p]), []
        candidates = (np.array(points[p]), np.array(surveyed, dtype=np.float64))
        for candidate in candidates:
            cost = refine(system.rays, state.unknowns, first, last, scale, candidate, np.empty(last - first))
            off = float(np.sum(((candidate - surveyed) / (sigma * scale)) ** 2))
            costs.append(cost + np.log1p(off) if np.isfinite(off) else np.inf)
        if costs[1] < costs[0] - LEAST_GAIN:
            points[p] = candidates[1]


def revived(system: BundleSystem, weights: Weights) -> Weights:
    """Return weights in which points of less than one and a half rays' weight count with all their rays.

    Otherwise a point once lost would have no residuals that could bring it back.
    """
    full = np.broadcast_to(np.asarray(weights.scales[0]) ** -2.0, weights.rays.shape)
    lost = lost_points(system, weights)[system.point_of_ray]
    return replace(weights, rays=np.where(lost, full, weights.rays))


def with_lost_points(system: BundleSystem, state: State, weights: Weights) -> tuple[State, Weights]:
    """Return state and weights in which lost points have another chance; control points that are not stay in place."""
    lost = lost_points(system, weights)
    points = reintersected(system, state, 1.0, lost).points
    if system.given.control is not None and system.uses_control:
        kept = system.given.control.point_index[~lost[system.given.control.point_index]]
        points[kept] = state.points[kept]
    return replace(state, points=points), revived(system, weights)


def robust_start(system: BundleSystem, state: State) -> tuple[State, Weights]:
    """Return a first solution from approximate values that may be bad, amid gross errors that may be many.

    The approximate orientations count as observations; the scale, of each image its own, starts at the size of the
    first misclosures and sinks step by step; points are intersected anew in each step. Redundancy numbers take the
    orientations as fixed here: what counts is that a ray of a point of few rays has a small residual whatever its
    error.
    """
    weights, damping = system.full_weights(), 1e-4
    anchored, scales, last_size = system, np.zeros(0), np.inf
    for number in range(START_STEPS):
        lost, weights = lost_points(system, weights), revived(system, weights)
        leverages = local_leverage(system, state, weights)
        found = normalised(system, state, weights, leverages, START_REDUNDANCY)
        before, scales = scales, image_scales(system, found, scales)
        by_ray = ray_scales(system, scales)
        state = reintersected(system, state, by_ray, lost)
        if number == 0:
            anchored = replace(system, anchor=_anchor(system, state, float(np.median(scales))))
        found = normalised(system, state, weights, leverages, START_REDUNDANCY)
        _, gnss, control = found.scales
        huber = partial(huber_weight, k=HUBER_K)
        functions = partial(tukey_weight, c=START_C), huber, huber
        weights = _weighted(system, found, (by_ray, gnss, control), functions)
        step = gauss_newton_step(anchored, state, weights, damping)
        state, damping = step.state, step.damping
        settled = float(np.max(scales)) <= 1.5 or (before.size > 0 and bool(np.all(scales > SETTLED * before)))
        # In a large block weights go on flipping between two states: steps that no longer shrink are the end, too.
        if settled and (step.size < 3.0 or step.size > 0.8 * last_size):
            break
        last_size = step.size
    return state, weights


def image_scales(system: BundleSystem, found: Normalised, before: Array) -> Array:
    """Return the robust scale of each image's rays, (n,): at least 1, and not below half of what it was before."""
    whole, z, telling = found.scale(0), found.z[0], found.variance[0] > TELLING_REDUNDANCY
    telling &= np.isfinite(z)
    result = np.full(len(system.given.projection_centres_m), whole)
    order = np.argsort(system.rays.image, kind="stable")
    bounds = np.searchsorted(system.rays.image[order], np.arange(len(result) + 1))
    for image in range(len(result)):
        rows = order[bounds[image] : bounds[image + 1]]
        own = z[rows][telling[rows]]
        if own.size >= 6:
            result[image] = trimmed_scale(own, 5.0)
    if before.size:
        result = np.maximum(result, before / SHRINK)
    return np.asarray(np.maximum(result, 1.0))


def ray_scales(system: BundleSystem, scales: Array) -> Array:
    """Return for each ray the largest scale of the images that see its point, (k,)."""
    of_point = np.ones(len(system.rays.start) - 1)
    np.maximum.at(of_point, system.point_of_ray, scales[system.rays.image])
    return of_point[system.point_of_ray]


def _anchor(system: BundleSystem, state: State, scale: float) -> Anchor:
    """Return the approximate orientations as observations whose sigma suits first misclosures of this scale."""
    sigma_px = ANCHOR * scale * float(np.median(system.rays.sigma_px))
    c = float(np.median(state.interior[:, 0]))
    distance = state.points[system.point_of_ray] - state.centres[system.rays.image]
    distance_m = float(np.nanmedian(np.linalg.norm(distance, axis=1)))
    return Anchor(
        centres=state.centres, rotations=state.rotations, sigma_m=sigma_px / c * distance_m, sigma_rad=sigma_px / c
    )


def _stepped(system: BundleSystem, state: State, weights: Weights, damping: float) -> tuple[State, float]:
    """Return the state after up to four steps at fixed weights, and the damping."""
    unknowns = 6 * len(state.centres) + 3 * len(state.points)
    for _ in range(4):
        step = gauss_newton_step(system, state, weights, damping)
        state, damping = step.state, step.damping
        if step.size < STILL * np.sqrt(unknowns):
            break
    return state, damping


def tukey_solution(
    system: BundleSystem, state: State, weights: Weights, options: AdjustmentOptions, progress: Progress = silent
) -> tuple[State, Weights]:
    """Return the solution with Tukey's weights, redundancy numbers and scales renewed in each round."""
    tukey, huber = partial(tukey_weight, c=options.tukey_c), partial(huber_weight, k=HUBER_K)
    # The start held the orientations to their approximations: only without that are residuals as small as their
    # redundancy numbers say, which matters most to the few control points that fix the datum.
    state, damping = _stepped(system, state, weights, 0.0)
    for number in range(TUKEY_ROUNDS):
        progress("bundle block adjustment: robust weights", number, TUKEY_ROUNDS)
        lost, last, weights = lost_points(system, weights), weights, revived(system, weights)
        leverages = _leverages(precision_at(system, state, weights))
        state = reintersected(system, state, normalised(system, state, weights, leverages).scale(0), lost)
        found = normalised(system, state, weights, leverages)
        weights = _weighted(system, found, found.trusted_scales, (tukey, tukey, huber))
        state, damping = _stepped(system, state, weights, damping)
        if number > 1 and np.mean(np.abs(weights.rays - last.rays) > 0.05) < SETTLED_SHARE:
            break
    return state, weights


def cut_weights(system: BundleSystem, state: State, weights: Weights, precision: Precision, rule: "CutRule") -> Weights:
    """Return weights of 1 within and 0 beyond the cut; of a point's used rays only the worst goes at once."""
    found = normalised(system, state, weights, _leverages(precision))
    scales = found.trusted_scales
    rays, gnss = (values / scale for values, scale in zip(found.largest[:2], scales[:2], strict=True))
    control = control_tests(system, found, weights, precision) / scales[2]
    full, used = system.full_weights(), weights.rays > 0.0
    inside = rays <= rule.reject_above
    magnitude = np.where(used, np.nan_to_num(rays, nan=np.inf), 0.0)
    kept = kept_control(system, weights, (control, magnitude), rule)
    if np.any((weights.control == 1.0) & ~kept):
        return replace(weights, control=full.control * kept)
    worst, gross = np.zeros(len(system.rays.start) - 1), np.full(len(system.rays.start) - 1, rule.gross_above)
    _judge_control_before_rays(system, np.where(weights.control > 0.0, control, 0.0), rule, (worst, gross))
    np.maximum.at(worst, system.point_of_ray, magnitude)
    spared = used & (magnitude < worst[system.point_of_ray]) & (magnitude < gross[system.point_of_ray])
    keep = used & (inside | spared)
    if rule.may_return:
        keep |= inside
    return Weights(
        rays=keep.astype(np.float64),
        gnss=full.gnss * (gnss <= rule.reject_above) * (rule.may_return | (weights.gnss > 0.0)),
        control=full.control * kept,
    )


def _judge_control_before_rays(
    system: BundleSystem, control: Array, rule: "CutRule", limits: tuple[Array, Array]
) -> None:
    """Raise the limits (m,), worst |z| and gross, of points whose control disagrees: their rays wait for its fate.

    Otherwise a wrong control point would hold its place and cast off its rays, and look faultless without them.
    """
    given = system.given.control
    if given is None or not system.uses_control:
        return
    worst, gross = limits
    disagrees = ~(control <= rule.reject_above)
    np.maximum.at(worst, given.point_index, np.nan_to_num(control, nan=np.inf))
    gross[given.point_index[disagrees]] = np.inf


def control_tests(system: BundleSystem, found: Normalised, weights: Weights, precision: Precision) -> Array:
    """Return sqrt(v' Q_vv^-1 v) of each control point (c,), reduced to be read like the largest |z| of three.

    Unlike single coordinates this statistic is largest for the wrong one of several points, however much it bends the
    block (Baarda 1968; Foerstner 1987).
    """
    given = system.given.control
    if given is None or not system.uses_control:
        return np.zeros(len(weights.control))
    z = found.z[2] * np.sqrt(found.variance[2])
    sigma = given.sigma_m[:, :, None] * given.sigma_m[:, None, :]
    taken = np.where(weights.control > 0.0, -1.0, 1.0)[:, None, None]
    variance = np.eye(3) + taken * np.nan_to_num(precision.point_covariances_m2[given.point_index]) / sigma
    values, vectors = np.linalg.eigh(variance)
    along = np.einsum("cji,cj->ci", vectors, z)
    return np.asarray(CHI_SHARE * np.sqrt(np.sum(along**2 / np.maximum(values, LEAST_REDUNDANCY), axis=1)))


def kept_control(system: BundleSystem, weights: Weights, tests: tuple[Array, Array], rule: "CutRule") -> Flags:
    """Return which control points (c,) stay: all but the worst beyond the cut, and enough for the datum.

    One at a time, for a wrong control point bends the block and spoils the residuals of the right ones; and not while
    one of its own rays, (k,), is worse.
    """
    given = system.given.control
    z, of_rays = tests
    if given is None or not system.uses_control:
        return np.zeros(len(z), dtype=np.bool_)
    inside, used, points = z <= rule.reject_above, weights.control > 0.0, len(system.rays.start) - 1
    keep = used | inside if rule.may_return else used
    worst = np.zeros(points)
    np.maximum.at(worst, system.point_of_ray, of_rays)
    seen = np.bincount(system.point_of_ray, weights.rays > 0.0, minlength=points)[given.point_index]
    held = keep & (seen > 0)
    bad = held & used & ~inside & ~(worst[given.point_index] > z)
    if np.any(bad) and np.count_nonzero(held) > min(rule.least_control, len(z)):
        keep = keep & (np.arange(len(z)) != int(np.argmax(np.where(bad, np.nan_to_num(z, nan=np.inf), -1.0))))
    return np.asarray(keep)


@dataclass(frozen=True, slots=True, kw_only=True)
class CutRule:
    """Beyond which |z| an observation is left out, and whether those left out may come back."""

    reject_above: float
    may_return: bool
    gross_above: float = np.inf
    """Beyond this an observation goes at once, even if another of its point is worse."""
    least_control: int = LEAST_CONTROL
    """So many control points stay, or all of fewer."""


def without_unchecked(system: BundleSystem, state: State, weights: Weights) -> Weights:
    """Return weights without those points that lost rays and have two left, unless they are control points.

    Of three rays any two may agree, and if two of them are wrong in the same way it is the good one that is rejected;
    with two left nothing shows it. Rays lost far off do not count: that two of those agree is hardly possible.
    Where such errors are many (``is_contaminated``), a point of two rays is not believed even if it lost none, for
    errors along the epipolar line do not show there; nor one that the rays it lost nearly outvote.
    """
    points = len(system.rays.start) - 1
    left = np.bincount(system.point_of_ray, weights.rays > 0.0, minlength=points)
    z = np.max(np.abs(misclosures(system, state).rays_px / system.rays.sigma_px), axis=1)
    near = np.bincount(system.point_of_ray, (weights.rays == 0.0) & ~(z > FAR_OFF), minlength=points)
    unchecked = (left < 3) & (near > 0)
    if is_contaminated(system, state, weights):
        doubtful = (left < 3) | (left < near + 2)
        unchecked |= doubtful & ~_needed(system, weights, doubtful)
    if system.given.control is not None and system.uses_control:
        unchecked[system.given.control.point_index[weights.control > 0.0]] = False
    return replace(weights, rays=weights.rays * ~unchecked[system.point_of_ray])


def wrong_share(system: BundleSystem, state: State, weights: Weights) -> float:
    """Return the share of rays rejected, but not far off, in points of at least three: those whose errors show."""
    testable = np.repeat(np.diff(system.rays.start) >= 3, np.diff(system.rays.start))
    z = np.max(np.abs(misclosures(system, state).rays_px / system.rays.sigma_px), axis=1)
    wrong = (weights.rays == 0.0) & (z <= FAR_OFF)
    return float(np.mean(wrong[testable])) if np.any(testable) else 0.0


def is_contaminated(system: BundleSystem, state: State, weights: Weights) -> bool:
    """Tell whether so many rays are wrong by little that points of two rays cannot be believed."""
    return wrong_share(system, state, weights) > CONTAMINATED


def _needed(system: BundleSystem, weights: Weights, doubtful: Flags) -> Flags:
    """Return which points (m,) are seen by images that would keep too few rays without the doubtful ones."""
    sure = (weights.rays > 0.0) & ~doubtful[system.point_of_ray]
    rays = np.bincount(system.rays.image, sure, minlength=len(system.given.projection_centres_m))
    needed = np.zeros(len(doubtful), dtype=np.bool_)
    needed[system.point_of_ray[(rays < LEAST_SURE_RAYS)[system.rays.image] & (weights.rays > 0.0)]] = True
    return needed


def notes_on_rejection(system: BundleSystem, state: State, weights: Weights, rounds: int) -> tuple[str, ...]:
    """Return in words what the user should know of the rejection."""
    notes = []
    if is_contaminated(system, state, weights):
        left = np.bincount(system.point_of_ray, weights.rays > 0.0, minlength=len(system.rays.start) - 1)
        given = np.diff(system.rays.start)
        notes.append(
            f"{100 * wrong_share(system, state, weights):.0f} % of the rays that can be checked are rejected; "
            f"{np.count_nonzero((given == 2) & (left == 0))} of {np.count_nonzero(given == 2)} points of two rays, "
            "where errors may not show, are left out"
        )
    if rounds >= REJECTION_ROUNDS:
        notes.append(f"the rejection of observations had not settled after {rounds} rounds")
    return tuple(notes)


def same(a: Weights, b: Weights) -> bool:
    """Tell whether two sets of weights are equal."""
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("rays", "gnss", "control"))


def used_rays(system: BundleSystem, weights: Weights, determined: Flags) -> Flags:
    """Return which rays (sorted order) have weight and a determined point."""
    return np.asarray((weights.rays > 0.0) & determined[system.point_of_ray])
