"""ULogs that tests write byte by byte, by the document of the format."""

import struct
from dataclasses import dataclass, field

MAGIC = bytes((0x55, 0x4C, 0x6F, 0x67, 0x01, 0x12, 0x35))
SYNC = bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))
CODES = {"uint64_t": "Q", "uint32_t": "I", "int32_t": "i", "double": "d", "float": "f", "bool": "?", "uint8_t": "B",
         "int8_t": "b", "uint16_t": "H"}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Message:
    """One message of an intact log."""

    begin: int
    end: int
    letter: str
    body: bytes

    @property
    def number(self) -> int:
        """Of a data message's subscription."""
        return struct.unpack_from("<H", self.body)[0]


@dataclass(kw_only=True)
class Made:
    """A log that grows."""

    data: bytearray = field(default_factory=lambda: bytearray(MAGIC + b"\x01" + struct.pack("<Q", 1_000_000)))

    def add(self, letter: str, body: bytes) -> "Made":
        self.data += struct.pack("<HB", len(body), ord(letter)) + body
        return self

    def flags(self, incompatible: bytes = bytes(8), appended: tuple[int, int, int] = (0, 0, 0)) -> "Made":
        return self.add("B", bytes(8) + incompatible + struct.pack("<3Q", *appended))

    def format(self, name: str, *fields: str) -> "Made":
        return self.add("F", f"{name}:{';'.join(fields)};".encode())

    def information(self, key: str, value: bytes) -> "Made":
        return self.add("I", bytes([len(key)]) + key.encode() + value)

    def text_information(self, name: str, value: str) -> "Made":
        return self.information(f"char[{len(value)}] {name}", value.encode())

    def multiple(self, name: str, value: bytes) -> "Made":
        key = f"char[{len(value)}] {name}".encode()
        return self.add("M", bytes([0, len(key)]) + key + value)

    def parameter(self, name: str, value: float | int) -> "Made":
        kind, code = ("int32_t", "<i") if isinstance(value, int) else ("float", "<f")
        key = f"{kind} {name}".encode()
        return self.add("P", bytes([len(key)]) + key + struct.pack(code, value))

    def default(self, name: str, value: float) -> "Made":
        key = f"float {name}".encode()
        return self.add("Q", bytes([1, len(key)]) + key + struct.pack("<f", value))

    def subscribe(self, number: int, name: str, instance: int = 0) -> "Made":
        return self.add("A", struct.pack("<BH", instance, number) + name.encode())

    def row(self, number: int, kinds: str, *values: object) -> "Made":
        return self.add("D", struct.pack("<H" + "".join(CODES[kind] for kind in kinds.split()), number, *values))

    def text(self, microseconds: int, text: str) -> "Made":
        return self.add("L", struct.pack("<BQ", ord("6"), microseconds) + text.encode())

    def sync(self) -> "Made":
        return self.add("S", SYNC)

    def dropout(self, milliseconds: int) -> "Made":
        return self.add("O", struct.pack("<H", milliseconds))


def messages(data: bytes) -> list[Message]:
    """Return the messages of an intact log, walked from one to the next."""
    found, place = [], 16
    while place < len(data):
        size, letter = struct.unpack_from("<HB", data, place)
        end = place + 3 + size
        found.append(Message(begin=place, end=end, letter=chr(letter), body=data[place + 3 : end]))
        place = end
    assert place == len(data)
    return found


def flight(rows: int = 120) -> bytes:
    """Return a short log with a little of each kind of message."""
    log = Made().flags()
    log.format(
        "vehicle_attitude", "uint64_t timestamp", "uint64_t timestamp_sample", "float[4] q", "uint8_t[4] _padding0"
    )
    log.format("camera_capture", "uint64_t timestamp", "uint64_t timestamp_utc", "double lat", "double lon",
               "uint32_t seq", "float alt", "float ground_distance", "float[4] q", "int8_t result",
               "uint8_t[7] _padding0")  # fmt: skip
    log.format("cpuload", "uint64_t timestamp", "float load")
    log.text_information("sys_name", "PX4").text_information("ver_hw", "MADE_BOARD")
    log.information("uint32_t ver_sw_release", struct.pack("<I", 0x010F02FF))
    log.parameter("SYS_AUTOSTART", 4001).parameter("MPC_XY_CRUISE", 4.5).parameter("CAM_CAP_FBACK", 0)
    log.default("MPC_XY_CRUISE", 5.0).multiple("perf_top", b"0 Idle Task")
    log.subscribe(0, "vehicle_attitude").subscribe(1, "camera_capture").subscribe(2, "cpuload")
    for k in range(rows):
        time = 2_000_000 + 20_000 * k
        log.row(0, "uint64_t uint64_t float float float float", time, time - 1000, 0.8, 0.6 * (-1) ** k, 0.0, 0.0)
        if k % 7 == 3:
            log.row(1, "uint64_t uint64_t double double uint32_t float float float float float float int8_t", time + 5,
                    1_700_000_000_000_000 + time, 35.0 + 1e-5 * k, 139.0 - 1e-5 * k, k // 7, 50.5, 45.25,
                    0.8, 0.0, 0.6, 0.0, 1)  # fmt: skip
        if k % 5 == 0:
            log.row(2, "uint64_t float", time + 9, 0.25)
        if k % 10 == 9:
            log.sync()
        if k % 30 == 29:
            log.text(time, f"[navigator] waypoint {k}").dropout(k)
    return bytes(log.data)
