"""Missions as ``.waypoints`` files: the text of ArduPilot's ground stations, ``QGC WPL 110``.

The first item is home, which ArduPilot does not fly to; a file whose first item is something else has no home.
"""

import math
import re
from pathlib import Path

from uavkit.core.errors import InputError
from uavkit.core.mission import Mission, MissionFrame, MissionItem
from uavkit.formats.atomic import write_text
from uavkit.formats.mission_items import mission_item

_HEADER = "QGC WPL 110"
_COLUMNS = 12
_LARGEST_BYTES = 64 * 1024 * 1024


def write_waypoints(path: Path, mission: Mission) -> None:
    """Write a mission, whole or not at all; a home that is not known is written as zeros."""
    home = MissionItem(
        command=16,
        frame=MissionFrame.GEOID,
        latitude_deg=mission.home_latitude_deg or 0.0,
        longitude_deg=mission.home_longitude_deg or 0.0,
        altitude_m=mission.home_height_geoid_m or 0.0,
    )
    lines = [_line(number, item) for number, item in enumerate((home, *mission.items))]
    write_text(path, "\n".join([_HEADER, *lines]) + "\n")


def read_waypoints(path: Path) -> Mission:
    """Read a mission; raises InputError with the line number for whatever is damaged."""
    lines = _lines(path)
    items: list[MissionItem] = []
    for number, line in lines:
        items.append(_item(f"{path}: line {number}", line, len(items)))
    if not items:
        raise InputError(f"{path}: the file holds no mission item below its header")
    first = items[0]
    if first.command not in (0, 16) or first.frame is not MissionFrame.GEOID:
        return Mission(items=tuple(items), source=str(path))
    known = (first.latitude_deg, first.longitude_deg) != (0.0, 0.0) and math.isfinite(first.latitude_deg)
    return Mission(
        items=tuple(items[1:]),
        home_latitude_deg=first.latitude_deg if known else None,
        home_longitude_deg=first.longitude_deg if known else None,
        home_height_geoid_m=first.altitude_m if known else None,
        source=str(path),
    )


def _line(number: int, item: MissionItem) -> str:
    parameters = (_text(value, 8) for value in item.parameters)
    place = (_text(item.latitude_deg, 9), _text(item.longitude_deg, 9), _text(item.altitude_m, 6))
    flags = (str(number), "1" if number == 0 else "0", str(item.frame.value), str(item.command))
    return "\t".join((*flags, *parameters, *place, "1" if item.autocontinue else "0"))


def _text(value: float, digits: int) -> str:
    return "nan" if math.isnan(value) else f"{value:.{digits}f}"


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines of items with their numbers; raises InputError for another format or version."""
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise InputError(f"{path}: {path.stat().st_size} bytes are no mission")
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no text (byte {error.start}): save the mission as .waypoints") from error
    header, *lines = re.split(r"\r\n|\n|\r", text)
    words = header.split()
    if words[:2] != ["QGC", "WPL"]:
        raise InputError(f"{path}: line 1 should be {_HEADER!r}: this is no .waypoints file")
    if words != _HEADER.split():
        raise InputError(f"{path}: version {' '.join(words[2:])!r} of the format, 110 is understood: save it again")
    return [
        (number, line)
        for number, line in enumerate(lines, start=2)
        if line.strip() and not line.lstrip().startswith("#")
    ]


def _item(where: str, line: str, expected: int) -> MissionItem:
    """Return the item of a line: index, current, frame, command, 4 parameters, place, autocontinue."""
    cells = line.split()
    if len(cells) != _COLUMNS:
        raise InputError(
            f"{where} has {len(cells)} columns, {_COLUMNS} make an item: the file is damaged, save it again"
        )
    index, _, frame, command = (_whole(where, cell) for cell in cells[:4])
    if index != expected:
        raise InputError(
            f"{where} is item {index}, {expected} should follow: a line is missing, doubled or out of order"
        )
    home_without_command = command == 0 and index == 0  # Mission Planner's, before it knows the vehicle
    autocontinue = _whole(where, cells[11]) != 0
    numbers = tuple(_number(where, cell) for cell in cells[4:11])
    return mission_item(where, 16 if home_without_command else command, frame, numbers, autocontinue)


def _whole(where: str, cell: str) -> int:
    if not re.fullmatch(r"[+-]?\d{1,9}", cell, re.ASCII):
        raise InputError(f"{where}: {cell[:40]!r} is no whole number: the file is damaged, save it again")
    return int(cell)


def _number(where: str, cell: str) -> float:
    if re.fullmatch(r"[+-]?\d+,\d*", cell):
        raise InputError(f"{where}: {cell!r}: decimal commas are not accepted, write decimal points")
    try:
        return float(cell)
    except ValueError:
        raise InputError(f"{where}: {cell[:40]!r} is no number: the file is damaged, save it again") from None
