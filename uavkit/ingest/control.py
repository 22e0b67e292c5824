"""Control and check points for a block: marks found among the stills, positions found near the block."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError, did_you_mean
from uavkit.core.frames import LocalFrame, parse_crs
from uavkit.core.heights import HeightDatum
from uavkit.core.points import CheckPoint, ControlPoint, SurveyedPoint
from uavkit.core.records import StillInfo
from uavkit.formats.control_file import FileMark, FilePoint, SurveyedPoints, to_local

FARTHEST_CONTROL_M = 2000.0
"""From the nearest station; beyond, the CRS is wrong."""

P = TypeVar("P", bound=SurveyedPoint)


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkedPoints:
    """Surveyed points whose marks are all in stills of the block."""

    surveyed: SurveyedPoints
    notes: tuple[str, ...]


def match_marks(surveyed: SurveyedPoints, infos: Sequence[StillInfo], unreadable: Sequence[str]) -> MarkedPoints:
    """Give each mark the name of its still as the block has it; marks of unknown images are named and dropped.

    Names that differ in case or lack their ending are matched, with a note. Raises InputError where no image of the
    file is known, and for marks outside their image.
    """
    sizes = {info.name: (info.width_px, info.height_px) for info in infos}
    lost = {name.casefold() for name in unreadable}
    notes: list[str] = []
    points, matched, total = [], 0, 0
    for point in surveyed.points:
        marks = []
        for mark in point.marks:
            total += 1
            name = _still_named(mark.image, sizes, f"{surveyed.source}: line {mark.line}", notes)
            if name is None:
                why = "cannot be read" if mark.image.casefold() in lost else "is none of the stills"
                hint = "" if mark.image.casefold() in lost else did_you_mean(mark.image, sizes)
                notes.append(f"{surveyed.source}: line {mark.line}: image {mark.image!r} {why}{hint}; mark left out")
                continue
            _check_inside(surveyed.source, point, mark, sizes[name])
            matched += 1
            marks.append(replace(mark, image=name))
        points.append(replace(point, marks=tuple(marks)))
    if total and not matched:
        example = next(mark for point in surveyed.points for mark in point.marks)
        raise InputError(
            f"{surveyed.source}: none of its {total} marks lies in a still of this block; line {example.line} names "
            f"{example.image!r}{did_you_mean(example.image, sizes)}. Is it the file of this flight?"
        )
    if surveyed.vertical is HeightDatum.UNKNOWN and len(parse_crs(surveyed.crs).axis_info) < 3:
        notes.append(f"{surveyed.source}: says not what its heights count from: taken as ellipsoidal")
    bare = [point.name for point in points if not point.marks]
    if bare:
        notes.append(f"{surveyed.source}: without any mark in the stills and not used: {', '.join(bare)}")
    kept = tuple(point for point in points if point.marks)
    return MarkedPoints(surveyed=replace(surveyed, points=kept), notes=tuple(notes))


def _still_named(image: str, sizes: dict[str, tuple[int, int]], where: str, notes: list[str]) -> str | None:
    if image in sizes:
        return image
    for key in (str.casefold, lambda name: name.rsplit(".", 1)[0].casefold()):
        near = [name for name in sizes if key(name) == key(image)]
        if len(near) == 1:
            note = f"{where}: image {image!r} is taken for {near[0]!r}"
            notes.append(note)
            return near[0]
    return None


def _check_inside(source: str, point: FilePoint, mark: FileMark, size: tuple[int, int]) -> None:
    inside = -0.5 <= mark.column_px <= size[0] + 0.5 and -0.5 <= mark.row_px <= size[1] + 0.5
    if not inside:
        raise InputError(
            f"{source}: line {mark.line}: the mark of {point.name!r} at ({mark.column_px:g}, {mark.row_px:g}) lies "
            f"outside of {mark.image} ({size[0]} x {size[1]} px): is it from a picture of another size, or are column "
            "and row swapped?"
        )


def local_points(surveyed: SurveyedPoints, frame: LocalFrame, kind: type[P], stations_m: Array) -> tuple[P, ...]:
    """Return the points in the local frame; raises InputError where they lie far from the stations (n, 3), or from one
    another where there are no stations, telling the distance."""
    points = to_local(surveyed, frame, kind)
    if not points:
        return ()
    place = np.array([point.position_m for point in points])[:, :2]
    reference = stations_m[:, :2] if len(stations_m) else np.median(place, axis=0)[None]
    distance = np.linalg.norm(place[:, None, :] - reference[None, :, :], axis=2).min(axis=1)
    far = distance > FARTHEST_CONTROL_M
    if not far.any():
        return points
    where = "the nearest exposure station" if len(stations_m) else "the other points"
    if 2 * int(far.sum()) > len(points):
        raise InputError(
            f"{surveyed.source}: the points lie {_distance(float(np.median(distance)))} from {where} (median) in "
            f"{surveyed.crs}: is that their CRS, are easting and northing swapped, is it the file of this flight?"
        )
    worst = int(np.argmax(distance))
    raise InputError(
        f"{surveyed.source}: line {surveyed.points[worst].line}: point {points[worst].name!r} lies "
        f"{_distance(float(distance[worst]))} from {where}: correct its coordinates or remove it"
    )


def _distance(metres: float) -> str:
    return f"{metres / 1000:.1f} km" if metres < 100_000 else f"{metres / 1000:.0f} km"


def height_notes(control: Sequence[ControlPoint], check: Sequence[CheckPoint], stations_m: Array) -> tuple[str, ...]:
    """Return a note where stations lie below the surveyed points or very high above: mixed height datums."""
    points = [*control, *check]
    if not points or not len(stations_m):
        return ()
    above = float(np.median(stations_m[:, 2]) - np.median([point.position_m[2] for point in points]))
    if 0.0 < above < 1000.0:
        return ()
    return (
        f"the stations lie {above:.0f} m above the surveyed points by their heights: are ellipsoidal, geoid and "
        "relative heights mixed? Positions and control each have a shift of their own, but check --height-datum",
    )
