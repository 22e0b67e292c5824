"""Coordinate reference systems as files give them, reduced to what a position on the map needs."""

import pyproj

from uavkit.core.frames import parse_crs


def horizontal_part(crs: pyproj.CRS) -> pyproj.CRS:
    """Return the two-dimensional part of a compound or three-dimensional CRS; any other unchanged."""
    if crs.is_compound:
        return horizontal_part(crs.sub_crs_list[0])
    return crs.to_2d() if len(crs.axis_info) > 2 else crs


def crs_text(crs: pyproj.CRS) -> str:
    """Return an EPSG code where one names exactly this CRS, else its WKT."""
    code = crs.to_epsg(min_confidence=100)
    return f"EPSG:{code}" if code is not None else str(crs.to_wkt())


def horizontal_crs(text: str) -> str:
    """Return the horizontal part of the CRS that a text names; raises InputError where it names none."""
    return crs_text(horizontal_part(parse_crs(text.strip())))
