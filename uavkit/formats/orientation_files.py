"""Exterior orientations as CSV and the interior orientation as TOML, with their a posteriori precision."""

import csv
import io
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uavkit.core.angles import omega_phi_kappa_from_rotation, omega_phi_kappa_jacobian
from uavkit.core.arrays import Array
from uavkit.core.camera import INTERIOR_PARAMETERS
from uavkit.core.errors import InputError
from uavkit.core.result import OrientedBlock
from uavkit.formats.atomic import write_text
from uavkit.formats.survey_axes import SurveyAxes, survey_axes

_ANGLES = ("omega_deg", "phi_deg", "kappa_deg")
_SIGMAS_CRS = ("sigma_easting_m", "sigma_northing_m", "sigma_height_m")
_SIGMAS_LOCAL = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
_SIGMAS_ANGLES = ("sigma_omega_deg", "sigma_phi_deg", "sigma_kappa_deg")


@dataclass(frozen=True, slots=True, kw_only=True)
class FileOrientation:
    """An image's exterior orientation as the CSV has it; all angles belong to the axes of the file's CRS."""

    image: str
    coordinates: tuple[float, float, float]
    omega_phi_kappa_deg: tuple[float, float, float]
    sigma_m: tuple[float, float, float]
    sigma_deg: tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class FileOrientations:
    """The contents of ``exterior_orientation.csv``."""

    crs: str | None
    """None where the coordinates are local ones."""
    orientations: tuple[FileOrientation, ...]


def exterior_orientations(oriented: OrientedBlock) -> FileOrientations:
    """Return the exterior orientations in the axes of the block's CRS, with standard deviations.

    The rotation is R_crs_from_image = R_crs_from_enu @ R_enu_from_image, with R_crs_from_enu (convergence of the
    meridian, curvature of the earth) at each projection centre; covariances are propagated to these axes.
    """
    axes, result = survey_axes(oriented.frame), oriented.adjustment
    places = axes.coordinates(result.projection_centres_m)
    rows = [
        _orientation(
            name,
            places[row],
            axes.R_axes_from_enu(result.projection_centres_m[row]),
            result.R_object_from_image[row],
            result.exterior_covariances[row],
        )
        for row, name in enumerate(oriented.images)
    ]
    return FileOrientations(crs=axes.crs, orientations=tuple(rows))


def write_exterior_orientations(path: Path, oriented: OrientedBlock) -> None:
    """Write ``exterior_orientation.csv``, whole or not at all."""
    contents, axes = exterior_orientations(oriented), survey_axes(oriented.frame)
    stream = io.StringIO()
    stream.write("\n".join(_head(axes, oriented.adjustment.datum.value)) + "\n")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_columns(axes))
    for item in contents.orientations:
        metres = [f"{value:.5f}" for value in item.coordinates]
        degrees = [f"{value:.8f}" for value in item.omega_phi_kappa_deg]
        sigmas = [f"{value:.5f}" for value in item.sigma_m] + [f"{value:.7f}" for value in item.sigma_deg]
        writer.writerow([item.image, *metres, *degrees, *sigmas])
    write_text(path, stream.getvalue())


def read_exterior_orientations(path: Path) -> FileOrientations:
    """Read ``exterior_orientation.csv``; raises InputError naming file and line."""
    try:
        lines = path.read_bytes().decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    head = [line for line in lines if line.startswith("#")]
    crs = next((found[1] for line in head if (found := re.match(r"#\s*crs:\s*(.+?)\s*$", line))), None)
    if crs is None:
        raise InputError(f"{path}: states no '# crs:': this is no exterior_orientation.csv of uavkit")
    rows = [(number, line) for number, line in enumerate(lines, start=1) if line.strip() and line[0] != "#"]
    columns = next(csv.reader([rows[0][1]])) if rows else []
    for known in (survey_columns(local=False), survey_columns(local=True)):
        if columns == list(known):
            break
    else:
        raise InputError(f"{path}: the header is not that of exterior orientations: {','.join(columns)!r}")
    items = tuple(_read_row(path, number, next(csv.reader([line])), len(columns)) for number, line in rows[1:])
    return FileOrientations(crs=None if crs.startswith("none") else crs, orientations=items)


def survey_columns(local: bool) -> tuple[str, ...]:
    """Return the columns of a file in local coordinates, or in those of a CRS."""
    place = ("east_m", "north_m", "up_m") if local else ("easting", "northing", "height_ellipsoid_m")
    return ("image", *place, *_ANGLES, *(_SIGMAS_LOCAL if local else _SIGMAS_CRS), *_SIGMAS_ANGLES)


def write_interior_orientation(path: Path, oriented: OrientedBlock) -> None:
    """Write ``interior_orientation.toml``, whole or not at all: values, sigmas (0: kept fixed) and correlations.

    The tables ``[interior]`` and ``[sigmas]`` have the keys of a camera profile and can replace a profile's own.
    """
    result = oriented.adjustment
    interior, sigma = result.interior, np.sqrt(np.diag(result.interior_covariance))
    lines = [
        "# uavkit interior orientation, adjusted",
        "# (0, 0) is the centre of the upper left pixel; distortion by Brown's model as in OpenCV, y down",
        f"camera = {json.dumps(oriented.block.camera.name, ensure_ascii=False)}",
        f"undetermined = {json.dumps(list(result.undetermined_interior))} # the block does not determine these",
        "",
        "[interior]",
        f"width_px = {interior.width_px}",
        f"height_px = {interior.height_px}",
        *(f"{name} = {float(value)!r}" for name, value in _named(interior.parameters())),
        "",
        "[sigmas] # a posteriori, 1 sigma; 0 was kept fixed",
        *(f"{name} = {float(value)!r}" for name, value in _named(sigma)),
    ]
    free = [number for number in range(len(sigma)) if sigma[number] > 0]
    for position, row in enumerate(free[:-1]):
        lines += ["", f"[correlations.{INTERIOR_PARAMETERS[row]}]"]
        for column in free[position + 1 :]:
            correlation = result.interior_covariance[row, column] / (sigma[row] * sigma[column])
            lines.append(f"{INTERIOR_PARAMETERS[column]} = {correlation:.4f}")
    write_text(path, "\n".join(lines) + "\n")


def _named(values: Array) -> list[tuple[str, float]]:
    return list(zip(INTERIOR_PARAMETERS, values.tolist(), strict=True))


def _orientation(
    name: str, place: Array, R_axes_from_enu: Array, R_enu_from_image: Array, covariance: Array
) -> FileOrientation:
    """Turn one orientation and its covariance (6, 6) into the file's axes."""
    rotation = R_axes_from_enu @ R_enu_from_image
    jacobian = omega_phi_kappa_jacobian(rotation)  # the rotation vector is in image space: no axes to turn
    centre = R_axes_from_enu @ covariance[:3, :3] @ R_axes_from_enu.T
    angles = jacobian @ covariance[3:, 3:] @ jacobian.T
    return FileOrientation(
        image=name,
        coordinates=_three(place),
        omega_phi_kappa_deg=_three(np.degrees(omega_phi_kappa_from_rotation(rotation))),
        sigma_m=_three(np.sqrt(np.diag(centre))),
        sigma_deg=_three(np.degrees(np.sqrt(np.diag(angles)))),
    )


def _three(values: Array) -> tuple[float, float, float]:
    first, second, third = values.tolist()
    return first, second, third


def _head(axes: SurveyAxes, datum: str) -> list[str]:
    if axes.frame is None:
        place = ["# crs: none (local coordinates: nothing tells where on earth, nor necessarily which scale)"]
        name = "the local frame"
    else:
        place = [f"# crs: {axes.crs}", "# heights: above the ellipsoid of WGS 84, in metres"]
        name = "the CRS (easting, northing, up) at the image's place"
    return [
        "# uavkit exterior orientation",
        *place,
        f"# datum: {datum}",
        "# rotation: R = Rx(omega) Ry(phi) Rz(kappa), from image space (x right, y up, z towards the viewer)",
        f"#           to the axes of {name}",
        "# sigmas: a posteriori standard deviations",
    ]


def _columns(axes: SurveyAxes) -> Sequence[str]:
    return survey_columns(local=axes.frame is None)


def _read_row(path: Path, number: int, cells: list[str], count: int) -> FileOrientation:
    try:
        if len(cells) != count:
            raise ValueError(f"{len(cells)} cells, the header has {count}")
        values = np.array([float(cell) for cell in cells[1:]])
    except ValueError as error:
        raise InputError(f"{path}: line {number}: {error}") from error
    return FileOrientation(
        image=cells[0],
        coordinates=_three(values[0:3]),
        omega_phi_kappa_deg=_three(values[3:6]),
        sigma_m=_three(values[6:9]),
        sigma_deg=_three(values[9:12]),
    )
