"""What a request names, read from its files."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uavkit.core.camera import CameraProfile
from uavkit.core.flightplan import AreaKind, SurveyArea
from uavkit.core.surface import ElevationGrid
from uavkit.core.vehicle import VehicleProfile
from uavkit.formats.area_file import inline_areas, read_areas
from uavkit.formats.camera_profiles import load_camera
from uavkit.formats.elevation_file import read_elevation
from uavkit.formats.plan_request import InlineArea, PlanRequest
from uavkit.formats.vehicle_profiles import load_vehicle
from uavkit.plan.planner import Fences
from uavkit.plan.site import KINDS

DEGREE_M = 111_000.0
BESIDE_M = 3000.0
"""How far around areas and take-off point the terrain model is read."""


@dataclass(frozen=True, kw_only=True)
class PlanInputs:
    """The arguments of plan_survey."""

    areas: tuple[SurveyArea, ...]
    camera: CameraProfile
    elevation: ElevationGrid | None
    vehicle: VehicleProfile | None
    fences: Fences
    notes: tuple[str, ...] = ()


def read_inputs(request: PlanRequest, folder: Path) -> PlanInputs:
    """Return everything that a request names; its paths count from a folder.

    Of an area file the geometries that the pattern can use are taken. Raises InputError for what cannot be read.
    """
    areas = inline_areas(request.areas) if request.areas else read_areas(_path(folder, request.area_file))
    fitting = tuple(area for area in areas if area.kind in KINDS[request.pattern])
    left_out = [area.name for area in areas if fitting and area.kind not in KINDS[request.pattern]]
    return PlanInputs(
        notes=(f"left out, no {' or '.join(kind.value for kind in KINDS[request.pattern])}: {', '.join(left_out)}",)
        if left_out
        else (),
        areas=fitting or areas,
        camera=load_camera(str(_path(folder, request.camera)) if request.camera.endswith(".toml") else request.camera),
        elevation=_elevation(request, folder, fitting or areas),
        vehicle=_vehicle(request, folder),
        fences=Fences(
            inside=_fence(folder, request.flight.fence_file), outside=_fence(folder, request.flight.keep_out_file)
        ),
    )


def _path(folder: Path, name: str) -> Path:
    return folder / Path(name).expanduser()


def _vehicle(request: PlanRequest, folder: Path) -> VehicleProfile | None:
    if not request.vehicle:
        return None
    return load_vehicle(str(_path(folder, request.vehicle)) if request.vehicle.endswith(".toml") else request.vehicle)


def _fence(folder: Path, name: str) -> tuple[SurveyArea, ...]:
    if not name:
        return ()
    return tuple(area for area in read_areas(_path(folder, name)) if area.kind is AreaKind.POLYGON)


def _elevation(request: PlanRequest, folder: Path, areas: tuple[SurveyArea, ...]) -> ElevationGrid | None:
    terrain = request.terrain
    if not terrain.file:
        return None
    places = [area.latitude_longitude_deg for area in areas]
    if request.flight.take_off_deg is not None:
        places.append(np.array([request.flight.take_off_deg]))
    low, high = np.concatenate(places).min(axis=0), np.concatenate(places).max(axis=0)
    around = BESIDE_M / DEGREE_M
    wider = around / max(0.1, float(np.cos(np.radians(np.max(np.abs([low[0], high[0]]))))))
    window = (float(low[0]) - around, float(low[1]) - wider, float(high[0]) + around, float(high[1]) + wider)
    return read_elevation(_path(folder, terrain.file), terrain.height_datum, terrain.sigma_m, window)


def self_contained(request: PlanRequest, folder: Path, found: PlanInputs) -> PlanRequest:
    """Return the request with its areas in it and its other paths absolute, to be read from any folder."""
    areas = [
        InlineArea(
            name=area.name,
            kind=area.kind.value,
            latitude_longitude_deg=[(float(a), float(b)) for a, b in area.latitude_longitude_deg],
            holes_deg=[[(float(a), float(b)) for a, b in hole] for hole in area.holes_deg],
        )
        for area in found.areas
    ]
    flight = request.flight
    fences = {name: _absolute(folder, getattr(flight, name)) for name in ("fence_file", "keep_out_file")}
    return request.model_copy(
        update={
            "area_file": "",
            "areas": areas,
            "camera": _absolute(folder, request.camera) if request.camera.endswith(".toml") else request.camera,
            "vehicle": _absolute(folder, request.vehicle) if request.vehicle.endswith(".toml") else request.vehicle,
            "terrain": request.terrain.model_copy(update={"file": _absolute(folder, request.terrain.file)}),
            "flight": flight.model_copy(update=fences),
        }
    )


def _absolute(folder: Path, name: str) -> str:
    return str(_path(folder, name).absolute()) if name else ""
