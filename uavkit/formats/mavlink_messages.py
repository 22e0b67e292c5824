"""MAVLink's messages: their numbers, checksum bytes and wire formats, from pymavlink's table of all dialects.

Only that table is used: pymavlink's readers keep global state, and decode each message one by one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

_DIALECT = "pymavlink.dialects.v20.all"
_IDS = 65_536
"""Numbers are of 24 bits, but no dialect uses more than 16 of them."""
_TYPES = {"Q": "<u8", "q": "<i8", "I": "<u4", "i": "<i4", "H": "<u2", "h": "<i2", "B": "u1", "b": "i1", "f": "<f4",
          "d": "<f8"}  # fmt: skip

HEARTBEAT, SYSTEM_TIME, PARAM_VALUE, GPS_RAW_INT, ATTITUDE, GLOBAL_POSITION_INT = 0, 2, 22, 24, 30, 33
CAMERA_TRIGGER, GPS2_RAW, AUTOPILOT_VERSION, CAMERA_FEEDBACK, STATUSTEXT, CAMERA_IMAGE_CAPTURED = (
    112, 124, 148, 180, 253, 263
)  # fmt: skip

FIELDS: Mapping[int, tuple[str, ...]] = MappingProxyType({
    HEARTBEAT: ("type", "autopilot"),
    SYSTEM_TIME: ("time_unix_usec", "time_boot_ms"),
    PARAM_VALUE: ("param_value", "param_id", "param_type"),
    GPS_RAW_INT: (
        "time_usec", "lat", "lon", "alt", "vel", "cog", "fix_type", "satellites_visible", "alt_ellipsoid", "h_acc",
        "v_acc",
    ),
    GPS2_RAW: (
        "time_usec", "lat", "lon", "alt", "vel", "cog", "fix_type", "satellites_visible", "alt_ellipsoid", "h_acc",
        "v_acc",
    ),
    ATTITUDE: ("time_boot_ms", "roll", "pitch", "yaw"),
    GLOBAL_POSITION_INT: ("time_boot_ms", "lat", "lon", "alt", "relative_alt", "vx", "vy", "vz"),
    CAMERA_TRIGGER: ("time_usec", "seq"),
    AUTOPILOT_VERSION: ("capabilities", "flight_sw_version"),
    CAMERA_FEEDBACK: (
        "time_usec", "lat", "lng", "alt_msl", "alt_rel", "roll", "pitch", "yaw", "img_idx", "cam_idx",
        "completed_captures",
    ),
    STATUSTEXT: ("severity", "text", "id", "chunk_seq"),
    CAMERA_IMAGE_CAPTURED: (
        "time_utc", "time_boot_ms", "lat", "lon", "alt", "relative_alt", "q", "image_index", "camera_id",
        "capture_result",
    ),
})  # fmt: skip
"""The messages that are decoded, and the fields that are used of them, by MAVLink's names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """What is known of all messages."""

    crc_extra: NDArray[np.int16]
    """(65536,) the byte that ends a message's checksum; -1 where no dialect defines the number."""
    longest: NDArray[np.int16]
    """(65536,) bytes of the payload, extensions included."""
    names: Mapping[int, str]
    autopilots: Mapping[int, str]
    vehicle_types: Mapping[int, str]

    def name(self, number: int) -> str:
        """Return the name of a message, UNKNOWN_number where it has none."""
        return self.names.get(number, f"UNKNOWN_{number}")


@lru_cache(maxsize=1)
def dialect() -> Dialect:
    """Return the table of all messages."""
    module = import_module(_DIALECT)
    messages = module.mavlink_map
    extra = np.full(_IDS, -1, dtype=np.int16)
    longest = np.full(_IDS, 255, dtype=np.int16)
    for number, message in messages.items():
        extra[number], longest[number] = message.crc_extra, message.unpacker.size
    extra.setflags(write=False)
    longest.setflags(write=False)
    return Dialect(
        crc_extra=extra,
        longest=longest,
        names=MappingProxyType({number: str(message.msgname) for number, message in messages.items()}),
        autopilots=_enum(module.enums["MAV_AUTOPILOT"], "MAV_AUTOPILOT_"),
        vehicle_types=_enum(module.enums["MAV_TYPE"], "MAV_TYPE_"),
    )


@lru_cache(maxsize=64)
def payload_type(number: int) -> np.dtype[np.void]:
    """Return the type of the used fields of a message, at their places on the wire, as far as the last of them."""
    message = import_module(_DIALECT).mavlink_map[number]
    names, formats, offsets, offset = list[str](), list[object](), list[int](), 0
    for name, letter, count in _wire(message):
        single = np.dtype(f"S{count}" if letter == "s" else _TYPES[letter])
        size = count if letter == "s" else single.itemsize * max(count, 1)
        if name in FIELDS[number]:
            names.append(name)
            formats.append(single if letter == "s" or count == 0 else (single, (count,)))
            offsets.append(offset)
        offset += size
    width = max(o + np.dtype(f).itemsize for o, f in zip(offsets, formats, strict=True))  # type: ignore[call-overload]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": width})


@lru_cache(maxsize=64)
def record_type(number: int) -> np.dtype[np.void]:
    """Return the type of the used fields of a message without gaps between them."""
    wire = payload_type(number)
    return np.dtype([(name, wire.fields[name][0]) for name in wire.names or () if wire.fields])


def _wire(message: object) -> list[tuple[str, str, int]]:
    """Return name, struct letter and length (0 where it is no array) of a message's fields as they are sent."""
    text = str(message.unpacker.format).lstrip("<")  # type: ignore[attr-defined]
    fields, digits = list[tuple[str, str, int]](), ""
    names = iter(message.ordered_fieldnames)  # type: ignore[attr-defined]
    for letter in text:
        if letter.isdigit():
            digits += letter
        else:
            fields.append((str(next(names)), letter, int(digits or 0) or (letter == "s")))
            digits = ""
    return fields


def _enum(entries: Mapping[int, object], prefix: str) -> Mapping[int, str]:
    names = {number: str(entry.name) for number, entry in entries.items()}  # type: ignore[attr-defined]
    words = {number: name.removeprefix(prefix).replace("_", " ").lower() for number, name in names.items()}
    return MappingProxyType(words)
