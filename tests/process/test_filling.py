"""Filling of gaps in rendered stills of known orientation, over relief."""

from dataclasses import replace

import numpy as np
import pytest

from tests.process.made_blocks import SMALL, Ground, MadeStills, carpet, still_of
from tests.process.test_tie_points import PLACES, _geometry, _matching, _true_transfer
from uavkit.core.arrays import Array
from uavkit.core.collinearity import image_coordinates, inside_image, object_rays
from uavkit.core.result import PointOrigin
from uavkit.process.filling import PER_CELL, Filling, RichPlaces, fill, rich_places
from uavkit.process.options import CandidateOptions
from uavkit.process.tie_points import ObjectGeometry

GROUND = Ground(1.0)
OPTIONS = CandidateOptions(cells=12)
MARGIN_PX = 14.0


@pytest.fixture(scope="module")
def stills() -> MadeStills:
    rng = np.random.default_rng(18)
    cover = carpet(rng, (-14.0, -13.0), (18.0, 18.0), 15.0 / 537.0)
    return MadeStills({f"{n}": still_of(p, SMALL, GROUND, cover, rng) for n, p in enumerate(PLACES)})


@pytest.fixture(scope="module")
def places(stills: MadeStills) -> list[RichPlaces]:
    matching = _matching(stills)
    return [rich_places(matching.pyramids.get(image), OPTIONS, MARGIN_PX) for image in range(len(PLACES))]


def _with_a_gap() -> ObjectGeometry:
    """The left 300 columns and a window in the right half of still 0 hold no point."""
    scene = _geometry(GROUND)
    column, row = scene.reference_px.T
    keep = (column > 300) & ~((np.abs(column - 560) < 80) & (np.abs(row - 300) < 80))
    return scene.geometry.only_points(keep)


@pytest.fixture(scope="module")
def filled(places: list[RichPlaces]) -> Filling:
    return fill(_with_a_gap(), places, 1)


def _true_points(filling: Filling) -> Array:
    points = np.full(filling.geometry.points.shape, np.nan)
    for image in np.unique(filling.candidates.reference_image):
        rows = filling.candidates.reference_image == image
        rays = object_rays(filling.candidates.reference_px[rows], PLACES[image], SMALL)
        points[rows] = GROUND.under(PLACES[image], rays)
    return points


def test_places_are_ranked_within_their_cells_and_off_the_border(places: list[RichPlaces]) -> None:
    for here in places:
        cells = here.cells(here.xy_px)
        assert here.rank.min() == 0
        assert here.rank.max() == PER_CELL - 1
        for cell in np.unique(cells)[:20]:
            assert sorted(here.rank[cells == cell]) == list(range(int(np.sum(cells == cell))))
        assert np.all(here.xy_px > MARGIN_PX - 1)
        assert np.all(here.xy_px < [SMALL.width_px - MARGIN_PX, SMALL.height_px - MARGIN_PX])


def test_points_are_chosen_in_empty_cells_only(filled: Filling, places: list[RichPlaces]) -> None:
    rows = filled.candidates.reference_image == 0
    xy = filled.candidates.reference_px[rows]
    here = places[0]
    present = image_coordinates(_with_a_gap().points, PLACES[0], SMALL)
    assert not np.any(np.isin(here.cells(xy), here.cells(present)))
    assert len(np.unique(here.cells(xy))) == len(xy)
    gap = (xy[:, 0] < 250) | (np.linalg.norm(xy - [560, 300], axis=1) < 60)
    assert gap.sum() > 40
    assert np.all(filled.candidates.origin == PointOrigin.FILLING)
    assert len(filled.candidates.ray_point) == 0


def test_a_gap_is_filled_once(filled: Filling, places: list[RichPlaces]) -> None:
    """What was chosen in still 0 keeps its cells of still 1 from being chosen again."""
    first = filled.geometry.points[filled.candidates.reference_image == 0]
    seen = image_coordinates(first, PLACES[1], SMALL)
    own = filled.candidates.reference_px[filled.candidates.reference_image == 1]
    assert not np.any(np.isin(places[1].cells(own), places[1].cells(seen)))
    assert len(own) < 0.6 * np.sum(places[1].rank == 0)


def test_where_about_a_new_point_is_is_told_with_its_sigma(filled: Filling) -> None:
    error = np.linalg.norm(filled.geometry.points - _true_points(filled), axis=1)
    sigma = np.sqrt(np.trace(filled.geometry.point_covariances, axis1=1, axis2=2))
    assert np.median(error) < 0.3  # relief of 1 m, seen from 15 m
    assert np.mean(error < 3.0 * sigma) > 0.9
    rays = filled.geometry.points - filled.geometry.centres[filled.candidates.reference_image]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    across = np.einsum("nij,nj->ni", filled.geometry.point_covariances, rays) - (sigma**2)[:, None] * rays
    assert np.abs(across).max() < 1e-9 * np.max(sigma) ** 2 + 1e-12


def test_new_points_are_measured_where_they_are(stills: MadeStills, filled: Filling) -> None:
    matched = _matching(stills).match_in_one(filled.candidates, filled.geometry)
    assert np.bincount(matched.ray_point).max() == 1
    points, seen = _true_points(filled), np.zeros(len(matched), dtype=np.int64)
    for image, place in enumerate(PLACES):
        inside = inside_image(image_coordinates(points, place, SMALL), SMALL, MARGIN_PX)
        seen += inside & (filled.candidates.reference_image != image)
    assert len(matched.ray_point) > 0.75 * np.sum(seen > 0)
    from_first = matched.reference_image[matched.ray_point] == 0
    for target in (1, 2):
        rows = from_first & (matched.ray_image == target)
        truth = _true_transfer(GROUND, matched.reference_px[matched.ray_point[rows]], target)
        error = np.linalg.norm(matched.ray_px[rows] - truth, axis=1)
        assert np.mean(error < 0.5) > 0.95


def test_a_still_that_is_not_oriented_gets_no_points(places: list[RichPlaces]) -> None:
    geometry = _with_a_gap()
    centres = geometry.centres.copy()
    centres[1] = np.nan
    filled = fill(replace(geometry, centres=centres), places, 1)
    assert set(filled.candidates.reference_image.tolist()) <= {0, 2}
