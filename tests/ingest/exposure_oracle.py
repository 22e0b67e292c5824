"""What can be known at all: an exhaustive search over offsets with the true law of a case. Slow, and plainly right.

Written apart from the matcher, of which it shares no code. It is told what no matcher can know: the law of the
intervals, the rates of all defects, the noise, and the drift. At each offset of a fine grid at which stills and events
meet, the probability of both sequences is summed over all the ways in which exposures can have given rise to them; of
these sums follows how probable each shift is. A case is settled if the true one has 99.9 %.

One way: a row of exposures, each after an interval of the law, seen by the camera and the log, or by one of them, or by
neither (twice in a row at most); false stills and events are thrown in anywhere; an event may come twice. Recordings
begin and end when someone pleases: how many entries are alone at an end tells nothing, otherwise a regular flight would
be settled by counting alone. A state of the sum: i stills and j events told, and when the last exposure was, which is
the time of an event, or, of a still that has none, one of ``PARTS`` times that its stamp allows.
"""

import math

import numba
import numpy as np
from exposure_cases import Case, CaseLaw

from uavkit.core.arrays import Array

SETTLED = 0.999
MOST_OFFSETS = 300
FEWER_FITS = 12
"""An offset at which so many fewer stills fit an event cannot compare."""
NEGLIGIBLE = 1e-14
PARTS = 32
WIDTHS = 6.0
"""A still may be so many standard deviations outside the interval of its stamp."""


def interval_table(law: CaseLaw, unseen: float, step: float, count: int) -> Array:
    """Return the density of the time from an exposure that is seen to the next, in steps from 0."""
    rng = np.random.default_rng(0)
    draws = law.interval_s + rng.normal(0.0, law.interval_noise_s, 400_000)
    if not law.hover:  # half of the strips are flown against the wind, each by a wind of its own
        draws *= np.where(rng.random(400_000) < 0.5, 1.0 + rng.uniform(0.0, 0.25, 400_000), 1.0)
        draws += np.where(rng.random(400_000) < law.turn_share, rng.uniform(3.0, 20.0, 400_000), 0.0)
    cells = (np.arange(count + 1) - 0.5) * step
    one = np.histogram(np.maximum(draws, 0.4), bins=cells)[0] / 400_000
    spectrum = np.fft.rfft(one, 2 * count)
    total = (1.0 - unseen) * (spectrum + unseen * spectrum**2 + unseen**2 * spectrum**3)
    return np.maximum(np.fft.irfft(total, 2 * count)[:count] / step, 1e-9)


@numba.njit(cache=True)
def _below(x):
    return 0.5 * math.erfc(-x * 0.7071067811865476)


@numba.njit(cache=True)
def _density(table, step, x):
    k = int(x / step + 0.5)
    return table[k] if 0 <= k < len(table) and x > -step else 1e-9


@numba.njit(cache=True)
def _runs(times, share, table, step, floor):
    """Product of what follows each entry if all later ones are of this sequence alone; (k + 1,)."""
    result = np.ones(len(times) + 1)
    for k in range(len(times) - 2, -1, -1):
        result[k] = result[k + 1] * share * max(_density(table, step, times[k + 1] - times[k]), floor)
    return result


@numba.njit(cache=True)
def log_probability(s, e, numbers, table, step, ends_s, ends_e):  # noqa: C901 - one recursion, said once
    """Logarithm of the sum over all ways, s (middles of the stamps) and e by one clock; ``numbers`` as in ``_numbers``.

    sums[j, c] of row i: the last exposure was event j-1 (c = 0), event j-2 (1), still i-1 at part c-2, still i-2 at
    part c-2-PARTS. Stills alone at an end are told by their middles, which does not tell shifts apart.
    """
    half, sigma, both, only_still, only_event, doubled, false_still, false_event = numbers
    n, m = len(s), len(e)
    reach = half + WIDTHS * sigma
    part = 2.0 * reach / PARTS
    allowed, place = np.zeros(PARTS), np.zeros(PARTS)
    for u in range(PARTS):
        place[u] = -reach + (u + 0.5) * part
        allowed[u] = (_below((place[u] + half) / sigma) - _below((place[u] - half) / sigma)) / (2.0 * half)
    run_e, run_s = _runs(e, only_event, table, step, 0.0), _runs(s, only_still, table, step, 0.05)
    row, below = np.zeros((m + 1, 2 + 2 * PARTS)), np.zeros((m + 1, 2 + 2 * PARTS))
    row[0, 0] = ends_s[0]
    for j in range(1, m + 1):
        row[j, 0] = ends_e[j] * run_e[0] / max(run_e[j - 1], 1e-300)
    total, scale, total_scale = 0.0, 0.0, -1e300
    for i in range(n + 1):
        below[:] = 0.0
        done = 0.0
        for j in range(m + 1):
            for c in range(2 + 2 * PARTS):
                here = row[j, c]
                if here < NEGLIGIBLE:
                    continue
                first, u = i == 0 and j == 0, (c - 2) % PARTS
                last = 0.0
                if c < 2 and j > c:
                    last = e[j - 1 - c]
                elif c >= 2:
                    last = s[i - 1 - (c - 2) // PARTS] + place[u]
                if i == n and j == m:
                    done += here * ends_e[0]
                elif i == n:
                    done += here * ends_e[m - j] * only_event * _density(table, step, e[j] - last) * run_e[j]
                elif j == m:
                    done += here * ends_s[n - i] * only_still * max(_density(table, step, s[i] - last), 0.05) * run_s[i]
                if i < n and j < m and abs(s[i] - e[j]) < reach:
                    x = s[i] - e[j]
                    fit = (_below((x + half) / sigma) - _below((x - half) / sigma)) / (2.0 * half)
                    gap = 1.0 if first else _density(table, step, e[j] - last)
                    below[j + 1, 0] += here * both * gap * fit
                if i < n and 0 < j < m and s[i] - reach < e[j]:
                    for v in range(PARTS):
                        gap = _density(table, step, s[i] + place[v] - last)
                        if gap > 1e-8:
                            below[j, 2 + v] += here * only_still * gap * allowed[v] * part
                if i < n and j > 0 and c < 2 + PARTS:
                    below[j, c if c < 2 else c + PARTS] += here * false_still
                if 0 < i < n and j < m and e[j] < s[i] + reach:
                    row[j + 1, 0] += here * only_event * _density(table, step, e[j] - last)
                if i > 0 and j < m and c != 1:
                    twice = doubled / 0.29 if c == 0 and 0.0 < e[j] - last < 0.31 else 0.0
                    row[j + 1, 1 if c == 0 else c] += here * (twice + false_event)
        if done > 0.0:
            top = max(scale, total_scale)
            total = total * math.exp(max(total_scale - top, -700.0)) + done * math.exp(max(scale - top, -700.0))
            total_scale = top
        if i < n:
            lead = ends_s[i + 1] * run_s[0] / max(run_s[i], 1e-300) * math.exp(min(max(-scale, -600.0), 600.0))
            for v in range(PARTS):
                below[0, 2 + v] += lead * allowed[v] * part * 2.0 * half
            greatest = max(below.max(), 1e-290)
            row, below = below / greatest, row
            scale += math.log(greatest)
    return total_scale + math.log(total) if total > 0.0 else -1e300


def _numbers(law: CaseLaw, unseen: float) -> Array:
    """Return what can happen to an exposure that is seen at all, and how many false entries a second brings."""
    a, b = law.still_missing, law.event_missing
    seen = 1.0 - unseen
    return np.array(
        [
            0.5 * law.resolution_s,
            law.jitter_s,
            (1.0 - a) * (1.0 - b) / seen,
            max((1.0 - a) * b / seen, 1e-9),
            max(a * (1.0 - b) / seen, 1e-9),
            law.event_doubled,
            law.still_spurious / law.interval_s,
            law.event_spurious / law.interval_s,
        ]
    )


def probability_of_true_shift(case: Case) -> float:
    """Return how probable the offsets near the true one are among all, by the true law and drift."""
    law = case.law
    unseen = law.still_missing * law.event_missing
    step = float(np.clip(0.3 * law.interval_noise_s, 0.002, 0.02))
    table = interval_table(law, unseen, step, int(3.0 * (law.interval_s + 12.0) / step))
    ends_s, ends_e = np.ones(len(case.still_s) + 1), np.ones(len(case.event_s) + 1)
    stills = (case.still_s + 0.5 * law.resolution_s - case.offset_s) / (1.0 + case.drift)
    offsets = _offsets(stills, case.event_s, law)
    numbers = _numbers(law, unseen)
    logs = np.array([log_probability(stills - o, case.event_s, numbers, table, step, ends_s, ends_e) for o in offsets])
    weight = np.exp(logs - logs.max())
    near = np.abs(offsets) < 0.45 * law.interval_s
    return float(weight[near].sum() / weight.sum())


def _offsets(stills: Array, events: Array, law: CaseLaw) -> Array:
    """Return the offsets about 0, the truth, of a fine grid, at which the most stills fit an event."""
    step = max(0.7 * law.jitter_s, 0.02 * law.resolution_s)
    cells = np.rint((stills[:, None] - events[None, :]) / step).astype(np.int64).ravel()
    wide = int(np.ceil((0.5 * law.resolution_s + 2.0 * law.jitter_s) / step))
    low = int(cells.min()) - wide
    counts = np.bincount(cells - low, minlength=int(cells.max()) - low + wide + 2)
    sums = np.concatenate([[0], np.cumsum(counts)])
    centres = np.arange(wide, len(counts) - wide)
    fits = sums[centres + wide + 1] - sums[centres - wide]
    order = np.argsort(-fits, kind="stable")[:MOST_OFFSETS]
    order = order[fits[order] >= fits[order[0]] - FEWER_FITS]
    return (centres[order] + low) * step
