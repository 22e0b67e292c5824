"""Choosing points whose matching windows lie apart, so that no part of a still is measured twice.

The same grey values give the same error: features found twice, tracks that broke and were found again, and windows
that overlap repeat a measurement instead of adding one. On simulated stills the errors of two rays of one pair of
stills correlate by 0.98 within 2 px, by 0.2 to 0.5 at a quarter of the window and below 0.1 from half a window on.
An adjustment takes rays as uncorrelated; repeated ones make it state sigmas that are too small.
"""

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.process.candidates import Candidates


def points_apart(candidates: Candidates, least_distance_px: float) -> Flags:
    """Return which points (m,) to keep so that no two of them come closer than a distance in any still.

    Of points that conflict the one with more rays is kept, then the one of the smaller mean sigma, then the first.
    Points without rays are not kept.
    """
    point, image, xy, sigma = candidates.all_rays()
    count = np.bincount(point, minlength=len(candidates))
    mean_sigma = np.bincount(point, sigma.mean(axis=1), len(candidates)) / np.maximum(count, 1)
    rank = np.empty(len(candidates), dtype=np.int64)
    rank[np.lexsort((mean_sigma, -count))] = np.arange(len(candidates))
    return np.asarray(_best_apart(rank, _close_points(point, image, xy, least_distance_px)) & (count > 0))


def _close_points(point: Indices, image: Indices, xy_px: Array, distance_px: float) -> NDArray[np.int64]:
    """Return the pairs of points (e, 2), each once, that lie closer than a distance in at least one still."""
    from scipy.spatial import cKDTree

    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for number in np.unique(image).tolist():
        rows = np.flatnonzero(image == number)
        close = cKDTree(xy_px[rows]).query_pairs(distance_px, output_type="ndarray")
        pairs.append(np.sort(point[rows][close], axis=1))
    return np.unique(np.concatenate(pairs), axis=0)


def _best_apart(rank: Indices, pairs: NDArray[np.int64]) -> Flags:
    """Return what taking points by ascending rank, each unless in conflict with one taken before, would keep."""
    keep, open_ = np.zeros(len(rank), dtype=bool), np.ones(len(rank), dtype=bool)
    while open_.any():
        best = rank.copy()
        np.minimum.at(best, pairs[:, 0], rank[pairs[:, 1]])
        np.minimum.at(best, pairs[:, 1], rank[pairs[:, 0]])
        taken = open_ & (best == rank)
        keep |= taken
        open_ &= ~taken
        open_[pairs[taken[pairs[:, 0]], 1]] = False
        open_[pairs[taken[pairs[:, 1]], 0]] = False
        pairs = pairs[open_[pairs].all(axis=1)]
    return keep
