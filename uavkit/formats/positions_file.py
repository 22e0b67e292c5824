"""Positions of the antenna by image, as RTK and PPK software tells them: a CSV that states each fix's sigmas.

::

    # uavkit positions
    # vertical: ellipsoid            (or geoid)
    # shift_sigma_m: 0.01            (or three numbers: east north up; may be missing)
    image,latitude_deg,longitude_deg,height_m,sigma_east_m,sigma_north_m,sigma_up_m

Instead of latitude and longitude there may be ``easting_m,northing_m`` with a line ``# crs: EPSG:...``; the sigmas may
be missing. ``shift_sigma_m`` is the a priori sigma of the error that all fixes have in common: the base station's.
"""

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from uavkit.core.errors import InputError, did_you_mean
from uavkit.core.frames import geographic_from_crs, parse_crs
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix
from uavkit.formats.atomic import write_text
from uavkit.formats.commented_csv import comment_keys, rows_of_cells, text_lines

_GEOGRAPHIC = ("latitude_deg", "longitude_deg")
_PROJECTED = ("easting_m", "northing_m")
_SIGMAS = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
COLUMNS = ("image", *_GEOGRAPHIC, "height_m", *_SIGMAS)
_KNOWN = (*COLUMNS, *_PROJECTED)
_KEYS = ("crs", "vertical", "shift_sigma_m")
_DATUMS = {datum.value: datum for datum in (HeightDatum.ELLIPSOID, HeightDatum.GEOID)}

_Row = tuple[int, dict[str, str]]
"""Line number and cells by column."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagePositions:
    """Fixes that each name their image."""

    fixes: tuple[GnssFix, ...]
    """``name`` is the image's."""
    lines: tuple[int, ...] = field(default=(), compare=False)
    """Where each stands in the file."""
    shift_sigma_m: tuple[float, float, float] | None = None
    """A priori sigma of the common error, east, north, up; None where the file does not say."""
    source: str = field(default="", compare=False)
    """Path, for messages."""


def read_image_positions(path: Path) -> ImagePositions:
    """Read the CSV; raises InputError naming file and line for whatever cannot be understood."""
    lines = text_lines(path)
    keys, rows = comment_keys(path, lines, _KEYS), list(rows_of_cells(path, lines, _check_header))
    if not rows:
        raise InputError(f"{path}: the file holds no position below its header")
    _refuse_doubles(path, rows)
    crs = keys["crs"][1] if "crs" in keys else ""
    datum = _datum(path, keys)
    if _PROJECTED[0] in rows[0][1]:
        if not crs:
            raise InputError(f"{path}: {' and '.join(_PROJECTED)} need a CRS: write a line like '# crs: EPSG:32654'")
        places, datum = _from_projected(path, keys["crs"], rows, datum)
    else:
        places = [_geographic(f"{path}: line {number}", cells) for number, cells in rows]
    fixes = [_fix(path, row, place, datum) for row, place in zip(rows, places, strict=True)]
    return ImagePositions(
        fixes=tuple(fixes), lines=tuple(n for n, _ in rows), shift_sigma_m=_shift(path, keys), source=str(path)
    )


def joined_image_positions(files: Sequence[ImagePositions]) -> ImagePositions:
    """Return the positions of several files as one; raises InputError where two state different common sigmas."""
    if len(files) == 1:
        return files[0]
    shifts = {one.shift_sigma_m for one in files}
    if len(shifts) > 1:
        raise InputError(f"{files[0].source} and {files[-1].source} state different shift_sigma_m: make them alike")
    return ImagePositions(
        fixes=tuple(fix for one in files for fix in one.fixes),
        lines=tuple(line for one in files for line in one.lines),
        shift_sigma_m=shifts.pop(),
        source=", ".join(one.source for one in files),
    )


def write_image_positions(path: Path, positions: ImagePositions) -> None:
    """Write the CSV in degrees, whole or not at all; raises InputError for mixed datums of heights."""
    datums = {fix.height_datum for fix in positions.fixes}
    if len(datums) > 1:
        raise InputError(f"{path}: the positions mix heights of different datums")
    stream = io.StringIO()
    stream.write("# uavkit positions\n")
    if datums & set(_DATUMS.values()):
        stream.write(f"# vertical: {datums.pop().value}\n")
    if positions.shift_sigma_m is not None:
        stream.write(f"# shift_sigma_m: {' '.join(map(repr, positions.shift_sigma_m))}\n")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for fix in positions.fixes:
        place = f"{fix.latitude_deg:.10f}", f"{fix.longitude_deg:.10f}", f"{fix.height_m:.4f}"
        sigmas = (*(fix.sigma_east_north_m or (fix.sigma_horizontal_m,) * 2), fix.sigma_vertical_m)
        writer.writerow([fix.name, *place, *("" if sigma is None else repr(sigma) for sigma in sigmas)])
    write_text(path, stream.getvalue())


def _check_header(where: str, header: list[str]) -> None:
    """Refuse a header with unknown, doubled or missing columns."""
    for name in header:
        if name not in _KNOWN:
            raise InputError(f"{where}: unknown column {name!r}{did_you_mean(name, _KNOWN)}")
    plane = _PROJECTED if _PROJECTED[0] in header or _PROJECTED[1] in header else _GEOGRAPHIC
    needed = ["image", *plane, "height_m"]
    if any(name in header for name in _SIGMAS):
        needed += _SIGMAS
    missing = [name for name in needed if name not in header]
    if missing:
        raise InputError(f"{where}: the header misses {', '.join(missing)}; it needs {', '.join(needed)}")
    if len(header) > len(needed):
        doubled = sorted({name for name in header if header.count(name) > 1 or name not in needed})
        raise InputError(f"{where}: each column is needed once, and one pair of coordinates: look at {doubled}")


def _refuse_doubles(path: Path, rows: Sequence[_Row]) -> None:
    seen: dict[str, int] = {}
    for number, cells in rows:
        name = cells["image"]
        if not name:
            raise InputError(f"{path}: line {number}: the position names no image")
        if seen.setdefault(name.casefold(), number) != number:
            first = seen[name.casefold()]
            raise InputError(f"{path}: lines {first} and {number} both give a position of {name}: remove one of them")


def _datum(path: Path, keys: dict[str, tuple[int, str]]) -> HeightDatum:
    if "vertical" not in keys:
        return HeightDatum.UNKNOWN
    number, value = keys["vertical"]
    if value.lower() not in _DATUMS:
        hint = did_you_mean(value, _DATUMS)
        raise InputError(f"{path}: line {number}: {value!r} is none of {', '.join(_DATUMS)}{hint}")
    return _DATUMS[value.lower()]


def _shift(path: Path, keys: dict[str, tuple[int, str]]) -> tuple[float, float, float] | None:
    if "shift_sigma_m" not in keys:
        return None
    number, value = keys["shift_sigma_m"]
    where = f"{path}: line {number}"
    numbers = [_finite(where, "shift_sigma_m", word) for word in value.split()]
    if len(numbers) == 1:
        numbers *= 3
    if len(numbers) != 3 or min(numbers) <= 0:
        raise InputError(f"{where}: shift_sigma_m needs one number > 0, or three (east north up), in metres: {value!r}")
    return numbers[0], numbers[1], numbers[2]


_Place = tuple[float, float, float]
"""Latitude and longitude in degrees, height in metres."""


def _geographic(where: str, cells: dict[str, str]) -> _Place:
    latitude, longitude = (_finite(where, name, cells[name]) for name in _GEOGRAPHIC)
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        swapped = abs(longitude) <= 90.0 and abs(latitude) <= 180.0
        hint = "latitude and longitude are swapped" if swapped else "give decimal degrees"
        raise InputError(f"{where}: latitude {latitude:g}, longitude {longitude:g} is no place on earth: {hint}")
    return latitude, longitude, _finite(where, "height_m", cells["height_m"])


def _from_projected(
    path: Path, crs: tuple[int, str], rows: Sequence[_Row], datum: HeightDatum
) -> tuple[list[_Place], HeightDatum]:
    """Return places and the datum of their heights: a CRS with a vertical part brings its own."""
    number, name = crs
    names = (*_PROJECTED, "height_m")
    table = np.array([[_finite(f"{path}: line {n}", key, cells[key]) for key in names] for n, cells in rows])
    try:
        parsed = parse_crs(name)
        if parsed.is_geographic:
            raise InputError(f"{name} counts in degrees: name latitude_deg and longitude_deg, or a projected CRS")
        places = geographic_from_crs(table, name)
    except InputError as error:
        raise InputError(f"{path}: line {number}: {error}") from error
    found = [(float(latitude), float(longitude), float(height)) for latitude, longitude, height in places]
    return found, HeightDatum.ELLIPSOID if len(parsed.axis_info) > 2 else datum


def _fix(path: Path, row: _Row, place: _Place, datum: HeightDatum) -> GnssFix:
    number, cells = row
    sigmas = [_sigma(f"{path}: line {number}", name, cells[name]) for name in _SIGMAS if name in cells]
    return GnssFix(
        gps_time_ns=None,
        latitude_deg=place[0],
        longitude_deg=place[1],
        height_m=place[2],
        height_datum=datum,
        sigma_horizontal_m=math.hypot(*sigmas[:2]) / math.sqrt(2.0) if sigmas else None,
        sigma_vertical_m=sigmas[2] if sigmas else None,
        sigma_east_north_m=(sigmas[0], sigmas[1]) if sigmas else None,
        name=cells["image"],
    )


def _sigma(where: str, name: str, word: str) -> float:
    value = _finite(where, name, word)
    if value <= 0:
        raise InputError(f"{where}: {name} must be > 0, is {value:g}")
    return value


def _finite(where: str, what: str, word: str) -> float:
    if re.fullmatch(r"[+-]?\d+,\d*", word):
        raise InputError(f"{where}: {what} is {word!r}: decimal commas are not accepted, write decimal points")
    try:
        number = float(word)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{where}: {what} is {word!r}, not a number")
    return number
