"""What the columns of a CSV are: declared by the user, or guessed for a declaration to begin with.

The declaration is a TOML file beside the CSV, named like it with ``.toml`` behind (flight.csv, flight.csv.toml)::

    role = "exposures"              # or "fixes", "attitudes", "estimates" (the autopilot's own positions)
    separator = ","                 # or ";", "\\t", " " (any number of blanks)
    exposure_kind = "feedback"      # what noticed the exposures: feedback, mark, captured, trigger, listed

    [columns]                       # on the left what it is, on the right the name in the CSV's own header
    gps_week = "Week"               # one way to tell the time: gps_week and gps_seconds_of_week, gps_s (since 1980),
    gps_seconds_of_week = "TOW"     # gps_time_ns, unix_s, unix_ms, or utc (ISO 8601); boot_s beside it
    latitude_deg = "Lat"
    longitude_deg = "Lon"
    height_ellipsoid_m = "Alt"      # or height_geoid_m, height_above_home_m: the datum must be known
    roll_deg = "Roll"               # or roll_rad, likewise pitch and yaw (from true north, clockwise)
    sigma_horizontal_m = "HAcc"
    sequence = "No"
    name = "Image"
"""

import csv
import json
import math
import re
from pathlib import Path
from typing import Literal

from uavkit.core.errors import InputError
from uavkit.formats.log_lines import number
from uavkit.formats.log_tables import ANGLES, CODES, NUMBERS, TIMES, Role
from uavkit.formats.options_file import StrictModel

CLOCKS = ("gps_week", "gps_seconds_of_week", "gps_s", "gps_time_ns", "unix_s", "unix_ms", "utc")
"""Fields that tell GPS time."""
DEGREES = {name.replace("_rad", "_deg"): name for name in ANGLES}
"""Fields of a declaration by what they become."""


class CsvColumns(StrictModel):
    """What the columns of a CSV are: each the name in its header, empty where it has none."""

    gps_week: str = ""
    gps_seconds_of_week: str = ""
    gps_s: str = ""
    gps_time_ns: str = ""
    unix_s: str = ""
    unix_ms: str = ""
    utc: str = ""
    boot_s: str = ""
    boot_time_ns: str = ""
    host_time_ns: str = ""
    latitude_deg: str = ""
    longitude_deg: str = ""
    height_ellipsoid_m: str = ""
    height_geoid_m: str = ""
    height_above_home_m: str = ""
    velocity_east_m_s: str = ""
    velocity_north_m_s: str = ""
    velocity_up_m_s: str = ""
    sigma_horizontal_m: str = ""
    sigma_vertical_m: str = ""
    fix_type: str = ""
    satellites: str = ""
    receiver: str = ""
    sigma_s: str = ""
    kind: str = ""
    sequence: str = ""
    roll_deg: str = ""
    pitch_deg: str = ""
    yaw_deg: str = ""
    roll_rad: str = ""
    pitch_rad: str = ""
    yaw_rad: str = ""
    name: str = ""


class CsvMapping(StrictModel):
    """What a CSV holds."""

    role: Literal["fixes", "estimates", "attitudes", "exposures"]
    separator: Literal[",", ";", "\t", " "] = ","
    exposure_kind: Literal["feedback", "mark", "captured", "trigger", "listed"] = "captured"
    columns: CsvColumns


def check_mapping(mapping: CsvMapping, where: Path) -> None:
    """Refuse a declaration that does not suit its role, or tells the time in two ways."""
    given, role = given_columns(mapping), Role(mapping.role)
    suited = (*CLOCKS, "boot_s", *TIMES, *NUMBERS[role], *CODES[role], *(("name",) if role != Role.ATTITUDES else ()))
    degrees = tuple(DEGREES) if ANGLES[0] in suited else ()
    for name in given:
        if name not in (*suited, *degrees):
            raise InputError(f"{where}: [columns] {name} is nothing that {mapping.role} have")
    clocks = [name for name in CLOCKS if name in given]
    if len(clocks) > 1 and set(clocks) != {"gps_week", "gps_seconds_of_week"}:
        raise InputError(f"{where}: [columns] the time is told twice, by {' and '.join(clocks)}: keep one of them")
    if clocks in (["gps_week"], ["gps_seconds_of_week"]):
        raise InputError(f"{where}: [columns] gps_week and gps_seconds_of_week need one another")
    for one, other in (("latitude_deg", "longitude_deg"), ("boot_s", "boot_time_ns"), *DEGREES.items()):
        if one == "latitude_deg" and (one in given) != (other in given):
            raise InputError(f"{where}: [columns] latitude_deg and longitude_deg need one another")
        if one != "latitude_deg" and one in given and other in given:
            raise InputError(f"{where}: [columns] {one} and {other} are the same: keep one of them")
    angles = [name for name in ANGLES if name in given or name.replace("_rad", "_deg") in given]
    lacking = {
        Role.FIXES: "latitude_deg" not in given,
        Role.ESTIMATES: "latitude_deg" not in given,
        Role.ATTITUDES: len(angles) < 3,
        Role.EXPOSURES: not clocks and "latitude_deg" not in given and not {"boot_s", "boot_time_ns"} & set(given),
    }[role]
    if lacking:
        needed = {Role.ATTITUDES: "roll, pitch and yaw", Role.EXPOSURES: "a time or a position"}
        raise InputError(f"{where}: [columns] {mapping.role} need {needed.get(role, 'latitude_deg and longitude_deg')}")


def given_columns(mapping: CsvMapping) -> dict[str, str]:
    """Return the file's columns that the mapping names, by what they mean."""
    return {name: column for name, column in mapping.columns.model_dump().items() if column}


def cells_of(text: str, separator: str) -> list[str]:
    """Return the cells of a line; none where its quotes are broken."""
    if separator == " ":
        return text.split()
    try:
        return [cell.strip() for cell in next(csv.reader([text], delimiter=separator, strict=True), [])]
    except csv.Error:
        return []


def header_of_table(text: str) -> tuple[list[str], str] | None:
    """Return the names of columns and the separator of a text that is names above numbers; None of any other."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith(("#", "%"))][:20]
    if len(lines) < 2 or "\0" in text[:1000]:
        return None
    for separator in (",", ";", "\t"):
        names = cells_of(lines[0], separator)
        if len(names) < 2 or len(set(names)) < len(names) or not all(names):
            continue
        if any(not math.isnan(number(name)) or len(name) > 60 or set(name) & set("<>{}$=") for name in names):
            continue
        below = cells_of(lines[1], separator)
        if len(below) == len(names) and any(not math.isnan(number(cell)) for cell in below):
            return names, separator
    return None


_GUESSES = (
    ("latitude_deg", r"lat(itude)?\b"), ("longitude_deg", r"lo?n(g|gitude)?\b"), ("height_ellipsoid_m", r".*ell"),
    ("height_geoid_m", r".*(msl|geoid|ortho)"), ("height_above_home_m", r".*(home|agl|rel)"),
    ("gps_week", r"(gps)?week"), ("gps_seconds_of_week", r"(gps)?(tow|sow|secondsofweek)"),
    ("unix_s", r".*(unix|epoch)"), ("utc", r".*(utc|iso|date|time)"),
    ("roll_deg", r"roll"), ("pitch_deg", r"pitch"), ("yaw_deg", r"yaw|head"),
    ("name", r".*(image|photo|file|name)"), ("sequence", r"(seq|index|id|no|number)\b"),
)  # fmt: skip


def mapping_to_write(path: Path, beside: Path, table: tuple[list[str], str] | None) -> str:
    """Return a message with a declaration to begin with, from the names of columns that the file has."""
    if table is None:
        return f"{path}: no CSV with names of columns above its numbers: give another file"
    names, separator = table
    guessed: dict[str, str] = {}
    for field, pattern in _GUESSES:
        for name in names:
            plain = re.sub(r"[\W_]", "", re.sub(r"[(\[].*|[_\s]deg$", "", name.lower()))
            if field not in guessed and name not in guessed.values() and re.match(pattern, plain):
                guessed[field] = name
    role = "exposures" if "name" in guessed or "sequence" in guessed else "fixes"
    if "latitude_deg" not in guessed and "roll_deg" in guessed:
        role = "attitudes"
    rest = [name for name in names if name not in guessed.values()]
    lines = [f'role = "{role}"', f"separator = {json.dumps(separator)}", "[columns]"]
    lines += [f"{field} = {json.dumps(name, ensure_ascii=False)}" for field, name in guessed.items()]
    lines += [f"# not used yet: {', '.join(rest)[:300]}"] if rest else []
    text = "\n".join(lines)
    return f"{path}: a CSV needs a declaration of its columns: write a file {beside.name} beside it, such as\n{text}"
