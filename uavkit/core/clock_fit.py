"""GPS time of another clock: offset and drift fitted robustly, in pieces where one line does not hold."""

from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.core.gpstime import NO_TIME

GREATEST_DRIFT = 0.01
"""Clocks of simulated vehicles run wrong by up to 0.4 %, real ones by 100 ppm."""
FAR_S = 1.0
"""A pair farther than this from where the median and the greatest drift allow it is of a clock not yet set."""
LEAST_IN_SEGMENT = 20
WINDOW = 15
"""Pairs over which residuals are smoothed before they are taken for a bend."""
BEND_S = 0.005
"""A line that smoothed residuals leave by more than this, and by more than four times their own sigma, is split."""
MOST_SEGMENTS = 256
_ROUNDS = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockSegment:
    """A stretch over which gps = boot + offset + drift (boot - middle)."""

    begin_boot_ns: int
    end_boot_ns: int
    middle_boot_ns: int
    offset_ns: int
    """GPS time minus the clock, in the middle."""
    drift_ppm: float
    residual_s: float
    """Spread of single pairs about the line: 1.48 times the median of their absolute residuals."""
    sigma_s: float
    """Of the offset in the middle; a delay that all pairs have in common is not in it."""
    samples: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockFit:
    """What ties a clock to GPS time."""

    segments: tuple[ClockSegment, ...]
    """In the order of time, at least one."""
    rejected: int
    """Pairs that belong to no line: of a receiver that did not know the time yet."""

    def gps_ns(self, boot_ns: Indices) -> Indices:
        """Return the GPS time of times of the clock, (n,) integer ns; NO_TIME stays. The lines go on beyond."""
        boot = np.asarray(boot_ns, dtype=np.int64)
        unknown = boot == NO_TIME
        begins = np.array([segment.begin_boot_ns for segment in self.segments], dtype=np.int64)
        row = np.clip(np.searchsorted(begins, boot, side="right") - 1, 0, len(begins) - 1)
        middle = np.array([segment.middle_boot_ns for segment in self.segments], dtype=np.int64)[row]
        offset = np.array([segment.offset_ns for segment in self.segments], dtype=np.int64)[row]
        drift = np.array([segment.drift_ppm for segment in self.segments])[row]
        since = np.where(unknown, 0, boot - middle)
        moved = boot + offset + np.rint(drift * 1e-6 * since).astype(np.int64)
        return np.where(unknown, NO_TIME, moved)

    @property
    def drift_ppm(self) -> float:
        """The drift over all segments, weighted by their lengths."""
        lengths = np.array([max(s.end_boot_ns - s.begin_boot_ns, 1) for s in self.segments], dtype=np.float64)
        return float(np.average([segment.drift_ppm for segment in self.segments], weights=lengths))

    @property
    def residual_s(self) -> float:
        """The spread of single pairs, the greatest of all segments."""
        return max(segment.residual_s for segment in self.segments)


def fit_clock(boot_ns: Indices, gps_ns: Indices) -> ClockFit | None:
    """Return the fit of pairs of times of the same instants, (n,) each, in any order; None without a pair.

    Lines minimise the sum of absolute residuals (iteratively reweighted least squares), so that single delayed
    messages do not count.
    """
    boot, gps = np.asarray(boot_ns, dtype=np.int64), np.asarray(gps_ns, dtype=np.int64)
    known = (boot != NO_TIME) & (gps != NO_TIME)
    order = np.argsort(boot[known], kind="stable")
    boot, gps = boot[known][order], gps[known][order]
    if len(boot) == 0:
        return None
    zero = int(np.sort(gps - boot)[len(boot) // 2])  # one of them: the mean of two may be near none
    difference_s = (gps - boot - zero) * 1e-9
    since_s = (boot - boot[len(boot) // 2]) * 1e-9
    near = np.abs(difference_s) < FAR_S + GREATEST_DRIFT * float(since_s[-1] - since_s[0])
    boot, difference_s = boot[near], difference_s[near]
    bounds = _split(boot, difference_s)
    segments = tuple(_segment(boot[a:b], difference_s[a:b], zero) for a, b in bounds)
    return ClockFit(segments=segments, rejected=int(np.sum(~near)))


def _line(since_s: Array, value_s: Array) -> tuple[float, float]:
    """Return offset and slope of the line with the least sum of absolute residuals, the slope 0 for a short stretch."""
    if len(since_s) < 3 or since_s[-1] - since_s[0] < 1.0:
        return float(np.median(value_s)), 0.0
    A = np.column_stack([np.ones_like(since_s), since_s])
    weight = np.ones_like(value_s)
    offset, slope = float(np.median(value_s)), 0.0
    for _ in range(_ROUNDS):
        N = A.T @ (A * weight[:, None])
        offset, slope = np.linalg.solve(N, A.T @ (weight * value_s)).tolist()
        weight = 1.0 / np.maximum(np.abs(value_s - offset - slope * since_s), 1e-6)
    return offset, slope


def _split(boot: Indices, value_s: Array) -> list[tuple[int, int]]:
    """Return bounds of stretches over each of which one line holds."""
    todo, done = [(0, len(boot))], list[tuple[int, int]]()
    while todo:
        a, b = todo.pop()
        since_s = np.asarray((boot[a:b] - boot[(a + b) // 2]) * 1e-9, dtype=np.float64)
        where = _bend(since_s, value_s[a:b]) if len(todo) + len(done) < MOST_SEGMENTS else None
        if where is None:
            done.append((a, b))
        else:
            todo += [(a, a + where), (a + where, b)]
    return sorted(done)


def _bend(since_s: Array, value_s: Array) -> int | None:
    """Return where to split a stretch (n,) whose smoothed residuals leave the line, None where they do not.

    That is where two lines explain best what one does not.
    """
    n = len(value_s)
    if n < 2 * LEAST_IN_SEGMENT:
        return None
    offset, slope = _line(since_s, value_s)
    residual_s = value_s - offset - slope * since_s
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(residual_s, WINDOW), axis=1)
    noise = 1.48 * float(np.median(np.abs(np.diff(residual_s)))) / np.sqrt(2.0)
    if float(np.abs(smooth).max()) <= max(BEND_S, 4.0 * 1.25 * noise / np.sqrt(WINDOW)):
        return None
    clipped = np.clip(residual_s, smooth.min() - 3.0 * noise, smooth.max() + 3.0 * noise)
    x = since_s / max(float(np.abs(since_s).max()), 1e-9)
    both = _square_sums(x, clipped)[:-1] + _square_sums(-x[::-1], clipped[::-1])[::-1][1:]
    both[: LEAST_IN_SEGMENT - 1] = both[n - LEAST_IN_SEGMENT :] = np.inf
    return int(np.argmin(both)) + 1


def _square_sums(x: Array, y: Array) -> Array:
    """Return the sum of squared residuals about the least squares line of the first 1, 2, ... points, (n,)."""
    count = np.arange(1, len(x) + 1, dtype=np.float64)
    sx, sy = np.cumsum(x), np.cumsum(y)
    xx, xy, yy = np.cumsum(x * x) - sx**2 / count, np.cumsum(x * y) - sx * sy / count, np.cumsum(y * y) - sy**2 / count
    return np.asarray(np.maximum(yy - xy**2 / np.maximum(xx, 1e-12), 0.0), dtype=np.float64)


def _segment(boot: Indices, value_s: Array, zero: int) -> ClockSegment:
    middle = int(boot[len(boot) // 2])
    since_s = np.asarray((boot - middle) * 1e-9, dtype=np.float64)
    offset, slope = _line(since_s, value_s)
    residual_s = 1.48 * float(np.median(np.abs(value_s - offset - slope * since_s)))
    return ClockSegment(
        begin_boot_ns=int(boot[0]),
        end_boot_ns=int(boot[-1]),
        middle_boot_ns=middle,
        offset_ns=zero + round(offset * 1e9),
        drift_ppm=slope * 1e6,
        residual_s=residual_s,
        sigma_s=1.25 * max(residual_s, 1e-4) / float(np.sqrt(len(boot))),
        samples=len(boot),
    )
