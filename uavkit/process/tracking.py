"""Tracking points through the video between two stills by orientation code matching.

Each picture is matched against the patches of the *first* one, warped by the accumulated local transformation, so that
errors do not add up; a patch is renewed only when its match decays. Positions are predicted from the motion
so far. LMedS and the vote of the neighbours decide which matches hold, for on relief one affine
transformation is not the truth (Anai et al. 2012, figure 7).

On ground that repeats itself (rows of plants) a match tells little: each period looks alike. There pictures follow one
another closely, and where nothing predicts the motion - after the shutter's black - it comes from what does not repeat:
tone of wide extent first, then the dissimilarity of all points together. Alignments that this cannot tell apart are
followed side by side until the pictures decide; where they do not, nothing is found.
"""

from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from uavkit.core.arrays import Array, Flags
from uavkit.core.errors import AdjustmentError, InputError
from uavkit.process.affine_motion import (
    apply_affine,
    compose,
    fit_affine,
    fit_affine_robustly,
    nearest_similarity,
    residuals_of,
    similarity_power,
)
from uavkit.process.kernels.affine import local_warps, neighbour_votes, over_inverse
from uavkit.process.kernels.fields import brightness, square_lines
from uavkit.process.orientation_code import (
    Dissimilarity,
    MatchPlan,
    PointMatches,
    coding_threshold,
    match_codes_at,
    packed_codes,
)
from uavkit.process.repetition import Tone, repeat_shifts, tone_costs, tone_of, wide_motion

Grey = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedPicture:
    """A square-pixel luminance picture of the video with its time."""

    image: Grey
    time_s: float
    usable: bool = True
    """False where the caller knows that the picture is black, frozen or flashed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingOptions:
    """Lengths are pixels of the pictures that are tracked.

    The defaults are for full-size pictures (square_field): on simulated video of an interlaced, MPEG-4 coded finder
    signal they gave 0.25 px (median) and 0.6 px (95 %) at the next still, half-size pictures 0.3 and 1.1 frame pixels
    with fewer points kept. For half-size pictures about two thirds of the lengths are right.
    """

    window_px: int = 21
    search_radius_px: int = 3
    lost_radius_px: int = 8
    """Half width of the search for points, and for pictures, that were not found at their prediction."""
    step_px: float = 4.0
    """Pictures are left out until the points are predicted to have moved this far."""
    most_step_s: float = 0.2
    most_dissimilarity: float = 2.9
    """In codes; 4 is chance."""
    most_ambiguity: float = 0.92
    renewal_dissimilarity: float = 2.7
    """A template that matches worse than this three times running is cut anew from the last picture."""
    least_share: float = 0.3
    """A picture in which fewer of the visible points are found is taken for unusable."""
    neighbours: int = 12
    most_misses: int = 12
    """Pictures running in which a point may go unseen before it is given up."""
    variant: Dissimilarity = Dissimilarity.PAPER
    decisive_z: float = 4.0
    """Difference of two alignments' dissimilarities over its standard deviation from which the worse is dropped."""
    most_rivals: int = 4
    """Alignments that are followed side by side where the ground repeats itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """How the whole picture moved in the last step: for prediction, within an interval and into the next one."""

    after_from_before: Array
    """Similarity transformation (2, 3)."""
    duration_s: float

    def over(self, seconds: float) -> Array:
        """The same motion continued for a time, (2, 3)."""
        return similarity_power(self.after_from_before, seconds / self.duration_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingResult:
    """Where the points are in the last usable picture."""

    points_px: Array
    """(n, 2); of lost points the prediction."""
    alive: Flags
    """Found in the last usable picture, (n,)."""
    dissimilarity: Array
    """In codes, (n,); nan if never found."""
    ambiguity: Array
    """Best over second best dissimilarity, (n,)."""
    affine: Array
    """Last picture from first picture, (2, 3), fitted to all points that were found."""
    warps: Array
    """Local last_from_first about each point, (n, 2, 2)."""
    motion: Motion | None
    """Of the last step; None if no second picture was usable."""
    time_s: float
    """Of the last usable picture."""
    pictures_used: int
    gaps: int
    """Pictures that were unusable."""
    repeats: bool
    """Whether the ground repeats itself: what is more than half a period off finds a wrong place."""


def predict(result: TrackingResult, time_s: float) -> Array:
    """Positions (n, 2) at a time near the end of tracking: the still's exposure, when the video may show nothing."""
    if result.motion is None:
        return result.points_px
    return apply_affine(result.motion.over(time_s - result.time_s), result.points_px)


@dataclass(frozen=True, slots=True)
class Source:
    """A picture from which templates are cut."""

    image: Grey
    threshold: int


@dataclass(frozen=True, slots=True)
class First:
    """What is kept of the first picture where the ground repeats itself."""

    source: Source
    tone: Tone
    """What does not repeat."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackState:
    """Everything known after a picture; advance() makes the next one."""

    options: TrackingOptions
    neighbours: NDArray[np.int64]
    start_px: Array
    sources: tuple[Source, ...]
    source_of: NDArray[np.int64]
    """Which source the template of each point is cut from, (n,)."""
    source_px: Array
    """Where in it, (n, 2)."""
    source_warps: Array
    """source_from_start about each point, (n, 2, 2)."""
    points_px: Array
    warps: Array
    """current_from_start, (n, 2, 2)."""
    drift_px_s: Array
    """Motion of each point against the motion of all, (n, 2)."""
    misses: NDArray[np.int64]
    decayed: NDArray[np.int64]
    """Running count of matches worse than renewal_dissimilarity, (n,)."""
    dissimilarity: Array
    ambiguity: Array
    affine: Array
    motion: Motion | None
    time_s: float
    last_image: Grey
    pictures_used: int = 1
    gaps: int = 0
    blind_pictures: int = 0
    """Unusable pictures since the last usable one."""
    recent: tuple[Grey, ...] = ()
    """Small copies of the last pictures, to recognise a frozen one."""
    repeats_px: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(k, 2) shifts at which the first picture repeats itself; none on ordinary ground."""
    first: "First | None" = None
    """The first picture; None on ordinary ground."""

    @property
    def repeats(self) -> bool:
        """Whether the ground repeats itself."""
        return len(self.repeats_px) > 0


def start(
    picture: TimedPicture, points_px: Array, options: TrackingOptions | None = None, motion: Motion | None = None
) -> TrackState:
    """Begin with points (n, 2) of a first picture; motion, of an earlier interval, predicts the first step."""
    chosen = options or TrackingOptions()
    points = np.array(points_px, np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 6:
        raise InputError(f"tracking needs at least 6 points (n, 2), got {points.shape}")
    count = len(points)
    unit = np.tile(np.eye(2), (count, 1, 1))
    repeats_px = repeat_shifts(picture.image)
    source = Source(picture.image, coding_threshold(picture.image))
    return TrackState(
        options=chosen,
        neighbours=_neighbours(points, chosen.neighbours),
        start_px=points,
        sources=(source,),
        source_of=np.zeros(count, np.int64),
        source_px=points.copy(),
        source_warps=unit,
        points_px=points.copy(),
        warps=unit.copy(),
        drift_px_s=np.zeros((count, 2)),
        misses=np.zeros(count, np.int64),
        decayed=np.zeros(count, np.int64),
        dissimilarity=np.full(count, np.nan),
        ambiguity=np.full(count, np.nan),
        affine=np.eye(2, 3),
        motion=motion,
        time_s=picture.time_s,
        last_image=picture.image,
        recent=(_small(picture.image),),
        repeats_px=repeats_px,
        first=First(source, tone_of(picture.image)) if len(repeats_px) else None,
    )


def _neighbours(points_px: Array, number: int) -> NDArray[np.int64]:
    """Rows of the nearest other points, (n, number), -1 where there are fewer."""
    wanted = min(number + 1, len(points_px))
    _, rows = cKDTree(points_px).query(points_px, k=wanted)
    result = np.full((len(points_px), number), -1, np.int64)
    result[:, : wanted - 1] = rows[:, 1:]
    return result


def _small(image: Grey) -> Grey:
    return np.ascontiguousarray(image[::4, ::4])


def is_usable(state: TrackState, picture: TimedPicture) -> bool:
    """False for a picture that is flagged, black, blown out, or the same as one of the last two in spite of motion."""
    if not picture.usable:
        return False
    small = _small(picture.image)
    if not _shows_something(small):
        return False
    if predicted_step_px(state, picture.time_s) < 1.0:
        return True
    return all(float(cv2.norm(small, old, cv2.NORM_L1)) / small.size > 0.3 for old in state.recent)


def _shows_something(small: Grey) -> bool:
    """False for a picture that is black or otherwise flat, or blown out."""
    sums = np.zeros(3, np.int64)
    brightness(small, 250, sums)
    mean, square = sums[0] / small.size, sums[1] / small.size
    return bool(square - mean**2 >= 9.0 and sums[2] <= 0.4 * small.size)


def predicted_step_px(state: TrackState, time_s: float) -> float:
    """How far the fastest tenth of the points should have moved since the last picture; infinite while unknown."""
    if state.motion is None:
        return float("inf")
    step = apply_affine(state.motion.over(time_s - state.time_s), state.points_px) - state.points_px
    return _upper_tenth(np.hypot(step[:, 0], step[:, 1]))


def _upper_tenth(values: Array) -> float:
    """The value that a tenth of all exceeds; numpy's quantile takes ten times as long for the same."""
    at = int(0.9 * (len(values) - 1))
    return float(np.partition(values, at)[at])


def advance(
    state: TrackState, picture: TimedPicture, rng: np.random.Generator, pool: Executor | None = None
) -> TrackState:
    """Follow the points into a later picture; a picture that cannot be used only counts as a gap.

    The threads of a pool share the matching; the result is the same to the last bit.
    """
    return _advanced(state, picture, rng, pool)[0]


def _advanced(
    state: TrackState, picture: TimedPicture, rng: np.random.Generator, pool: Executor | None
) -> list[TrackState]:
    """The state after a picture; several where the ground repeats itself and each may be right, the likeliest first."""
    if picture.image.shape != state.last_image.shape:
        raise InputError(f"picture size changed from {state.last_image.shape} to {picture.image.shape}")
    if not is_usable(state, picture):
        return [_blind(state)]
    packed = packed_codes(picture.image)
    for attempt in _attempts(state, picture):
        found = _follow(state, packed, attempt, picture.time_s, rng, pool)
        if found is not None:
            return [_moved(state, picture, found)]
    if state.repeats and (state.blind_pictures < _EAGER or state.blind_pictures % _EAGER == 0):
        alignments = _alignments(state, picture, _Judge(packed, tone_of(picture.image), pool), rng)
        return [_moved(state, picture, one.found) for one in alignments] or [_blind(state)]
    return [_blind(state)]


_EAGER = 4
"""Pictures running that are searched for the place at any cost, on ground that repeats itself; then every fourth."""


def _blind(state: TrackState) -> TrackState:
    return replace(state, gaps=state.gaps + 1, blind_pictures=state.blind_pictures + 1)


@dataclass(frozen=True, slots=True)
class _Attempt:
    """A predicted transformation (2, 3), and how widely to search about it."""

    motion: Array
    radius_px: int
    least_share: float
    """Of the visible points, to be found."""


def _attempts(state: TrackState, picture: TimedPicture) -> Iterable[_Attempt]:
    """What to try in turn: the predicted motion (or the whole picture's shift), a wider search, a global one."""
    options = state.options
    usual = min(options.lost_radius_px, options.search_radius_px + state.blind_pictures // 2)
    if state.repeats:
        # a wider search, or the shift of the whole picture, would find another period as well
        if state.motion is not None and picture.time_s - state.time_s < options.most_step_s:
            yield _Attempt(
                state.motion.over(picture.time_s - state.time_s), options.search_radius_px, options.least_share
            )
        return
    if state.motion is not None:
        motion = state.motion.over(picture.time_s - state.time_s)
        yield _Attempt(motion, usual, options.least_share)
    else:
        motion = np.eye(2, 3)
        shift = coarse_shift(state.last_image, picture.image)
        yield _Attempt(shift, min(usual + 1, options.lost_radius_px), max(_SHARE_BY_SHIFT, options.least_share))
    if state.motion is None or usual < options.lost_radius_px:
        yield _Attempt(motion, options.lost_radius_px, options.least_share)
    turned = coarse_motion(state.last_image, picture.image, motion)
    yield _Attempt(turned, options.lost_radius_px, options.least_share)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """Matches of one picture that hold, and where the other points should be."""

    matches: PointMatches
    good: Flags
    points_px: Array
    step: Array
    residuals_px: Array


def _follow(
    state: TrackState,
    packed: Grey,
    attempt: _Attempt,
    time_s: float,
    rng: np.random.Generator,
    pool: Executor | None,
) -> _Found | None:
    """Match all points about their prediction; None if too few are found for this to be the same scene."""
    options, motion, radius = state.options, attempt.motion, attempt.radius_px
    seconds = time_s - state.time_s
    predicted = apply_affine(motion, state.points_px) + state.drift_px_s * seconds
    tried = state.misses <= options.most_misses
    radii = np.where(tried, np.where(state.misses > 0, min(2 * radius, options.lost_radius_px), radius), 0)
    matches = _match(state, packed, predicted, motion, radii, pool)
    good = _credible(matches, options)
    visible = matches.coded_share >= 0
    visible &= ~np.isnan(matches.points_px[:, 0])
    if good.sum() < max(6, attempt.least_share * visible.sum()):
        return None
    fresh = good & (state.misses == 0)
    fit_rows = fresh if fresh.sum() >= 6 else good
    try:
        step = fit_affine_robustly(state.points_px[fit_rows], matches.points_px[fit_rows], rng)
    except AdjustmentError:
        return None
    if step.inliers.sum() < max(6, 0.5 * attempt.least_share * visible.sum()):
        return None
    return _voted(state, matches, good, step.target_from_source, step.scale_px)


@dataclass(frozen=True, slots=True)
class _Judge:
    """A picture by which alignments are judged."""

    packed: Grey
    tone: Tone
    pool: Executor | None

    def matches(self, state: TrackState, predicted: Array, motion: Array, radius_px: int) -> PointMatches:
        """Match the points about predicted positions (n, 2)."""
        return _match(state, self.packed, predicted, motion, np.full(len(predicted), radius_px, np.int64), self.pool)

    def cost(self, state: TrackState, predicted: Array, motion: Array) -> Array:
        """What each point costs at predicted positions, (n,): dissimilarity and tone; nan outside the picture."""
        matches = self.matches(state, predicted, motion, 2)
        outside = (matches.coded_share < 0) | np.isnan(matches.points_px[:, 0])
        cost = np.where(outside, np.nan, np.minimum(matches.dissimilarity, 4.0))
        if state.first is None:
            return cost
        warps = motion[:, :2] @ state.warps
        tone = tone_costs(state.first.tone, self.tone, state.start_px, predicted, warps)
        return np.asarray(cost + _TONE_WEIGHT * tone)


_TONE_WEIGHT = 2.0
"""Codes that tone without correlation is worth."""


@dataclass(frozen=True, slots=True)
class _Alignment:
    """One way in which a picture may show the points, with what each of these costs."""

    motion: Array
    cost: Array
    found: _Found

    @property
    def mean(self) -> float:
        """Of the cost of all points that the picture shows."""
        return _mean_of(self.cost)


def _mean_of(cost: Array) -> float:
    known = cost[np.isfinite(cost)]
    return float(known.mean()) if len(known) else float("inf")


def _alignments(state: TrackState, picture: TimedPicture, judge: _Judge, rng: np.random.Generator) -> list[_Alignment]:
    """All alignments of a picture that are about as good as the best, that first; on ground that repeats itself.

    Tone of wide extent tells the motion to some pixels. About it, and at the shifts at which the ground repeats itself
    about the best, all points together are compared: a single one fits at each period.
    """
    wide, likeness = wide_motion(state.last_image, picture.image)
    if likeness < _LEAST_LIKENESS:
        return []
    ways = _climbed(state, judge, _likely_motions(state, judge, wide), rng)
    if len(ways) > 1:
        ways = sorted([*_by_region(state, ways, rng), *ways], key=lambda way: way.mean)
    kept: list[_Alignment] = []
    for way in ways:
        same = any(_median_distance(way.found.points_px, one.found.points_px) < _SAME_PX for one in kept)
        if not same and (not kept or _z_of_worse(kept[0].cost, way.cost) < state.options.decisive_z):
            kept.append(way)
    return kept if len(kept) <= state.options.most_rivals else []


def _climbed(state: TrackState, judge: _Judge, motions: list[Array], rng: np.random.Generator) -> list[_Alignment]:
    """Alignments near motions (2, 3), and at the repetitions about the best until none is better; the best first."""
    ways: list[_Alignment] = []
    for _ in range(_MOST_CLIMBS):
        best = ways[0].mean if ways else np.inf
        fresh = (_refined(state, judge, motion, rng) for motion in motions)
        ways = sorted([*ways, *(way for way in fresh if way is not None)], key=lambda way: way.mean)
        if not ways or ways[0].mean >= best:
            break
        motions = _slipped(state, ways[0].motion)
    return ways


def _by_region(state: TrackState, ways: list[_Alignment], rng: np.random.Generator) -> list[_Alignment]:
    """One alignment of the parts of several: each point goes the way that is cheapest to the region about it.

    Relief shifts parts of a picture by more than half a period; no single alignment is right there. Regions are wide,
    for the costs of a few points tell one period from the next no better than chance. Empty where the points of the
    result do not move together.
    """
    costs = np.stack([way.cost for way in ways])
    size = min(len(state.start_px), max(_LEAST_REGION, round(_REGION * len(state.start_px))))
    _, region = cKDTree(state.start_px).query(state.start_px, k=size)
    chosen = np.argmin(np.nan_to_num(costs - costs[0])[:, region].mean(axis=2), axis=0)
    rows = np.arange(len(chosen))

    def of_chosen(values: list[Any]) -> Any:
        return np.stack(values)[chosen, rows]

    good = np.asarray(of_chosen([way.found.good for way in ways]), np.bool_)
    points = np.asarray(of_chosen([way.found.points_px for way in ways]))
    matches = PointMatches(
        points_px=of_chosen([way.found.matches.points_px for way in ways]),
        dissimilarity=of_chosen([way.found.matches.dissimilarity for way in ways]),
        ambiguity=of_chosen([way.found.matches.ambiguity for way in ways]),
        on_rim=of_chosen([way.found.matches.on_rim for way in ways]),
        coded_share=of_chosen([way.found.matches.coded_share for way in ways]),
    )
    try:
        step = fit_affine_robustly(state.points_px[good], points[good], rng).target_from_source
    except AdjustmentError:
        return []
    residuals = points - apply_affine(step, state.points_px)
    found = _Found(matches=matches, good=good, points_px=points, step=step, residuals_px=residuals)
    return [_Alignment(step, np.asarray(of_chosen(list(costs))), found)]


_REGION = 0.12
"""Share of all points that decide together on the way of one."""
_LEAST_REGION = 24
_LEAST_LIKENESS = 0.5
"""Correlation of tone below which it tells nothing, and any period would be a guess."""
_MOST_CLIMBS = 6
_GRID_PX = np.arange(-9.0, 9.5, 3.0)
"""About the motion that tone of wide extent tells, along columns and rows."""
_LIKELY_SHIFTS = 6
_JUDGING_POINTS = 250
_SAME_PX = 2.0


def _likely_motions(state: TrackState, judge: _Judge, motion: Array) -> list[Array]:
    """The motions (2, 3), shifted over a grid, at which some of the points cost least."""
    some = slice(None, None, max(1, len(state.points_px) // _JUDGING_POINTS))
    part = replace(
        state,
        start_px=state.start_px[some],
        source_of=state.source_of[some],
        source_px=state.source_px[some],
        source_warps=state.source_warps[some],
        points_px=state.points_px[some],
        warps=state.warps[some],
    )
    shifts = [np.array([[0, 0, column], [0, 0, row]]) for column in _GRID_PX for row in _GRID_PX]
    costs = [
        _mean_of(judge.cost(part, apply_affine(motion + shift, part.points_px), motion + shift)) for shift in shifts
    ]
    return [motion + shifts[index] for index in np.argsort(costs, kind="stable")[:_LIKELY_SHIFTS]]


def _slipped(state: TrackState, motion: Array) -> list[Array]:
    """Motions (2, 3) that a repeating ground takes for a motion: one period off everywhere, or on one side only.

    Where a side of the picture is matched one period off, all between adapts to it: scale or rotation is wrong by the
    period over the width of the picture.
    """
    middle, size = state.points_px.mean(axis=0), np.ptp(state.points_px, axis=0) / 2 + 1.0
    result = []
    for shift in _shortest(state.repeats_px):
        moved = motion[:, :2] @ state.affine[:, :2] @ shift
        for sign in (1.0, -1.0):
            result.append(motion + np.column_stack([np.zeros((2, 2)), sign * moved]))
            for axis, side in ((0, 0.5), (0, -0.5), (1, 0.5), (1, -0.5)):
                slope = side * np.eye(2)[axis] / size[axis]  # 0 on one side of the picture, 1 on the other
                by_place = np.append(slope, 0.5 - slope @ middle)
                result.append(motion + sign * np.outer(moved, by_place))
    return result


_MOST_PERIODS = 2


def _shortest(repeats_px: Array) -> list[Array]:
    """Those of the shifts (k, 2) of which the others are multiples, the shortest first."""
    apart: list[Array] = []
    for shift in repeats_px[np.argsort(np.hypot(*repeats_px.T), kind="stable")]:
        multiples = (round(float(shift @ one / (one @ one))) * one for one in apart)
        if all(np.hypot(*(shift - multiple)) > 2 * _SAME_PX for multiple in multiples):
            apart.append(shift)
    return apart[:_MOST_PERIODS]


def _refined(state: TrackState, judge: _Judge, motion: Array, rng: np.random.Generator) -> _Alignment | None:
    """An alignment near a motion (2, 3): matched in ever narrower searches about what neighbours agree on."""
    options = state.options
    predicted = apply_affine(motion, state.points_px)
    for radius in (4, 4, 3, 3, 2):
        matches = judge.matches(state, predicted, motion, radius)
        good = np.asarray((matches.dissimilarity <= options.most_dissimilarity) & ~matches.on_rim)
        visible = (matches.coded_share >= 0) & ~np.isnan(matches.points_px[:, 0])
        if good.sum() < max(6, options.least_share * visible.sum()):
            return None
        try:
            step = fit_affine_robustly(state.points_px[good], matches.points_px[good], rng)
        except AdjustmentError:
            return None
        motion = step.target_from_source
        expected = _bent(motion, state.points_px, matches.points_px, good)
        medians, _, _ = _votes(matches.points_px - expected, good, state.neighbours)
        predicted = expected + np.nan_to_num(medians)
    found = _voted(state, matches, good, motion, step.scale_px)
    return _Alignment(motion, judge.cost(state, predicted, motion), found)


def _bent(motion: Array, points_px: Array, matched_px: Array, good: Flags) -> Array:
    """Positions (n, 2) by a quadratic surface over those matches that hold: relief bends the motion of a picture.

    Matches are taken in as the surface comes near them, from an affine motion (2, 3) on.
    """
    middle, size = points_px.mean(axis=0), np.ptp(points_px, axis=0) / 2 + 1.0
    x, y = ((points_px - middle) / size).T
    design = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    expected = apply_affine(motion, points_px)
    for _ in range(_BENDING_ROUNDS):
        near = good & (np.hypot(*(matched_px - expected).T) <= _NEAR_PX)
        if near.sum() < 4 * design.shape[1]:
            return expected
        solution, *_ = np.linalg.lstsq(design[near], matched_px[near], rcond=None)
        expected = design @ solution
    return np.asarray(expected)


_BENDING_ROUNDS = 3
_NEAR_PX = 2.5
"""Of the surface so far: matches farther off are of another period."""


def _median_distance(one_px: Array, two_px: Array) -> float:
    return float(np.median(np.hypot(*(one_px - two_px).T)))


def _z_of_worse(better: Array, worse: Array) -> float:
    """Mean difference of two costs (n,) of the same points over its standard deviation."""
    difference = worse - better
    difference = difference[np.isfinite(difference)]
    if len(difference) < 6:
        return 0.0
    return float(difference.mean() / max(float(difference.std()) / np.sqrt(len(difference)), 1e-9))


def _match(
    state: TrackState,
    packed: Grey,
    predicted: Array,
    motion: Array,
    radii: NDArray[np.int64],
    pool: Executor | None,
) -> PointMatches:
    """Match with templates cut from each source and warped by source_from_start (motion current_from_start)^-1."""
    warps = motion[:, :2] @ state.warps
    source_from_current = np.empty_like(warps)
    over_inverse(state.source_warps, warps, source_from_current)
    parts = []
    for index, source in enumerate(state.sources):
        rows = np.flatnonzero(state.source_of == index)
        plan = MatchPlan(
            reference_px=state.source_px[rows],
            predicted_px=predicted[rows],
            reference_from_target=source_from_current[rows],
            radii_px=radii[rows],
        )
        options = state.options
        parts.append(
            (
                rows,
                match_codes_at(
                    source.image,
                    packed,
                    plan,
                    threshold=source.threshold,
                    window_px=options.window_px,
                    variant=options.variant,
                    pool=pool,
                ),
            )
        )
    return _joined(parts, len(predicted))


def _joined(parts: list[tuple[NDArray[np.int64], PointMatches]], count: int) -> PointMatches:
    points, dissimilarity, ambiguity = np.full((count, 2), np.nan), np.full(count, np.nan), np.full(count, np.nan)
    on_rim, coded = np.zeros(count, np.bool_), np.full(count, -1.0)
    for rows, part in parts:
        points[rows], dissimilarity[rows], ambiguity[rows] = part.points_px, part.dissimilarity, part.ambiguity
        on_rim[rows], coded[rows] = part.on_rim, part.coded_share
    return PointMatches(
        points_px=points, dissimilarity=dissimilarity, ambiguity=ambiguity, on_rim=on_rim, coded_share=coded
    )


def _credible(matches: PointMatches, options: TrackingOptions) -> Flags:
    """Matches that are good by themselves; unmatched points are nan and compare as False."""
    good = (matches.dissimilarity <= options.most_dissimilarity) & ~matches.on_rim
    return np.asarray(good & ~(matches.ambiguity > options.most_ambiguity))


def _voted(state: TrackState, matches: PointMatches, good: Flags, step: Array, scale_px: float) -> _Found:
    """Keep matches whose residual against the affine step agrees with that of their neighbours (or, alone, is small).

    A point that was lost has no previous position to step from: for it the whole displacement since the start is
    compared with the neighbours', with the width of the search as its tolerance.
    """
    expected = apply_affine(step, state.points_px)
    residuals = matches.points_px - expected
    fresh = good & (state.misses == 0)
    medians, spread, votes = _votes(residuals, fresh, state.neighbours)
    tolerance = np.minimum(np.maximum(2.5 * spread, 0.75), np.maximum(2.5 * scale_px, 1.5))
    against_neighbours = np.abs(residuals - medians).max(axis=1)
    against_all = np.abs(residuals).max(axis=1)
    holds = np.where(votes >= 5, against_neighbours <= tolerance, against_all <= 2.5 * scale_px)
    holds_again = against_neighbours <= state.options.lost_radius_px / 2 + tolerance
    kept = good & np.where(state.misses == 0, holds, holds_again)
    points = np.where(kept[:, None], matches.points_px, expected + medians)
    return _Found(
        matches=matches,
        good=kept,
        points_px=points,
        step=step,
        residuals_px=np.where(kept[:, None], residuals, medians),
    )


def _votes(residuals: Array, counted: Flags, neighbours: NDArray[np.int64]) -> tuple[Array, Array, NDArray[np.int64]]:
    count = len(residuals)
    medians, spread, votes = np.empty((count, 2)), np.empty(count), np.empty(count, np.int64)
    neighbour_votes(residuals, counted, neighbours, medians, spread, votes)
    return medians, spread, votes


_WARP_LIMITS = np.array([0.15, 0.4])
"""Weight of the general transformation in a local one, and how far the elements of the two may be apart: on a slope of
45 degrees the local scale changes by the base over the height, 0.4 between stills of 60 % overlap."""


_STRAY_PX = 4.0
"""A match this far from where its neighbours imply it (and four times as far as theirs) has locked elsewhere."""


def _moved(state: TrackState, picture: TimedPicture, found: _Found) -> TrackState:
    """The state after a picture in which the points were found."""
    good, points = found.good, found.points_px
    seconds = picture.time_s - state.time_s
    affine = _trimmed_affine(state.start_px, points, good) if good.sum() >= 6 else compose(found.step, state.affine)
    warps, good, points = _settled(state, affine, good, points)
    similarity = nearest_similarity(found.step, points)
    extra = apply_affine(found.step, state.points_px) - apply_affine(similarity, state.points_px)
    worse = found.matches.dissimilarity > state.options.renewal_dissimilarity
    moved = replace(
        state,
        points_px=points,
        warps=warps,
        drift_px_s=0.5 * state.drift_px_s + 0.5 * (found.residuals_px + extra) / seconds,
        misses=_missed(state, found.matches, good),
        decayed=np.where(good & worse, state.decayed + 1, np.where(good, 0, state.decayed)),
        dissimilarity=np.where(good, found.matches.dissimilarity, state.dissimilarity),
        ambiguity=np.where(good, found.matches.ambiguity, state.ambiguity),
        affine=affine,
        motion=Motion(after_from_before=similarity, duration_s=seconds),
        time_s=picture.time_s,
        last_image=picture.image,
        pictures_used=state.pictures_used + 1,
        blind_pictures=0,
        recent=(*state.recent[-1:], _small(picture.image)),
    )
    return _renewed(moved, good)


def _settled(state: TrackState, affine: Array, good: Flags, points_px: Array) -> tuple[Array, Flags, Array]:
    """Local warps, matches without strays, and positions.

    A lost point waits where its neighbours imply it to be, however long it was outside the picture; a stray becomes a
    lost point.
    """
    warps, implied = np.empty_like(state.warps), points_px.copy()
    general = np.ascontiguousarray(affine[:, :2])
    local_warps(state.start_px, points_px, good, state.neighbours, general, _WARP_LIMITS, warps, implied)
    off = points_px - implied
    medians, spread, votes = _votes(off, good, state.neighbours)
    stray = (votes >= 5) & (np.abs(off - medians).max(axis=1) > np.maximum(_STRAY_PX, 4 * spread))
    kept = good & ~stray
    return warps, kept, np.where(kept[:, None], points_px, implied)


def _missed(state: TrackState, matches: PointMatches, good: Flags) -> NDArray[np.int64]:
    """Count of misses; a point outside the picture may come back, so it is never given up there."""
    outside = np.isnan(matches.points_px[:, 0])
    more = np.where(outside, np.minimum(state.misses + 1, state.options.most_misses), state.misses + 1)
    return np.where(good, 0, more)


def _trimmed_affine(start_px: Array, current_px: Array, good: Flags) -> Array:
    """Least squares affine of all good points, once more without the worst tenth."""
    affine = fit_affine(start_px, current_px, good)
    residuals = residuals_of(affine, start_px, current_px)
    kept = good & (residuals <= _upper_tenth(residuals[good]))
    return fit_affine(start_px, current_px, kept) if kept.sum() >= 6 else affine


def _renewed(state: TrackState, good: Flags) -> TrackState:
    """Cut templates anew where three matches running have decayed; sources that nobody uses any more are dropped.

    Some points wait for others, so that there are few sources.
    """
    renew = good & (state.decayed >= 3)
    if renew.sum() < max(1.0, 0.05 * good.sum()):
        return state
    newest = Source(state.last_image, coding_threshold(state.last_image))
    source_of = np.where(renew, len(state.sources), state.source_of)
    used = np.unique(source_of)
    sources = (*state.sources, newest)
    return replace(
        state,
        sources=tuple(sources[index] for index in used),
        source_of=np.searchsorted(used, source_of),
        source_px=np.where(renew[:, None], state.points_px, state.source_px),
        source_warps=np.where(renew[:, None, None], state.warps, state.source_warps),
        decayed=np.where(renew, 0, state.decayed),
    )


_COARSE = 4
_COARSE_ANGLES_DEG = (0.0, -5.0, 5.0, -10.0, 10.0, -15.0, 15.0, -20.0, 20.0, -25.0, 25.0)
_FINE_ANGLES_DEG = (0.0, -2.5, 2.5, -1.25, 1.25)


_SHARE_BY_SHIFT = 0.6
"""Visible points to be found about the shift of the whole picture: with fewer the wider search finds more."""


def coarse_motion(before: Grey, after: Grey, predicted: Array) -> Array:
    """after_from_before (2, 3) near a predicted one by phase correlation of pictures at a quarter of the size.

    Turns the earlier picture by angles about the prediction and takes the shift of the highest peak.
    """
    small = _reduced(before), _reduced(after)
    best = _best_turn(*small, predicted, _COARSE_ANGLES_DEG)
    return _best_turn(*small, best, _FINE_ANGLES_DEG)


def coarse_shift(before: Grey, after: Grey) -> Array:
    """after_from_before (2, 3), a mere shift, by phase correlation of pictures at a quarter of the size."""
    return _best_turn(_reduced(before), _reduced(after), np.eye(2, 3), (0.0,))


def _reduced(image: Grey) -> NDArray[np.float32]:
    size = (image.shape[1] // _COARSE, image.shape[0] // _COARSE)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _best_turn(
    before: NDArray[np.float32], after: NDArray[np.float32], predicted: Array, angles_deg: tuple[float, ...]
) -> Array:
    """The best of several turns about the middle of the picture; transformations are in full-size pixels."""
    rows, columns = after.shape
    window = cv2.createHanningWindow((columns, rows), cv2.CV_32F)
    middle = (np.array([columns, rows]) * _COARSE - 1) / 2
    best, best_response = predicted, -1.0
    for angle_deg in angles_deg:
        c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
        turn = np.array([[c, -s], [s, c]])
        tried = compose(np.column_stack([turn, middle - turn @ middle]), predicted)
        # full-size pixel x is small pixel (x - (k - 1) / 2) / k
        half = (_COARSE - 1) / 2
        shift = (tried[:, :2] @ np.full(2, half) + tried[:, 2] - half) / _COARSE
        mean = float(before.mean())
        warped = cv2.warpAffine(before, np.column_stack([tried[:, :2], shift]), (columns, rows), borderValue=mean)
        (dx, dy), response = cv2.phaseCorrelate(warped, after, window)
        if response > best_response:
            best_response = response
            best = tried + np.array([[0, 0, dx * _COARSE], [0, 0, dy * _COARSE]])
    return best


def track(
    pictures: Iterable[TimedPicture],
    points_px: Array,
    options: TrackingOptions | None = None,
    *,
    rng: np.random.Generator,
    initial_affine: Array | None = None,
    motion: Motion | None = None,
    pool: Executor | None = None,
) -> TrackingResult:
    """Follow points (n, 2) from the first usable picture through all others.

    initial_affine (2, 3) brings points_px into the first usable picture, where they were measured at another instant
    (the still's); motion is that of the interval before. Pictures are left out as long as little motion is
    predicted; the last usable one is always matched. The threads of a pool share the matching. Raises InputError if
    there is no usable picture.
    """
    points = points_px if initial_affine is None else apply_affine(initial_affine, points_px)
    rivals: list[_Rival] = []
    waiting: TimedPicture | None = None
    for picture in pictures:
        if not rivals:
            if picture.usable and _shows_something(_small(picture.image)):
                rivals = [_Rival(start(picture, points, options, motion))]
            continue
        if _may_wait(rivals[0].state, picture):
            waiting = picture
            continue
        before_s = rivals[0].state.time_s
        rivals = _followed(rivals, picture, rng, pool)
        if rivals[0].state.time_s == before_s and waiting is not None:
            # this picture was no use: the one left out last is nearer to it than any other
            rivals = _followed(rivals, waiting, rng, pool)
        waiting = None
    if not rivals:
        raise InputError("no usable picture to begin tracking with")
    if waiting is not None:
        rivals = _followed(rivals, waiting, rng, pool)
    return _verified([rival.state for rival in rivals], pool) if rivals[0].state.repeats else _result(rivals[0].state)


@dataclass(frozen=True, slots=True)
class _Rival:
    """One of several alignments that are followed side by side, with what it has cost since they parted."""

    state: TrackState
    cost: Array = field(default_factory=lambda: np.zeros(1))
    """Sum over pictures of the dissimilarity of each point, (n,)."""


def _followed(
    rivals: list[_Rival], picture: TimedPicture, rng: np.random.Generator, pool: Executor | None
) -> list[_Rival]:
    """Follow each rival into a picture, and drop those that are worse than the best by now, or have become the same."""
    after = [(rival, state) for rival in rivals for state in _advanced(rival.state, picture, rng, pool)]
    if len(after) == 1:
        return [_Rival(after[0][1])]
    best_time_s = max(state.time_s for _, state in after)
    if best_time_s == rivals[0].state.time_s:  # no use to any of them
        return [_Rival(state, rival.cost) for rival, state in after]
    judge = _Judge(packed_codes(picture.image), tone_of(picture.image), pool)
    judged = [_Rival(state, rival.cost + _cost_of(state, judge, best_time_s)) for rival, state in after]
    judged.sort(key=lambda rival: _mean_of(rival.cost))
    kept: list[_Rival] = []
    for rival in judged:
        same = any(_median_distance(rival.state.points_px, one.state.points_px) < _SAME_PX for one in kept)
        worse = bool(kept) and _z_of_worse(kept[0].cost, rival.cost) >= rival.state.options.decisive_z
        if not same and not worse and len(kept) < rival.state.options.most_rivals:
            kept.append(rival)
    return kept


def _cost_of(state: TrackState, judge: _Judge, time_s: float) -> Array:
    """What the picture of a time costs a state, (n,); the most where the state could not use it."""
    if state.time_s != time_s:
        return np.full(len(state.points_px), 4.0 + _TONE_WEIGHT)
    return judge.cost(state, state.points_px, np.eye(2, 3))


_REPEATING_STEP_S = 0.05
"""Where the ground repeats itself the camera must not change its speed by half a period within a step."""


def _may_wait(state: TrackState, picture: TimedPicture) -> bool:
    """True if a picture is worth matching only should it turn out to be the last one."""
    options, elapsed_s = state.options, picture.time_s - state.time_s
    if state.repeats and (
        state.motion is None or state.motion.duration_s > options.most_step_s or elapsed_s > _REPEATING_STEP_S
    ):
        return False  # the mean motion over a gap is not the speed after it, and a wrong guess finds another period
    soon = elapsed_s < options.most_step_s
    return soon and predicted_step_px(state, picture.time_s) < options.step_px and is_usable(state, picture)


def _result(state: TrackState) -> TrackingResult:
    return TrackingResult(
        points_px=state.points_px,
        alive=np.asarray((state.misses == 0) & ~np.isnan(state.dissimilarity)),
        dissimilarity=state.dissimilarity,
        ambiguity=state.ambiguity,
        affine=state.affine,
        warps=state.warps,
        motion=state.motion,
        time_s=state.time_s,
        pictures_used=state.pictures_used,
        gaps=state.gaps,
        repeats=state.repeats,
    )


def _verified(rivals: list[TrackState], pool: Executor | None) -> TrackingResult:
    """The result on ground that repeats itself: the last picture is compared with the first once more.

    Both are stills, sharper than all between. Where rivals are left, relief makes each right in a part of the picture:
    every point goes with the one that is cheapest all around it, and is lost where none is clearly so.
    """
    latest_s = max(state.time_s for state in rivals)
    rivals = [state for state in rivals if state.time_s == latest_s]
    best = rivals[0]
    if len(rivals) == 1:
        return _result(best)
    judge = _Judge(packed_codes(best.last_image), tone_of(best.last_image), pool)
    costs = np.stack([judge.cost(_afresh(state), state.points_px, np.eye(2, 3)) for state in rivals])
    around = np.stack([_around(cost - costs[0], best.neighbours) for cost in costs])
    order = np.sort(around, axis=0)
    chosen, clear = np.argmin(around, axis=0), order[1] - order[0] >= _CLEARLY_CHEAPER
    rows = np.arange(len(chosen))

    def of_chosen(values: list[Array]) -> Array:
        return np.asarray(np.stack(values)[chosen, rows])

    return replace(
        _result(best),
        points_px=of_chosen([state.points_px for state in rivals]),
        warps=of_chosen([state.warps for state in rivals]),
        dissimilarity=of_chosen([state.dissimilarity for state in rivals]),
        ambiguity=of_chosen([state.ambiguity for state in rivals]),
        alive=np.stack([_result(state).alive for state in rivals])[chosen, rows] & clear,
    )


_CLEARLY_CHEAPER = 0.1
"""Mean cost by which one of several rivals must be cheaper about a point."""


def _afresh(state: TrackState) -> TrackState:
    """The state with templates of the first picture alone."""
    if state.first is None:
        return state
    return replace(
        state,
        sources=(state.first.source,),
        source_of=np.zeros_like(state.source_of),
        source_px=state.start_px,
        source_warps=np.tile(np.eye(2), (len(state.start_px), 1, 1)),
    )


def _around(values: Array, neighbours: NDArray[np.int64]) -> Array:
    """Means of values (n,) over the neighbours' neighbours; nan counts as 0."""
    known = np.nan_to_num(values, nan=0.0)
    rows = np.where(neighbours >= 0, neighbours, np.arange(len(values))[:, None])
    once = known[rows].mean(axis=1)
    return np.asarray(once[rows].mean(axis=1))


def square_field(field_lines: Grey, parity: int) -> Grey:
    """Square pixels at frame size, (2 k, w), from the k lines of one field; parity 0: top field, 1: bottom field.

    Line k of the top field is frame row 2 k, of the bottom field 2 k + 1; the result's pixel (column, row) is frame
    pixel (column, row) for both. Rows between lines are interpolated with the cubic (-1 9 9 -1) / 16, the same for
    both parities; rows beyond the outermost line repeat it.
    """
    _check_parity(field_lines, parity)
    result = np.empty((2 * field_lines.shape[0], field_lines.shape[1]), np.uint8)
    square_lines(field_lines, parity, result)
    return result


def square_field_half(field_lines: Grey, parity: int) -> Grey:
    """Square pixels at half frame size, (k, w / 2), from the k lines of one field; parity 0: top, 1: bottom.

    The result's pixel (c, r) is frame pixel (2 c + 0.5, 2 r + 0.5) for both parities: a row lies a quarter of a field
    line below line r of the top field (3/4 line r, 1/4 line r + 1) and as much above that of the bottom field.
    """
    _check_parity(field_lines, parity)
    lines = field_lines.astype(np.uint16)
    pairs = lines[:, 0 : 2 * (lines.shape[1] // 2) : 2] + lines[:, 1::2]
    padded = np.pad(pairs, ((1, 1), (0, 0)), mode="edge")
    other = padded[2:] if parity == 0 else padded[:-2]
    return ((3 * pairs + other + 4) >> 3).astype(np.uint8)


def frame_from_half(points_half_px: Array) -> Array:
    """Frame pixels (n, 2) of positions in a picture of square_field_half."""
    return 2.0 * points_half_px + 0.5


def half_from_frame(points_px: Array) -> Array:
    """Positions (n, 2) in a picture of square_field_half of frame pixels."""
    return (points_px - 0.5) / 2.0


def _check_parity(field_lines: Grey, parity: int) -> None:
    if parity not in (0, 1) or field_lines.ndim != 2 or field_lines.dtype != np.uint8:
        raise InputError(
            f"a field is 8-bit (lines, width) with parity 0 or 1, got {field_lines.dtype}, parity {parity}"
        )
