"""Which stills hold one another: whose rays, once gross errors are found, still tie them into one rigid block."""

import numpy as np

from uavkit.core.arrays import Array, Flags, Indices

LEAST_SHARED = (8, 12, 20, 40)
"""Rays to points that others of the block see too; each is tried in turn, the least that leaves stills out counts."""
LEAST_KNOWN = (4, 8, 16, 32)
"""Of these, rays to points that two others fix: they give the still its scale."""

MOST_LOOSENED = 5
"""Adjustments in turn, each without the stills that the last one found loose."""


def loose_stills(image: Indices, point: Indices, count: int) -> Indices:
    """Return the stills, of ``count``, that do not belong to the largest rigid part of a block.

    ``image`` and ``point`` (k,) are the rays that hold. A part is built as a block is: of two stills with most points
    in common, then of any still that sees enough points of it, some of them fixed by two others already.
    Empty where no demand parts the block.
    """
    for shared, known in zip(LEAST_SHARED, LEAST_KNOWN, strict=True):
        part = _largest_part(image, point, count, (shared, known))
        if not part.all():
            return np.flatnonzero(~part)
    return np.zeros(0, dtype=np.int64)


def _largest_part(image: Indices, point: Indices, count: int, least: tuple[int, int]) -> Flags:
    """Return which stills belong to the largest rigid part, (count,)."""
    _, point = np.unique(point, return_inverse=True)
    sees = np.zeros((count, int(point.max(initial=-1)) + 1), dtype=np.float64)
    sees[image, point] = 1.0
    common = np.triu(sees @ sees.T, 1)
    largest, rest = np.zeros(count, dtype=np.bool_), np.ones(count, dtype=np.bool_)
    while rest.sum() > largest.sum():
        pairs = np.where(rest[:, None] & rest[None, :], common, 0.0)
        seed = np.unravel_index(int(np.argmax(pairs)), pairs.shape)
        if pairs[seed] < least[0]:
            break
        part = _grown(sees, np.isin(np.arange(count), seed), least)
        largest = part if part.sum() > largest.sum() else largest
        rest &= ~part
    return largest


def _grown(sees: Array, part: Flags, least: tuple[int, int]) -> Flags:
    """Return a part of the stills, (n,), with all that can be added to it; ``sees`` (n, m) is 1 for each ray."""
    while True:
        rays = sees[part].sum(axis=0)
        joins = (sees @ (rays >= 1) >= least[0]) & (sees @ (rays >= 2) >= least[1]) & ~part
        if not joins.any():
            return part
        part = part | joins
