"""Damaged dataflash logs: what damage did not touch is found with its content, and lost bytes are counted exactly.

What is to be found is worked out from the intact log's own list of messages, without the reader's scan.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.formats.dataflash_made import MadeLog, small_flight
from tests.formats.log_damage import Damaged, damaged
from uavkit.formats.dataflash import read_messages
from uavkit.formats.dataflash_fields import Messages

SIM_LOG = Path(__file__).resolve().parents[2] / "sim_logs" / "sitl_distance_trigger" / "flight.BIN"
MINUTE_US = 60_000_000


@dataclass(frozen=True)
class Intact:
    """A log and its messages (begin, end, name), types and lengths by name, and which have TimeUS first."""

    data: bytes
    messages: list[tuple[int, int, str]]
    types: dict[int, str]
    lengths: dict[str, int]
    timed: frozenset[str]
    decoded: Messages


def made(tmp_path: Path, seed: int) -> Intact:
    log = small_flight(np.random.default_rng(seed))
    types = {number: name for name, (number, _, _) in log.kinds.items()} | {0x80: "FMT"}
    lengths = {name: log.length(name) for name in types.values()}
    timed = frozenset(name for name, (_, _, columns) in log.kinds.items() if columns.startswith("TimeUS"))
    return intact(tmp_path, bytes(log.data), log.messages, types, lengths, timed)


def recorded(tmp_path: Path) -> Intact:
    """Return the recorded flight, its messages as pymavlink finds them."""
    from pymavlink import DFReader

    with DFReader.DFReader_binary(str(SIM_LOG)) as reader:
        formats = reader.formats
        messages = sorted(
            (place, place + formats[kind].len, formats[kind].name)
            for kind in range(256)
            for place in reader.offsets[kind]
        )
        types = {kind: known.name for kind, known in formats.items()}
        lengths = {known.name: known.len for known in formats.values()}
        timed = frozenset(known.name for known in formats.values() if known.columns[:1] == ["TimeUS"])
    return intact(tmp_path, SIM_LOG.read_bytes(), messages, types, lengths, timed)


def intact(
    tmp_path: Path,
    data: bytes,
    messages: list[tuple[int, int, str]],
    types: dict[int, str],
    lengths: dict[str, int],
    timed: frozenset[str],
) -> Intact:
    path = tmp_path / "intact.BIN"
    path.write_bytes(data)
    decoded = read_messages(path, frozenset(types.values()))
    assert decoded.damage.lost_bytes == len(data) - sum(end - begin for begin, end, _ in messages)
    places = {name: [begin for begin, _, kind in messages if kind == name] for name in types.values()}
    for name, rows in decoded.rows.items():
        assert rows.places.tolist() == places[name]
    return Intact(data, messages, types, lengths, timed, decoded)


def time_us(data: bytes, place: int) -> int:
    return int.from_bytes(data[place + 3 : place + 11], "little")


def untouched(log: Intact, hurt: Damaged) -> dict[int, tuple[int, str]]:
    """Return by its new place each message that stands whole in a span that damage did not touch: old place, name."""
    return {
        begin + offset: (begin, name)
        for begin, end, name in log.messages
        for a, b, offset in hurt.intact
        if a <= begin and end <= b
    }


def touched_and_accepted(log: Intact, hurt: Damaged, found: dict[int, tuple[int, str]]) -> Iterator[tuple[int, str]]:
    """Yield place and name of damaged messages whose head stands and whose damage nothing tells (rule in dataflash)."""
    whole = {old for old, _ in found.values()}
    last_us = 0
    for begin, _, name in log.messages:
        before_us = last_us
        if name in log.timed:
            last_us = time_us(log.data, begin)
        spans = [offset for a, b, offset in hurt.intact if a <= begin < b]
        for offset in spans:
            place = begin + offset
            if place in found or (begin in whole and len(spans) == 1):
                continue
            kind = head(log, hurt.data, place)
            end = place + log.lengths.get(kind, 0)
            if not kind or end > len(hurt.data) or any(place < other < end for other in found):
                continue
            followed = end == len(hurt.data) or bool(head(log, hurt.data, end))
            if followed or kind not in log.timed or abs(time_us(hurt.data, place) - before_us) <= MINUTE_US:
                yield place, kind


def head(log: Intact, data: bytes, place: int) -> str:
    return (
        log.types.get(data[place + 2], "") if data[place : place + 2] == b"\xa3\x95" and place + 2 < len(data) else ""
    )


def check(log: Intact, seed: int, path: Path) -> str:
    """Read one damaged log and compare; returns the kind of damage."""
    rng = np.random.default_rng(seed)
    hurt = damaged(log.data, rng)
    path.write_bytes(hurt.data)
    block_bytes = int(rng.choice([1500, 4096, 65_536, 1 << 23]))
    result = read_messages(path, frozenset(log.types.values()), block_bytes=block_bytes)
    read = {int(place): name for name, rows in result.rows.items() for place in rows.places}
    accepted_bytes = sum(count * log.lengths[name] for name, count in result.counts.items() if name in log.lengths)
    found = untouched(log, hurt)
    kept = {old for old, _ in found.values()}
    if any(name == "FMT" and begin not in kept for begin, _, name in log.messages):
        return "definition"
    assert result.damage.lost_bytes == len(hurt.data) - accepted_bytes
    extra = dict(touched_and_accepted(log, hurt, found))
    expected = {place: name for place, (_, name) in found.items()} | extra
    assert read == {place: name for place, name in expected.items() if name != "FMT"}
    assert result.damage.lost_bytes == len(hurt.data) - sum(log.lengths[name] for name in expected.values())
    assert sum(span.length for span in result.damage.spans) == result.damage.lost_bytes
    check_content(log, result, found)
    return hurt.kind


def check_content(log: Intact, result: Messages, found: dict[int, tuple[int, str]]) -> None:
    for name, rows in result.rows.items():
        before = log.decoded.of(name)
        whole = np.array([int(place) in found for place in rows.places], dtype=bool)
        old = np.array([found[int(place)][0] for place in rows.places[whole]], dtype=np.int64)
        at = np.searchsorted(before.places, old)
        for column, values in rows.columns.items():
            assert values[whole].tobytes() == before.columns[column][at].tobytes()


def test_damage_leaves_the_rest_of_a_made_log(tmp_path: Path) -> None:
    log = made(tmp_path, 1)
    seen = {check(log, seed, tmp_path / "hurt.BIN") for seed in range(200)}
    assert {"cut", "zeroed", "repeated", "flipped"} <= seen


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_damage_leaves_the_rest_of_made_logs(tmp_path: Path, seed: int) -> None:
    log = made(tmp_path, seed + 2)
    for trial in range(200):
        check(log, 1000 * (seed + 1) + trial, tmp_path / "hurt.BIN")


def test_damage_leaves_the_rest_of_a_recorded_flight(tmp_path: Path) -> None:
    log = recorded(tmp_path)
    for seed in range(20):
        check(log, seed, tmp_path / "hurt.BIN")


@pytest.mark.slow
def test_more_damage_leaves_the_rest_of_a_recorded_flight(tmp_path: Path) -> None:
    log = recorded(tmp_path)
    for seed in range(300):
        check(log, 5000 + seed, tmp_path / "hurt.BIN")


def test_a_message_cut_short_does_not_swallow_the_one_behind_it(tmp_path: Path) -> None:
    """Its length then leads to a head again, by chance: the cut is as long as the message behind it."""
    log = MadeLog().define_all()
    for k in range(5):
        log.add("NOIS", 42_000_000 + 10 * k, b"noise")
    place = len(log.data) - log.length("NOIS")
    log.add("ATT", 42_000_100, 0.0, 1.0, 0.0, 2.0, 0.0, 3.0, 3)
    log.add("EV", 42_000_110, 7)
    keep = log.length("NOIS") - log.length("ATT")
    data = bytes(log.data[: place + keep] + log.data[place + log.length("NOIS") :])
    path = tmp_path / "cut.BIN"
    path.write_bytes(data)
    result = read_messages(path)
    assert result.counts["ATT"] == 1
    assert result.counts["NOIS"] == 4
    assert result.of("ATT").number("Roll").tolist() == [1.0]
    assert [(span.offset, span.length) for span in result.damage.spans] == [(place, keep)]


def test_a_head_inside_a_payload_is_no_message(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    ev_like = b"\xa3\x95" + bytes([log.kinds["EV"][0]]) + bytes(range(9))
    for k in range(200):
        log.add("NOIS", 42_000_000 + 10 * k, bytes(64 - len(ev_like)) + ev_like)
    path = tmp_path / "heads.BIN"
    path.write_bytes(bytes(log.data))
    result = read_messages(path)
    assert result.counts["NOIS"] == 200
    assert "EV" not in result.counts
    assert result.damage.lost_bytes == 0


def test_a_lost_definition_costs_its_own_messages_only(tmp_path: Path) -> None:
    log = made(tmp_path, 7)
    definitions = [(begin, end) for begin, end, name in log.messages if name == "FMT"]
    names = ["FMT", *(log.types[log.data[begin + 3]] for begin, _ in definitions[1:])]
    until = definitions[-1][1]
    path, hit = tmp_path / "hurt.BIN", 0
    for seed in range(60):
        hurt = damaged(log.data[: until + 200], np.random.default_rng(seed), longest=150)
        shift = len(hurt.data) - until - 200
        path.write_bytes(hurt.data + log.data[until + 200 :])
        lost = {name for name, (begin, end) in zip(names, definitions, strict=True) if hurt.moved(begin, end) is None}
        hit += bool(lost)
        result = read_messages(path, frozenset(log.types.values()))
        read = {(int(place), name) for name, rows in result.rows.items() for place in rows.places}
        behind = [(begin + shift, name) for begin, _, name in log.messages if begin >= until + 200]
        assert {message for message in behind if message[1] not in lost} <= read
    assert hit > 40
