"""Patterns of a survey: each shapes the sets of strips that are laid over its areas, and the order of their lines."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.plan.ground import flat_ground
from uavkit.plan.lines import EXIT_BASES, HeightRule, Mounting, StationLine
from uavkit.plan.strips import StripRequest, StripSet, best_heading, lay_strips

SIMPLER = 0.1
"""Of a corridor's width: bends of its line that are less than this are straightened, and the band widened."""
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
NO_TURN = np.eye(3)


@dataclass(frozen=True, kw_only=True)
class LaidSet:
    """The lines of a set with all that is needed to judge them."""

    mounting: Mounting
    lines: tuple[StationLine, ...]
    """In the axes of the mounting's ground, by row and then along it, all in one direction."""
    axes: Array
    """(3, 3): map axes from those of the set."""
    origin_m: Array
    """(3,)."""
    half_turn: Array
    """What flying a line backwards does to the image, (3, 3)."""
    sets_of_flight: int
    """Sets with the same number are flown together, row by row: the legs of a corridor."""
    area: Any = None
    """shapely's, in the axes of the set: where the overlap to both sides counts."""
    target_m: Array | None = None
    """(3,): what all images look at; they are compared on planes across their view through it, not on the ground."""


@dataclass(frozen=True, kw_only=True)
class Region:
    """An area in map coordinates."""

    name: str
    shape: Any
    """shapely's polygon, line or point."""


def polygon_set(
    region: Region, heading_rad: float | None, mounting: Mounting, request: StripRequest, set_number: int
) -> LaidSet:
    """Return strips over a polygon; without a heading the best one is taken."""
    if heading_rad is None:
        imaging, height = mounting.imaging, mounting.rule.above_ground_m
        base = (1.0 - request.forward_overlap) * imaging.length_m(height)
        heading_rad = best_heading(region.shape, base, (1.0 - request.side_overlap) * imaging.width_m(height))
    lines = lay_strips(
        StripSet(
            area=region.name,
            set_number=set_number,
            polygon=region.shape,
            heading_rad=heading_rad,
            mounting=mounting,
            request=request,
        )
    )
    return LaidSet(
        mounting=mounting,
        lines=tuple(lines),
        axes=np.eye(3),
        origin_m=np.zeros(3),
        half_turn=HALF_TURN,
        sets_of_flight=set_number,
        area=region.shape,
    )


def heading_of(laid: LaidSet) -> float:
    """Return the heading (rad) of a laid set's lines."""
    line = max(laid.lines, key=len)
    step = line.path_m[-1] - line.path_m[0]
    return float(np.arctan2(step[0], step[1]))


def corridor_band(line: Any, width_m: float) -> Any:
    """Return the band of a width along a line, in map coordinates."""
    return line.buffer(0.5 * width_m, cap_style="flat", join_style="mitre", mitre_limit=2.0)


def corridor_sets(
    region: Region, width_m: float, mounting: Mounting, request: StripRequest, first_number: int
) -> list[LaidSet]:
    """Return a set for each leg of a line: its strips lie over a rectangle that also covers the bends at its ends."""
    tolerance = SIMPLER * width_m
    vertices = np.array(region.shape.simplify(tolerance).coords)
    half = 0.5 * width_m + (tolerance if len(vertices) < len(region.shape.coords) else 0.0)
    steps = np.diff(vertices, axis=0)
    headings = np.arctan2(steps[:, 0], steps[:, 1])
    result = []
    for number, (begin, end) in enumerate(pairwise(vertices)):
        ahead = (end - begin) / np.hypot(*(end - begin))
        before = _bend_length(headings, number - 1, half)
        after = _bend_length(headings, number, half)
        leg = Region(name=region.name, shape=_rectangle(begin - before * ahead, end + after * ahead, half))
        laid = polygon_set(leg, float(headings[number]), mounting, request, first_number + number)
        result.append(replace(laid, sets_of_flight=first_number))
    return result


def _bend_length(headings: Array, at: int, half_m: float) -> float:
    """Return how much longer a leg must be for the outer side of the bend between two legs."""
    if not 0 <= at < len(headings) - 1:
        return 0.0
    turn = abs(float(np.angle(np.exp(1j * (headings[at + 1] - headings[at])))))
    return half_m * float(np.tan(min(0.5 * turn, np.radians(60.0))))


def _rectangle(begin: Array, end: Array, half_m: float) -> Any:
    from shapely import LineString

    return LineString([begin, end]).buffer(half_m, cap_style="flat")


@dataclass(frozen=True, kw_only=True)
class Face:
    """A facade above a line."""

    height_m: float
    base_m: float
    flown_on_right: bool
    least_above_ground_m: float
    """Height above ground below which no station may lie."""


def facade_sets(
    region: Region, face: Face, mounting: Mounting, request: StripRequest, first_number: int
) -> list[LaidSet]:
    """Return a set of vertical strips for each side of a line, or of a polygon's outline.

    The axes of such a set are: x along the facade to the right, y up, z out of it towards the camera.
    """
    ground = mounting.ground
    vertices = _outline(region.shape)
    if not face.flown_on_right:
        vertices = vertices[::-1]
    result = []
    for number, (begin, end) in enumerate(pairwise(vertices)):
        length = float(np.hypot(*(end - begin)))
        along = np.array([*(end - begin) / length, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        axes = np.column_stack([along, up, np.cross(along, up)])
        feet = ground.heights_at(begin + np.linspace(0.0, 1.0, 21)[:, None] * (end - begin))
        outside = ground.heights_at(
            begin + np.linspace(0.0, 1.0, 21)[:, None] * (end - begin) + mounting.rule.above_ground_m * axes[:2, 2]
        )
        origin = np.array([*begin, float(np.min(feet)) + face.base_m])
        lead = (
            0.0
            if mounting.stops
            else 0.5 * (1.0 - request.forward_overlap) * mounting.imaging.length_m(mounting.rule.above_ground_m)
        )
        lowest = float(np.max(outside)) + face.least_above_ground_m - origin[2] + lead
        result.append(
            _facade_set(
                Region(name=region.name, shape=(length, face.height_m)),
                (axes, origin),
                mounting,
                replace(request, least_along_m=lowest),
                first_number + number,
            )
        )
    return result


def _facade_set(
    face: Region, placed: tuple[Array, Array], mounting: Mounting, request: StripRequest, number: int
) -> LaidSet:
    from shapely import box

    length, height = face.shape
    if request.least_along_m > height:
        raise InputError(
            f"{face.name}: the whole facade of {height:g} m is lower than the vehicle may fly here "
            f"({request.least_along_m:.1f} m above its foot): lower least_clearance_m, or survey it from the ground"
        )
    plane = flat_ground(mounting.ground.local_map, 0.0)
    rule = HeightRule(above_ground_m=mounting.rule.above_ground_m, altitude_m=None, tolerance_m=0.0)
    upright = replace(mounting, ground=plane, rule=rule, lead_m=0.0)
    shape = box(0.0, 0.0, length, height)
    laid = polygon_set(Region(name=face.name, shape=shape), 0.0, upright, request, number)
    return replace(laid, axes=placed[0], origin_m=placed[1], half_turn=NO_TURN)


def _outline(shape: Any) -> Array:
    from shapely.geometry.polygon import orient

    if shape.geom_type == "Polygon":
        return np.array(orient(shape, 1.0).exterior.coords)  # counter-clockwise: outside is on the right
    return np.array(shape.coords)


@dataclass(frozen=True, kw_only=True)
class Circles:
    """Circles about an object."""

    radius_m: float
    object_height_m: float
    rings: int
    ring_height_m: float


def orbit_set(region: Region, circles: Circles, mounting: Mounting, request: StripRequest, number: int) -> LaidSet:
    """Return circles about a point; every image looks at half the height of the object in the middle."""
    ground = mounting.ground
    x, y = region.shape.centroid.coords[0]
    foot = float(ground.heights_at(np.array([[x, y]]))[0])
    if np.isnan(foot):
        ground.refuse_voids(np.array([[x, y]]), "the middle of the orbit lies on")
    target = np.array([x, y, foot + 0.5 * circles.object_height_m])
    lines = []
    for ring in range(circles.rings):
        height = foot + mounting.rule.above_ground_m + ring * circles.ring_height_m
        lines.append(_ring(region.name, number, ring, (target, height, circles.radius_m), mounting, request))
    return LaidSet(
        mounting=mounting,
        lines=tuple(lines),
        axes=np.eye(3),
        origin_m=np.zeros(3),
        half_turn=NO_TURN,
        sets_of_flight=number,
        target_m=target,
    )


def _ring(
    name: str, number: int, row: int, where: tuple[Array, float, float], mounting: Mounting, request: StripRequest
) -> StationLine:
    target, height, radius = where
    slant = float(np.hypot(radius, height - target[2]))
    base = (1.0 - request.forward_overlap) * mounting.imaging.width_m(slant)
    count = max(4, int(np.ceil(2.0 * np.pi * radius / base)))
    angles = 2.0 * np.pi * np.arange(count) / count
    centres = np.column_stack(
        [target[0] + radius * np.sin(angles), target[1] + radius * np.cos(angles), np.full(count, height)]
    )
    back = (centres - target) / np.linalg.norm(centres - target, axis=1)[:, None]
    right = np.cross(np.array([0.0, 0.0, 1.0]), back)
    right /= np.linalg.norm(right, axis=1)[:, None]
    upright = np.stack([right, np.cross(back, right), back], axis=-1)
    beyond = 0.0 if mounting.stops else EXIT_BASES  # on towards where the circle closes
    ends = (centres[0] + beyond * (centres[-1] - centres[0]), centres[-1] + beyond * (centres[0] - centres[-1]))
    path = centres if mounting.stops else np.concatenate([ends[0][None], centres, ends[1][None]])
    first = 0 if mounting.stops else 1
    return StationLine(
        area=name,
        set_number=number,
        row=row,
        centres_m=np.ascontiguousarray(centres),
        rotations=np.ascontiguousarray(upright),
        base_m=2.0 * np.pi * radius / count,
        path_m=path,
        bends=np.ones(len(path), np.bool_),
        station_vertex=np.arange(first, first + count, dtype=np.int64),
        exit_vertex=len(path) - 1,
        back_exit_vertex=0,
    )


def flown_order(sets: Sequence[LaidSet], begin_xy: Array) -> list[tuple[int, StationLine]]:
    """Return (index of the set, line as flown) in the order of flight: to and fro, each set from its nearest corner."""
    result: list[tuple[int, StationLine]] = []
    here = begin_xy
    numbers = list(dict.fromkeys(laid.sets_of_flight for laid in sets))
    for number in numbers:
        members = [index for index, laid in enumerate(sets) if laid.sets_of_flight == number]
        legs = _to_and_fro(sets, members, here) if len(members) > 1 else _serpentine(sets[members[0]], members[0], here)
        result += legs
        index, last = result[-1]
        here = (last.path_m[-1] @ sets[index].axes.T + sets[index].origin_m)[:2]
    return result


def _ends(laid: LaidSet, lines: Sequence[StationLine]) -> tuple[Array, Array]:
    """Return the beginning of the first and the end of the last of some lines, on the map."""
    ends = np.array([lines[0].path_m[0], lines[-1].path_m[-1]]) @ laid.axes.T + laid.origin_m
    return ends[0][:2], ends[1][:2]


def _serpentine(laid: LaidSet, index: int, here: Array) -> list[tuple[int, StationLine]]:
    """Return the lines of a set to and fro, from whichever of its four corners is nearest."""
    rows = [[line for line in laid.lines if line.row == row] for row in sorted({line.row for line in laid.lines})]
    best: tuple[float, list[StationLine]] | None = None
    for ordered in (rows, rows[::-1]):
        for first_back in (False, True):
            lines: list[StationLine] = []
            for number, row in enumerate(ordered):
                back = (number % 2 == 1) != first_back
                lines += [line.flown_back(laid.half_turn) for line in row[::-1]] if back else row
            far = float(np.hypot(*(_ends(laid, lines)[0] - here)))
            if best is None or far < best[0] - 1e-6:
                best = far, lines
    assert best is not None
    return [(index, line) for line in best[1]]


def _to_and_fro(sets: Sequence[LaidSet], members: list[int], here: Array) -> list[tuple[int, StationLine]]:
    """Return the lines of several legs row by row: along all legs, and back along all of them."""
    first, last = sets[members[0]], sets[members[-1]]
    starts = np.hypot(*(_ends(first, first.lines)[0] - here)), np.hypot(*(_ends(last, last.lines[-1:])[1] - here))
    from_end = bool(starts[1] < starts[0])
    result: list[tuple[int, StationLine]] = []
    most = max(line.row for member in members for line in sets[member].lines) + 1
    for row in range(most):
        back = (row % 2 == 1) != from_end
        for member in members[::-1] if back else members:
            lines = [line for line in sets[member].lines if line.row == row]
            half_turn = sets[member].half_turn
            ordered = [line.flown_back(half_turn) for line in lines[::-1]] if back else lines
            result += [(member, line) for line in ordered]
    return result
