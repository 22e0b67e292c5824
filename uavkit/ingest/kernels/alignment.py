"""All order-preserving alignments of stills and events at one setting of the camera's clock, weighed by two recursions.

The exposures are one chain in the order of time. A state (i, j, kind) has told the first i stills and the first j
events; the kind says what came last: a PAIR, a still ALONE, an event alone (EVENT), an event that tells the exposure
before it once more (AGAIN), or a still that does (COPY). AGAIN and COPY stand for false entries too: after both, the
next interval counts from the exposure before. All weights are divided by those of two chains that have nothing to do
with one another, so the logarithm of the sum is that of the Bayes factor against no relation at all.

Only states near the diagonal of equal times exist: row i holds j from ``first[i]`` to ``last[i]``, at ``start[i]`` on.
"""

import math

import numpy as np
from numpy.typing import NDArray

from uavkit.ingest.kernels.jit import inlined, kernel

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

PAIR, ALONE, EVENT, AGAIN, COPY = 0, 1, 2, 3, 4
KINDS = 5
LAST_STILLS, LAST_EVENTS = 5, 6
PARTS = 24
LEAST = 1e-250
"""Sums smaller than this, of the greatest of their row, count for nothing."""
_ROOT_HALF = math.sqrt(0.5)
TAIL_SHARE, TAIL_SCALE = 0.05, 3.0
"""So many residuals have so many times the standard deviation of the others."""


@inlined
def _box(x: float, half: float, sigma: float) -> float:
    """Return the density of a uniform distribution of +-half with Gaussian noise."""
    a = math.erf((x + half) / sigma * _ROOT_HALF) - math.erf((x - half) / sigma * _ROOT_HALF)
    return 0.25 * a / half


@inlined
def residual_density(x: float, half: float, sigma: float) -> float:
    """Return the density (1/s) of a still's middle minus the event's time, of a stamp cut down to 2 half."""
    x = abs(x)
    if x > half + 3.5 * TAIL_SCALE * sigma:
        return 0.0
    if x < half - 3.5 * TAIL_SCALE * sigma:
        return 0.5 / half
    return float((1.0 - TAIL_SHARE) * _box(x, half, sigma) + TAIL_SHARE * _box(x, half, TAIL_SCALE * sigma))


@inlined
def interval_density(table: Floats, grid: Floats, interval_s: float) -> float:
    """Return the density of an interval between exposures; ``grid`` is first value, 1/step, and scale of the tail."""
    k = (interval_s - grid[0]) * grid[1]
    if k < 0.0:
        return 1e-9
    row = int(k)
    if row + 1 >= len(table):
        return float(grid[3] * grid[2] / (interval_s + grid[2]) ** 2)
    share = k - row
    return float((1.0 - share) * table[row] + share * table[row + 1])


@kernel
def fill_steps(
    stills: tuple[Floats, Floats], events: tuple[Floats, Floats], bands: tuple[Integers, Integers, Integers],
    tables: Floats, grid: Floats, steps: Floats,
) -> None:  # fmt: skip
    """Fill ``steps`` (states, 4): density of the residual of still i and event j, of the intervals from still i-1 to
    event j, from event j-1 to still i, from event j-2 to still i."""
    s, half = stills
    e, sigma = events
    first, last, start = bands
    n, m = len(s), len(e)
    for i in range(n + 1):
        for j in range(first[i], last[i] + 1):
            k = start[i] + j - first[i]
            for c in range(4):
                steps[k, c] = 0.0
            if i < n and j < m:
                steps[k, 0] = residual_density(s[i] - e[j], half[i], sigma[j])
            if i > 0 and j < m:
                steps[k, 1] = interval_density(tables[1], grid, e[j] - s[i - 1])
            if i < n and j > 0:
                steps[k, 2] = interval_density(tables[1], grid, s[i] - e[j - 1])
            if i < n and j > 1:
                steps[k, 3] = interval_density(tables[1], grid, s[i] - e[j - 2])


@inlined
def _moves(
    i: int, j: int, kind: int, steps: Floats, per_still: Floats, per_event: Floats, weights: Floats, out: Floats
) -> None:
    """Give the weights of the steps from a state: to each kind, and to the first still (event) of those left last.

    ``per_still`` (n, 3): 1 / density if unrelated, density of the interval before, weight as a copy. ``per_event``
    (m, 5): the same, the density of the interval over two events, and that of any number of exposures between this
    event and the one before (-1 to leave it aside): a coarse stamp between them tells less. ``steps`` (4,) of the
    state.
    """
    n, m = len(per_still), len(per_event)
    to_event = to_still = 0.0
    if kind == ALONE:
        to_event = steps[1]
        if 0 < j < m and per_event[j, 4] >= 0.0:
            to_event = 0.5 * (to_event + per_event[j, 4])
        to_still = per_still[i, 1] if i < n else 0.0
    elif kind == AGAIN and j > 1:
        to_event = per_event[j, 3] if j < m else 0.0
        to_still = steps[3]
    elif j > 0:
        to_event = per_event[j, 1] if j < m else 0.0
        to_still = steps[2]
    out[:] = 0.0
    if i < n and j < m:
        out[PAIR] = weights[kind, PAIR] * to_event * steps[0] * per_still[i, 0] * per_event[j, 0]
    if i < n and 0 < j < m:  # stills alone before the first and after the last event are ends, weighed apart
        out[ALONE] = weights[kind, ALONE] * to_still * per_still[i, 0]
    if 0 < i < n and j < m:
        out[EVENT] = weights[kind, EVENT] * to_event * per_event[j, 0]
    if i < n:
        out[LAST_STILLS] = to_still * per_still[i, 0]
    if j < m:
        out[LAST_EVENTS] = to_event * per_event[j, 0]
    if j < m and j > 0 and kind != ALONE:
        out[AGAIN] = weights[kind, AGAIN] * per_event[j, 2]
    if i < n and j > 0 and kind != ALONE and kind != AGAIN:
        out[COPY] = weights[kind, COPY] * per_still[i, 2]


@kernel
def own_chain(interval: Floats, over_two: Floats, none: Floats, own: Floats) -> None:
    """Fill ``own`` (k,) with the density of each entry given those before, of a sequence by itself.

    ``interval``, ``over_two``: densities of the intervals since the entry before, and the one before that; ``none``: of
    an entry that is no exposure.
    """
    exposure, other = 1.0, 0.0  # what the entry before was
    for k in range(len(interval)):
        now = exposure * interval[k] + other * over_two[k]
        otherwise = none[k]
        own[k] = now + otherwise
        exposure, other = now / own[k], otherwise / own[k]


@kernel
def own_stamps(still_s: Floats, half_s: Floats, table: Floats, grid: Floats, none: Floats, own: Floats) -> None:
    """Fill ``own`` (n,) from 1 on with the density of each stamp given those before, of coarse stamps by themselves.

    The time within the stamp's resolution is followed in ``PARTS``: stamps of a regular row, cut down, are far from
    independent. ``table`` is the law of exact intervals. An entry likelier to be none is left out of the chain.
    """
    here, there = np.full(PARTS, 1.0 / PARTS), np.zeros(PARTS)
    last = 0
    for k in range(1, len(still_s)):
        total = 0.0
        a, b = 2.0 * half_s[last] / PARTS, 2.0 * half_s[k] / PARTS
        begin = still_s[k] - half_s[k] + 0.5 * b - (still_s[last] - half_s[last] + 0.5 * a)
        for v in range(PARTS):
            there[v] = 0.0
            for u in range(PARTS):
                if here[u] > 1e-12:
                    there[v] += here[u] * interval_density(table, grid, begin + v * b - u * a)
            there[v] *= b
            total += there[v]
        density = total / (2.0 * half_s[k])
        own[k] = density + none[k]
        if density >= none[k]:
            last = k
            for v in range(PARTS):
                here[v] = there[v] / total


@kernel
def forward(
    bands: tuple[Integers, Integers, Integers], steps: Floats, per_still: Floats, per_event: Floats,
    weights: Floats, edges: tuple[Floats, Floats], states: Floats, scale: Floats,
) -> float:  # fmt: skip
    """Fill ``states`` (states, kinds) with the sum over all beginnings, row i times exp(-scale[i]); return the log sum.

    ``edges``: the logarithm of the weight of so many stills (events) alone at an end.
    """
    first, last, start = bands
    n, m = len(per_still), len(per_event)
    out = np.zeros(KINDS + 2)
    states[:] = 0.0
    scale[0] = 0.0
    for j in range(1, last[0] + 1):
        states[start[0] + j, EVENT] = math.exp(edges[1][j])
    begin = math.exp(edges[0][0])
    total = 0.0
    total_scale = -1e300
    for i in range(n + 1):
        if i > 0 and first[i] == 0:
            states[start[i], ALONE] += math.exp(edges[0][i] - scale[i])
        ended = 0.0
        for j in range(first[i], last[i] + 1):
            k = start[i] + j - first[i]
            if i == 0 and j == 0:  # nothing before the first pair
                if start[1] > k and m > 0 and first[1] <= 1 <= last[1]:
                    pair = begin * steps[k, 0] * per_still[0, 0] * per_event[0, 0] * per_event[0, 1]
                    states[start[1] + 1 - first[1], PAIR] += pair
                continue
            for kind in range(KINDS):
                value = states[k, kind]
                if value < LEAST:
                    continue
                _moves(i, j, kind, steps[k], per_still, per_event, weights, out)
                if i == n:
                    if j == m:
                        ended += value * math.exp(edges[1][0])
                    elif kind != EVENT:
                        ended += value * out[LAST_EVENTS] * math.exp(edges[1][m - j])
                elif j == m and kind != ALONE:
                    ended += value * out[LAST_STILLS] * math.exp(edges[0][n - i])
                if j < last[i]:
                    states[k + 1, EVENT] += value * out[EVENT]
                    states[k + 1, AGAIN] += value * out[AGAIN]
                if i < n:
                    if first[i + 1] <= j <= last[i + 1]:
                        below = start[i + 1] + j - first[i + 1]
                        states[below, ALONE] += value * out[ALONE]
                        states[below, COPY] += value * out[COPY]
                    if first[i + 1] <= j + 1 <= last[i + 1]:
                        states[start[i + 1] + j + 1 - first[i + 1], PAIR] += value * out[PAIR]
        if ended > 0.0:
            if scale[i] > total_scale:
                total = total * math.exp(total_scale - scale[i]) + ended if total > 0.0 else ended
                total_scale = scale[i]
            else:
                total += ended * math.exp(scale[i] - total_scale)
        if i < n:
            size = math.exp(edges[0][i + 1] - scale[i]) if first[i + 1] == 0 else 0.0
            for k in range(start[i + 1], start[i + 2]):
                for kind in range(KINDS):
                    size = max(size, states[k, kind])
            shrink = max(size, 1e-200) if size > 0.0 else 1.0
            scale[i + 1] = scale[i] + math.log(shrink)
            for k in range(start[i + 1], start[i + 2]):
                for kind in range(KINDS):
                    states[k, kind] /= shrink
    return total_scale + math.log(total) if total > 0.0 else -1e300


@kernel
def backward(
    bands: tuple[Integers, Integers, Integers], steps: Floats, per_still: Floats, per_event: Floats,
    weights: Floats, edges: tuple[Floats, Floats], states: Floats, scale: Floats,
) -> None:  # fmt: skip
    """Fill ``states`` with the sum over all continuations after each state, row i times exp(-scale[i])."""
    first, last, start = bands
    n, m = len(per_still), len(per_event)
    out = np.zeros(KINDS + 2)
    states[:] = 0.0
    scale[n] = 0.0
    for i in range(n, -1, -1):
        if i < n:
            scale[i] = scale[i + 1]
        greatest = 0.0
        for j in range(last[i], first[i] - 1, -1):
            k = start[i] + j - first[i]
            for kind in range(KINDS):
                value = 0.0
                if not (i == 0 and j == 0):
                    _moves(i, j, kind, steps[k], per_still, per_event, weights, out)
                    if i == n:
                        if j == m:
                            value = math.exp(edges[1][0] - scale[i])
                        elif kind != EVENT:
                            value = out[LAST_EVENTS] * math.exp(edges[1][m - j] - scale[i])
                    elif j == m and kind != ALONE:
                        value = out[LAST_STILLS] * math.exp(edges[0][n - i] - scale[i])
                    if j < last[i]:
                        value += out[EVENT] * states[k + 1, EVENT] + out[AGAIN] * states[k + 1, AGAIN]
                    if i < n:
                        if first[i + 1] <= j <= last[i + 1]:
                            below = start[i + 1] + j - first[i + 1]
                            value += out[ALONE] * states[below, ALONE] + out[COPY] * states[below, COPY]
                        if first[i + 1] <= j + 1 <= last[i + 1]:
                            value += out[PAIR] * states[start[i + 1] + j + 1 - first[i + 1], PAIR]
                states[k, kind] = value
                greatest = max(greatest, value)
        if greatest > 0.0:
            for k in range(start[i], start[i + 1]):
                for kind in range(KINDS):
                    states[k, kind] /= greatest
            scale[i] += math.log(greatest)


@kernel
def posterior(
    bands: tuple[Integers, Integers, Integers],
    before: tuple[Floats, Floats],
    after: tuple[Floats, Floats],
    log_sum: float,
    out: Floats,
) -> None:
    """Fill ``out`` (states, kinds) with the probability that the chain passes through each state."""
    _, _, start = bands
    for i in range(len(start) - 1):
        size = math.exp(min(before[1][i] + after[1][i] - log_sum, 700.0))
        for k in range(start[i], start[i + 1]):
            for kind in range(KINDS):
                out[k, kind] = before[0][k, kind] * after[0][k, kind] * size
