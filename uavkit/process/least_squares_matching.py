"""Least squares matching: where a point of one picture lies in another, to a few hundredths of a pixel, with precision.

Model (Ackermann 1984, Gruen 1985): g1(u) + n = h0 + h1 g2(p + W u), six geometric and two radiometric unknowns,
Gauss-Newton, weights falling from the centre; solved in the inverse compositional form of Baker and Matthews (2004),
see kernels.least_squares.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache
from math import ceil

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags
from uavkit.core.errors import InputError
from uavkit.process.kernels import least_squares

Grey = NDArray[np.uint8]

CHUNK = 256
"""Points in one unit of work, whatever the number of workers, so that results do not depend on it."""


class MatchingStatus(IntEnum):
    """What became of a point."""

    OK = least_squares.OK
    LEFT_IMAGE = least_squares.LEFT_IMAGE
    DIVERGED = least_squares.DIVERGED
    LOW_TEXTURE = least_squares.LOW_TEXTURE
    LOW_CORRELATION = least_squares.LOW_CORRELATION
    AFFINE_TOO_LARGE = least_squares.AFFINE_TOO_LARGE
    NOT_RETURNED = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchingOptions:
    """How least squares matching proceeds and what it accepts."""

    window_px: int = 31
    """Side of the square window, odd."""
    weight_sigma: float = 0.5
    """Standard deviation of the Gaussian weights in half windows."""
    most_iterations: int = 15
    shift_iterations: int = 1
    """First iterations that move the window without deforming it: they widen the range of convergence."""
    convergence_px: float = 0.004
    """How far the result may lie from where further iterations would end: the last step times their rate."""
    most_drift_px: float = 4.0
    """Farthest distance from the start before the point counts as diverged."""
    least_gradient: float = 2.0
    """Least root mean square gradient, grey values a pixel, in the direction of weakest texture."""
    least_correlation: float = 0.7
    most_affine_change: float = 0.5
    """Largest change of an element of the warp, in units of its scale; slopes seen from two stations reach 0.4."""
    most_return_miss_px: float = 0.1
    """Used by match_forward_backward: a point whose return misses its start by more is NOT_RETURNED."""

    def __post_init__(self) -> None:
        if self.window_px % 2 == 0 or not 7 <= self.window_px <= 201:
            raise InputError(f"window_px must be odd and between 7 and 201, is {self.window_px}")
        if self.most_iterations <= self.shift_iterations:
            raise InputError("most_iterations must exceed shift_iterations")


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchingResult:
    """One row a point; the numbers of a point whose status is not OK are its last state, or nan."""

    target_px: Array
    """Where the reference point lies in the target, (n, 2)."""
    warps: Array
    """target_from_reference about the point, (n, 2, 2)."""
    gain: Array
    """Contrast of the target over that of the reference, (n,)."""
    offset: Array
    """Grey value of the target where the reference has its window's mean, (n,)."""
    covariance_px2: Array
    """Formal covariance of target_px FOR THE PAIR, (n, 2, 2): sigma_grey^2 (A'WA)^-1 A'W^2 A (A'WA)^-1 / gain^2,
    of uncorrelated grey-value noise, sigma_grey from the residuals (so the noise of both pictures is in it)."""
    sigma_grey: Array
    """Weighted root mean square residual, grey values of the target, (n,)."""
    correlation: Array
    """Weighted correlation coefficient of the two windows, (n,)."""
    iterations: NDArray[np.int64]
    """(n,)."""
    status: NDArray[np.int64]
    """MatchingStatus of each point, (n,)."""

    @property
    def ok(self) -> Flags:
        """True for each point that was matched, (n,)."""
        return np.asarray(self.status == MatchingStatus.OK)


def match_least_squares(
    reference: Grey,
    target: Grey,
    reference_px: Array,
    target_px: Array,
    warps: Array,
    options: MatchingOptions | None = None,
    *,
    workers: int = 1,
) -> MatchingResult:
    """Match each reference point (n, 2) from its start target_px (n, 2) with target_from_reference warps (n, 2, 2).

    The start may be about 2 px off. Reference points may lie between pixels. Results are the same bits with any
    number of workers. Raises InputError where shapes or picture types do not fit.
    """
    chosen = options or MatchingOptions()
    count = _checked_count(reference, target, reference_px, target_px, warps)
    positions = np.array(target_px, np.float64)
    moved_warps = np.array(warps, np.float64)
    results, status = np.full((count, 8), np.nan), np.full(count, MatchingStatus.LEFT_IMAGE, np.int64)
    starts = np.array(reference_px, np.float64)
    fine, coarse = _tables(chosen, 1), _tables(chosen, 2)
    criteria = _criteria(chosen)
    side = _buffer_side(moved_warps, chosen)
    pictures = np.ascontiguousarray(reference), np.ascontiguousarray(target)

    def match(rows: slice) -> None:
        least_squares.match_patches(
            *pictures,
            starts[rows],
            chosen.window_px,
            criteria,
            positions[rows],
            moved_warps[rows],
            results[rows],
            status[rows],
            least_squares.workspace(chosen.window_px, side, fine, coarse),
        )

    in_chunks(match, count, workers)
    covariances = results[:, [4, 5, 5, 6]].reshape(-1, 2, 2)
    return MatchingResult(
        target_px=positions,
        warps=moved_warps,
        gain=results[:, 0],
        offset=results[:, 1],
        covariance_px2=covariances,
        sigma_grey=results[:, 2],
        correlation=results[:, 3],
        iterations=np.nan_to_num(results[:, 7]).astype(np.int64),
        status=status,
    )


def in_chunks(work: Callable[[slice], None], count: int, workers: int) -> None:
    """Call work with slices of CHUNK rows, on workers threads; work must write its own rows only."""
    slices = [slice(begin, min(begin + CHUNK, count)) for begin in range(0, count, CHUNK)]
    if workers <= 1 or len(slices) <= 1:
        for rows in slices:
            work(rows)
        return
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(work, slices))


@dataclass(frozen=True, slots=True, kw_only=True)
class ForwardBackward:
    """A forward match with its return; points that fail either way carry that status."""

    forward: MatchingResult
    """Its status is NOT_RETURNED, or that of the way back, where the way back failed."""
    return_miss_px: Array
    """Where the way back ended, minus the reference point, (n, 2); nan where the forward match failed."""


def match_forward_backward(
    reference: Grey,
    target: Grey,
    reference_px: Array,
    target_px: Array,
    warps: Array,
    options: MatchingOptions | None = None,
    *,
    workers: int = 1,
) -> ForwardBackward:
    """Match forward, then back from where it ended, and flag points whose return misses by most_return_miss_px.

    The way back starts where the way forth ended, with the inverse warp, at the reference point itself.
    """
    chosen = options or MatchingOptions()
    forward = match_least_squares(reference, target, reference_px, target_px, warps, chosen, workers=workers)
    rows = np.flatnonzero(forward.ok)
    starts = np.array(reference_px, np.float64)[rows]
    back_warps = np.asarray(np.linalg.inv(forward.warps[rows]), np.float64)
    backward = match_least_squares(
        target, reference, forward.target_px[rows], starts, back_warps, chosen, workers=workers
    )
    miss = np.full(forward.target_px.shape, np.nan)
    miss[rows] = backward.target_px - starts
    status = forward.status.copy()
    far = np.hypot(*(backward.target_px - starts).T) > chosen.most_return_miss_px
    status[rows] = np.where(backward.ok, np.where(far, MatchingStatus.NOT_RETURNED, status[rows]), backward.status)
    return ForwardBackward(forward=_with_status(forward, status), return_miss_px=miss)


@dataclass(frozen=True, slots=True, kw_only=True)
class RaySigmaOptions:
    """How formal precision becomes the a priori sigma of a ray; the constants are measured on simulated pictures."""

    formal_scale: float = 1.2
    """True over formal standard deviation: 1.1 to 1.3 in rendered stills (noise of 3 to 4 grey values, JPEG quality
    92), across the epipolar line; up to 1.5 on plane ground with JPEG quality 60 to 92, turns up to 30 degrees, scales
    0.75 to 1.3."""
    surface_px: float = 0.01
    """What is left of the pair's error where the formal sigma goes to zero, by the same comparison (0.011 px at 4 and
    at 18 mm on the ground). Relief within the window is not in it: it moves all rays of a point alike, so that they
    meet where the window sees the ground on average, 0.1 to 0.2 pixels on the ground above or below its centre."""
    miss_scale: float = 0.3
    """Share of the return miss. Pairs of stills with misses of 0.013 and of 0.032 px had the same true errors."""
    fallback_miss_px: float = 0.015
    """Standard deviation of the return miss in a class of too few points."""
    least_class_size: int = 30


def texture_angle_classes(result: MatchingResult) -> NDArray[np.int64]:
    """Class 0 to 5 of each point, (n,): formal sigma in three parts, doubled for windows turned, scaled or sheared.

    Points without a match are -1.
    """
    largest = np.sqrt(np.trace(result.covariance_px2, axis1=1, axis2=2))
    classes = np.full(len(largest), -1, np.int64)
    if not result.ok.any():
        return classes
    limits = np.quantile(largest[result.ok], [1 / 3, 2 / 3])
    texture = np.searchsorted(limits, largest[result.ok])
    deformed = np.abs(result.warps - np.eye(2)).max(axis=(1, 2)) > 0.05
    classes[result.ok] = texture + 3 * deformed[result.ok]
    return classes


def ray_sigma(
    result: MatchingResult,
    return_miss_px: Array,
    classes: NDArray[np.int64] | None = None,
    options: RaySigmaOptions | None = None,
) -> Array:
    """A priori sigma (column, row) of the ray in the target, (n, 2), nan for points without a match.

    Variance components of the pair: (formal_scale x formal)^2 + (miss_scale x miss)^2 + surface^2, half of it to each
    ray, where miss is the robust standard deviation (1.4826 x median) of the return misses in the point's class.
    Forward and backward see the same noise, which therefore cancels in the miss: it holds errors of interpolation and
    deformation only, and never replaces the formal part. The residuals of an adjustment may scale the whole.
    """
    chosen = options or RaySigmaOptions()
    of_class = texture_angle_classes(result) if classes is None else classes
    formal = np.diagonal(result.covariance_px2, axis1=1, axis2=2) * chosen.formal_scale**2
    miss = np.full(formal.shape, chosen.fallback_miss_px)
    for index in np.unique(of_class[of_class >= 0]):
        rows = (of_class == index) & result.ok
        if rows.sum() >= chosen.least_class_size:
            miss[of_class == index] = 1.4826 * np.median(np.abs(return_miss_px[rows]), axis=0)
    variance = (formal + (chosen.miss_scale * miss) ** 2 + chosen.surface_px**2) / 2.0
    return np.where(result.ok[:, None], np.sqrt(variance), np.nan)


def _with_status(result: MatchingResult, status: NDArray[np.int64]) -> MatchingResult:

    return replace(result, status=status)


def _tables(options: MatchingOptions, step: int) -> NDArray[np.float32]:
    return _weight_tables(options.window_px, options.weight_sigma, step)


@lru_cache(maxsize=16)
def _weight_tables(window_px: int, weight_sigma: float, step: int) -> NDArray[np.float32]:
    return least_squares.grid_tables(window_px, weight_sigma, step)


def _criteria(options: MatchingOptions) -> least_squares.Criteria:
    return least_squares.Criteria(
        most_iterations=options.most_iterations,
        shift_iterations=options.shift_iterations,
        convergence_px=float(options.convergence_px),
        most_drift_px=float(options.most_drift_px),
        least_gradient=float(options.least_gradient),
        least_correlation=float(options.least_correlation),
        most_affine_change=float(options.most_affine_change),
    )


def _buffer_side(warps: Array, options: MatchingOptions) -> int:
    """Room for the largest warped window with what it may move and grow; ten times the window at most."""
    finite = warps[np.isfinite(warps).all(axis=(1, 2))]
    stretch = min(float(np.abs(finite).sum(axis=2).max(initial=1.0)), 10.0)
    reach = (
        stretch * (options.window_px // 2) + 3 + options.most_drift_px + options.most_affine_change * options.window_px
    )
    return 2 * ceil(max(reach, options.window_px / 2 + 6)) + 4


def _checked_count(reference: Grey, target: Grey, reference_px: Array, target_px: Array, warps: Array) -> int:
    for name, picture in (("reference", reference), ("target", target)):
        if picture.ndim != 2 or picture.dtype != np.uint8:
            raise InputError(f"the {name} must be an 8-bit picture (h, w), is {picture.dtype} {picture.shape}")
    count = int(np.asarray(reference_px).shape[0])
    if reference_px.shape != (count, 2) or target_px.shape != (count, 2) or warps.shape != (count, 2, 2):
        raise InputError(
            f"need points (n, 2), (n, 2) and warps (n, 2, 2), got {[a.shape for a in (reference_px, target_px, warps)]}"
        )
    return count
