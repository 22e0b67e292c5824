"""Planned surveys made by hand, with coverage and ground of known figures, for the tests of pictures and pages."""

import numpy as np

from tests.plan.made_plans import GROUND_M, made_footprints, made_plan
from uavkit.core.arrays import Array
from uavkit.core.flightplan import CoverageMap, FlightPlan
from uavkit.core.frames import LocalMap
from uavkit.core.surface import ElevationGrid
from uavkit.formats.plan_request import FacadeRequest, ImagingRequest, PlanRequest, TerrainRequest
from uavkit.plan.planner import Planned


def made_request(pattern: str = "polygon", *, least_images: int = 4) -> PlanRequest:
    """Return the request that a made plan could come from."""
    return PlanRequest(
        camera="Ricoh GX200",
        pattern=pattern,  # type: ignore[arg-type]
        imaging=ImagingRequest(height_above_ground_m=30.0, least_images=least_images),
        terrain=TerrainRequest(least_clearance_m=5.0),
        facade=FacadeRequest(height_m=40.0) if pattern == "facade" else None,
    )


def made_map(plan: FlightPlan) -> LocalMap:
    """Return the local map about the take-off point of a made plan."""
    return LocalMap(
        latitude_deg=plan.take_off.latitude_deg,
        longitude_deg=plan.take_off.longitude_deg,
        height_ellipsoid_m=GROUND_M,
    )


def made_coverage(counts: Array) -> CoverageMap:
    """Return a map of coverage with cells of 1 m, all in the area."""
    return CoverageMap(
        images=counts.astype(np.uint16), in_area=np.ones(counts.shape, np.bool_), first_xy_m=(0.5, 0.5), cell_m=1.0
    )


def made_planned(plan: FlightPlan | None = None, coverage: CoverageMap | None = None) -> Planned:
    """Return a plan with its map, a coverage of 6 images everywhere, and footprints."""
    plan = plan if plan is not None else made_plan()
    return Planned(
        plan=plan,
        coverage=coverage if coverage is not None else made_coverage(np.full((40, 60), 6)),
        local_map=made_map(plan),
        footprints_deg=made_footprints(plan),
    )


def made_ground(plan: FlightPlan, slope_east: float, slope_north: float, sigma_m: float = 0.5) -> ElevationGrid:
    """Return a sloping plane through the take-off point, with nodes every 10 m within 400 m of it."""
    nodes = np.arange(-400.0, 401.0, 10.0)
    x, y = np.meshgrid(nodes, nodes[::-1])
    return ElevationGrid(
        height_ellipsoid_m=(GROUND_M + slope_east * x + slope_north * y).astype(np.float32),
        crs=made_map(plan).crs.replace("+ellps=WGS84", "+datum=WGS84"),
        crs_from_grid=np.array([[10.0, 0.0, -400.0], [0.0, -10.0, 400.0]]),
        sigma_m=sigma_m,
        source="a made plane",
    )
