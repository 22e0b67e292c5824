"""A flight plan on disk, ``NAME.flightplan.json``: versioned JSON without loss."""

import json
from pathlib import Path

from uavkit.core.errors import InputError
from uavkit.core.flightplan import FlightPlan
from uavkit.formats.atomic import write_text
from uavkit.formats.record_codec import InlineArrays, decode, encode

FORMAT, VERSION = "uavkit flight plan", 1
SUFFIX = ".flightplan.json"


def write_flightplan(path: Path, plan: FlightPlan) -> None:
    """Write a plan, whole or not at all; a line for each of its parts, so that two plans compare well."""
    parts = encode(plan, InlineArrays())
    lines = [f' "format": "{FORMAT}"', f' "version": {VERSION}', ' "plan": {\n' + ",\n".join(_lines(parts)) + "\n }"]
    write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


def _lines(parts: dict[str, object]) -> list[str]:
    return [f"  {_json(key)}: {_json(value)}" for key, value in parts.items()]


def _json(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def read_flightplan(path: Path) -> FlightPlan:
    """Read a plan; raises InputError for another format or version, unknown keys and damage."""
    try:
        content = json.loads(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: the flight plan is damaged ({error}): plan again") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{path}: this is no flight plan of uavkit: give the {SUFFIX} that 'uavkit plan' writes")
    if content.get("version") != VERSION:
        raise InputError(
            f"{path}: the flight plan has version {content.get('version')}, this uavkit reads {VERSION}: plan again"
        )
    plan = decode(FlightPlan, content.get("plan"), InlineArrays(), f"{path}: plan")
    _check(path, plan)
    return plan


def _check(path: Path, plan: FlightPlan) -> None:
    """Refuse tables of unequal length and indices that lead nowhere."""
    table, count = plan.exposures, len(plan.exposures)
    names = [name for name in table.__dataclass_fields__ if len(getattr(table, name)) != count]
    if names:
        raise InputError(f"{path}: plan.exposures.{names[0]} has not {count} rows: the file was changed, plan again")
    if count and not (table.strip.min() >= 0 and table.strip.max() < len(plan.strips)):
        raise InputError(f"{path}: plan.exposures.strip names a strip that is not there: plan again")
    for number, sortie in enumerate(plan.sorties):
        for waypoint in sortie.waypoints:
            if waypoint.exposure >= count or waypoint.strip >= len(plan.strips):
                raise InputError(f"{path}: plan.sorties[{number}] names an exposure or strip that is not there")
