"""An oriented block as a COLMAP text model: cameras.txt, images.txt, points3D.txt.

COLMAP counts pixels from the corner of the first one (0.5 px more) and has camera axes x right, y down, z forward; the
world is the block's local frame, east, north, up in metres.
"""

from pathlib import Path

import numpy as np

from uavkit.core.arrays import Indices
from uavkit.core.camera import InteriorOrientation
from uavkit.core.errors import InputError
from uavkit.core.result import OrientedBlock
from uavkit.formats.atomic import write_text

_CAMERA_FROM_IMAGE_SPACE = np.diag([1.0, -1.0, -1.0])


def write_colmap_model(folder: Path, oriented: OrientedBlock) -> None:
    """Write the three text files into a folder: used rays and determined points.

    Raises InputError where COLMAP's text format cannot hold the block: a sheared camera, blanks in image names.
    """
    bad = next((name for name in oriented.images if len(name.split()) != 1), None)
    if bad is not None:
        raise InputError(f"{folder}: COLMAP's text format has no blanks in image names: rename {bad!r}")
    rows = _rays_to_write(oriented)
    camera = "1 FULL_OPENCV " + _camera_parameters(folder, oriented.adjustment.interior)
    write_text(folder / "cameras.txt", f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n{camera}\n")
    write_text(folder / "images.txt", _images(oriented, rows))
    write_text(folder / "points3D.txt", _points(oriented, rows))


def _rays_to_write(oriented: OrientedBlock) -> Indices:
    """Return the rows of rays that are used and whose points are determined, sorted by image."""
    determined = np.all(np.isfinite(oriented.adjustment.points_m), axis=1)
    rows = np.flatnonzero(oriented.adjustment.ray_used & determined[oriented.rays.point_index])
    return np.asarray(rows[np.argsort(oriented.rays.image_index[rows], kind="stable")], dtype=np.int64)


def _camera_parameters(folder: Path, interior: InteriorOrientation) -> str:
    if abs(interior.b2) * max(interior.width_px, interior.height_px) > 0.01:
        raise InputError(
            f"{folder}: COLMAP knows no shear, and the camera's b2 is {interior.b2:g}: adjust with b2 fixed"
        )
    c = interior.principal_distance_px
    values = [c * (1.0 + interior.b1), c, interior.x0_px + 0.5, interior.y0_px + 0.5]
    values += [interior.k1, interior.k2, interior.p1, interior.p2, interior.k3, 0.0, 0.0, 0.0]
    return " ".join([str(interior.width_px), str(interior.height_px), *map(repr, map(float, values))])


def _images(oriented: OrientedBlock, rows: Indices) -> str:
    from scipy.spatial.transform import Rotation

    result, rays = oriented.adjustment, oriented.rays
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# POINTS2D[] as X Y POINT3D_ID"]
    for number, name in enumerate(oriented.images):
        R_camera_from_world = _CAMERA_FROM_IMAGE_SPACE @ result.R_object_from_image[number].T
        x, y, z, w = Rotation.from_matrix(R_camera_from_world).as_quat().tolist()
        shift = (-R_camera_from_world @ result.projection_centres_m[number]).tolist()
        lines.append(" ".join([str(number + 1), *map(repr, [w, x, y, z, *shift]), "1", name]))
        own = rows[rays.image_index[rows] == number]
        points = zip((rays.xy_px[own] + 0.5).tolist(), rays.point_index[own].tolist(), strict=True)
        lines.append(" ".join(f"{column!r} {row!r} {point + 1}" for (column, row), point in points))
    return "\n".join(lines) + "\n"


def _points(oriented: OrientedBlock, rows: Indices) -> str:
    """Return points3D.txt; a track names (image, place among the image's points), the error is the mean residual."""
    rays, result = oriented.rays, oriented.adjustment
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX"]
    images, points = rays.image_index[rows], rays.point_index[rows]
    place = np.arange(len(rows)) - np.searchsorted(images, images)
    errors = np.linalg.norm(result.ray_residuals_px[rows], axis=1)
    order = np.argsort(points, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(points[order])) + 1):
        if len(group) == 0:
            continue
        point = int(points[group[0]])
        track = " ".join(f"{images[ray] + 1} {place[ray]}" for ray in group)
        position = " ".join(map(repr, result.points_m[point].tolist()))
        colour = " ".join(map(str, oriented.point_colours[point].tolist()))
        lines.append(f"{point + 1} {position} {colour} {float(errors[group].mean()):.4f} {track}")
    return "\n".join(lines) + "\n"
