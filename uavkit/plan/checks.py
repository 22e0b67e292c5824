"""What camera, vehicle, law and fences allow: the speed of a plan, and reasons to refuse one, with what to change."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.camera import CameraProfile
from uavkit.core.errors import InputError
from uavkit.core.vehicle import VehicleKind, VehicleProfile
from uavkit.formats.plan_request import FlightRequest, PlanRequest
from uavkit.plan.flight import Performance, Vertex
from uavkit.plan.ground import Ground
from uavkit.plan.imaging import Imaging

USUAL_SPEED_M_S = 5.0
USUAL_CLIMB_M_S, USUAL_DESCENT_M_S, USUAL_ACCELERATION_M_S2 = 2.5, 1.5, 1.5
SLOWEST_SHARE = 0.7
"""A fixed wing does not fly slower than this share of its usual speed."""


@dataclass(frozen=True, kw_only=True)
class SpeedBound:
    """Something that limits the speed on the strips."""

    most_m_s: float
    why: str
    change: str


def speed_bounds(
    request: PlanRequest, imaging: Imaging, least_base_m: float, least_depth_m: float
) -> tuple[SpeedBound, ...]:
    """Return what limits the speed on the strips: interval of the camera, motion blur, motion between video frames."""
    flight, bounds = request.flight, []
    interval = flight.camera_interval_s or imaging.profile.least_interval_s
    if interval is not None and least_base_m > 0.0 and flight.trigger != "hover":
        bounds.append(
            SpeedBound(
                most_m_s=least_base_m / interval,
                why=f"{imaging.profile.name} needs {interval:g} s between images, and the base is {least_base_m:.2f} m",
                change="less forward overlap or a greater height",
            )
        )
    gsd = imaging.gsd_m(least_depth_m)
    if flight.shutter_s is not None and flight.trigger != "hover":
        bounds.append(
            SpeedBound(
                most_m_s=flight.most_motion_blur_px * gsd / flight.shutter_s,
                why=f"{flight.shutter_s:g} s exposure may blur {flight.most_motion_blur_px:g} px ({1e3 * gsd:.1f} mm)",
                change="a shorter exposure",
            )
        )
    if flight.video_frames_per_s is not None:
        bounds.append(
            SpeedBound(
                most_m_s=flight.most_video_motion_px
                * video_pixel_m(request, imaging, least_depth_m)
                * flight.video_frames_per_s,
                why=f"tracking follows {flight.most_video_motion_px:g} video px from a frame to the next",
                change="a greater height",
            )
        )
    return tuple(bounds)


def video_pixel_m(request: PlanRequest, imaging: Imaging, depth_m: float) -> float:
    """Return the ground distance of a pixel of the finder's video, which shows the whole width of the image."""
    return imaging.gsd_m(depth_m) * imaging.interior.width_px / request.flight.video_width_px


def chosen_speed(flight: FlightRequest, vehicle: VehicleProfile | None, bounds: Sequence[SpeedBound]) -> float:
    """Return the speed on the strips: the requested one, which must be possible, or the greatest usual one that is.

    Raises InputError where the requested speed is too high, or a fixed wing would have to fly too slowly.
    """
    usual = vehicle.speed_m_s if vehicle is not None else USUAL_SPEED_M_S
    least = min(bounds, key=lambda bound: bound.most_m_s, default=None)
    if flight.speed_m_s is not None:
        if vehicle is not None and flight.speed_m_s > vehicle.greatest_speed_m_s:
            raise InputError(
                f"[flight] speed_m_s = {flight.speed_m_s:g}: {vehicle.name} flies {vehicle.greatest_speed_m_s:g} m/s "
                f"at most"
            )
        if least is not None and flight.speed_m_s > least.most_m_s * (1.0 + 1e-9):
            raise InputError(
                f"[flight] speed_m_s = {flight.speed_m_s:g} is too fast: {least.why}: at most {least.most_m_s:.2f} "
                f"m/s, or {least.change}"
            )
        return flight.speed_m_s
    speed = usual if least is None else min(usual, least.most_m_s)
    if vehicle is not None and vehicle.kind is VehicleKind.FIXED_WING and speed < SLOWEST_SHARE * usual:
        assert least is not None
        raise InputError(
            f"{vehicle.name} cannot fly as slowly as {speed:.1f} m/s (usually {usual:g}): {least.why}; ask for "
            f"{least.change}"
        )
    return speed


def performance_of(request: PlanRequest, vehicle: VehicleProfile | None, speed_m_s: float) -> Performance:
    """Return how this plan is flown; raises InputError where the wind is more than the vehicle can stand."""
    flight = request.flight
    transit = max(speed_m_s, vehicle.speed_m_s if vehicle is not None else USUAL_SPEED_M_S)
    if vehicle is not None:
        if vehicle.greatest_wind_m_s is not None and flight.wind_m_s > vehicle.greatest_wind_m_s:
            raise InputError(
                f"[flight] wind_m_s = {flight.wind_m_s:g}: {vehicle.name} stands {vehicle.greatest_wind_m_s:g} m/s "
                f"at most"
            )
        against = vehicle.greatest_speed_m_s - flight.wind_m_s
        if against < 1.0:
            raise InputError(
                f"[flight] wind_m_s = {flight.wind_m_s:g}: {vehicle.name}, which flies {vehicle.greatest_speed_m_s:g} "
                f"m/s, would hardly come back against it: wait for less wind"
            )
        transit, speed_m_s = min(transit, against), min(speed_m_s, against)
    return Performance(
        speed_m_s=speed_m_s,
        transit_m_s=transit,
        climb_m_s=_limit(flight.climb_m_s, vehicle.climb_m_s if vehicle else USUAL_CLIMB_M_S, vehicle, "climb_m_s"),
        descent_m_s=_limit(
            flight.descent_m_s, vehicle.descent_m_s if vehicle else USUAL_DESCENT_M_S, vehicle, "descent_m_s"
        ),
        acceleration_m_s2=vehicle.acceleration_m_s2 if vehicle is not None else USUAL_ACCELERATION_M_S2,
        turn_radius_m=vehicle.turn_radius_m if vehicle is not None else 0.0,
        hold_s=flight.hold_s if flight.trigger == "hover" else 0.0,
        stops=flight.trigger == "hover",
        even_speed=flight.trigger == "time",
    )


def _limit(asked: float | None, usual: float, vehicle: VehicleProfile | None, name: str) -> float:
    if asked is not None and vehicle is not None and asked > usual:
        raise InputError(f"[flight] {name} = {asked:g}: {vehicle.name} does {usual:g} m/s at most")
    return asked if asked is not None else usual


def check_payload(camera: CameraProfile, vehicle: VehicleProfile | None) -> str:
    """Refuse a camera that is too heavy for the vehicle; return a note where the mass is not known."""
    if vehicle is None or vehicle.payload_g == 0.0:  # its own camera is built in
        return ""
    if camera.mass_g is None:
        return f"the mass of {camera.name} is not known: {vehicle.name} carries {vehicle.payload_g:g} g"
    if camera.mass_g > vehicle.payload_g:
        raise InputError(
            f"{camera.name} weighs {camera.mass_g:g} g, {vehicle.name} carries {vehicle.payload_g:g} g: take a lighter "
            f"camera or another vehicle"
        )
    return ""


def check_lead(vehicle: VehicleProfile | None, request: PlanRequest) -> float:
    """Return the lead-in of the strips, m; raises InputError where a vehicle that must keep flying cannot hover."""
    flight = request.flight
    if request.pattern == "facade" and flight.trigger == "distance":
        raise InputError(
            "pattern = 'facade': its strips go up and down, and autopilots measure the distance between exposures "
            "across the ground: [flight] trigger = 'hover' or 'time'"
        )
    if vehicle is not None and vehicle.kind is VehicleKind.FIXED_WING:
        if flight.trigger == "hover":
            raise InputError(
                f"[flight] trigger = 'hover': {vehicle.name} cannot stop in the air: take distance or time"
            )
        if request.pattern in ("facade", "orbit"):
            raise InputError(f"pattern = {request.pattern!r}: {vehicle.name} cannot fly it: take a multirotor")
        return flight.lead_in_m if flight.lead_in_m is not None else 2.0 * vehicle.turn_radius_m
    if flight.lead_in_m is not None:
        return flight.lead_in_m
    if flight.trigger == "hover":
        return 0.0
    speed = flight.speed_m_s or (vehicle.speed_m_s if vehicle is not None else USUAL_SPEED_M_S)
    acceleration = vehicle.acceleration_m_s2 if vehicle is not None else USUAL_ACCELERATION_M_S2
    return 0.5 * speed**2 / acceleration + 1.0


@dataclass(frozen=True, kw_only=True)
class MapFences:
    """Fences in map coordinates (shapely's)."""

    inside: Any = None
    outside: Any = None
    margin_m: float = 0.0
    """That the vehicle needs beside its path to turn."""


def check_fences(vertices: Sequence[Vertex], ground: Ground, fences: MapFences) -> None:
    """Refuse a path that leaves the fence or crosses a place to keep out of, naming where."""
    from shapely import LineString, Point

    if fences.inside is None and fences.outside is None:
        return
    for before, after in pairwise(vertices):
        ends = np.array([before.xyz_m[:2], after.xyz_m[:2]])
        leg = Point(ends[0]) if np.allclose(*ends) else LineString(ends)
        turning = before.line != after.line and fences.margin_m > 0.0
        swept = leg.buffer(fences.margin_m) if turning else leg
        what = "turning there" if turning else "the path"
        if fences.inside is not None and not fences.inside.covers(swept):
            raise _fenced(ground, ends[1], f"{what} leaves the fence", turning)
        if fences.outside is not None and fences.outside.intersects(swept):
            raise _fenced(ground, ends[1], f"{what} crosses a place to keep out of", turning)


def _fenced(ground: Ground, xy: Array, what: str, turning: bool) -> InputError:
    latitude, longitude = ground.local_map.geographic_from_map(xy[None])[0]
    more = "there is no room for a turn: " if turning else ""
    return InputError(
        f"{what} near latitude {latitude:.6f}, longitude {longitude:.6f}: {more}make the area smaller, turn the "
        f"strips, shorten lead_in_m, or move the take-off point"
    )


def check_heights(path_m: Array, ground: Ground, request: PlanRequest, first_level: int) -> tuple[float, float]:
    """Return least clearance (minus twice the model's sigma) and greatest height above ground of a path (k, 3).

    first_level: vertices before it, and the same number at the end, belong to take-off and landing. Raises InputError
    where the path is too low or higher than the law allows, naming the place.
    """
    legs = ground.clearances(path_m[first_level:])
    if len(legs) == 0:
        return float("inf"), float("-inf")
    clearance = legs[:, 0] - 2.0 * ground.sigma_m
    worst = int(np.argmin(clearance))
    if clearance[worst] < request.terrain.least_clearance_m - 1e-6:
        raise InputError(
            f"the path comes within {legs[worst, 0]:.1f} m of the ground {_near(ground, path_m[first_level + worst])}; "
            f"less twice the terrain model's error of {ground.sigma_m:g} m this is under the clearance of "
            f"{request.terrain.least_clearance_m:g} m: fly higher, follow the ground more closely (tolerance), or take "
            f"a better terrain model"
        )
    highest = int(np.argmax(legs[:, 1]))
    most = request.flight.greatest_height_above_ground_m
    if legs[highest, 1] > most + 1e-6:
        raise InputError(
            f"the path is {legs[highest, 1]:.0f} m above the ground {_near(ground, path_m[first_level + highest])}, "
            f"greatest_height_above_ground_m, the law where you fly, allows {most:g} m: fly lower, follow the "
            f"ground, or divide the area"
        )
    return float(clearance[worst]), float(legs[highest, 1])


def _near(ground: Ground, xyz: Array) -> str:
    latitude, longitude = ground.local_map.geographic_from_map(xyz[None, :2])[0]
    return f"near latitude {latitude:.6f}, longitude {longitude:.6f}"
