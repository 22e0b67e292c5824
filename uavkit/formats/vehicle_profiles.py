"""Vehicle profiles: the limits of a type of vehicle, as TOML files in ``hardware/vehicles``."""

from functools import lru_cache
from pathlib import Path
from typing import Literal

from pydantic import Field

from uavkit.core.errors import InputError
from uavkit.core.vehicle import VehicleKind, VehicleProfile
from uavkit.formats.options_file import StrictModel, read_toml
from uavkit.formats.profile_names import profile_named

PACKAGE = Path(__file__).resolve().parents[1]


class _Profile(StrictModel):
    name: str = Field(min_length=1)
    maker: str
    kind: Literal["multirotor", "fixed wing"]
    endurance_s: float = Field(gt=0, le=86400)
    payload_g: float = Field(ge=0, le=100000)
    speed_m_s: float = Field(gt=0, le=100)
    greatest_speed_m_s: float = Field(gt=0, le=100)
    climb_m_s: float = Field(gt=0, le=50)
    descent_m_s: float = Field(gt=0, le=50)
    acceleration_m_s2: float = Field(gt=0, le=50)
    turn_radius_m: float = Field(ge=0, le=1000)
    greatest_wind_m_s: float | None = Field(default=None, gt=0, le=50)
    most_mission_items: int = Field(ge=10, le=100000)
    autopilot: Literal["ardupilot", "px4", "dji", "other"]
    source: str = Field(min_length=1)


def vehicle_folder() -> Path:
    """Return where the profiles lie: in a checkout ``hardware/vehicles``, in an installed wheel beside the code."""
    checkout = PACKAGE.parent / "hardware" / "vehicles"
    folder = checkout if (PACKAGE.parent / "pyproject.toml").is_file() else PACKAGE / "data" / "vehicles"
    if not folder.is_dir():
        raise InputError(f"the vehicle profiles are missing at {folder}: install uavkit again")
    return folder


def read_vehicle(path: Path) -> VehicleProfile:
    """Read one profile; raises InputError with file, key and nearest known key, and for limits that contradict."""
    content = read_toml(path, _Profile)
    if content.speed_m_s > content.greatest_speed_m_s:
        raise InputError(
            f"{path}: speed_m_s = {content.speed_m_s:g} is more than greatest_speed_m_s = "
            f"{content.greatest_speed_m_s:g}: lower the one or raise the other"
        )
    if content.kind == "fixed wing" and content.turn_radius_m == 0.0:
        raise InputError(f"{path}: turn_radius_m = 0: a fixed wing does not turn on the spot, give its radius")
    return VehicleProfile(**{**content.model_dump(), "kind": VehicleKind(content.kind)})


@lru_cache(maxsize=4)
def _profiles(folder: Path) -> dict[str, VehicleProfile]:
    """Return all profiles by the names of their files."""
    return {path.stem: read_vehicle(path) for path in sorted(folder.glob("*.toml"))}


def list_vehicles() -> tuple[str, ...]:
    """Return the names of all profiles."""
    return tuple(profile.name for profile in _profiles(vehicle_folder()).values())


def load_vehicle(name: str) -> VehicleProfile:
    """Return the profile of a name, or of a path to a TOML file of one's own.

    Case, blanks, hyphens and underscores do not count. Raises InputError for an unknown name, with the nearest one.
    """
    if name.lower().endswith(".toml"):
        return read_vehicle(Path(name))
    profiles = _profiles(vehicle_folder())
    return profiles[profile_named("vehicle", name, {key: (found.name, key) for key, found in profiles.items()})]
