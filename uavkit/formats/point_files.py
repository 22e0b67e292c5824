"""Object points of an oriented block as PLY and as LAS or LAZ, in the coordinates of its CRS."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.frames import parse_crs
from uavkit.core.points import PointKind
from uavkit.core.result import OrientedBlock
from uavkit.formats.atomic import atomic_path
from uavkit.formats.survey_axes import survey_axes

_PLY_RECORD = np.dtype(
    [
        ("x", "<f8"),
        ("y", "<f8"),
        ("z", "<f8"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("kind", "u1"),
        ("rays", "<u2"),
        ("sigma_x", "<f4"),
        ("sigma_y", "<f4"),
        ("sigma_z", "<f4"),
    ]
)
_PLY_NAMES = {"<f8": "double", "<f4": "float", "|u1": "uchar", "<u2": "ushort"}


@dataclass(frozen=True, slots=True, kw_only=True)
class PointTable:
    """The determined object points in the file's coordinates."""

    crs: str | None
    coordinates: Array
    """(n, 3)."""
    sigma_m: Array
    """(n, 3) along the axes of the CRS."""
    colours: NDArray[np.uint8]
    """(n, 3) red, green, blue."""
    kinds: NDArray[np.uint8]
    """(n,) PointKind."""
    rays: NDArray[np.uint16]
    """(n,) number of rays used."""


def point_table(oriented: OrientedBlock) -> PointTable:
    """Return the determined points of a block in the coordinates of its CRS, local ones without a frame."""
    axes, result = survey_axes(oriented.frame), oriented.adjustment
    determined = np.all(np.isfinite(result.points_m), axis=1)
    points = result.points_m[determined]
    middle = points.mean(axis=0) if len(points) else np.zeros(3)
    R_axes_from_enu = axes.R_axes_from_enu(middle)
    covariances = R_axes_from_enu @ result.point_covariances_m2[determined] @ R_axes_from_enu.T
    used = oriented.rays.point_index[result.ray_used]
    count = np.bincount(used, minlength=len(result.points_m))[determined]
    return PointTable(
        crs=axes.crs,
        coordinates=axes.coordinates(points),
        sigma_m=np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)),
        colours=oriented.point_colours[determined],
        kinds=oriented.point_kinds[determined].astype(np.uint8),
        rays=np.minimum(count, 65_535).astype(np.uint16),
    )


def write_ply(path: Path, oriented: OrientedBlock) -> None:
    """Write a binary PLY with coordinates in double precision, colours, kind, rays and sigmas."""
    table = point_table(oriented)
    records = np.zeros(len(table.coordinates), dtype=_PLY_RECORD)
    for column, name in enumerate("xyz"):
        records[name] = table.coordinates[:, column]
        records[f"sigma_{name}"] = table.sigma_m[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        records[name] = table.colours[:, column]
    records["kind"], records["rays"] = table.kinds, table.rays
    kinds = ", ".join(f"{kind.value} {kind.name.lower()}" for kind in PointKind)
    place = f"crs {table.crs}, heights above the ellipsoid" if table.crs else "local coordinates"
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {place}; {'metres' if table.crs else 'of arbitrary position, direction and scale'}",
        f"comment kind: {kinds}",
        f"element vertex {len(records)}",
        *(f"property {_PLY_NAMES[str(_PLY_RECORD[name].str)]} {name}" for name in _PLY_RECORD.names or ()),
        "end_header",
    ]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(head).encode() + b"\n" + records.tobytes())


def write_las(path: Path, oriented: OrientedBlock) -> None:
    """Write LAS or, by the suffix .laz, LAZ: version 1.4, colours, kind, rays and sigmas, millimetres.

    The CRS is in the file as WKT; heights are above the ellipsoid. Raises InputError where there is no point.
    """
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    table = point_table(oriented)
    if len(table.coordinates) == 0:
        raise InputError(f"{path}: the block has no object point to write")
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.floor(table.coordinates.min(axis=0))
    header.system_identifier, header.generating_software = "ellipsoidal heights", "uavkit"
    header.creation_date = None  # the same block gives the same file
    for name, kind in (("kind", "u1"), ("rays", "u2"), ("sigma_x", "f4"), ("sigma_y", "f4"), ("sigma_z", "f4")):
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=kind))
    if table.crs:
        header.vlrs.append(WktCoordinateSystemVlr(parse_crs(table.crs).to_wkt("WKT1_GDAL")))
        header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.x, las.y, las.z = table.coordinates.T
    las.red, las.green, las.blue = (table.colours.astype(np.uint16) * 257).T
    las["kind"], las["rays"] = table.kinds, table.rays
    for column, name in enumerate("xyz"):
        las[f"sigma_{name}"] = table.sigma_m[:, column]
    with atomic_path(path) as temporary:
        las.write(str(temporary))
