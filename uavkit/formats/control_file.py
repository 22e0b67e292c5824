"""Surveyed points with their marks in images: OpenDroneMap's gcp_list.txt, and uavkit's own CSV.

gcp_list.txt: a first line with the CRS, then ``X Y Z column row image [label] [more]`` in blanks or tabs; rows of one
label (without labels: of the same coordinates) are one point. It states neither sigmas nor the heights' datum.

The CSV states all of it::

    # uavkit points
    # crs: EPSG:32654
    # vertical: ellipsoid            (or geoid)
    # pixel: centre                  (or corner)
    name,easting_m,northing_m,height_m,sigma_easting_m,sigma_northing_m,sigma_height_m,image,column_px,row_px,sigma_px
"""

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import TypeVar

import numpy as np

from uavkit.core.errors import InputError, did_you_mean
from uavkit.core.frames import LocalFrame, ellipsoid_heights_m, geographic_from_crs, parse_crs
from uavkit.core.heights import HeightDatum
from uavkit.core.points import CheckPoint, ImageMark, SurveyedPoint
from uavkit.formats.atomic import write_text
from uavkit.formats.commented_csv import comment_keys, rows_of_cells

COLUMNS = (
    "name",
    "easting_m",
    "northing_m",
    "height_m",
    "sigma_easting_m",
    "sigma_northing_m",
    "sigma_height_m",
    "image",
    "column_px",
    "row_px",
    "sigma_px",
)
_NEEDED = COLUMNS[:4]
_KEYS = ("crs", "vertical", "pixel")
UNKNOWN_HEIGHT_SIGMA_M = 1e4
"""A control point without a height takes part with this sigma of its height: its position alone counts."""

P = TypeVar("P", bound=SurveyedPoint)


class PixelOrigin(Enum):
    """What (0, 0) is in a file of marks."""

    CENTRE = "centre"
    """The centre of the upper left pixel, as everywhere in uavkit."""
    CORNER = "corner"
    """Its upper left corner: 0.5 px are taken off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlFileOptions:
    """What counts where a file does not say it."""

    sigma_horizontal_m: float = 0.01
    """Of easting and northing each."""
    sigma_height_m: float = 0.02
    sigma_mark_px: float = 1.0
    vertical: HeightDatum = HeightDatum.UNKNOWN
    pixel_origin: PixelOrigin = PixelOrigin.CENTRE


@dataclass(frozen=True, slots=True, kw_only=True)
class FileMark:
    """A mark as the file has it."""

    image: str
    column_px: float
    row_px: float
    sigma_px: float
    line: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class FilePoint:
    """A surveyed point in the CRS of its file."""

    name: str
    coordinates: tuple[float, float, float]
    """Easting, northing in metres (longitude, latitude in degrees for a geographic CRS) and height in metres; NaN
    where the height is not known."""
    sigma_m: tuple[float, float, float]
    """Easting, northing, height, in metres for a geographic CRS too."""
    marks: tuple[FileMark, ...]
    line: int = field(default=0, compare=False)
    """Where the point first appears."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyedPoints:
    """The contents of a file of surveyed points."""

    crs: str
    vertical: HeightDatum
    pixel_origin: PixelOrigin
    points: tuple[FilePoint, ...]
    source: str = field(default="", compare=False)
    """Path, for messages."""

    def only(self, names: Iterable[str]) -> "SurveyedPoints":
        """Return the points of these names, in the order of the file; raises InputError for an unknown name."""
        known, wanted = [point.name for point in self.points], set(names)
        for name in sorted(wanted - set(known)):
            raise InputError(f"{self.source}: there is no point {name!r}{did_you_mean(name, known)}")
        return replace(self, points=tuple(point for point in self.points if point.name in wanted))


@dataclass(slots=True)
class _Row:
    """One line of a file, parsed but not yet grouped."""

    line: int
    name: str
    coordinates: tuple[float, float, float]
    sigma_m: tuple[float, float, float]
    mark: FileMark | None


def read_surveyed_points(path: Path, options: ControlFileOptions | None = None) -> SurveyedPoints:
    """Read a gcp_list.txt or a CSV of surveyed points, told apart by content.

    Raises InputError naming file and line for whatever cannot be understood or contradicts itself.
    """
    lines = _lines(path)
    for line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            is_csv = "," in line and "easting_m" in line.replace(" ", "").lower().split(",")
            is_csv = is_csv or path.suffix.lower() == ".csv"
            return (_read_csv if is_csv else _read_odm)(path, lines, options or ControlFileOptions())
    raise InputError(f"{path}: the file holds no surveyed point: give a gcp_list.txt or a CSV of uavkit")


def to_local(
    surveyed: SurveyedPoints, frame: LocalFrame, kind: type[P], vertical: HeightDatum | None = None
) -> tuple[P, ...]:
    """Return ControlPoint or CheckPoint records in a local frame, marks counted from the centre of the first pixel.

    ``vertical`` overrides the datum that the file states; heights of unknown datum count as ellipsoidal, and a CRS with
    a vertical part brings its own. Sigmas of easting and northing are taken for those of east and north: axes differ
    by the convergence of the meridian, a few degrees. Raises InputError for a check point without height and for
    coordinates that do not fit the CRS.
    """
    if not surveyed.points:
        return ()
    coordinates = np.array([point.coordinates for point in surveyed.points])
    without_height = np.isnan(coordinates[:, 2])
    if issubclass(kind, CheckPoint) and np.any(without_height):
        bad = surveyed.points[int(np.argmax(without_height))]
        raise InputError(
            f"{surveyed.source}: line {bad.line}: check point {bad.name!r} has no height: give one or use it as control"
        )
    coordinates[without_height, 2] = 0.0
    try:
        latitude, longitude, height = geographic_from_crs(coordinates, surveyed.crs).T
    except InputError as error:
        raise InputError(f"{surveyed.source}: {error}") from error
    if len(parse_crs(surveyed.crs).axis_info) < 3:
        height = ellipsoid_heights_m(latitude, longitude, height, vertical or surveyed.vertical)
    height[without_height] = frame.height_ellipsoid_m
    enu = frame.enu_from_geographic(latitude, longitude, height)
    shift_px = -0.5 if surveyed.pixel_origin is PixelOrigin.CORNER else 0.0
    return tuple(
        kind(
            name=point.name,
            position_m=(float(position[0]), float(position[1]), float(position[2])),
            sigma_m=(*point.sigma_m[:2], UNKNOWN_HEIGHT_SIGMA_M if unknown else point.sigma_m[2]),
            marks=tuple(_image_mark(mark, shift_px) for mark in point.marks),
        )
        for point, position, unknown in zip(surveyed.points, enu, without_height, strict=True)
    )


def write_points_csv(path: Path, surveyed: SurveyedPoints) -> None:
    """Write the CSV, whole or not at all; raises InputError for a geographic CRS, whose degrees are no metres."""
    _refuse_geographic(path, surveyed.crs)
    stream = io.StringIO()
    stream.write(f"# uavkit points\n# crs: {surveyed.crs}\n")
    if surveyed.vertical is not HeightDatum.UNKNOWN:
        stream.write(f"# vertical: {surveyed.vertical.value}\n")
    stream.write(f"# pixel: {surveyed.pixel_origin.value}\n")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for point in surveyed.points:
        height = "" if math.isnan(point.coordinates[2]) else repr(point.coordinates[2])
        place = [_name(path, point.name), *map(repr, point.coordinates[:2]), height, *map(repr, point.sigma_m)]
        for mark in point.marks:
            writer.writerow([*place, mark.image, repr(mark.column_px), repr(mark.row_px), repr(mark.sigma_px)])
        if not point.marks:
            writer.writerow([*place, "", "", "", ""])
    write_text(path, stream.getvalue())


def write_gcp_list(path: Path, surveyed: SurveyedPoints) -> None:
    """Write OpenDroneMap's gcp_list.txt with labels, in tabs; raises InputError for a point without marks.

    The file cannot state sigmas, nor the datum of the heights.
    """
    rows = [surveyed.crs]
    for point in surveyed.points:
        if not point.marks:
            raise InputError(f"{path}: {point.name!r} has no marks, and a gcp_list.txt holds only marks: write a CSV")
        place = [*map(repr, point.coordinates[:2]), repr(point.coordinates[2])]
        for mark in point.marks:
            cells = [*place, repr(mark.column_px), repr(mark.row_px), mark.image, _name(path, point.name)]
            rows.append("\t".join(cells))
    write_text(path, "\n".join(rows) + "\n")


def _image_mark(mark: FileMark, shift_px: float) -> ImageMark:
    return ImageMark(
        image=mark.image,
        column_px=mark.column_px + shift_px,
        row_px=mark.row_px + shift_px,
        sigma_px=mark.sigma_px,
    )


def _lines(path: Path) -> list[str]:
    """Return a text file's lines; UTF-8 with or without byte order mark, any line ends."""
    try:
        return path.read_bytes().decode("utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no UTF-8 text (byte {error.start}): save it as UTF-8") from error


def _read_odm(path: Path, lines: Sequence[str], options: ControlFileOptions) -> SurveyedPoints:
    content = [(n, line.strip()) for n, line in enumerate(lines, start=1) if line.strip() and line.strip()[0] != "#"]
    number, crs = content[0]
    if len(crs.split()) >= 6 and all(_is_number(word) for word in crs.split()[:3]):
        raise InputError(f"{path}: line {number}: the first line must name the CRS, like EPSG:32654, and is {crs!r}")
    _check_crs(path, number, crs)
    rows = [_odm_row(path, number, line, options) for number, line in content[1:]]
    if parse_crs(crs).is_geographic:
        _check_degrees(path, rows)
    return SurveyedPoints(
        crs=crs,
        vertical=options.vertical,
        pixel_origin=options.pixel_origin,
        points=_grouped(path, rows),
        source=str(path),
    )


def _odm_row(path: Path, number: int, line: str, options: ControlFileOptions) -> _Row:
    where = f"{path}: line {number}"
    words = [word.strip() for word in line.split("\t")] if "\t" in line else line.split()
    if len(words) < 6 or not all(_is_number(word) for word in words[:2]):  # tabs and blanks mixed
        words = line.split()
    if len(words) < 6:
        commas = ": write blanks or tabs between fields, and decimal points" if "," in line else ""
        raise InputError(f"{where} has {len(words)} fields of 6, X Y Z column row image{commas}")
    x, y = (_finite(where, what, word) for what, word in zip("XY", words, strict=False))
    height = math.nan if words[2].lower() in ("nan", "-") else _finite(where, "Z", words[2])
    mark = FileMark(
        image=words[5],
        column_px=_finite(where, "column", words[3]),
        row_px=_finite(where, "row", words[4]),
        sigma_px=options.sigma_mark_px,
        line=number,
    )
    _check_mark(where, mark)
    sigma = (options.sigma_horizontal_m, options.sigma_horizontal_m, options.sigma_height_m)
    return _Row(number, words[6] if len(words) > 6 else "", (x, y, height), sigma, mark)


def _read_csv(path: Path, lines: Sequence[str], options: ControlFileOptions) -> SurveyedPoints:
    keys = comment_keys(path, lines, _KEYS)
    if "crs" not in keys:
        raise InputError(f"{path}: states no CRS: write a line like '# crs: EPSG:32654' above the header")
    _check_crs(path, keys["crs"][0], keys["crs"][1])
    _refuse_geographic(path, keys["crs"][1])
    vertical, origin = options.vertical, options.pixel_origin
    if "vertical" in keys:
        vertical = _choice(path, *keys["vertical"], {d.value: d for d in (HeightDatum.ELLIPSOID, HeightDatum.GEOID)})
    if "pixel" in keys:
        origin = _choice(path, *keys["pixel"], {item.value: item for item in PixelOrigin})
    rows = [
        _csv_row(f"{path}: line {number}", number, cells, options)
        for number, cells in rows_of_cells(path, lines, _check_header)
    ]
    return SurveyedPoints(
        crs=keys["crs"][1], vertical=vertical, pixel_origin=origin, points=_grouped(path, rows), source=str(path)
    )


def _check_header(where: str, header: list[str]) -> None:
    for name in header:
        if name not in COLUMNS:
            raise InputError(f"{where}: unknown column {name!r}{did_you_mean(name, COLUMNS)}")
    missing = [name for name in _NEEDED if name not in header]
    if missing or len(set(header)) < len(header):
        raise InputError(f"{where}: the header needs each of {', '.join(_NEEDED)} once")


def _csv_row(where: str, number: int, cells: dict[str, str], options: ControlFileOptions) -> _Row:
    if not cells["name"]:
        raise InputError(f"{where}: the point has no name")
    height = cells["height_m"]
    defaults = (options.sigma_horizontal_m, options.sigma_horizontal_m, options.sigma_height_m)
    sigmas = [_sigma(where, name, cells, value) for name, value in zip(COLUMNS[4:7], defaults, strict=True)]
    mark = None
    if cells.get("image"):
        mark = FileMark(
            image=cells["image"],
            column_px=_finite(where, "column_px", cells.get("column_px", "")),
            row_px=_finite(where, "row_px", cells.get("row_px", "")),
            sigma_px=_sigma(where, "sigma_px", cells, options.sigma_mark_px),
            line=number,
        )
        _check_mark(where, mark)
    elif cells.get("column_px") or cells.get("row_px"):
        raise InputError(f"{where}: a mark without image: fill in the column 'image' or empty column_px and row_px")
    return _Row(
        line=number,
        name=cells["name"],
        coordinates=(
            _finite(where, "easting_m", cells["easting_m"]),
            _finite(where, "northing_m", cells["northing_m"]),
            math.nan if height.lower() in ("", "nan", "-") else _finite(where, "height_m", height),
        ),
        sigma_m=(sigmas[0], sigmas[1], sigmas[2]),
        mark=mark,
    )


def _grouped(path: Path, rows: Sequence[_Row]) -> tuple[FilePoint, ...]:
    """Join the rows of each point; raises InputError where rows of one name, or marks in one image, contradict."""
    if not rows:
        raise InputError(f"{path}: the file holds no surveyed point below its head")
    groups: dict[str, list[_Row]] = {}
    names = {row.name for row in rows}
    unnamed: dict[tuple[str, ...], str] = {}
    for row in rows:
        key = row.name
        if not key:
            place = tuple(map(repr, row.coordinates))
            key = unnamed.setdefault(place, _free_name(names, len(unnamed) + 1))
        groups.setdefault(key, []).append(row)
    return tuple(_joined(path, name, group) for name, group in groups.items())


def _free_name(taken: set[str], number: int) -> str:
    name = f"point-{number}"
    while name in taken:
        name += "'"
    return name


def _joined(path: Path, name: str, rows: Sequence[_Row]) -> FilePoint:
    first, marks = rows[0], dict[str, FileMark]()
    for row in rows:
        same = row.coordinates[:2] == first.coordinates[:2] and repr(row.coordinates[2]) == repr(first.coordinates[2])
        if not same or row.sigma_m != first.sigma_m:
            what = "coordinates" if not same else "sigmas"
            raise InputError(
                f"{path}: lines {first.line} and {row.line} give {name!r} different {what}: correct one of "
                f"them, or give different points different names"
            )
        if row.mark is None:
            continue
        other = marks.setdefault(row.mark.image, row.mark)
        if other != row.mark:
            raise InputError(
                f"{path}: lines {other.line} and {row.line} mark {name!r} twice in {row.mark.image}: remove one of them"
            )
    return FilePoint(
        name=name,
        coordinates=first.coordinates,
        sigma_m=first.sigma_m,
        marks=tuple(marks.values()),
        line=first.line,
    )


def _check_crs(path: Path, line: int, crs: str) -> None:
    try:
        parse_crs(crs)
    except InputError as error:
        raise InputError(f"{path}: line {line}: {error}") from error


def _refuse_geographic(path: Path, crs: str) -> None:
    if parse_crs(crs).is_geographic:
        raise InputError(f"{path}: {crs} counts in degrees, the CSV in metres: give a projected CRS like EPSG:32654")


def _check_degrees(path: Path, rows: Sequence[_Row]) -> None:
    """Refuse degrees that are none: PROJ would wrap a latitude of 139 degrees around the pole and say nothing."""
    for row in rows:
        longitude, latitude, _ = row.coordinates
        if abs(latitude) > 90.0 or abs(longitude) > 180.0:
            raise InputError(
                f"{path}: line {row.line}: longitude {longitude:g}, latitude {latitude:g} is no place on earth: for a "
                f"geographic CRS X is longitude and Y latitude, in degrees"
            )


def _check_mark(where: str, mark: FileMark) -> None:
    if mark.column_px < -0.5 or mark.row_px < -0.5:
        raise InputError(f"{where}: the mark ({mark.column_px:g}, {mark.row_px:g}) lies outside of any image")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _finite(where: str, what: str, word: str) -> float:
    if re.fullmatch(r"[+-]?\d+,\d*", word):
        raise InputError(f"{where}: {what} is {word!r}: decimal commas are not accepted, write decimal points")
    number = float(word) if _is_number(word) else math.nan
    if not math.isfinite(number):
        raise InputError(f"{where}: {what} is {word!r}, not a number")
    return number


def _sigma(where: str, name: str, cells: dict[str, str], default: float) -> float:
    if not cells.get(name):
        return default
    value = _finite(where, name, cells[name])
    if value <= 0:
        raise InputError(f"{where}: {name} must be > 0, is {value:g}")
    return value


V = TypeVar("V")


def _choice(path: Path, line: int, value: str, known: dict[str, V]) -> V:
    if value.lower() not in known:
        raise InputError(f"{path}: line {line}: {value!r} is none of {', '.join(known)}{did_you_mean(value, known)}")
    return known[value.lower()]


def _name(path: Path, name: str) -> str:
    """Refuse names that a reader could not give back."""
    if not name or name != name.strip() or name.startswith("#") or not name.isprintable():
        raise InputError(f"{path}: {name!r} cannot be written as a name: no outer blanks, line breaks or leading '#'")
    return name
