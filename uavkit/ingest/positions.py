"""Join positions that carry no still's name or time with the stills: by order, checked by geometry, never shifted.

Waypoint lists give one position for each exposure, in order; lists with a point too few or too many are the trade's
classic source of positions that all belong to the neighbouring still. What can settle it: the placemarks' names, their
times, the stills' own EXIF positions, and the distances between positions against the times between stills. What none
of them settles is left out and named.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.block import PositionSource
from uavkit.core.errors import InputError
from uavkit.core.frames import LocalFrame
from uavkit.core.records import GnssFix, StillInfo
from uavkit.formats.positions_file import ImagePositions
from uavkit.ingest.sequence_alignment import (
    AlignmentOptions,
    SequenceAlignment,
    align_by_order,
    align_sequences,
    decide,
    no_clock,
)

LOG_LEFT_OUT = -9.0
"""Logarithm of the weight of a still without position, or a position without still, in the midst of the flight."""
LOG_LEFT_OUT_END = -5.0
"""The same before the first and after the last pair: places of take-off and landing are often listed."""
LONGEST_SKIP = 4
"""Stills or positions that may be missing one after another."""
STRAY_SHARE = 0.12
"""Steps that tell nothing: an outlier at one end, a wait; their lengths are spread evenly over ``STRAY_M``."""
STRAY_M = 60.0
LONG_PAUSE = 0.6
"""A time between stills longer than usual by this share of the usual one is that of a turn, if the path has turns."""
TURN_RAD = 0.9
LOG_TURN = (2.0, -3.0, -1.5)
"""Weights of a long pause at a turn of the path, of one elsewhere, and of a turn without a pause."""
LEAST_FOR_ORDER = 0.51
"""Probability of each pair from which equal counts are joined by order."""
CERTAIN = 0.9995
APART = 6.0
"""Steps longer than this many usual ones lead to no exposure, at the ends of a list; outliers are nearer."""
CARRIER_PHASE_SIGMA_M = 0.1
"""Positions that state less than this are those of RTK or PPK with fixed ambiguities."""
FAR_M = 20_000.0
"""Positions this far from the median of all are none of this flight."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionOptions:
    """What counts where the source of positions does not say it."""

    sigma_horizontal_m: float = 1.0
    """Of a listed position, for each axis: single frequency with SBAS."""
    sigma_vertical_m: float = 2.0
    exif_sigma_horizontal_m: float = 1.5
    exif_sigma_vertical_m: float = 3.0
    wanted_probability: float = 0.997


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinedPositions:
    """The position of each still, as far as it can be told."""

    fixes: tuple[GnssFix | None, ...]
    """One for each still, in their order."""
    probability: Array
    """(n,) that the position belongs to the still; 0 where there is none."""
    from_exif: bool
    discarded: tuple[str, ...]
    """Positions that belong to no still, with the reason."""
    notes: tuple[str, ...]
    velocity_m_s: Array | None = None
    """(n, 3) east, north, up of the antenna, NaN where unknown; None where nothing tells it."""
    flight: Indices | None = None
    """(n,) number of the flight; None: all are of one."""
    source: PositionSource = PositionSource.LISTED

    @property
    def count(self) -> int:
        """Number of stills with a position."""
        return sum(fix is not None for fix in self.fixes)


def join_positions(
    infos: Sequence[StillInfo],
    fixes: Sequence[GnssFix],
    absent: Sequence[str] = (),
    options: PositionOptions = PositionOptions(),
) -> JoinedPositions:
    """Return the position of each still among listed ones.

    ``absent`` names stills that were taken but cannot be read: they keep their place in the order.
    """
    near, discarded = _without_far(fixes)
    slots = _slots(infos, absent)
    by_name = _by_name(slots, near)
    if by_name is not None:
        return _result(infos, slots, by_name, near, discarded, ["positions joined with stills by their names"])
    if len(near) >= 3 * len(slots) and len(near) > 20:
        note = (
            f"{len(near)} positions for {len(slots)} stills: that is a track, not a list of exposures, and is not "
            "used; give the positions of the exposures"
        )
        return _result(infos, slots, {}, near, discarded, [note])
    alignment, how = _align(slots, near, options)
    pairs = {int(i): (int(j), float(p)) for (i, j), p in zip(alignment.pairs, alignment.probability, strict=True)}
    discarded = [*discarded, *(f"{_called(near, j)}: belongs to no still" for j in alignment.second_unpaired)]
    notes = [*_count_notes(slots, near, pairs, how), *_open_notes(slots, alignment)]
    return _result(infos, slots, pairs, near, discarded, notes)


def exif_positions(infos: Sequence[StillInfo]) -> JoinedPositions:
    """Return the positions that the stills themselves carry."""
    fixes = [info.position for info in infos]
    without = [info.name for info in infos if info.position is None]
    notes = []
    if len(without) < len(infos):
        notes.append(f"positions from the EXIF of {len(infos) - len(without)} stills")
        if without:
            notes.append(f"{len(without)} stills without EXIF position: {', '.join(without)}")
    probability = np.array([0.0 if fix is None else 1.0 for fix in fixes])
    return JoinedPositions(
        fixes=tuple(fixes),
        probability=probability,
        from_exif=True,
        discarded=(),
        notes=tuple(notes),
        source=PositionSource.EXIF,
    )


def fix_sigmas(fix: GnssFix, from_exif: bool, options: PositionOptions) -> tuple[float, float, float]:
    """Return the sigmas of east, north, up in metres: the fix's own where it states them."""
    horizontal = options.exif_sigma_horizontal_m if from_exif else options.sigma_horizontal_m
    vertical = options.exif_sigma_vertical_m if from_exif else options.sigma_vertical_m
    h = fix.sigma_horizontal_m or horizontal
    east, north = fix.sigma_east_north_m or (h, h)
    return east, north, fix.sigma_vertical_m or vertical


def common_sigma(joined: JoinedPositions) -> tuple[float, float, float] | None:
    """Return the a priori sigma of the error that fixes of a carrier-phase solution have in common; None for others.

    Where every fix states its sigmas, and none of their medians reaches ``CARRIER_PHASE_SIGMA_M``, the ambiguities are
    fixed; what is left in common is the base station's error, which is taken for as large as a fix's own.
    """
    fixes = [fix for fix in joined.fixes if fix is not None]
    if not fixes or any(fix.sigma_horizontal_m is None or fix.sigma_vertical_m is None for fix in fixes):
        return None
    median_m = np.median([fix_sigmas(fix, joined.from_exif, PositionOptions()) for fix in fixes], axis=0)
    if float(median_m.max()) >= CARRIER_PHASE_SIGMA_M:
        return None
    east, north, up = median_m.tolist()
    return east, north, up


def join_named(infos: Sequence[StillInfo], listed: ImagePositions, absent: Sequence[str] = ()) -> JoinedPositions:
    """Return the position of each still by the names that a file of positions gives, with or without their ending.

    ``absent`` names stills that were taken but cannot be read. Raises InputError where no name is that of a still, or
    two are that of the same one.
    """
    slots = [_Slot(name=info.name, info=info) for info in infos] + [_Slot(name=name, info=None) for name in absent]
    known = _known_names(slots)
    pairs: dict[int, tuple[int, float]] = {}
    strange = []
    for j, (fix, line) in enumerate(zip(listed.fixes, listed.lines, strict=True)):
        row = known.get(fix.name.casefold())
        if row is None:
            strange.append(f"line {line}: {fix.name}")
        elif row in pairs:
            first = listed.lines[pairs[row][0]]
            raise InputError(f"{listed.source}: lines {first} and {line} both give a position of {slots[row].name}")
        else:
            pairs[row] = (j, 1.0)
    if not pairs:
        raise InputError(f"{listed.source}: no position bears the name of a still ({strange[0]}; {infos[0].name} ...)")
    discarded = [f"{listed.source}: {what}: no such still, the position is not used" for what in strange]
    notes = ["positions joined with stills by their names"]
    without = [slot.name for row, slot in enumerate(slots) if slot.info is not None and row not in pairs]
    if without:
        notes.append(f"{len(without)} stills without a position: {', '.join(without)}")
    fixes = tuple(listed.fixes[pairs[row][0]] if row in pairs else None for row in range(len(infos)))
    probability = np.array([0.0 if fix is None else 1.0 for fix in fixes])
    return JoinedPositions(
        fixes=fixes, probability=probability, from_exif=False, discarded=tuple(discarded), notes=tuple(notes)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Slot:
    """A still that was taken, whether it can be read or not."""

    name: str
    info: StillInfo | None


def _natural(name: str) -> list[tuple[int, int, str]]:
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in re.split(r"([0-9]+)", name.casefold())]


def _slots(infos: Sequence[StillInfo], absent: Sequence[str]) -> list[_Slot]:
    """Put unreadable stills where their names say, if the readable ones are in the order of their names."""
    slots = [_Slot(name=info.name, info=info) for info in infos]
    keys = [_natural(slot.name) for slot in slots]
    if any(a > b for a, b in pairwise(keys)):
        return slots
    slots += [_Slot(name=name, info=None) for name in absent]
    return sorted(slots, key=lambda slot: _natural(slot.name))


def _without_far(fixes: Sequence[GnssFix]) -> tuple[list[GnssFix], list[str]]:
    """Take out positions at 0, 0 and such that lie unreasonably far from all others."""
    if not fixes:
        return [], []
    place = _east_north(fixes)
    middle = np.median(place, axis=0)
    far = np.linalg.norm(place - middle, axis=1) > FAR_M
    reasons = [
        f"{_called(fixes, n)}: {np.linalg.norm(place[n] - middle) / 1000:.0f} km from the others"
        for n in map(int, np.flatnonzero(far))
    ]
    return [fix for fix, bad in zip(fixes, far, strict=True) if not bad], reasons


def _east_north(fixes: Sequence[GnssFix]) -> Array:
    """Return metres (n, 2) in a plane through the median position; good to some tenths of a per cent near it."""
    latitude, longitude = np.array([[fix.latitude_deg, fix.longitude_deg] for fix in fixes]).T
    frame = LocalFrame.at(float(np.median(latitude)), float(np.median(longitude)), 0.0)
    return frame.enu_from_geographic(latitude, longitude, np.zeros(len(fixes)))[:, :2]


def _called(fixes: Sequence[GnssFix], index: int) -> str:
    name = fixes[index].name
    return f"position {index + 1} ({name})" if name else f"position {index + 1}"


def _known_names(slots: Sequence[_Slot]) -> dict[str, int]:
    """Return the index of each still by its name with and without ending."""
    known: dict[str, int] = {}
    for index, slot in enumerate(slots):
        known[slot.name.casefold()] = index
        known.setdefault(slot.name.rsplit(".", 1)[0].casefold(), index)
    return known


def _by_name(slots: Sequence[_Slot], fixes: Sequence[GnssFix]) -> dict[int, tuple[int, float]] | None:
    """Return pairs where at least half of the positions bear a still's name (with or without its ending)."""
    known = _known_names(slots)
    rows = [known.get(fix.name.strip().casefold()) for fix in fixes]
    hits = [row for row in rows if row is not None]
    if 2 * len(hits) < len(fixes) or not hits or len(set(hits)) != len(hits):
        return None
    return {row: (j, 1.0) for j, row in enumerate(rows) if row is not None}


def _align(slots: Sequence[_Slot], fixes: Sequence[GnssFix], options: PositionOptions) -> tuple[SequenceAlignment, str]:
    """Align by the best knowledge there is: times, EXIF positions, or distances against intervals."""
    settings = AlignmentOptions(wanted_probability=options.wanted_probability, jitter_s=0.1, first_resolution_s=1.0)
    stills_s = _still_times(slots)
    fixes_ns = [fix.gps_time_ns for fix in fixes if fix.gps_time_ns is not None]
    if stills_s is not None and len(fixes_ns) == len(fixes) and all(a < b for a, b in pairwise(fixes_ns)):
        fixes_s = np.array([time - fixes_ns[0] for time in fixes_ns]) * 1e-9
        return align_sequences(stills_s, fixes_s, settings), "times"
    own = [slot.info.position if slot.info is not None else None for slot in slots]
    if sum(fix is not None for fix in own) >= 2:
        return align_by_order(_nearness(own, fixes), settings), "EXIF positions"
    place_m = _east_north(fixes) if fixes else np.zeros((0, 2))
    matrix = _step_probabilities(stills_s, place_m, len(slots))
    return _decided(matrix, place_m, options), "order and distances" if stills_s is not None else "order"


def _decided(matrix: Array, place_m: Array, options: PositionOptions) -> SequenceAlignment:
    """Cut a matrix of probabilities into pairs and what is left open.

    Where the counts are equal, order is taken unless something else is likelier. Where the first or the last position
    lies far apart like a place of take-off, another one may be missing, and order must be all but certain.
    """
    wanted = options.wanted_probability
    n, m = matrix.shape
    if n == m and n:
        wanted = CERTAIN if _end_apart(place_m) else wanted
        if float(np.diag(matrix).min()) > LEAST_FOR_ORDER and not _end_apart(place_m):
            wanted = LEAST_FOR_ORDER
    return decide(matrix, no_clock(), AlignmentOptions(wanted_probability=wanted))


def _end_apart(place_m: Array) -> bool:
    steps_m = np.linalg.norm(np.diff(place_m, axis=0), axis=1)
    return len(steps_m) > 2 and max(steps_m[0], steps_m[-1]) > APART * float(np.median(steps_m))


def _still_times(slots: Sequence[_Slot]) -> Array | None:
    times = [slot.info.camera_time_ns if slot.info is not None else None for slot in slots]
    known = [time for time in times if time is not None]
    if len(known) < len(times) or len(known) < 2 or any(a > b for a, b in pairwise(known)):
        return None
    return np.array([time - known[0] for time in known]) * 1e-9


def _nearness(own: Sequence[GnssFix | None], fixes: Sequence[GnssFix]) -> Array:
    """Return evidence (n, m): EXIF and listed positions of one exposure agree within some metres."""
    given = [fix for fix in own if fix is not None]
    place = _east_north([*given, *fixes])
    rows = iter(place[: len(given)])
    evidence = np.zeros((len(own), len(fixes)))
    for i, fix in enumerate(own):
        if fix is not None:
            distance = np.linalg.norm(place[len(given) :] - next(rows), axis=1)
            evidence[i] = np.maximum(6.0 - 0.5 * (distance / 3.0) ** 2, -8.0)
    return evidence


def _step_probabilities(stills_s: Array | None, place_m: Array, stills: int) -> Array:
    """Return the probability (n, m) of each pair from the order and from distances against intervals.

    All chains of pairs are weighed (forward and backward): each step from one pair to the next by how well the distance
    fits, each still or position that is left out by a fixed weight.
    """
    n, m = stills, len(place_m)
    if min(n, m) == 0:
        return np.zeros((n, m))
    step = _log_steps(stills_s, place_m, n)
    ends = np.asarray(LOG_LEFT_OUT_END * (np.arange(n)[:, None] + np.arange(m)[None, :]), dtype=np.float64)
    forward = _chain(step, ends)
    turned = _chain(_reversed_steps(step, n, m), ends)[::-1, ::-1]
    total = forward + ends[::-1, ::-1]
    peak = float(total.max())
    log_sum = peak + np.log(np.exp(total - peak).sum())
    return np.asarray(np.exp(np.minimum(forward + turned - log_sum, 0.0)))


_Steps = dict[tuple[int, int], Array]
"""For (stills, positions) gone forward: (n, m) log weight of the step that begins at each pair."""


def _reversed_steps(step: _Steps, n: int, m: int) -> _Steps:
    """The same steps for both sequences turned round."""
    result = {}
    for (di, dj), weight in step.items():
        turned = np.full((n, m), -np.inf)
        turned[: n - di, : m - dj] = weight[: n - di, : m - dj][::-1, ::-1]
        result[di, dj] = turned
    return result


def _chain(step: _Steps, ends: Array) -> Array:
    """Return (n, m) the log sum over all chains that lead to each pair, that pair included."""
    n, m = ends.shape
    sums = ends.copy()
    for i in range(1, n):
        for j in range(1, m):
            terms = [sums[i, j]]
            for (di, dj), weight in step.items():
                if di <= i and dj <= j:
                    terms.append(sums[i - di, j - dj] + weight[i - di, j - dj] + LOG_LEFT_OUT * (di + dj - 2))
            values = np.array(terms)
            peak = values.max()
            sums[i, j] = peak + np.log(np.exp(values - peak).sum())
    return sums


def _log_steps(stills_s: Array | None, place_m: Array, n: int) -> _Steps:
    """Return how well each step fits: its length against the usual spacing, or against the interval times the usual
    speed; heavy tails for outliers; pauses of the stills against turns of the path.

    A still and a position are never left out side by side: an outlier is no reason to leave both out.
    """
    m = len(place_m)
    steps_m = np.linalg.norm(np.diff(place_m, axis=0), axis=1)
    usual_m = float(np.median(steps_m)) if m > 1 else 0.0
    spread_m = max(1.48 * float(np.median(np.abs(steps_m - usual_m))) if m > 1 else 0.0, 0.1 * usual_m, 1.0)
    pace, pauses = _pace(stills_s, n)
    turns, known = _turns(place_m, np.abs(steps_m - usual_m) > 3.5 * spread_m)
    if not 1 <= int(pauses.sum()) <= int(turns.sum()):
        known = np.zeros_like(known)
    result = {}
    for di in range(1, min(LONGEST_SKIP, n - 1) + 1):
        for dj in range(1, min(LONGEST_SKIP, m - 1) + 1):
            weight = np.full((n, m), -np.inf)
            if di != dj or di == 1:
                distance = np.linalg.norm(place_m[dj:] - place_m[:-dj], axis=1)[None, :]
                fit = _normal(distance - di * usual_m, spread_m)
                if pace is not None:
                    expected = (pace[di:] - pace[:-di])[:, None] * usual_m
                    fit = 0.5 * fit + 0.5 * _normal(distance - expected, spread_m + 0.25 * usual_m)
                log_fit = np.log((1.0 - STRAY_SHARE) * fit + STRAY_SHARE / STRAY_M)
                weight[: n - di, : m - dj] = log_fit + _turn_weights(
                    _any_of(pauses, di), _any_of(turns, dj), ~_any_of(~known, dj)
                )
            result[di, dj] = weight
    return result


def _normal(residual: Array, sigma: float) -> Array:
    return np.asarray(np.exp(-0.5 * (residual / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi)))


def _pace(stills_s: Array | None, n: int) -> tuple[Array | None, Flags]:
    """Return times in units of the usual interval, pauses taken out, shape (n,), and which intervals (n - 1,) are
    pauses."""
    if stills_s is None:
        return None, np.zeros(max(n - 1, 0), dtype=np.bool_)
    intervals = np.diff(stills_s)
    usual = max(float(np.median(intervals)), 1e-9)
    pauses = intervals > (1.0 + LONG_PAUSE) * usual
    return np.concatenate([[0.0], np.cumsum(np.where(pauses, usual, intervals) / usual)]), pauses


def _turns(place_m: Array, stray: Flags) -> tuple[Flags, Flags]:
    """Return which steps (m - 1,) of the path lead from one strip to the next, across what comes before and after, and
    of which that can be told: not near outliers, positions between two stray steps."""
    m = len(place_m)
    turns, known = np.zeros(max(m - 1, 0), dtype=np.bool_), np.zeros(max(m - 1, 0), dtype=np.bool_)
    outlier = np.concatenate([[False], stray[1:] & stray[:-1], [False]]) if m > 1 else np.zeros(m, dtype=np.bool_)
    for j in range(2, m - 3):
        step, before, after = place_m[j + 1] - place_m[j], place_m[j] - place_m[j - 2], place_m[j + 3] - place_m[j + 1]
        turns[j] = all(_angle_rad(step, other) > TURN_RAD for other in (before, after))
        known[j] = not outlier[[j - 2, j, j + 1, j + 3]].any()
    return turns & known, known


def _angle_rad(one: Array, two: Array) -> float:
    """Angle between two directions in the plane, 0 to pi."""
    return float(abs(np.arctan2(one[0] * two[1] - one[1] * two[0], one @ two)))


def _any_of(flags: Flags, count: int) -> Flags:
    """Return for each window of ``count`` flags whether one of them is set."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(flags, count).any(axis=1), dtype=np.bool_)


def _turn_weights(pauses: Flags, turns: Flags, known: Flags) -> Array:
    pause, turn = pauses[:, None], turns[None, :]
    both, alone, without = LOG_TURN
    weight = np.where(pause & turn, both, np.where(pause, alone, np.where(turn, without, 0.0)))
    return np.asarray(np.where(known[None, :], weight, 0.0))


def _count_notes(
    slots: Sequence[_Slot], fixes: Sequence[GnssFix], pairs: dict[int, tuple[int, float]], how: str
) -> list[str]:
    if len(slots) == len(fixes):
        text = f"{len(pairs)} positions joined with stills by {how}, the counts are equal"
        least = min((probability for _, probability in pairs.values()), default=1.0)
        if least < CERTAIN and how.startswith("order"):
            text += f"; the order alone gives a pair {least:.2f} at least: stills and positions may both be missing"
        return [text]
    word = "fewer" if len(fixes) < len(slots) else "more"
    text = f"{len(fixes)} positions are {word} than {len(slots)} stills: {len(pairs)} joined by {how}"
    if len(pairs) < min(len(slots), len(fixes)):
        text += "; nothing settles to which still the others belong, so they are left out"
    return [text]


def _open_notes(slots: Sequence[_Slot], alignment: SequenceAlignment) -> list[str]:
    notes = []
    if alignment.first_ambiguous:
        names = ", ".join(slots[i].name for i in alignment.first_ambiguous)
        notes.append(f"{len(alignment.first_ambiguous)} stills whose position is ambiguous and left out: {names}")
    if alignment.first_unpaired:
        names = ", ".join(slots[i].name for i in alignment.first_unpaired)
        notes.append(f"{len(alignment.first_unpaired)} stills without position: {names}")
    return notes


def _result(
    infos: Sequence[StillInfo],
    slots: Sequence[_Slot],
    pairs: dict[int, tuple[int, float]],
    fixes: Sequence[GnssFix],
    discarded: Sequence[str],
    notes: Sequence[str],
) -> JoinedPositions:
    by_name = {slots[i].name: (fixes[j], probability) for i, (j, probability) in pairs.items()}
    found = [by_name.get(info.name) for info in infos]
    return JoinedPositions(
        fixes=tuple(None if entry is None else entry[0] for entry in found),
        probability=np.array([0.0 if entry is None else entry[1] for entry in found]),
        from_exif=False,
        discarded=tuple(discarded),
        notes=tuple(notes),
    )
