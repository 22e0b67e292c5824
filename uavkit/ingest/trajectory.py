"""Where the antenna was at any moment of a flight: fixes of a receiver, interpolated, with honest sigmas.

Between two fixes a cubic takes positions and velocities of both ends (Hermite's interpolation). If the vehicle's true
acceleration departs from the cubic's by no more than D, the error at the share s of an interval h is at most
D h^2 s^2 (1 - s)^2, a sixteenth of D h^2 in the middle (from the error's vanishing with its derivative at both ends).
D is taken from how acceleration changes over the neighbouring intervals. Where velocities are differences of positions
they are themselves uncertain by D h / 4, which adds D h^2 s (1 - s) / 4.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.errors import InputError
from uavkit.core.flight_log import FixTable, FixType
from uavkit.core.frames import LocalFrame, geoid_undulation_m
from uavkit.core.gpstime import NO_TIME
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix

UNKNOWN_ACCELERATION_M_S2 = 10.0
"""Where nothing tells how the vehicle accelerates: its own weight, more than a survey asks for."""
MOST_WITHOUT_HEIGHT = 0.1
"""A datum of height is taken if no more than this share of the fixes lacks it; those are left out."""
DISBELIEVED = 0.5
"""Velocities that differ from the way flown by this share of it, in the median, are none of this flight."""
JUDGED_S = 5.0
"""Time over which velocities are compared with the way flown, so that the fixes' noise does not count."""
BOUND_SHARE = 1.0 / 3.0
"""Of the bound of the interpolation that counts as its sigma: errors hardly ever pass the bound."""
MOST_OFF_UNDULATION_M = 10.0
"""Receivers' geoids are coarse: within this of EGM96, their undulation is believed."""
MOST_HEIGHT_M = 100_000.0
"""Heights beyond are damage."""
MOST_SPEED_M_S = 1000.0
"""Velocities beyond are damage."""
ABOVE_NOISE = 6.0
"""Ways are judged that are longer than so many times the misfit of single intervals: noise of positions is none of
velocities."""
LEAST_SPEED_M_S = 0.5
"""Slower than this, velocities are not judged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryOptions:
    """Where a trajectory ends."""

    most_intervals: float = 3.5
    """A gap longer than so many usual intervals between fixes is not bridged."""
    most_beyond: float = 1.0
    """So many usual intervals before the first and after the last fix of a stretch are still told."""

    def __post_init__(self) -> None:
        if not (self.most_intervals >= 1.0 and 0.0 <= self.most_beyond <= 1.0):
            raise ValueError("most_intervals must be >= 1, most_beyond 0 to 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class Positions:
    """Positions at k moments; NaN where unknown, with the reason."""

    gps_ns: Indices
    """(k,)."""
    frame: LocalFrame
    """Its heights count in ``height_datum``, not necessarily from the ellipsoid."""
    height_datum: HeightDatum
    """Of all heights; UNKNOWN where there are none."""
    position_m: Array
    """(k, 3) in ``frame``."""
    velocity_m_s: Array
    """(k, 3) east, north, up: those of the fixes, between two of them linearly interpolated."""
    sigma_horizontal_m: Array
    """(k,) for each axis: the receiver's, and a third of the bound; NaN where the receiver states none."""
    sigma_vertical_m: Array
    """(k,)."""
    interpolation_m: Array
    """(k, 2) bound of the error of interpolation, horizontal and vertical."""
    reasons: tuple[str, ...]
    """(k,) why a position is unknown; empty where it is known."""

    @property
    def known(self) -> Flags:
        """Return which positions are known, (k,)."""
        return np.array([not reason for reason in self.reasons], dtype=np.bool_)

    def geographic(self) -> Array:
        """Return latitude, longitude in degrees and height in ``height_datum``, (k, 3)."""
        result = np.full((len(self.gps_ns), 3), np.nan)
        known = self.known
        if known.any():
            result[known] = self.frame.geographic_from_enu(self.position_m[known])
        if self.height_datum is HeightDatum.UNKNOWN:
            result[:, 2] = np.nan
        return result

    def fixes(self) -> tuple[GnssFix | None, ...]:
        """Return the positions as records, None where unknown."""
        place = self.geographic()
        return tuple(self._fix(row, place[row]) if good else None for row, good in enumerate(self.known))

    def _fix(self, row: int, place: Array) -> GnssFix:
        horizontal, vertical = float(self.sigma_horizontal_m[row]), float(self.sigma_vertical_m[row])
        return GnssFix(
            gps_time_ns=int(self.gps_ns[row]),
            latitude_deg=float(place[0]),
            longitude_deg=float(place[1]),
            height_m=float(place[2]),
            height_datum=self.height_datum,
            sigma_horizontal_m=horizontal if np.isfinite(horizontal) else None,
            sigma_vertical_m=vertical if np.isfinite(vertical) else None,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """Fixes of one receiver in the order of time, ready to be interpolated; made by ``build_trajectory``."""

    frame: LocalFrame
    height_datum: HeightDatum
    gps_ns: Indices
    """(n,) strictly rising."""
    position_m: Array
    """(n, 3)."""
    velocity_m_s: Array
    """(n, 3) NaN where a single fix tells none."""
    sigma_m: Array
    """(n, 2) horizontal and vertical, as the receiver states them; NaN where it does not."""
    joined: Flags
    """(n - 1,) whether the vehicle's way from a fix to the next is known: no gap, no time without a fix."""
    difference: Flags
    """(n, 2) whether velocities, horizontal and vertical, are differences of positions."""
    change_m_s2: Array
    """(n - 1, 2) D of the interpolation, horizontal and vertical."""
    acceleration_m_s2: Array
    """(n, 2) largest about a fix, for extrapolation."""
    lost_ns: Indices
    """(b,) ascending: moments at which the receiver had no fix."""
    interval_s: float
    """The usual one."""
    options: TrajectoryOptions
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.gps_ns)

    @property
    def gaps(self) -> tuple[tuple[int, int], ...]:
        """Return the GPS times between which nothing is known, of fixes before and after."""
        rows = np.flatnonzero(~self.joined)
        return tuple((int(self.gps_ns[row]), int(self.gps_ns[row + 1])) for row in rows)

    def at(self, gps_ns: Indices) -> Positions:
        """Return the positions of the antenna at GPS times (k,), integer ns, in any order."""
        wanted = np.asarray(gps_ns, dtype=np.int64)
        row, reasons = np.searchsorted(self.gps_ns, wanted, side="right") - 1, [""] * len(wanted)
        inside = (row >= 0) & (row < len(self) - 1)
        inside[inside] = self.joined[row[inside]]
        position, velocity = np.full((len(wanted), 3), np.nan), np.full((len(wanted), 3), np.nan)
        sigma, bound = np.full((len(wanted), 2), np.nan), np.full((len(wanted), 2), np.nan)
        if inside.any():
            found = self._interpolated(row[inside], wanted[inside])
            position[inside], velocity[inside], sigma[inside], bound[inside] = found
        for k in np.flatnonzero(~inside).tolist():
            fix, reasons[k] = self._nearest(int(wanted[k]), int(row[k]))
            if not reasons[k]:
                position[k], velocity[k], sigma[k], bound[k] = self._beyond(fix, int(wanted[k]))
        total = np.hypot(sigma, BOUND_SHARE * bound)
        return Positions(
            gps_ns=wanted,
            frame=self.frame,
            height_datum=self.height_datum,
            position_m=position,
            velocity_m_s=velocity,
            sigma_horizontal_m=total[:, 0],
            sigma_vertical_m=total[:, 1],
            interpolation_m=bound,
            reasons=tuple(reasons),
        )

    def _interpolated(self, row: Indices, wanted: Indices) -> tuple[Array, Array, Array, Array]:
        """Return positions, velocities (k, 3), sigmas and bounds (k, 2) between fixes row and row + 1, (k,)."""
        h = ((self.gps_ns[row + 1] - self.gps_ns[row]) * 1e-9)[:, None]
        s = (wanted - self.gps_ns[row])[:, None] * 1e-9 / h
        p, q, v, w = (table[index] for table in (self.position_m, self.velocity_m_s) for index in (row, row + 1))
        bend, way = s * s * (3.0 - 2.0 * s), q - p
        position = p + bend * way + h * (s * (1.0 - s) ** 2 * v - s * s * (1.0 - s) * w)
        # The cubic's own slope holds the noise of both positions, 1.5 times their difference over h: too much for most.
        velocity = (1.0 - s) * v + s * w
        by_difference = 0.25 * s * (1.0 - s) * (self.difference[row] | self.difference[row + 1])
        bound = self.change_m_s2[row] * h * h * (s * s * (1.0 - s) ** 2 + by_difference)
        sigma = (1.0 - s) * self.sigma_m[row] + s * self.sigma_m[row + 1]
        return position, velocity, sigma, bound

    def _nearest(self, wanted: int, row: int) -> tuple[int, str]:
        """Return the fix from which a moment not between joined fixes is told, or the reason why it is not."""
        reach_s = self.options.most_beyond * self.interval_s
        candidates = []
        for fix in (row, row + 1):
            if 0 <= fix < len(self) and np.isfinite(self.velocity_m_s[fix]).all():
                apart = abs(wanted - int(self.gps_ns[fix]))
                if apart * 1e-9 <= reach_s * (1.0 + 1e-9) and not self._lost_between(wanted, int(self.gps_ns[fix])):
                    candidates.append((apart, fix))
        if candidates:
            return min(candidates)[1], ""
        return -1, self._why(wanted, row)

    def _lost_between(self, one: int, other: int) -> bool:
        first, last = min(one, other), max(one, other)
        return bool(np.searchsorted(self.lost_ns, last, side="right") > np.searchsorted(self.lost_ns, first))

    def _why(self, wanted: int, row: int) -> str:
        if wanted == NO_TIME:
            return "its GPS time is not known"
        if row < 0:
            return f"{(int(self.gps_ns[0]) - wanted) * 1e-9:.1f} s before the receiver's first fix"
        before = (wanted - int(self.gps_ns[row])) * 1e-9
        if row == len(self) - 1:
            return f"{before:.1f} s after the receiver's last fix"
        pause = (int(self.gps_ns[row + 1]) - int(self.gps_ns[row])) * 1e-9
        what = "no fix" if self._lost_between(int(self.gps_ns[row]), int(self.gps_ns[row + 1])) else "no position"
        return f"the receiver had {what} for {pause:.1f} s about it"

    def _beyond(self, fix: int, wanted: int) -> tuple[Array, Array, Array, Array]:
        """Return position, velocity (3,), sigma and bound (2,) at a moment shortly before or after a fix."""
        since_s, velocity = (wanted - int(self.gps_ns[fix])) * 1e-9, self.velocity_m_s[fix]
        accelerated = 0.5 * self.acceleration_m_s2[fix] * since_s**2
        # A velocity by differences is that of the stretch's last interval, uncertain by as much again.
        bound = accelerated + self.difference[fix] * self.acceleration_m_s2[fix] * self.interval_s * abs(since_s) / 2.0
        return self.position_m[fix] + since_s * velocity, velocity, self.sigma_m[fix], bound


def build_trajectory(table: FixTable, options: TrajectoryOptions = TrajectoryOptions()) -> Trajectory:
    """Return the trajectory of the first receiver that has fixes, or of an autopilot's own estimate.

    Heights are ellipsoidal where the receiver tells them (and they are: a note says where they cannot be), else above
    the geoid, else above the take-off point. Two fixes of one moment count once. Raises InputError for less than two
    fixes with GPS time.
    """
    rows, notes = _rows_of_receiver(table)
    good = rows[_usable(table, rows)]
    lost_ns = _lost_times(table, rows, good)
    datum, height_m = _heights(table, good, notes)
    finite = np.isfinite(height_m)
    good, height_m = good[finite], height_m[finite]
    order = np.argsort(table.when.gps_ns[good], kind="stable")
    good, height_m = good[order], height_m[order]
    first = np.concatenate([[True], np.diff(table.when.gps_ns[good]) > 0]) if len(good) else np.zeros(0, np.bool_)
    if not first.all():
        notes.append(f"{int(np.sum(~first))} fixes of a moment that had one already are left out")
    good, height_m = good[first], height_m[first]
    if len(good) < 2:
        raise InputError(f"{len(good)} positions with a fix and GPS time: a trajectory needs two at least")
    middle, place = len(good) // 2, (table.latitude_deg[good], table.longitude_deg[good])
    frame = LocalFrame.at(float(place[0][middle]), float(place[1][middle]), float(height_m[middle]))
    position_m = frame.enu_from_geographic(*place, height_m)
    sigma_m = np.column_stack([table.sigma_horizontal_m[good], table.sigma_vertical_m[good]])
    sigma_m[~((sigma_m > 0.0) & np.isfinite(sigma_m))] = np.nan
    return _trajectory(
        (frame, datum, options),
        (table.when.gps_ns[good], lost_ns),
        (position_m, _within(table.velocity_m_s[good], MOST_SPEED_M_S), sigma_m),
        notes,
    )


def _trajectory(
    kind: tuple[LocalFrame, HeightDatum, TrajectoryOptions],
    times: tuple[Indices, Indices],
    columns: tuple[Array, Array, Array],
    notes: list[str],
) -> Trajectory:
    """Put a trajectory together from sorted fixes: positions, velocities (n, 3) and sigmas (n, 2)."""
    (frame, datum, options), (gps_ns, lost_ns), (position_m, velocity_m_s, sigma_m) = kind, times, columns
    h = np.diff(gps_ns) * 1e-9
    interval_s = float(np.median(h))
    free = np.searchsorted(lost_ns, gps_ns[1:], side="right") == np.searchsorted(lost_ns, gps_ns[:-1])
    joined = np.asarray((h <= options.most_intervals * interval_s) & free, dtype=np.bool_)
    if not joined.all():
        notes.append(f"{int(np.sum(~joined))} gaps in the positions, {float(h[~joined].sum()):.1f} s together")
    velocity, difference = _velocities(h, joined, position_m, velocity_m_s, notes)
    change, acceleration = _accelerations(h, joined, position_m, velocity)
    return Trajectory(
        frame=frame,
        height_datum=datum,
        gps_ns=gps_ns,
        position_m=position_m,
        velocity_m_s=velocity,
        sigma_m=sigma_m,
        joined=joined,
        difference=difference,
        change_m_s2=change,
        acceleration_m_s2=acceleration,
        lost_ns=lost_ns,
        interval_s=interval_s,
        options=options,
        notes=tuple(notes),
    )


def _rows_of_receiver(table: FixTable) -> tuple[Indices, list[str]]:
    """Return the rows of the first receiver with two fixes or more, in the order of the file."""
    every = np.arange(len(table), dtype=np.int64)
    receivers: NDArray[np.uint8] = np.unique(table.receiver)
    for receiver in receivers.tolist():
        rows = every[table.receiver == receiver]
        if np.sum(_usable(table, rows)) >= 2:
            others = len(receivers) - 1
            notes = [f"receiver {receiver} is used, {others} other(s) not"] if others else []
            return rows, notes
    return every, []


def _usable(table: FixTable, rows: Indices) -> Flags:
    """Return which rows have a fix in three dimensions (or do not say), a place on earth and a time."""
    latitude, longitude = table.latitude_deg[rows], table.longitude_deg[rows]
    on_earth = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 180.0)
    known = (table.fix_type[rows] >= FixType.THREE_DIMENSIONAL) & (table.when.gps_ns[rows] > 0)  # nor NO_TIME
    return np.asarray(on_earth & known, dtype=np.bool_)


def _lost_times(table: FixTable, rows: Indices, good: Indices) -> Indices:
    """Return when the receiver said that it had no fix; without a time of its own, right after the fix before it."""
    without = rows[table.fix_type[rows] < FixType.THREE_DIMENSIONAL]
    times = table.when.gps_ns[without]
    before = np.searchsorted(good, without) - 1
    untimed = times <= 0
    if len(good):
        times = np.where(untimed & (before >= 0), table.when.gps_ns[good[np.maximum(before, 0)]] + 1, times)
    return np.unique(times[times > 0])


def _heights(table: FixTable, good: Indices, notes: list[str]) -> tuple[HeightDatum, Array]:
    """Return the datum of the heights and the heights (k,), NaN where a fix lacks it; zeros where none has any."""
    columns = [
        (HeightDatum.ELLIPSOID, _within(table.height_ellipsoid_m[good], MOST_HEIGHT_M)),
        (HeightDatum.GEOID, _within(table.height_geoid_m[good], MOST_HEIGHT_M)),
        (HeightDatum.GROUND, _within(table.height_above_home_m[good], MOST_HEIGHT_M)),
    ]
    off_m = _off_the_undulation_m(table, good, columns[0][1] - columns[1][1])
    if off_m > MOST_OFF_UNDULATION_M:
        notes.append(
            f"ellipsoidal heights less those above the geoid miss the geoid's undulation by {off_m:.0f} m: those above "
            "the geoid are used"
        )
        del columns[0]
    missing = [float(np.mean(~np.isfinite(height))) if len(height) else 1.0 for _, height in columns]
    for share, column in zip(missing, columns, strict=True):
        if share <= MOST_WITHOUT_HEIGHT:
            return column
    least = int(np.argmin(missing))
    return columns[least] if missing[least] < 1.0 else (HeightDatum.UNKNOWN, np.zeros(len(good)))


def _within(values: Array, most: float) -> Array:
    """Return values with NaN in place of those that are larger than any can be."""
    return np.where(np.abs(values) <= most, values, np.nan)


def _off_the_undulation_m(table: FixTable, good: Indices, undulation_m: Array) -> float:
    """Return by how much the two heights of the fixes differ otherwise than ellipsoid and geoid do; 0 if not told.

    ``undulation_m`` (k,) is their difference. Receivers and simulators that do not know it give one for the other.
    """
    both = good[np.isfinite(undulation_m)]
    if len(both) == 0:
        return 0.0
    middle = both[len(both) // 2]
    expected_m = geoid_undulation_m(table.latitude_deg[middle : middle + 1], table.longitude_deg[middle : middle + 1])
    return float(abs(np.nanmedian(undulation_m) - expected_m[0]))


def _velocities(h: Array, joined: Flags, position: Array, told: Array, notes: list[str]) -> tuple[Array, Flags]:
    """Return velocities (n, 3), the receiver's where it tells them, and where they are differences, (n, 2)."""
    differences, velocity = _difference_velocities(h, joined, position), told.copy()
    for axes, name in ((slice(0, 2), "horizontal"), (slice(2, 3), "vertical")):
        if _misfit(h, joined, position[:, axes], told[:, axes]) > DISBELIEVED:
            notes.append(f"the {name} velocities do not fit the positions: differences of positions take their place")
            velocity[:, axes] = np.nan
    unknown = ~np.isfinite(velocity)
    velocity[unknown] = differences[unknown]
    return velocity, np.column_stack([unknown[:, :2].any(axis=1), unknown[:, 2]])


def _misfit(h: Array, joined: Flags, position: Array, velocity: Array) -> float:
    """Return by what share of the way flown the velocities (n, 1 or 2) miss it, in the median over some seconds."""
    seconds = np.concatenate([[0.0], np.cumsum(h)])
    first = np.arange(len(seconds))
    last = np.minimum(np.searchsorted(seconds, seconds + JUDGED_S), len(seconds) - 1)
    step = 0.5 * (velocity[1:] + velocity[:-1]) * h[:, None]
    good = joined & np.isfinite(step).all(axis=1)
    flown = np.vstack([np.zeros(step.shape[1]), np.cumsum(np.where(good[:, None], step, 0.0), axis=0)])
    bad = np.concatenate([[0], np.cumsum(~good)])
    way = position[last] - position[first]
    length = np.linalg.norm(way, axis=1)
    apart = np.linalg.norm((np.diff(position, axis=0) - step)[good], axis=1)
    noise = float(np.median(apart)) if len(apart) else 0.0
    judged = (bad[last] == bad[first]) & (length > LEAST_SPEED_M_S * (seconds[last] - seconds)) & (last > first)
    judged &= length > ABOVE_NOISE * noise
    if not judged.any():
        return 0.0
    off = np.linalg.norm(way - flown[last] + flown[first], axis=1)
    return float(np.median(off[judged] / length[judged]))


def _difference_velocities(h: Array, joined: Flags, position: Array) -> Array:
    """Return velocities (n, 3) of the parabola through three joined fixes; of a line through two; NaN of one."""
    n = len(position)
    slope = np.where(joined[:, None], np.diff(position, axis=0) / h[:, None], np.nan)
    before, after = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    before[1:], after[:-1] = slope, slope
    h_before, h_after = np.concatenate([[1.0], h])[:, None], np.concatenate([h, [1.0]])[:, None]
    inner = (h_after * before + h_before * after) / (h_before + h_after)
    # At the ends of a stretch: the parabola's slope there is twice the chord less that of its inner end.
    first, last = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    first[:-1], last[1:] = 2.0 * slope - inner[1:], 2.0 * slope - inner[:-1]
    result = inner
    for other in (first, last, after, before):
        result = np.where(np.isfinite(result), result, other)
    return np.asarray(result, dtype=np.float64)


def _accelerations(h: Array, joined: Flags, position: Array, velocity: Array) -> tuple[Array, Array]:
    """Return how far the true acceleration may depart from the cubic's, (n - 1, 2), and how large it is, (n, 2)."""
    hc, way = h[:, None], np.diff(position, axis=0)
    begin = (6.0 * way / hc - 4.0 * velocity[:-1] - 2.0 * velocity[1:]) / hc
    end = (-6.0 * way / hc + 2.0 * velocity[:-1] + 4.0 * velocity[1:]) / hc
    mean = np.where(joined[:, None], 0.5 * (begin + end), np.nan)
    step = _sizes(np.diff(mean, axis=0))
    around = np.full((len(h), 2, 2), np.nan)
    around[1:, 0], around[:-1, 1] = step, step
    with np.errstate(invalid="ignore"):
        change = np.fmax(np.fmax(around[:, 0], around[:, 1]), _sizes(end - begin))
    # Velocities of differences make a single interval look straight: nothing is known of it.
    change[np.isnan(around).all(axis=(1, 2)) | ~np.isfinite(change).all(axis=1)] = UNKNOWN_ACCELERATION_M_S2
    size = np.where(joined[:, None], np.fmax(_sizes(begin), _sizes(end)) + change, np.nan)
    about = np.full((len(position), 2), np.nan)
    about[1:] = size
    about[:-1] = np.fmax(about[:-1], size)
    return change, np.where(np.isfinite(about), about, UNKNOWN_ACCELERATION_M_S2)


def _sizes(vectors: Array) -> Array:
    """Return the horizontal and vertical size of vectors (n, 3), shape (n, 2)."""
    return np.column_stack([np.hypot(vectors[:, 0], vectors[:, 1]), np.abs(vectors[:, 2])])
