"""Mission items as autopilots hold them: MAVLink's commands with their parameters."""

from dataclasses import dataclass
from enum import Enum, IntEnum


class MissionCommand(IntEnum):
    """The commands of MAVLink (MAV_CMD) that a plan uses."""

    WAYPOINT = 16
    """Parameters: hold s, acceptance radius m, pass radius m, yaw deg (nan: as the autopilot likes)."""
    RETURN_TO_LAUNCH = 20
    LAND = 21
    TAKEOFF = 22
    CONDITION_YAW = 115
    """Parameters: yaw deg, rate deg/s, direction, 0: absolute."""
    DO_CHANGE_SPEED = 178
    """Parameters: 1 (ground speed), m/s, throttle (-1: unchanged), 0: absolute."""
    DO_SET_HOME = 179
    DO_DIGICAM_CONTROL = 203
    """Parameter 5 (latitude's place) = 1: take one picture."""
    DO_MOUNT_CONTROL = 205
    """Parameters: pitch deg, roll deg, yaw deg; parameter 7 (altitude's place) = 2: these angles."""
    DO_SET_CAM_TRIGG_DIST = 206
    """Parameters: distance m (0: stop), shutter ms, 1: take one at once."""
    DO_SET_CAM_TRIGG_INTERVAL = 214
    IMAGE_START_CAPTURE = 2000
    """Parameters: camera (0: all), interval s, number (0: no end)."""
    IMAGE_STOP_CAPTURE = 2001


class MissionFrame(Enum):
    """What the altitude of an item counts from; the value is MAV_FRAME."""

    GEOID = 0
    """Above mean sea level as the autopilot knows it."""
    COMMAND = 2
    """No position."""
    TAKE_OFF = 3
    """Above the take-off point (MAVLink: home)."""
    TERRAIN = 10
    """Above the ground as the autopilot's own terrain data know it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionItem:
    """One item of a mission; positions in degrees of WGS 84, altitude in metres in the item's frame.

    For commands without a position latitude, longitude and altitude carry parameters 5, 6 and 7.
    """

    command: int
    """A number of MAV_CMD, not only of those in MissionCommand: foreign plans hold others."""
    frame: MissionFrame
    parameters: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Parameters 1 to 4; nan means that the autopilot decides."""
    latitude_deg: float = 0.0
    longitude_deg: float = 0.0
    altitude_m: float = 0.0
    autocontinue: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """What is uploaded to an autopilot for one flight."""

    items: tuple[MissionItem, ...]
    home_latitude_deg: float | None = None
    home_longitude_deg: float | None = None
    home_height_geoid_m: float | None = None
    """Of the take-off point above mean sea level; None where the file does not tell."""
    cruise_speed_m_s: float | None = None
    hover_speed_m_s: float | None = None
    firmware: int = 3
    """MAV_AUTOPILOT: 3 ArduPilot, 12 PX4."""
    vehicle_type: int = 2
    """MAV_TYPE: 1 fixed wing, 2 quadrotor."""
    source: str = ""
    """The file that it was read from."""
