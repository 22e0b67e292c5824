"""The sum over all alignments of a chain at one setting of the camera's clock, and what each pair has of it."""

from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.ingest.exposure_chain import Chain, bands_of

NOISE_WIDTH = 10.0
"""States are kept within so many standard deviations of equal times."""
LEAST_SHARE = 1e-7


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """A setting of the camera's clock: still = ``reference_s`` + ``offset_s`` + (1 + drift) (event - reference)."""

    offset_s: float
    drift: float
    reference_s: float

    def moved(self, offset_s: float, drift: float) -> "Clock":
        """Return the clock with this much more offset and drift."""
        return Clock(offset_s=self.offset_s + offset_s, drift=self.drift + drift, reference_s=self.reference_s)

    def about(self, reference_s: float) -> "Clock":
        """Return the same clock with its offset told at another time."""
        moved = self.offset_s + self.drift * (reference_s - self.reference_s)
        return Clock(offset_s=moved, drift=self.drift, reference_s=reference_s)

    def event_time_s(self, still_s: Array) -> Array:
        """Return times of stills as the clock of the events has them."""
        return self.reference_s + (still_s - self.offset_s - self.reference_s) / (1.0 + self.drift)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairs:
    """What the sum over all alignments says of each pair; k pairs that are not quite impossible."""

    log_sum: float
    still: Indices
    """(k,) rows."""
    event: Indices
    """(k,)."""
    probability: Array
    """(k,)."""
    again: Array
    """(m,) probability that an event tells the exposure before it once more."""
    copy: Array
    """(n,) the same of stills."""
    still_alone: Array
    """(n,) probability that no event tells a still's exposure, other than at the ends."""
    event_alone: Array
    """(m,)."""


def log_sum(chain: Chain, clock: Clock, blur_s: float | Array) -> float:
    """Return the logarithm of the sum over all alignments over that of no relation; ``blur_s`` is more noise."""
    bands, steps = _prepare(chain, clock, blur_s)
    return _forward(chain, bands, steps)[0]


def _prepare(chain: Chain, clock: Clock, blur_s: float | Array) -> tuple[tuple[Indices, Indices, Indices], Array]:
    from uavkit.ingest.kernels.alignment import fill_steps

    still_s = clock.event_time_s(chain.still_s)
    sigma = np.sqrt(chain.sigma_s**2 + np.square(blur_s))
    reach = chain.half_s + NOISE_WIDTH * float(sigma.max())
    bands = bands_of(still_s - reach, still_s + reach, chain.event_s)
    steps = np.empty((int(bands[2][-1]), 4))
    fill_steps((still_s, chain.half_s), (chain.event_s, sigma), bands, chain.tables, chain.grid, steps)
    return bands, steps


def _forward(chain: Chain, bands: tuple[Indices, Indices, Indices], steps: Array) -> tuple[float, Array, Array]:
    from uavkit.ingest.kernels.alignment import KINDS, forward

    states, scale = np.empty((len(steps), KINDS)), np.empty(len(chain.still_s) + 1)
    edges = (chain.still_edge, chain.event_edge)
    total = forward(bands, steps, chain.per_still, chain.per_event, chain.weights, edges, states, scale)
    return float(total), states, scale


def pairs_of(chain: Chain, clock: Clock, blur_s: float | Array) -> Pairs:
    """Return the probability of each pair at one setting of the clock."""
    from uavkit.ingest.kernels.alignment import AGAIN, ALONE, COPY, EVENT, KINDS, PAIR, backward, posterior

    n, m = len(chain.still_s), len(chain.event_s)
    bands, steps = _prepare(chain, clock, blur_s)
    total, before, before_scale = _forward(chain, bands, steps)
    after, after_scale = np.empty_like(before), np.empty_like(before_scale)
    edges = (chain.still_edge, chain.event_edge)
    backward(bands, steps, chain.per_still, chain.per_event, chain.weights, edges, after, after_scale)
    shares = np.zeros((len(steps), KINDS))
    if total > -1e299:
        posterior(bands, (before, before_scale), (after, after_scale), total, shares)
    if not float(shares.max(initial=0.0)) < 1.0 + 1e-6:  # sums so small that they were lost: nothing fits here
        shares[:] = 0.0
    row = np.repeat(np.arange(n + 1), np.diff(bands[2]))
    told = np.arange(len(steps)) - bands[2][row] + bands[0][row]
    k = np.flatnonzero(shares[:, PAIR] > LEAST_SHARE)
    midst = (row > 0) & (row < n) & (told > 0) & (told < m)
    return Pairs(
        log_sum=total,
        still=row[k] - 1,
        event=told[k] - 1,
        probability=shares[k, PAIR],
        again=_total(told, shares[:, AGAIN], m),
        copy=_total(row, shares[:, COPY], n),
        still_alone=_total(row, shares[:, ALONE] * midst, n),
        event_alone=_total(told, shares[:, EVENT] * midst, m),
    )


def _total(told: Indices, shares: Array, count: int) -> Array:
    """Return (count,) the sum of the shares of all states that have told so many entries, the first at least."""
    return np.asarray(np.bincount(told, weights=shares, minlength=count + 1)[1:], dtype=np.float64)
