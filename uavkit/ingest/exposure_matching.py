"""Which still belongs to which exposure, by stamps of the camera's clock and events in GPS time: probable, or open.

Stills and events keep their order; either may lack entries, hold false ones, or tell one twice; the camera's clock is
off by an unknown offset and drift. The model is stated in ``exposure_chain``; the probability of each pair is summed
over all order-preserving alignments and all settings of the clock that matter (``exposure_posterior``), against there
being no relation at all, as with the log of another flight.

Each run of stills by one setting of the clock is matched: all sorties together where one offset and drift hold, those
left over then on their own. Where several shifts of a regular flight explain it nearly as well, all of it is ambiguous.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.core.exposures import StillState
from uavkit.core.gpstime import NO_TIME
from uavkit.core.progress import Progress, silent
from uavkit.ingest.exposure_chain import Chain, build_chain
from uavkit.ingest.exposure_clocks import ClockLimits
from uavkit.ingest.exposure_intervals import AGAIN_WITHIN_S
from uavkit.ingest.exposure_posterior import Posterior, posterior
from uavkit.ingest.exposure_stamps import ExposureStamps, Shots, StillStamps, sessions_of

LEAST_PROBABLE = 0.05
"""A partner less probable than this is not worth naming."""
SAME_TIME = 1.5
"""Events of one exposure that lie no further apart than so many times the jitter need no flag."""
LEAST_LEFT = 6
"""So many stills and events must be left for another clock setting to be looked for."""
LEAST_PAUSE_S = 60.0
PAUSE_INTERVALS = 10.0
"""A pause so long is one between sorties: the camera's clock may have been set anew."""
MOST_RUNS = 16


class EventState(Enum):
    """What is known of an event."""

    MATCHED = "matched"
    DOUBLED = "doubled"
    """It tells the exposure of the event before once more."""
    NO_STILL = "no still"
    AMBIGUOUS = "ambiguous"
    NO_TIME = "no time"


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchOptions:
    """What is known beforehand, and what is wanted."""

    jitter_s: float = 0.02
    """Standard deviation of a still's time against its event's, resolution and constant lag left out."""
    greatest_drift_ppm: float = 200.0
    wanted_probability: float = 0.999
    """A shift is taken if it is so probable, and a pair; pairs of coarse stamps if their mean is."""
    coarse_probability: float = 0.99
    """The least probability of a single pair where stamps are coarse."""
    longest_pause_s: float = 10_800.0
    """Stills further apart are matched apart."""

    def __post_init__(self) -> None:
        if not (self.jitter_s > 0 and 0.5 < self.coarse_probability <= self.wanted_probability < 1):
            raise ValueError("jitter_s must be > 0, and 0.5 < coarse_probability <= wanted_probability < 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraClock:
    """One setting of the camera's clock: camera time = GPS time + offset, which drifts."""

    stills: Indices
    """Rows of the stills that it holds for."""
    reference_gps_ns: int
    """Where the offset is told."""
    offset_s: float
    drift_ppm: float
    sigma_offset_s: float
    """At the reference."""
    sigma_drift_ppm: float
    residual_s: float
    """Standard deviation of the matched stills' middle times about the clock; the resolution is in it. NaN if none."""
    settled: bool
    """The shift is as probable as wanted."""
    probability: float
    """Of the shift."""

    def gps_ns(self, camera_ns: Indices) -> Indices:
        """Return GPS times of camera times, (k,) integer ns."""
        zero = self.reference_gps_ns + round(self.offset_s * 1e9)
        since_s = (np.asarray(camera_ns, dtype=np.int64) - zero) * 1e-9
        gps_s = np.asarray(since_s / (1.0 + self.drift_ppm * 1e-6), dtype=np.float64)
        return self.reference_gps_ns + np.rint(gps_s * 1e9).astype(np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExposureMatching:
    """Which event each of n stills belongs to, and what became of each of m events."""

    event: Indices
    """(n,) row of the event, -1 for none; of an ambiguous still the most probable one, which must not be used."""
    probability: Array
    """(n,) that the still belongs to ``event`` (DOUBLED: to the exposure that it tells)."""
    state: tuple[StillState, ...]
    """(n,)."""
    reason: tuple[str, ...]
    """(n,) in words, empty where matched."""
    spread_s: Array
    """(n,) by how much the events that may be the still's own lie apart: 0 unless doubled."""
    event_state: tuple[EventState, ...]
    """(m,)."""
    event_reason: tuple[str, ...]
    """(m,) why an event is not used, empty where it is."""
    clocks: tuple[CameraClock, ...]
    """One for each setting of the camera's clock; empty where nothing fits."""
    notes: tuple[str, ...]

    @property
    def settled(self) -> bool:
        """Whether a shift was found for any still, and none is open."""
        return bool(self.clocks) and all(clock.settled for clock in self.clocks)

    def used(self) -> Indices:
        """Return rows of the stills that have an event, doubled ones included."""
        good = (StillState.MATCHED, StillState.DOUBLED)
        return np.array([row for row, state in enumerate(self.state) if state in good], dtype=np.int64)


def match_exposures(
    stills: StillStamps, events: ExposureStamps, options: MatchOptions | None = None, progress: Progress = silent
) -> ExposureMatching:
    """Return the pairs of stills (n) and exposure events (m), both in any order, with what is left open and why."""
    work = _Work(stills, events, options or MatchOptions())
    runs = sorted(sessions_of(stills, work.options.longest_pause_s), key=lambda run: -len(run.rows))
    left: list[Shots] = []
    for done, run in enumerate(runs):
        progress("matching stills with exposures", done, len(runs))
        left += work.match(run)
    for _ in range(MOST_RUNS):
        if not left:
            break
        left += work.match_what_is_left(left.pop(0))
    progress("matching stills with exposures", len(runs), len(runs))
    return work.result()


class _Work:
    """Collects the results of several runs."""

    def __init__(self, stills: StillStamps, events: ExposureStamps, options: MatchOptions) -> None:
        n = len(stills.name)
        self.options = options
        self._stills, self._events = stills, events
        self._event = np.full(n, -1, dtype=np.int64)
        self._probability, self._spread_s = np.zeros(n), np.zeros(n)
        untimed = stills.time_ns == NO_TIME
        self._state = [StillState.NO_TIME if bad else StillState.NO_EVENT for bad in untimed]
        self._reason = ["its file tells no time, and its file number no place" if bad else "" for bad in untimed]
        lost = events.gps_ns == NO_TIME
        self._event_state = [EventState.NO_TIME if bad else EventState.NO_STILL for bad in lost]
        self._event_reason = ["its log tells no GPS time" if bad else "no still is left for it" for bad in lost]
        self._clocks: list[CameraClock] = []
        self._notes: list[list[str]] = []

    def match(self, shots: Shots) -> list[Shots]:
        """Match one run with the events not used yet; return those of its stills that another setting may explain."""
        run = self._run(shots)
        found = None if run is None else run.posterior(self._expected(shots))
        if run is None or found is None:
            for row in shots.rows:
                self._reason[row] = "no event is left" if run is None else "no event fits at any setting of the clock"
            return []
        clock = run.clock(found)
        self._take(run, found, clock)
        return self._left(shots) if clock.settled else _at_longest_pause(shots)

    def match_what_is_left(self, shots: Shots) -> list[Shots]:
        """Match stills that another setting of the clock left alone; what does not settle stays as it was."""
        run = self._run(shots)
        found = None if run is None else run.posterior(None)
        if run is None or found is None:
            return []
        if not run.clock(found).settled:
            return _at_longest_pause(shots)
        clock = run.clock(found)
        self._take(run, found, clock)
        return self._left(shots)

    def _run(self, shots: Shots) -> "_Run | None":
        unused = (EventState.NO_STILL, EventState.AMBIGUOUS)
        rows = np.array([j for j, state in enumerate(self._event_state) if state in unused], dtype=np.int64)
        if len(rows) == 0 or (len(rows) < LEAST_LEFT and self._clocks):
            return None
        rows = rows[np.argsort(self._events.gps_ns[rows], kind="stable")]
        return _Run(self._stills, self._events, shots, rows, self.options)

    def _expected(self, shots: Shots) -> "CameraClock | None":
        """Return the nearest setting that is known well, for a short run that cannot tell its own."""
        known = [clock for clock in self._clocks if clock.settled]
        if not known or len(shots.rows) == 0:
            return None
        return min(known, key=lambda clock: abs(int(clock.gps_ns(shots.low_ns[:1])[0]) - clock.reference_gps_ns))

    def _left(self, shots: Shots) -> list[Shots]:
        """Return the stills of a settled run that no event explains, where they are many together."""
        begin, end = _longest_run(np.array([self._state[row] is StillState.NO_EVENT for row in shots.rows]))
        if end - begin < LEAST_LEFT:
            return []
        part = slice(begin, end)
        return [Shots(rows=shots.rows[part], low_ns=shots.low_ns[part], width_ns=shots.width_ns[part])]

    def _take(self, run: "_Run", found: Posterior, clock: CameraClock) -> None:
        decided = run.decisions(found, clock.settled)
        used = [d.still for d in decided if d.state in (StillState.MATCHED, StillState.DOUBLED)]
        for decision in decided:
            row = decision.still
            self._event[row], self._probability[row] = decision.event, decision.probability
            self._state[row], self._reason[row] = decision.state, decision.reason
            self._spread_s[row] = decision.spread_s
        for event, state, reason in run.event_decisions(found, decided):
            if self._event_state[event] is not EventState.MATCHED:
                self._event_state[event], self._event_reason[event] = state, reason
        self._clocks.append(run.measured(clock, used, self._event))
        self._notes.append(run.notes(self._clocks[-1], found))

    def result(self) -> ExposureMatching:
        """Return all that was found."""
        settled = [clock for clock in self._clocks if clock.settled]
        found = {int(row) for clock in settled for row in clock.stills}
        kept = [k for k, c in enumerate(self._clocks) if c.settled or not found.issuperset(c.stills.tolist())]
        clocks = tuple(self._clocks[k] for k in kept)
        notes = list(dict.fromkeys(note for k in kept for note in self._notes[k]))
        if len(settled) > 1:
            notes.append(f"the camera's clock was set anew: {len(settled)} settings, each matched on its own")
        return ExposureMatching(
            event=self._event,
            probability=self._probability,
            state=tuple(self._state),
            reason=tuple(self._reason),
            spread_s=self._spread_s,
            event_state=tuple(self._event_state),
            event_reason=tuple(self._event_reason),
            clocks=clocks,
            notes=tuple(notes),
        )


def _seconds(time_ns: Indices) -> Array:
    return np.asarray(time_ns * 1e-9, dtype=np.float64)


def _at_longest_pause(shots: Shots) -> list[Shots]:
    """Return the stills before and after a pause between two sorties, none where there is no such pause."""
    gap_s = _seconds(np.diff(shots.low_ns))
    if len(gap_s) < 2 * LEAST_LEFT:
        return []
    if float(gap_s.max()) < max(LEAST_PAUSE_S, PAUSE_INTERVALS * float(np.median(gap_s))):
        return []
    cut = int(np.argmax(gap_s)) + 1
    parts = (slice(0, cut), slice(cut, len(shots.rows)))
    return [Shots(rows=shots.rows[p], low_ns=shots.low_ns[p], width_ns=shots.width_ns[p]) for p in parts]


def _longest_run(flags: "np.typing.NDArray[np.bool_]") -> tuple[int, int]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    if len(edges) == 0:
        return 0, 0
    begins, ends = edges[::2], edges[1::2]
    k = int(np.argmax(ends - begins))
    return int(begins[k]), int(ends[k])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Decision:
    still: int
    event: int
    probability: float
    state: StillState
    reason: str
    spread_s: float


class _Run:
    """One run of stills and the events that may belong to it."""

    def __init__(
        self, stills: StillStamps, events: ExposureStamps, shots: Shots, rows: Indices, options: MatchOptions
    ) -> None:
        self._stills, self._events, self._shots, self._rows, self._options = stills, events, shots, rows, options
        self._still_zero, self._event_zero = int(shots.low_ns[0]), int(events.gps_ns[rows[0]])
        half_s = _seconds(shots.width_ns) / 2.0
        sigma = np.where(np.isfinite(events.sigma_s[rows]), events.sigma_s[rows], 0.0)
        self.chain: Chain = build_chain(
            _seconds(shots.low_ns - self._still_zero) + half_s,
            half_s,
            _seconds(events.gps_ns[rows] - self._event_zero),
            np.hypot(options.jitter_s, sigma),
        )

    def posterior(self, known: "CameraClock | None") -> Posterior | None:
        """Return the probabilities; those by a setting known from other stills if these tell no better."""
        greatest = self._options.greatest_drift_ppm * 1e-6
        limits = ClockLimits(sigma_drift=0.5 * greatest, greatest_drift=1.25 * greatest)
        free = posterior(self.chain, limits)
        if known is None or (free is not None and free.modes[0] > self._options.wanted_probability):
            return free
        middle = self._event_zero + round(0.5e9 * (self.chain.event_s[0] + self.chain.event_s[-1]))
        since_s = (middle - known.reference_gps_ns) * 1e-9
        offset_s = known.offset_s + known.drift_ppm * 1e-6 * since_s
        offset_s -= (self._still_zero - self._event_zero) * 1e-9
        margin = 5.0 * float(np.hypot(known.sigma_offset_s, known.sigma_drift_ppm * 1e-6 * since_s)) + 0.1
        limits = ClockLimits(
            sigma_drift=limits.sigma_drift,
            greatest_drift=limits.greatest_drift,
            offsets_s=(offset_s - margin, offset_s + margin),
        )
        return posterior(self.chain, limits) or free

    def clock(self, found: Posterior) -> CameraClock:
        """Return the clock in the user's terms."""
        wanted = self._options.wanted_probability
        return CameraClock(
            stills=self._shots.rows,
            reference_gps_ns=self._event_zero + round(found.clock.reference_s * 1e9),
            offset_s=found.clock.offset_s + (self._still_zero - self._event_zero) * 1e-9,
            drift_ppm=found.clock.drift * 1e6,
            sigma_offset_s=found.sigma_offset_s,
            sigma_drift_ppm=found.sigma_drift * 1e6,
            residual_s=float("nan"),
            settled=bool(found.modes[0] >= wanted),
            probability=float(found.modes[0]),
        )

    def measured(self, clock: CameraClock, used: Sequence[int], event: Indices) -> CameraClock:
        """Return the clock with the residuals of the stills used."""
        from dataclasses import replace

        rows = np.array([k for k, row in enumerate(self._shots.rows) if int(row) in set(used)], dtype=np.int64)
        if len(rows) < 3:
            return clock
        middle = self._shots.low_ns[rows] + self._shots.width_ns[rows] // 2
        residual = (clock.gps_ns(middle) - self._events.gps_ns[event[self._shots.rows[rows]]]) * 1e-9
        return replace(clock, residual_s=float(np.std(residual)))

    def decisions(self, found: Posterior, settled: bool) -> list[_Decision]:
        """Return what becomes of each still."""
        offers = [self._offer(k, found) for k in range(len(self._shots.rows))]
        level = self._level(np.array([o.probability for o in offers]), float(found.modes[0])) if settled else 2.0
        taken = [o.event for o in offers if o.probability >= level]
        contested = {event for event in taken if taken.count(event) > 1} if len(set(taken)) < len(taken) else set()
        return [self._decided(o, level, o.event in contested) for o in offers]

    def _level(self, probability: Array, shift: float) -> float:
        """Return how probable (n,) pairs must be; that of the shift is judged by itself, and taken off here.

        Of coarse stamps the mean of all that are taken must be as probable as wanted: each alone is open to the chance
        that two entries that miss their partners fall into the same second.
        """
        wanted = self._options.wanted_probability
        if not self.chain.coarse:
            return wanted * shift
        given = np.sort(probability / shift)[::-1]
        given = given[given >= self._options.coarse_probability]
        good = np.flatnonzero(np.cumsum(1.0 - given) <= (1.0 - wanted) * np.arange(1, len(given) + 1))
        return shift * (min(wanted, float(given[good[-1]])) if len(good) else wanted)

    def _offer(self, k: int, found: Posterior) -> _Decision:
        """Return the best event of still k, taken together with those that may tell the same exposure."""
        begin, end = np.searchsorted(found.still, [k, k + 1])
        row = int(self._shots.rows[k])
        if begin == end or float(found.probability[begin:end].max()) < 1e-6:
            return _Decision(
                still=row,
                event=-1,
                probability=0.0,
                state=StillState.NO_EVENT,
                reason=self._lonely(k, found),
                spread_s=0.0,
            )
        event, probability = found.event[begin:end], found.probability[begin:end]
        best = int(np.argmax(probability))
        near = np.abs(self.chain.event_s[event] - self.chain.event_s[event[best]]) < AGAIN_WITHIN_S
        near &= probability >= min(1e-4, float(probability[best]))
        time, weight = self.chain.event_s[event[near]], probability[near]
        alone = float(probability[best]) >= self._options.wanted_probability * float(found.modes[0])
        spread = 0.0 if alone else float(np.ptp(time))
        shown = [j for j in np.argsort(-probability).tolist() if probability[j] > LEAST_PROBABLE]
        names = " or ".join(f"{self._label(int(event[j]))} ({probability[j]:.3f})" for j in shown)
        return _Decision(
            still=row,
            event=int(self._rows[event[best]]),
            probability=float(probability[best]) if alone else float(weight.sum()),
            state=StillState.AMBIGUOUS if float(probability.sum()) > LEAST_PROBABLE else StillState.NO_EVENT,
            reason=f"ambiguous: {names}, or none" if names else self._lonely(k, found),
            spread_s=spread,
        )

    def _decided(self, offer: _Decision, level: float, contested: bool) -> _Decision:
        from dataclasses import replace

        if offer.probability < level or contested:
            if offer.state is StillState.NO_EVENT:
                return replace(offer, event=-1, probability=1.0 - offer.probability, spread_s=0.0)
            return replace(offer, state=StillState.AMBIGUOUS, spread_s=0.0)
        if offer.spread_s > SAME_TIME * self._options.jitter_s:
            told = f"told by several events within {offer.spread_s:.2f} s: {offer.reason.removeprefix('ambiguous: ')}"
            return replace(offer, state=StillState.DOUBLED, reason=told.removesuffix(", or none"))
        return replace(offer, state=StillState.MATCHED, reason="", spread_s=0.0)

    def _lonely(self, k: int, found: Posterior) -> str:
        apart = self.chain.event_s - found.clock.event_time_s(self.chain.still_s[k : k + 1])[0]
        nearest = int(np.argmin(np.abs(apart)))
        return f"no event within {max(abs(float(apart[nearest])), 0.01):.2f} s: the nearest is {self._label(nearest)}"

    def _label(self, event: int) -> str:
        return self._events.label[int(self._rows[event])]

    def event_decisions(self, found: Posterior, decided: Sequence[_Decision]) -> list[tuple[int, EventState, str]]:
        """Return what becomes of each event."""
        good = (StillState.MATCHED, StillState.DOUBLED)
        taken = {d.event for d in decided if d.state in good}
        stills: list[list[tuple[float, str]]] = [[] for _ in self._rows]
        for i, j, p in zip(found.still.tolist(), found.event.tolist(), found.probability.tolist(), strict=True):
            if p > LEAST_PROBABLE:
                stills[j].append((p, self._stills.name[self._shots.rows[i]]))
        return [
            (row, EventState.MATCHED, "") if row in taken else (row, *self._why_not(j, found, stills[j]))
            for j, row in enumerate(self._rows.tolist())
        ]

    def _why_not(self, j: int, found: Posterior, stills: list[tuple[float, str]]) -> tuple[EventState, str]:
        gap = float(self.chain.event_s[j] - self.chain.event_s[j - 1]) if j else np.inf
        if gap < 2.0 * AGAIN_WITHIN_S and found.again[j] > 0.5:
            return EventState.DOUBLED, f"doubled: {gap:.2f} s after {self._label(j - 1)}"
        if stills:
            names = " or ".join(f"{name} ({p:.3f})" for p, name in sorted(stills, reverse=True)[:4])
            return EventState.AMBIGUOUS, f"ambiguous: {names}"
        apart = found.clock.event_time_s(self.chain.still_s) - self.chain.event_s[j]
        nearest = int(np.argmin(np.abs(apart)))
        name = self._stills.name[self._shots.rows[nearest]]
        return EventState.NO_STILL, f"no still within {abs(float(apart[nearest])):.2f} s: the nearest is {name}"

    def notes(self, clock: CameraClock, found: Posterior) -> list[str]:
        """Return in words what the clock is, and what is left open."""
        first = self._stills.name[self._shots.rows[0]]
        count = len(self._shots.rows)
        if not clock.settled:
            why = (
                "they may be of different flights"
                if found.unrelated > 0.5
                else f"the best of several shifts has a probability of {clock.probability:.3f}"
            )
            return [f"{count} stills from {first} on are not matched: {why}"]
        notes = [f"{count} stills from {first} on: the camera's clock is {offset_in_words(clock.offset_s)}"]
        if self.chain.coarse and np.any(self._stills.resolution_ns[self._shots.rows] < self._shots.width_ns):
            notes.append("the stills' stamps are coarser than they state: taken as whole seconds")
        return notes


def offset_in_words(offset_s: float) -> str:
    """Return "9 h 0 min 2.3 s ahead of UTC: it runs on local time" or the like."""
    size = abs(offset_s)
    days, rest = divmod(size, 86_400.0)
    hours, rest = divmod(rest, 3600.0)
    minutes, seconds = divmod(rest, 60.0)
    parts = [(f"{days:.0f} d", days), (f"{hours:.0f} h", days + hours), (f"{minutes:.0f} min", days + hours + minutes)]
    text = " ".join([part for part, shown in parts if shown] + [f"{seconds:.1f} s"])
    local = 1500.0 < size < 15 * 3600.0 and abs(size - 900.0 * round(size / 900.0)) < 180.0
    where = f"{text} {'ahead of' if offset_s > 0 else 'behind'} UTC"
    return where + (": it runs on local time" if local else "")
