"""Streams of receivers: what is found in mixed and damaged ones, and what is counted as lost."""

import time
import tracemalloc
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.formats import receiver_bytes as made
from tests.formats.log_damage import damaged
from uavkit.core.errors import InputError
from uavkit.core.gpstime import gps_time_ns_from_week
from uavkit.core.progress import silent
from uavkit.formats import nmea, receiver_stream, ubx
from uavkit.formats.log_bytes import DamageTally


def mixed_stream(rng: np.random.Generator, count: int = 60) -> bytes:
    """Return a stream of every kind of message, with the marks of messages inside payloads."""
    false_frame = b"\xb5\x62\x01\x07\xff\xff" + b"$GPGGA,1*" + b"\xd3\x03\xff"
    makers = (
        lambda n: made.pvt(200 * n, (2026, 1, 4, 0, 0, n % 60), lat=int(rng.integers(-(10**9) // 2, 10**9 // 2))),
        lambda n: made.nmea(f"GNGGA,0000{n % 60:02d}.00,3536.{n:05d},N,13942.0,E,1,12,0.9,36.2,M,39.3,M,,"),
        lambda n: made.rtcm(rng.bytes(int(rng.integers(0, 200)))),
        lambda n: made.ubx(2, 0x15, rng.bytes(int(rng.integers(0, 300))) + false_frame + rng.bytes(30)),
        lambda n: made.tm2(n, (made.WEEK, 200 * n + 17, n)),
        lambda n: made.nmea(f"GNRMC,0000{n % 60:02d}.00,A,3536.0,N,13942.0,E,0.1,,040126,,,A"),
        lambda n: made.ubx(1, 0x61, b""),
    )
    return b"".join(makers[int(rng.integers(len(makers)))](n) for n in range(count))


def found(data: bytes, block_bytes: int = receiver_stream.BLOCK_BYTES) -> tuple[list[tuple[int, int]], DamageTally]:
    tally = DamageTally()
    places: list[tuple[int, int]] = []
    for batch in receiver_stream.batches(BytesIO(data), tally, block_bytes):
        places += [(begin + batch.offset, length) for begin, length in batch.places.tolist()]
    return places, tally


def test_clean_stream_loses_nothing() -> None:
    data = mixed_stream(np.random.default_rng(3), 200)
    places, tally = found(data)
    assert places == list(made.plain_messages(data))
    assert len(places) == 200
    assert sum(length for _, length in places) == len(data)
    assert tally.result().lost_bytes == 0


def check_damage(seeds: range) -> None:
    for seed in seeds:
        rng = np.random.default_rng([20, seed])
        data = mixed_stream(rng)
        whole = list(made.plain_messages(data))
        hurt = damaged(data, rng)
        places, tally = found(hurt.data, int(rng.integers(200, 5000)))
        lengths = dict(places)
        assert places == list(made.plain_messages(hurt.data)), f"seed {seed}"
        assert tally.result().lost_bytes == len(hurt.data) - sum(lengths.values()), f"seed {seed}"
        touched = 0
        for begin, length in whole:
            moved = hurt.moved(begin, begin + length)
            if moved is None:
                touched += length
            else:
                assert lengths[moved] >= length, f"seed {seed}: message at {begin}"
        assert tally.result().lost_bytes <= touched + max(len(hurt.data) - len(data), 0), f"seed {seed}"


def test_damage_hurts_only_what_it_touches() -> None:
    check_damage(range(120))


@pytest.mark.slow
def test_damage_at_a_thousand_places() -> None:
    check_damage(range(1000, 2000))


def test_every_untouched_position_and_mark_is_read_with_its_content(tmp_path: Path) -> None:
    path = tmp_path / "hurt.ubx"
    for seed in range(60):
        rng = np.random.default_rng([21, seed])
        messages = [
            made.pvt(200 * n, lat=350_000_000 + n) if n % 3 else made.tm2(n, (made.WEEK, 200 * n, n)) for n in range(60)
        ]
        ends = np.cumsum([len(message) for message in messages]).tolist()
        hurt = damaged(b"".join(messages), rng)
        path.write_bytes(hurt.data)
        log = ubx.read_log(path, silent)
        latitudes, sequences = set(log.fix_table.latitude_deg.tolist()), set(log.exposure_table.sequence.tolist())
        for n, (message, end) in enumerate(zip(messages, ends, strict=True)):
            if hurt.moved(end - len(message), end) is not None:
                assert (350_000_000 + n) / 1e7 in latitudes if n % 3 else n in sequences, f"seed {seed} message {n}"
        marks = log.exposure_table
        expected = [
            gps_time_ns_from_week(made.WEEK, 200_000_000 * number) + number for number in marks.sequence.tolist()
        ]
        assert marks.when.gps_ns.tolist() == expected


def test_reading_does_not_depend_on_blocks() -> None:
    rng = np.random.default_rng(5)
    data = b"".join(damaged(mixed_stream(rng, 20), rng).data for _ in range(5))
    expected, tally = found(data)
    for block_bytes in (1, 7, 64, 1000):
        places, again = found(data, block_bytes)
        assert places == expected
        assert again.result() == tally.result()


def test_reading_does_not_depend_on_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    data = b"".join(damaged(mixed_stream(rng, 20), rng).data for _ in range(5))
    expected, tally = found(data)
    monkeypatch.setattr(receiver_stream, "MOST_AT_ONCE", 3)
    places, again = found(data)
    assert places == expected
    assert again.result() == tally.result()


def test_a_sentence_ends_where_the_next_begins() -> None:
    assert found(made.nmea("GPTXT,a$GPTXT,b"))[0] == []


def test_spans_say_where_and_why() -> None:
    good = made.pvt(0)
    data = good + b"\xb5\x62\x01\x07\x04" + good + bytes(9) + good + b"$GPGGA,1" + good + b"\xd3\x00\x05" + good + b"?!"
    _, tally = found(data)
    spans = [(span.offset, span.length, span.why.split()[0]) for span in tally.result().spans]
    n = len(good)
    assert spans == [
        (n, 5, "u-blox"), (2 * n + 5, 9, "zeros"), (3 * n + 14, 8, "NMEA"), (4 * n + 22, 3, "RTCM"),
        (5 * n + 25, 2, "no"),
    ]  # fmt: skip
    assert tally.result().lost_bytes == 27


def test_wrong_checksums_are_lost() -> None:
    for message in (made.pvt(0), made.nmea("GPTXT,01,01,02,abc"), made.rtcm(b"\x3e\xd0" + bytes(17))):
        for place in range(1, len(message) - (2 if message[:1] == b"$" else 0)):
            hurt = bytearray(message)
            hurt[place] ^= 0x55
            places, tally = found(bytes(hurt) + made.ubx(1, 0x61, b""))
            assert [begin for begin, _ in places] == [len(message)], f"byte {place} of {message[:3]!r}"
            assert tally.result().lost_bytes == len(message)


def test_checksum_of_the_standard() -> None:
    """CRC-24Q of "123456789" is 0xCDE703 (catalogue of parametrised CRCs); NMEA's example of a sentence."""
    assert made.crc24q(b"123456789") == 0xCDE703
    assert made.nmea("GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,").endswith(b"*47\r\n")


def test_line_ends_and_lower_case_checksums() -> None:
    text = made.nmea("GPTXT,01,01,02,k")
    assert text[-4:-2] in (text[-4:-2].upper(), text[-4:-2].lower())
    for end in (b"\r\n", b"\n", b"\r\r\n", b""):
        for body in (text[:-2], text[:-4] + text[-4:-2].lower()):
            places, tally = found((body + end) * 3)
            assert places == [(n * len(body + end), len(body + end)) for n in range(3)]
            assert tally.result().lost_bytes == 0


def test_sentences_without_a_checksum_only_where_none_has_one() -> None:
    bare = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,\r\n"
    places, tally = found(bare * 3)
    assert len(places) == 3
    assert tally.result().lost_bytes == 0
    places, tally = found(bare + made.nmea("GPTXT,01,01,02,x") + bare)
    assert len(places) == 1
    assert tally.result().lost_bytes == 2 * len(bare)
    for not_one in (b"$GPGGA,1\n", b"$GPGGA,\x99\r\n", b"$,1,2\r\n", b"$GPGGA\r\n", b"$gpgga,1\r\n", bare[:-1]):
        assert found(not_one)[0] == []


def test_recognised_by_content() -> None:
    rng = np.random.default_rng(7)
    sentences = made.nmea("GPTXT,01,01,02,x") * 10
    bare = b"$GPGLL,4717.5,N,00833.9,E,120000,A\r\n" * 4
    assert ubx.recognises(mixed_stream(rng))
    assert not nmea.recognises(mixed_stream(rng))
    assert not ubx.recognises(sentences)
    assert nmea.recognises(sentences)
    assert nmea.recognises(bare)
    assert not ubx.recognises(bare)
    assert ubx.recognises(made.pvt(0)[50:] + made.pvt(0))
    for other in (b"", b"\xb5\x62", rng.bytes(60_000), b"FMT, 128, 89, FMT, BBnNZ\n" * 100, bytes(1000)):
        assert not ubx.recognises(other)
        assert not nmea.recognises(other)
    assert not ubx.recognises(rng.bytes(30_000) + made.pvt(0) + rng.bytes(30_000)), "a frame inside another log"


@settings(max_examples=80, deadline=None)
@given(st.binary(max_size=400), st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), max_size=8))
def test_any_bytes_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, noise: bytes, hits: list) -> None:  # type: ignore[type-arg]
    base = bytearray(mixed_stream(np.random.default_rng(9), 12) + noise)
    for place, value in hits:
        base[place % len(base)] = value
    path = tmp_path_factory.getbasetemp() / "any.ubx"
    for data in (bytes(base), noise):
        path.write_bytes(data)
        ubx.recognises(data)
        try:
            log = ubx.read_log(path, silent)
        except InputError:
            assert not list(made.plain_messages(data))
            continue
        covered = sum(length for _, length in made.plain_messages(data))
        assert log.damage.lost_bytes <= len(data) - covered


@settings(max_examples=80, deadline=None)
@given(st.data())
def test_any_payload_of_any_message_is_read(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    """Frames that are intact but tell nonsense."""
    kinds = st.sampled_from(
        [(1, 2), (1, 3), (1, 6), (1, 7), (1, 0x12), (1, 0x14), (1, 0x20), (1, 0x21), (1, 0x26), (13, 3)]
    )
    messages = st.lists(st.tuples(kinds, st.binary(min_size=14, max_size=100)), min_size=1, max_size=12)
    stream = b"".join(made.ubx(*kind, payload) for kind, payload in data.draw(messages))
    path = tmp_path_factory.getbasetemp() / "nonsense.ubx"
    path.write_bytes(stream)
    log = ubx.read_log(path, silent)
    assert log.damage.lost_bytes == 0
    list(log.fixes())
    list(log.exposures())


def test_hostile_streams_take_bounded_time() -> None:
    """Beginnings of the longest frames, over and over: each fails, and none may cost its length."""
    found(made.pvt(0))
    n = 3_000_000
    for pattern in (
        b"\xb5\x62\x01\x07\xff\xff",
        b"\xd3\x03\xff",
        b"$GPGGA,",
        b"$A,",
        b"\xb5",
        b"\xd3\x00",
        b"$GPXXX" * 9,
    ):
        begin = time.perf_counter()
        places, tally = found(pattern * (n // len(pattern)), 100_000)
        assert time.perf_counter() - begin < 4.0, f"{pattern!r}"
        assert places == []
        assert tally.result().lost_bytes == n // len(pattern) * len(pattern)


def test_memory_stays_bounded(tmp_path: Path) -> None:
    """A stream of 24 MB that holds little: some blocks, not the file."""
    path = tmp_path / "long.ubx"
    frame = made.ubx(2, 0x15, bytes(60_000))
    with path.open("wb") as stream:
        for n in range(400):
            stream.write(frame + made.pvt(200 * n))
    ubx.read_log(path, silent)
    tracemalloc.start()
    log = ubx.read_log(path, silent)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(log.fix_table) == 400
    assert peak < 18 * receiver_stream.BLOCK_BYTES


def test_two_logs_at_once() -> None:
    first, second = mixed_stream(np.random.default_rng(11), 300), mixed_stream(np.random.default_rng(12), 300)
    tallies = (DamageTally(), DamageTally())
    places: tuple[list[tuple[int, int]], list[tuple[int, int]]] = ([], [])
    readers = [
        receiver_stream.batches(BytesIO(data), tally, 500) for data, tally in zip((first, second), tallies, strict=True)
    ]
    open_ones = [0, 1]
    while open_ones:
        for which in tuple(open_ones):
            batch = next(readers[which], None)
            if batch is None:
                open_ones.remove(which)
            else:
                places[which].extend((begin + batch.offset, length) for begin, length in batch.places.tolist())
    assert places[0] == list(made.plain_messages(first))
    assert places[1] == list(made.plain_messages(second))
