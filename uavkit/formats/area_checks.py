"""What an area must be before a flight is laid over it: a place on earth, an outline that does not cross itself, holes
that lie inside and apart."""

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.flightplan import AreaKind, SurveyArea

HIGHEST_LATITUDE_DEG = 85.0
"""Beyond, meridians converge too fast for headings and strips to mean what they say."""
LEAST_WIDTH_M = 0.001
"""A polygon that is narrower, on average, has no area."""
_DEGREE_M = 111320.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Outline:
    """An area as a file gives it, not yet checked."""

    name: str
    kind: AreaKind
    vertices_deg: Array
    """(n, 2) latitude, longitude."""
    holes_deg: tuple[Array, ...] = ()


def checked_areas(outlines: list[Outline], source: str) -> tuple[SurveyArea, ...]:
    """Return the areas of a source, each with a name of its own; raises InputError naming source, area and place."""
    areas: list[SurveyArea] = []
    taken: dict[str, int] = {}
    for number, outline in enumerate(outlines, start=1):
        given = " ".join(outline.name.split())
        where = f"{source}: area {number}" + (f" ({given!r})" if given else "")
        areas.append(_checked_area(outline, _own_name(given or f"area {number}", taken), where))
    return tuple(areas)


def _own_name(name: str, taken: dict[str, int]) -> str:
    """Return the name, with a number behind it where another area has it; ``taken`` counts the areas of each name."""
    own = name
    while own in taken:
        taken[name] += 1
        own = f"{name} ({taken[name]})"
    taken[own] = 1
    return own


def _checked_area(outline: Outline, name: str, where: str) -> SurveyArea:
    if outline.kind is AreaKind.POLYGON:
        vertices = _checked_ring(outline.vertices_deg, f"{where}: the outline")
        holes = tuple(
            _checked_ring(hole, f"{where}: hole {number}") for number, hole in enumerate(outline.holes_deg, start=1)
        )
        _check_polygon(vertices, holes, where)
        return SurveyArea(name=name, kind=outline.kind, latitude_longitude_deg=vertices, holes_deg=holes)
    if outline.holes_deg:
        raise InputError(f"{where}: a {outline.kind.value} has no holes: remove them, or make it a polygon")
    vertices = _without_repeats(_checked_places(outline.vertices_deg, where))
    if outline.kind is AreaKind.LINE and len(vertices) < 2:
        raise InputError(f"{where}: a line needs 2 different vertices{_at(vertices)}: draw it again")
    if outline.kind is AreaKind.POINT and len(outline.vertices_deg) != 1:
        raise InputError(f"{where}: a point has one position, here are {len(outline.vertices_deg)}")
    return SurveyArea(name=name, kind=outline.kind, latitude_longitude_deg=vertices)


def _at(vertices: Array) -> str:
    return f", at {place(*vertices[0])} there is only one" if len(vertices) else ", it has none"


def place(latitude_deg: float, longitude_deg: float) -> str:
    """Return a place in words, to 0.1 m."""
    return f"latitude {latitude_deg:.6f}, longitude {longitude_deg:.6f}"


def _checked_places(vertices_deg: Array, where: str) -> Array:
    """Return the vertices if all are places where flights can be planned, on one side of the antimeridian."""
    for number, (latitude, longitude) in enumerate(vertices_deg.tolist(), start=1):
        _check_place(latitude, longitude, f"{where}, vertex {number}")
    if len(vertices_deg) and np.ptp(vertices_deg[:, 1]) > 180.0:
        raise InputError(
            f"{where} reaches from longitude {vertices_deg[:, 1].min():.6f} to {vertices_deg[:, 1].max():.6f}: an area "
            f"across the antimeridian is not supported; divide it at longitude 180"
        )
    return vertices_deg


def _check_place(latitude: float, longitude: float, where: str) -> None:
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        raise InputError(f"{where}: latitude {latitude}, longitude {longitude} is not finite: draw it again")
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        raise InputError(
            f"{where}: {place(latitude, longitude)} is no place on earth: {_range_hint(latitude, longitude)}"
        )
    if abs(latitude) > HIGHEST_LATITUDE_DEG:
        raise InputError(
            f"{where}: {place(latitude, longitude)} is too near to the pole: areas are planned up to "
            f"{HIGHEST_LATITUDE_DEG:g} degrees of latitude"
        )


def _range_hint(latitude: float, longitude: float) -> str:
    if abs(latitude) > 90.0 and abs(latitude) <= 180.0 and abs(longitude) <= 90.0:
        return "latitude and longitude are swapped, exchange them"
    if abs(latitude) <= 90.0 and abs(longitude) <= 360.0:
        return "give longitudes from -180 to 180, and divide an area that crosses the antimeridian"
    return "give decimal degrees, or state the coordinate reference system"


def _without_repeats(vertices_deg: Array) -> Array:
    """Return the vertices without those that equal the one before."""
    if len(vertices_deg) < 2:
        return vertices_deg
    new = np.any(vertices_deg[1:] != vertices_deg[:-1], axis=1)
    return np.asarray(vertices_deg[np.concatenate([[True], new])])


def _checked_ring(vertices_deg: Array, where: str) -> Array:
    """Return an open ring without repeated vertices; raises InputError where it crosses itself or has no area."""
    ring = _without_repeats(_checked_places(vertices_deg, where))
    while len(ring) > 1 and np.array_equal(ring[0], ring[-1]):
        ring = ring[:-1]
    if len(np.unique(ring, axis=0)) < 3:
        raise InputError(
            f"{where} has {len(np.unique(ring, axis=0))} different vertices, a polygon needs 3: draw it again"
        )
    reason, at = _fault(_polygon(ring))
    if _is_flat(ring):
        raise InputError(f"{where} has no area: its vertices lie on a line, near {place(*ring[0])}; draw it again")
    if reason:
        raise InputError(f"{where} crosses or touches itself at {at}: move its vertices there ({reason})")
    return ring


def _is_flat(ring: Array) -> bool:
    """Tell whether the ring's hull is, on average, narrower than a millimetre."""
    metres = (ring - ring[0]) * _DEGREE_M * np.array([1.0, math.cos(math.radians(ring[0, 0]))])
    import shapely

    hull = shapely.convex_hull(shapely.multipoints(metres))
    return bool(hull.area < LEAST_WIDTH_M * 0.5 * hull.length)


def _polygon(ring: Array, holes: tuple[Array, ...] = ()) -> Any:
    """Return a shapely polygon; x is longitude."""
    import shapely

    return shapely.Polygon(ring[:, ::-1], [hole[:, ::-1] for hole in holes])


def _fault(polygon: Any) -> tuple[str, str]:
    """Return what is wrong with a polygon, in the words of GEOS, and the place; empty where it is valid."""
    import shapely

    if shapely.is_valid(polygon):
        return "", ""
    reason = str(shapely.is_valid_reason(polygon))
    match = re.fullmatch(r"(.*)\[(\S+) (\S+?)\]", reason)
    return (match[1], place(float(match[3]), float(match[2]))) if match else (reason, "an unknown place")


def _check_polygon(outline: Array, holes: tuple[Array, ...], where: str) -> None:
    """Refuse holes that leave the outline, overlap one another, or cut the area into pieces."""
    if not holes:
        return
    import shapely

    outside, inner = _polygon(outline), [_polygon(hole) for hole in holes]
    for number, hole in enumerate(inner, start=1):
        if not outside.covers(hole):
            spot = shapely.difference(hole, outside).representative_point()
            raise InputError(
                f"{where}: hole {number} lies outside the outline at {place(spot.y, spot.x)}: move or remove it"
            )
    _check_apart(inner, where)
    reason, at = _fault(_polygon(outline, holes))
    if reason:
        raise InputError(f"{where}: the holes and the outline touch at {at}: move them apart ({reason})")


def _check_apart(holes: list[Any], where: str) -> None:
    import shapely

    first, second = shapely.STRtree(holes).query(holes, predicate="intersects")
    for one, two in zip(first.tolist(), second.tolist(), strict=True):
        common = shapely.intersection(holes[one], holes[two]) if one < two else None
        if common is not None and common.area > 0.0:
            spot = common.representative_point()
            raise InputError(
                f"{where}: holes {one + 1} and {two + 1} overlap at {place(spot.y, spot.x)}: join them or move one"
            )
