"""MAVLink frames and telemetry logs encoded from the definitions, for tests of the reader.

Numbers, checksum bytes and wire layouts (fields ordered by size, extensions behind) are written down here once more,
from the message definitions, so that they do not come from the code under test.
"""

import struct
from dataclasses import dataclass

LAYOUTS: dict[str, tuple[int, int, str]] = {
    "HEARTBEAT": (0, 50, "<IBBBBB"),
    "SYSTEM_TIME": (2, 137, "<QI"),
    "PARAM_VALUE": (22, 220, "<fHH16sB"),
    "GPS_RAW_INT": (24, 24, "<QiiiHHHHBBiIIIIH"),
    "ATTITUDE": (30, 39, "<Iffffff"),
    "GLOBAL_POSITION_INT": (33, 104, "<IiiiihhhH"),
    "CAMERA_TRIGGER": (112, 174, "<QI"),
    "GPS2_RAW": (124, 87, "<QiiiIHHHHBBBHiIIII"),
    "AUTOPILOT_VERSION": (148, 178, "<QQIIIIHH8s8s8s18s"),
    "CAMERA_FEEDBACK": (180, 52, "<QiiffffffHBBBH"),
    "STATUSTEXT": (253, 83, "<B50sHB"),
    "CAMERA_IMAGE_CAPTURED": (263, 133, "<QIiiii4fiBb205s"),
    "NEW_MESSAGE": (52_345, 77, "<IfB"),
}
"""By name: number, checksum byte, layout. The last is in no dialect."""


def crc(data: bytes) -> int:
    """Return CRC-16/MCRF4XX: polynomial 0x1021 bit by bit, reflected, from 0xFFFF."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ 0x8408 if value & 1 else value >> 1
    return value


@dataclass(frozen=True, kw_only=True)
class Sender:
    """Who sends, and how."""

    system: int = 1
    component: int = 1
    version: int = 2
    signed: bool = False


def frame(name: str, values: tuple[object, ...], sender: Sender | None = None, sequence: int = 0) -> bytes:
    """Return a frame; missing values at the end (extensions) are left out in version 1 and zero in version 2."""
    sender = sender or Sender()
    number, extra, layout = LAYOUTS[name]
    if sender.version == 1:
        payload = _packed(layout, values)
        core = struct.pack("<BBBBB", len(payload), sequence, sender.system, sender.component, number) + payload
        return b"\xfe" + core + struct.pack("<H", crc(core + bytes([extra])))
    payload = _packed(layout, values)
    payload = payload.rstrip(b"\0") or payload[:1]
    head = struct.pack("<BBBBBB", len(payload), int(sender.signed), 0, sequence, sender.system, sender.component)
    core = head + number.to_bytes(3, "little") + payload
    signature = bytes([7]) + (123_456_789).to_bytes(6, "little") + b"\x11\x22\x33\x44\x55\x66" if sender.signed else b""
    return b"\xfd" + core + struct.pack("<H", crc(core + bytes([extra]))) + signature


def _packed(layout: str, values: tuple[object, ...]) -> bytes:
    """Pack as many fields as there are values."""
    letters, digits, used = layout[1:], "", "<"
    left = len(values)
    for letter in letters:
        if letter.isdigit():
            digits += letter
            continue
        count = 1 if letter == "s" or not digits else int(digits)
        if left <= 0:
            break
        used += digits + letter
        left -= count
        digits = ""
    return struct.pack(used, *values)


def record(stamp_us: int, message: bytes) -> bytes:
    """Return a record of a telemetry log."""
    return struct.pack(">Q", stamp_us) + message
