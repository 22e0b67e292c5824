"""Local frames, coordinate reference systems and the geoid: the only module of ``core`` that uses pyproj.

All transformations refuse to be approximate: where a grid is missing, pyproj would return the input unchanged and say
nothing; here that is an InputError.
"""

import os
import warnings
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import pyproj
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from uavkit.core.angles import nearest_rotation
from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.heights import HeightDatum

GEOID_GRID = Path(__file__).resolve().parents[1] / "data" / "egm96_15.gtx"
WGS84 = "EPSG:4979"
WORST_TRANSFORMATION_M = 3.0
"""Stated accuracy beyond which a datum transformation is refused; regional realisations of ITRF state 1 to 3 m."""

os.environ["PROJ_NETWORK"] = "OFF"  # read by each context that PROJ makes: no grid is ever fetched


@lru_cache(maxsize=64)
def parse_crs(text: str) -> pyproj.CRS:
    """Return the CRS that an EPSG code, PROJ or WKT text names, or "WGS84 UTM 54N"; raises InputError otherwise."""
    words = text.upper().replace("/", " ").split()
    if len(words) == 3 and words[0] in ("WGS84", "WGS") and words[1] == "UTM":
        return _utm(words[2], text)
    if text.strip().isdigit():
        text = f"EPSG:{text.strip()}"
    try:
        return pyproj.CRS.from_user_input(text)
    except CRSError as error:
        raise InputError(
            f"{text!r} is no coordinate reference system: give an EPSG code like EPSG:32654, PROJ text, or "
            f"'WGS84 UTM 54N'"
        ) from error


def _utm(zone: str, text: str) -> pyproj.CRS:
    number, hemisphere = zone[:-1], zone[-1]
    if not (number.isdigit() and 1 <= int(number) <= 60 and hemisphere in "NS"):
        raise InputError(f"{text!r}: a UTM zone is 1 to 60 followed by N or S, like 54N")
    return pyproj.CRS.from_epsg((32600 if hemisphere == "N" else 32700) + int(number))


def utm_crs(latitude_deg: float, longitude_deg: float) -> str:
    """Return the EPSG code of the WGS 84 / UTM zone of a place."""
    zone = int((longitude_deg + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32600 if latitude_deg >= 0 else 32700) + zone}"


@lru_cache(maxsize=16)
def _transformer(source: str, target: str) -> pyproj.Transformer:
    crs_from, crs_to = parse_crs(source), parse_crs(target)
    try:
        transformer = pyproj.Transformer.from_crs(
            crs_from, crs_to, always_xy=True, allow_ballpark=False, only_best=True
        )
    except ProjError as error:
        raise _inexact(crs_from, crs_to) from error
    if transformer.accuracy < 0 and not _best_is_available(crs_from, crs_to):
        raise _inexact(crs_from, crs_to)
    _refuse_inaccurate(transformer.accuracy, crs_from, crs_to)
    return transformer


def _inexact(crs_from: pyproj.CRS, crs_to: pyproj.CRS, what: str = "no exact transformation") -> InputError:
    return InputError(
        f"{what} from {crs_from.name} to {crs_to.name} is available here (a grid is missing); give the coordinates in "
        f"a system on WGS 84, ITRF or a datum with published parameters"
    )


def _refuse_inaccurate(accuracy_m: float, crs_from: pyproj.CRS, crs_to: pyproj.CRS) -> None:
    if accuracy_m > WORST_TRANSFORMATION_M:
        raise _inexact(crs_from, crs_to, f"only a transformation good to {accuracy_m:g} m")


def _best_is_available(crs_from: pyproj.CRS, crs_to: pyproj.CRS) -> bool:
    """Tell whether, of several transformations among which PROJ chooses point by point, none better lacks its grid."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it says in words what best_available says
        return bool(TransformerGroup(crs_from, crs_to, always_xy=True, allow_ballpark=False).best_available)


def transformed(source: str, target: str, coordinates: Array) -> Array:
    """Transform (n, 3) coordinates, x or longitude first; raises InputError where what PROJ chose is not accurate."""
    transformer = _transformer(source, target)
    x, y, height = coordinates.T
    result = np.column_stack(transformer.transform(x, y, height, errcheck=True))
    if transformer.accuracy < 0 and len(coordinates):
        used = transformer.get_last_used_operation()
        _refuse_inaccurate(used.accuracy, parse_crs(source), parse_crs(target))
    return result


@lru_cache(maxsize=1)
def _geoid_transformer() -> pyproj.Transformer:
    if not GEOID_GRID.is_file():
        raise InputError(f"the geoid grid {GEOID_GRID} is missing: install uavkit again")
    grid = os.fspath(GEOID_GRID)
    return pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=vgridshift +grids={grid} +multiplier=1 "
        f"+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )


def geoid_undulation_m(latitude_deg: Array, longitude_deg: Array) -> Array:
    """Return the height of the EGM96 geoid above the WGS 84 ellipsoid, same shape as the inputs in degrees."""
    latitude, longitude = np.broadcast_arrays(np.asarray(latitude_deg, float), np.asarray(longitude_deg, float))
    _, _, height = _geoid_transformer().transform(longitude, latitude, np.zeros_like(latitude), errcheck=True)
    undulation = np.asarray(height, dtype=np.float64)
    if not np.all(np.isfinite(undulation)):
        raise InputError("the EGM96 geoid grid does not cover all positions")
    return undulation


def ellipsoid_heights_m(latitude_deg: Array, longitude_deg: Array, height_m: Array, datum: HeightDatum) -> Array:
    """Return ellipsoidal heights of heights in a datum; UNKNOWN counts as ellipsoidal, GROUND is refused.

    Raises InputError for heights above ground: they are relative to an unknown surface.
    """
    if datum is HeightDatum.GROUND:
        raise InputError("heights above ground say nothing of the absolute height: give ellipsoid or geoid heights")
    height = np.asarray(height_m, dtype=np.float64)
    if datum is HeightDatum.GEOID:
        return height + geoid_undulation_m(latitude_deg, longitude_deg)
    return height


@dataclass(frozen=True, kw_only=True)
class LocalFrame:
    """East-north-up in metres at one origin on WGS 84, exact over any distance (no projection, no flat earth)."""

    latitude_deg: float
    longitude_deg: float
    height_ellipsoid_m: float
    crs: str
    """The horizontal CRS of the survey's files: EPSG code or PROJ text; heights beside it are above the ellipsoid of
    WGS 84, whatever the ellipsoid of the CRS, unless the CRS has a height of its own."""

    def __post_init__(self) -> None:
        parse_crs(self.crs)

    @cached_property
    def _enu_from_geographic(self) -> pyproj.Transformer:
        return pyproj.Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 +lat_0={float(self.latitude_deg)!r} "
            f"+lon_0={float(self.longitude_deg)!r} +h_0={float(self.height_ellipsoid_m)!r}"
        )

    def enu_from_geographic(self, latitude_deg: Array, longitude_deg: Array, height_ellipsoid_m: Array) -> Array:
        """Return east, north, up in metres, shape (n, 3), of WGS 84 positions, each (n,)."""
        enu = self._enu_from_geographic.transform(
            np.asarray(longitude_deg, float), np.asarray(latitude_deg, float), np.asarray(height_ellipsoid_m, float)
        )
        return np.column_stack(enu)

    def geographic_from_enu(self, enu_m: Array) -> Array:
        """Return latitude, longitude in degrees and ellipsoidal height in metres, shape (n, 3), of ENU (n, 3)."""
        east, north, up = np.asarray(enu_m, dtype=np.float64).T
        longitude, latitude, height = self._enu_from_geographic.transform(east, north, up, direction="INVERSE")
        return np.column_stack([latitude, longitude, height])

    def enu_from_crs(self, coordinates_m: Array, crs: str | None = None) -> Array:
        """Return ENU (n, 3) of easting, northing (or longitude, latitude) and ellipsoidal height (n, 3) in a CRS.

        Raises InputError where the CRS is unknown or a coordinate lies outside its validity.
        """
        geographic = geographic_from_crs(coordinates_m, crs or self.crs)
        return self.enu_from_geographic(*geographic.T)

    def crs_from_enu(self, enu_m: Array) -> Array:
        """Return easting, northing and ellipsoidal height in the survey's CRS, shape (n, 3), of ENU (n, 3)."""
        geographic = self.geographic_from_enu(enu_m)
        result = transformed(WGS84, _three_dimensional(self.crs), geographic[:, [1, 0, 2]])
        if not _has_height(self.crs):
            result[:, 2] = geographic[:, 2]
        return result

    def R_crs_from_enu(self, enu_m: Array) -> Array:
        """Return the rotation (3, 3) from ENU axes to the axes of the CRS at a point (3,): meridian convergence and
        the curvature of the earth between origin and point; scale is left out."""
        step = 0.5 * np.vstack([np.eye(3), -np.eye(3)])
        ends = self.crs_from_enu(np.asarray(enu_m, float) + step)
        return nearest_rotation((ends[:3] - ends[3:]).T)

    @classmethod
    def at(cls, latitude_deg: float, longitude_deg: float, height_ellipsoid_m: float, crs: str = "") -> "LocalFrame":
        """Return a frame at a place; without a CRS its UTM zone is taken."""
        return cls(
            latitude_deg=latitude_deg,
            longitude_deg=longitude_deg,
            height_ellipsoid_m=height_ellipsoid_m,
            crs=crs or utm_crs(latitude_deg, longitude_deg),
        )


def _has_height(crs: str) -> bool:
    return len(parse_crs(crs).axis_info) >= 3


@lru_cache(maxsize=64)
def _three_dimensional(crs: str) -> str:
    parsed = parse_crs(crs)
    return parsed.to_wkt() if _has_height(crs) else parsed.to_3d().to_wkt()


def geographic_from_crs(coordinates_m: Array, crs: str) -> Array:
    """Return latitude, longitude (degrees) and ellipsoidal height (n, 3) of coordinates (n, 3) in a CRS.

    The heights count from the ellipsoid of WGS 84, also where the CRS is on another ellipsoid (for a CRS with a
    vertical part: from that part's datum). Raises InputError where a coordinate cannot be transformed, naming it.
    """
    given = np.asarray(coordinates_m, dtype=np.float64)
    source = _three_dimensional(crs)
    try:
        result = transformed(source, WGS84, given)
        if not _has_height(crs):
            own_height = given[:, 2] + (given[:, 2] - result[:, 2])
            result = transformed(source, WGS84, np.column_stack([given[:, :2], own_height]))
    except ProjError as error:
        raise InputError(f"coordinates do not fit {crs}: {error}") from error
    bad = ~np.all(np.isfinite(result), axis=1)
    if np.any(bad):
        raise InputError(f"coordinates {given[bad][0]} do not fit {crs}: wrong CRS, or easting and northing swapped")
    return result[:, [1, 0, 2]]


@dataclass(frozen=True, kw_only=True)
class LocalMap:
    """A transverse Mercator map about one place: true to scale there at one height, to 1e-6 within 9 km of it."""

    latitude_deg: float
    longitude_deg: float
    height_ellipsoid_m: float = 0.0
    """Where a metre of the map is a metre."""

    @cached_property
    def crs(self) -> str:
        """The map's CRS as PROJ text; x is east, y is north, metres, the place has (0, 0)."""
        scale = 1.0 + self.height_ellipsoid_m / 6371000.0
        return (
            f"+proj=tmerc +lat_0={float(self.latitude_deg)!r} +lon_0={float(self.longitude_deg)!r} "
            f"+k_0={scale!r} +ellps=WGS84 +units=m +type=crs"
        )

    @cached_property
    def _projection(self) -> pyproj.Proj:
        return pyproj.Proj(self.crs)

    def map_from_geographic(self, latitude_deg: Array, longitude_deg: Array) -> Array:
        """Return x, y in metres, shape (n, 2), of WGS 84 positions, each (n,)."""
        x, y = self._projection(np.asarray(longitude_deg, float), np.asarray(latitude_deg, float), errcheck=True)
        return np.column_stack([x, y])

    def geographic_from_map(self, xy_m: Array) -> Array:
        """Return latitude, longitude in degrees, shape (n, 2), of map positions (n, 2)."""
        longitude, latitude = self._projection(xy_m[:, 0], xy_m[:, 1], inverse=True, errcheck=True)
        return np.column_stack([latitude, longitude])

    def convergence_rad(self, latitude_deg: Array, longitude_deg: Array) -> Array:
        """Return the meridian convergence (n,): the azimuth of the map's north, from true north, clockwise."""
        factors = self._projection.get_factors(np.asarray(longitude_deg, float), np.asarray(latitude_deg, float))
        return np.asarray(np.radians(factors.meridian_convergence))
