"""Parallel strips over a polygon, each at the distance from the one before and with the base that the ground asks for.

In the axes of a set of strips u runs along them and v across, to the right.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.plan.lines import Mounting, StationLine, refuse_too_many, straight_line
from uavkit.plan.overlap import Neighbours, forward_overlaps, points_on_ground, side_overlaps

ROUNDS = 12
"""Of bringing stations or strips closer until the overlap holds."""
SPARE = 0.005
"""Overlap asked for beyond the request: what the nodes of an image may miss."""
FIRMLY = 0.985
"""A distance that is too long is shortened by this at least."""

LONGER = 1.04
"""A row is first tried with the base, and the distance to the next, of the row before, lengthened by this."""

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class StripRequest:
    """What strips must give."""

    forward_overlap: float
    side_overlap: float
    least_images: int
    keep_overlap: bool
    """Measure the overlap on the ground, and bring stations closer where it is too small."""
    extra_stations: int = 0
    """At both ends of each strip, beyond what the flat ground asks for."""
    inset_share: float = 0.0
    """How much nearer to the rim than on flat ground the outermost strips lie, in distances of strips."""
    least_along_m: float = -np.inf
    """No station lies before this place along the strips: the foot of a facade, where a vehicle cannot fly."""


@dataclass(frozen=True, kw_only=True)
class StripSet:
    """What a set of strips covers, and its axes."""

    area: str
    set_number: int
    polygon: Any
    """shapely's, in the axes of the mounting's ground."""
    heading_rad: float
    """Of the strips, from the y axis (north), clockwise."""
    mounting: Mounting
    request: StripRequest

    @property
    def along(self) -> Array:
        """Return the direction of u, (2,)."""
        return np.array([np.sin(self.heading_rad), np.cos(self.heading_rad)])

    @property
    def across(self) -> Array:
        """Return the direction of v, (2,)."""
        return np.array([np.cos(self.heading_rad), -np.sin(self.heading_rad)])


def lay_strips(strips: StripSet) -> list[StationLine]:
    """Return the lines of a set, by v and then by u, all in the direction of u.

    Raises InputError where the requested overlap cannot be had on this ground.
    """
    layout = _Layout(strips)
    rows = layout.rows()
    return layout.lines(rows)


class _Layout:
    """Lays one set; keeps its polygon turned to u, v."""

    def __init__(self, strips: StripSet) -> None:
        from shapely import affinity

        self.strips = strips
        imaging, height = strips.mounting.imaging, strips.mounting.rule.above_ground_m
        ask = strips.request
        self.length_m, self.width_m = imaging.length_m(height), imaging.width_m(height)
        self.base_m = (1.0 - ask.forward_overlap) * self.length_m
        self.distance_m = (1.0 - ask.side_overlap) * self.width_m
        (ux, uy), (vx, vy) = strips.along, strips.across
        self.polygon = affinity.affine_transform(strips.polygon, [ux, uy, vx, vy, 0.0, 0.0])
        self.bounds = self.polygon.bounds
        across = self.bounds[3] - self.bounds[1]
        refuse_too_many(self.polygon.area / (self.base_m * self.distance_m) + across / self.distance_m, strips.area)
        self.last_base_m, self.last_distance_m = self.base_m, np.inf
        self.base_of_row: dict[float, float] = {}

    def map_xy(self, u: float, v: float) -> Array:
        return u * self.strips.along + v * self.strips.across

    # which rows

    def inset_m(self) -> float:
        """Return how far inside the rim of the area the outermost strips lie (negative: outside)."""
        along = max(1, int(self.length_m / self.base_m))
        needed = int(np.ceil(self.strips.request.least_images / along))
        inset = 0.47 * self.width_m - (needed - 1) * self.distance_m
        inset = float(np.clip(inset, -self.distance_m, 0.5 * self.distance_m))
        return inset - self.strips.request.inset_share * self.distance_m

    def rows(self) -> list[float]:
        """Return v of each row: evenly spread on flat ground, closer where the overlap on the ground asks for it."""
        low, high, inset = self.bounds[1], self.bounds[3], self.inset_m()
        span = (high - low) - 2.0 * inset
        if span <= 0.02 * self.distance_m:
            return [0.5 * (low + high)]
        even = span / np.ceil(span / self.distance_m - 1e-9)
        rows = [low + inset]
        while rows[-1] < high - inset - 0.02 * self.distance_m:
            rows.append(rows[-1] + self._distance_after(rows[-1], even))
            done = min(rows[-1] - low, high - inset - low) / max(high - inset - low, 1e-9)
            self.strips.mounting.progress(f"lay strips over {self.strips.area}", int(100.0 * done), 100)
            refuse_too_many(len(rows) * (self.bounds[2] - self.bounds[0]) / self.base_m / 20.0, self.strips.area)
        return rows

    def _distance_after(self, row: float, wanted_m: float) -> float:
        """Return the greatest distance to the next row, not above the wanted one, that gives the side overlap."""
        ask = self.strips.request
        if not ask.keep_overlap:
            return wanted_m
        distance = min(wanted_m, LONGER * self.last_distance_m)
        for _ in range(ROUNDS):
            there = row + distance
            union = self._merged([*self.own(row, distance), *self.own(there, distance)])
            if not union:
                return distance
            share = self._least_side(self._probe(row, union), self._probe(there, union))
            self.last_distance_m = distance
            if np.isnan(share) or share >= ask.side_overlap + SPARE or self._exact(share, ask.side_overlap):
                return distance
            factor = (1.0 - ask.side_overlap - SPARE) / max(1.0 - share, 1e-3)
            distance *= float(np.clip(factor, 0.3, FIRMLY))
        raise self._impossible("side", ask.side_overlap, row)

    def _impossible(self, which: str, share: float, row: float) -> InputError:
        middle = self.map_xy(0.5 * (self.bounds[0] + self.bounds[2]), row)
        latitude, longitude = self.strips.mounting.ground.local_map.geographic_from_map(middle[None])[0]
        return InputError(
            f"{self.strips.area}: a {which} overlap of {share:.0%} cannot be had on the ground of the strip at "
            f"latitude {latitude:.6f}, longitude {longitude:.6f}: fly higher, follow the ground, or turn the strips "
            f"along the slope"
        )

    def _probe(self, row: float, intervals: list[Interval]) -> list[tuple[StationLine, Array]]:
        """Return lines of a row with stations and their ground points, for the comparison with another row."""
        return [self._line(row, interval) for interval in intervals]

    def _least_side(self, here: list[tuple[StationLine, Array]], there: list[tuple[StationLine, Array]]) -> float:
        least = np.nan
        for ours, theirs in ((here, there), (there, here)):
            beside = Neighbours.of(self.strips.along, [line for line, _ in theirs])
            for line, points in ours:
                if len(line) > 2:  # the ends of a probe are not compared: what is beyond them is not laid yet
                    shares = side_overlaps(self.strips.mounting.imaging, points[1:-1], beside)
                    least = np.fmin(least, np.min(shares))
        return float(least)

    # which part of a row

    def own(self, row: float, distance_m: float, before_m: float | None = None) -> list[Interval]:
        """Return where along a row there must be stations for the ground that is nearer to it than to other rows."""
        from shapely import box

        low = row - 0.5 * (distance_m if before_m is None else before_m)
        band = self.polygon.intersection(box(self.bounds[0] - 1.0, low, self.bounds[2] + 1.0, row + 0.5 * distance_m))
        parts = [part.bounds for part in getattr(band, "geoms", [band]) if not part.is_empty]
        extra = self._extra_m()
        return self._merged([(part[0] - extra, part[2] + extra) for part in parts])

    def _extra_m(self) -> float:
        """Return how far beyond the area's rim stations are needed for as many images there as were asked for."""
        ask = self.strips.request
        ahead = int(0.5 * self.length_m / self.base_m + 1e-9)
        wanted = min(max(0, ask.least_images - ahead - 1), ahead) + ask.extra_stations
        return wanted * self.base_m

    def _merged(self, intervals: list[Interval]) -> list[Interval]:
        """Return intervals united where the gap between two is not worth leaving out."""
        merged: list[Interval] = []
        for begin, end in sorted(intervals):
            if merged and begin - merged[-1][1] <= self.length_m + 2.0 * self.base_m:
                merged[-1] = (merged[-1][0], max(merged[-1][1], end))
            else:
                merged.append((begin, end))
        return merged

    # the lines

    def lines(self, rows: list[float]) -> list[StationLine]:
        """Return the lines of all rows, each as long as its own ground and that of the rows beside it."""
        gaps = [b - a for a, b in pairwise(rows)]
        outer = 2.0 * max(self.distance_m, abs(self.inset_m()) * 1.1)
        own = [
            self.own(row, gap_after, gap_before)
            for row, gap_before, gap_after in zip(rows, [outer, *gaps], [*gaps, outer], strict=True)
        ]
        result: list[StationLine] = []
        for number, row in enumerate(rows):
            around = [interval for other in own[max(0, number - 1) : number + 2] for interval in other]
            for interval in self._merged(around):
                line, _ = self._line(row, interval)
                result.append(replace(line, row=number))
        return result

    def _line(self, row: float, interval: Interval) -> tuple[StationLine, Array]:
        """Return a line over an interval of u, its base short enough for the forward overlap, and its ground points.

        Where the vehicle stops for every image the base changes along the line, else the shortest one serves it all.
        """
        ask = self.strips.request
        longest = min(self.base_m, self.base_of_row.get(row, LONGER * self.last_base_m))
        along = self._evenly(interval, longest)
        for turn in range(ROUNDS):
            line = self._stations(row, along)
            points = self._points(line)
            if not ask.keep_overlap or len(line) < 2:
                return line, points
            shares = self._forward(line, points)
            least = float(np.min(shares))
            self.last_base_m = self.base_of_row[row] = longest
            if least >= ask.forward_overlap + 0.5 * SPARE or self._exact(least, ask.forward_overlap):
                return line, points
            factors = (1.0 - ask.forward_overlap - SPARE) / np.maximum(1.0 - shares, 1e-3)
            if self.strips.mounting.stops:
                # in the end nothing may grow again, or shares would go to and fro
                along = self._closer(along, factors if turn < 3 else np.minimum(factors, 1.0))
            else:
                longest = line.base_m * float(np.clip(factors.min(), 0.3, FIRMLY))
                along = self._evenly(interval, longest)
        raise self._impossible("forward", ask.forward_overlap, row)

    def _points(self, line: StationLine) -> Array:
        imaging = self.strips.mounting.imaging
        return points_on_ground(imaging, self.strips.mounting.ground, line, imaging.probe_directions)

    def _forward(self, line: StationLine, points: Array) -> Array:
        """Return the lesser share (n - 1,) that two neighbours show of one another, whichever is flown first."""
        imaging = self.strips.mounting.imaging
        ahead = forward_overlaps(imaging, line, points)[:-1]
        back = replace(
            line,
            centres_m=np.ascontiguousarray(line.centres_m[::-1]),
            rotations=np.ascontiguousarray(line.rotations[::-1]),
        )
        behind = forward_overlaps(imaging, back, np.ascontiguousarray(points[::-1]))[:-1][::-1]
        return np.asarray(np.fmin(ahead, behind))

    def _closer(self, along: Array, factors: Array) -> Array:
        """Return stations along a line whose distances are those before times factors (n - 1,), as far as needed."""
        allowed = np.minimum(
            np.diff(along) * np.clip(np.where(factors < 1.0, factors * FIRMLY, factors), 0.3, None), self.base_m
        )
        passed = np.concatenate([[0.0], np.cumsum(np.diff(along) / allowed)])
        count = int(np.ceil(passed[-1] - 1e-9)) + 1
        refuse_too_many(count, self.strips.area)
        return np.interp(np.linspace(0.0, passed[-1], count), passed, along)

    def _exact(self, share: float, wanted: float) -> bool:
        """Tell whether an overlap is the requested one but for rounding: on flat ground it is exact."""
        return self.strips.mounting.ground.is_flat and share >= wanted - 1e-3

    def _evenly(self, interval: Interval, base_m: float) -> Array:
        """Return stations at even distances, not above a base, from one end of an interval to the other."""
        first = max(interval[0], self.strips.request.least_along_m)
        length = max(interval[1] - first, 0.0)
        count = max(1, int(np.ceil(length / base_m - 1e-9))) + 1
        refuse_too_many(count, self.strips.area)
        return np.linspace(first, first + length, count)

    def _stations(self, row: float, along: Array) -> StationLine:
        return straight_line(
            self.strips.mounting,
            place=(self.strips.area, self.strips.set_number, 0),
            start_xy=self.map_xy(0.0, row),
            direction=self.strips.along,
            along_m=along,
        )


def best_heading(polygon: Any, base_m: float, distance_m: float) -> float:
    """Return the heading (rad) whose strips over a polygon are shortest, a turn counting as two distances of strips.

    Tried are the directions of the sides of the convex hull and every five degrees.
    """
    from shapely import affinity, box

    hull = np.array(polygon.convex_hull.exterior.coords)
    sides = np.diff(hull, axis=0)
    headings = np.unique(
        np.round(
            np.mod(
                np.concatenate([np.arctan2(sides[:, 0], sides[:, 1]), np.radians(np.arange(0.0, 180.0, 5.0))]), np.pi
            ),
            9,
        )
    )
    costs = []
    for heading in headings:
        s, c = np.sin(heading), np.cos(heading)
        turned = affinity.affine_transform(polygon, [s, c, c, -s, 0.0, 0.0])
        u0, v0, u1, v1 = turned.bounds
        count = max(1, int(np.ceil((v1 - v0) / distance_m)))
        step, cost = (v1 - v0) / count, 0.0
        shown = min(count, 60)
        for k in range(shown):  # of many strips a sample tells
            v = v0 + (v1 - v0) * (k + 0.5) / shown
            cut = turned.intersection(box(u0 - 1.0, v - 0.5 * step, u1 + 1.0, v + 0.5 * step))
            parts = [part.bounds for part in getattr(cut, "geoms", [cut]) if not part.is_empty]
            cost += sum(part[2] - part[0] for part in parts) + base_m + 2.0 * distance_m
        costs.append(cost * count / shown)
    return float(headings[int(np.argmin(costs))])
