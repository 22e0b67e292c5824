"""Stamps of stills and of exposure events, in the order of the shots; events of several logs made one list."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import PurePath

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.core.gpstime import NO_TIME

SAME_SHUTTER_S = 0.1
"""Events of two logs so near, after the constant lag between the logs is taken off, tell the same exposure."""
GREATEST_LAG_S = 1.0
LEAST_FOR_LAG = 3
FILE_NUMBERS_TELL = 0.02
"""Times that run backwards by file number at more than this share: the numbers tell nothing of the order."""
WHOLE_UNITS_NS = (1_000_000_000, 100_000_000, 10_000_000, 1_000_000)
LEAST_FOR_UNIT = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class StillStamps:
    """When n stills were taken, by the camera's own clock; in any order."""

    name: tuple[str, ...]
    """File names, with folders where there are several."""
    time_ns: Indices
    """(n,) cut down to the resolution; NO_TIME where the file does not say."""
    resolution_ns: Indices
    """(n,)."""

    def __post_init__(self) -> None:
        if not len(self.name) == len(self.time_ns) == len(self.resolution_ns):
            raise ValueError("StillStamps: name, time_ns and resolution_ns must be equally long")
        if len(self.resolution_ns) and int(self.resolution_ns.min()) <= 0:
            raise ValueError("StillStamps: resolution_ns must be > 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExposureStamps:
    """When m exposures were, as logs tell; in any order."""

    gps_ns: Indices
    """(m,) NO_TIME where a log does not say."""
    sigma_s: Array
    """(m,) NaN where nothing says it."""
    label: tuple[str, ...]
    """(m,) what the user knows an event by: its log and its number there."""

    def __post_init__(self) -> None:
        if not len(self.gps_ns) == len(self.sigma_s) == len(self.label):
            raise ValueError("ExposureStamps: gps_ns, sigma_s and label must be equally long")


@dataclass(frozen=True, slots=True, kw_only=True)
class MergedExposures:
    """The exposures of several logs as one list in the order of time."""

    stamps: ExposureStamps
    log: Indices
    """(m,) row of the log that each is taken from."""
    row: Indices
    """(m,) its row there."""
    notes: tuple[str, ...]


def merge_exposures(logs: Sequence[ExposureStamps], log_names: Sequence[str]) -> MergedExposures:
    """Return the exposures of all logs, each once: where logs tell the same one, the log named first counts.

    Another log's events may lag by a constant (a report follows the trigger): the lag is the median over the nearest
    events, and events are the same where they differ from it by less than ``SAME_SHUTTER_S``. What the other log alone
    tells is moved by the lag.
    """
    time = np.zeros(0, dtype=np.int64)
    log, row, notes = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), []
    for number, stamps in enumerate(logs):
        known = np.flatnonzero(stamps.gps_ns != NO_TIME)
        known = known[np.argsort(stamps.gps_ns[known], kind="stable")]
        new = stamps.gps_ns[known]
        lag_s, same = _told_already(time, new)
        if np.any(same):
            told = f"{int(same.sum())} of {len(new)} exposures of {log_names[number]} are told by another log already"
            notes.append(told + (f", {lag_s:+.3f} s apart" if abs(lag_s) >= 0.001 else ""))
            new = new - (round(lag_s * 1e9) if int(same.sum()) >= LEAST_FOR_LAG else 0)
        time = np.concatenate([time, new[~same]])
        log = np.concatenate([log, np.full(int(np.sum(~same)), number, dtype=np.int64)])
        row = np.concatenate([row, known[~same]])
        order = np.argsort(time, kind="stable")
        time, log, row = time[order], log[order], row[order]
    places = list(zip(log.tolist(), row.tolist(), strict=True))
    sigma = np.array([logs[a].sigma_s[b] for a, b in places], dtype=np.float64)
    label = tuple(logs[a].label[b] for a, b in places)
    stamps = ExposureStamps(gps_ns=time, sigma_s=sigma, label=label)
    return MergedExposures(stamps=stamps, log=log, row=row, notes=tuple(notes))


def _told_already(time_ns: Indices, new_ns: Indices) -> tuple[float, "np.typing.NDArray[np.bool_]"]:
    """Return the lag of new events behind those known, both rising, and which of the new ones are known."""
    if len(time_ns) == 0 or len(new_ns) == 0:
        return 0.0, np.zeros(len(new_ns), dtype=bool)
    difference_s = (new_ns - time_ns[_nearest(time_ns, new_ns)]) * 1e-9
    near = difference_s[np.abs(difference_s) < GREATEST_LAG_S]
    if len(near) == 0:
        return 0.0, np.zeros(len(new_ns), dtype=bool)
    lag_s = float(np.median(near))
    if float(np.median(np.abs(near - lag_s))) > 0.5 * SAME_SHUTTER_S:  # no common lag: of other exposures
        lag_s = 0.0
    moved = new_ns - round(lag_s * 1e9)
    nearest = _nearest(time_ns, moved)
    apart_s = np.abs(moved - time_ns[nearest]) * 1e-9
    same = apart_s < SAME_SHUTTER_S
    order = np.lexsort((apart_s, nearest))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(nearest[order]) > 0
    closest = np.zeros(len(order), dtype=bool)
    closest[order] = first
    return lag_s, same & closest


def _nearest(sorted_ns: Indices, wanted_ns: Indices) -> Indices:
    after = np.clip(np.searchsorted(sorted_ns, wanted_ns), 1, max(len(sorted_ns) - 1, 1))
    if len(sorted_ns) == 1:
        return np.zeros(len(wanted_ns), dtype=np.int64)
    before = after - 1
    closer = np.abs(wanted_ns - sorted_ns[before]) <= np.abs(sorted_ns[after] - wanted_ns)
    return np.where(closer, before, after)


def resolution_seen_ns(stills: StillStamps) -> Indices:
    """Return (n,) the resolution of stamps: coarser than stated where all are multiples (a SubSec that is always 0)."""
    known = stills.time_ns[stills.time_ns != NO_TIME]
    if len(known) < LEAST_FOR_UNIT:
        return stills.resolution_ns
    unit = next((u for u in WHOLE_UNITS_NS if not np.any(known % u)), 1)
    return np.maximum(stills.resolution_ns, unit)


def file_order(names: Sequence[str]) -> Indices:
    """Return the rows of names in the order of folders and file numbers, with wraps (DSC09999 before DSC00001)."""
    keys = [_name_key(name) for name in names]
    numbers: dict[tuple[str, str], list[int]] = {}
    for folder, prefix, digits, _ in keys:
        if digits:
            numbers.setdefault((folder, prefix), []).append(int(digits))
    moduli = {group: 10 ** len(str(max(values))) for group, values in numbers.items()}
    begins = {group: _first_number(values, moduli[group]) for group, values in numbers.items()}
    folders = {folder: number for number, folder in enumerate(sorted({key[0] for key in keys}, key=_natural))}

    def place(row: int) -> tuple[int, int, str, str]:
        folder, prefix, digits, name = keys[row]
        group = (folder, prefix)
        number = (int(digits) - begins[group]) % moduli[group] if digits else 0
        return folders[folder], number, prefix, name

    return np.array(sorted(range(len(names)), key=place), dtype=np.int64)


def _name_key(name: str) -> tuple[str, str, str, str]:
    """Return folder, what stands before the number, the number's digits, and the name."""
    path = PurePath(name)
    found = re.search(r"(\d+)\D*$", path.stem)
    digits = found[1] if found and len(found[1]) <= 9 else ""
    prefix = path.stem[: found.start(1)] if found and digits else path.stem
    return str(path.parent), prefix, digits, name


def _natural(text: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", text)]


def _first_number(values: Sequence[int], modulus: int) -> int:
    """Return where a cyclic run of numbers begins: after the greatest gap, if it wraps at all."""
    ordered = sorted(set(values))
    if ordered[0] > 1 or ordered[-1] < modulus - 2:  # only a run that reaches both ends may wrap
        return ordered[0]
    gaps = [b - a for a, b in pairwise(ordered)]
    widest = int(np.argmax(gaps)) if gaps else 0
    return ordered[widest + 1] if gaps and gaps[widest] > modulus // 4 else ordered[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Shots:
    """Stills in the order in which they were taken, with the interval in which each was, by the camera's clock."""

    rows: Indices
    """(k,) rows of the stills."""
    low_ns: Indices
    """(k,) rising."""
    width_ns: Indices
    """(k,)."""


def sessions_of(stills: StillStamps, longest_pause_s: float) -> list[Shots]:
    """Return the stills in runs of one setting of the camera's clock: parted where time runs back, and by long pauses.

    Stills without a time are put between their neighbours by file number, and may be any time between these; those
    without a neighbour are in no run.
    """
    resolution = resolution_seen_ns(stills)
    by_file = file_order(stills.name)
    timed = by_file[stills.time_ns[by_file] != NO_TIME]
    if len(timed) == 0:
        return []
    time = stills.time_ns[timed]
    back = np.flatnonzero(np.diff(time) < -2 * resolution[timed[1:]])
    if len(back) > max(2.0, FILE_NUMBERS_TELL * len(timed)):
        back = np.zeros(0, dtype=np.int64)
    runs = []
    for part in np.split(timed, back + 1):
        place = np.empty(len(stills.name), dtype=np.int64)
        place[by_file] = np.arange(len(by_file))
        ordered = part[np.lexsort((place[part], stills.time_ns[part]))]
        pauses = np.flatnonzero(np.diff(stills.time_ns[ordered]) > longest_pause_s * 1e9) + 1
        runs += [run for run in np.split(ordered, pauses) if len(run)]
    return [_with_untimed(stills, run, by_file, resolution) for run in runs]


def _with_untimed(stills: StillStamps, run: Indices, by_file: Indices, resolution: Indices) -> Shots:
    """Return a run of rows in order, with the stills without time that stand between two of them by file number."""
    following: dict[int, list[int]] = {}
    member = np.zeros(len(stills.name), dtype=bool)
    member[run] = True
    last, waiting = -1, list[int]()
    for row in by_file.tolist():
        if stills.time_ns[row] == NO_TIME:
            waiting.append(row)
        elif member[row]:
            if last >= 0:
                following[last] = waiting
            last, waiting = row, []
        else:
            last, waiting = -1, []
    rows, low, width = list[int](), list[int](), list[int]()
    for k, row in enumerate(run.tolist()):
        begin = int(stills.time_ns[row])
        rows.append(row)
        low.append(begin)
        width.append(int(resolution[row]))
        if k + 1 < len(run):
            until = int(stills.time_ns[run[k + 1]] + resolution[run[k + 1]])
            for untimed in following.get(row, []):
                rows.append(untimed)
                low.append(begin)
                width.append(until - begin)
    return Shots(rows=np.array(rows), low_ns=np.array(low, dtype=np.int64), width_ns=np.array(width, dtype=np.int64))
