"""From the video pixel down to the still pixel: orientation code matching through an image pyramid.

One video pixel is about six still pixels and least squares matching pulls in from two, so tracked positions are refined
on 1/8, 1/4, 1/2 of the still and on the still itself.
"""

from dataclasses import dataclass
from math import ceil

import cv2
import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags
from uavkit.core.errors import InputError
from uavkit.process.orientation_code import (
    Dissimilarity,
    MatchPlan,
    PointMatches,
    coding_threshold,
    match_codes_at,
    packed_codes,
)

Grey = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagePyramid:
    """A still at 1/1, 1/2, 1/4, ... of its size, with its orientation codes; made once by build_pyramid."""

    grey: tuple[Grey, ...]
    packed: tuple[Grey, ...]
    thresholds: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class PyramidOptions:
    """Lengths in pixels of the still, unless said otherwise."""

    start_radius_px: float = 16.0
    """How far the prediction may be off."""
    level_radius_px: int = 2
    """Half width of the search on each level after the first, pixels of that level."""
    window_px: int = 21
    """Side of the templates on every level, pixels of that level."""
    most_dissimilarity: float = 2.9
    """In codes; 4 is chance."""
    most_ambiguity: float = 0.95
    variant: Dissimilarity = Dissimilarity.PAPER


@dataclass(frozen=True, slots=True, kw_only=True)
class RefinedPoints:
    """Positions in the target still, one row a point."""

    target_px: Array
    """(n, 2); the last good estimate, at least the prediction, where ok is false."""
    ok: Flags
    """Found on the still itself, (n,)."""
    dissimilarity: Array
    """On the finest level on which the point was found, in codes, (n,); nan if on none."""


def build_pyramid(image: Grey, levels: int = 4) -> ImagePyramid:
    """Halve a still (h, w) by means of 2 x 2 pixels, levels - 1 times, and code every level."""
    if image.ndim != 2 or image.dtype != np.uint8 or min(image.shape) < 16 * 2**levels:
        raise InputError(f"a pyramid of {levels} levels needs a larger 8-bit picture than {image.dtype} {image.shape}")
    grey = [np.ascontiguousarray(image)]
    for _ in range(levels - 1):
        rows, columns = (side // 2 for side in grey[-1].shape)
        even = grey[-1][: 2 * rows, : 2 * columns]
        grey.append(np.asarray(cv2.resize(even, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8))
    thresholds = tuple(coding_threshold(picture) for picture in grey)
    packed = tuple(packed_codes(picture, limit) for picture, limit in zip(grey, thresholds, strict=True))
    return ImagePyramid(grey=tuple(grey), packed=packed, thresholds=thresholds)


def level_from_full(points_px: Array, level: int) -> Array:
    """Positions (n, 2) on a level of full-size positions: a halving is x_half = (x - 1/2) / 2, centres at integers."""
    scale = 2.0**level
    return np.asarray((points_px - (scale - 1) / 2) / scale)


def full_from_level(points_px: Array, level: int) -> Array:
    """Full-size positions (n, 2) of positions on a level."""
    scale = 2.0**level
    return np.asarray(points_px * scale + (scale - 1) / 2)


def refine_through_pyramid(
    reference: ImagePyramid,
    target: ImagePyramid,
    reference_px: Array,
    target_px: Array,
    warps: Array,
    options: PyramidOptions | None = None,
) -> RefinedPoints:
    """Bring predicted positions target_px (n, 2) to within about a pixel; warps (n, 2, 2) are target_from_reference.

    A point that is not found on one level is searched more widely on the next finer one; what counts is the finest.
    """
    chosen = options or PyramidOptions()
    _check(reference, target, reference_px, target_px, warps)
    reference_from_target = np.asarray(np.linalg.inv(warps), np.float64)
    positions = np.array(target_px, np.float64)
    uncertain_px = np.full(len(positions), float(chosen.start_radius_px))
    dissimilarity = np.full(len(positions), np.nan)
    found = np.zeros(len(positions), np.bool_)
    for level in reversed(range(len(reference.grey))):
        radii = np.ceil(uncertain_px / 2.0**level).astype(np.int64) + 1
        # a search on a fine level never grows beyond that of the first: it would cost much and find chance
        radii = np.minimum(radii, ceil(chosen.start_radius_px / 2.0 ** (len(reference.grey) - 1)) + 4)
        matches = _match_level(
            reference, target, level, (reference_px, positions, reference_from_target), radii, chosen
        )
        found = (matches.dissimilarity <= chosen.most_dissimilarity) & ~matches.on_rim
        found &= ~(matches.ambiguity > chosen.most_ambiguity)
        positions[found] = full_from_level(matches.points_px[found], level)
        dissimilarity[found] = matches.dissimilarity[found]
        # one pixel of this level is two of the next, where level_radius_px is to remain
        uncertain_px[found] = (chosen.level_radius_px - 1) * 2.0 ** max(level - 1, 0)
    return RefinedPoints(target_px=positions, ok=np.asarray(found), dissimilarity=dissimilarity)


def _match_level(
    reference: ImagePyramid,
    target: ImagePyramid,
    level: int,
    geometry: tuple[Array, Array, Array],
    radii: NDArray[np.int64],
    options: PyramidOptions,
) -> PointMatches:
    reference_px, positions, reference_from_target = geometry
    plan = MatchPlan(
        reference_px=level_from_full(reference_px, level),
        predicted_px=level_from_full(positions, level),
        reference_from_target=reference_from_target,
        radii_px=radii,
    )
    return match_codes_at(
        reference.grey[level],
        target.packed[level],
        plan,
        threshold=reference.thresholds[level],
        window_px=options.window_px,
        variant=options.variant,
    )


def _check(reference: ImagePyramid, target: ImagePyramid, reference_px: Array, target_px: Array, warps: Array) -> None:
    if len(reference.grey) != len(target.grey):
        raise InputError(f"pyramids differ in levels: {len(reference.grey)} and {len(target.grey)}")
    count = len(reference_px)
    if reference_px.shape != (count, 2) or target_px.shape != (count, 2) or warps.shape != (count, 2, 2):
        raise InputError(
            f"need points (n, 2), (n, 2) and warps (n, 2, 2), got {[a.shape for a in (reference_px, target_px, warps)]}"
        )
