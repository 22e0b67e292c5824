"""Dataflash logs as text: the same tables as from the binary log, and damaged lines counted."""

import re
import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.formats.dataflash_made import BOOT_US, MODERN, WEEK, WEEK_MS
from tests.formats.log_damage import Damaged, damaged
from uavkit.core.errors import InputError
from uavkit.core.flight_log import FlightLog, LogKind
from uavkit.formats import dataflash, dataflash_text
from uavkit.formats.dataflash_fields import WANTED, Messages

SIM_LOG = Path(__file__).resolve().parents[2] / "sim_logs" / "sitl_distance_trigger" / "flight.BIN"


def as_text(path: Path, apart: str = ", ", end: str = "\n") -> str:
    """Return a binary log as text, written by pymavlink's decoding."""
    from pymavlink import DFReader

    lines = list[str]()
    with DFReader.DFReader_binary(str(path)) as reader:
        while (message := reader.recv_msg()) is not None:
            values = [str(getattr(message, column)) for column in message.get_fieldnames()]
            lines.append(apart.join([message.get_type(), *values]) + end)
    return "".join(lines)


def read(tmp_path: Path, text: "str | bytes") -> FlightLog:
    path = tmp_path / "made.log"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    assert dataflash_text.recognises(path.read_bytes()[:65536])
    return dataflash_text.read_log(path)


def definition(name: str, kinds: "dict[str, tuple[int, str, str]] | None" = None) -> str:
    number, characters, columns = (kinds or MODERN)[name]
    return f"FMT, {number}, 99, {name}, {characters}, {columns}\n"


HEAD = "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n" + "".join(map(definition, MODERN))


@pytest.mark.parametrize(("apart", "end"), [(", ", "\n"), (",", "\r\n"), ("  ,   ", " \n")])
def test_the_tables_of_a_log_are_those_of_the_binary_one(tmp_path: Path, apart: str, end: str) -> None:
    binary, text = dataflash.read_log(SIM_LOG), read(tmp_path, as_text(SIM_LOG, apart, end))
    assert text.kind is LogKind.DATAFLASH_TEXT
    assert text.damage.lost_bytes == 0
    assert text.message_counts == binary.message_counts
    assert (text.vehicle, text.texts, text.notes) == (binary.vehicle, binary.texts, binary.notes)
    assert text.parameters == pytest.approx(binary.parameters, rel=1e-15, nan_ok=True)
    for table in ("fix_table", "estimate_table", "attitude_table", "exposure_table"):
        ours, theirs = getattr(text, table), getattr(binary, table)
        assert len(ours) > 30
        np.testing.assert_array_equal(ours.when.gps_ns, theirs.when.gps_ns)
        np.testing.assert_array_equal(ours.when.boot_ns, theirs.when.boot_ns)
        for column in fields(ours):
            if column.name not in ("when", "name"):
                np.testing.assert_allclose(
                    getattr(ours, column.name), getattr(theirs, column.name), rtol=1e-15, atol=1e-14
                )


def test_numbers_of_all_kinds(tmp_path: Path) -> None:
    written = [
        "0",
        "-0.5",
        "+1.25",
        "1e3",
        "-2.5E-3",
        ".5",
        "7.",
        "nan",
        "123456789012345678901",
        "0.30000001192092896",
    ]
    lines = "".join(f"PARM, {BOOT_US + k}, P{k}, {value}, 0\n" for k, value in enumerate(written))
    result = read(tmp_path, HEAD + lines)
    for k, value in enumerate(written):
        assert result.parameters[f"P{k}"] == pytest.approx(float(value), rel=3e-16, nan_ok=True)
    assert result.damage.lost_bytes == 0


def test_texts_may_hold_commas(tmp_path: Path) -> None:
    result = read(tmp_path, HEAD + f"MSG, {BOOT_US}, Mission: 3, 4, Waypoint  \nMSG, {BOOT_US}, übel\n")
    assert result.texts == ("Mission: 3, 4, Waypoint", "übel")


def test_lines_that_cannot_be_understood_are_lost(tmp_path: Path) -> None:
    good = f"ATT, {BOOT_US}, 0, 1, 0, 2, 0, 3, 3\n"
    bad = [
        f"ATT, {BOOT_US}, 0, 1, 0, 2, 0, 3\n",
        f"ATT, {BOOT_US}, 0, 1x, 0, 2, 0, 3, 3\n",
        f"ATT, {BOOT_US}, 0, 1, 0, , 0, 3, 3\n",
        f"AT\0, {BOOT_US}, 0, 1, 0, 2, 0, 3, 3\n",
        "what is this\n",
        "NEW, 1, 2, 3\n",
        f"ATT, {BOOT_US}, 0, 1, 0, 2, 0, 3, \x80\n",
        "FMT, 300, 12, XY, Q, TimeUS\n",
        ", 1\n",
    ]
    for line in bad:
        raw = line.encode("latin-1")
        result = read(tmp_path, HEAD.encode() + good.encode() + raw + good.encode() + b"\n  \n")
        assert result.damage.lost_bytes == len(raw), line
        assert result.damage.spans[0].offset == len(HEAD) + len(good)
        assert len(result.attitude_table) == 2


def test_a_message_whose_line_begins_in_another_is_found(tmp_path: Path) -> None:
    good = f"ATT, {BOOT_US}, 0, 1, 0, 2, 0, 3, 3\n"
    result = read(tmp_path, HEAD + good + f"POS, {BOOT_US}, 35.8, 13" + good)
    assert len(result.attitude_table) == 2
    assert result.damage.lost_bytes == len(f"POS, {BOOT_US}, 35.8, 13")


def test_a_message_that_a_text_ran_into_is_found(tmp_path: Path) -> None:
    good = f"ATT, {BOOT_US}, 0, 1, 0, 2, 0, 3, 3\n"
    result = read(tmp_path, HEAD + f"MSG, {BOOT_US}, Mission: 3 WP" + good)
    assert len(result.attitude_table) == 1
    assert result.texts == ()
    assert result.damage.lost_bytes == len(f"MSG, {BOOT_US}, Mission: 3 WP")


def test_a_last_line_without_an_end(tmp_path: Path) -> None:
    good = f"ATT, {BOOT_US}, 0, 1, 0, 2, 0, 3, 3"
    assert len(read(tmp_path, HEAD + good).attitude_table) == 1
    cut = read(tmp_path, HEAD + good[:-3])
    assert (len(cut.attitude_table), cut.damage.lost_bytes) == (0, len(good) - 3)


def test_a_definition_is_good_for_what_stands_before_it(tmp_path: Path) -> None:
    good = f"ATT, {BOOT_US}, 0, 1, 0, 2, 0, 3, 3\n"
    result = read(tmp_path, good + HEAD + good)
    assert len(result.attitude_table) == 2
    assert result.damage.lost_bytes == 0


def test_old_firmware(tmp_path: Path) -> None:
    text = (
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format\n"
        "FMT, 130, 45, GPS, BIHBcLLeeEefI, Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T\n"
        "GPS, 3, 130040903, 1769, 10, 0.00, -35.3547178, 149.1696673, 885.52, 870.45, 24.56, 321.44, 2.450000, 127615\n"
    )
    fixes = read(tmp_path, text).fix_table
    assert [fixes.latitude_deg[0], fixes.longitude_deg[0]] == [-35.3547178, 149.1696673]
    assert [fixes.height_geoid_m[0], fixes.height_above_home_m[0]] == [870.45, 885.52]
    assert fixes.velocity_m_s[0, 2] == -2.45
    assert fixes.when.boot_ns.tolist() == [127_615_000_000]
    assert fixes.satellites.tolist() == [10]


def test_what_is_not_recognised() -> None:
    assert not dataflash_text.recognises(SIM_LOG.read_bytes()[:65536])
    assert not dataflash_text.recognises(b"name,lat,lon\nFMT,35,139\n")
    assert not dataflash_text.recognises(b"")


def test_nothing_defined(tmp_path: Path) -> None:
    path = tmp_path / "made.log"
    path.write_text("ATT, 1, 2\n")
    with pytest.raises(InputError, match="no line defines"):
        dataflash_text.read_log(path)


def test_a_line_without_an_end_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "made.log"
    good = f"ATT, {BOOT_US}, 0, 1, 0, 2, 0, 3, 3\n"
    path.write_bytes(HEAD.encode() + b"x" * 20_000_000 + b"\n" + good.encode())
    begin = time.perf_counter()
    result = dataflash_text.read_log(path)
    assert time.perf_counter() - begin < 5.0
    assert result.damage.lost_bytes == 20_000_001
    assert len(result.attitude_table) == 1


def flight() -> tuple[str, list[tuple[int, int, str]]]:
    """Return a made log as text, and its lines: begin, end, name."""
    rng = np.random.default_rng(3)
    parts = HEAD.splitlines(keepends=True)
    for tick in range(300):
        at_us = BOOT_US + 40_000 * tick
        parts.append(f"ATT, {at_us}, 0, {tick * 0.01:.2f}, 0, {-tick * 0.02:.2f}, 0, {tick * 0.5}, 3\n")
        parts.append(f"POS, {at_us + 1}, {35.8 + tick * 1e-7:.7f}, 139.65, {20 + tick}, {rng.normal()}, 1\n")
        if tick % 5 == 0:
            time = f"{WEEK_MS + 40 * tick}, {WEEK}"
            parts.append(f"GPS, {at_us + 2}, 0, 6, {time}, 14, 1.21, 35.8, 139.65, 20.07, 4, 90, -0.5, 0, 1\n")
        if tick % 9 == 0:
            parts.append(f"EV, {at_us + 3}, {tick}\n")
            parts.append(f"MSG, {at_us + 4}, text {tick}, and more\n")
    lines, at = list[tuple[int, int, str]](), 0
    for part in parts:
        lines.append((at, at + len(part), part.split(",")[0]))
        at += len(part)
    return "".join(parts), lines


def understood(line: bytes) -> bool:
    """Tell whether a line is a message, by rules of this test's own."""
    if re.search(rb"[\0-\x08\x0b\x0c\x0e-\x1f\x7f]", line):
        return False
    name, *values = [value.strip() for value in line.split(b",")]
    if name == b"FMT":
        return len(values) >= 5
    if name.decode("latin-1") not in MODERN:
        return False
    _, characters, _ = MODERN[name.decode()]
    if characters[-1] == "Z":
        values = [*values[: len(characters) - 1], b",".join(values[len(characters) - 1 :])]
    if len(values) != len(characters) or (max(line) > 127 and not set(characters) & set("nNZ")):
        return False
    if name.decode() not in WANTED:
        return True
    number = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,4})?|[+-]?nan\w?|[+-]?inf", re.IGNORECASE)
    return all(c in "nNZ" or number.fullmatch(value) for c, value in zip(characters, values, strict=True))


def check(text: str, lines: Sequence[tuple[int, int, str]], seed: int, path: Path) -> str:
    rng = np.random.default_rng(seed)
    hurt = damaged(text.encode(), rng, longest=200)
    path.write_bytes(hurt.data)
    result = dataflash_text.read_messages(path, block_bytes=int(rng.choice([512, 4096, 1 << 20])))
    found = {
        begin + offset: name for begin, end, name in lines for a, b, offset in hurt.intact if a <= begin and end <= b
    }
    if min(end + offset for _, end, offset in hurt.intact) < len(HEAD) or hurt.intact[-1][0] < len(HEAD):
        return "definition"
    read = {int(place): name for name, rows in result.rows.items() for place in rows.places}
    for place, name in found.items():
        assert name not in WANTED or read.get(place) == name
    assert result.damage.lost_bytes == lost_bytes(hurt.data, found)
    compare(result, text, hurt, lines)
    return hurt.kind


def lost_bytes(data: bytes, found: dict[int, str]) -> int:
    """Return the bytes of lines that are not understood; what stands whole at the end of one is not lost."""
    lost, at = 0, 0
    for line in split(data):
        inside = [place for place in found if at < place < at + len(line)]
        if inside:
            lost += min(inside) - at
        elif not understood(line) and line.strip():
            lost += len(line)
        at += len(line)
    return lost


def split(data: bytes) -> list[bytes]:
    parts = data.split(b"\n")
    return [part + b"\n" for part in parts[:-1]] + ([parts[-1]] if parts[-1] else [])


def compare(result: Messages, text: str, hurt: Damaged, lines: Sequence[tuple[int, int, str]]) -> None:
    """Compare the numbers of untouched lines with what Python reads in them."""
    moved = [(hurt.moved(begin, end), begin, end, name) for begin, end, name in lines]
    for name in ("ATT", "POS", "GPS"):
        whole = [(place, begin, end) for place, begin, end, kind in moved if place is not None and kind == name]
        written = np.array([[float(value) for value in text[begin:end].split(",")[1:]] for _, begin, end in whole])
        rows = result.of(name)
        at = np.searchsorted(rows.places, [place for place, _, _ in whole])
        for k, column in enumerate(rows.columns):
            np.testing.assert_allclose(rows.number(column)[at], written[:, k], rtol=3e-16)


def test_damage_leaves_the_other_lines(tmp_path: Path) -> None:
    text, lines = flight()
    seen = {check(text, lines, seed, tmp_path / "hurt.log") for seed in range(40)}
    assert {"cut", "zeroed", "repeated", "flipped"} <= seen


@pytest.mark.slow
def test_more_damage_leaves_the_other_lines(tmp_path: Path) -> None:
    text, lines = flight()
    for seed in range(500):
        check(text, lines, 1000 + seed, tmp_path / "hurt.log")


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=40)), max_size=8), st.binary(max_size=300))
def test_no_bytes_whatever_end_in_a_traceback(
    tmp_path_factory: pytest.TempPathFactory, changes: list[tuple[int, bytes]], rest: bytes
) -> None:
    data = bytearray(FUZZED)
    for place, piece in changes:
        at = place % len(data)
        data[at : at + len(piece)] = piece
    path = tmp_path_factory.mktemp("fuzz") / "fuzz.log"
    for content in (bytes(data) + rest, rest, b"FMT, 1, 5, GPS, QQ, TimeUS,GWk\n" + rest):
        path.write_bytes(content)
        try:
            result = dataflash_text.read_log(path)
        except InputError:
            continue
        assert 0 <= result.damage.lost_bytes <= len(content)
        list(result.fixes()), list(result.exposures()), list(result.attitudes())


FUZZED = flight()[0][:4000].encode()
