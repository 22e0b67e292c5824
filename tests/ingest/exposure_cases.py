"""Random flights with known truth: stills by the camera's clock, events by GPS time, and what belongs together.

Nothing here is known to the matcher: intervals, rates of what is missing, doubled or spurious, noise, drift.
"""

from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Indices


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseLaw:
    """By what a case was drawn; the oracle may know it, the matcher may not."""

    hover: bool
    resolution_s: float
    interval_s: float
    interval_noise_s: float
    """Standard deviation of the regular intervals."""
    turn_share: float
    """Share of the intervals that hold a turn."""
    jitter_s: float
    event_missing: float
    event_doubled: float
    event_spurious: float
    still_missing: float
    still_spurious: float
    cut_share: float
    """Probability that a recording begins late, and that it ends early."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One flight; n stills, m events."""

    law: CaseLaw
    still_s: Array
    """(n,) stamps, cut down."""
    taken_s: Array
    """(n,) when each still was truly taken, by GPS time."""
    event_s: Array
    """(m,)."""
    still_exposure: Indices
    """(n,) number of the exposure, -1 for a spurious still."""
    event_exposure: Indices
    """(m,), -1 for a spurious event."""
    event_is_double: "np.typing.NDArray[np.bool_]"
    """(m,) tells an exposure for the second time."""
    offset_s: float
    drift: float

    def true_event(self) -> Indices:
        """Return (n,) the event of each still, -1 where there is none."""
        rows = {int(x): j for j, x in enumerate(self.event_exposure) if x >= 0 and not self.event_is_double[j]}
        return np.array([rows.get(int(x), -1) if x >= 0 else -1 for x in self.still_exposure], dtype=np.int64)


def draw_law(rng: np.random.Generator, *, hover: bool, resolution_s: float) -> CaseLaw:
    """Draw noise, and on either side up to 10 % missing, doubled or spurious, parted at random among these."""
    events = rng.uniform(0.0, 0.1) * rng.dirichlet(np.ones(3))
    stills = rng.uniform(0.0, 0.1) * rng.dirichlet(np.ones(2))
    interval = float(rng.uniform(1.5, 6.0))
    steady, windy = float(np.exp(rng.uniform(np.log(0.005), np.log(0.08)))), interval * float(rng.uniform(0.03, 0.1))
    return CaseLaw(
        hover=hover,
        resolution_s=resolution_s,
        interval_s=interval,
        interval_noise_s=steady if hover else windy,
        turn_share=0.0 if hover else float(rng.uniform(0.04, 0.12)),
        jitter_s=float(rng.uniform(0.005, 0.025)),
        event_missing=float(events[0]),
        event_doubled=float(events[1]),
        event_spurious=float(events[2]),
        still_missing=float(stills[0]),
        still_spurious=float(stills[1]),
        cut_share=float(rng.choice([0.0, 0.3])),
    )  # fmt: skip


def draw_case(rng: np.random.Generator, law: CaseLaw, exposures: int) -> Case:
    """Draw a flight of so many exposures."""
    time = draw_times(rng, law, exposures)
    number = np.arange(exposures)
    event = _cut(rng, law, number[rng.random(exposures) >= law.event_missing])
    still = _cut(rng, law, number[rng.random(exposures) >= law.still_missing])
    twice = event[rng.random(len(event)) < law.event_doubled]
    event_s = time[event]
    rows = [(t, int(k), False) for t, k in zip(event_s, event, strict=True)]
    rows += [(float(time[k] + rng.uniform(0.010, 0.300)), int(k), True) for k in twice]
    rows += [(t, -1, False) for t in _spurious(rng, law.event_spurious, event_s)]
    rows.sort()
    offset, drift = float(rng.uniform(-43200.0, 43200.0)), float(rng.uniform(-100e-6, 100e-6))
    taken = time[still] + rng.normal(0.0, law.jitter_s, len(still))
    shots = [(float(t), int(k)) for t, k in zip(taken, still, strict=True)]
    shots += [(t, -1) for t in _spurious(rng, law.still_spurious, taken)]
    shots.sort()
    exact = np.array([t * (1.0 + drift) + offset for t, _ in shots])
    return Case(
        law=law,
        still_s=np.floor(exact / law.resolution_s) * law.resolution_s,
        taken_s=np.array([t for t, _ in shots]),
        event_s=np.array([t for t, _, _ in rows]),
        still_exposure=np.array([k for _, k in shots], dtype=np.int64),
        event_exposure=np.array([k for _, k, _ in rows], dtype=np.int64),
        event_is_double=np.array([d for _, _, d in rows], dtype=bool),
        offset_s=offset,
        drift=drift,
    )


def draw_times(rng: np.random.Generator, law: CaseLaw, exposures: int) -> Array:
    """Return rising times (exposures,) of a hover or a distance flight."""
    gaps = law.interval_s + rng.normal(0.0, law.interval_noise_s, exposures)
    if not law.hover:
        turn = rng.random(exposures) < law.turn_share
        strip = np.cumsum(turn) % 2  # with the wind and against it
        gaps *= np.where(strip == 1, 1.0 + rng.uniform(0.0, 0.25), 1.0)
        gaps += np.where(turn, rng.uniform(3.0, 20.0, exposures), 0.0)
    return np.asarray(rng.uniform(0.0, 1000.0) + np.cumsum(np.maximum(gaps, 0.4)), dtype=np.float64)


def _cut(rng: np.random.Generator, law: CaseLaw, rows: Indices) -> Indices:
    """Return the rows without up to a fifth at either end."""
    most = max(1, len(rows) // 5)
    begin = int(rng.integers(1, most + 1)) if rng.random() < law.cut_share else 0
    end = int(rng.integers(1, most + 1)) if rng.random() < law.cut_share else 0
    return rows[begin : len(rows) - end]


def _spurious(rng: np.random.Generator, rate: float, times: Array) -> list[float]:
    count = int(rng.binomial(len(times), rate))
    return [float(t) for t in rng.uniform(times[0], times[-1], count)]


def by_index(case: Case) -> Indices:
    """Pair first with first, second with second: what many tools do."""
    n, m = len(case.still_s), len(case.event_s)
    return np.where(np.arange(n) < m, np.arange(n), -1)


def by_nearest_time(case: Case) -> Indices:
    """Set the clock by the first still and the first event, then take the nearest event within half an interval."""
    moved = case.still_s - (case.still_s[0] - case.event_s[0])
    nearest = np.abs(moved[:, None] - case.event_s[None, :]).argmin(axis=1)
    far = np.abs(moved - case.event_s[nearest]) > 0.5 * float(np.median(np.diff(case.event_s)))
    return np.where(far, -1, nearest)
