"""Missions as QGroundControl's ``.plan`` files, version 1, with plain mission items.

A survey or corridor of QGroundControl's own is read where the file carries the plain items that it was turned into.
"""

import json
import math
from pathlib import Path
from typing import Any

from uavkit.core.errors import InputError
from uavkit.core.mission import Mission, MissionFrame, MissionItem
from uavkit.formats.atomic import write_text
from uavkit.formats.mission_items import mission_item

_VERSION, _MISSION_VERSION, _FENCE_VERSION = 1, 2, 2
_TRANSECT_VERSIONS = {"survey": (3, 4, 5), "CorridorScan": (2, 3)}
"""Of QGroundControl's own items that carry their plain items."""
_ALTITUDE_MODES = {MissionFrame.TAKE_OFF: 1, MissionFrame.GEOID: 2, MissionFrame.TERRAIN: 4}
_LARGEST_BYTES = 64 * 1024 * 1024


def write_plan(path: Path, mission: Mission) -> None:
    """Write a mission, whole or not at all."""
    write_text(path, json.dumps(_document(mission), indent=4, allow_nan=False) + "\n")


def read_plan(path: Path) -> Mission:
    """Read the mission of a plan; raises InputError for other versions, items that carry no plain ones, and damage."""
    content = _load(path)
    version = content.get("version")
    if content.get("fileType", "Plan") != "Plan":
        raise InputError(f"{path}: this is a {content['fileType']!r} file of QGroundControl, no plan: save the plan")
    if version != _VERSION:
        raise InputError(
            f"{path}: the plan has version {version!r}, {_VERSION} is understood: save it again as a .plan"
        )
    mission = content.get("mission")
    if not isinstance(mission, dict):
        raise InputError(f"{path}: the plan holds no mission (only fences or rally points): save it with its mission")
    if mission.get("version") != _MISSION_VERSION:
        raise InputError(
            f"{path}: its mission has version {mission.get('version')!r}, {_MISSION_VERSION} is understood: open it in "
            f"a current QGroundControl and save it again"
        )
    items = mission.get("items")
    if not isinstance(items, list):
        raise InputError(f"{path}: the mission has no list of items")
    latitude, longitude, height_m = _home(path, mission.get("plannedHomePosition"))
    return Mission(
        items=tuple(item for number, plain in enumerate(items, start=1) for item in _items(path, plain, f"{number}")),
        home_latitude_deg=latitude,
        home_longitude_deg=longitude,
        home_height_geoid_m=height_m,
        cruise_speed_m_s=_speed(mission.get("cruiseSpeed")),
        hover_speed_m_s=_speed(mission.get("hoverSpeed")),
        firmware=_whole(path, mission.get("firmwareType", 3), "firmwareType"),
        vehicle_type=_whole(path, mission.get("vehicleType", 2), "vehicleType"),
        source=str(path),
    )


def _document(mission: Mission) -> dict[str, Any]:
    frames = {item.frame for item in mission.items if item.frame in _ALTITUDE_MODES}
    home = (mission.home_latitude_deg, mission.home_longitude_deg, mission.home_height_geoid_m)
    return {
        "fileType": "Plan",
        "geoFence": {"circles": [], "polygons": [], "version": _FENCE_VERSION},
        "groundStation": "QGroundControl",
        "mission": {
            "cruiseSpeed": mission.cruise_speed_m_s or 0,
            "firmwareType": mission.firmware,
            "globalPlanAltitudeMode": _ALTITUDE_MODES[frames.pop()] if len(frames) == 1 else 0,
            "hoverSpeed": mission.hover_speed_m_s or 0,
            "items": [_plain_item(number, item) for number, item in enumerate(mission.items, start=1)],
            "plannedHomePosition": [value or 0 for value in home],
            "vehicleType": mission.vehicle_type,
            "version": _MISSION_VERSION,
        },
        "rallyPoints": {"points": [], "version": _FENCE_VERSION},
        "version": _VERSION,
    }


def _plain_item(number: int, item: MissionItem) -> dict[str, Any]:
    numbers = (*item.parameters, item.latitude_deg, item.longitude_deg, item.altitude_m)
    altitude = (
        {
            "AMSLAltAboveTerrain": None,
            "Altitude": _null(item.altitude_m),
            "AltitudeMode": _ALTITUDE_MODES[item.frame],
        }
        if item.frame in _ALTITUDE_MODES
        else {}
    )
    return {
        **altitude,
        "autoContinue": item.autocontinue,
        "command": item.command,
        "doJumpId": number,
        "frame": item.frame.value,
        "params": [_null(value) for value in numbers],
        "type": "SimpleItem",
    }


def _null(value: float) -> float | int | None:
    """Return what JSON holds: null for nan, whole numbers without a point, as QGroundControl writes them."""
    if math.isnan(value):
        return None
    rounded = round(value, 10)
    return int(rounded) if rounded == int(rounded) else rounded


def _load(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise InputError(f"{path}: {path.stat().st_size} bytes are no mission")
        content = json.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: the plan is damaged ({error}): save it again") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: this is no plan of QGroundControl")
    return content


def _items(path: Path, plain: Any, number: str) -> list[MissionItem]:
    """Return the item, or the plain items that one of QGroundControl's own carries."""
    where = f"{path}: item {number}"
    if not isinstance(plain, dict):
        raise InputError(f"{where} is no mission item: save the plan again")
    if plain.get("type") == "SimpleItem":
        return [_simple(where, plain)]
    if plain.get("type") != "ComplexItem":
        raise InputError(f"{where} has the type {plain.get('type')!r}: SimpleItem and ComplexItem are understood")
    name = plain.get("complexItemType")
    transect = plain.get("TransectStyleComplexItem")
    inner = transect.get("Items") if isinstance(transect, dict) else None
    if not isinstance(name, str) or not isinstance(inner, list) or not inner:
        raise InputError(
            f"{where} is a {name!r} of QGroundControl and carries no plain mission items: upload the plan with "
            f"it, download it again and save what comes back"
        )
    versions = _TRANSECT_VERSIONS.get(name, ())
    if plain.get("version") not in versions:
        known = ", ".join(map(str, versions)) or "none"
        raise InputError(
            f"{where} is a {name!r} of QGroundControl, version {plain.get('version')!r}, understood: {known}: open the "
            f"plan in a current QGroundControl and save it again"
        )
    return [item for part, other in enumerate(inner, start=1) for item in _items(path, other, f"{number}.{part}")]


def _simple(where: str, plain: dict[str, Any]) -> MissionItem:
    params = plain.get("params")
    if not isinstance(params, list) or len(params) != 7:
        raise InputError(f"{where} needs a list of 7 'params'")
    return mission_item(
        where,
        _whole(where, plain.get("command"), "command"),
        _whole(where, plain.get("frame"), "frame"),
        tuple(_number(where, value) for value in params),
        plain.get("autoContinue", True) is not False,
    )


def _number(where: str, value: Any) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e300:
        raise InputError(f"{where}: the parameter {str(value)[:40]!r} is no number")
    return float(value)


def _whole(where: object, value: Any, key: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float) or not -1e9 < value < 1e9 or value != int(value):
        raise InputError(f"{where}: {key} should be a whole number, is {str(value)[:40]!r}")
    return int(value)


def _speed(value: Any) -> float | None:
    known = isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < 1000
    return float(value) if known else None


def _home(path: Path, value: Any) -> tuple[float | None, float | None, float | None]:
    """Return latitude, longitude and height of home, None where the plan does not tell (some write zeros)."""
    if value is None:
        return None, None, None
    if not isinstance(value, list) or len(value) not in (2, 3):
        raise InputError(f"{path}: plannedHomePosition should be latitude, longitude, altitude")
    latitude, longitude, *height = (_number(f"{path}: plannedHomePosition", number) for number in value)
    if (latitude, longitude) == (0.0, 0.0) or not (math.isfinite(latitude) and math.isfinite(longitude)):
        return None, None, None
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        raise InputError(f"{path}: plannedHomePosition {latitude:g}, {longitude:g} is no place on earth")
    return latitude, longitude, height[0] if height and math.isfinite(height[0]) else None
