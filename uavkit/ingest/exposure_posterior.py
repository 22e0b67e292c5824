"""The probability of each pair over all settings of the camera's clock that matter, and of there being no relation."""

from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.ingest.exposure_chain import OFFSETS_S, Chain, rates_seen, with_noise, with_rates
from uavkit.ingest.exposure_clocks import (
    NEAR_BEST,
    ClockLimits,
    WeighedClock,
    best_clocks,
    fitted_with_covariance,
    same_clock,
    searched,
)
from uavkit.ingest.exposure_sums import Clock, Pairs, log_sum, pairs_of

NEGLIGIBLE = 9.0
"""Settings whose logarithm is so much lower than the best are left out of the sum."""
NOISE_STRENGTH = 4.0
"""As if the noise a priori came from so many pairs."""
NO_RELATION = 0.05
"""Probability a priori that the events are not those of the stills."""
LOG_NO_RELATION = float(np.log(NO_RELATION / (1.0 - NO_RELATION)))
HOPELESS = 0.9
"""A shift less probable than this is of no use."""
SHARE_TO_GO_ON = 0.5
SHIFT_TRUST = 0.75
"""Odds between shifts, and against no relation, are taken to this power: that the law of intervals and the rates of
defects are estimates is an error that all pairs of a shift have in common."""
LEAST_SHARE, LEAST_SHARE_IF_OPEN = 1e-5, 0.02
"""Settings less probable are left out of the pairs' probabilities; where all is open these only serve to tell why."""
MOST_SETTINGS = 1500


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """What is known after all; k pairs that are not quite impossible."""

    still: Indices
    event: Indices
    probability: Array
    again: Array
    """(m,) of each event to tell the exposure before it once more."""
    copy: Array
    """(n,)."""
    unrelated: float
    """Probability that stills and events have nothing to do with one another."""
    modes: Array
    """Probabilities of shifts apart from one another, the greatest first."""
    clock: Clock
    sigma_offset_s: float
    sigma_drift: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Region:
    """Settings about one best, with the logarithm of sum times prior of each."""

    clocks: list[Clock]
    log_weights: Array
    blur_s: Array | float


def posterior(chain: Chain, limits: ClockLimits) -> Posterior | None:
    """Return the probabilities of all pairs; None where no setting of the clock gives a pair."""
    modes = best_clocks(chain, limits)
    if not modes or modes[0].log_sum < -1e299:
        return None
    for _ in range(2):
        seen = pairs_of(chain, modes[0].clock, 0.0)
        chain = with_rates(chain, rates_seen(chain, (seen.still_alone, seen.event_alone), (seen.copy, seen.again)))
        chain = with_noise(chain, _noise_seen(chain, seen, modes[0].clock))
    regions: list[_Region] = []
    grids: list[_Grid] = []
    for mode in _at_their_best(chain, modes, limits):
        if any(grid.holds(mode.clock) for grid in grids):
            continue
        grid = _Grid(chain, mode.clock, limits)
        region = grid.explored()
        if len(region.clocks) == 0:
            continue
        regions.append(region)
        grids.append(grid)
        if _open_already(regions):
            break
    return _summed(chain, regions, limits) if regions else None


def _noise_seen(chain: Chain, pairs: Pairs, clock: Clock) -> float:
    """Return the standard deviation of residuals over that expected; 1 for coarse stamps, which do not tell."""
    if chain.coarse or len(pairs.still) == 0:
        return 1.0
    residual_s = clock.event_time_s(chain.still_s[pairs.still]) - chain.event_s[pairs.event]
    variance = chain.sigma_s[pairs.event] ** 2 + chain.half_s[pairs.still] ** 2 / 3.0
    square = np.minimum(residual_s**2 / variance, 16.0)
    total = NOISE_STRENGTH + float(pairs.probability.sum())
    return float(np.clip(np.sqrt((NOISE_STRENGTH + float(pairs.probability @ square)) / total), 0.3, 3.0))


def _at_their_best(chain: Chain, modes: list[WeighedClock], limits: ClockLimits) -> list[WeighedClock]:
    """Return the modes at their best settings, the best first; fewer where so many are as good that all stays open."""
    found: list[WeighedClock] = []
    for mode in modes:
        one = searched(chain, mode, limits) if chain.coarse else mode
        if not any(same_clock(one.clock, other.clock, chain) for other in found):
            found.append(one)
        top = max(entry.log_sum for entry in found)
        if sum(np.exp(entry.log_sum - top) for entry in found) > 1.0 / SHARE_TO_GO_ON:
            break
    return [e for e in sorted(found, key=lambda e: -e.log_sum) if e.log_sum > top - NEAR_BEST]


def _open_already(regions: list[_Region]) -> bool:
    """Tell whether no region can be the only one any more: then the others need not be looked at."""
    return bool(_shares(regions)[:-1].max() < HOPELESS)


class _Grid:
    """Settings of offset and drift about a best one, visited from it outwards as far as they matter."""

    def __init__(self, chain: Chain, clock: Clock, limits: ClockLimits) -> None:
        self._chain, self._limits = chain, limits
        pairs = pairs_of(chain, clock, 0.0)
        chosen = (pairs.still, pairs.event, pairs.probability)
        covariance = fitted_with_covariance(chain, chosen, limits)[1] if len(pairs.still) else np.eye(2)
        middle = float(np.average(chain.event_s[pairs.event], weights=pairs.probability)) if len(pairs.still) else 0.0
        self._clock = clock.about(middle)
        noise = chain.noise_s
        arm = np.abs(chain.event_s - middle)
        wide = float(np.sqrt(np.average(arm[pairs.event] ** 2, weights=pairs.probability))) if len(pairs.still) else 1.0
        self._step_s = max(0.5 * noise, 0.9 * float(np.sqrt(covariance[0, 0])))
        self._step_drift = min(max(self._step_s / max(wide, 1e-3), 1e-8), limits.greatest_drift)
        self._visited: dict[tuple[int, int], float] = {}
        self.blur_s = np.sqrt((self._step_s**2 + (self._step_drift * arm) ** 2) / 12.0)

    def holds(self, clock: Clock) -> bool:
        """Tell whether a setting was visited and counts."""
        there = clock.about(self._clock.reference_s)
        a = round((there.offset_s - self._clock.offset_s) / self._step_s)
        b = round((there.drift - self._clock.drift) / self._step_drift)
        best = max(self._visited.values())
        return self._visited.get((a, b), -np.inf) > best - NEGLIGIBLE

    def explored(self) -> _Region:
        """Return all settings about the mode that are not negligible beside its best."""
        todo = [(0, 0)]
        best = self._weigh((0, 0))
        while todo and len(self._visited) < MOST_SETTINGS:
            a, b = todo.pop(0)
            if self._visited[a, b] < best - NEGLIGIBLE:
                continue
            for cell in ((a + 1, b), (a - 1, b), (a, b + 1), (a, b - 1)):
                if cell not in self._visited:
                    best = max(best, self._weigh(cell))
                    todo.append(cell)
        kept = [cell for cell, value in self._visited.items() if value > max(best - NEGLIGIBLE, -1e200)]
        return _Region(
            clocks=[self._at(cell) for cell in kept],
            log_weights=np.array([self._visited[cell] for cell in kept]),
            blur_s=self.blur_s,
        )

    def _at(self, cell: tuple[int, int]) -> Clock:
        return self._clock.moved(cell[0] * self._step_s, cell[1] * self._step_drift)

    def _weigh(self, cell: tuple[int, int]) -> float:
        clock = self._at(cell)
        if abs(clock.drift) > self._limits.greatest_drift + 0.5 * self._step_drift:
            value = -np.inf
        else:
            value = log_sum(self._chain, clock, self.blur_s) + self._log_prior(clock.drift)
        self._visited[cell] = value
        return value

    def _log_prior(self, drift: float) -> float:
        from scipy.special import ndtr

        half, sigma = 0.5 * self._step_drift, self._limits.sigma_drift
        share = float(ndtr((drift + half) / sigma) - ndtr((drift - half) / sigma))
        low, high = self._limits.offsets_s or (0.0, OFFSETS_S)
        return float(np.log(max(share, 1e-12)) + np.log(self._step_s / max(high - low, self._step_s)))


def _shares(regions: list[_Region]) -> Array:
    """Return the probability of each region, and of no relation (the last)."""
    logs = np.array([float(np.logaddexp.reduce(region.log_weights)) for region in regions] + [LOG_NO_RELATION])
    weights = np.exp(SHIFT_TRUST * (logs - logs.max()))
    return np.asarray(weights / weights.sum(), dtype=np.float64)


def _summed(chain: Chain, regions: list[_Region], limits: ClockLimits) -> Posterior:
    """Return the mean over all settings by their weights."""
    n, m = len(chain.still_s), len(chain.event_s)
    shares = _shares(regions)
    least = LEAST_SHARE if float(shares[:-1].max()) > HOPELESS else LEAST_SHARE_IF_OPEN
    keys, values = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
    again, copy = np.zeros(m), np.zeros(n)
    best: tuple[float, Pairs | None] = (-np.inf, None)
    for region, share in zip(regions, shares[:-1].tolist(), strict=True):
        weights = np.exp(region.log_weights - region.log_weights.max())
        weights *= share / weights.sum()
        for clock, weight in zip(region.clocks, weights.tolist(), strict=True):
            if weight < least:
                continue
            pairs = pairs_of(chain, clock, region.blur_s)
            keys.append(pairs.still * m + pairs.event)
            values.append(weight * pairs.probability)
            again += weight * pairs.again
            copy += weight * pairs.copy
            if weight > best[0]:
                best = (weight, pairs)
    key, inverse = np.unique(np.concatenate(keys), return_inverse=True)
    total = np.bincount(inverse, weights=np.concatenate(values), minlength=len(key))
    clock, sigma_offset, sigma_drift = _clock(chain, regions, best[1], limits)
    return Posterior(
        still=key // m,
        event=key % m,
        probability=np.asarray(total, dtype=np.float64),
        again=again,
        copy=copy,
        unrelated=float(shares[-1]),
        modes=np.sort(shares[:-1])[::-1],
        clock=clock,
        sigma_offset_s=sigma_offset,
        sigma_drift=sigma_drift,
    )


def _clock(
    chain: Chain, regions: list[_Region], pairs: Pairs | None, limits: ClockLimits
) -> tuple[Clock, float, float]:
    """Return the mean setting of the best region and its standard deviations: of the fit, or of the settings."""
    region = max(regions, key=lambda one: float(one.log_weights.max()))
    weights = np.exp(region.log_weights - region.log_weights.max())
    weights /= weights.sum()
    reference = region.clocks[0].reference_s
    offsets = np.array([clock.offset_s for clock in region.clocks])
    drifts = np.array([clock.drift for clock in region.clocks])
    offset, drift = float(weights @ offsets), float(weights @ drifts)
    sigmas = [float(np.sqrt(weights @ (offsets - offset) ** 2)), float(np.sqrt(weights @ (drifts - drift) ** 2))]
    if pairs is not None and len(pairs.still):
        chosen = (pairs.still, pairs.event, pairs.probability)
        fit, covariance = fitted_with_covariance(chain, chosen, limits)
        if not chain.coarse:
            fit = fit.about(reference)
            offset, drift = fit.offset_s, fit.drift
        sigmas = [max(sigmas[0], float(np.sqrt(covariance[0, 0]))), max(sigmas[1], float(np.sqrt(covariance[1, 1])))]
    return Clock(offset_s=offset, drift=drift, reference_s=reference), sigmas[0], sigmas[1]
