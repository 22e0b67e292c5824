"""Requests, areas and grounds for the tests of planning."""

from typing import Any

import numpy as np

from uavkit.core.flightplan import AreaKind, SurveyArea
from uavkit.core.frames import LocalMap, utm_crs
from uavkit.core.surface import ElevationGrid
from uavkit.core.vehicle import VehicleKind, VehicleProfile
from uavkit.formats.camera_profiles import load_camera
from uavkit.formats.plan_request import PlanRequest

LATITUDE_DEG, LONGITUDE_DEG = 47.0, 8.0
MAP = LocalMap(latitude_deg=LATITUDE_DEG, longitude_deg=LONGITUDE_DEG)
CAMERA = load_camera("Ricoh GX200")
SQUARE = [(0.0, 0.0), (150.0, 0.0), (150.0, 120.0), (0.0, 120.0)]


def area(xy_m: Any, kind: AreaKind = AreaKind.POLYGON, name: str = "field") -> SurveyArea:
    """An area by map coordinates."""
    places = MAP.geographic_from_map(np.array(xy_m, dtype=np.float64))
    return SurveyArea(name=name, kind=kind, latitude_longitude_deg=places)


def request(**tables: Any) -> PlanRequest:
    """A request with height 50 m unless it says otherwise."""
    tables.setdefault("imaging", {})
    if "gsd_mm" not in tables["imaging"]:
        tables["imaging"] = {"height_above_ground_m": 50.0, **tables["imaging"]}
    return PlanRequest.model_validate({"camera": CAMERA.name, "name": "made", **tables})


def hills(height_m: float = 8.0, wave_m: float = 150.0, node_m: float = 5.0, sigma_m: float = 0.2) -> ElevationGrid:
    """A square kilometre of rolling ground about the origin of the map."""
    import pyproj

    crs = utm_crs(LATITUDE_DEG, LONGITUDE_DEG)
    east, north = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(LONGITUDE_DEG, LATITUDE_DEG)
    steps = np.arange(-500.0, 500.1, node_m)
    x, y = np.meshgrid(steps, steps[::-1])
    heights = 400.0 + height_m * np.sin(2 * np.pi * x / wave_m) * np.cos(2 * np.pi * y / (1.3 * wave_m))
    return ElevationGrid(
        height_ellipsoid_m=heights.astype(np.float32),
        crs=crs,
        crs_from_grid=np.array([[node_m, 0.0, east - 500.0], [0.0, -node_m, north + 500.0]]),
        sigma_m=sigma_m,
        source="made hills",
    )


def vehicle(**changes: Any) -> VehicleProfile:
    """A small multirotor."""
    values: dict[str, Any] = {
        "name": "Made",
        "maker": "test",
        "kind": VehicleKind.MULTIROTOR,
        "endurance_s": 900.0,
        "payload_g": 500.0,
        "speed_m_s": 5.0,
        "greatest_speed_m_s": 12.0,
        "climb_m_s": 3.0,
        "descent_m_s": 2.0,
        "acceleration_m_s2": 2.0,
        "turn_radius_m": 0.0,
        "greatest_wind_m_s": 10.0,
        "most_mission_items": 700,
        "autopilot": "ardupilot",
        "source": "made",
    }
    return VehicleProfile(**{**values, **changes})
