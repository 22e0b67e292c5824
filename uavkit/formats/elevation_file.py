"""Elevation models from GeoTIFF, SRTM .hgt and ESRI ASC, and back to GeoTIFF: offline, with a stated vertical datum.

Heights become ellipsoidal on reading. A file that does not tell its vertical datum needs it told: a guess would be
wrong by tens of metres. Voids are nan, never 0.
"""

import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError, did_you_mean
from uavkit.core.frames import parse_crs
from uavkit.core.heights import HeightDatum
from uavkit.core.surface import ElevationGrid
from uavkit.formats.atomic import atomic_path
from uavkit.formats.crs_text import crs_text, horizontal_part
from uavkit.formats.elevation_window import GridExtent, Window, add_height_shift, window_around

MOST_NODES = 100_000_000
SRTM_SIGMA_M = 6.0
"""Of an SRTM height: the mission's requirement of 10 m relative error at 90 % is 10 / 1.645 = 6.1 m; the absolute
errors that Rodriguez, Morris and Belz (2006) measured, about 6 to 9 m at 90 % by continent, are 3.6 to 5.5 m. The
required 16 m absolute (9.7 m) is not taken: it is mostly an offset that a flight shares with its take-off point."""
SIGMA_PER_CELL, LEAST_SIGMA_M, GREATEST_SIGMA_M = 0.5, 0.1, 5.0
"""Of the heights of any other file that states none: half of a cell, within these bounds."""
LEAST_HEIGHT_M, GREATEST_HEIGHT_M = -1000.0, 9100.0
"""Heights of ground beyond these are voids whose value the file does not declare, or feet."""
DATUM_TAG, SIGMA_TAG, SOURCE_TAG = "uavkit_height_datum", "uavkit_sigma_m", "uavkit_source"
_TOLD_DATUMS = (HeightDatum.ELLIPSOID.value, HeightDatum.GEOID.value)
_TIFF_MAGICS = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
_HGT_VOID = -32768
_METRES = ("m", "metre", "metres", "meter", "meters")
Around = tuple[float, float, float, float]
"""South, west, north, east in degrees."""


def read_elevation(
    path: Path, height_datum: str = "", sigma_m: float | None = None, around: Around | None = None
) -> ElevationGrid:
    """Return the elevation model of a GeoTIFF, .hgt or ESRI ASC file with ellipsoidal heights.

    ``height_datum`` ("ellipsoid" or "geoid") is needed where the file does not tell, and must not contradict what it
    tells. ``around`` (south, west, north, east in degrees) reads that window alone, two nodes wider, or the part of it
    that the file has. Without ``sigma_m``, a GeoTIFF written by ``write_elevation`` keeps its own, SRTM has
    ``SRTM_SIGMA_M``, any other file half its cell size, at least 0.1 m and at most 5 m: a cell's height stands for all
    of its ground. Raises InputError naming the file, what is wrong, and what to do.
    """
    if height_datum not in ("", *_TOLD_DATUMS):
        hint = did_you_mean(height_datum, _TOLD_DATUMS)
        raise InputError(f"height_datum {height_datum!r} is neither 'ellipsoid' nor 'geoid'{hint}")
    if sigma_m is not None and not (math.isfinite(sigma_m) and sigma_m >= 0.0):
        raise InputError(f"sigma_m of an elevation model is a number of metres, 0 or more, not {sigma_m}")
    start = _first_bytes(path)
    if start.startswith(_TIFF_MAGICS):
        return _from_geotiff(path, height_datum, sigma_m, around)
    if _hgt_corner(path) is not None:
        return _from_hgt(path, height_datum, sigma_m, around)
    if re.match(rb"\s*(ncols|nrows)\s+\d", start, re.IGNORECASE):
        return _from_asc(path, height_datum, sigma_m, around)
    raise InputError(
        f"{path}: neither GeoTIFF nor ESRI ASC, nor an SRTM tile named like N44W072.hgt: convert it, for instance with "
        f"gdal_translate -of GTiff"
    )


def _first_bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            start = file.read(256).removeprefix(b"\xef\xbb\xbf")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    if not start:
        raise InputError(f"{path}: the file is empty: copy it again")
    return start


@dataclass(frozen=True, slots=True, kw_only=True)
class _Datum:
    """How heights become ellipsoidal."""

    crs3d: str = ""
    """Of the heights, where they count from another ellipsoid than that of WGS 84."""
    geoid: bool = False
    note: str = ""

    @property
    def name(self) -> str:
        return _TOLD_DATUMS[self.geoid]


def _finished(
    path: Path, heights: NDArray[np.float32], extent: GridExtent, window: Window, datum: _Datum, sigma_m: float
) -> ElevationGrid:
    """Return the grid of heights that were read; they are changed in place to ellipsoidal ones."""
    crs_from_grid = extent.crs_from_window(window)
    heights[~np.isfinite(heights)] = np.nan
    _check_heights(path, heights, GridExtent(crs=extent.crs, crs_from_grid=crs_from_grid, shape=heights.shape))
    if datum.geoid or datum.crs3d:
        add_height_shift(heights, extent.crs, crs_from_grid, datum.crs3d)
    return ElevationGrid(
        height_ellipsoid_m=heights,
        crs=extent.crs,
        crs_from_grid=crs_from_grid,
        sigma_m=sigma_m,
        source=f"{path.name}: {datum.note or f'{datum.name} heights'}",
    )


def _check_heights(path: Path, heights: NDArray[np.float32], extent: GridExtent) -> None:
    with np.errstate(invalid="ignore"):
        bad = (heights < LEAST_HEIGHT_M) | (heights > GREATEST_HEIGHT_M)
    if not np.any(bad):
        return
    row, column = np.unravel_index(int(np.argmax(bad)), bad.shape)
    raise InputError(
        f"{path}: {heights[row, column]:g} m at {extent.place(float(column), float(row))} is no height of ground: "
        f"declare that value as nodata (gdal_edit -a_nodata), or convert the heights to metres"
    )


def _window(path: Path, extent: GridExtent, around: Around | None) -> Window:
    """Return the window to read; raises InputError where it is outside the file, or too large."""
    if min(extent.shape) < 2:
        raise InputError(
            f"{path}: an elevation model needs 2 x 2 nodes, this has {extent.shape[0]} x {extent.shape[1]}"
        )
    try:
        extent.bounds_deg()  # a CRS without an exact transformation is told here
        window = extent.whole() if around is None else window_around(extent, around)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    nodes = window.rows * window.columns
    if nodes > MOST_NODES:
        raise InputError(
            f"{path}: {window.columns} x {window.rows} nodes ({nodes / 1e6:.0f} million) are more than "
            f"{MOST_NODES // 1_000_000} million: cut the file to the area (gdalwarp -te) or make it coarser (-tr)"
        )
    return window


def _default_sigma_m(extent: GridExtent) -> float:
    return min(max(SIGMA_PER_CELL * extent.cell_m, LEAST_SIGMA_M), GREATEST_SIGMA_M)


# Vertical datum


def _told_datum(path: Path, told: str) -> _Datum:
    if not told:
        raise InputError(
            f"{path}: the file does not say what its heights count from: state height_datum, 'geoid' for heights above "
            f"sea level (most published models), or 'ellipsoid' for GNSS heights ([terrain] height_datum = \"geoid\")"
        )
    return _Datum(geoid=told == HeightDatum.GEOID.value)


def _agreed(path: Path, own: _Datum, told: str) -> _Datum:
    if told and told != own.name:
        raise InputError(
            f"{path}: its heights count from the {own.name} by the file's own word, height_datum says {told!r}: leave "
            f"height_datum out, or correct the file"
        )
    return own


def _datum_of_crs(path: Path, crs: Any, told: str) -> _Datum:
    """Return the vertical datum that the CRS states, else the told one."""
    if crs.is_compound:
        vertical = crs.sub_crs_list[-1]
        _refuse_other_units(path, vertical.axis_info[-1])
        if "EGM96" in vertical.name or vertical.to_epsg() == 5773:
            return _agreed(path, _Datum(geoid=True, note="geoid heights (EGM96)"), told)
        if "EGM2008" in vertical.name or vertical.to_epsg() == 3855:
            return _agreed(path, _Datum(geoid=True, note="EGM2008 heights, taken as geoid heights (EGM96)"), told)
        if not told:
            raise InputError(
                f"{path}: heights in {vertical.name!r} cannot be made ellipsoidal here: state height_datum = 'geoid' "
                f"to take them as EGM96 heights (wrong by up to a metre or two), or convert them to ellipsoidal heights"
            )
        return _Datum(geoid=told == HeightDatum.GEOID.value, note=f"{vertical.name} heights, taken as {told} heights")
    if len(crs.axis_info) > 2:
        _refuse_other_units(path, crs.axis_info[-1])
        return _agreed(path, _Datum(crs3d=crs_text(crs)), told)
    return _told_datum(path, told)


def _refuse_other_units(path: Path, axis: Any) -> None:
    if axis.unit_conversion_factor != 1.0:
        raise InputError(f"{path}: heights in {axis.unit_name}: convert them to metres")


def _horizontal(path: Path, crs: Any) -> str:
    """Return the horizontal CRS; raises InputError where it is no map or has other units than degrees and metres."""
    flat = horizontal_part(crs)
    if not (flat.is_projected or flat.is_geographic):
        raise InputError(f"{path}: {flat.name!r} is no CRS of the earth: assign the right one (gdal_edit -a_srs)")
    axis = flat.axis_info[0]
    if flat.is_projected and axis.unit_conversion_factor != 1.0:
        raise InputError(f"{path}: the grid is in {axis.unit_name}: transform it to metres (gdalwarp -t_srs EPSG:...)")
    if flat.is_geographic and axis.unit_name != "degree":
        raise InputError(
            f"{path}: the grid is in {axis.unit_name}: transform it to degrees (gdalwarp -t_srs EPSG:4326)"
        )
    return crs_text(flat)


# SRTM


def _hgt_corner(path: Path) -> tuple[int, int] | None:
    """Return latitude and longitude of the south-west node, from a name like N44W072.hgt or n44_w072_1arc.hgt."""
    match = re.match(r"([NS])(\d{2})_?([EW])(\d{3})(?!\d)", path.name, re.IGNORECASE)
    if match is None or path.suffix.lower() != ".hgt":
        return None
    latitude, longitude = int(match[2]), int(match[4])
    return -latitude if match[1] in "Ss" else latitude, -longitude if match[3] in "Ww" else longitude


def _from_hgt(path: Path, told: str, sigma_m: float | None, around: Around | None) -> ElevationGrid:
    """Read an SRTM tile: big-endian metres above EGM96, rows from north to south, nodes on the edges of the tile."""
    size = path.stat().st_size
    side = {2 * side * side: side for side in (1201, 3601)}.get(size)
    if side is None:
        raise InputError(f"{path}: {size} bytes are no SRTM tile (1201 x 1201 or 3601 x 3601 heights): copy it again")
    south, west = _hgt_corner(path) or (0, 0)
    step = 1.0 / (side - 1)
    extent = GridExtent(
        crs="EPSG:4326",
        crs_from_grid=np.array([[step, 0.0, float(west)], [0.0, -step, south + 1.0]]),
        shape=(side, side),
    )
    datum = _agreed(path, _Datum(geoid=True, note="SRTM, geoid heights (EGM96)"), told)
    window = _window(path, extent, around)
    tile = np.memmap(path, dtype=">i2", mode="r", shape=(side, side))
    heights = np.array(tile[window.slices], dtype=np.float32)
    heights[heights == _HGT_VOID] = np.nan
    return _finished(path, heights, extent, window, datum, SRTM_SIGMA_M if sigma_m is None else sigma_m)


# ESRI ASC


def _from_asc(path: Path, told: str, sigma_m: float | None, around: Around | None) -> ElevationGrid:
    crs = _asc_crs(path)
    header, start = _asc_header(path)
    extent = _asc_extent(path, header, _horizontal(path, crs))
    datum = _datum_of_crs(path, crs, told)
    window = _window(path, extent, around)
    heights = _asc_heights(path, start, extent, window)
    heights[heights == np.float32(header.get("nodata_value", -9999.0))] = np.nan
    return _finished(path, heights, extent, window, datum, _default_sigma_m(extent) if sigma_m is None else sigma_m)


def _asc_crs(path: Path) -> Any:
    beside = next((p for p in (path.with_suffix(".prj"), path.with_suffix(".PRJ")) if p.is_file()), None)
    if beside is None:
        raise InputError(
            f"{path}: an ESRI ASC does not say its coordinate reference system: write {path.stem}.prj beside it, with "
            f"its WKT or just a code like EPSG:32654"
        )
    try:
        return parse_crs(beside.read_bytes().decode("utf-8-sig").strip())
    except OSError as error:
        raise InputError(f"{beside}: cannot be read ({error.strerror or error})") from error
    except (UnicodeDecodeError, InputError) as error:
        raise InputError(f"{beside}: {error}") from error


_ASC_KEYS = (
    "ncols",
    "nrows",
    "xllcorner",
    "yllcorner",
    "xllcenter",
    "yllcenter",
    "cellsize",
    "dx",
    "dy",
    "nodata_value",
)


def _asc_header(path: Path) -> tuple[dict[str, float], int]:
    """Return the header's numbers by key in lower case, and where the heights begin."""
    header: dict[str, float] = {}
    with path.open("rb") as file:
        while True:
            start = file.tell()
            words = file.readline(4096).removeprefix(b"\xef\xbb\xbf").decode("latin-1").split()
            if not words or not words[0][0].isalpha() or words[0].lower() == "nan":
                return header, start
            key = words[0].lower()
            if key not in _ASC_KEYS:
                raise InputError(f"{path}: {words[0]!r} is no key of an ESRI ASC{did_you_mean(key, _ASC_KEYS)}")
            try:
                header[key] = float(words[1])
            except (IndexError, ValueError):
                raise InputError(f"{path}: {' '.join(words)!r}: {key} needs a number with a decimal point") from None


def _asc_extent(path: Path, header: dict[str, float], crs: str) -> GridExtent:
    """Return where the nodes lie: centres of the cells, rows from north to south."""
    dx, dy = (header.get(key, header.get("cellsize", math.nan)) for key in ("dx", "dy"))
    at_centre = "xllcenter" in header, "yllcenter" in header
    west = header.get("xllcenter", header.get("xllcorner", math.nan)) + (0.0 if at_centre[0] else 0.5 * dx)
    south = header.get("yllcenter", header.get("yllcorner", math.nan)) + (0.0 if at_centre[1] else 0.5 * dy)
    columns, rows = header.get("ncols", math.nan), header.get("nrows", math.nan)
    if not (np.all(np.isfinite([dx, dy, west, south, columns, rows])) and min(dx, dy, columns, rows) > 0.0):
        raise InputError(
            f"{path}: the header needs ncols, nrows, xllcorner or xllcenter, yllcorner or yllcenter, and cellsize, all "
            f"finite, sizes above 0: export it again"
        )
    if columns != int(columns) or rows != int(rows):
        raise InputError(f"{path}: ncols {columns:g} and nrows {rows:g} must be whole numbers: export it again")
    north = south + (rows - 1.0) * dy
    return GridExtent(
        crs=crs, crs_from_grid=np.array([[dx, 0.0, west], [0.0, -dy, north]]), shape=(int(rows), int(columns))
    )


def _asc_heights(path: Path, start: int, extent: GridExtent, window: Window) -> NDArray[np.float32]:
    """Return the window's heights; rows are taken by count of numbers, lines may be broken anywhere."""
    if extent.shape[0] * extent.shape[1] > path.stat().st_size - start:  # a number takes two bytes, the last one one
        raise InputError(
            f"{path}: the file is shorter than {extent.shape[0]} x {extent.shape[1]} heights: copy it again"
        )
    heights = np.empty((window.rows, window.columns), dtype=np.float32)
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("error")
        file.seek(start)
        for row in range(window.row + window.rows):
            line = _asc_row(path, file, row, extent.shape[1])
            if row >= window.row:
                heights[row - window.row] = line[window.column : window.column + window.columns]
    return heights


def _asc_row(path: Path, file: Any, row: int, columns: int) -> NDArray[np.float32]:
    try:
        line = np.fromfile(file, dtype=np.float32, sep=" ", count=columns)
    except (ValueError, DeprecationWarning):
        raise InputError(
            f"{path}: row {row + 1} of the heights holds something that is no number with a decimal point: mend it"
        ) from None
    if len(line) != columns:
        raise InputError(f"{path}: the heights end in row {row + 1}, at {len(line)} of {columns}: copy the file again")
    return line


# GeoTIFF


@contextmanager
def _opened(path: Path, mode: str, **profile: Any) -> Iterator[Any]:
    """Open a GeoTIFF with GDAL, the same whatever the environment says; its errors become InputErrors."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    # heights' datum also from GeoTIFF 1.0; half a pixel is added to the coordinates of points, as the standard says;
    # no .aux.xml is written beside the file
    settings = {"GTIFF_REPORT_COMPD_CS": True, "GTIFF_POINT_GEO_IGNORE": False, "GDAL_PAM_ENABLED": mode == "r"}
    try:
        with warnings.catch_warnings(), rasterio.Env(**settings):
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path, mode, driver="GTiff", **profile) as dataset:
                yield dataset
    except (RasterioError, rasterio.errors.CRSError) as error:
        raise InputError(f"{path}: no GeoTIFF that can be {'read' if mode == 'r' else 'written'} ({error})") from error


def _from_geotiff(path: Path, told: str, sigma_m: float | None, around: Around | None) -> ElevationGrid:
    with _opened(path, "r") as dataset:
        _check_bands(path, dataset)
        crs = _geotiff_crs(path, dataset)
        extent = GridExtent(
            crs=_horizontal(path, crs),
            crs_from_grid=_node_from_corner(path, dataset.transform),
            shape=(int(dataset.height), int(dataset.width)),
        )
        tags = dataset.tags()
        datum = _geotiff_datum(path, tags, crs, told)
        window = _window(path, extent, around)
        heights = _geotiff_heights(dataset, window)
    sigma_m = _tagged_sigma_m(tags) if sigma_m is None else sigma_m
    return _finished(path, heights, extent, window, datum, _default_sigma_m(extent) if sigma_m is None else sigma_m)


def _check_bands(path: Path, dataset: Any) -> None:
    if dataset.count != 1:
        raise InputError(f"{path}: {dataset.count} bands, an elevation model has one: extract it (gdal_translate -b 1)")
    if np.dtype(dataset.dtypes[0]).kind not in "iuf":
        raise InputError(f"{path}: values of type {dataset.dtypes[0]} are no heights: export it again")
    unit = (dataset.units[0] or "").strip()
    if unit and unit.lower() not in _METRES:
        raise InputError(f"{path}: heights in {unit!r}: convert them to metres")


def _geotiff_crs(path: Path, dataset: Any) -> Any:
    if dataset.crs is None or dataset.transform.is_identity:
        raise InputError(
            f"{path}: the file does not say where it lies: assign its coordinate reference system (gdal_edit -a_srs "
            f"EPSG:...) and its position, or export it as GeoTIFF again"
        )
    try:
        return parse_crs(dataset.crs.to_wkt(version="WKT2_2019"))
    except InputError as error:
        raise InputError(f"{path}: its coordinate reference system is not understood: {error}") from error


def _node_from_corner(path: Path, transform: Any) -> Array:
    """Return the affine of nodes, the centres of pixels, of GDAL's, which starts at the corner of the first pixel."""
    affine = np.array([[transform.a, transform.b, transform.c], [transform.d, transform.e, transform.f]])
    if not np.all(np.isfinite(affine)) or np.linalg.det(affine[:, :2]) == 0.0:
        raise InputError(f"{path}: its pixels have no area, by the position that the file states: export it again")
    affine[:, 2] += affine[:, :2] @ [0.5, 0.5]
    return affine


def _geotiff_datum(path: Path, tags: dict[str, str], crs: Any, told: str) -> _Datum:
    own = tags.get(DATUM_TAG, "")
    if own not in _TOLD_DATUMS:
        return _datum_of_crs(path, crs, told)
    return _agreed(path, _Datum(geoid=own == HeightDatum.GEOID.value, note=tags.get(SOURCE_TAG, "")), told)


def _tagged_sigma_m(tags: dict[str, str]) -> float | None:
    try:
        sigma_m = float(tags.get(SIGMA_TAG, "nan"))
    except ValueError:
        return None
    return sigma_m if math.isfinite(sigma_m) and sigma_m >= 0.0 else None


def _geotiff_heights(dataset: Any, window: Window) -> NDArray[np.float32]:
    """Return the window's heights in metres; what the file declares as nodata, or masks, is nan."""
    from rasterio.windows import Window as FileWindow

    part = FileWindow(window.column, window.row, window.columns, window.rows)
    masked = dataset.read(1, window=part, masked=True)
    heights = np.asarray(masked.data, dtype=np.float32)
    scale, offset = float(dataset.scales[0]), float(dataset.offsets[0])
    if (scale, offset) != (1.0, 0.0):
        heights = np.asarray(heights * scale + offset, dtype=np.float32)
    heights[np.ma.getmaskarray(masked)] = np.nan
    return heights


def write_elevation(path: Path, grid: ElevationGrid) -> None:
    """Write a GeoTIFF (float32, deflated, voids nan) that ``read_elevation`` understands without a word."""
    from rasterio.crs import CRS
    from rasterio.transform import Affine

    corner = grid.crs_from_grid.copy()
    corner[:, 2] -= corner[:, :2] @ [0.5, 0.5]
    rows, columns = grid.height_ellipsoid_m.shape
    profile = {"width": columns, "height": rows, "count": 1, "dtype": "float32", "compress": "deflate", "predictor": 3}
    profile |= {"tiled": True, "nodata": math.nan, "transform": Affine(*corner.ravel().tolist())}
    with atomic_path(path) as temporary:
        crs = CRS.from_wkt(parse_crs(grid.crs).to_wkt())
        with _opened(temporary, "w", crs=crs, **profile) as dataset:
            dataset.write(grid.height_ellipsoid_m, 1)
            dataset.units = ("m",)
            tags = {
                DATUM_TAG: HeightDatum.ELLIPSOID.value,
                SIGMA_TAG: repr(float(grid.sigma_m)),
                SOURCE_TAG: grid.source,
            }
            dataset.update_tags(**tags)
