"""Lines of exposure stations as they are laid out, before they are divided into sorties; and the path along them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags
from uavkit.core.errors import InputError
from uavkit.core.progress import Progress, silent
from uavkit.plan.ground import Ground
from uavkit.plan.imaging import Imaging
from uavkit.plan.kernels import simplified

MOST_SAMPLES = 50000
"""Of the profile of one leg."""
PROFILE_SHARE = 0.8
"""Of the tolerance in height that straight legs may use up; the rest is for what lies between samples."""
EXIT_BASES = 0.4
"""How far beyond the last exposure, in bases, triggering ends: less than one, more than a vehicle's own errors."""


@dataclass(frozen=True, kw_only=True)
class HeightRule:
    """How high to fly."""

    above_ground_m: float
    altitude_m: float | None
    """One ellipsoidal height for all strips; None to follow the ground."""
    tolerance_m: float
    """Of the height above ground where it is followed."""


@dataclass(frozen=True, kw_only=True)
class Mounting:
    """What every line of a set has in common."""

    imaging: Imaging
    ground: Ground
    """In the axes in which the lines are laid: those of the map, or those of a facade."""
    rule: HeightRule
    lead_m: float
    """Straight flight before the first and after the last exposure."""
    stops: bool
    """The vehicle stops at every exposure."""
    progress: Progress = silent


@dataclass(frozen=True, kw_only=True)
class StationLine:
    """A line of exposure stations in the direction of flight, in the axes of its set."""

    area: str
    set_number: int
    row: int
    """Place among the parallel lines of its set."""
    centres_m: Array
    """(n, 3)."""
    rotations: Array
    """(n, 3, 3): axes of the set from image."""
    base_m: float
    path_m: Array
    """(k, 3): from the beginning of the lead-in to the end of the lead-out, every station a vertex."""
    bends: Flags
    """(k,): vertices that the path needs; the others lie on the straight leg between their neighbours."""
    station_vertex: NDArray[np.int64]
    """(n,): which vertex each station is."""
    exit_vertex: int
    """Where triggering ends."""
    back_exit_vertex: int
    """Where it ends if the line is flown the other way."""

    def __len__(self) -> int:
        return len(self.centres_m)

    def part(self, first: int, last: int) -> "StationLine":
        """Return the line with the stations first to last only; where it is cut it gets a lead and an exit."""
        reached = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.path_m, axis=0), axis=1))])
        stations = reached[self.station_vertex]
        beyond = float(reached[self.exit_vertex] - stations[-1])  # 0 where the vehicle stops at every station
        begin = 0.0 if first == 0 else max(0.0, stations[first] - stations[0])
        leaves = float(reached[self.exit_vertex]) if last == len(self) - 1 else float(stations[last]) + beyond
        end = float(reached[-1]) if last == len(self) - 1 else leaves
        every = np.unique(np.concatenate([reached[(reached >= begin) & (reached <= end)], [begin, leaves, end]]))
        path = np.column_stack([np.interp(every, reached, self.path_m[:, axis]) for axis in range(3)])
        bends = np.isin(every, reached[self.bends])
        bends[[0, -1]] = True
        vertices = np.searchsorted(every, stations[first : last + 1])
        bends[vertices[[0, -1]]] = True
        return replace(
            self,
            centres_m=self.centres_m[first : last + 1],
            rotations=self.rotations[first : last + 1],
            path_m=path,
            bends=bends,
            station_vertex=vertices.astype(np.int64),
            exit_vertex=int(np.searchsorted(every, leaves)),
            back_exit_vertex=0,
        )

    def flown_back(self, half_turn: Array) -> "StationLine":
        """Return the line in the other direction; half_turn (3, 3) turns the image with the vehicle, or not."""
        last = len(self.path_m) - 1
        return replace(
            self,
            centres_m=np.ascontiguousarray(self.centres_m[::-1]),
            rotations=np.ascontiguousarray(self.rotations[::-1] @ half_turn),
            path_m=np.ascontiguousarray(self.path_m[::-1]),
            bends=self.bends[::-1],
            station_vertex=last - self.station_vertex[::-1],
            exit_vertex=last - self.back_exit_vertex,
            back_exit_vertex=last - self.exit_vertex,
        )

    def moved(self, axes: Array, origin_m: Array) -> "StationLine":
        """Return the line in other axes: x' = axes (3, 3) x + origin (3,)."""
        return replace(
            self,
            centres_m=np.ascontiguousarray(self.centres_m @ axes.T + origin_m),
            rotations=np.ascontiguousarray(axes @ self.rotations),
            path_m=np.ascontiguousarray(self.path_m @ axes.T + origin_m),
        )


def straight_profile(ground: Ground, rule: HeightRule, start_xy: Array, end_xy: Array) -> tuple[Array, Array]:
    """Return the vertices of a path above a straight line: distance from its start and height, each (k,).

    Straight legs stay within the tolerance of the wanted height above ground. Raises InputError over a void.
    """
    length = float(np.hypot(*(end_xy - start_xy)))
    if rule.altitude_m is not None or ground.is_flat:
        height = rule.altitude_m if rule.altitude_m is not None else ground.limits[0] + rule.above_ground_m
        return np.array([0.0, length]), np.array([height, height])
    count = int(np.clip(np.ceil(length / ground.step_m), 1, MOST_SAMPLES)) + 1
    distance = np.linspace(0.0, length, count)
    xy = start_xy + (distance / max(length, 1e-9))[:, None] * (end_xy - start_xy)
    height = ground.heights_at(xy) + rule.above_ground_m
    if np.any(np.isnan(height)):
        ground.refuse_voids(xy[np.isnan(height)], "the path crosses")
    if length == 0.0:
        return distance[:1], height[:1]
    kept = np.zeros(count, np.bool_)
    kept[[0, -1]] = True
    simplified(distance, height, kept, PROFILE_SHARE * rule.tolerance_m)
    return distance[kept], height[kept]


def straight_line(
    mounting: Mounting,
    *,
    place: tuple[str, int, int],
    start_xy: Array,
    direction: Array,
    along_m: Array,
) -> StationLine:
    """Return a straight line of stations at distances ``along_m`` (n,), ascending, from a start in a direction (2,)."""
    base = float(np.mean(np.diff(along_m))) if len(along_m) > 1 else 0.0
    lead = max(mounting.lead_m, 0.0 if mounting.stops else 0.5 * base)
    begin, end = along_m[0] - lead, along_m[-1] + lead
    distance, height = straight_profile(
        mounting.ground, mounting.rule, start_xy + begin * direction, start_xy + end * direction
    )
    bends = distance + begin
    beyond = 0.0 if mounting.stops else EXIT_BASES * base
    ends = np.array([along_m[0] - beyond, along_m[-1] + beyond])
    every = np.unique(np.concatenate([bends, along_m, ends]))
    heights = np.interp(every, bends, height)
    path = np.column_stack([start_xy + every[:, None] * direction, heights])
    vertices = np.searchsorted(every, along_m)
    needed = np.isin(every, bends)
    needed[vertices[[0, -1]]] = True
    needed[0] = needed[-1] = True
    rotation = mounting.imaging.nadir_rotation(float(np.arctan2(direction[0], direction[1])))
    return StationLine(
        area=place[0],
        set_number=place[1],
        row=place[2],
        centres_m=np.ascontiguousarray(path[vertices]),
        rotations=np.ascontiguousarray(np.broadcast_to(rotation, (len(along_m), 3, 3))),
        base_m=base,
        path_m=path,
        bends=needed,
        station_vertex=vertices.astype(np.int64),
        exit_vertex=int(np.searchsorted(every, ends[1])),
        back_exit_vertex=int(np.searchsorted(every, ends[0])),
    )


def refuse_too_many(stations: float, what: str) -> None:
    """Raise an InputError where a layout would have more stations than a plan can sensibly have."""
    if stations > 300000:
        raise InputError(
            f"{what} would take {stations:.3g} images: fly higher, ask for less overlap, or divide the area"
        )
