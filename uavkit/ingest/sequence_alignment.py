"""Align two sequences of times that tell of the same events: stills by the camera's clock, shutters seen in the video.

Either sequence may lack entries or hold false ones; the clocks differ by an unknown offset and drift, and stamps may be
cut down to whole seconds. Pairs keep the order. All order-preserving matchings are weighed at once: for each offset and
drift of a grid, a pair weighs e^``LOG_PAIR_WEIGHT`` times the density of its residual, an entry left unpaired weighs 1
(e^``LOG_EDGE_WEIGHT`` before the first and after the last pair, for recordings are often started late), and the sums
over all matchings follow from two recursions (forward and backward). Their product gives the probability of each pair;
what stays below the wanted probability is named ambiguous and left open.
"""

from dataclasses import dataclass, field

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.core.errors import InputError

LOG_PAIR_WEIGHT = 9.0
"""A pair that fits against two entries left alone in the midst: e^9, about 1 in 90 entries missing on each side."""
LOG_EDGE_WEIGHT = 2.1
"""An entry left alone at an end against one in the midst. A regular sequence shifted by one either way stays too likely
to be settled by equal counts alone."""
LONGEST_EDGE = 12
"""Beyond this many entries an end is no likelier than the midst."""
FEWER_PAIRS = 6
"""Offsets that give so many pairs fewer than the best are not looked at."""
MOST_CLOCKS = 4000
"""Offsets and drifts looked at, at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentOptions:
    """What is known of the two clocks."""

    first_resolution_s: float = 0.0
    """Stamps of the first sequence are cut down to multiples of this."""
    second_resolution_s: float = 0.0
    jitter_s: float = 0.02
    """Standard deviation of all other differences (shutter lag, frame times)."""
    greatest_drift_ppm: float = 500.0
    wanted_probability: float = 0.99
    """Pairs less probable than this are named ambiguous."""

    def __post_init__(self) -> None:
        if not (self.jitter_s > 0 and min(self.first_resolution_s, self.second_resolution_s) >= 0):
            raise ValueError("jitter_s must be > 0 and resolutions >= 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockDifference:
    """first = second (1 + drift) + offset, of the true times of both clocks."""

    offset_s: float
    """At time 0 of the second clock."""
    drift_ppm: float
    sigma_s: float
    """Standard deviation of the offset in the middle of the sequence; infinite without pairs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceAlignment:
    """Which entry of the first sequence is which of the second."""

    pairs: Indices
    """(k, 2) rows of the first and the second sequence, both rising."""
    probability: Array
    """(k,) of each pair."""
    first_unpaired: tuple[int, ...]
    """Entries that probably have no partner."""
    second_unpaired: tuple[int, ...]
    first_ambiguous: tuple[int, ...]
    """Entries of which several partners (or a partner or none) are possible: left open."""
    second_ambiguous: tuple[int, ...]
    clock: ClockDifference
    matrix: Array = field(repr=False)
    """(n, m) probability of each pair."""


def align_sequences(
    first_s: Array, second_s: Array, options: AlignmentOptions, evidence: Array | None = None
) -> SequenceAlignment:
    """Return the pairs of two rising sequences of seconds, (n,) and (m,), with their probabilities.

    ``evidence`` (n, m) is the logarithm of how much likelier a pair is by what else is known of it (its content), 0 for
    nothing. Raises InputError where a sequence does not rise.
    """
    first, second = np.asarray(first_s, dtype=np.float64), np.asarray(second_s, dtype=np.float64)
    for name, times in (("first", first), ("second", second)):
        if np.any(np.diff(times) < 0):
            where = int(np.argmax(np.diff(times) < 0)) + 1
            raise InputError(
                f"times of the {name} sequence run backwards at entry {where}: sort them, or split the flights"
            )
    extra = np.zeros((len(first), len(second))) if evidence is None else np.asarray(evidence, dtype=np.float64)
    if len(first) == 0 or len(second) == 0:
        return decide(extra, no_clock(), options)
    first_zero, second_zero = float(first.mean()), float(second.mean())
    a, b = first - first_zero, second - second_zero
    offsets, drifts = _clocks(a, b, options)
    matrix = _pair_probabilities(a, b, offsets, drifts, (options, extra))
    clock = _clock_difference(a, b, matrix, options)
    offset = clock.offset_s + first_zero - (1.0 + clock.drift_ppm * 1e-6) * second_zero
    moved = ClockDifference(offset_s=offset, drift_ppm=clock.drift_ppm, sigma_s=clock.sigma_s)
    return decide(matrix, moved, options)


def align_by_order(evidence: Array, options: AlignmentOptions) -> SequenceAlignment:
    """Return the pairs of two sequences of which only the order and the evidence (n, m) for each pair are known."""
    logs = LOG_PAIR_WEIGHT + np.asarray(evidence, dtype=np.float64)
    matrix = _matching_probabilities(logs[None])[1][0] if logs.size else np.zeros_like(logs)
    return decide(matrix, no_clock(), options)


def no_clock() -> ClockDifference:
    """Return what is known of the clocks where no pair tells."""
    return ClockDifference(offset_s=float("nan"), drift_ppm=float("nan"), sigma_s=float("inf"))


def _clocks(a: Array, b: Array, options: AlignmentOptions) -> tuple[Array, Array]:
    """Return the offsets (g,) and drifts (g,) worth looking at: those near which most pairs would fit."""
    step = 0.75 * options.jitter_s
    span = max(float(b[-1] - b[0]), options.jitter_s)
    half = int(np.ceil(options.greatest_drift_ppm * 1e-6 * 0.5 * span / step))
    offsets, drifts, counts = [], [], []
    for drift in np.arange(-half, half + 1) * (step / (0.5 * span)):
        cells, number = _fitting_pairs((a[:, None] - (1.0 + drift) * b[None, :]).ravel(), step, options)
        offsets.append(cells * step)
        drifts.append(np.full(len(cells), drift))
        counts.append(number)
    count = np.concatenate(counts)
    order = np.argsort(-count, kind="stable")[:MOST_CLOCKS]
    order = order[count[order] >= max(1, count[order[0]] - FEWER_PAIRS)]
    return np.concatenate(offsets)[order], np.concatenate(drifts)[order]


def _fitting_pairs(differences_s: Array, step: float, options: AlignmentOptions) -> tuple[Array, Array]:
    """Return multiples (cells) of ``step`` as offsets, and for each the number of differences that fit it."""
    low = int(np.floor((options.first_resolution_s + 2.5 * options.jitter_s) / step))
    high = int(np.floor((options.second_resolution_s + 2.5 * options.jitter_s) / step))
    cells = np.rint(differences_s / step).astype(np.int64)
    occupied, number = np.unique(cells, return_counts=True)
    candidates = np.unique((occupied[:, None] + np.arange(-high, low + 1)[None, :]).ravel())
    total = np.concatenate([[0], np.cumsum(number)])
    # a pair's difference lies between offset - first resolution and offset + second resolution
    begin = np.searchsorted(occupied, candidates - low, side="left")
    end = np.searchsorted(occupied, candidates + high, side="right")
    return candidates.astype(np.float64), total[end] - total[begin]


def _log_density(residual_s: Array, options: AlignmentOptions) -> Array:
    """Return the logarithm of the residuals' density over its greatest value: stamps cut down, and Gaussian jitter."""
    from scipy.special import ndtr

    low, high = -options.first_resolution_s - 1e-4, options.second_resolution_s + 1e-4
    s = options.jitter_s
    density = ndtr((residual_s - low) / s) - ndtr((residual_s - high) / s)
    middle = 0.5 * (low + high)
    greatest = float(ndtr((middle - low) / s) - ndtr((middle - high) / s))
    return np.asarray(np.log(np.maximum(density / greatest, 1e-30)))


def _pair_probabilities(
    a: Array, b: Array, offsets: Array, drifts: Array, knowledge: tuple[AlignmentOptions, Array]
) -> Array:
    """Return the probability of each pair (n, m), averaged over the clocks by how well each explains everything."""
    options, evidence = knowledge
    evidence = evidence + LOG_PAIR_WEIGHT + _log_gain(a, b, options)
    chunk = max(1, 4_000_000 // (len(a) * len(b)))
    logs, matrices = [], []
    greatest = -np.inf
    for start in range(0, len(offsets), chunk):
        o, d = offsets[start : start + chunk, None, None], drifts[start : start + chunk, None, None]
        weight = evidence + _log_density(a[None, :, None] - o - (1.0 + d) * b[None, None, :], options)
        log_sum, matrix = _matching_probabilities(weight)
        peak = float(log_sum.max())
        share = np.exp(log_sum - peak)
        logs.append((peak, float(share.sum())))
        matrices.append(np.tensordot(share, matrix, axes=1))
        greatest = max(greatest, peak)
    scale = [np.exp(peak - greatest) for peak, _ in logs]
    total = sum(s * share for s, (_, share) in zip(scale, logs, strict=True))
    return np.asarray(sum(s * matrix for s, matrix in zip(scale, matrices, strict=True)) / total)


def _log_gain(a: Array, b: Array, options: AlignmentOptions) -> float:
    """Return the logarithm of how much a fitting residual tells: the spread of the intervals over the residuals' own.

    Intervals that are all alike tell nothing: an entry left alone would fit just as well. Then one pair more or less
    shall not settle where the sequence begins, and the weight of a pair is lowered.
    """
    own = options.first_resolution_s + options.second_resolution_s + 5.0 * options.jitter_s
    finer = a if options.first_resolution_s < options.second_resolution_s else b
    spread = float(np.subtract(*np.percentile(np.diff(finer), [75, 25]))) if len(finer) > 2 else 0.0
    gain = float(np.log(max(1e-3, 2.0 * spread / own)))
    return max(6.0 * gain, -4.5) if gain < 0 else gain


def _matching_probabilities(log_weight: Array) -> tuple[Array, Array]:
    """Return (g,) the logarithm of the sum over all matchings and (g, n, m) the probability of each pair."""
    _, n, m = log_weight.shape
    before = _log_sums_before(log_weight)
    after = _log_sums_before(log_weight[:, ::-1, ::-1])[:, ::-1, ::-1]
    ends = _edge(np.arange(n)[::-1][:, None] + 0 * np.arange(m)) + _edge(
        np.arange(m)[::-1][None, :] + 0 * np.arange(n)[:, None]
    )
    last = (log_weight + before + ends).reshape(len(log_weight), -1)
    nothing = float(_edge(np.array(n)) + _edge(np.array(m)))
    log_sum = np.logaddexp(_log_sum_exp(last), nothing)
    return log_sum, np.exp(log_weight + before + after - log_sum[:, None, None])


def _edge(entries: "np.typing.NDArray[np.signedinteger]") -> Array:
    return np.asarray(LOG_EDGE_WEIGHT * np.minimum(entries, LONGEST_EDGE), dtype=np.float64)


def _log_sum_exp(values: Array) -> Array:
    peak = values.max(axis=1)
    return np.asarray(peak + np.log(np.exp(values - peak[:, None]).sum(axis=1)))


def _log_sums_before(log_weight: Array) -> Array:
    """Return (g, n, m) the logarithm of the sum over all matchings of the entries before each pair."""
    g, n, m = log_weight.shape
    result = np.empty_like(log_weight)
    sums = np.zeros((g, m + 1))  # of all matchings that end before a column, in rows so far, over exp(scale)
    scale = np.zeros((g, 1))
    columns = _edge(np.arange(m))
    for row in range(n):
        start = np.exp(columns[None, :] + float(_edge(np.array(row))) - scale)
        inner = start + sums[:, :m]
        with np.errstate(divide="ignore"):
            result[:, row] = np.log(inner) + scale
        sums[:, 1:] += np.cumsum(inner * np.exp(log_weight[:, row]), axis=1)
        grown = np.maximum(sums[:, -1:], 1.0)
        sums /= grown
        scale += np.log(grown)
    return result


def _clock_difference(a: Array, b: Array, matrix: Array, options: AlignmentOptions) -> ClockDifference:
    """Return offset and drift by least squares over the probable pairs, the drift held near 0 by its a priori sigma."""
    rows, columns = np.nonzero(matrix > 0.5)
    if len(rows) == 0:
        return no_clock()
    middle = 0.5 * (options.second_resolution_s - options.first_resolution_s)
    y = a[rows] - b[columns] - middle
    spread = (options.first_resolution_s**2 + options.second_resolution_s**2) / 12.0
    sigma = np.sqrt(options.jitter_s**2 + spread)
    centre = float(np.mean(b[columns]))
    x = b[columns] - centre
    a_priori = max(options.greatest_drift_ppm * 0.5e-6, 1e-9)
    drift = float(x @ y / (x @ x + (sigma / a_priori) ** 2))
    offset = float(np.mean(y)) - drift * centre
    return ClockDifference(offset_s=offset, drift_ppm=drift * 1e6, sigma_s=float(sigma / np.sqrt(len(y))))


def decide(matrix: Array, clock: ClockDifference, options: AlignmentOptions) -> SequenceAlignment:
    """Take the pairs of a matrix of probabilities (n, m) that are probable enough, and name everything else."""
    wanted = options.wanted_probability
    rows, columns = np.nonzero(matrix >= wanted)
    if len(set(columns.tolist())) != len(columns) or len(set(rows.tolist())) != len(rows):
        raise ValueError("wanted_probability must be above 0.5: an entry got two partners")
    total_first, total_second = matrix.sum(axis=1), matrix.sum(axis=0)
    open_first, open_second = set(range(matrix.shape[0])) - set(rows), set(range(matrix.shape[1])) - set(columns)
    return SequenceAlignment(
        pairs=np.column_stack([rows, columns]).astype(np.int64),
        probability=matrix[rows, columns],
        first_unpaired=tuple(sorted(int(i) for i in open_first if total_first[i] <= 1.0 - wanted)),
        second_unpaired=tuple(sorted(int(j) for j in open_second if total_second[j] <= 1.0 - wanted)),
        first_ambiguous=tuple(sorted(int(i) for i in open_first if total_first[i] > 1.0 - wanted)),
        second_ambiguous=tuple(sorted(int(j) for j in open_second if total_second[j] > 1.0 - wanted)),
        clock=clock,
        matrix=matrix,
    )
