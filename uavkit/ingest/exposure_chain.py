"""How stills and exposure events come about, as a chain of exposures of which each sequence tells most.

The model, with nothing fitted to a certain flight:

* One exposure follows another after an interval. The law of intervals is that which the sequences show, mixed with a
  broad one (``exposure_intervals``): where the flight is regular, an entry without partner is as well predicted as a
  pair, and a shift by one costs little.
* An exposure is told by both sequences, or by one alone (``Rates`` each; runs of them are likelier than so many
  single ones). At the ends, where recordings begin late or stop early, k entries alone have the probability
  ``END_SHARE`` / (k (k + 1)), in the midst each costs.
* An event may tell an exposure again within ``AGAIN_WITHIN_S``, or at any time tell what was none; stills likewise.
  Such entries do not break the chain.
* The rates of these defects are unknown: Beta distributed a priori, and taken from the flight itself as it shows them.
* A stamp of resolution r is the time by the camera's clock cut down: uniform over r, with Gaussian noise and a tail
  (see ``kernels.alignment.residual_density``).
"""

from dataclasses import dataclass, replace

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.ingest.exposure_intervals import AGAIN_WITHIN_S, IntervalLaw, density_of, interval_law

RUN_SHARE = 0.4
"""After one entry alone the next is so too with this probability."""
END_SHARE = 0.4
OFFSETS_S = 86_400.0
"""The range over which the camera's clock may be off, for weighing a match against none."""
LEAST_HALF_S = 0.5e-3


RATE_STRENGTH = 20.0
"""As if the rates a priori came from so many exposures."""
GREATEST_RATE = 0.3
"""A flight of which more than this is amiss is one that does not match."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rates:
    """Defects in an exposure, of each sequence."""

    still_alone: float = 0.05
    """An exposure that no event tells."""
    event_alone: float = 0.05
    event_again: float = 0.03
    event_false: float = 0.03
    still_again: float = 0.02
    still_false: float = 0.03


PRIOR_RATES = Rates()


@dataclass(frozen=True, slots=True, kw_only=True)
class Chain:
    """Both sequences, rising, in seconds from times of their own, with all weights that do not depend on the clock."""

    still_s: Array
    """(n,) middle of the interval in which each stamp says the exposure was, by the camera's clock."""
    half_s: Array
    """(n,) half the resolution."""
    event_s: Array
    """(m,)."""
    sigma_s: Array
    """(m,) of a still's time against the event's, the resolution left out."""
    per_still: Array
    """(n, 3): see ``kernels.alignment``."""
    per_event: Array
    """(m, 5)."""
    tables: Array
    """(3, cells) density of intervals: of two events, of an event and a still, of two stills."""
    grid: Array
    """(4,) first interval, cells in a second, scale and share of the tail beyond the table."""
    weights: Array
    """(kinds, kinds) a priori from one kind to the next."""
    still_edge: Array
    """(n + 1,) logarithm of the probability of k stills alone at an end."""
    event_edge: Array
    """(m + 1,)."""
    law: IntervalLaw
    interval_s: float
    """Median."""
    noise_s: float
    """Median of ``sigma_s``."""
    typical_half_s: float
    """Median of ``half_s``."""
    rates: Rates

    @property
    def coarse(self) -> bool:
        """Whether stamps are cut down by much more than the noise."""
        return self.typical_half_s > 2.0 * self.noise_s


def build_chain(still_s: Array, half_s: Array, event_s: Array, sigma_s: Array, rates: Rates = PRIOR_RATES) -> Chain:
    """Return the chain of rising times (n,) of stills (middles of their intervals) and (m,) of events."""
    half = np.maximum(half_s, LEAST_HALF_S)
    typical_half = float(np.median(half))
    noise = float(np.median(sigma_s))
    law = interval_law(still_s, typical_half, event_s, noise)
    chain = Chain(
        still_s=still_s,
        half_s=half,
        event_s=event_s,
        sigma_s=sigma_s,
        per_still=np.zeros((len(still_s), 3)),
        per_event=np.zeros((len(event_s), 5)),
        tables=np.zeros((3, 1)),
        grid=law.grid,
        weights=np.zeros((5, 5)),
        still_edge=_edge(len(still_s)),
        event_edge=_edge(len(event_s)),
        law=law,
        interval_s=law.median_s,
        noise_s=noise,
        typical_half_s=typical_half,
        rates=rates,
    )
    return with_rates(chain, rates)


def with_rates(chain: Chain, rates: Rates) -> Chain:
    """Return the same chain with other rates of defects."""
    tables = chain.law.of_exposures(events_missing=rates.still_alone, stills_missing=rates.event_alone)
    return replace(
        chain,
        tables=tables,
        per_still=_per_still(chain, tables, rates),
        per_event=_per_event(chain, tables, rates),
        weights=_weights(rates),
        rates=rates,
    )


def with_noise(chain: Chain, factor: float) -> Chain:
    """Return the same chain with the noise so many times as great."""
    return chain if factor == 1.0 else replace(chain, sigma_s=factor * chain.sigma_s, noise_s=factor * chain.noise_s)


def _weights(rates: Rates) -> Array:
    """Return (5, 5) from PAIR, ALONE, EVENT, AGAIN, COPY to the same."""
    still, event = rates.still_alone, rates.event_alone
    usual = [1.0 - still - event, still, event, 1.0, 1.0]
    run = max(RUN_SHARE, still, event)
    after_still = [1.0 - run - event, run, event, 0.0, 0.0]
    after_event = [1.0 - run - still, still, run, 1.0, 1.0]
    return np.array([usual, after_still, after_event, usual, usual])


def _edge(count: int) -> Array:
    k = np.arange(1, count + 1, dtype=np.float64)
    return np.concatenate([[np.log(1.0 - END_SHARE)], np.log(END_SHARE / (k * (k + 1.0)))])


def told_again(gap_s: Array, resolution_s: float) -> Array:
    """Return the density of the time from an exposure to its being told again."""
    within = AGAIN_WITHIN_S + resolution_s
    return np.asarray(1.0 / within / (1.0 + np.exp(np.minimum((gap_s - within) / 0.02, 60.0))), dtype=np.float64)


def told_falsely(gap_s: Array, interval_s: float) -> Array:
    """Return the density of the time from an exposure to an entry that tells what was none."""
    return np.asarray(np.exp(-gap_s / interval_s) / interval_s, dtype=np.float64)


def _per_still(chain: Chain, tables: Array, rates: Rates) -> Array:
    """Return (n, 3): see ``_entries``. A chain of stills alone is given the law that explains it best."""
    from uavkit.ingest.kernels.alignment import own_stamps

    gap = np.diff(chain.still_s)
    none = rates.still_again * told_again(gap, 2.0 * chain.typical_half_s)
    none += rates.still_false * told_falsely(gap, chain.interval_s)
    by_stills = chain.law.shown_by_stills()
    entries = _entries(chain.still_s, none, (tables[2], by_stills[2]), chain.grid)[:, :3]
    if not chain.coarse:
        return entries
    own, no_exposure = 1.0 / entries[:, 0], np.concatenate([[0.0], none])
    chains = [own]
    for law in (by_stills[0], chain.law.shown_by_events()[0]):
        chains.append(own.copy())
        own_stamps(chain.still_s, chain.half_s, law, chain.grid, no_exposure, chains[-1])
    best = max(chains, key=lambda one: float(np.log(one).sum()))
    return np.column_stack([1.0 / best, entries[:, 1], no_exposure / best])


def _per_event(chain: Chain, tables: Array, rates: Rates) -> Array:
    gap = np.diff(chain.event_s)
    none = rates.event_again * told_again(gap, 0.0) + rates.event_false * told_falsely(gap, chain.interval_s)
    entries = _entries(chain.event_s, none, (tables[0], chain.law.shown_by_events()[0]), chain.grid)
    several = np.full(len(chain.event_s), -1.0)
    if chain.coarse:
        several[1:] = chain.law.of_several(rates.still_alone, gap)
    return np.column_stack([entries, several])


def rates_seen(chain: Chain, alone: tuple[Array, Array], none: tuple[Array, Array]) -> Rates:
    """Return the rates a posteriori: ``alone`` (n,), (m,) probability that no partner tells a still's (an event's)
    exposure, ends left out; ``none`` (n,), (m,) that it is no exposure, or one told again."""
    exposures = RATE_STRENGTH + min(len(chain.still_s), len(chain.event_s))
    prior, rates = PRIOR_RATES, chain.rates

    def rate(before: float, count: float) -> float:
        return min((RATE_STRENGTH * before + count) / exposures, GREATEST_RATE)

    again = []
    for times_s, resolution, share, false in (
        (chain.still_s, 2.0 * chain.typical_half_s, rates.still_again, rates.still_false),
        (chain.event_s, 0.0, rates.event_again, rates.event_false),
    ):
        gap = np.diff(times_s, prepend=times_s[0])
        told = share * told_again(gap, resolution)
        again.append(told / (told + false * told_falsely(gap, chain.interval_s)))
    return Rates(
        still_alone=rate(prior.still_alone, float(alone[0].sum())),
        event_alone=rate(prior.event_alone, float(alone[1].sum())),
        still_again=rate(prior.still_again, float(none[0] @ again[0])),
        still_false=rate(prior.still_false, float(none[0] @ (1.0 - again[0]))),
        event_again=rate(prior.event_again, float(none[1] @ again[1])),
        event_false=rate(prior.event_false, float(none[1] @ (1.0 - again[1]))),
    )


def _entries(times_s: Array, none: Array, laws: tuple[Array, Array], grid: Array) -> Array:
    """Return (k, 4): 1 / density in a chain of its own, density of the interval before, that of being no exposure over
    the first, density of the interval over two. ``laws``: of the exposures, and of what the sequences show."""
    from uavkit.ingest.kernels.alignment import own_chain

    once, twice = np.diff(times_s), times_s[2:] - times_s[:-2]
    (interval, over_two), (own_interval, own_over_two) = (
        (
            np.concatenate([[1.0 / OFFSETS_S], density_of(law, grid, once)]),
            np.concatenate([np.full(min(2, len(times_s)), 1e-9), density_of(law, grid, twice)]),
        )
        for law in laws
    )
    no_exposure, own = np.concatenate([[0.0], none]), np.empty(len(times_s))
    own_chain(own_interval, own_over_two, no_exposure, own)
    return np.column_stack([1.0 / own, interval, no_exposure / own, over_two])


def bands_of(low_s: Array, high_s: Array, event_s: Array) -> tuple[Indices, Indices, Indices]:
    """Return for rows 0 ... n first and last number of events told, and where each row starts, (n + 1,), (n + 2,) last.

    Still i may be any time between ``low_s`` and ``high_s`` (n,): of the events, those before ``low_s`` of the still
    told last have been told, those after ``high_s`` of the next have not.
    """
    n, m = len(low_s), len(event_s)
    low = np.minimum.accumulate(low_s[::-1])[::-1]
    high = np.maximum.accumulate(high_s)
    first = np.zeros(n + 1, dtype=np.int64)
    first[1:] = np.searchsorted(event_s, low, side="left")
    last = np.full(n + 1, m, dtype=np.int64)
    last[:n] = np.searchsorted(event_s, high, side="right")
    last = np.maximum(last, first)
    start = np.concatenate([[0], np.cumsum(last - first + 1)]).astype(np.int64)
    return first, last, start
