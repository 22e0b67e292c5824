"""Where the messages of a ULog lie, though nothing but their own content tells; on bare arrays.

The rules of acceptance are stated in ``uavkit.formats.ulog_file``.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavkit.formats.kernels.jit import kernel

MORE = -1
"""What ``frame_length`` returns where the bytes at hand do not decide."""
PLACE, SYNCED, FRAMES, SPANS, DROPOUTS, DROPOUT_MS, DROPOUT_MOST_MS, STATE_LENGTH = 0, 1, 2, 3, 4, 5, 6, 7
"""Places in the state of a scan: the next byte, whether a message ends there, lengths of the lists, dropouts."""
STRAY, CUT_SHORT, CUT_OFF = 0, 1, 2
"""Why bytes are lost: no message can begin there; another message begins within; the file ends within."""
DONE, DEFINITION = 0, 1
"""Why a scan returns: it needs the next block (or more room for its lists); it met a definition of messages."""
HEADER_TYPE = 111
"""Type under which the header of the file is listed: its third byte."""
PROOF = 8
"""So many messages in a row are no accident."""
LEAST_DATA = 10
"""A number and a time."""
ORPHANS = 1024
"""Numbers of subscriptions stay below this."""

_A, _B, _C, _D, _F, _I, _L, _M, _O, _P, _Q, _R, _S = (np.uint8(ord(letter)) for letter in "ABCDFILMOPQRS")
_HEADER_TYPE = np.uint8(HEADER_TYPE)
_MAGIC = np.array([0x55, 0x4C, 0x6F, 0x67, 0x01, 0x12, 0x35], dtype=np.uint8)
_SYNC = np.array([0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12], dtype=np.uint8)
_SIZES = np.zeros((256, 2), dtype=np.int64)
for _letter, _least, _most in (
    ("S", 8, 8), ("O", 2, 2), ("R", 2, 2), ("B", 40, 256), ("F", 4, 4096), ("A", 4, 258), ("I", 4, 65535),
    ("P", 4, 65535), ("M", 5, 65535), ("Q", 5, 65535), ("L", 9, 1033), ("C", 11, 1035),
):  # fmt: skip
    _SIZES[ord(_letter)] = _least, _most
"""Least and greatest size of the messages of each type but data; 0 for types that are not known."""


class Tables(NamedTuple):
    """What is known of the log so far."""

    least: NDArray[np.int32]
    """(65536,) Least size of data messages by number of subscription; 0 while unknown."""
    most: NDArray[np.int32]
    """(65536,) Greatest size; -1 while unknown."""
    learned: NDArray[np.int32]
    """(65536,) Size that was seen though no format says it; 0 for none."""
    counts: NDArray[np.int64]
    """(65536,) Data messages found, by number."""
    known_sizes: NDArray[np.bool_]
    """(65536,) Whether some format has data messages of this size."""
    subscribed: NDArray[np.bool_]
    """(65536,) Whether a number has a subscription."""
    wanted: NDArray[np.bool_]
    """(65536,) Whether its data messages are to be listed."""
    type_counts: NDArray[np.int64]
    """(256,) Messages found, by type."""
    type_names: NDArray[np.uint8]
    """(t, 9) Names of the basic types, filled up with zeros."""
    type_sizes: NDArray[np.int64]
    """(t,)."""


@kernel
def _two_bytes(data: NDArray[np.uint8], place: int) -> int:
    return int(np.int64(data[place]) + 256 * np.int64(data[place + 1]))


@kernel
def _is_name(byte: int) -> bool:
    return (
        97 <= byte <= 122 or 65 <= byte <= 90 or 48 <= byte <= 57 or byte == 95 or byte == 45 or byte == 47
    )  # a-z A-Z 0-9 _ - /


@kernel
def _format_holds(data: NDArray[np.uint8], begin: int, end: int) -> bool:
    """Tell whether text reads ``name:type field;type field;``."""
    colons = spaces = 0
    for place in range(begin, end):
        byte = data[place]
        if byte == 58:
            colons += 1
        elif byte == 32:
            spaces += 1
        elif not (_is_name(byte) or byte == 59 or byte == 91 or byte == 93):
            return False
    return colons == 1 and spaces > 0


@kernel
def _name_holds(data: NDArray[np.uint8], begin: int, end: int) -> bool:
    for place in range(begin, end):
        if not _is_name(data[place]):
            return False
    return end > begin


@kernel
def _text_holds(data: NDArray[np.uint8], begin: int, end: int) -> bool:
    """Tell whether there are no control characters but tab, ends of lines and escape."""
    for place in range(begin, end):
        byte = data[place]
        if byte < 32 and byte != 9 and byte != 10 and byte != 13 and byte != 27:
            return False
    return True


@kernel
def _is_level(byte: int) -> bool:
    """Tell whether a byte is a level of severity, 0 to 7, as a digit or as a number."""
    return 48 <= byte <= 55 or byte <= 7


@kernel
def _digits(data: NDArray[np.uint8], begin: int, end: int) -> int:
    """Return the number that one to five digits make, -1 where they do not."""
    if not 1 <= end - begin <= 5:
        return -1
    number = 0
    for place in range(begin, end):
        if not 48 <= data[place] <= 57:
            return -1
        number = number * 10 + data[place] - 48
    return number


@kernel
def _type_size(data: NDArray[np.uint8], begin: int, end: int, tables: Tables) -> int:
    """Return the size of the basic type that is named, -1 for none."""
    names, length = tables.type_names, end - begin
    if not 0 < length <= names.shape[1]:
        return -1
    for row in range(len(names)):
        same = length == names.shape[1] or names[row, length] == 0
        for place in range(length):
            same = same and names[row, place] == data[begin + place]
        if same:
            return int(tables.type_sizes[row])
    return -1


@kernel
def _value_length(data: NDArray[np.uint8], begin: int, end: int, tables: Tables) -> int:
    """Return the length of the value that a key ``type name`` or ``type[n] name`` announces; -1 for no key."""
    space = begin
    while space < end and data[space] != 32:
        space += 1
    if space == begin or space + 1 >= end:
        return -1
    for place in range(space + 1, end):
        if data[place] <= 32 or data[place] >= 127:
            return -1
    stop, count = space, 1
    if data[space - 1] == 93:
        stop = begin
        while stop < space and data[stop] != 91:
            stop += 1
        count = _digits(data, stop + 1, space - 1)
    size = _type_size(data, begin, stop, tables)
    return size * count if size > 0 and count >= 0 else -1


@kernel
def _begins_with(data: NDArray[np.uint8], place: int, mark: NDArray[np.uint8]) -> bool:
    same = True
    for k in range(min(len(mark), len(data) - place)):
        same = same and data[place + k] == mark[k]
    return bool(same)


@kernel
def _content_holds(data: NDArray[np.uint8], kind: int, body: int, end: int, tables: Tables) -> bool:
    """Tell whether the content of a message, from ``body`` to ``end``, is of its type; data messages left out."""
    if kind == _S:
        return _begins_with(data, body, _SYNC)
    if kind == _B:
        far = data[body + 22] | data[body + 23] | data[body + 30] | data[body + 31] | data[body + 38] | data[body + 39]
        return bool(far == 0)
    if kind == _F:
        return _format_holds(data, body, end)
    if kind == _A:
        return _name_holds(data, body + 3, end)
    if kind in (_I, _P, _M, _Q):
        key = body + 1 if kind in (_I, _P) else body + 2
        stop = key + int(np.int64(data[key - 1]))
        return stop <= end and _value_length(data, key, stop, tables) == end - stop
    if kind in (_L, _C):
        time = body + 1 if kind == _L else body + 3
        years = data[time + 6] | data[time + 7]  # 48 bits of microseconds are nine years
        return bool(_is_level(data[body]) and years == 0 and _text_holds(data, time + 8, end))
    return True


@kernel
def _data_length(
    data: NDArray[np.uint8], place: int, least: NDArray[np.int32], most: NDArray[np.int32], learned: NDArray[np.int32]
) -> int:
    """Return the length of the data message at a place, 0 for none, MORE for more bytes."""
    n = len(data)
    if place + 5 > n:
        return MORE
    size, number = _two_bytes(data, place), _two_bytes(data, place + 3)
    fits = least[number] <= size <= most[number] or size == learned[number]
    if data[place + 2] != _D or size < LEAST_DATA or not fits:
        return 0
    return 3 + size if place + 3 + size <= n else MORE


@kernel
def _is_plain(
    data: NDArray[np.uint8], place: int, least: NDArray[np.int32], most: NDArray[np.int32], learned: NDArray[np.int32]
) -> bool:
    """Tell whether a data message begins at a place, another one follows it, and nothing in it looks like a third.

    So it is with nearly all of them; the others are judged at length.
    """
    length = _data_length(data, place, least, most, learned)
    end = place + length
    if length <= 0 or _data_length(data, end, least, most, learned) <= 0:
        return False
    for start in range(place + 1, end):
        kind = data[start + 2]
        if kind == _D and _data_length(data, start, least, most, learned) != 0:
            return False
        if kind == _S and data[start] == len(_SYNC):
            return False
    return True


@kernel
def frame_length(data: NDArray[np.uint8], place: int, tables: Tables) -> int:
    """Return the length of the message that its content says begins at a place, 0 for none, MORE for more bytes."""
    n = len(data)
    if place + 3 > n:
        return MORE
    kind = data[place + 2]
    if kind == _D:
        return _data_length(data, place, tables.least, tables.most, tables.learned)
    size = _two_bytes(data, place)
    length = 3 + size
    if kind == _HEADER_TYPE:
        if not _begins_with(data, place, _MAGIC):
            return 0
        return 16 if place + 16 <= n else MORE
    if not _SIZES[kind, 0] <= size <= _SIZES[kind, 1] or _SIZES[kind, 1] == 0:
        return 0
    if place + length > n:
        return MORE
    return length if _content_holds(data, kind, place + 3, place + length, tables) else 0


@kernel
def _orphan_length(data: NDArray[np.uint8], place: int, tables: Tables) -> int:
    """Return the length of a data message whose subscription or format was lost, 0 for none, MORE for more bytes.

    It has the size of a format that is known, or the number of a subscription without any message yet.
    """
    n = len(data)
    if place + 5 > n:
        return MORE
    size = _two_bytes(data, place)
    number = _two_bytes(data, place + 3)
    if data[place + 2] != _D or size < LEAST_DATA:
        return 0
    orphan = number < ORPHANS and tables.most[number] < 0 and tables.known_sizes[size]
    unproven = tables.subscribed[number] and tables.counts[number] == 0
    if not (orphan or unproven):
        return 0
    return 3 + size if place + 3 + size <= n else MORE


@kernel
def _any_length(data: NDArray[np.uint8], place: int, tables: Tables) -> int:
    """Return the length of a message or an orphan."""
    length = frame_length(data, place, tables)
    return length if length != 0 else _orphan_length(data, place, tables)


@kernel
def _chain_holds(data: NDArray[np.uint8], start: int, end: int, aligned: bool, tables: Tables) -> int:
    """Tell whether messages from ``start`` run on to ``end`` or beyond: 1, 0, or MORE."""
    sure = data[start + 2] in (_D, _S)
    at, count = start, 0
    while at < end and count < PROOF:
        length = _any_length(data, at, tables) if count else frame_length(data, at, tables)
        if length <= 0:
            return length
        at += length
        count += 1
    if count >= PROOF or (at == end and (count >= 2 or sure)):
        return 1
    if at == end or aligned:
        return 0
    if count >= 2 or sure or at == len(data):
        return 1
    return min(_any_length(data, at, tables), 1)


@kernel
def _hidden(data: NDArray[np.uint8], place: int, end: int, aligned: bool, tables: Tables) -> int:
    """Return where within a supposed message others begin that run on to its end or beyond; 0 for nowhere, or MORE.

    Where a message follows it (``aligned``), the hidden ones are data messages or marks and end with it exactly.
    """
    more = 0
    for start in range(place + 1, min(end, len(data) - 2)):
        kind = data[start + 2]
        if kind < 65 or (aligned and kind not in (_D, _S)):
            continue
        holds = _chain_holds(data, start, end, aligned, tables)
        if holds > 0:
            return start
        more = min(more, holds)
    return more


@kernel
def _judged(data: NDArray[np.uint8], final: bool, synced: bool, place: int, tables: Tables) -> tuple[int, int, bool]:
    """Judge the message that may begin at a place.

    Returns its length, whether it is an orphan; or 0, and the bytes to skip, negative where others cut it short; or
    MORE.
    """
    length, orphan = frame_length(data, place, tables), False
    if length == 0:
        length = _orphan_length(data, place, tables)
        orphan = length > 0
    if length <= 0:
        return (MORE, 0, False) if length == MORE and not final else (0, 1, False)
    end = place + length
    follows = end == len(data) and final
    if not follows:
        after = _any_length(data, end, tables)
        if after == MORE and not final:
            return MORE, 0, False
        follows = after > 0
    sure = not orphan and data[place + 2] in (_D, _S, _B, _HEADER_TYPE)
    if not follows and (orphan or not (synced or sure)):
        return 0, 1, False
    if not follows or data[place + 2] == _D:
        hidden = _hidden(data, place, end, follows, tables)
        if hidden == MORE and not final:
            return MORE, 0, False
        if hidden > 0:
            return 0, place - hidden, False
    return length, 0, orphan


@kernel
def _candidate(data: NDArray[np.uint8], place: int) -> int:
    """Return the first place from ``place`` on at which type and size are possible."""
    while place + 3 <= len(data):
        kind = data[place + 2]
        if kind == _D or (kind == _HEADER_TYPE and data[place] == _MAGIC[0]):
            return place
        if _SIZES[kind, 1] > 0 and _SIZES[kind, 0] <= _two_bytes(data, place) <= _SIZES[kind, 1]:
            return place
        place += 1
    return place


@kernel
def _lose(state: NDArray[np.int64], spans: NDArray[np.int64], place: int, length: int, why: int) -> None:
    """List a span as lost, as a part of the one before where it touches it."""
    row = state[SPANS]
    if row > 0 and spans[row - 1, 0] + spans[row - 1, 1] == place:
        spans[row - 1, 1] += length
        return
    spans[row, 0], spans[row, 1], spans[row, 2] = place, length, why
    state[SPANS] = row + 1


@kernel
def _take(
    data: NDArray[np.uint8], place: int, length: int, orphan: bool, state: NDArray[np.int64],
    tables: Tables, frames: NDArray[np.int64],
) -> None:  # fmt: skip
    """Count a message, and list it where it is of use."""
    kind = data[place + 2]
    tables.type_counts[kind] += 1
    value = _two_bytes(data, place + 3)
    what = -int(np.int64(kind))
    listed = kind not in (_S, _O, _R)
    if kind == _D:
        if orphan and tables.learned[value] == 0:
            tables.learned[value] = length - 3
        tables.counts[value] += 1
        what, listed = value, tables.wanted[value]
    elif kind == _O:
        state[DROPOUTS] += 1
        state[DROPOUT_MS] += value
        state[DROPOUT_MOST_MS] = max(state[DROPOUT_MOST_MS], value)
    if listed:
        row = state[FRAMES]
        frames[row, 0], frames[row, 1], frames[row, 2] = place, length, what
        state[FRAMES] = row + 1


@kernel
def scan(
    data: NDArray[np.uint8],
    final: bool,
    state: NDArray[np.int64],
    tables: Tables,
    frames: NDArray[np.int64],
    spans: NDArray[np.int64],
) -> int:
    """Go through a block from ``state[PLACE]``, and return DONE or DEFINITION.

    ``frames``, (f, 3), takes place, length and number (data) or minus the type of the messages to list; ``spans``,
    (s, 3), takes place, length and reason of what is lost. The scan stops where either is full.
    """
    n, place, synced = len(data), state[PLACE], state[SYNCED] != 0
    answer = DONE
    while place < n and state[FRAMES] < len(frames) and state[SPANS] < len(spans):
        if synced and _is_plain(data, place, tables.least, tables.most, tables.learned):
            length, skip, orphan = 3 + _two_bytes(data, place), 0, False
        else:
            length, skip, orphan = _judged(data, final, synced, place, tables)
        if length == MORE:
            break
        if length == 0:
            cut_off = synced and frame_length(data, place, tables) == MORE
            why = CUT_SHORT if skip < 0 else CUT_OFF if cut_off else STRAY
            _lose(state, spans, place, abs(skip), why)
            place += abs(skip)
            synced = False
            after = _candidate(data, place)
            if after > place:
                _lose(state, spans, place, after - place, STRAY)
                place = after
            continue
        _take(data, place, length, orphan, state, tables, frames)
        synced = True
        place += length
        if data[place - length + 2] in (_A, _F):
            answer = DEFINITION
            break
    state[PLACE] = place
    state[SYNCED] = 1 if synced else 0
    return answer
