"""What a processed block is worth, measured against the truth of its simulated flight.

Two errors of the check points are told. *Surveyed*: block minus surveyed coordinates, as the report has it; their
predicted sigmas and joint covariance hold the block's precision and the survey's noise. *True*: block minus true
coordinates. Judged is the first, for it is what a user sees.
"""

from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.result import OrientedBlock
from uavkit.report.measures import determined_points, differences_m, rays_of_points, strip_ties
from uavkit.simulate.camera import SimulatedCamera, SimulatedView
from uavkit.simulate.kernels import CELL_M
from uavkit.simulate.options import SimulationOptions
from uavkit.simulate.survey import make_scene
from uavkit.simulate.world import World, enu_from_site

CHI_SQUARE_PROBABILITY = 0.999
GROUND_CELL_M = 1.0


def evaluated(result: OrientedBlock, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a row: orientation, check points, yield."""
    views = true_views(truth)
    return {
        "stills": len(truth["exposures"]),
        "stills_oriented": len(result.images),
        "points": int(determined_points(result).sum()),
        "video_share": result.video_share,
        "sigma0": result.adjustment.sigma0,
        "step_s": {step: round(seconds, 1) for step, seconds in result.seconds.items()},
        "check_points_expected": len(truth["check_points"]),
        **check_point_errors(
            differences_m(result.check), result.check_covariance_m2, surveyed_minus_true_m(result, truth)
        ),
        **yielded(result, true_world(truth), views),
        "fewest_ties_of_neighbouring_strips": fewest_ties(strip_ties(result)[1]),
    }


def check_point_errors(difference_m: Array, covariance_m2: Array, surveyed_minus_true_m: Array) -> dict[str, Any]:
    """Return root mean square errors and their prediction, XY of both axes together, and chi-square of all of them.

    Differences (n, 3) are block minus survey, with their joint covariance (3 n, 3 n).
    """
    variance = np.diag(covariance_m2).reshape(-1, 3)
    return {
        "check_points": len(difference_m),
        **_root_mean_squares("rmse", difference_m**2),
        **_root_mean_squares("rmse_predicted", variance),
        **_root_mean_squares("rmse_true", (difference_m + surveyed_minus_true_m) ** 2),
        "chi_square": float(difference_m.ravel() @ np.linalg.solve(covariance_m2, difference_m.ravel())),
        "chi_square_freedom": difference_m.size,
        "chi_square_bound": chi_square_bound(difference_m.size),
    }


def _root_mean_squares(name: str, squares_m2: Array) -> dict[str, float]:
    """Return roots of the mean of squares (n, 3), in mm: of both horizontal axes together, and of heights."""
    return {
        f"{name}_xy_mm": 1e3 * float(np.sqrt(np.mean(squares_m2[:, 0] + squares_m2[:, 1]))),
        f"{name}_z_mm": 1e3 * float(np.sqrt(np.mean(squares_m2[:, 2]))),
    }


def surveyed_minus_true_m(result: OrientedBlock, truth: Mapping[str, Any]) -> Array:
    """Return the error of the surveyed coordinates of the block's check points in its local frame, shape (n, 3)."""
    frame = result.block.frame
    if frame is None:
        raise ValueError("the block lies nowhere on earth: its check points have no true coordinates")
    names = [point["name"] for point in truth["check_points"]]
    places = frame.enu_from_crs(np.array([point["crs_m"] for point in truth["check_points"]]), truth["frame"]["crs"])
    true = dict(zip(names, places, strict=True))
    surveyed = {point.name: np.array(point.position_m) for point in result.block.check_points}
    return np.array([surveyed[point.name] - true[point.name] for point in result.check]).reshape(-1, 3)


def chi_square_bound(freedom: int) -> float:
    """Return what chi-square stays below with the stated probability."""
    from scipy.stats import chi2

    return float(chi2.ppf(CHI_SQUARE_PROBABILITY, freedom))


def true_views(truth: Mapping[str, Any]) -> dict[str, SimulatedView]:
    """Return the true camera at each exposure, by the name of the still."""
    camera = SimulatedCamera(**truth["camera"])
    return {
        exposure["image"]: SimulatedView(
            camera=camera,
            centre_m=np.array(exposure["projection_centre_m"]),
            R_object_from_image=np.array(exposure["R_object_from_image"]),
        )
        for exposure in truth["exposures"]
    }


def true_world(truth: Mapping[str, Any]) -> World:
    """Return the site of a survey, made again; raises ValueError where the simulator has changed since."""
    defaults = SimulationOptions()
    kinds = {name: type(getattr(defaults, name)) for name in truth["options"]}
    values = {
        name: kinds[name](value) if issubclass(kinds[name], Enum) else value for name, value in truth["options"].items()
    }
    world = make_scene(SimulationOptions(**values)).world
    points = np.array([point["position_m"] for point in truth["check_points"]])
    if np.abs(world.height_m(points[:, 0], points[:, 1]) - points[:, 2]).max() > 1e-3:
        raise ValueError("the simulator makes another site now than when this flight was rendered: render it again")
    return world


def yielded(result: OrientedBlock, world: World, views: Mapping[str, SimulatedView]) -> dict[str, float]:
    """Return the share of ground cells seen by two stills or more that hold a point, and of rays that were found."""
    frame = result.block.frame
    if frame is None:
        raise ValueError("the block lies nowhere on earth: its points lie on no ground")
    use = determined_points(result)
    points = _in_site_frame(result, result.adjustment.points_m[use])
    cells = ground_cells(world)
    seen = sum((view.sees(world, cells, 0.0).astype(int) for view in views.values()), np.zeros(len(cells), int))
    rays = rays_of_points(result)[use]
    showing = stills_that_show(points, views)
    return {
        "cells_seen_twice": int((seen >= 2).sum()),
        "cells_with_a_point": float(holds_a_point(cells[seen >= 2], points).mean()),
        "rays_per_point": float(rays.mean()),
        "rays_found": float(np.mean(rays / np.maximum(showing, rays))),
    }


def _in_site_frame(result: OrientedBlock, points_m: Array) -> Array:
    """Return points (n, 3) of the block's local frame in the local frame of the simulated site."""
    from uavkit.simulate.site import CRS, site_frame

    frame = result.block.frame
    if frame is None:
        raise ValueError("the block lies nowhere on earth")
    crs = frame.crs_from_enu(points_m)
    return site_frame().enu_from_crs(crs, frame.crs or CRS)


def ground_cells(world: World) -> Array:
    """Return the middle of each ground cell of the site, on the true surface, shape (n, 3) in east, north, up."""
    half = [0.5 * (nodes - 1) * CELL_M for nodes in world.ground.heights_m.shape]
    across, along = (np.arange(np.ceil(-h) + 0.5 * GROUND_CELL_M, h, GROUND_CELL_M) for h in half)
    grid = np.stack(np.meshgrid(along, across), axis=-1).reshape(-1, 2)
    enu = np.column_stack([grid, np.zeros(len(grid))]) @ enu_from_site().T
    enu[:, 2] = world.height_m(enu[:, 0], enu[:, 1])
    return enu


def holds_a_point(cells_m: Array, points_m: Array) -> Flags:
    """Tell which ground cells, given by their middles (n, 3), hold one of the points (m, 3)."""
    return np.asarray(np.isin(_cell_numbers(cells_m), _cell_numbers(points_m)))


def _cell_numbers(points_m: Array) -> Indices:
    """Return a number for the ground cell of each point (n, 3): equal where two points share a cell."""
    site = points_m @ enu_from_site()
    column, row = np.floor(site[:, :2] / GROUND_CELL_M).astype(np.int64).T
    return np.asarray(row * 100_000 + column)


def stills_that_show(points_m: Array, views: Mapping[str, SimulatedView]) -> Indices:
    """Return how many pictures each point (n, 3) falls into; what may hide it there is not looked at."""
    count = np.zeros(len(points_m), dtype=np.int64)
    for view in views.values():
        pixels = view.project(points_m)
        size = np.array([view.camera.width_px - 1, view.camera.height_px - 1])
        count += _in_field_of_view(points_m, view) & np.all((pixels >= 0) & (pixels <= size), axis=1)
    return count


def _in_field_of_view(points_m: Array, view: SimulatedView) -> Flags:
    """Tell which points lie within the cone through the picture's corners.

    Far outside it the polynomial of the distortion folds back, and would put points into the picture that it never saw.
    """
    width, height = view.camera.width_px - 1.0, view.camera.height_px - 1.0
    corners = view.camera.ideal_of(np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]]))
    in_image = (points_m - view.centre_m) @ view.R_object_from_image
    farthest = 1.01 * np.linalg.norm(corners, axis=1).max()
    return np.asarray(np.linalg.norm(in_image[:, :2], axis=1) <= -in_image[:, 2] * farthest)


def fewest_ties(shared: Indices) -> int:
    """Return the least number of points that two neighbouring strips share, of the matrix of all pairs (s, s)."""
    return int(np.diagonal(shared, 1).min()) if len(shared) > 1 else 0
