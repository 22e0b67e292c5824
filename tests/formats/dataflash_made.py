"""Dataflash logs that tests encode themselves: every byte from a known value, by a table of their own."""

import struct
from dataclasses import dataclass, field

import numpy as np

from uavkit.core.gpstime import WEEK_NS

PACKED = {
    "b": "b", "B": "B", "h": "h", "H": "H", "i": "i", "I": "I", "f": "f", "d": "d", "n": "4s", "N": "16s", "Z": "64s",
    "c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "M": "B", "q": "q", "Q": "Q", "a": "64s",
}  # fmt: skip
MODERN = {
    "PARM": (32, "QNff", "TimeUS,Name,Value,Default"),
    "MSG": (59, "QZ", "TimeUS,Message"),
    "ATT": (72, "QffffffB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,AEKF"),
    "POS": (74, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "CAM": (81, "QBHIHLLeeeccC", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y"),
    "TRIG": (82, "QBHIHLLeeeccC", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y"),
    "GPS": (94, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "GPA": (95, "QBCCCCfBIHeHH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta,AEl,RTCMFU,RTCMFD"),
    "NOIS": (110, "QZ", "TimeUS,Bytes"),
    "FILE": (111, "NIBZ", "FileName,Offset,Length,Data"),
    "EV": (112, "QB", "TimeUS,Id"),
}
"""Type, format and columns by name, as firmware 4.6 writes them; NOIS stands for the many that nobody decodes."""
WEEK = 2446
WEEK_MS = 13_833_000
BOOT_US = 42_173_000
"""When WEEK_MS was, by the boot clock."""


def packed(characters: str, *values: object) -> bytes:
    """Return values as bytes; texts are filled with zeros."""
    return struct.pack("<" + "".join(PACKED[character] for character in characters), *values)


def fmt(number: int, name: str, characters: str, columns: str, length: int | None = None) -> bytes:
    """Return an FMT message."""
    size = 3 + struct.calcsize("<" + "".join(PACKED[c] for c in characters)) if length is None else length
    fields = packed("BBnNZ", number, size, name.encode(), characters.encode(), columns.encode())
    return b"\xa3\x95\x80" + fields


@dataclass
class MadeLog:
    """A log in the making."""

    kinds: dict[str, tuple[int, str, str]] = field(default_factory=lambda: dict(MODERN))
    data: bytearray = field(default_factory=bytearray)
    messages: list[tuple[int, int, str]] = field(default_factory=list)
    """Begin, end and name of each."""

    def define_all(self) -> "MadeLog":
        self._add("FMT", fmt(0x80, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"))
        for name in self.kinds:
            self.define(name)
        return self

    def define(self, name: str) -> None:
        self._add("FMT", fmt(self.kinds[name][0], name, *self.kinds[name][1:]))

    def add(self, name: str, *values: object) -> None:
        number, characters, _ = self.kinds[name]
        self._add(name, b"\xa3\x95" + bytes([number]) + packed(characters, *values))

    def raw(self, data: bytes) -> None:
        """Add bytes that are no message."""
        self.data += data

    def length(self, name: str) -> int:
        if name == "FMT":
            return 89
        return 3 + struct.calcsize("<" + "".join(PACKED[character] for character in self.kinds[name][1]))

    def _add(self, name: str, message: bytes) -> None:
        self.messages.append((len(self.data), len(self.data) + len(message), name))
        self.data += message

    def gps(self, at_us: int, number: int = 0, **changed: object) -> None:
        """Add a GPS and its GPA: a fix whose time fits the boot clock."""
        since_ms = (at_us - BOOT_US) // 1000
        values = {
            "TimeUS": at_us + 20_000, "I": number, "Status": 6, "GMS": WEEK_MS + since_ms, "GWk": WEEK, "NSats": 14,
            "HDop": 121, "Lat": 358000916, "Lng": 1396501063, "Alt": 2007, "Spd": 4.0, "GCrs": 90.0, "VZ": -0.5,
            "Yaw": 0.0, "U": 1,
        } | changed  # fmt: skip
        self.add("GPS", *(values[name] for name in MODERN["GPS"][2].split(",")))
        self.add("GPA", values["TimeUS"], number, 200, 30, 45, 7, 0.0, 1, at_us // 1000, 200, 4212, 0, 0)

    def cam(self, name: str, at_us: int, image: int, number: int = 0) -> None:
        """Add a CAM or a TRIG; its GPSTime is that of a fix before it."""
        self.add(
            name, at_us, number, image, WEEK_MS + 200 * ((at_us - BOOT_US) // 200_000), WEEK, 358000924, 1396501023,
            2006, 1499, 2100, -931, -372, 35_974,
        )  # fmt: skip


def gps_ns(at_us: int) -> int:
    """Return the GPS time that the made logs' boot clock has."""
    return WEEK * WEEK_NS + WEEK_MS * 1_000_000 + (at_us - BOOT_US) * 1000


def small_flight(rng: np.random.Generator, seconds: int = 12) -> MadeLog:
    """Return a log of some seconds in which every message can be told from every other, noise among them."""
    log = MadeLog().define_all()
    log.add("MSG", BOOT_US, b"ArduCopter V4.6.3 (92b0cd78)")
    for k in range(20):
        log.add("PARM", BOOT_US + k, f"P_{k}".encode(), float(k), 0.0)
    for tick in range(seconds * 25):
        at_us = BOOT_US + tick * 40_000
        noise = rng.integers(0, 256, 64, dtype=np.uint8).tobytes()
        log.add("NOIS", at_us, noise)
        log.add("ATT", at_us + 1, 0.0, tick * 0.01, 0.0, -tick * 0.02, 0.0, tick * 0.5, 3)
        log.add("POS", at_us + 2, 358000000 + tick, 1396500000 - tick, 20.0 + tick, 15.0 + tick, 14.0)
        if tick % 5 == 0:
            log.gps(at_us)
        if tick % 7 == 0:
            log.cam("CAM", at_us + 4, tick // 7)
        if tick % 11 == 0:
            log.add("FILE", b"@SYS/uarts.txt", tick, 64, noise[::-1])
        if tick % 13 == 0:
            log.add("EV", at_us + 6, tick % 256)
    return log
