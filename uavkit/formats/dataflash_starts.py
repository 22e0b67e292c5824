"""Several starts of a vehicle in one dataflash log: each begins to count time anew, and is put behind the others.

Such a file is what joining logs gives, or an old autopilot that goes on with the log before. One clock cannot hold
for all: by that of the first, all others' times would be wrong. So the boot times of later starts are moved by what the
starts lie apart in GPS time; what is moved then has one clock with the rest.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from uavkit.core.arrays import Indices
from uavkit.formats.dataflash_fields import NO_ROWS, Messages, Rows

FALL_US = 5_000_000
"""A boot time so much lower than that before is of another start, of damage, or of a block that comes again."""
APART_US = 10_000_000
"""Starts so near in GPS time are the same: what fell was damage, or a block came again."""
FEWEST = 3
"""Fixes that tell a start."""
_LONGEST_US = 2**53
_WEEK_US = 7 * 86_400 * 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class _Start:
    """One start of the vehicle, by its fixes."""

    place: int
    """In the file, of the first."""
    place_before: int
    """Of the last one before."""
    first_us: int
    last_before_us: int
    gps_minus_boot_us: int | None
    """None where no fix of it has a time."""


def joined_starts(messages: Messages) -> tuple[Messages, tuple[str, ...]]:
    """Return the messages with boot times that go on over the starts of the vehicle, and a note where there are some.

    Messages of a start that nothing ties to GPS time are left out. A log of one start, or without boot times in
    microseconds, comes back as it is.
    """
    starts = _starts(messages.of("GPS"))
    known = [start.gps_minus_boot_us for start in starts if start.gps_minus_boot_us is not None]
    if len(starts) < 2 or not known:
        return messages, ()
    moves = [
        None if start.gps_minus_boot_us is None else start.gps_minus_boot_us - min(known) for start in starts
    ]  # fmt: skip
    rows = {name: _moved(part, starts, moves) for name, part in messages.rows.items()}
    note = f"the vehicle was started {len(starts)} times: boot times of later starts go on from the first, by GPS time"
    lost = moves.count(None)
    if lost:
        note += f"; of {lost} starts nothing tells the time, their messages are left out"
    result = Messages(rows=rows, counts=messages.counts, damage=messages.damage, notes=messages.notes)
    return result, (note,)


def _starts(gps: Rows) -> list[_Start]:
    """Return the starts by the messages of the receiver; none where they have no boot time in microseconds."""
    if "TimeUS" not in gps.columns or "GMS" not in gps.columns:
        return []
    boot_us, week, ms = gps.integer("TimeUS", -1), gps.integer("GWk", 0), gps.integer("GMS", -1)
    usable = np.flatnonzero((boot_us >= 0) & (boot_us < _LONGEST_US))
    if not len(usable):
        return []
    boot_us, week, ms, places = boot_us[usable], week[usable], ms[usable], gps.places[usable]
    timed = (week > 0) & (week < 10_000) & (ms >= 0) & (ms * 1000 < _WEEK_US)
    apart_us = np.where(timed, week * _WEEK_US + ms * 1000 - boot_us, 0)
    bounds = [0, *(np.flatnonzero(np.diff(boot_us) < -FALL_US) + 1).tolist(), len(boot_us)]
    starts: list[_Start] = []
    for begin, end in pairwise(bounds):
        told = apart_us[begin:end][timed[begin:end]]
        apart = int(np.sort(told)[len(told) // 2]) if len(told) >= FEWEST else None
        if starts and (end - begin < FEWEST or _goes_on(starts[-1], apart, boot_us[:begin], boot_us[begin:end])):
            if starts[-1].gps_minus_boot_us is None:
                starts[-1] = replace(starts[-1], gps_minus_boot_us=apart)
            continue
        before = max(begin - 1, 0)
        starts.append(
            _Start(
                place=int(places[begin]),
                place_before=int(places[before]),
                first_us=int(boot_us[begin]),
                last_before_us=int(boot_us[before]),
                gps_minus_boot_us=apart,
            )
        )
    return starts


def _goes_on(start: _Start, apart_us: int | None, before_us: Indices, boot_us: Indices) -> bool:
    """Tell whether what follows a fall is of the same start: by GPS time, without it where boot times come again."""
    if apart_us is not None and start.gps_minus_boot_us is not None:
        return abs(apart_us - start.gps_minus_boot_us) < APART_US
    return bool(np.isin(boot_us[:FEWEST], before_us).all())


def _moved(rows: Rows, starts: list[_Start], moves: list[int | None]) -> Rows:
    """Return messages with the boot times of each start moved, those of starts that are not to be moved left out."""
    if "TimeUS" not in rows.columns or not len(rows):
        return rows
    time_us = rows.integer("TimeUS", -1)
    number = _start_of(rows.places, time_us, starts)
    move_us = np.array([move or 0 for move in moves], dtype=np.int64)[number]
    columns = {**rows.columns, "TimeUS": np.where(time_us >= 0, time_us + move_us, time_us)}
    if "SMS" in columns:
        columns["SMS"] = rows.integer("SMS", -1) + move_us // 1000
    moved = Rows(places=rows.places, columns=columns)
    kept = np.array([move is not None for move in moves])[number]
    if kept.all():
        return moved
    return moved.where(kept) if kept.any() else NO_ROWS


def _start_of(places: Indices, time_us: Indices, starts: list[_Start]) -> Indices:
    """Return the start (n,) that messages belong to: by their place, between two fixes by their time."""
    number = np.zeros(len(places), dtype=np.int64)
    for k, start in enumerate(starts[1:], start=1):
        between = (places > start.place_before) & (places < start.place)
        nearer = np.abs(time_us - start.first_us) < np.abs(time_us - start.last_before_us)
        number[(places >= start.place) | (between & nearer)] = k
    return number
