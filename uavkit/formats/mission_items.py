"""What the readers of missions share: which frames and places are understood, and how they are refused."""

import math

from uavkit.core.errors import InputError
from uavkit.core.mission import MissionFrame, MissionItem

_FRAMES = {
    0: MissionFrame.GEOID,
    2: MissionFrame.COMMAND,
    3: MissionFrame.TAKE_OFF,
    5: MissionFrame.GEOID,
    6: MissionFrame.TAKE_OFF,
    10: MissionFrame.TERRAIN,
    11: MissionFrame.TERRAIN,
}
"""MAV_FRAME; 5, 6 and 11 are the same as 0, 3 and 10 for positions sent as whole numbers."""
_PLACES = frozenset({16, 17, 18, 19, 20, 21, 22, 31, 82, 84, 85})
_HIGHEST_COMMAND = 65535


def mission_item(
    where: str, command: int, frame: int, numbers: tuple[float, ...], autocontinue: bool = True
) -> MissionItem:
    """Return an item of MAVLink's seven parameters; raises InputError for what cannot be, naming the place."""
    if frame not in _FRAMES:
        raise InputError(f"{where}: frame {frame} is not understood: let altitudes count from take-off or sea level")
    if not 0 < command <= _HIGHEST_COMMAND:
        raise InputError(f"{where}: {command} is no command of MAVLink")
    if any(map(math.isinf, numbers)):
        raise InputError(f"{where}: a parameter is infinite")
    p1, p2, p3, p4, latitude, longitude, altitude = numbers
    if command in _PLACES and (abs(latitude) > 90.0 or abs(longitude) > 180.0):
        swapped = abs(longitude) <= 90.0 and abs(latitude) <= 180.0
        hint = "latitude and longitude are swapped" if swapped else "give decimal degrees"
        raise InputError(f"{where}: latitude {latitude:g}, longitude {longitude:g} is no place on earth: {hint}")
    return MissionItem(
        command=command,
        frame=_FRAMES[frame],
        parameters=(p1, p2, p3, p4),
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=altitude,
        autocontinue=autocontinue,
    )
