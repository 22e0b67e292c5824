"""Tie point matching by back-projection in rendered stills of known orientation."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.process.made_blocks import SMALL, Ground, MadeStills, carpet, still_of
from uavkit.core.angles import rotation_from_omega_phi_kappa, rotation_from_vector
from uavkit.core.arrays import Array
from uavkit.core.collinearity import image_coordinates, inside_image, object_rays
from uavkit.core.orientation import ExteriorOrientation
from uavkit.core.progress import silent
from uavkit.process.measurement import RayTasks
from uavkit.process.options import MeasurementOptions
from uavkit.process.pictures import PictureStore, PyramidStore
from uavkit.process.tie_points import (
    ObjectGeometry,
    TiePointMatching,
    surface_normals,
    visible_tasks,
)

PLANE = Ground(0.0)
MARGIN_PX = 18.0


def _station(
    east: float, north: float, omega: float, phi: float, kappa: float, up: float = 15.0
) -> ExteriorOrientation:
    return ExteriorOrientation(
        projection_centre_m=np.array([east, north, up]),
        R_object_from_image=rotation_from_omega_phi_kappa(omega, phi, kappa),
    )


PLACES = [_station(0, 0, 0.03, -0.02, 0.1), _station(4, 0.5, -0.05, 0.04, 0.0), _station(3, 6, 0.02, 0.06, 3.2)]


@dataclass(frozen=True)
class Scene:
    geometry: ObjectGeometry
    reference_image: Array
    reference_px: Array


def _geometry(ground: Ground, point_sigma_m: float = 0.0, centre_sigma_m: float = 0.0) -> Scene:
    """Points chosen on a grid of still 0, with their true positions and normals."""
    column, row = np.meshgrid(np.arange(40.0, 780.0, 60.0), np.arange(40.0, 580.0, 60.0))
    xy = np.column_stack([column.ravel(), row.ravel()]) + 0.3
    points = ground.under(PLACES[0], object_rays(xy, PLACES[0], SMALL))
    h = 1e-4
    slope = [
        (ground.height_m(points[:, 0] + dx, points[:, 1] + dy) - ground.height_m(points[:, 0] - dx, points[:, 1] - dy))
        / (2 * h)
        for dx, dy in ((h, 0.0), (0.0, h))
    ]
    normals = np.column_stack([-slope[0], -slope[1], np.ones(len(points))])
    exterior = np.zeros((3, 6, 6))
    exterior[:, :3, :3] = centre_sigma_m**2 * np.eye(3)
    geometry = ObjectGeometry(
        interior=SMALL,
        centres=np.array([p.projection_centre_m for p in PLACES]),
        rotations=np.array([p.R_object_from_image for p in PLACES]),
        exterior_covariances=exterior,
        points=points,
        point_covariances=np.tile(point_sigma_m**2 * np.eye(3), (len(points), 1, 1)),
        normals=normals / np.linalg.norm(normals, axis=1)[:, None],
    )
    return Scene(geometry, np.zeros(len(points), dtype=np.int64), xy)


def _true_transfer(ground: Ground, xy: Array, target: int) -> Array:
    return image_coordinates(ground.under(PLACES[0], object_rays(xy, PLACES[0], SMALL)), PLACES[target], SMALL)


@pytest.mark.parametrize("relief_m", [0.0, 1.5])
def test_starts_and_warps_are_those_of_the_surface(relief_m: float) -> None:
    ground = Ground(relief_m)
    scene = _geometry(ground)
    tasks, _ = visible_tasks(scene.geometry, scene.reference_image, scene.reference_px, MARGIN_PX)
    assert set(tasks.target_image.tolist()) == {1, 2}
    for target in (1, 2):
        rows = tasks.target_image == target
        xy = tasks.reference_px[rows]
        np.testing.assert_array_equal(xy, scene.reference_px[tasks.point[rows]])
        np.testing.assert_allclose(tasks.start_px[rows], _true_transfer(ground, xy, target), atol=1e-3)
        for axis in (0, 1):
            h = 0.5 * np.eye(2)[axis]
            slope = _true_transfer(ground, xy + h, target) - _true_transfer(ground, xy - h, target)
            np.testing.assert_allclose(tasks.warps[rows][:, :, axis], slope, atol=0.02)


def test_every_point_in_view_is_tasked_and_no_other() -> None:
    scene = _geometry(PLANE)
    tasks, radii = visible_tasks(scene.geometry, scene.reference_image, scene.reference_px, MARGIN_PX)
    assert len(radii) == len(tasks)
    for target in (1, 2):
        xy = image_coordinates(scene.geometry.points, PLACES[target], SMALL)
        seen = np.flatnonzero(inside_image(xy, SMALL, MARGIN_PX))
        assert tasks.point[tasks.target_image == target].tolist() == seen.tolist()
        assert 0 < len(seen) < len(xy)


def test_points_turned_away_or_unknown_are_not_tasked() -> None:
    scene = _geometry(PLANE)
    normals, points = scene.geometry.normals.copy(), scene.geometry.points.copy()
    normals[::3] = [np.sin(1.5), 0.0, np.cos(1.5)]  # facing east, at 86 degrees from the vertical
    normals[1::3] = [0.0, 0.0, -1.0]
    points[2] = np.nan
    geometry = replace(scene.geometry, normals=normals, points=points)
    tasks, _ = visible_tasks(geometry, scene.reference_image, scene.reference_px, MARGIN_PX)
    assert not np.any(tasks.point % 3 == 1)
    assert 2 not in tasks.point
    assert np.any(tasks.point % 3 == 2)
    east = tasks.point[tasks.point % 3 == 0]  # seen only by stations well east of the point
    assert len(east) < 0.5 * np.sum(tasks.point % 3 == 2)
    unoriented = replace(scene.geometry, centres=np.where([[True], [False], [True]], scene.geometry.centres, np.nan))
    tasks, _ = visible_tasks(unoriented, scene.reference_image, scene.reference_px, MARGIN_PX)
    assert set(tasks.target_image.tolist()) == {2}


def test_nothing_in_view_gives_no_tasks() -> None:
    scene = _geometry(PLANE)
    far = replace(scene.geometry, centres=scene.geometry.centres + [[0, 0, 0], [500.0, 0, 0], [0, 500.0, 0]])
    tasks, radii = visible_tasks(far, scene.reference_image, scene.reference_px, MARGIN_PX)
    assert (len(tasks), len(radii)) == (0, 0)


def test_radii_are_three_sigma_of_the_prediction() -> None:
    """1 px on the ground is 15 m / 537 = 28 mm: sigma 56 mm of point and of station give 3 x sqrt(4 + 4) px."""
    gsd = 15.0 / 537.0
    radii = []
    for point, centre in ((2 * gsd, 0.0), (0.0, 2 * gsd), (2 * gsd, 2 * gsd), (4 * gsd, 0.0)):
        scene = _geometry(PLANE, point, centre)
        radii.append(visible_tasks(scene.geometry, scene.reference_image, scene.reference_px, MARGIN_PX)[1])
    np.testing.assert_allclose(radii[0], radii[1], rtol=1e-9)
    np.testing.assert_allclose(radii[2], np.sqrt(2) * radii[0], rtol=1e-9)
    np.testing.assert_allclose(radii[3], 2 * radii[0], rtol=1e-9)
    # 2 px across the line of sight; farther out the height adds its part: sqrt(1 + (r / c)^2), 1.37 in the corner
    assert 5.9 < radii[0].min() < 6.6
    assert 6.0 * 1.2 < radii[0].max() < 6.0 * 1.45


def test_normals_of_a_slope() -> None:
    rng = np.random.default_rng(3)
    plan = rng.uniform(-5, 5, (300, 2))
    normal = np.array([-0.4, 0.3, 1.0]) / np.linalg.norm([-0.4, 0.3, 1.0])
    points = np.column_stack([plan, 0.4 * plan[:, 0] - 0.3 * plan[:, 1]]) + rng.normal(0, 0.005, (300, 3))
    points[7] = np.nan
    view = np.tile([0.0, 0.0, 15.0], (300, 1))
    found = surface_normals(points, view)
    np.testing.assert_allclose(found[7], [0, 0, 1])
    cosine = np.delete(found, 7, axis=0) @ normal
    # The medians of twelve neighbours' coordinates lie off the plane by some centimetres over a radius of one metre.
    assert np.quantile(cosine, 0.05) > np.cos(np.radians(5.0))
    assert np.median(cosine) > np.cos(np.radians(2.0))
    np.testing.assert_allclose(surface_normals(points, -view)[:7] @ normal, -cosine[:7])
    few = surface_normals(points[:5], view[:5])
    np.testing.assert_allclose(few, np.tile([0, 0, 1.0], (5, 1)))


@pytest.fixture(scope="module")
def pictured() -> tuple[MadeStills, Ground]:
    rng = np.random.default_rng(17)
    ground = Ground(1.0)
    cover = carpet(rng, (-14.0, -13.0), (18.0, 18.0), 15.0 / 537.0)
    return MadeStills({f"{n}": still_of(p, SMALL, ground, cover, rng) for n, p in enumerate(PLACES)}), ground


def _matching(stills: MadeStills, workers: int = 1) -> TiePointMatching:
    store = PictureStore(stills, tuple(stills.pictures))
    return TiePointMatching(
        pyramids=PyramidStore(store), options=MeasurementOptions(window_px=21), workers=workers,
        progress=silent,
    )  # fmt: skip


def _shifted(tasks: RayTasks, rng: np.random.Generator, reach_px: float) -> RayTasks:
    angle = rng.uniform(0, 2 * np.pi, len(tasks))
    return replace(tasks, start_px=tasks.start_px + reach_px * np.column_stack([np.cos(angle), np.sin(angle)]))


def test_a_wrong_start_within_the_radius_is_mended_by_the_search(pictured: tuple[MadeStills, Ground]) -> None:
    stills, ground = pictured
    scene = _geometry(ground)
    tasks, _ = visible_tasks(scene.geometry, scene.reference_image, scene.reference_px, MARGIN_PX + 16)
    truth = tasks.start_px
    wrong = _shifted(tasks, np.random.default_rng(1), 12.0)
    found_tasks, found = _matching(stills)._search(wrong, np.full(len(wrong), 15.0))
    error = np.linalg.norm(found_tasks.start_px - truth, axis=1)
    assert found.mean() > 0.7
    assert np.mean(error[found] < 2.0) > 0.97
    np.testing.assert_array_equal(found_tasks.start_px[~found], wrong.start_px[~found])
    # a radius that least squares matching covers is left to it
    kept, measurable = _matching(stills)._search(wrong, np.full(len(wrong), 1.5))
    assert measurable.all()
    np.testing.assert_array_equal(kept.start_px, wrong.start_px)


def test_the_search_is_the_same_with_any_number_of_workers(pictured: tuple[MadeStills, Ground]) -> None:
    stills, ground = pictured
    scene = _geometry(ground)
    tasks, _ = visible_tasks(scene.geometry, scene.reference_image, scene.reference_px, MARGIN_PX + 16)
    wrong = _shifted(tasks, np.random.default_rng(2), 9.0)
    radii = np.linspace(1.0, 40.0, len(wrong))
    one, two = (_matching(stills, workers)._search(wrong, radii) for workers in (1, 2))
    np.testing.assert_array_equal(one[0].start_px, two[0].start_px)
    np.testing.assert_array_equal(one[1], two[1])


def test_another_scene_is_not_found(pictured: tuple[MadeStills, Ground]) -> None:
    stills, ground = pictured
    rng = np.random.default_rng(99)
    other = carpet(rng, (-14.0, -13.0), (18.0, 18.0), 15.0 / 537.0)
    strange = MadeStills({**stills.pictures, "1": still_of(PLACES[1], SMALL, ground, other, rng)})
    scene = _geometry(ground)
    tasks, _ = visible_tasks(scene.geometry, scene.reference_image, scene.reference_px, MARGIN_PX + 16)
    _, found = _matching(strange)._search(tasks, np.full(len(tasks), 12.0))
    assert found[tasks.target_image == 2].mean() > 0.7
    assert found[tasks.target_image == 1].mean() < 0.05


def test_a_turned_still_moves_the_starts_the_way_it_turns() -> None:
    """A small rotation about image space's y (up) to the right moves the scene to the left by c times the angle."""
    scene = _geometry(PLANE)
    tasks, _ = visible_tasks(scene.geometry, scene.reference_image, scene.reference_px, 100.0)
    rotations = scene.geometry.rotations.copy()
    rotations[1] = rotations[1] @ rotation_from_vector(np.array([0.0, -0.01, 0.0]))
    turned, _ = visible_tasks(
        replace(scene.geometry, rotations=rotations), scene.reference_image, scene.reference_px, 80.0
    )
    at = {(p, i): xy for p, i, xy in zip(turned.point, turned.target_image, turned.start_px, strict=True)}
    for point, image, xy in zip(tasks.point, tasks.target_image, tasks.start_px, strict=True):
        expected = -5.37 if image == 1 else 0.0
        assert at[(point, image)][0] - xy[0] == pytest.approx(expected, abs=3.0 if image == 1 else 1e-9)
