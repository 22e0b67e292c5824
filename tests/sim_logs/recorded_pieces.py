"""The recorded flights message by message, read plainly as intact files are, and thinned so that they are small."""

import struct
from dataclasses import dataclass
from pathlib import Path

from tests.formats.tlog_bytes import LAYOUTS, crc

SIM_LOGS = Path(__file__).resolve().parents[2] / "sim_logs"


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A message of an intact log with all its bytes."""

    name: str
    data: bytes


def joined(pieces: list[Piece]) -> bytes:
    return b"".join(piece.data for piece in pieces)


def count(pieces: list[Piece], name: str) -> int:
    return sum(piece.name == name for piece in pieces)


def begin_of(pieces: list[Piece], index: int) -> int:
    """Return where in the joined file a message begins."""
    return sum(len(piece.data) for piece in pieces[:index])


def nth(pieces: list[Piece], name: str, number: int) -> int:
    """Return the index of the message of a name with a number, from 0."""
    return [index for index, piece in enumerate(pieces) if piece.name == name][number]


def thinned(pieces: list[Piece], every: dict[str, int]) -> list[Piece]:
    """Return the messages of some names: all (1), or every so manieth; those of other names are left out."""
    seen: dict[str, int] = {}
    kept = []
    for piece in pieces:
        number = seen[piece.name] = seen.get(piece.name, -1) + 1
        if piece.name in every and number % every[piece.name] == 0:
            kept.append(piece)
    return kept


def dataflash(folder: str) -> list[Piece]:
    """Return a recorded dataflash log, thinned."""
    data = (SIM_LOGS / folder / "flight.BIN").read_bytes()
    lengths, names, pieces, at = {128: 89}, {128: "FMT"}, list[Piece](), 0
    while at < len(data):
        kind = data[at + 2]
        piece = Piece(name=names[kind], data=data[at : at + lengths[kind]])
        if kind == 128:
            lengths[piece.data[3]] = piece.data[4]
            names[piece.data[3]] = piece.data[5:9].rstrip(b"\0").decode()
        pieces.append(piece)
        at += len(piece.data)
    return thinned(pieces, {"FMT": 1, "MSG": 4, "PARM": 40, "GPS": 4, "GPA": 12, "CAM": 1, "ATT": 12, "POS": 24})


def tlog(folder: str) -> list[Piece]:
    """Return a recorded telemetry log, thinned: records of a stamp and a frame of version 2."""
    data = (SIM_LOGS / folder / "flight.tlog").read_bytes()
    names = {number: name for name, (number, _, _) in LAYOUTS.items()}
    pieces, at = list[Piece](), 0
    while at < len(data):
        assert data[at + 8] == 0xFD
        length = 8 + 12 + data[at + 9]
        number = int.from_bytes(data[at + 15 : at + 18], "little")
        pieces.append(Piece(name=names[number], data=data[at : at + length]))
        at += length
    every = {"HEARTBEAT": 6, "SYSTEM_TIME": 5, "GPS_RAW_INT": 3, "ATTITUDE": 10, "GLOBAL_POSITION_INT": 10}
    return thinned(pieces, every | {"CAMERA_FEEDBACK": 1, "CAMERA_IMAGE_CAPTURED": 1, "STATUSTEXT": 8})


def of_system(piece: Piece, system: int) -> Piece:
    """Return a record as if another vehicle had sent it, its checksum put right."""
    frame = bytearray(piece.data[8:-2])
    frame[5] = system
    checksum = struct.pack("<H", crc(bytes(frame[1:]) + bytes([LAYOUTS[piece.name][1]])))
    return Piece(name=piece.name, data=piece.data[:8] + bytes(frame) + checksum)


def received_later(piece: Piece, by_s: int) -> Piece:
    """Return a record with another time of reception."""
    (stamp_us,) = struct.unpack_from(">Q", piece.data)
    return Piece(name=piece.name, data=struct.pack(">Q", stamp_us + by_s * 1_000_000) + piece.data[8:])


def ulog() -> list[Piece]:
    """Return the recorded PX4 log, thinned; the first piece is the file's header."""
    data = (SIM_LOGS / "px4_distance_trigger/flight.ulg").read_bytes()
    pieces, topics, at = [Piece(name="header", data=data[:16])], dict[int, str](), 16
    while at < len(data):
        (length,) = struct.unpack_from("<H", data, at)
        piece, letter = data[at : at + 3 + length], chr(data[at + 2])
        name = letter
        if letter == "A":
            topics[struct.unpack_from("<H", piece, 4)[0]] = piece[6:].decode()
        if letter == "D":
            name = topics[struct.unpack_from("<H", piece, 3)[0]]
        pieces.append(Piece(name=name, data=piece))
        at += len(piece)
    every = {"vehicle_gps_position": 6, "vehicle_attitude": 20, "vehicle_global_position": 20, "L": 4}
    whole = ("header", "B", "F", "I", "P", "Q", "A", "camera_capture", "camera_trigger")
    return thinned(pieces, every | dict.fromkeys(whole, 1))


def overwritten(piece: Piece, offset: int, layout: str, *values: float) -> Piece:
    """Return a message with fields at an offset of it overwritten."""
    data = bytearray(piece.data)
    struct.pack_into("<" + layout, data, offset, *values)
    return Piece(name=piece.name, data=bytes(data))
