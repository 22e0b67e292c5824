"""The law of the intervals between exposures, as both sequences show it.

What a sequence shows has gaps where it missed an exposure itself. The law of the exposures' own intervals follows by
division in the frequency domain: if a share p is missed at random, the shown law is the mixture of sums of one, two,
three ... intervals with weights (1 - p) p^k. A gap that both sequences show alike is then as improbable as it should
be: otherwise a shift that makes the gap of one meet that of the other by chance would look far too good.
"""

from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array

BROAD_SHARE = 0.15
"""Of a density that is broad: intervals that the flight has not shown."""
AGAIN_WITHIN_S = 0.33
MOST_CELLS = 60_000
FINEST_S = 1e-3
MISSING_AT_LEAST = 0.05
"""Taken for the share missed when the own law is worked out: what is left of gaps that are the sequences' own would
make their meeting too likely; what is taken too much does no harm."""
ENOUGH_EVENTS = 12
"""With so many events, coarse stamps of stills have no say in the law."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IntervalLaw:
    """Histograms of the intervals shown, over cells from 0 s on, and how to smooth them."""

    event_counts: Array
    """(k,)."""
    still_counts: Array
    """(k,)."""
    event_share: float
    """In the exposures' own law; the stills have the rest."""
    widths_s: tuple[tuple[float, float], tuple[float, float]]
    """Bandwidths of events and of stills: that of their noise, and Silverman's."""
    step_s: float
    margin: int
    """Cells before 0 in the tables made of this, for intervals with noise."""
    median_s: float
    half_s: float
    """Half the resolution of stills."""

    @property
    def grid(self) -> Array:
        """Return first interval of the tables, cells in a second, scale and share of the tail beyond them."""
        return np.array([-self.margin * self.step_s, 1.0 / self.step_s, self.median_s, BROAD_SHARE])

    def of_exposures(self, events_missing: float, stills_missing: float) -> Array:
        """Return (3, cells) the density of the intervals of exposures that either sequence tells: between two events,
        an event and a still, two stills; the arguments are the shares that the sequences miss."""
        counts = (self.event_counts, self.still_counts)
        missing, shares = (events_missing, stills_missing), (self.event_share, 1.0 - self.event_share)
        law = np.zeros(len(self.event_counts))
        for shown, p, share, widths in zip(counts, missing, shares, self.widths_s, strict=True):
            if share > 0.0:
                law += share * self._smoothed(shown, max(p, MISSING_AT_LEAST), widths)
        both = events_missing * stills_missing
        return self._blurred((1.0 - both) * law + both * _sum_of_two(law, self.step_s))

    def of_several(self, events_missing: float, interval_s: Array) -> Array:
        """Return the density of an exposure so long (any shape) after another with one or more between the two."""
        k = len(self.event_counts)
        law = self._smoothed(self.event_counts, events_missing, self.widths_s[0])
        one = np.fft.rfft(law, 2 * k) * self.step_s
        total, power = np.zeros(k), np.asarray(one)
        for _ in range(int(k * self.step_s / self.median_s) + 1):
            power = one * np.fft.rfft(np.fft.irfft(power, 2 * k)[:k], 2 * k)
            total += np.fft.irfft(power, 2 * k)[:k]
        cells = np.asarray(interval_s) / self.step_s
        inside = np.interp(cells, np.arange(k), np.maximum(total / self.step_s, 0.0))
        usual = BROAD_SHARE / self.median_s
        return np.asarray(np.where(cells < k - 1, (1.0 - BROAD_SHARE) * inside + usual, 1.0 / self.median_s))

    def shown_by_events(self) -> Array:
        """Return (3, cells) the density of the intervals that the events show, gaps and all, as above."""
        return self._blurred(self._smoothed(self.event_counts, 0.0, self.widths_s[0]))

    def shown_by_stills(self) -> Array:
        """Return (3, cells) the same of the stills."""
        return self._blurred(self._smoothed(self.still_counts, 0.0, self.widths_s[1]))

    def _smoothed(self, counts: Array, missing: float, widths_s: tuple[float, float]) -> Array:
        """Return the density (k,) of the intervals' own law by the counts of those shown, half with either width."""
        k = len(counts)
        spectrum = np.fft.rfft(counts / max(float(counts.sum()), 1.0), 2 * k)
        own = spectrum / ((1.0 - missing) + missing * spectrum)
        angle = np.pi * np.arange(k + 1) / (k * self.step_s)
        gauss = [np.exp(-0.5 * (angle * width) ** 2) for width in widths_s]
        law = np.fft.irfft(own * 0.5 * (gauss[0] + gauss[1]), 2 * k)[:k] / self.step_s
        return np.asarray(np.maximum(law, 0.0), dtype=np.float64)

    def _blurred(self, law: Array) -> Array:
        """Return the law, mixed with the broad one, of exact times, and of stills at one or either end."""
        from scipy.ndimage import uniform_filter1d

        interval_s = np.arange(len(law)) * self.step_s
        broad = self.median_s / (interval_s + self.median_s) ** 2
        whole = np.concatenate([np.zeros(self.margin), (1.0 - BROAD_SHARE) * law + BROAD_SHARE * broad])
        width = max(1, round(2.0 * self.half_s / self.step_s))
        once = uniform_filter1d(whole, width, mode="nearest")
        twice = uniform_filter1d(once, width, mode="nearest")
        return np.asarray(np.maximum(np.array([whole, once, twice]), 1e-9), dtype=np.float64)


def fast_length(least: int) -> int:
    """Return the smallest power of 2 or 3 times one that is at least so great."""
    power = 1 << max(least - 1, 1).bit_length()
    return 3 * power // 4 if 3 * power // 4 >= least else power


def _sum_of_two(law: Array, step_s: float) -> Array:
    """Return the density of the sum of two intervals."""
    spectrum = np.fft.rfft(law, 2 * len(law))
    return np.asarray(np.maximum(np.fft.irfft(spectrum**2, 2 * len(law))[: len(law)], 0.0) * step_s, dtype=np.float64)


def interval_law(still_s: Array, half_s: float, event_s: Array, noise_s: float) -> IntervalLaw:
    """Return the law of two rising sequences, (n,) and (m,)."""
    events, stills = np.diff(event_s), np.diff(still_s)
    every = np.concatenate([events, stills]) if len(events) + len(stills) else np.ones(1)
    real = every[every > AGAIN_WITHIN_S]
    median = float(np.median(real)) if len(real) else max(float(np.median(every)), 0.1)
    length = float(np.clip(12.0 * median, 20.0, 300.0))
    step = max(min(0.4 * noise_s, 0.02 * median), FINEST_S, length / MOST_CELLS)
    count = fast_length(int(length / step))
    cells = (np.arange(count + 1) - 0.5) * step
    coarse = half_s > 2.0 * noise_s and len(events) >= ENOUGH_EVENTS
    alone = 1.0 if coarse or len(stills) == 0 else 0.6
    return IntervalLaw(
        event_counts=np.histogram(events, bins=cells)[0].astype(np.float64),
        still_counts=np.histogram(stills, bins=cells)[0].astype(np.float64),
        event_share=alone if len(events) else 0.0,
        widths_s=(_widths(events, noise_s), _widths(stills, noise_s + 0.6 * half_s)),
        step_s=step,
        margin=int(np.ceil((4.0 * half_s + 0.5) / step)),
        median_s=median,
        half_s=half_s,
    )


def _widths(values: Array, blur_s: float) -> tuple[float, float]:
    fine = 1.5 * blur_s
    if len(values) < 2:
        return fine, fine
    spread = min(float(np.std(values)), float(np.subtract(*np.percentile(values, [75, 25]))) / 1.34)
    return fine, max(fine, 0.9 * spread * len(values) ** -0.2)


def density_of(table: Array, grid: Array, interval_s: Array) -> Array:
    """Return the density of intervals of any shape by a table of cells."""
    cells = (interval_s - grid[0]) * grid[1]
    inside = np.interp(cells, np.arange(len(table)), table)
    beyond = grid[3] * grid[2] / (np.maximum(interval_s, 0.0) + grid[2]) ** 2
    return np.asarray(np.where(cells >= len(table) - 1, beyond, np.where(cells < 0.0, 1e-9, inside)), dtype=np.float64)
