"""The order in which images are eliminated from the reduced normal equations: nested dissection (George 1973).

The block is cut in two where few images separate its halves, and each half again. Images of one half share no point
with those of the other once the separating ones are eliminated last, so what fills in stays within small fronts.
"""

from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.process.normal_equations import Pattern

LEAF = 40
"""Parts of up to so many images are not cut again: dense arithmetic is quick there."""
LARGEST_SEPARATOR = 0.6
"""A separator above this share of its part saves nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Front:
    """Images eliminated together, and the later ones that their elimination ties to one another."""

    own: Indices
    boundary: Indices
    parent: int
    """Number of the front that takes the boundary up; -1 for none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Elimination:
    """Fronts in the order of their elimination, children before parents."""

    fronts: tuple[Front, ...]
    front_of_image: Indices
    """(n,)."""
    rank: Indices
    """(n,) place of an image in the order of elimination."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Neighbours:
    """The pattern both ways, without the diagonal: those of image i are rows start[i] to start[i + 1]."""

    start: Indices
    image: Indices

    def of(self, images: Indices) -> Indices:
        """Return all neighbours of images, with repetition."""
        if len(images) == 0:
            return np.zeros(0, dtype=np.int64)
        return np.concatenate([self.image[self.start[i] : self.start[i + 1]] for i in images])


def _neighbours(pattern: Pattern) -> _Neighbours:
    row, column = pattern.row, pattern.column
    apart = row != column
    a, b = np.concatenate([row[apart], column[apart]]), np.concatenate([column[apart], row[apart]])
    order = np.lexsort((b, a))
    start = np.searchsorted(a[order], np.arange(len(pattern.row_start)))
    return _Neighbours(start=start.astype(np.int64), image=b[order])


def dissect(pattern: Pattern, centres_m: Array) -> Elimination:
    """Return the order of elimination of images that see points in common, (n, 3) projection centres."""
    neighbours, images = _neighbours(pattern), len(centres_m)
    parts: list[Indices] = []
    # Own images of the fronts, parents before children; reversed, it is an order of elimination.
    waiting = [np.arange(images, dtype=np.int64)]
    while waiting:
        part = waiting.pop()
        separator, halves = _cut(part, neighbours, centres_m)
        parts.append(separator)
        waiting.extend(half for half in halves if len(half))
    parts = [part for part in parts[::-1] if len(part)]
    return _with_boundaries(parts, neighbours, images)


def _cut(part: Indices, neighbours: _Neighbours, centres_m: Array) -> tuple[Indices, tuple[Indices, ...]]:
    """Return the images that separate two halves of a part, and the halves; all of it and none where it is small."""
    if len(part) <= LEAF:
        return part, ()
    local = centres_m[part] - np.mean(centres_m[part], axis=0)
    axes = np.linalg.eigh(local.T @ local)[1][:, :0:-1]
    best, halves = part, (part[:0], part[:0])
    for along in (local @ axes).T:
        order = np.argsort(along, kind="stable")
        first, second = np.sort(part[order[: len(part) // 2]]), np.sort(part[order[len(part) // 2 :]])
        for a, b in ((first, second), (second, first)):
            separator = np.intersect1d(np.unique(neighbours.of(a)), b)
            if len(separator) < len(best):
                best, halves = separator, (a, np.setdiff1d(b, separator))
    if len(best) > LARGEST_SEPARATOR * len(part):
        return part, ()
    return best, halves


def _with_boundaries(parts: list[Indices], neighbours: _Neighbours, images: int) -> Elimination:
    """Return fronts with their boundaries: later neighbours of their own images, and of what they took up."""
    rank, front_of_image = np.empty(images, dtype=np.int64), np.empty(images, dtype=np.int64)
    order = np.concatenate(parts)
    rank[order] = np.arange(images)
    for number, part in enumerate(parts):
        front_of_image[part] = number
    taken_up: list[list[Indices]] = [[] for _ in parts]
    fronts = []
    for number, part in enumerate(parts):
        near = np.unique(np.concatenate([neighbours.of(part), *taken_up[number]]))
        boundary = near[front_of_image[near] > number]
        boundary = boundary[np.argsort(rank[boundary])]
        parent = int(front_of_image[boundary[0]]) if len(boundary) else -1
        if parent >= 0:
            taken_up[parent].append(boundary)
        fronts.append(Front(own=part, boundary=boundary, parent=parent))
    return Elimination(fronts=tuple(fronts), front_of_image=front_of_image, rank=rank)
