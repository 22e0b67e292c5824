"""Damaged telemetry logs: what damage did not touch is found, what is lost is counted to the byte; no bytes crash."""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.formats.log_damage import Damaged, damaged
from tests.formats.tlog_bytes import LAYOUTS, Sender, frame, record
from uavkit.core.errors import InputError
from uavkit.core.flight_log import FlightLog
from uavkit.core.gpstime import NO_TIME
from uavkit.formats import tlog, tlog_rows
from uavkit.formats.mavlink_messages import dialect

SITL = Path(__file__).resolve().parents[2] / "../shared/data/sitl"
UNIX_US = 1_795_000_000_000_000
NUMBERS = {number: name for name, (number, _, _) in LAYOUTS.items() if name != "NEW_MESSAGE"}


@dataclass(frozen=True, kw_only=True)
class Message:
    """Where a frame lies in the intact log; a stamp stands before it."""

    begin: int
    end: int
    name: str


def walked(data: bytes) -> list[Message]:
    """Return the messages of an intact log by their lengths alone."""
    messages, place = list[Message](), 8
    known = dialect()
    while place < len(data):
        signed = 13 * (data[place + 2] & 1)
        length = data[place + 1] + (8 if data[place] == 0xFE else 12 + signed)
        number = data[place + 5] if data[place] == 0xFE else int.from_bytes(data[place + 7 : place + 10], "little")
        messages.append(Message(begin=place, end=place + length, name=known.name(number)))
        place += length + 8
    return messages


def made_log(seed: int, sender: Sender) -> bytes:
    """Return a log of 160 messages, no two alike, some of no dialect."""
    rng = np.random.default_rng(seed)
    parts = list[bytes]()
    for k in range(160):
        boot, unix = 50_000 + 40 * k, UNIX_US + 40_000 * k
        a, b, c = rng.normal(0, 0.3, 3)
        kinds: list[tuple[str, tuple[object, ...]]] = [
            ("ATTITUDE", (boot, a, b, c, 0.0, a, b)),
            ("GPS_RAW_INT", (boot * 1000, 358_000_000 + k, 1_396_500_000, 20_000, 1, 1, k, 1, 3, 9)),
            ("SYSTEM_TIME", (unix, boot)),
            ("CAMERA_FEEDBACK", (unix, 358_000_000, 1_396_500_000 + k, a, b, c, a, b, 0.0, k, 0, 0, 0, 0)),
            ("NEW_MESSAGE", (boot, a, 3)) if sender.version == 2 else ("HEARTBEAT", (k, 2, 3, 81, 4, 3)),
            ("STATUSTEXT", (6, f"text {k}".encode())),
        ]
        name, values = kinds[k % len(kinds)] if k > 2 else ("HEARTBEAT", (k, 2, 3, 81, 4, 3))
        parts.append(record(unix + 30_000, frame(name, values, sender, k % 256)))
    return b"".join(parts)


def expected_lost(data: bytes, whole: list[tuple[int, int]]) -> int:
    """Return the bytes of a damaged log that belong to no message, whose whole frames lie at (begin, end)."""
    lost, end_before = len(data), 0
    for begin, end in sorted(whole):
        stamp = data[max(0, begin - 8) : begin]
        has_stamp = begin - 8 >= end_before and 0 < struct.unpack(">Q", stamp)[0] < 0x0F << 48
        lost -= end - begin + 8 * has_stamp
        end_before = end
    return lost


def check(log: FlightLog, data: bytes, whole: dict[tuple[int, int], str]) -> None:
    names = list(whole.values())
    assert log.message_counts == {name: names.count(name) for name in set(names)}
    assert log.damage.lost_bytes == expected_lost(data, list(whole))
    assert sum(span.length for span in log.damage.spans) == log.damage.lost_bytes
    assert log.damage.span_count == len(log.damage.spans)
    for span in log.damage.spans:
        for begin, end in whole:
            assert span.offset + span.length <= begin or span.offset >= end


def whole_frames(hurt: Damaged, data: bytes, messages: list[Message]) -> dict[tuple[int, int], str]:
    """Return what of an intact log lies whole in the damaged one, twice where it is repeated.

    By its bytes: damage may put back what it took, zeros for zeros, or the end of one message for another's.
    """
    return {
        (message.begin + offset, message.end + offset): message.name
        for offset in {offset for _, _, offset in hurt.intact}
        for message in messages
        if message.begin + offset >= 0
        and hurt.data[message.begin + offset : message.end + offset] == data[message.begin : message.end]
    }


def run_damages(data: bytes, path: Path, rng: np.random.Generator, count: int) -> None:
    messages = walked(data)
    for _ in range(count):
        hurt = damaged(data, rng)
        path.write_bytes(hurt.data)
        check(tlog.read_log(path), hurt.data, whole_frames(hurt, data, messages))


def contents(data: bytes, whole: dict[tuple[int, int], str], name: str, part: slice) -> set[bytes]:
    """Return bytes of the payloads of whole frames of a kind, as they stand in the file, trailing zeros put back."""
    found = set[bytes]()
    for (begin, end), kind in whole.items():
        if kind == name:
            header = 6 if data[begin] == 0xFE else 10
            found.add((data[begin + header : end - 2] + bytes(64))[part])
    return found


@pytest.mark.parametrize("sender", [Sender(), Sender(version=1)], ids=["v2", "v1"])
def test_damage_of_made_logs(tmp_path: Path, sender: Sender) -> None:
    run_damages(made_log(1, sender), tmp_path / "damaged.tlog", np.random.default_rng(11), 60)


def test_content_of_what_damage_did_not_touch(tmp_path: Path) -> None:
    data, rng, path = made_log(2, Sender()), np.random.default_rng(12), tmp_path / "damaged.tlog"
    messages = walked(data)
    for _ in range(30):
        hurt = damaged(data, rng)
        path.write_bytes(hurt.data)
        log, whole = tlog.read_log(path), whole_frames(hurt, data, messages)
        rolls = {np.float32(roll).tobytes() for roll in log.attitude_table.roll_rad}
        assert rolls == contents(hurt.data, whole, "ATTITUDE", slice(4, 8))
        numbers = {int(n).to_bytes(2, "little") for n in log.exposure_table.sequence}
        assert numbers == contents(hurt.data, whole, "CAMERA_FEEDBACK", slice(40, 42))
        speeds = {round(v * 1e7).to_bytes(4, "little") for v in log.fix_table.latitude_deg}
        assert speeds == contents(hurt.data, whole, "GPS_RAW_INT", slice(8, 12))


def recorded(name: str, size: int) -> bytes:
    """Return the first records of a recorded flight, to the end of a message."""
    path = SITL / name
    if not path.exists():
        pytest.skip(f"{path} is not there")
    data = path.read_bytes()[:size]
    last = [message.end for message in walked(data) if message.end <= len(data)][-1]
    return data[:last]


def test_damage_of_a_recorded_log(tmp_path: Path) -> None:
    run_damages(recorded("px4_dist.tlog", 60_000), tmp_path / "damaged.tlog", np.random.default_rng(13), 50)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["px4_dist.tlog", "digicam.tlog"])
def test_damage_of_recorded_logs_at_length(tmp_path: Path, name: str) -> None:
    run_damages(recorded(name, 100_000), tmp_path / "damaged.tlog", np.random.default_rng(14), 1000)


@pytest.mark.slow
@pytest.mark.parametrize("sender", [Sender(), Sender(version=1)], ids=["v2", "v1"])
def test_damage_of_made_logs_at_length(tmp_path: Path, sender: Sender) -> None:
    run_damages(made_log(3, sender), tmp_path / "damaged.tlog", np.random.default_rng(15), 1000)


def test_damage_of_raw_streams(tmp_path: Path) -> None:
    stamped = made_log(18, Sender())
    frames = [stamped[m.begin : m.end] for m in walked(stamped)]
    ends = np.cumsum([len(f) for f in frames]).tolist()
    names = [m.name for m in walked(stamped)]
    messages = [Message(begin=e - len(f), end=e, name=n) for e, f, n in zip(ends, frames, names, strict=True)]
    data, rng, path = b"".join(frames), np.random.default_rng(19), tmp_path / "damaged.raw"
    for _ in range(40):
        hurt = damaged(data, rng)
        path.write_bytes(hurt.data)
        log, whole = tlog.read_log(path), whole_frames(hurt, data, messages)
        names = list(whole.values())
        assert log.message_counts == {name: names.count(name) for name in set(names)}
        assert log.damage.lost_bytes == len(hurt.data) - sum(end - begin for begin, end in whole)


def test_padding_with_zeros_is_lost_quickly(tmp_path: Path) -> None:
    data, path = made_log(20, Sender()), tmp_path / "padded.tlog"
    path.write_bytes(data + bytes(30_000_000) + data)
    log = tlog.read_log(path)
    assert log.damage.lost_bytes == 30_000_000
    assert log.damage.span_count == 1
    assert sum(log.message_counts.values()) == 320


def test_every_place_of_a_cut_at_the_end(tmp_path: Path) -> None:
    data = made_log(4, Sender())[:1500]
    messages, path = walked(made_log(4, Sender())), tmp_path / "short.tlog"
    for size in range(400, 1500, 7):
        path.write_bytes(data[:size])
        whole = {(m.begin, m.end): m.name for m in messages if m.end <= size}
        check(tlog.read_log(path), data[:size], whole)


def test_signature_cut_short_does_not_swallow_the_next_message(tmp_path: Path) -> None:
    data = made_log(5, Sender(signed=True))
    messages, path = walked(data), tmp_path / "signed.tlog"
    hurt = messages[50]
    for missing in range(1, 14):
        cut = data[: hurt.end - missing] + data[hurt.end :]
        path.write_bytes(cut)
        whole = {(m.begin, m.end): m.name for m in messages[:50]}
        whole |= {(m.begin - missing, m.end - missing): m.name for m in messages[51:]}
        check(tlog.read_log(path), cut, whole)


def test_frame_within_a_damaged_payload_is_no_message_before_it_ends(tmp_path: Path) -> None:
    """A frame in the payload of an intact one (a log sent over the link) belongs to that payload."""
    inner = frame("SYSTEM_TIME", (UNIX_US, 77))
    outer = frame("STATUSTEXT", (6, inner))
    data = made_log(6, Sender()) + record(UNIX_US, outer)
    path = tmp_path / "nested.tlog"
    path.write_bytes(data)
    log = tlog.read_log(path)
    assert log.damage.lost_bytes == 0
    assert log.message_counts["SYSTEM_TIME"] == sum(m.name == "SYSTEM_TIME" for m in walked(data))


def test_stamp_that_no_clock_shows_is_lost_alone(tmp_path: Path) -> None:
    data = bytearray(made_log(7, Sender()))
    messages = walked(bytes(data))
    attitude = next(m for m in messages[20:] if m.name == "ATTITUDE")
    data[attitude.begin - 8] = 0x80
    path = tmp_path / "stamp.tlog"
    path.write_bytes(bytes(data))
    log = tlog.read_log(path)
    assert log.damage.lost_bytes == 8
    assert log.damage.spans[0].offset == attitude.begin - 8
    assert log.damage.spans[0].why == "time stamp damaged, message intact"
    row = np.flatnonzero(log.attitude_table.when.host_ns == NO_TIME)
    assert len(row) == 1


@pytest.mark.parametrize("block", [9_000, 10_007, 40_000])
def test_block_size_does_not_matter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    rng = np.random.default_rng(16)
    data = damaged(made_log(8, Sender()) * 8, rng).data + bytes(20_000) + made_log(9, Sender())
    path = tmp_path / "blocks.tlog"
    path.write_bytes(data)
    once = tlog.read_log(path)
    monkeypatch.setattr(tlog_rows, "_BLOCK_BYTES", block)
    again = tlog.read_log(path)
    assert again.damage == once.damage
    assert again.message_counts == once.message_counts
    np.testing.assert_array_equal(again.attitude_table.when.gps_ns, once.attitude_table.when.gps_ns)


def read_or_refuse(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    tlog.recognises(data)
    try:
        log = tlog.read_log(path)
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017
        return
    assert log.damage.lost_bytes <= len(data)
    assert len(list(log.exposures())) == len(log.exposure_table)
    assert len(list(log.fixes())) <= len(log.fix_table)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=3000))
def test_no_bytes_crash(tmp_path: Path, data: bytes) -> None:
    read_or_refuse(tmp_path / "any.tlog", data)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    messages=st.lists(
        st.tuples(
            st.sampled_from(sorted(NUMBERS.values())), st.binary(min_size=0, max_size=120), st.integers(0, 2**64 - 1)
        ),
        min_size=1,
        max_size=30,
    ),
    stamped=st.booleans(),
)
def test_no_content_of_right_messages_crashes(
    tmp_path: Path, messages: list[tuple[str, bytes, int]], stamped: bool
) -> None:
    from tests.formats.tlog_bytes import crc

    parts = list[bytes]()
    for k, (name, payload, stamp) in enumerate(messages):
        number, extra, _ = LAYOUTS[name]
        core = struct.pack("<BBBBBB", len(payload), 0, 0, k, 1, 1) + number.to_bytes(3, "little") + payload
        whole = b"\xfd" + core + struct.pack("<H", crc(core + bytes([extra])))
        parts.append(record(stamp, whole) if stamped else whole)
    read_or_refuse(tmp_path / "odd.tlog", b"".join(parts))


@pytest.mark.slow
def test_no_mutation_crashes(tmp_path: Path) -> None:
    rng = np.random.default_rng(17)
    data = made_log(10, Sender())
    for _ in range(1000):
        bad = damaged(data, rng).data
        for _ in range(int(rng.integers(0, 20))):
            bad = damaged(bad, rng, longest=60).data
        read_or_refuse(tmp_path / "mutated.tlog", bad)
