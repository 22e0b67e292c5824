"""Vehicle profiles."""

import math
from pathlib import Path

import pytest

from uavkit.core.errors import InputError
from uavkit.core.vehicle import VehicleKind
from uavkit.formats.vehicle_profiles import list_vehicles, load_vehicle, read_vehicle, vehicle_folder

VALID = (vehicle_folder() / "generic_arducopter.toml").read_text(encoding="utf-8")


def changed(tmp_path: Path, old: str, new: str) -> Path:
    assert old in VALID
    path = tmp_path / "mine.toml"
    path.write_text(VALID.replace(old, new), encoding="utf-8")
    return path


def test_the_vehicle_of_the_paper() -> None:
    vehicle = load_vehicle("asctec falcon-8")
    assert (vehicle.payload_g, vehicle.endurance_s / 60.0) == (500.0, 16.0)
    assert vehicle.kind is VehicleKind.MULTIROTOR


def test_every_profile_is_sound() -> None:
    assert len(list_vehicles()) == len(list(vehicle_folder().glob("*.toml"))) >= 5
    for name in list_vehicles():
        vehicle = load_vehicle(name)
        assert vehicle.name == name
        assert vehicle.speed_m_s <= vehicle.greatest_speed_m_s
        assert len(vehicle.source.split()) > 10
    assert {load_vehicle(name).autopilot for name in list_vehicles()} == {"ardupilot", "px4", "dji", "other"}


def test_a_plane_banks_no_more_than_30_degrees() -> None:
    plane = load_vehicle("Generic foam plane")
    assert plane.kind is VehicleKind.FIXED_WING
    bank = math.atan(plane.speed_m_s**2 / (9.81 * plane.turn_radius_m))
    assert math.degrees(bank) < 30.5


def test_names_of_files_and_files_of_ones_own(tmp_path: Path) -> None:
    assert load_vehicle("dji_matrice350") == load_vehicle("DJI Matrice 350 RTK")
    own = changed(tmp_path, 'name = "Generic ArduCopter"', 'name = "Mine"')
    assert load_vehicle(str(own)).name == "Mine"


def test_an_unknown_name_tells_the_nearest() -> None:
    with pytest.raises(InputError, match="did you mean 'AscTec Falcon 8'"):
        load_vehicle("asctek falcon")
    with pytest.raises(InputError, match="Known: "):
        load_vehicle("")


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("payload_g", "payload_kg", "did you mean 'payload_g'"),
        ("endurance_s = 720.0", "", "lacks 'endurance_s'"),
        ("endurance_s = 720.0", "endurance_s = -1.0", "endurance_s"),
        ('autopilot = "ardupilot"', 'autopilot = "apm"', "autopilot"),
        ("speed_m_s = 5.0", "speed_m_s = 15.0", "greatest_speed_m_s"),
        ('kind = "multirotor"', 'kind = "fixed wing"', "turn_radius_m"),
    ],
)
def test_what_is_refused(old: str, new: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_vehicle(changed(tmp_path, old, new))
    assert "mine.toml" in str(caught.value)
