"""Messages of GNSS receivers, encoded byte by byte for tests, and a slow, plain reader of streams to compare with."""

import struct
from collections.abc import Iterator

WEEK = 2400
"""A GPS week: it begins on 2026-01-04 00:00:00 GPS time."""


def ubx(kind: int, number: int, payload: bytes) -> bytes:
    """Return a u-blox frame."""
    body = struct.pack("<BBH", kind, number, len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) % 256
        b = (b + a) % 256
    return b"\xb5\x62" + body + bytes((a, b))


def nmea(text: str) -> bytes:
    """Return a sentence with its checksum."""
    total = 0
    for character in text:
        total ^= ord(character)
    return f"${text}*{total:02X}\r\n".encode("ascii")


def rtcm(payload: bytes) -> bytes:
    """Return an RTCM 3 frame."""
    body = b"\xd3" + struct.pack(">H", len(payload)) + payload
    return body + crc24q(body).to_bytes(3, "big")


def crc24q(data: bytes) -> int:
    """Return CRC-24Q bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 16
        for _ in range(8):
            crc = (crc << 1) ^ (0x1864CFB if crc & 0x800000 else 0)
    return crc & 0xFFFFFF


def pvt(
    tow_ms: int,
    utc: tuple[int, int, int, int, int, int] = (2026, 1, 4, 0, 0, 0),
    *,
    valid: int = 7,
    nano: int = 0,
    fix: tuple[int, int] = (3, 1),
    lat: int = 356_000_000,
    lon: int = 1_397_000_000,
    heights: tuple[int, int] = (75_500, 36_250),
    accuracies: tuple[int, int] = (1414, 2500),
    velocity: tuple[int, int, int] = (0, 0, 0),
    satellites: int = 12,
    flags3: int = 0,
    short: bool = False,
) -> bytes:
    """Return NAV-PVT; ``fix`` is fixType and flags, velocity north, east, down in mm/s."""
    payload = struct.pack("<IH5BB", tow_ms, *utc, valid) + struct.pack("<Ii4B", 20, nano, *fix, 0, satellites)
    payload += struct.pack("<iiiiII", lon, lat, *heights, *accuracies)
    payload += struct.pack("<iiiiiIIHH", *velocity, 0, 0, 100, 10_000, 150, flags3) + bytes(4)
    return ubx(0x01, 0x07, payload if short else payload + bytes(8))


def posllh(tow_ms: int, lat: int, lon: int, heights: tuple[int, int], accuracies: tuple[int, int]) -> bytes:
    """Return NAV-POSLLH."""
    return ubx(0x01, 0x02, struct.pack("<IiiiiII", tow_ms, lon, lat, *heights, *accuracies))


def hpposllh(
    tow_ms: int,
    whole: tuple[int, int, int, int],
    rest: tuple[int, int, int, int],
    accuracies: tuple[int, int],
    flags: int = 0,
) -> bytes:
    """Return NAV-HPPOSLLH; ``whole`` and ``rest`` are lon, lat, height, hMSL."""
    return ubx(0x01, 0x14, struct.pack("<B2xBI4i4bII", 0, flags, tow_ms, *whole, *rest, *accuracies))


def sol(tow_ms: int, rest_ns: int, week: int, fix: int, flags: int, satellites: int = 9) -> bytes:
    """Return NAV-SOL."""
    ecef = struct.pack("<iiiIiiiI", 0, 0, 0, 300, 0, 0, 0, 50)
    head = struct.pack("<IihBB", tow_ms, rest_ns, week, fix, flags)
    return ubx(0x01, 0x06, head + ecef + struct.pack("<HBBI", 150, 0, satellites, 0))


def status(tow_ms: int, fix: int, flags: int, flags2: int = 0) -> bytes:
    """Return NAV-STATUS."""
    return ubx(0x01, 0x03, struct.pack("<IBBBBII", tow_ms, fix, flags, 0, flags2, 1000, 60_000))


def velned(tow_ms: int, north: int, east: int, down: int) -> bytes:
    """Return NAV-VELNED, cm/s."""
    return ubx(0x01, 0x12, struct.pack("<IiiiIIiII", tow_ms, north, east, down, 0, 0, 0, 50, 100))


def timeutc(tow_ms: int, utc: tuple[int, int, int, int, int, int], nano: int, valid: int = 7) -> bytes:
    """Return NAV-TIMEUTC."""
    return ubx(0x01, 0x21, struct.pack("<IIiH5BB", tow_ms, 30, nano, *utc, valid))


def timegps(tow_ms: int, rest_ns: int, week: int, leap: int, valid: int = 7) -> bytes:
    """Return NAV-TIMEGPS."""
    return ubx(0x01, 0x20, struct.pack("<IihbBI", tow_ms, rest_ns, week, leap, valid, 30))


def timels(tow_ms: int, source: int, leap: int, valid: int = 1) -> bytes:
    """Return NAV-TIMELS."""
    return ubx(0x01, 0x26, struct.pack("<IB3xBbBbiHH3xB", tow_ms, 0, source, leap, 0, 0, 0, 0, 0, valid))


def tm2(
    count: int,
    rising: tuple[int, int, int],
    falling: tuple[int, int, int] = (0, 0, 0),
    *,
    flags: int = 0x80 | 0x40 | 0x08,
    accuracy_ns: int = 30,
    channel: int = 0,
) -> bytes:
    """Return TIM-TM2; edges are week, ms of the week, ns. Flags by default: new rising edge, valid, GNSS time."""
    (wn_r, ms_r, ns_r), (wn_f, ms_f, ns_f) = rising, falling
    payload = struct.pack("<BBHHHIIIII", channel, flags, count, wn_r, wn_f, ms_r, ns_r, ms_f, ns_f, accuracy_ns)
    return ubx(0x0D, 0x03, payload)


def plain_messages(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield begin and length of the intact messages of a stream (sentences with their line end), the plain way."""
    at = 0
    while at < len(data):
        length = _ubx_length(data, at) or _nmea_length(data, at) or _rtcm_length(data, at)
        if length:
            yield at, length
        at += max(length, 1)


def _ubx_length(data: bytes, at: int) -> int:
    if data[at : at + 2] != b"\xb5\x62" or at + 8 > len(data):
        return 0
    (size,) = struct.unpack_from("<H", data, at + 4)
    frame = data[at : at + size + 8]
    return len(frame) if len(frame) == size + 8 and ubx(frame[2], frame[3], frame[6:-2]) == frame else 0


def _rtcm_length(data: bytes, at: int) -> int:
    if data[at] != 0xD3 or at + 6 > len(data) or data[at + 1] > 3:
        return 0
    size = data[at + 1] * 256 + data[at + 2] + 6
    frame = data[at : at + size]
    return size if len(frame) == size and rtcm(frame[3:-3]) == frame else 0


def _nmea_length(data: bytes, at: int) -> int:
    star = data.find(b"*", at, at + 1024)
    if data[at] != 36 or star < 0 or star + 3 > len(data):
        return 0
    text, told = data[at + 1 : star], data[star + 1 : star + 3]
    address = text.split(b",")[0]
    if any(not 32 <= byte < 127 or byte == 36 for byte in text) or len(text) < 3:
        return 0
    if not all(chr(byte).isupper() or chr(byte).isdigit() for byte in address) or not address:
        return 0
    if nmea(text.decode("ascii"))[-4:-2].lower() != told.lower():
        return 0
    end = star + 3
    while end < len(data) and end < star + 7 and data[end] in b"\r\n":
        end += 1
    return end - at
