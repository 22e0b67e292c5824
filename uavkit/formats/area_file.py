"""Areas to survey from KML, KMZ, GeoJSON, Shapefile and WKT, recognised by their content, checked before use.

KML and GeoJSON give longitude, latitude on WGS 84 by their standards (GeoJSON: RFC 7946). A shapefile says its CRS in
the ``.prj`` beside it; WKT says it as ``SRID=...;`` before the geometry, x (longitude, easting) first; without such a
word the coordinates must be plausible degrees. Heights are dropped. Each part of a Multi geometry is an own area.
"""

import codecs
import io
import json
import re
import struct
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.flightplan import AreaKind, SurveyArea
from uavkit.core.frames import geographic_from_crs
from uavkit.formats.area_checks import Outline, checked_areas
from uavkit.formats.crs_text import horizontal_crs
from uavkit.formats.kml_document import LARGEST_BYTES, child_text, coordinate_tuples, local_name, read_kml
from uavkit.formats.plan_request import InlineArea

_SHAPEFILE_MAGIC = b"\x00\x00\x27\x0a"
_WKT_NAMES = r"POINT|LINESTRING|LINEARRING|POLYGON|MULTIPOINT|MULTILINESTRING|MULTIPOLYGON|GEOMETRYCOLLECTION"
_DEEPEST_WKT = 12
"""Brackets within brackets: more is no area, and would exhaust the parser's stack."""
_NAMES = ("name", "title", "label")
_WGS84_NAMES = ("CRS84", "4326", "WGS84", "WGS 84")


def read_areas(path: Path) -> tuple[SurveyArea, ...]:
    """Return the areas of a KML, KMZ, GeoJSON, SHP or WKT file in their order, with their names (else "area 1", ...).

    Raises InputError saying which area is wrong, what, where (latitude, longitude) and what to do.
    """
    content = _bytes(path)
    outlines = list(_reader(path, content)(path, content))
    if not outlines:
        raise InputError(f"{path}: there is no polygon, line or point in it: draw the area and export it again")
    return checked_areas(outlines, str(path))


def inline_areas(request_areas: Sequence[InlineArea]) -> tuple[SurveyArea, ...]:
    """Return the areas that are written into a request, checked as those of a file are."""
    outlines = [
        Outline(
            name=area.name,
            kind=AreaKind(area.kind),
            vertices_deg=np.array(area.latitude_longitude_deg, dtype=np.float64).reshape(-1, 2),
            holes_deg=tuple(np.array(hole, dtype=np.float64).reshape(-1, 2) for hole in area.holes_deg),
        )
        for area in request_areas
    ]
    return checked_areas(outlines, "the request")


def _bytes(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        if size > LARGEST_BYTES:
            raise InputError(f"{path}: a file of {size} bytes is no area: give the outline alone")
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    if not content.strip(b" \t\r\n\x00"):
        raise InputError(f"{path}: the file is empty: export the area again")
    return content


_Reader = Callable[[Path, bytes], Iterable[Outline]]


def _reader(path: Path, content: bytes) -> _Reader:
    """Return the reader for what the file holds, whatever its name."""
    if content.startswith(_SHAPEFILE_MAGIC):
        return _of_shapefile
    if content.startswith(b"PK") or zipfile.is_zipfile(io.BytesIO(content)):
        return _of_kml
    start = content[:200].replace(b"\x00", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \t\r\n")
    if start.startswith(b"<"):
        return _of_kml
    if start.startswith((b"{", b"[")):
        return _of_geojson
    if re.match(rb"\s*(#|SRID\s*=|" + _WKT_NAMES.encode() + rb")", start, re.IGNORECASE):
        return _of_wkt
    beside = path.with_suffix(".shp")
    if path.suffix.lower() in (".dbf", ".shx", ".prj") and beside.is_file():
        raise InputError(f"{path}: this is a companion of a shapefile: give {beside.name}")
    raise InputError(f"{path}: neither KML, KMZ, GeoJSON, shapefile (.shp) nor WKT: export the area as one of these")


def _text(path: Path, content: bytes) -> str:
    try:
        utf16 = content.startswith((b"\xff\xfe", b"\xfe\xff"))
        return content.decode("utf-16" if utf16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: the text is not UTF-8 ({error.reason}): save it as UTF-8") from error


def _vertices(tuples: Sequence[Sequence[Any]], where: str) -> Array:
    """Return (n, 2) latitude, longitude of longitude, latitude[, height]; raises InputError naming the vertex."""
    places = []
    for number, numbers in enumerate(tuples, start=1):
        try:
            if not 2 <= len(numbers) <= 4 or any(isinstance(value, bool) for value in numbers):
                raise ValueError
            longitude, latitude = (float(value) for value in numbers[:2])
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                f"{where}, vertex {number}: {_short(numbers)} is not longitude, latitude in decimal degrees"
            ) from None
        places.append((latitude, longitude))
    return np.array(places, dtype=np.float64).reshape(-1, 2)


def _short(value: object) -> str:
    text = ",".join(map(str, value)) if isinstance(value, list) else str(value)
    return repr(text if len(text) <= 60 else text[:57] + "...")


# KML


def _of_kml(path: Path, content: bytes) -> Iterator[Outline]:
    if content.startswith(b"PK"):
        _refuse_zipped_shapefile(path, content)
    marks = [element for element in read_kml(path).iter() if local_name(element) == "Placemark"]
    for number, mark in enumerate(marks, start=1):
        name = child_text(mark, "name")
        yield from _kml_geometries(mark, name, f"{path}: placemark {number}" + (f" ({name!r})" if name else ""))


def _refuse_zipped_shapefile(path: Path, content: bytes) -> None:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            names = [name.lower() for name in archive.namelist()]
    except (zipfile.BadZipFile, NotImplementedError, ValueError, UnicodeDecodeError, EOFError) as error:
        raise InputError(f"{path}: the KMZ is damaged ({error}): export it again") from error
    if any(name.endswith(".shp") for name in names) and not any(name.endswith(".kml") for name in names):
        raise InputError(f"{path}: this is a packed shapefile: unpack it and give the .shp")


def _kml_geometries(parent: ElementTree.Element, name: str, where: str) -> Iterator[Outline]:
    """Yield the geometries below an element, however deep in MultiGeometries."""
    pending = list(parent)[::-1]
    while pending:
        element = pending.pop()
        tag = local_name(element)
        if tag == "MultiGeometry":
            pending.extend(list(element)[::-1])
        elif tag == "Polygon":
            yield _kml_polygon(element, name, where)
        elif tag == "LinearRing":
            yield Outline(name=name, kind=AreaKind.POLYGON, vertices_deg=_kml_vertices(element, where))
        elif tag in ("LineString", "Point"):
            kind = AreaKind.LINE if tag == "LineString" else AreaKind.POINT
            yield Outline(name=name, kind=kind, vertices_deg=_kml_vertices(element, where))


def _kml_vertices(element: ElementTree.Element, where: str) -> Array:
    return _vertices(coordinate_tuples(child_text(element, "coordinates")), where)


def _kml_polygon(element: ElementTree.Element, name: str, where: str) -> Outline:
    rings = {"outerBoundaryIs": [], "innerBoundaryIs": []}  # type: dict[str, list[Array]]
    for boundary in element:
        for ring in (child for child in boundary if local_name(child) == "LinearRing"):
            rings.setdefault(local_name(boundary), []).append(_kml_vertices(ring, where))
    outer = rings["outerBoundaryIs"]
    if len(outer) != 1:
        raise InputError(f"{where}: a polygon has one outer boundary, here are {len(outer)}: draw it again")
    return Outline(name=name, kind=AreaKind.POLYGON, vertices_deg=outer[0], holes_deg=tuple(rings["innerBoundaryIs"]))


# GeoJSON


def _of_geojson(path: Path, content: bytes) -> Iterator[Outline]:
    try:
        document = json.loads(_text(path, content))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: no valid GeoJSON ({error}): export it again") from error
    if not isinstance(document, dict):
        raise InputError(f"{path}: GeoJSON is an object with a type, this is a list: export it again")
    _check_geojson_crs(path, document)
    features = document.get("features") if document.get("type") == "FeatureCollection" else [document]
    if not isinstance(features, list):
        raise InputError(f"{path}: the FeatureCollection has no list of features: export it again")
    for number, feature in enumerate(features, start=1):
        where = f"{path}: feature {number}"
        if not isinstance(feature, dict):
            raise InputError(f"{where}: {_short(feature)} is no feature: export it again")
        _check_geojson_crs(path, feature)
        name, geometry = _geojson_feature(feature)
        yield from _geojson_geometries(geometry, name, where + (f" ({name!r})" if name else ""))


def _check_geojson_crs(path: Path, member: dict[str, Any]) -> None:
    """Refuse a ``crs`` member (of the GeoJSON before RFC 7946) that is not WGS 84."""
    crs = member.get("crs")
    if crs is None:
        return
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(name, str) or re.split(r"[:/#]", name)[-1].strip().upper() not in _WGS84_NAMES:
        raise InputError(
            f"{path}: GeoJSON is longitude, latitude on WGS 84 (RFC 7946), this one is in {_short(name or crs)}: "
            f"transform it, for instance with ogr2ogr -t_srs EPSG:4326"
        )


def _geojson_feature(feature: dict[str, Any]) -> tuple[str, Any]:
    """Return name and geometry; a bare geometry is its own."""
    if feature.get("type") != "Feature":
        return "", feature
    properties = feature.get("properties")
    return _name(properties if isinstance(properties, dict) else {}), feature.get("geometry")


def _name(properties: dict[str, Any]) -> str:
    """Return the first of the properties that are names, whatever their case."""
    by_key = {str(key).lower(): value for key, value in properties.items() if isinstance(value, str | int)}
    return next((str(by_key[key]).strip() for key in _NAMES if str(by_key.get(key, "")).strip()), "")


def _geojson_geometries(geometry: Any, name: str, where: str) -> Iterator[Outline]:
    pending = [geometry]
    while pending:
        member = pending.pop()
        if member is None:  # a feature without a place is allowed
            continue
        kind = member.get("type") if isinstance(member, dict) else None
        if kind == "GeometryCollection":
            pending.extend(_list(member.get("geometries"), where)[::-1])
        elif isinstance(kind, str) and kind in _GEOJSON_KINDS:
            parts = _list(member.get("coordinates"), where)
            for part in parts if kind.startswith("Multi") else [parts]:
                yield _geojson_outline(_GEOJSON_KINDS[kind], _list(part, where), name, where)
        else:
            raise InputError(f"{where}: {_short(kind)} is no geometry of GeoJSON: export it as polygons")


_GEOJSON_KINDS = {
    prefix + kind: area_kind
    for prefix in ("", "Multi")
    for kind, area_kind in (("Point", AreaKind.POINT), ("LineString", AreaKind.LINE), ("Polygon", AreaKind.POLYGON))
}


def _list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list):
        raise InputError(f"{where}: {_short(value)} stands where a list of coordinates should: export it again")
    return value


def _geojson_outline(kind: AreaKind, coordinates: list[Any], name: str, where: str) -> Outline:
    if kind is AreaKind.POINT:
        return Outline(name=name, kind=kind, vertices_deg=_vertices([coordinates], where))
    if kind is AreaKind.LINE:
        return Outline(name=name, kind=kind, vertices_deg=_vertices(coordinates, where))
    rings = [_vertices(_list(ring, where), where) for ring in coordinates] or [np.empty((0, 2))]
    return Outline(name=name, kind=kind, vertices_deg=rings[0], holes_deg=tuple(rings[1:]))


# Shapefile

_SHAPEFILE_FAULTS = (struct.error, ValueError, LookupError, TypeError, OverflowError, AssertionError, OSError)
_POINTS, _LINES, _POLYGONS, _MULTIPOINTS = (1, 11, 21), (3, 13, 23), (5, 15, 25), (8, 18, 28)
_NULL_SHAPE = 0


def _of_shapefile(path: Path, content: bytes) -> Iterator[Outline]:
    crs = _shapefile_crs(path)
    for number, (shape_type, name, parts) in enumerate(_shapes(path, content), start=1):
        where = f"{path}: shape {number}" + (f" ({name!r})" if name else "")
        rings = [_degrees(part, crs, where) for part in parts]
        if shape_type in _POLYGONS:
            yield from _shapefile_polygons(rings, name)
        elif shape_type in _LINES:
            yield from (Outline(name=name, kind=AreaKind.LINE, vertices_deg=ring) for ring in rings)
        elif shape_type in _POINTS + _MULTIPOINTS:
            points = np.concatenate([np.empty((0, 2)), *rings])
            yield from (Outline(name=name, kind=AreaKind.POINT, vertices_deg=point[None]) for point in points)
        elif shape_type != _NULL_SHAPE:
            raise InputError(f"{where}: a shape of type {shape_type} is no area: export polygons, lines or points")


def _shapefile_crs(path: Path) -> str:
    """Return the CRS of the ``.prj`` beside the file; empty where there is none."""
    beside = next((p for p in (path.with_suffix(".prj"), path.with_suffix(".PRJ")) if p.is_file()), None)
    if beside is None:
        return ""
    try:
        return horizontal_crs(beside.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise InputError(f"{beside}: cannot be read ({error.strerror or error})") from error
    except (UnicodeDecodeError, InputError) as error:
        raise InputError(f"{beside}: {error}") from error


def _shapes(path: Path, content: bytes) -> list[tuple[int, str, list[Array]]]:
    """Return shape type, name and parts (n, 2) x, y of each shape."""
    import shapefile

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reader = shapefile.Reader(shp=io.BytesIO(content))
            shapes = list(reader.iterShapes())
            names = _shapefile_names(path, len(shapes))
            return [(int(shape.shapeType), name, _parts(shape)) for shape, name in zip(shapes, names, strict=True)]
    except (*_SHAPEFILE_FAULTS, shapefile.ShapefileException) as error:
        raise InputError(f"{path}: the shapefile is damaged ({error}): export it again") from error


def _parts(shape: Any) -> list[Array]:
    points = np.array([point[:2] for point in shape.points], dtype=np.float64).reshape(-1, 2)
    starts = [int(start) for start in getattr(shape, "parts", [])] or [0]
    if starts != sorted(starts) or starts[0] < 0 or starts[-1] > len(points):
        raise ValueError("its parts do not fit its points")
    return np.split(points, starts[1:]) if len(points) else []


def _shapefile_names(path: Path, count: int) -> list[str]:
    """Return the name of each shape out of the table beside the file, empty where there is none."""
    import shapefile

    beside = next((p for p in (path.with_suffix(".dbf"), path.with_suffix(".DBF")) if p.is_file()), None)
    if beside is None:
        return [""] * count
    content = io.BytesIO(beside.read_bytes())
    table = shapefile.Reader(dbf=content, encoding=_encoding(path.with_suffix(".cpg")), encodingErrors="replace")
    names = [_name(record.as_dict()) for record in table.iterRecords()]
    return (names + [""] * count)[:count]


def _encoding(path: Path) -> str:
    """Return the encoding that a ``.cpg`` file names, like UTF-8, ISO-8859-1 or 1252; else UTF-8."""
    name = path.read_bytes()[:40].decode("latin-1").strip() if path.is_file() else ""
    for candidate in (name, f"cp{name.removeprefix('ANSI ')}"):
        with suppress(LookupError, ValueError):
            return codecs.lookup(candidate).name
    return "utf-8"


def _degrees(xy: Array, crs: str, where: str) -> Array:
    """Return latitude, longitude (n, 2) of x, y in a CRS; without one, x, y must be plausible degrees."""
    if crs:
        try:
            return geographic_from_crs(np.column_stack([xy, np.zeros(len(xy))]), crs)[:, :2] if len(xy) else xy
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
    far = np.any(np.isfinite(xy) & (np.abs(xy) > 180.0), axis=1)  # not finite, swapped: told later, in better words
    if np.any(far):
        bad = xy[far][0]
        raise InputError(
            f"{where}: {bad[0]:g}, {bad[1]:g} is no longitude, latitude in degrees, and the file does not say its "
            f"coordinate reference system: put the .prj beside a shapefile, write SRID=32654; (say) before WKT"
        )
    return np.asarray(xy[:, ::-1])


def _shapefile_polygons(rings: list[Array], name: str) -> Iterator[Outline]:
    """Yield the polygons of a shape: its clockwise rings are outlines, each other ring a hole of the one about it."""
    clockwise = [_doubled_area(ring) >= 0.0 for ring in rings]
    outer = [ring for ring, is_outer in zip(rings, clockwise, strict=True) if is_outer]
    inner = [ring for ring, is_outer in zip(rings, clockwise, strict=True) if not is_outer]
    if not outer:  # written with the other sense of rotation
        outer, inner = inner, []
    holes: dict[int, list[Array]] = {number: [] for number in range(len(outer))}
    for hole in inner:
        holes[_ring_about(outer, hole)].append(hole)
    for number, ring in enumerate(outer):
        yield Outline(name=name, kind=AreaKind.POLYGON, vertices_deg=ring, holes_deg=tuple(holes[number]))


def _doubled_area(ring: Array) -> float:
    """Return twice the signed area of latitude, longitude: positive where it runs clockwise on the map."""
    centred = np.nan_to_num(ring - ring[:1])
    y, x = centred.T
    return float(np.sum(y * np.roll(x, -1) - x * np.roll(y, -1)))


def _ring_about(outer: list[Array], hole: Array) -> int:
    """Return the index of the smallest outline that has the hole's first vertex inside, else of the first outline."""
    import shapely

    point = shapely.points(hole[0]) if np.all(np.isfinite(hole[0])) else None
    about = [
        number
        for number, ring in enumerate(outer)
        if point is not None and len(ring) > 3 and np.all(np.isfinite(ring)) and shapely.polygons(ring).covers(point)
    ]
    return min(about, key=lambda number: abs(_doubled_area(outer[number])), default=0)


# WKT


def _of_wkt(path: Path, content: bytes) -> Iterator[Outline]:
    lines = [line for line in _text(path, content).splitlines() if not line.lstrip().startswith("#")]
    for number, (srid, geometry) in enumerate(_wkt_geometries(path, "\n".join(lines)), start=1):
        where = f"{path}: geometry {number}"
        try:
            crs = horizontal_crs(srid) if srid and srid != "4326" else ""
        except InputError as error:
            raise InputError(f"{where}: SRID={srid}: {error}") from error
        yield from _wkt_outlines(_wkt_parsed(geometry, where), crs, where)


def _wkt_geometries(path: Path, text: str) -> Iterator[tuple[str, str]]:
    """Yield SRID (digits or nothing) and WKT of each geometry of the text; they may be parted by blanks, ',' or ';'."""
    start = re.compile(rf"[\s;,]*(?:SRID\s*=\s*(\d+)\s*;\s*)?((?:{_WKT_NAMES})\s*(?:ZM|Z|M)?\s*(?:EMPTY\b|\())", re.I)
    position, rest = 0, re.compile(r"[\s;,]*\Z")
    while not rest.match(text, position):
        match = start.match(text, position)
        end = _closing(text, match.end()) if match and text[match.end() - 1] == "(" else match.end() if match else -1
        if match is None or end < 0:
            raise InputError(
                f"{path}: {_short(text[position : position + 80].strip())} is no WKT, or its brackets do not close"
            )
        yield match[1] or "", text[match.start(2) : end]
        position = end


def _closing(text: str, position: int) -> int:
    """Return the position behind the bracket that closes the one before ``position``; -1 for none, or too deep."""
    depth = 1
    for bracket in re.compile(r"[()]").finditer(text, position):
        depth += 1 if bracket[0] == "(" else -1
        if depth == 0:
            return bracket.end()
        if depth > _DEEPEST_WKT:
            return -1
    return -1


def _wkt_parsed(geometry: str, where: str) -> Any:
    import shapely

    try:
        with np.errstate(all="ignore"):  # numbers out of range become infinite, and are told as that
            return shapely.from_wkt(geometry)
    except shapely.errors.ShapelyError as error:
        raise InputError(f"{where}: no valid WKT ({error}): export it again") from error


def _wkt_outlines(geometry: Any, crs: str, where: str) -> Iterator[Outline]:
    import shapely

    def degrees(ring: Any) -> Array:
        return _degrees(np.asarray(shapely.get_coordinates(ring), dtype=np.float64), crs, where)

    if geometry.geom_type.startswith(("Multi", "GeometryCollection")):
        for part in geometry.geoms:
            yield from _wkt_outlines(part, crs, where)
    elif geometry.geom_type == "Polygon":
        holes = tuple(degrees(ring) for ring in geometry.interiors)
        yield Outline(name="", kind=AreaKind.POLYGON, vertices_deg=degrees(geometry.exterior), holes_deg=holes)
    elif geometry.geom_type == "LinearRing":
        yield Outline(name="", kind=AreaKind.POLYGON, vertices_deg=degrees(geometry))
    else:
        kind = AreaKind.POINT if geometry.geom_type == "Point" else AreaKind.LINE
        yield Outline(name="", kind=kind, vertices_deg=degrees(geometry))
