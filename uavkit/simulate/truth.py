"""The truth of a simulated survey: one JSON file that no stage reads, and its export for a check by foreign code."""

import json
from dataclasses import asdict
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.formats.atomic import write_text
from uavkit.simulate.options import Terrain
from uavkit.simulate.site import CRS, HEIGHT_ELLIPSOID_M, LATITUDE_DEG, LONGITUDE_DEG, gps_time_ns, site_frame
from uavkit.simulate.world import AZIMUTH_RAD, along_across

if TYPE_CHECKING:
    from uavkit.simulate.control import TruePoint
    from uavkit.simulate.survey import Scene
    from uavkit.simulate.video import Finder


def survey_truth(scene: "Scene", finder: "Finder | None") -> dict[str, Any]:
    """Everything true about a survey as plain values."""
    options = {k: v.value if isinstance(v, Enum) else v for k, v in asdict(scene.options).items() if k != "workers"}
    return {
        "options": options,
        "world_seed": scene.world.seed,
        "frame": {
            "latitude_deg": LATITUDE_DEG,
            "longitude_deg": LONGITUDE_DEG,
            "height_ellipsoid_m": HEIGHT_ELLIPSOID_M,
            "crs": CRS,
            "crest_azimuth_from_east_deg": float(np.degrees(AZIMUTH_RAD)),
        },
        "camera": scene.camera.as_dict(),
        "camera_clock": asdict(scene.clock),
        "exposures": [_exposure(scene, n) for n in range(len(scene.names))],
        "control_points": [_point(point) for point in scene.control],
        "check_points": [_point(point) for point in scene.check],
        "gnss": {
            "shift_m": scene.waypoints.shift_m.tolist(),
            "outliers": [scene.names[n] for n in scene.waypoints.outliers],
            "outlier_indexes": scene.waypoints.outliers.tolist(),
            "lever_arm_m": [0.0, 0.0, 0.0],
        },
        "video": None if finder is None else _video(finder),
        "block": _block(scene),
    }


def _exposure(scene: "Scene", index: int) -> dict[str, Any]:
    time_s = float(scene.flight.exposure_s[index])
    last = int(scene.flight.last_live_field[index])
    view = scene.view(index)
    return {
        "image": scene.names[index],
        "strip": index // scene.options.stations_per_strip,
        "gps_time_ns": gps_time_ns(time_s),
        "video_time_s": time_s,
        "last_live_frame": last // 2,
        "last_live_field": last % 2,
        "first_black_frame": (last + 1) // 2,
        "first_black_field": (last + 1) % 2,
        "gain": float(scene.gains[index]),
        "projection_centre_m": view.centre_m.tolist(),
        "R_object_from_image": view.R_object_from_image.tolist(),
    }


def _point(point: "TruePoint") -> dict[str, Any]:
    place = point.position_m[None]
    return {
        "name": point.name,
        "position_m": point.position_m.tolist(),
        "crs_m": site_frame().crs_from_enu(place)[0].tolist(),
        "marks": {image: pixel for image, pixel in zip(point.images, point.pixels.tolist(), strict=True)},
    }


def _video(finder: "Finder") -> dict[str, Any]:
    flight = finder.flight
    return {
        "frames": finder.frame_count,
        "field_interval_s": flight.field_interval_s,
        "field_order": finder.options.field_order.value,
        "first_field_gps_time_ns": gps_time_ns(0.0),
        "still_from_video": {
            "matrix": finder.geometry.matrix.tolist(),
            "shift_px": finder.geometry.shift_px.tolist(),
        },
    }


def _block(scene: "Scene") -> dict[str, Any]:
    """Station spacing, heights above ground and overlaps, on the crest and at the foot (mean over the stations), or
    where the ground below the stations is nearest and farthest."""
    camera, stations = scene.camera, scene.flight.stations_m
    options = scene.options
    long_side = camera.width_px / camera.principal_distance_px
    short_side = camera.height_px / camera.principal_distance_px
    ground = scene.world.height_m(stations[:, 0], stations[:, 1])
    levels = _levels_m(scene, ground)
    return {
        "station_spacing_m": options.station_spacing_m,
        "strip_spacing_m": options.strip_spacing_m,
        "image_side_along_strip": "long (columns)",
        "gsd_m": {k: h / camera.principal_distance_px for k, h in levels.items()},
        "height_above_m": levels,
        "forward_overlap": {k: 1 - options.station_spacing_m / (h * long_side) for k, h in levels.items()},
        "side_overlap": {k: 1 - options.strip_spacing_m / (h * short_side) for k, h in levels.items()},
        "height_above_ground_at_stations_m": (stations[:, 2] - ground).round(2).tolist(),
    }


def _levels_m(scene: "Scene", ground_m: Array) -> dict[str, float]:
    """Mean height of the stations above two levels of the ground; ``ground_m`` lies below the stations."""
    stations, options = scene.flight.stations_m, scene.options
    height = float(stations[:, 2].mean())
    if options.terrain is not Terrain.EMBANKMENT:
        return {"highest": float((stations[:, 2] - ground_m).min()), "lowest": float((stations[:, 2] - ground_m).max())}
    _, across = along_across(stations[:, 0], stations[:, 1])
    centre_strip = np.abs(across) < options.strip_spacing_m * 0.51
    return {"crest": max(height - float(ground_m[centre_strip].mean()), 1.0), "foot": height}


def write_truth(path: Path, truth: dict[str, Any]) -> None:
    """Write the truth as JSON."""
    write_text(path, json.dumps(truth, indent=1) + "\n")


def read_truth(path: Path) -> dict[str, Any]:
    """Read the truth back; raises InputError where the file is missing or no truth of a survey."""
    try:
        truth: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no truth of a simulated survey: {error}") from error
    return truth


def truth_to_colmap_text(truth: dict[str, Any], folder: Path) -> None:
    """Write a survey's truth as COLMAP's text model: cameras.txt, images.txt, points3D.txt.

    COLMAP counts pixels from the corner of the upper left pixel (0.5 px more) and turns world into camera axes x right,
    y down, z forward. Points are the control and check points with their true marks.
    """
    camera = truth["camera"]
    c = camera["principal_distance_px"]
    numbers = [
        c,
        c,
        camera["x0_px"] + 0.5,
        camera["y0_px"] + 0.5,
        camera["k1"],
        camera["k2"],
        camera["p1"],
        camera["p2"],
    ]
    numbers += [camera["k3"], 0.0, 0.0, 0.0]
    line = ["1", "FULL_OPENCV", str(camera["width_px"]), str(camera["height_px"]), *(repr(float(n)) for n in numbers)]
    write_text(folder / "cameras.txt", " ".join(line) + "\n")
    points = truth["control_points"] + truth["check_points"]
    images, tracks = [], ["" for _ in points]
    for number, exposure in enumerate(truth["exposures"], start=1):
        R_camera_from_object = np.diag([1.0, -1.0, -1.0]) @ np.array(exposure["R_object_from_image"]).T
        shift = -R_camera_from_object @ np.array(exposure["projection_centre_m"])
        pose = [*_quaternion(R_camera_from_object), *shift.tolist()]
        images.append(" ".join([str(number), *map(repr, pose), "1", exposure["image"]]))
        marks: list[str] = []
        for n, point in enumerate(points):
            if exposure["image"] in point["marks"]:
                column, row = point["marks"][exposure["image"]]
                tracks[n] += f" {number} {len(marks)}"
                marks.append(f"{column + 0.5!r} {row + 0.5!r} {n + 1}")
        images.append(" ".join(marks))
    write_text(folder / "images.txt", "\n".join(images) + "\n")
    rows = [
        " ".join([str(n + 1), *map(repr, point["position_m"]), "0 0 0 0"]) + tracks[n] for n, point in enumerate(points)
    ]
    write_text(folder / "points3D.txt", "\n".join(rows) + "\n")


def _quaternion(R: Array) -> list[float]:
    """Unit quaternion (w, x, y, z) of a rotation matrix: eigenvector of its 4 x 4 form (Bar-Itzhack 2000)."""
    a = R
    form = np.array(
        [
            [a[0, 0] - a[1, 1] - a[2, 2], a[1, 0] + a[0, 1], a[2, 0] + a[0, 2], a[2, 1] - a[1, 2]],
            [a[1, 0] + a[0, 1], a[1, 1] - a[0, 0] - a[2, 2], a[2, 1] + a[1, 2], a[0, 2] - a[2, 0]],
            [a[2, 0] + a[0, 2], a[2, 1] + a[1, 2], a[2, 2] - a[0, 0] - a[1, 1], a[1, 0] - a[0, 1]],
            [a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1], a[0, 0] + a[1, 1] + a[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(form)[1][:, -1].tolist()
    return [w, x, y, z]
