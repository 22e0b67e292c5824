"""What the user decides by hand goes before what the matching found."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from uavkit.core.errors import InputError, did_you_mean
from uavkit.core.exposures import StillState
from uavkit.core.gpstime import NO_TIME
from uavkit.formats.match_file import NONE, MatchRow
from uavkit.ingest.exposure_matching import EventState, ExposureMatching
from uavkit.ingest.exposure_stamps import ExposureStamps

BY_HAND = "by hand"
"""The reason of a decision."""
NEAR_S = 0.05
"""A GPS time means the event so near to it."""
_LAST_S = 2**63 // 10**9 - 1
"""What comes later has no place in 64 bits of nanoseconds."""


def apply_overrides(
    matching: ExposureMatching, names: Sequence[str], events: ExposureStamps, rows: Sequence[MatchRow], where: str
) -> ExposureMatching:
    """Return the matching of n named stills with the rows' decisions in place; ``where`` is the file, for messages.

    Raises InputError for unknown images and events, and for an event that two images are given to. A row that says what
    the matching found changes nothing; an event taken from another still leaves that one ambiguous.
    """
    wanted = _wanted(names, events, rows, where)
    event, probability = matching.event.copy(), matching.probability.copy()
    state, reason, spread = list(matching.state), list(matching.reason), matching.spread_s.copy()
    owner = {int(event[row]): row for row in matching.used().tolist()}
    for still, target in wanted.items():
        used = state[still] in (StillState.MATCHED, StillState.DOUBLED)
        if (used and int(event[still]) == target) or (target < 0 and state[still] is StillState.NO_EVENT):
            continue
        if used and owner.get(int(event[still])) == still:
            del owner[int(event[still])]
        other = owner.get(target) if target >= 0 else None
        if other is not None and other not in wanted:
            state[other] = StillState.AMBIGUOUS
            reason[other] = f"its event was given to {names[still]} by hand"
        event[still], probability[still], spread[still] = target, 1.0, 0.0
        state[still] = StillState.MATCHED if target >= 0 else StillState.NO_EVENT
        reason[still] = BY_HAND
        if target >= 0:
            owner[target] = still
    event_state, event_reason = _events(matching, event, state)
    return replace(
        matching,
        event=event,
        probability=probability,
        state=tuple(state),
        reason=tuple(reason),
        spread_s=spread,
        event_state=event_state,
        event_reason=event_reason,
        notes=(*matching.notes, f"{len(wanted)} images are matched by hand: {where}"),
    )


def _events(
    matching: ExposureMatching, event: "np.typing.NDArray[np.int64]", state: Sequence[StillState]
) -> tuple[tuple[EventState, ...], tuple[str, ...]]:
    """Return state and reason of each event after stills were given other ones."""
    good = (StillState.MATCHED, StillState.DOUBLED)
    taken = {int(event[row]) for row in range(len(state)) if state[row] in good}
    states, reasons = list(matching.event_state), list(matching.event_reason)
    for row in range(len(states)):
        if row in taken:
            states[row], reasons[row] = EventState.MATCHED, ""
        elif states[row] is EventState.MATCHED:
            states[row], reasons[row] = EventState.NO_STILL, "its still was given another event by hand"
    return tuple(states), tuple(reasons)


def _wanted(names: Sequence[str], events: ExposureStamps, rows: Sequence[MatchRow], where: str) -> dict[int, int]:
    """Return the event (-1 for none) of each still that a row decides."""
    stills = {name.casefold(): row for row, name in enumerate(names)}
    labels = {label.casefold(): row for row, label in enumerate(events.label)}
    wanted: dict[int, int] = {}
    given: dict[int, str] = {}
    for row in rows:
        place = f"{where}: line {row.line}"
        still = stills.get(row.image.casefold())
        if still is None:
            raise InputError(f"{place}: there is no image {row.image!r}{did_you_mean(row.image, list(names))}")
        if not row.event:
            continue
        target = -1 if row.event.casefold() == NONE else _event(row.event, labels, events, place)
        if target >= 0 and target in given:
            label = events.label[target]
            raise InputError(f"{place}: {label} is given to {given[target]} and to {row.image}: one can have it")
        given[target] = row.image
        wanted[still] = target
    return wanted


def _event(text: str, labels: dict[str, int], events: ExposureStamps, place: str) -> int:
    """Return the row of an event named by its label, its number (from 1), or its GPS time."""
    if text.casefold() in labels:
        return labels[text.casefold()]
    time = re.fullmatch(r"([0-9]{1,10})(?:\.([0-9]{0,30}))?", text)
    if time is not None and time[2] is None:
        if 1 <= int(text) <= len(events.label):
            return int(text) - 1
        raise InputError(f"{place}: there is no event {text}: they are numbered from 1 to {len(events.label)}")
    if time is None or int(time[1]) > _LAST_S:
        hint = did_you_mean(text, list(events.label))
        raise InputError(f"{place}: {text[:60]!r} is no event, no GPS time in seconds, and not {NONE!r}{hint}")
    gps_ns = int(time[1]) * 10**9 + int(time[2].ljust(9, "0")[:9])
    known = np.flatnonzero(events.gps_ns != NO_TIME)
    apart_s = np.abs(events.gps_ns[known] - gps_ns) * 1e-9
    if len(known) == 0 or float(apart_s.min()) > NEAR_S:
        nearest = f": the nearest is {apart_s.min():.2f} s away" if len(known) else ""
        raise InputError(f"{place}: no event is at GPS time {text}{nearest}")
    return int(known[np.argmin(apart_s)])
