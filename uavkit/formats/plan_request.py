"""The request of a flight as data: every option with its unit, range and default."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from uavkit.core.errors import InputError
from uavkit.formats.options_file import StrictModel, read_toml, validated

Degrees = Annotated[tuple[float, float], Field(strict=False)]
"""Latitude, longitude."""


class InlineArea(StrictModel):
    """An area written into the request itself."""

    name: str = "area"
    kind: Literal["polygon", "line", "point"] = "polygon"
    latitude_longitude_deg: list[Degrees] = Field(min_length=1)
    holes_deg: list[list[Degrees]] = Field(default=[])


class ImagingRequest(StrictModel):
    """What the images must show."""

    height_above_ground_m: float | None = Field(default=None, gt=0, le=10000)
    """Or the distance from a facade; give this or gsd_mm."""
    gsd_mm: float | None = Field(default=None, gt=0, le=10000)
    """Ground distance of a pixel."""
    forward_overlap: float = Field(default=0.8, ge=0, lt=1)
    """Share of an image that the next one of its strip shows."""
    side_overlap: float = Field(default=0.6, ge=0, lt=1)
    """Share of an image that the neighbouring strip shows."""
    direction_deg: float | Literal["best"] = "best"
    """Of the strips, from north, clockwise; best: the fewest, shortest strips."""
    long_side: Literal["across", "along"] = "across"
    """How the longer side of the image lies to the flight."""
    keep_overlap: bool = True
    """With a terrain model: bring strips and exposures closer where the slope would break the overlap, and count a
    constant altitude from the highest ground."""
    least_images: int = Field(default=4, ge=1, le=100)
    """That see each point of the area."""


class TerrainRequest(StrictModel):
    """The ground, and how closely to follow it."""

    file: str = ""
    """GeoTIFF, .hgt or ESRI ASC; relative to the request."""
    height_datum: Literal["", "ellipsoid", "geoid"] = ""
    """Of its heights, where the file itself does not tell."""
    sigma_m: float | None = Field(default=None, ge=0, le=1000)
    """Stated error of its heights (1 sigma); else as known for its kind."""
    follow: bool = False
    """Keep the height above ground; else one altitude for all strips."""
    tolerance: float = Field(default=0.1, gt=0, lt=1)
    """Of the height above ground along the strips, as a share of it."""
    least_clearance_m: float = Field(default=5.0, ge=0, le=1000)
    """Of the whole path above the terrain model minus twice its sigma."""


class FlightRequest(StrictModel):
    """How to fly."""

    trigger: Literal["distance", "time", "hover"] = "distance"
    speed_m_s: float | None = Field(default=None, gt=0, le=100)
    """On the strips; else the vehicle's usual one (5 m/s without a vehicle), less where camera or video ask for it."""
    climb_m_s: float | None = Field(default=None, gt=0, le=50)
    descent_m_s: float | None = Field(default=None, gt=0, le=50)
    hold_s: float = Field(default=2.0, ge=0, le=600)
    """Time that the vehicle stands still for an exposure (hover)."""
    shutter_s: float | None = Field(default=None, gt=0, le=10)
    """Exposure time, to check the motion blur."""
    most_motion_blur_px: float = Field(default=1.0, gt=0, le=100)
    camera_interval_s: float | None = Field(default=None, gt=0, le=600)
    """Least time between exposures; else the camera's."""
    video_frames_per_s: float | None = Field(default=None, gt=0, le=1000)
    """Of the finder's video, to check the motion between frames."""
    video_width_px: int = Field(default=640, ge=64, le=16384)
    most_video_motion_px: float = Field(default=12.0, gt=0, le=1000)
    """From one frame to the next: what tracking follows."""
    lead_in_m: float | None = Field(default=None, ge=0, le=10000)
    """Straight flight before the first and after the last exposure of a strip; else by trigger, speed and vehicle."""
    images_in_turns: bool = False
    take_off_deg: Degrees | None = None
    """Else the corner of the area where the flight begins."""
    entry: Literal["nearest", "NE", "SE", "SW", "NW"] = "nearest"
    """Corner of the area where the flight begins; nearest to the take-off point."""
    altitude_from: Literal["take_off", "geoid"] = "take_off"
    """What the altitudes of the mission count from."""
    greatest_height_above_ground_m: float = Field(default=120.0, gt=0, le=10000)
    """That the law allows, anywhere on the path."""
    fence_file: str = ""
    """Polygons (KML, GeoJSON, ...; relative to the request) in which the whole path must lie."""
    keep_out_file: str = ""
    """Polygons that the path must not cross."""
    wind_m_s: float = Field(default=3.0, ge=0, le=50)
    """Allowed for in endurance: every leg is taken as flown against it."""


class SortiesRequest(StrictModel):
    """How a long flight is divided."""

    reserve: float = Field(default=0.2, ge=0, lt=1)
    """Share of the endurance that stays in the battery."""
    overlap_images: int = Field(default=3, ge=0, le=100)
    """Exposures that a sortie repeats of the one before."""
    most_items: int | None = Field(default=None, ge=10, le=100000)
    """Mission items of a sortie; else as many as the autopilot holds (700 without a vehicle)."""
    split_at_items: bool = False
    """Divide where the mission has more items than the autopilot holds; else that is an error."""


class CrossGridRequest(StrictModel):
    """Second set of strips at right angles."""

    height_factor: float = Field(default=1.0, ge=0.5, le=2)
    """Height of the second set by that of the first: another height helps against doming."""


class CorridorRequest(StrictModel):
    """A band along a line."""

    width_m: float = Field(gt=0, le=100000)


class FacadeRequest(StrictModel):
    """A vertical face above a line (or along the outline of a polygon), seen from its right-hand side or outside."""

    height_m: float = Field(gt=0, le=10000)
    base_m: float = Field(default=0.0, ge=-1000, le=10000)
    """Of the face's foot above the ground."""
    side: Literal["right", "left"] = "right"
    """Of the line, in its direction, on which the vehicle flies; for a polygon right is outside."""


class OrbitRequest(StrictModel):
    """Circles about a point, looking at it."""

    radius_m: float = Field(gt=0, le=10000)
    object_height_m: float = Field(default=0.0, ge=0, le=10000)
    """Of the object's top above the ground in the middle; the cameras look at half of it."""
    rings: int = Field(default=1, ge=1, le=20)
    ring_height_m: float = Field(default=10.0, gt=0, le=1000)
    """From a circle to the next higher one."""


class PlanRequest(StrictModel):
    """A whole request."""

    name: str = Field(default="", max_length=80)
    """Of the plan and its files; else the name of the request's file."""
    about: str = ""
    pattern: Literal["polygon", "cross_grid", "corridor", "facade", "orbit"] = "polygon"
    area_file: str = ""
    """KML, KMZ, GeoJSON, SHP or WKT; relative to the request."""
    areas: list[InlineArea] = Field(default=[])
    camera: str = Field(min_length=1)
    vehicle: str = ""
    imaging: ImagingRequest = ImagingRequest()
    terrain: TerrainRequest = TerrainRequest()
    flight: FlightRequest = FlightRequest()
    sorties: SortiesRequest = SortiesRequest()
    cross_grid: CrossGridRequest = CrossGridRequest()
    corridor: CorridorRequest | None = None
    facade: FacadeRequest | None = None
    orbit: OrbitRequest | None = None


def request_of(path: Path, given: Mapping[str, Any]) -> PlanRequest:
    """Return the request in a TOML file, or for an area file, with values by dotted name in place of its own.

    Values that are None are not given. Raises InputError naming what is wrong.
    """
    if path.suffix.lower() == ".toml":
        content = read_toml(path, PlanRequest).model_dump(exclude_unset=True)
    elif not path.is_file():
        raise InputError(f"{path}: there is no such file: give an area (KML, GeoJSON, SHP, WKT) or a request (TOML)")
    else:
        content = {"area_file": path.name}
    content.setdefault("name", path.stem)
    for name, value in given.items():
        if value is None:
            continue
        table, _, key = name.rpartition(".")
        (content.setdefault(table, {}) if table else content)[key] = value
        if name in _ONE_OF and given.get(f"{table}.{_ONE_OF[name]}") is None:
            content[table].pop(_ONE_OF[name], None)
    if "camera" not in content:
        raise InputError(f"{path}: name the camera (--camera); 'uavkit cameras' lists those that are known")
    request = validated(PlanRequest, content, str(path))
    if bool(request.area_file) == bool(request.areas):
        raise InputError(f"{path}: give area_file or [[areas]], one of them")
    check_request(request, str(path))
    return request


_ONE_OF = {
    "imaging.height_above_ground_m": "gsd_mm",
    "imaging.gsd_mm": "height_above_ground_m",
}
"""What the one of two options given on the command line takes the place of in the file."""


def check_request(request: PlanRequest, where: str) -> None:
    """Refuse requests whose parts do not fit one another, with what to change."""
    imaging = request.imaging
    if (imaging.height_above_ground_m is None) == (imaging.gsd_mm is None):
        raise InputError(f"{where}: [imaging] give height_above_ground_m or gsd_mm, one of them")
    for pattern in ("corridor", "facade", "orbit"):
        if request.pattern == pattern and getattr(request, pattern) is None:
            raise InputError(f"{where}: the pattern {pattern} needs a table [{pattern}]")
    if request.terrain.follow and not request.terrain.file:
        raise InputError(f"{where}: [terrain] follow needs a terrain model: give file")


def request_text(request: PlanRequest) -> str:
    """Return a request as TOML with all its options, defaults included; what has no value is left out."""
    content = request.model_dump()
    tables = {key: value for key, value in content.items() if isinstance(value, dict)}
    areas = content.pop("areas")
    lines = [f"{key} = {_toml(value)}" for key, value in content.items() if key not in tables and value is not None]
    for area in areas:
        lines += ["", "[[areas]]", *(f"{key} = {_toml(value)}" for key, value in area.items())]
    for name, table in tables.items():
        lines += ["", f"[{name}]"]
        lines += [f"{key} = {_toml(value)}" for key, value in table.items() if value is not None]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    """Return plain data as TOML; JSON's texts, numbers and truth values are TOML's too."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(part) for part in value)}]"
    return json.dumps(value, ensure_ascii=False)
