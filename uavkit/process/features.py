"""Candidate points from features (SIFT) between stills, where no video leads from one to the next."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Image, Indices, content_hash
from uavkit.core.cache import Arrays, StepCache
from uavkit.core.camera import InteriorOrientation, ideal_from_pixels
from uavkit.core.progress import Progress
from uavkit.process.kernels.guided import UNLIKE, best_allowed
from uavkit.process.measurement import RayTasks
from uavkit.process.options import CandidateOptions
from uavkit.process.pictures import PictureStore

LOWE_RATIO = 0.8
"""Nearest over second nearest descriptor distance (Lowe 2004)."""
_UNIT_IN_BYTES = 512.0
EPIPOLAR_TOLERANCE_PX = 6.0
"""Distance from the epipolar line that an unknown lens distortion may cause."""
LEAST_MATCHES = 15
"""Geometrically consistent matches that make two stills a pair."""
_EXHAUSTIVE_UP_TO = 40
_FREELY_MATCHED = 3000
"""Strongest features that are compared without geometry, to find the geometry."""
Descriptors = NDArray[np.float32]

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, slots=True, kw_only=True)
class Features:
    """Features of one still."""

    xy_px: Array
    """(n, 2) in the still's own pixels."""
    size_px: Array
    """(n,)."""
    angle_rad: Array
    """(n,) direction of the feature, clockwise from the column axis."""
    descriptors: NDArray[np.uint8]
    """(n, 128) square roots of SIFT's normalised histograms (Arandjelovic and Zisserman 2012) with length 512."""

    @property
    def unit_descriptors(self) -> Descriptors:
        """Return the descriptors with length 1; kept in bytes, those of all stills take a quarter of the memory."""
        values = self.descriptors.astype(np.float32)
        return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1), 1.0)[:, None])

    def strongest(self, most: int) -> "Features":
        """Return the first so many features: they stand in the order of their strength."""
        return Features(
            xy_px=self.xy_px[:most],
            size_px=self.size_px[:most],
            angle_rad=self.angle_rad[:most],
            descriptors=self.descriptors[:most],
        )


def detect_features(grey: Image, options: CandidateOptions) -> Features:
    """Find SIFT features in a still reduced to the width that the options say, spread over the picture."""
    height, width = grey.shape
    reduction = min(1.0, options.feature_width_px / max(width, height))
    small = (
        grey if reduction == 1.0 else cv2.resize(grey, None, fx=reduction, fy=reduction, interpolation=cv2.INTER_AREA)
    )
    scale = np.array([width / small.shape[1], height / small.shape[0]])
    # Without precise upscaling OpenCV's features lie a quarter of a pixel too far right and down.
    detector = cv2.SIFT.create(nfeatures=4 * options.features, contrastThreshold=0.01, enable_precise_upscale=True)
    keypoints: Sequence[cv2.KeyPoint] = _spread(detector.detect(small, None), small.shape, options.features)
    if not keypoints:
        return Features(
            xy_px=np.zeros((0, 2)),
            size_px=np.zeros(0),
            angle_rad=np.zeros(0),
            descriptors=np.zeros((0, 128), np.uint8),
        )
    keypoints, raw = detector.compute(small, keypoints)
    roots = np.sqrt(raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-9))
    return Features(
        xy_px=(np.array([k.pt for k in keypoints]) + 0.5) * scale - 0.5,
        size_px=np.array([k.size for k in keypoints]) * float(scale.mean()),
        angle_rad=np.radians([k.angle for k in keypoints]),
        descriptors=np.minimum(np.rint(_UNIT_IN_BYTES * roots), 255).astype(np.uint8),
    )


def _spread(
    keypoints: "Sequence[cv2.KeyPoint]", shape: tuple[int, ...], most: int, cells: int = 16
) -> "list[cv2.KeyPoint]":
    """Return at most so many keypoints, the strongest of each cell of a grid, in a stable order."""
    ordered = sorted(keypoints, key=lambda k: (-k.response, k.pt, k.angle))
    rows = max(1, round(cells * shape[0] / shape[1]))
    quota = max(1, int(np.ceil(1.5 * most / (cells * rows))))
    taken = np.zeros((rows, cells), dtype=np.int64)
    kept = []
    for keypoint in ordered:
        row = min(int(keypoint.pt[1] * rows / shape[0]), rows - 1)
        column = min(int(keypoint.pt[0] * cells / shape[1]), cells - 1)
        if taken[row, column] < quota:
            taken[row, column] += 1
            kept.append(keypoint)
    return kept[:most]


def pairs_to_compare(count: int, positions_m: Array | None, neighbours: int) -> list[tuple[int, int]]:
    """Return pairs of stills (i < j) worth comparing: nearest by position (count, 3; NaN unknown) and in sequence.

    Without positions all pairs up to 40 stills, beyond that the nearest in sequence.
    """
    pairs: set[tuple[int, int]] = {(i, i + step) for step in (1, 2) for i in range(count - step)}
    known = np.zeros(count, dtype=bool) if positions_m is None else np.isfinite(positions_m).all(axis=1)
    if positions_m is not None:
        rows = np.flatnonzero(known)
        for i in rows.tolist():
            others = rows[rows != i]
            distance = np.linalg.norm(positions_m[others] - positions_m[i], axis=1)
            nearest = others[np.argsort(distance, kind="stable")[:neighbours]]
            pairs |= {(min(i, j), max(i, j)) for j in nearest.tolist()}
    for i in np.flatnonzero(~known).tolist():
        reach = count if count <= _EXHAUSTIVE_UP_TO else neighbours
        pairs |= {(min(i, j), max(i, j)) for j in range(max(0, i - reach), min(count, i + reach + 1)) if j != i}
    return sorted(pairs)


def match_descriptors(first: Features, second: Features) -> Indices:
    """Return rows (n, 2) of mutually nearest descriptors that pass the ratio test in one direction or the other."""
    if len(first.xy_px) < 2 or len(second.xy_px) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    likeness = first.unit_descriptors @ second.unit_descriptors.T
    return _mutual(*_two_best(likeness), *_two_best(likeness.T))


def _two_best(likeness: Descriptors) -> tuple[Descriptors, Indices]:
    """Return the best and second best likeness (n, 2) of each row, and the column of the best."""
    rows = np.arange(len(likeness))
    best = np.argmax(likeness, axis=1)
    first = likeness[rows, best].copy()
    likeness[rows, best] = UNLIKE
    second = likeness.max(axis=1)
    likeness[rows, best] = first
    return np.column_stack([first, second]), best


def _mutual(forth: Descriptors, forth_index: Indices, back: Descriptors, back_index: Indices) -> Indices:
    """Return the rows (n, 2) that choose each other and stand out from their second best, from one side at least."""
    rows = np.flatnonzero(forth[:, 0] > UNLIKE)
    rows = rows[back_index[forth_index[rows]] == rows]
    partners = forth_index[rows]
    good = np.minimum(_distance_ratio(forth[rows]), _distance_ratio(back[partners])) < LOWE_RATIO
    return np.column_stack([rows[good], partners[good]])


def _distance_ratio(likeness: Descriptors) -> Descriptors:
    """Return nearest over second nearest distance (n,) of unit vectors with these scalar products (n, 2)."""
    distance = np.sqrt(np.maximum(1.0 - likeness, 1e-9))
    return np.asarray(distance[:, 0] / distance[:, 1])


def epipolar_geometry(
    xy_first_px: Array, xy_second_px: Array, interior: InteriorOrientation
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the essential matrix (3, 3) in ideal coordinates, y down, and which matches (n, 2), (n, 2) agree with it.

    RANSAC with the five-point algorithm (Nister 2004). Without enough agreement the matrix is zero and none agrees.
    """
    nothing = np.zeros((3, 3)), np.zeros(len(xy_first_px), dtype=bool)
    if len(xy_first_px) < 8:
        return nothing
    first, second = ideal_from_pixels(xy_first_px, interior), ideal_from_pixels(xy_second_px, interior)
    essential, inliers = cv2.findEssentialMat(
        first,
        second,
        np.eye(3),
        method=cv2.RANSAC,
        prob=0.9999,
        threshold=EPIPOLAR_TOLERANCE_PX / interior.principal_distance_px,
        maxIters=4000,
    )
    if essential is None or essential.shape != (3, 3) or inliers is None:
        return nothing
    return np.asarray(essential, dtype=np.float64), np.asarray(inliers.ravel() > 0)


def match_guided(
    first: Features, second: Features, links: Indices, essential: Array, interior: InteriorOrientation
) -> Indices:
    """Match again among pairs near the epipolar line and near where the affine of the verified links sends a feature,
    up to the scatter that relief causes; returns rows (n, 2)."""
    source = np.column_stack([first.xy_px[links[:, 0]], np.ones(len(links))])
    coefficients, *_ = np.linalg.lstsq(source, second.xy_px[links[:, 1]], rcond=None)
    scatter = np.abs(source @ coefficients - second.xy_px[links[:, 1]])
    reach = 2.0 * np.quantile(scatter, 0.95, axis=0) + 0.01 * interior.width_px
    predicted = np.column_stack([first.xy_px, np.ones(len(first.xy_px))]) @ coefficients
    ideal = ideal_from_pixels(first.xy_px, interior), ideal_from_pixels(second.xy_px, interior)
    lines = np.column_stack([ideal[0], np.ones(len(ideal[0]))]) @ essential.T
    lines /= np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-12)[:, None]
    limits = np.array([*reach, EPIPOLAR_TOLERANCE_PX / interior.principal_distance_px])
    best = [np.full((len(f.xy_px), 2), UNLIKE, dtype=np.float32) for f in (first, second)]
    index = [np.zeros(len(f.xy_px), dtype=np.int64) for f in (first, second)]
    best_allowed(
        first.unit_descriptors,
        second.unit_descriptors,
        predicted.astype(np.float32),
        lines.astype(np.float32),
        second.xy_px.astype(np.float32),
        ideal[1].astype(np.float32),
        limits.astype(np.float32),
        best[0],
        index[0],
        best[1],
        index[1],
    )
    return _mutual(best[0], index[0], best[1], index[1])


def _in_order(work: Callable[[T], R], items: list[T], workers: int, progress: Progress, stage: str) -> list[R]:
    """Return [work(item) ...] computed by threads, telling progress."""
    results = []
    with ThreadPoolExecutor(max(1, workers)) as pool:
        for done, result in enumerate(pool.map(work, items), start=1):
            results.append(result)
            progress(stage, done, len(items))
    return results


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureMatches:
    """Verified matches of all pairs of stills, as links between numbered features."""

    features: list[Features]
    pairs: list[tuple[int, int]]
    links: list[Indices]
    """For each pair rows (n, 2) of features."""


def match_features(
    store: PictureStore,
    pairs: list[tuple[int, int]],
    interior: InteriorOrientation,
    options: CandidateOptions,
    cache: StepCache,
    *,
    workers: int,
    progress: Progress,
) -> FeatureMatches:
    """Detect features in all stills that occur in the pairs, match and verify each pair; both steps are cached."""

    def detect(index: int) -> Features:
        return _cached_features(store, index, options, cache)

    used = sorted({index for pair in pairs for index in pair})
    found = dict(zip(used, _in_order(detect, used, workers, progress, "features"), strict=True))
    nothing = Features(
        xy_px=np.zeros((0, 2)), size_px=np.zeros(0), angle_rad=np.zeros(0), descriptors=np.zeros((0, 128), np.uint8)
    )
    features = [found.get(index, nothing) for index in range(len(store))]

    def match(pair: tuple[int, int]) -> Indices:
        return _matched_pair(features[pair[0]], features[pair[1]], interior)

    links = _in_order(match, pairs, workers, progress, "feature matching")
    good = [row for row, link in enumerate(links) if len(link) >= LEAST_MATCHES]
    return FeatureMatches(features=features, pairs=[pairs[row] for row in good], links=[links[row] for row in good])


def _cached_features(store: PictureStore, index: int, options: CandidateOptions, cache: StepCache) -> Features:
    def compute() -> Arrays:
        found = detect_features(store.grey(index), options)
        return {"xy": found.xy_px, "size": found.size_px, "angle": found.angle_rad, "descriptors": found.descriptors}

    key = content_hash(["features 3", store.fingerprint(index), str((options.feature_width_px, options.features))])
    kept = cache.arrays("features", key, compute)
    return Features(xy_px=kept["xy"], size_px=kept["size"], angle_rad=kept["angle"], descriptors=kept["descriptors"])


def _matched_pair(first: Features, second: Features, interior: InteriorOrientation) -> Indices:
    """Match freely, find the epipolar geometry, then match again among what it allows: many more pass."""
    links = match_descriptors(first.strongest(_FREELY_MATCHED), second.strongest(_FREELY_MATCHED))
    essential, agrees = epipolar_geometry(first.xy_px[links[:, 0]], second.xy_px[links[:, 1]], interior)
    links = links[agrees]
    if len(links) < LEAST_MATCHES:
        return links[:0]
    guided = match_guided(first, second, links, essential, interior)
    _, agrees = epipolar_geometry(first.xy_px[guided[:, 0]], second.xy_px[guided[:, 1]], interior)
    return guided[agrees]


def feature_tasks(matches: FeatureMatches, interior: InteriorOrientation) -> RayTasks:
    """Chain the links to points (union-find), choose each point's reference still, and say what is to be measured.

    A point with two features in one still is contradictory and is left out. The reference is the still in which the
    point lies nearest to the middle: there the perspective on relief differs least from its neighbours'.
    """
    offsets = np.cumsum([0] + [len(f.xy_px) for f in matches.features])
    image_of = np.repeat(np.arange(len(matches.features)), np.diff(offsets))
    label = _components(
        int(offsets[-1]), [link + offsets[list(pair)] for pair, link in zip(matches.pairs, matches.links, strict=True)]
    )
    nodes = np.flatnonzero(np.bincount(label, minlength=len(label))[label] > 1)
    nodes = nodes[np.lexsort((nodes, label[nodes]))]
    xy = np.concatenate([f.xy_px for f in matches.features])
    size = np.concatenate([f.size_px for f in matches.features])
    angle = np.concatenate([f.angle_rad for f in matches.features])
    middle = 0.5 * np.array([interior.width_px - 1, interior.height_px - 1])
    starts = np.flatnonzero(np.r_[True, np.diff(label[nodes]) != 0]) if len(nodes) else np.zeros(0, int)
    rows: list[tuple[int, int, int]] = []
    for number, (begin, end) in enumerate(pairwise([*starts.tolist(), len(nodes)])):
        members = nodes[begin:end]
        if len(set(image_of[members].tolist())) < len(members):
            continue
        reference = members[int(np.argmin(np.linalg.norm(xy[members] - middle, axis=1)))]
        rows.extend((number, int(reference), int(node)) for node in members if node != reference)
    table = np.array(rows, dtype=np.int64).reshape(-1, 3)
    point, reference, target = table.T
    return RayTasks(
        point=point,
        reference_image=image_of[reference],
        reference_px=xy[reference],
        target_image=image_of[target],
        start_px=xy[target],
        warps=_similarity_warps(
            image_of[reference], image_of[target], angle[target] - angle[reference], size[target] / size[reference]
        ),
    )


def _components(count: int, links: list[Indices]) -> Indices:
    """Return the smallest node of the connected component of each of count nodes."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate(links) if links else np.zeros((0, 2), dtype=np.int64)
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return np.asarray(label, dtype=np.int64)


def _similarity_warps(reference: Indices, target: Indices, turn_rad: Array, scale: Array) -> Array:
    """Return warps (k, 2, 2) with the median rotation and scale of each pair of images: single features scatter."""
    warps = np.zeros((len(reference), 2, 2))
    pair = reference * (int(target.max(initial=0)) + 1) + target
    for number in np.unique(pair):
        rows = np.flatnonzero(pair == number)
        mean_turn = np.arctan2(np.median(np.sin(turn_rad[rows])), np.median(np.cos(turn_rad[rows])))
        ratio = float(np.median(scale[rows]))
        c, s = ratio * np.cos(mean_turn), ratio * np.sin(mean_turn)
        warps[rows] = [[c, -s], [s, c]]
    return warps
