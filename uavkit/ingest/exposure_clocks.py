"""Which settings of the camera's clock are worth weighing: those that many pairs agree in, made as good as they can be.

Offsets come from the differences of all stills and events: coarse windows that hold many, then, within these, fine
offsets and drifts that most stills fit. Each is improved by least squares over the pairs that are probable at it, and
where stamps are cut down by searching the sum over all alignments itself.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.ingest.exposure_chain import Chain
from uavkit.ingest.exposure_sums import Clock, Pairs, log_sum, pairs_of

MOST_WINDOWS = 400
MOST_STARTS = 250
MOST_IMPROVED = (80, 60, 45, 30)
"""Settings kept at most, from round to round of improvement."""
FEWER_SHARE = 0.25
"""Windows that hold so many fewer pairs than the best are not looked at."""
FEWER_AT_LEAST = 10.0
MOST_CELLS = 10_000_000
"""Of the coarse windows: a range of offsets of some months."""
SHIFTS = (1, 2, 3, 4, 6, 9, 14, 21, 32)
"""A better shift is looked for so many events further on and back: in a regular flight the right one may be far."""
MOST_NEIGHBOURS = 6
MOST_ROUNDS = 12
MOST_DRIFTS = 41
NEAR_BEST = 20.0
"""Settings whose logarithm is so much lower than the best do not count."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockLimits:
    """What is known of the camera's clock beforehand."""

    sigma_drift: float
    """The drift is Gaussian about 0."""
    greatest_drift: float
    offsets_s: tuple[float, float] | None = None
    """The offset in the middle of the events, if anything is known of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WeighedClock:
    """A setting of the clock and the logarithm of the sum at it."""

    clock: Clock
    log_sum: float


def best_clocks(chain: Chain, limits: ClockLimits) -> list[WeighedClock]:
    """Return the settings that may matter, the best first, each by least squares; none where nothing fits."""
    blur = _vote_step(chain)
    pairs = min(len(chain.still_s), len(chain.event_s))
    starts = _without_doubles(chain, [WeighedClock(clock=clock, log_sum=0.0) for clock in _starts(chain, limits)])
    found = [WeighedClock(clock=start.clock, log_sum=log_sum(chain, start.clock, blur)) for start in starts]
    found = _nearly_best(found, 0.3 * pairs, MOST_IMPROVED[0])
    for blur_s, each, most in zip((blur, 0.5 * blur, 0.0), (0.2, 0.12, 0.06), MOST_IMPROVED[1:], strict=True):
        found = [_improved(chain, entry.clock, blur_s, limits) for entry in found]
        found = _without_doubles(chain, _nearly_best(found, each * pairs, most))
    for _ in range(MOST_ROUNDS if found else 0):
        best = found[0]
        found = _without_doubles(chain, found + _neighbours(chain, best.clock, limits))
        found = _nearly_best(found, 0.06 * pairs, MOST_IMPROVED[-1])
        if found[0].log_sum <= best.log_sum:
            break
    return found


def _neighbours(chain: Chain, clock: Clock, limits: ClockLimits) -> list[WeighedClock]:
    """Return the settings at which the stills belong to events a few further on or back.

    In a regular flight these are nearly as good, and the votes may have named only some of them.
    """
    rough = []
    noise, blur = 2.5 * chain.noise_s + _vote_step(chain), 0.5 * _vote_step(chain)
    for k in (shift for shift in SHIFTS if shift < len(chain.event_s)):
        shift_s = float(np.median(chain.event_s[k:] - chain.event_s[:-k]))
        for sign in (-1.0, 1.0):
            moved = _fitted_to_nearest(chain, clock.moved(sign * shift_s, 0.0), noise, limits)
            rough.append(WeighedClock(clock=moved, log_sum=log_sum(chain, moved, blur)))
    likely = sorted(rough, key=lambda entry: -entry.log_sum)[:MOST_NEIGHBOURS]
    return [_improved(chain, _improved(chain, entry.clock, blur, limits).clock, 0.0, limits) for entry in likely]


def _nearly_best(found: list[WeighedClock], margin: float, most: int) -> list[WeighedClock]:
    """Return the best, first, and those that may yet be as good: improvement may gain them ``margin``."""
    order = sorted(found, key=lambda entry: -entry.log_sum)[:most]
    return [entry for entry in order if entry.log_sum > order[0].log_sum - NEAR_BEST - margin]


def _without_doubles(chain: Chain, found: list[WeighedClock]) -> list[WeighedClock]:
    kept: list[WeighedClock] = []
    for entry in found:
        if not any(same_clock(entry.clock, other.clock, chain) for other in kept):
            kept.append(entry)
    return kept


def _vote_step(chain: Chain) -> float:
    return max(chain.noise_s, 0.12 * 2.0 * chain.typical_half_s)


def _middle(chain: Chain) -> float:
    return 0.5 * float(chain.event_s[0] + chain.event_s[-1])


def _half_span(chain: Chain) -> float:
    spans = (chain.event_s[-1] - chain.event_s[0], chain.still_s[-1] - chain.still_s[0])
    return max(0.5 * float(min(spans)), 1.0)


def _drifts(half_span: float, step_s: float, limits: ClockLimits) -> Array:
    """Return drifts a step apart at the ends of the sequence, 0 among them."""
    half = min(int(np.ceil(limits.greatest_drift * half_span / step_s - 0.5)), MOST_DRIFTS // 2)
    return np.asarray(np.arange(-half, half + 1) * (limits.greatest_drift / max(half, 1)), dtype=np.float64)


def _starts(chain: Chain, limits: ClockLimits) -> Iterator[Clock]:
    """Yield offsets and drifts at which many stills fit an event, at most ``MOST_STARTS``, the fullest first."""
    step = _vote_step(chain)
    noise = 2.5 * chain.noise_s + step
    drifts = _drifts(_half_span(chain), 2.0 * step, limits)
    found: list[tuple[int, float, float]] = []
    for low, high in _windows(chain, limits):
        found += _peaks(chain, (low, high), drifts, (step, noise))
    found.sort(key=lambda entry: -entry[0])
    for _, offset, drift in found[:MOST_STARTS]:
        yield _fitted_to_nearest(chain, Clock(offset_s=offset, drift=drift, reference_s=_middle(chain)), noise, limits)


def _fitted_to_nearest(chain: Chain, clock: Clock, noise_s: float, limits: ClockLimits) -> Clock:
    """Return the clock by least squares over each still and the event nearest to it, those that do not fit left out.

    The grid of drifts is coarse: without this a wrong shift that it happens to meet looks better than the true one.
    """
    for _ in range(3):
        moved = clock.event_time_s(chain.still_s)
        after = np.clip(np.searchsorted(chain.event_s, moved), 1, max(len(chain.event_s) - 1, 1))
        after = np.minimum(after, len(chain.event_s) - 1)
        before = np.maximum(after - 1, 0)
        nearest = np.where(moved - chain.event_s[before] < chain.event_s[after] - moved, before, after)
        fits = np.flatnonzero(np.abs(moved - chain.event_s[nearest]) < chain.half_s + noise_s)
        if len(fits) < 2:
            break
        clock, _ = fitted_with_covariance(chain, (fits, nearest[fits], np.ones(len(fits))), limits)
    return clock


def _windows(chain: Chain, limits: ClockLimits) -> list[tuple[float, float]]:
    """Return spans of offsets that many differences of stills and events lie in, the fullest first."""
    from uavkit.ingest.kernels.votes import count_differences

    width = float(np.clip(0.5 * chain.interval_s, 6.0 * _vote_step(chain), 2.0))
    middle = _middle(chain)
    low = float(chain.still_s[0] - chain.event_s[-1]) - width
    high = float(chain.still_s[-1] - chain.event_s[0]) + width
    if limits.offsets_s is not None:
        low, high = max(low, limits.offsets_s[0]), min(high, limits.offsets_s[1])
        if low > high:
            return []
    count = int((high - low) / width) + 2
    half_span = max(0.5 * float(chain.event_s[-1] - chain.event_s[0]), 1.0)
    drifts = _drifts(min(half_span, 2.0 * _half_span(chain)), width, limits)
    if count > MOST_CELLS:
        number, best = _scattered_counts(chain, (low, high, width), drifts)
    else:
        number, best = np.arange(count), np.zeros(count, dtype=np.int64)
        for drift in drifts:
            cells = np.zeros(count, dtype=np.int64)
            count_differences(chain.still_s, chain.event_s + drift * (chain.event_s - middle), low, width, cells)
            best = np.maximum(best, cells + np.maximum(np.append(cells[1:], 0), np.insert(cells[:-1], 0, 0)))
    if not len(best):
        return []
    order = np.argsort(-best, kind="stable")[:MOST_WINDOWS]
    least = best[order[0]] - max(FEWER_AT_LEAST, FEWER_SHARE * float(best[order[0]]))
    chosen = order[best[order] >= max(least, 1.0)]
    return [(low + width * float(k), low + width * float(k + 1)) for k in number[chosen]]


def _scattered_counts(chain: Chain, cell: tuple[float, float, float], drifts: Array) -> tuple[Indices, Indices]:
    """Return the numbers of the cells that differences lie in, ascending, and the best count of each with a neighbour.

    What lies years apart, as the one event with a damaged time does, would need more cells than the memory holds.
    """
    low, high, width = cell
    middle = _middle(chain)
    numbers, sums = list[Indices](), list[Indices]()
    for drift in drifts:
        moved = chain.event_s + drift * (chain.event_s - middle)
        apart = (chain.still_s[:, None] - moved).ravel()
        inside = apart[(apart >= low) & (apart <= high)]
        number, count = np.unique(np.floor((inside - low) / width).astype(np.int64), return_counts=True)
        after, before = (_count_at(number + step, number, count) for step in (1, -1))
        numbers.append(number)
        sums.append(count + np.maximum(after, before))
    every, place = np.unique(np.concatenate(numbers), return_inverse=True)
    best = np.zeros(len(every), dtype=np.int64)
    np.maximum.at(best, place, np.concatenate(sums))
    return every, best


def _count_at(wanted: Indices, number: Indices, count: Indices) -> Indices:
    place = np.minimum(np.searchsorted(number, wanted), max(len(number) - 1, 0))
    return np.where(number[place] == wanted, count[place], 0) if len(number) else np.zeros(len(wanted), dtype=np.int64)


def _peaks(
    chain: Chain, window: tuple[float, float], drifts: Array, cell: tuple[float, float]
) -> list[tuple[int, float, float]]:
    """Return count, offset and drift where most stills fit, for stretches of the window apart."""
    from uavkit.ingest.kernels.votes import count_fits

    step, noise = cell
    count = max(1, int(np.ceil((window[1] - window[0]) / step)))
    middle = _middle(chain)
    votes = np.zeros((len(drifts), count), dtype=np.int64)
    for row, drift in enumerate(drifts):
        moved = chain.event_s + drift * (chain.event_s - middle)
        count_fits(chain.still_s, chain.half_s, moved, (window[0], step, noise), votes[row])
    best = votes.max(axis=0)
    apart = max(2, int(np.ceil(0.34 * chain.interval_s / step)))
    peaks = []
    for begin in range(0, count, apart):
        level = int(best[begin : begin + apart].max())
        offsets = begin + np.flatnonzero(best[begin : begin + apart] == level)
        offset = int(offsets[len(offsets) // 2])
        rows = np.flatnonzero(votes[:, offset] == level)
        row = int(rows[np.argmin(np.abs(rows - np.mean(rows)))])
        if level > 0:
            peaks.append((level, window[0] + step * offset, float(drifts[row])))
    return peaks


def same_clock(one: Clock, two: Clock, chain: Chain) -> bool:
    """Tell whether two settings differ by less than what matters."""
    noise = chain.noise_s
    there = two.about(one.reference_s)
    span = (one.drift - there.drift) * _half_span(chain)
    return abs(one.offset_s - there.offset_s) < 0.3 * noise and abs(span) < 0.3 * noise


def _improved(chain: Chain, clock: Clock, blur_s: float, limits: ClockLimits) -> WeighedClock:
    """Return the clock by least squares over the pairs that are probable at it, weighed with half the blur."""
    pairs = pairs_of(chain, clock, blur_s)
    if len(pairs.still):
        clock = fitted(chain, pairs, limits)
    return WeighedClock(clock=clock, log_sum=log_sum(chain, clock, 0.5 * blur_s))


def fitted(chain: Chain, pairs: Pairs, limits: ClockLimits) -> Clock:
    """Return the clock by least squares over the pairs, weighed by their probability."""
    return fitted_with_covariance(chain, (pairs.still, pairs.event, pairs.probability), limits)[0]


def fitted_with_covariance(
    chain: Chain, pairs: tuple[Indices, Indices, Array], limits: ClockLimits
) -> tuple[Clock, Array]:
    """Return the clock and the covariance (2, 2) of offset (s) and drift; ``pairs`` are rows and probabilities (k,)."""
    still, event, probability = pairs
    variance = chain.sigma_s[event] ** 2 + chain.half_s[still] ** 2 / 3.0
    weight = probability / variance
    reference = float(np.average(chain.event_s[event], weights=weight))
    x = chain.event_s[event] - reference
    y = chain.still_s[still] - chain.event_s[event]
    offset = float(np.average(y, weights=weight))
    information = float(weight @ x**2) + 1.0 / limits.sigma_drift**2
    drift = float(np.clip(weight @ (x * (y - offset)) / information, -limits.greatest_drift, limits.greatest_drift))
    covariance = np.diag([1.0 / float(weight.sum()), 1.0 / information])
    return Clock(offset_s=offset, drift=drift, reference_s=reference), covariance


def searched(chain: Chain, start: WeighedClock, limits: ClockLimits) -> WeighedClock:
    """Return the best setting near a start by trying steps of offset and drift, halved where none is better.

    For coarse stamps: least squares is far from the best there.
    """
    best = WeighedClock(clock=start.clock, log_sum=log_sum(chain, start.clock, 0.0))
    step = 0.25 * chain.typical_half_s
    arm = 0.6 * _half_span(chain)
    while step > 0.4 * chain.noise_s:
        tried = (
            best.clock.moved(a * step, b * step / arm) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1))
        )
        weighed = [
            WeighedClock(clock=clock, log_sum=log_sum(chain, clock, 0.0))
            for clock in tried
            if abs(clock.drift) <= limits.greatest_drift
        ]
        better = max(weighed, key=lambda entry: entry.log_sum, default=best)
        if better.log_sum > best.log_sum + 0.1:
            best = better
        else:
            step *= 0.5
    return best
