"""Damaged ULogs: what damage did not touch is found, and what it cost is counted byte by byte."""

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.formats.log_damage import Damaged, damaged
from tests.formats.ulog_made import SYNC, Made, Message, flight, messages
from uavkit.core.errors import InputError
from uavkit.core.flight_log import FlightLog
from uavkit.core.progress import silent
from uavkit.formats import ulog_file
from uavkit.formats.log_bytes import Blocks
from uavkit.formats.ulog import read_log, recognises

DATA = Path(__file__).resolve().parents[2] / "../shared/data"
SMALL = DATA / "logs/ulg/test_sample_log_small.ulg"
FLIGHT = DATA / "sitl/px4_dist.ulg"
UNLISTED = {"S": 11, "O": 5, "R": 5}
"""Lengths of the messages that are counted without being listed."""


class Listing(ulog_file._Scanner):
    """Keeps where the messages lie."""

    def __init__(self) -> None:
        super().__init__({})
        self.found: dict[int, int] = {}
        self._offset = 0

    def scan(self, block: NDArray[np.uint8], offset: int, final: bool) -> int:
        self._tables.wanted[:] = True
        self._offset = offset
        return super().scan(block, offset, final)

    def _take_data(self, block: NDArray[np.uint8], frames: NDArray[np.int64]) -> None:
        self.found |= {self._offset + place: length for place, length, _ in frames.tolist()}

    def _take_other(self, letter: str, message: bytes, offset: int) -> None:
        self.found[offset] = len(message)
        super()._take_other(letter, message, offset)


def listed(data: bytes, block_bytes: int = 4096) -> Listing:
    """Scan bytes in blocks of an odd size."""
    blocks, listing, consumed = Blocks(io.BytesIO(data), block_bytes), Listing(), 0
    while (block := blocks.next(consumed)) is not None:
        consumed = listing.scan(block, blocks.offset, blocks.final)
    return listing


def places(message: Message, harm: Damaged) -> list[int]:
    """Return where an intact message stands in the damaged log; none where damage touched it."""
    return [message.begin + c for a, b, c in harm.intact if a <= message.begin and message.end <= b]


def undefined(all_messages: list[Message], harm: Damaged) -> set[int]:
    """Return the numbers of topics of which nothing says the size any more.

    Those whose format and subscription are both damaged; and with them those without a format, because what follows
    their messages is not known either.
    """
    touched = [message for message in all_messages if not places(message, harm)]
    formats = {message.body.split(b":")[0] for message in touched if message.letter == "F"}
    named = [message for message in all_messages if message.letter == "A" and message.body[3:] in formats]
    lost = any(not places(message, harm) for message in named)
    return {int.from_bytes(message.body[1:3], "little") for message in named} if lost else set()


def check_damage(data: bytes, all_messages: list[Message], rng: np.random.Generator) -> str:
    harm = damaged(data, rng)
    listing = listed(harm.data, int(rng.integers(700, 9000)))
    damage = listing._tally.result()
    accepted = sum(listing.found.values()) + sum(n * listing.type_count(letter) for letter, n in UNLISTED.items())
    assert damage.lost_bytes + accepted == len(harm.data)
    lost = [(span.offset, span.offset + span.length) for span in damage.spans]
    assert damage.span_count == len(lost)
    skip = undefined(all_messages, harm)
    intact_bytes = 0
    for message in all_messages:
        if message.letter == "D" and message.number in skip:
            continue
        for place in places(message, harm)[:2]:
            end = place + message.end - message.begin
            intact_bytes += end - place
            if message.letter in UNLISTED:
                assert not any(a < end and place < b for a, b in lost), (harm.kind, message)
            else:
                assert listing.found.get(place) == end - place, (harm.kind, message.begin, message.letter)
    if not skip and harm.kind != "repeated":
        assert damage.lost_bytes <= len(harm.data) - 16 * (harm.data[:16] == data[:16]) - intact_bytes
    return harm.kind


def test_intact_log_loses_nothing() -> None:
    data = flight()
    listing = listed(data, 777)
    assert listing._tally.result().lost_bytes == 0
    assert {m.begin: m.end - m.begin for m in messages(data) if m.letter not in UNLISTED} | {0: 16} == listing.found


@pytest.mark.parametrize("seed", range(120))
def test_made_log_damaged(seed: int) -> None:
    data = flight()
    check_damage(data, messages(data), np.random.default_rng(seed))


@pytest.mark.skipif(not SMALL.exists(), reason="no ../shared/data/logs/ulg")
def test_recorded_log_damaged() -> None:
    data = SMALL.read_bytes()
    all_messages = messages(data)
    kinds = {check_damage(data, all_messages, np.random.default_rng(seed)) for seed in range(25)}
    assert len(kinds) == 4


@pytest.mark.slow
@pytest.mark.skipif(not FLIGHT.exists(), reason="no ../shared/data/sitl")
def test_thousand_damages() -> None:
    made = flight()
    all_messages = messages(made)
    for seed in range(1000, 1600):
        check_damage(made, all_messages, np.random.default_rng(seed))
    for path, seeds in ((SMALL, range(2000, 2150)), (FLIGHT, range(3000, 3050))):
        data = path.read_bytes()
        all_messages = messages(data)
        for seed in seeds:
            check_damage(data, all_messages, np.random.default_rng(seed))


def read(data: bytes, folder: Path) -> FlightLog:
    path = folder / "log.ulg"
    path.write_bytes(data)
    return read_log(path, silent)


def test_values_of_intact_messages_are_read(tmp_path: Path) -> None:
    data = flight()
    all_messages, whole = messages(data), read(data, tmp_path)
    attitudes, shots = ([m for m in all_messages if m.letter == "D" and m.number == number] for number in (0, 1))
    checked = 0
    for seed in range(40):
        harm = damaged(data, np.random.default_rng(500 + seed))
        if any(m.letter in "AF" and not places(m, harm) for m in all_messages):
            continue  # damage of the definitions: the rows cannot be decoded
        log = read(harm.data, tmp_path)
        at = {int(t): k for k, t in enumerate(log.attitude_table.when.boot_ns)}
        for row, message in enumerate(attitudes):
            if places(message, harm):
                k = at[int(whole.attitude_table.when.boot_ns[row])]
                assert log.attitude_table.roll_rad[k] == whole.attitude_table.roll_rad[row]
        kept = [row for row, message in enumerate(shots) if places(message, harm)]
        assert set(whole.exposure_table.latitude_deg[kept]) <= set(log.exposure_table.latitude_deg)
        texts = {m.body[9:].decode() for m in all_messages if m.letter == "L" and places(m, harm)}
        assert texts <= set(log.texts)
        checked += 1
    assert checked > 25


def test_header_gone(tmp_path: Path) -> None:
    data = flight()
    for harm, lost in (
        (data[16:], 0),
        (bytes(16) + data[16:], 16),
        (data[9:], 7),
        (b"\x55\x4c\x6f\x66" + data[4:], 16),
    ):
        assert recognises(harm)
        log = read(harm, tmp_path)
        assert log.damage.lost_bytes == lost
        assert len(log.exposure_table) == len(read(data, tmp_path).exposure_table) == 17
        assert any("header" in note for note in log.notes)


def test_cut_off_at_the_end(tmp_path: Path) -> None:
    data = flight()
    last = messages(data)[-2]
    log = read(data[: last.end - 1], tmp_path)
    assert log.damage.lost_bytes == last.end - 1 - last.begin
    assert "ends" in log.damage.spans[0].why


def test_appended_after_a_message_cut_short(tmp_path: Path) -> None:
    data = flight()
    crash = b"\x10\x00M\x00\x0bchar[3] xyzabc"
    cut = messages(data)[-5]
    assert cut.letter == "D"
    log = read(
        data[: cut.end - 4] + (len(crash) - 3).to_bytes(2, "little") + crash[2:] * 1 + flight()[cut.end :], tmp_path
    )
    assert log.damage.lost_bytes == cut.end - 4 - cut.begin
    assert log.message_counts["multiple information"] == 2


def test_message_within_a_message_that_was_cut_to_the_same_end(tmp_path: Path) -> None:
    """A cut whose remains end where another message ends: the whole one within is found."""
    data = flight()
    all_messages = messages(data)
    k = next(k for k, m in enumerate(all_messages) if m.letter == "D" and m.number == 0 and k > 40)
    sync = (8).to_bytes(2, "little") + b"S" + SYNC
    attitude = all_messages[k]
    harm = data[: attitude.end - len(sync)] + sync + data[attitude.end :]
    log = read(harm, tmp_path)
    assert log.damage.lost_bytes == attitude.end - attitude.begin - len(sync)
    assert log.message_counts["synchronisation"] == read(data, tmp_path).message_counts["synchronisation"] + 1


def test_subscription_lost(tmp_path: Path) -> None:
    data = flight()
    gone = next(m for m in messages(data) if m.letter == "A" and m.body.endswith(b"vehicle_attitude"))
    log = read(data[: gone.begin] + data[gone.end :], tmp_path)
    assert log.damage.lost_bytes == 0
    assert log.message_counts["data of number 0"] == 120
    assert any("subscription is lost" in note for note in log.notes)


def test_rows_without_subscription_follow_one_another(tmp_path: Path) -> None:
    log = Made().format("cpuload", "uint64_t timestamp", "float load").text_information("sys_name", "PX4")
    for k in range(6):
        log.row(7, "uint64_t float", 1_000_000 * k + 1, 0.5)
    told = read(bytes(log.data), tmp_path)
    assert told.damage.lost_bytes == 0
    assert told.message_counts["data of number 7"] == 6


def test_bytes_like_a_short_message_among_damage(tmp_path: Path) -> None:
    """Three bytes make a dropout or the end of a subscription: after damage they count only before another message."""
    data = flight()
    at = messages(data)[-20].begin
    noise = bytes(10) + b"\x02\x00O\x99\x99" + bytes(10) + b"\x02\x00R\x01\x00" + bytes(10)
    told = read(data[:at] + noise + data[at:], tmp_path)
    assert told.damage.lost_bytes == len(noise)
    assert told.message_counts == read(data, tmp_path).message_counts


def test_format_lost(tmp_path: Path) -> None:
    data = flight()
    gone = next(m for m in messages(data) if m.letter == "F" and m.body.startswith(b"vehicle_attitude"))
    log = read(data[: gone.begin] + data[gone.end :], tmp_path)
    assert log.damage.lost_bytes == 0
    assert log.message_counts["vehicle_attitude"] == 120
    assert len(log.attitude_table) == 0


def test_log_of_nothing_is_an_error(tmp_path: Path) -> None:
    for data in (b"\x01\x02\x03" * 1000, flight()[:9]):
        with pytest.raises(InputError, match="download"):
            read(data, tmp_path)


def test_zeros_and_noise_take_no_time(tmp_path: Path) -> None:
    data = flight(10)
    noise = np.random.default_rng(3).integers(0, 256, 3_000_000, dtype=np.uint8).tobytes()
    log = read(data + noise + bytes(3_000_000) + flight(10)[16:], tmp_path)
    assert 5_999_000 < log.damage.lost_bytes <= 6_000_000 + 100
    assert log.message_counts["vehicle_attitude"] >= 20


@settings(max_examples=150, deadline=None)
@given(noise=st.binary(max_size=600), seed=st.integers(0, 10**6), where=st.floats(0, 1), keep_head=st.booleans())
def test_any_bytes(
    noise: bytes, seed: int, where: float, keep_head: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = flight(12)
    rng = np.random.default_rng(seed)
    mutated = bytearray(data)
    for place in rng.integers(0, len(data), int(rng.integers(0, 60))):
        mutated[place] = int(rng.integers(256))
    at = int(where * len(data))
    harm = bytes(mutated[:at]) + noise + bytes(mutated[at:]) if keep_head else noise
    recognises(harm)
    try:
        log = read(harm, tmp_path_factory.mktemp("any"))
    except InputError:
        return
    list(log.fixes()), list(log.exposures()), list(log.attitudes())
    assert 0 <= log.damage.lost_bytes <= len(harm)
