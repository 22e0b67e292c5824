"""Parts of a block: stills that hang together, while too few points tie them to the others.

Points that two stills alone show orient these to each other, but carry no scale on to a third. So a block falls into
parts where three stills in a row have no ground in common, or a gap of the video lies between them, though each pair
of neighbours is tied.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.camera import InteriorOrientation, InteriorSigmas
from uavkit.core.errors import AdjustmentError
from uavkit.core.progress import Progress
from uavkit.process.approximations import (
    LEAST_RESECTION_POINTS,
    GrowingBlock,
    RayTable,
    common_points,
    orient_approximately,
    ray_table,
)
from uavkit.process.candidates import Candidates, join

Pairs = list[tuple[int, int]]
"""Pairs of rows of stills, the smaller row first."""


def orient_in_parts(
    rays: RayTable,
    counts: tuple[int, int],
    interior: InteriorOrientation,
    sigmas: InteriorSigmas,
    progress: Progress,
) -> list[GrowingBlock]:
    """Orient all stills that hang together with others; ``counts`` is the number of stills and of points.

    Returns the parts, the one of most stills first, each in a frame of its own; a still may be in several of them.
    Raises AdjustmentError where not even two stills can be oriented to each other.
    """
    parts = [orient_approximately(rays, counts, interior, sigmas, progress)]
    left = ~parts[0].oriented
    while left.sum() >= 2:
        try:
            part = orient_approximately(rays, counts, interior, sigmas, progress, left)
        except AdjustmentError:  # no two of those left over hang together
            break
        if not (part.oriented & left).any():
            break
        parts.append(part)
        left &= ~part.oriented
    return sorted(parts, key=lambda part: -int(part.oriented.sum()))


def part_numbers(parts: list[GrowingBlock], count: int) -> Indices:
    """Return the number of the part that each still belongs to (count,): the largest one, or one of its own."""
    number = np.arange(count) + len(parts)
    for row in reversed(range(len(parts))):
        number[parts[row].oriented] = row
    return number


def tied_across(common: Array, part: Indices) -> Flags:
    """Tell which stills (n,) share points, as many as orient a still, with one of another part.

    ``common`` (n, n) is how many points each pair of stills has in common.
    """
    across = part[:, None] != part[None, :]
    return np.asarray(np.any(across & (common >= LEAST_RESECTION_POINTS), axis=1))


def pairs_to_add(untried: Pairs, part: Indices, common: Array) -> Pairs:
    """Return the pairs of stills that may join the parts (n,) of a block; ``common`` (n, n) are points by features.

    First those between parts. Then those with a still that features tie to another part: a point which no other still
    of its part shows has no depth there, and carries no scale over.
    """
    between = [(i, j) for i, j in untried if part[i] != part[j]]
    tied = tied_across(common, part)
    return between or [(i, j) for i, j in untried if tied[i] or tied[j]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """A block as whole as features make it."""

    candidates: Candidates
    block: GrowingBlock
    """The part of most stills."""
    notes: list[str]


def joined_by_features(
    through: Candidates,
    pairs: tuple[Pairs, Pairs],
    interior: InteriorOrientation,
    match: Callable[[Pairs], Candidates],
    orient: Callable[[Candidates], list[GrowingBlock]],
) -> Joined:
    """Orient a block; while it falls into parts, match features in further pairs of stills between these.

    ``through`` are points through the video, ``pairs`` those to match at once and those that may be matched later.
    The features of all pairs so far become common points each time: one in three stills joins parts by itself. Raises
    the AdjustmentError of ``orient`` where no pair is left to try.
    """
    now, later = pairs
    count, notes = 1 + max((j for _, j in now + later), default=0), list[str]()
    while True:
        features, failure = match(now), None
        candidates = join([through, features])
        try:
            parts = orient(candidates)
        except AdjustmentError as error:
            parts, failure = [], error
        point, image, xy, _ = features.all_rays()
        part = part_numbers(parts, count)
        more = pairs_to_add(later, part, common_points(ray_table(point, image, xy, interior), count))
        if not more and failure is not None:
            raise failure
        if not more:
            return Joined(candidates=candidates, block=parts[0], notes=notes)
        notes.append(
            f"the stills fell into {len(np.unique(part))} parts with too few points in common: "
            f"features were tried in {len(more)} more pairs"
        )
        now, later = sorted({*now, *more}), sorted({*later} - {*more})
