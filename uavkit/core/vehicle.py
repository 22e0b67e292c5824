"""What is known of a vehicle before it flies."""

from dataclasses import dataclass
from enum import Enum


class VehicleKind(Enum):
    """How a vehicle stays in the air."""

    MULTIROTOR = "multirotor"
    FIXED_WING = "fixed wing"


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleProfile:
    """Limits of a type of vehicle; None where the maker does not state one."""

    name: str
    maker: str
    kind: VehicleKind
    endurance_s: float
    """With the payload, in still air, to the landing with an empty battery."""
    payload_g: float
    speed_m_s: float
    """Usual speed on a strip."""
    greatest_speed_m_s: float
    climb_m_s: float
    descent_m_s: float
    acceleration_m_s2: float
    """When it starts and stops at a waypoint."""
    turn_radius_m: float
    """Least radius at its usual speed; 0 for a vehicle that turns on the spot."""
    greatest_wind_m_s: float | None
    most_mission_items: int
    """That its autopilot holds."""
    autopilot: str
    """``ardupilot``, ``px4``, ``dji`` or ``other``."""
    source: str
