"""True errors of the rays of oriented blocks, and whether the calibrated sigmas tell them.

Two errors are measured, with the true orientation of simulated flights:

* *Against the surface*: the point's first ray is intersected with the true surface and projected into the point's other
  stills; the measured place minus that one, along and across the epipolar line. Along it holds relief in the matching
  window, which moves all rays of a point together: it is no error of rays, but of where on the ground the point lies.
* *Against each other*: the rays of a point are intersected with the true orientation, free of any surface, and leave
  residuals. These alone act upon orientations and points in an adjustment, hence upon these the ratio of true to
  calibrated sigma is judged: the root of the sum of v^2 / sigma^2 over that of the redundancy numbers.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tests.benchmarks.blocks import Case, ingest, process
from tests.benchmarks.evaluation import true_views, true_world
from tests.benchmarks.rows import measured
from uavkit.core.arrays import Array, Indices
from uavkit.core.result import OrientedBlock, PointOrigin
from uavkit.formats.adjustment_file import read_oriented_block
from uavkit.project import Project
from uavkit.simulate.camera import SimulatedView, true_camera
from uavkit.simulate.world import World

pytestmark = pytest.mark.slow

FLIGHTS = [("constant", 21), ("trace", 22), ("constant", 23), ("trace", 24)]
MOST_SIGMA_PX = 0.12
MOST_DEVIATION = 0.25
DEPTH_STEP_M = 0.02


def ray_errors(result: OrientedBlock, truth: Mapping[str, Any], world: World) -> dict[str, Any]:
    """Return the values of a row."""
    views = true_views(truth)
    of_image = [views[name] for name in result.images]
    tied = result.point_origins[result.rays.point_index] != PointOrigin.MARK
    rows = np.flatnonzero(result.adjustment.ray_used & tied)
    rows = rows[np.lexsort((result.rays.image_index[rows], result.rays.point_index[rows]))]
    image, point = result.rays.image_index[rows], result.rays.point_index[rows]
    xy_px, sigma_px = result.rays.xy_px[rows], result.rays.sigma_px[rows].mean(axis=1)
    return {
        "rays": len(rows),
        "calibrated_sigma_px": float(np.sqrt(np.mean(sigma_px**2))),
        **_against_surface(of_image, world, image, point, xy_px),
        **_against_each_other(of_image, image, point, xy_px, sigma_px),
    }


def _against_surface(
    views: list[SimulatedView], world: World, image: Indices, point: Indices, xy_px: Array
) -> dict[str, float]:
    first = np.r_[True, np.diff(point) != 0]
    anchor = np.flatnonzero(first)[np.cumsum(first) - 1]
    ground = np.full((len(point), 3), np.nan)
    for i in np.unique(image[first]):
        rows = np.flatnonzero(first & (image == i))
        ground[rows] = views[i].intersect(world, xy_px[rows])
    ground = ground[anchor]
    centres = np.array([view.centre_m for view in views])[image[anchor]]
    away = (ground - centres) / np.linalg.norm(ground - centres, axis=1)[:, None]
    error, line = np.full(xy_px.shape, np.nan), np.full(xy_px.shape, np.nan)
    for i in np.unique(image):
        rows = np.flatnonzero(~first & (image == i))
        if len(rows):
            place = views[i].project(ground[rows])
            error[rows] = xy_px[rows] - place
            line[rows] = views[i].project(ground[rows] + DEPTH_STEP_M * away[rows]) - place
    good = np.isfinite(error).all(axis=1) & np.isfinite(line).all(axis=1)
    error, line = error[good], line[good] / np.linalg.norm(line[good], axis=1)[:, None]
    along, across = np.sum(error * line, axis=1), error[:, 1] * line[:, 0] - error[:, 0] * line[:, 1]
    return {
        **_spread("surface_along", along),
        **_spread("surface_across", across),
        "surface_along_median_px": float(np.median(along)),
    }


def _against_each_other(
    views: list[SimulatedView], image: Indices, point: Indices, xy_px: Array, sigma_px: Array
) -> dict[str, Any]:
    residuals, redundancy = intersection_residuals(views, image, point, xy_px, sigma_px)
    use = redundancy > 0.05
    squares = np.sum(residuals**2, axis=1)
    limits = np.quantile(sigma_px, [1 / 3, 2 / 3])
    texture = np.searchsorted(limits, sigma_px)
    scaled = np.abs(residuals[use]) / np.sqrt(redundancy[use] / 2.0)[:, None]
    normed = scaled / sigma_px[use][:, None]
    return {
        "mutual_rms_px": _root(squares[use], redundancy[use]),
        "mutual_robust_px": float(1.4826 * np.median(scaled)),
        "true_over_calibrated": _root((squares / sigma_px**2)[use], redundancy[use]),
        "true_over_calibrated_robust": float(1.4826 * np.median(normed)),
        "true_over_calibrated_by_sigma": [
            round(_root((squares / sigma_px**2)[use & (texture == t)], redundancy[use & (texture == t)]), 3)
            for t in range(3)
        ],
        "limits_of_sigma_px": [round(float(limit), 4) for limit in limits],
    }


def _root(squares: Array, redundancy: Array) -> float:
    return float(np.sqrt(squares.sum() / redundancy.sum()))


def _spread(name: str, values: Array) -> dict[str, float]:
    return {
        f"{name}_rms_px": float(np.sqrt(np.mean(values**2))),
        f"{name}_robust_px": float(1.4826 * np.median(np.abs(values))),
    }


def intersection_residuals(
    views: list[SimulatedView], image: Indices, point: Indices, xy_px: Array, sigma_px: Array
) -> tuple[Array, Array]:
    """Return residuals (k, 2) and redundancy numbers (k,), 0 to 2, of rays intersected with the true orientation.

    Rays are sorted by point. The distance of a point from a ray, over its distance from the camera and times the
    principal distance, stands for the residual in the least squares; the residuals themselves are in the image.
    """
    _, number = np.unique(point, return_inverse=True)
    centres = np.array([view.centre_m for view in views])[image]
    directions = np.empty((len(image), 3))
    for i in np.unique(image):
        directions[image == i] = views[i].rays(xy_px[image == i])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    points = _intersected(across / sigma_px[:, None, None] ** 2, centres, number)
    distance = np.linalg.norm(points[number] - centres, axis=1)
    # a ray is as many pixels wide as the principal distance over the cosine of its angle to the axis
    axes = np.array([-view.R_object_from_image[:, 2] for view in views])[image]
    scale = views[0].camera.principal_distance_px / np.sum(axes * directions, axis=1) / distance
    weighted = across * ((scale / sigma_px) ** 2)[:, None, None]
    points = _intersected(weighted, centres, number)
    normal = np.zeros((number.max() + 1, 3, 3))
    np.add.at(normal, number, weighted)
    taken = np.einsum("kij,kji->k", np.linalg.pinv(normal)[number], weighted)
    residuals = np.empty(xy_px.shape)
    for i in np.unique(image):
        rows = image == i
        residuals[rows] = views[i].project(points[number[rows]]) - xy_px[rows]
    return residuals, 2.0 - taken


def _intersected(weighted: Array, centres: Array, number: Indices) -> Array:
    normal, right = np.zeros((number.max() + 1, 3, 3)), np.zeros((number.max() + 1, 3))
    np.add.at(normal, number, weighted)
    np.add.at(right, number, np.einsum("kij,kj->ki", weighted, centres))
    return np.einsum("nij,nj->ni", np.linalg.pinv(normal), right)


def case_of(flight: str, seed: int) -> Case:
    """Return a flight of 18 stills of half size, without video."""
    options = {"flight": flight, "seed": seed, "scale": 0.5, "strips": 3, "stations": 6, "video_standard": "none"}
    return Case(benchmark="rays", name=f"{flight} {seed}", simulate=options)


def measure(case: Case) -> dict[str, Any]:
    """Take a flight through the chain and return the values of its row."""
    ingest(case)
    process(case)
    truth = json.loads((case.flight / "truth" / "truth.json").read_text(encoding="utf-8"))
    return ray_errors(read_oriented_block(Project(case.survey).result_file), truth, true_world(truth))


@pytest.mark.parametrize("flight,seed", FLIGHTS)
def test_rays_of_simulated_stills(flight: str, seed: int) -> None:
    case = case_of(flight, seed)
    row = measured("rays", case.name, lambda: measure(case))
    assert row["mutual_rms_px"] < MOST_SIGMA_PX
    assert abs(row["true_over_calibrated"] - 1.0) < MOST_DEVIATION


def test_residuals_of_rays_of_known_sigma_have_that_sigma() -> None:
    rng = np.random.default_rng(3)
    camera = true_camera(1, 0.5)
    views = [
        SimulatedView(camera=camera, centre_m=np.array([x, 0.3 * x, 15.0]), R_object_from_image=np.eye(3))
        for x in (-4.0, -1.0, 2.0, 5.0)
    ]
    ground = np.column_stack([rng.uniform(-2, 2, (500, 2)), rng.uniform(-1, 1, 500)])
    image, point = np.tile(np.arange(4), 500), np.repeat(np.arange(500), 4)
    xy_px = np.empty((2000, 2))
    for i, view in enumerate(views):
        xy_px[image == i] = view.project(ground)
    sigma_px = np.full(2000, 0.1)
    measured_px = xy_px + rng.normal(0, 0.1, xy_px.shape)
    residuals, redundancy = intersection_residuals(views, image, point, measured_px, sigma_px)
    assert redundancy.sum() == pytest.approx(500 * 5, rel=1e-6)
    # 2500 degrees of freedom: the root is known to 1.4 %
    assert _root(np.sum((residuals / 0.1) ** 2, axis=1), redundancy) == pytest.approx(1.0, abs=0.06)
