"""What a processed block is worth, measured against the truth of its simulated flight.

Several errors of the check points are told. Judged is block minus *surveyed* coordinates, for it is what a user sees in
the report; the predicted sigmas and the joint covariance of these differences hold the block's precision and the
survey's noise. Beside it: block minus *true* coordinates; the same after a similarity transformation to the truth, the
error of the *shape* alone; and what an *exact* block would show that hangs on the same control points, for with three
of these their noise is most of what check points show.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.result import OrientedBlock, PointDifference
from uavkit.process.absolute import fit_similarity
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
        **check_point_errors(differences_m(result.check), result.check_covariance_m2),
        **errors_to_truth(MarkedPlaces.of_block(result, truth)),
        **yielded(result, true_world(truth), views),
        "fewest_ties_of_neighbouring_strips": fewest_ties(strip_ties(result)[1]),
    }


def check_point_errors(difference_m: Array, covariance_m2: Array) -> dict[str, Any]:
    """Return root mean square errors and their prediction, XY of both axes together, and chi-square of all of them.

    Differences (n, 3) are block minus survey, with their joint covariance (3 n, 3 n).
    """
    variance = np.diag(covariance_m2).reshape(-1, 3)
    return {
        "check_points": len(difference_m),
        **root_mean_squares("rmse", difference_m**2),
        **root_mean_squares("rmse_predicted", variance),
        "chi_square": float(difference_m.ravel() @ np.linalg.solve(covariance_m2, difference_m.ravel())),
        "chi_square_freedom": difference_m.size,
        "chi_square_bound": chi_square_bound(difference_m.size),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkedPlaces:
    """Where a program puts the check points, with the truth, all in one local frame in metres."""

    check_m: Array
    """(n, 3) as computed."""
    check_surveyed_m: Array
    check_true_m: Array
    control_surveyed_m: Array
    """(c, 3), of the control points that were used; none without control."""
    control_true_m: Array

    @classmethod
    def of_block(cls, result: OrientedBlock, truth: Mapping[str, Any]) -> "MarkedPlaces":
        """Return the places of a processed block."""
        frame, block = result.block.frame, result.block
        if frame is None:
            raise ValueError("the block lies nowhere on earth: its check points have no true coordinates")
        points = [*truth["check_points"], *truth["control_points"]]
        places = frame.enu_from_crs(np.array([point["crs_m"] for point in points]), truth["frame"]["crs"])
        true = {point["name"]: place for point, place in zip(points, places, strict=True)}
        surveyed = {p.name: np.array(p.position_m) for p in (*block.check_points, *block.control_points)}

        def table(known: Mapping[str, Array], of: tuple[PointDifference, ...]) -> Array:
            return np.array([known[point.name] for point in of]).reshape(-1, 3)

        return cls(
            check_m=table(surveyed, result.check) + differences_m(result.check),
            check_surveyed_m=table(surveyed, result.check),
            check_true_m=table(true, result.check),
            control_surveyed_m=table(surveyed, result.control),
            control_true_m=table(true, result.control),
        )


def errors_to_truth(places: MarkedPlaces) -> dict[str, float]:
    """Return root mean square errors against the truth, of the shape alone, and those an exact block would show."""
    shape = fit_similarity(places.check_m, places.check_true_m).apply(places.check_m) - places.check_true_m
    errors = {
        **root_mean_squares("rmse_true", (places.check_m - places.check_true_m) ** 2),
        **root_mean_squares("rmse_shape", shape**2),
    }
    if len(places.control_true_m) >= 3:
        exact = fit_similarity(places.control_true_m, places.control_surveyed_m).apply(places.check_true_m)
        errors |= root_mean_squares("rmse_of_exact_block", (exact - places.check_surveyed_m) ** 2)
    return errors


def root_mean_squares(name: str, squares_m2: Array) -> dict[str, float]:
    """Return roots of the mean of squares (n, 3), in mm: of both horizontal axes together, and of heights."""
    return {
        f"{name}_xy_mm": 1e3 * float(np.sqrt(np.mean(squares_m2[:, 0] + squares_m2[:, 1]))),
        f"{name}_z_mm": 1e3 * float(np.sqrt(np.mean(squares_m2[:, 2]))),
    }


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
