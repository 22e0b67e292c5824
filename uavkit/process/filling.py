"""Filling: new points where an oriented block has none, so that no part of the ground is left without.

Neither the video nor features lead everywhere: strip ends meet across strips, the finder crops the rim, and some
tracks are lost. Once stills are oriented, the points around a gap tell the depth of a new one well enough to find it
in another still.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil

import numpy as np
from scipy.spatial import cKDTree

from uavkit.core.arrays import Array, Indices
from uavkit.core.collinearity import image_coordinates, inside_image, object_rays
from uavkit.core.result import PointOrigin
from uavkit.process.candidates import Candidates, empty
from uavkit.process.options import CandidateOptions
from uavkit.process.orientation_code import CODE_COUNT, orientation_codes, richness, select_points
from uavkit.process.pyramid import ImagePyramid, full_from_level
from uavkit.process.tie_points import ObjectGeometry

CELLS = 1.75
"""Cells of a still in which a point is wanted, along its longer side, for each cell of ``CandidateOptions``."""
PER_CELL = 3
_DETECTION_LEVEL = 2
_RICHNESS_WINDOW_PX = 25
_NEIGHBOURS = 12
_LEAST_SCATTER = 0.005
"""Of the depth: what a surface is taken to deviate from the plane of its neighbours at least."""
_BEND = 0.3
"""Change of slope that is reckoned with where points lie outside their neighbours."""
_SLOPE_HOLD = 0.02
"""Weight, in neighbours, that holds a plane level against their slope where they all lie on one side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RichPlaces:
    """The pixels of one still that are richest in orientation codes, some in each cell."""

    xy_px: Array
    """(n, 2)."""
    rank: Indices
    """(n,) 0 for the richest of its cell."""
    cell_px: float

    def cells(self, xy_px: Array) -> Indices:
        """Return the number of the cell (n,) in which points (n, 2) of the still lie."""
        column, row = np.floor((xy_px + 0.5) / self.cell_px).astype(np.int64).T
        return np.asarray(row * 100_000 + column)


def rich_places(pyramid: ImagePyramid, options: CandidateOptions, margin_px: float) -> RichPlaces:
    """Choose the richest pixels of each cell of a still, ``margin_px`` off its border."""
    level = min(_DETECTION_LEVEL, len(pyramid.grey) - 1)
    small = pyramid.grey[level]
    cell_px = max(8, round(max(small.shape) / (CELLS * options.cells)))
    half = _RICHNESS_WINDOW_PX // 2
    codes = np.pad(orientation_codes(small), half, constant_values=CODE_COUNT)
    field = richness(codes, _RICHNESS_WINDOW_PX)[half:-half, half:-half]
    places = select_points(field, cell_px, PER_CELL, ceil(margin_px / 2**level))
    found = RichPlaces(
        xy_px=full_from_level(places, level),
        rank=np.zeros(len(places), dtype=np.int64),
        cell_px=float(cell_px * 2**level),
    )
    _, first, cell = np.unique(found.cells(found.xy_px), return_index=True, return_inverse=True)
    return replace(found, rank=np.arange(len(places)) - first[cell])


@dataclass(frozen=True, slots=True, kw_only=True)
class Filling:
    """Points without rays, and where about they are."""

    candidates: Candidates
    geometry: ObjectGeometry
    """Of the new points alone, in the stills of the block."""


def fill(geometry: ObjectGeometry, places: Sequence[RichPlaces], per_cell: int) -> Filling:
    """Choose up to ``per_cell`` points in each cell of each still into which no object point falls.

    What is chosen in one still counts as known in the next, so that a gap is filled once.
    """
    known = np.flatnonzero(np.isfinite(geometry.points[:, 0]))
    points, normals = geometry.points[known], geometry.normals[known]
    chosen: list[tuple[int, Array]] = []
    covariances = np.zeros((0, 3, 3))
    for image in np.flatnonzero(np.isfinite(geometry.centres[:, 0])).tolist():
        xy = image_coordinates(points, geometry.exterior(image), geometry.interior)
        inside = inside_image(xy, geometry.interior)
        if int(inside.sum()) < _NEIGHBOURS:
            continue
        here = places[image]
        wanted = (here.rank < per_cell) & ~np.isin(here.cells(here.xy_px), here.cells(xy[inside]))
        fresh = here.xy_px[wanted]
        new, covariance = _on_the_surface(geometry, image, xy[inside], points[inside], fresh)
        chosen.append((image, fresh))
        _, nearest = cKDTree(points[inside]).query(new)
        points, normals = np.vstack([points, new]), np.vstack([normals, normals[inside][nearest]])
        covariances = np.concatenate([covariances, covariance])
    return Filling(
        candidates=_without_rays(chosen),
        geometry=replace(
            geometry, points=points[len(known) :], normals=normals[len(known) :], point_covariances=covariances
        ),
    )


def _on_the_surface(
    geometry: ObjectGeometry, image: int, known_px: Array, known: Array, wanted_px: Array
) -> tuple[Array, Array]:
    """Return object points (n, 3) on the rays of wanted pixels (n, 2), with their covariances along these rays.

    Inverse depth is linear in the image of a plane: it is fitted to the nearest known points.
    """
    exterior = geometry.exterior(image)
    axis = exterior.R_object_from_image[:, 2]
    inverse = -1.0 / ((known - exterior.projection_centre_m) @ axis)
    _, near = cKDTree(known_px).query(wanted_px, k=_NEIGHBOURS)
    offset = known_px[near] - wanted_px[:, None]
    reach = np.linalg.norm(offset, axis=2).max(axis=1)
    design = np.concatenate([np.ones((*near.shape, 1)), offset / reach[:, None, None]], axis=2)
    normal = np.einsum("nki,nkj->nij", design, design) + np.diag([0.0, _SLOPE_HOLD, _SLOPE_HOLD]) * _NEIGHBOURS
    cofactors = np.linalg.inv(normal)
    middle = np.median(inverse[near], axis=1)
    plane = np.einsum("nij,nkj,nk->ni", cofactors, design, inverse[near] - middle[:, None])
    residual = inverse[near] - middle[:, None] - np.einsum("nki,ni->nk", design, plane)
    scatter = np.hypot(1.4826 * np.median(np.abs(residual), axis=1), _LEAST_SCATTER * middle)
    expected = np.clip(middle + plane[:, 0], 0.5 * middle, 2.0 * middle)
    leverage = cofactors[:, 0, 0]
    bend = _BEND * np.linalg.norm(offset, axis=2).min(axis=1) / geometry.interior.principal_distance_px
    sigma = np.hypot(scatter * np.sqrt(1.0 + leverage), expected * bend * np.minimum(leverage, 1.0))
    rays = object_rays(wanted_px, exterior, geometry.interior)
    rays = rays / -(rays @ axis)[:, None]
    along = rays * (sigma / expected**2)[:, None]
    return exterior.projection_centre_m + rays / expected[:, None], along[:, :, None] * along[:, None, :]


def _without_rays(chosen: list[tuple[int, Array]]) -> Candidates:
    if not chosen:
        return empty()
    image = np.concatenate([np.full(len(xy), row) for row, xy in chosen])
    return replace(
        empty(),
        reference_image=image,
        reference_px=np.concatenate([xy for _, xy in chosen]),
        origin=np.full(len(image), PointOrigin.FILLING, dtype=np.int8),
    )
