"""The text files of ArduPilot's ground stations, written and read, flown and damaged ones."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.formats.made_missions import missions, same_items
from tests.formats.mavsdk_peer import mission_reader
from tests.plan.made_plans import made_plan
from uavkit.core.errors import InputError
from uavkit.core.flightplan import Trigger
from uavkit.core.mission import Mission, MissionFrame, MissionItem
from uavkit.formats.waypoints_file import read_waypoints, write_waypoints
from uavkit.plan.mission import mission_of

ROOT = Path(__file__).resolve().parents[2]
FLOWN = ROOT / "sim_logs/sitl_distance_trigger/mission.waypoints"
relaxed = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@given(mission=missions)
@relaxed
def test_round_trip(mission: Mission, tmp_path: Path) -> None:
    write_waypoints(tmp_path / "a.waypoints", mission)
    back = read_waypoints(tmp_path / "a.waypoints")
    assert same_items(mission, back)
    assert back.home_latitude_deg == pytest.approx(mission.home_latitude_deg, abs=1e-7)
    assert back.home_longitude_deg == pytest.approx(mission.home_longitude_deg, abs=1e-7)
    assert back.home_height_geoid_m == pytest.approx(mission.home_height_geoid_m, abs=1e-3)


def test_a_home_that_is_not_known_stays_so(tmp_path: Path) -> None:
    mission = Mission(items=(MissionItem(command=20, frame=MissionFrame.COMMAND),))
    write_waypoints(tmp_path / "a.waypoints", mission)
    assert read_waypoints(tmp_path / "a.waypoints") == replace(mission, source=str(tmp_path / "a.waypoints"))


def test_lines_of_the_format(tmp_path: Path) -> None:
    write_waypoints(tmp_path / "a.waypoints", mission_of(made_plan(strips=1), 0, "ardupilot", "take_off"))
    header, home, take_off, *_ = (tmp_path / "a.waypoints").read_text().splitlines()
    assert header == "QGC WPL 110"
    cells = home.split("\t")
    assert (len(cells), cells[:4], cells[8:10]) == (12, ["0", "1", "0", "16"], ["35.800000000", "139.650000000"])
    assert take_off.split("\t")[:4] == ["1", "0", "3", "22"]
    assert "nan" not in (tmp_path / "a.waypoints").read_text()  # not all ground stations read one


def test_a_flown_mission_is_read() -> None:
    mission = read_waypoints(FLOWN)
    assert mission.home_latitude_deg == 35.8
    assert [item.command for item in mission.items[:3]] == [22, 16, 206]
    assert mission.items[2].parameters == (12.7, 0.0, 1.0, 0.0)


@pytest.mark.parametrize("trigger", list(Trigger))
def test_pymavlink_loads_the_same_items(trigger: Trigger, tmp_path: Path) -> None:
    mavwp = pytest.importorskip("pymavlink.mavwp", reason="pymavlink is not installed")
    mission = mission_of(made_plan(trigger, pattern="facade"), 0, "ardupilot", "geoid")
    write_waypoints(tmp_path / "a.waypoints", mission)
    loader = mavwp.MAVWPLoader()
    assert loader.load(str(tmp_path / "a.waypoints")) == len(mission.items) + 1
    home = loader.wp(0)
    assert (home.command, home.frame, home.current) == (16, 0, 1)
    assert (home.x, home.y, home.z) == pytest.approx(
        (mission.home_latitude_deg, mission.home_longitude_deg, mission.home_height_geoid_m), abs=1e-6
    )
    for number, ours in enumerate(mission.items, start=1):
        other = loader.wp(number)
        assert (other.seq, other.command, other.frame) == (number, ours.command, ours.frame.value)
        assert (other.param1, other.param2, other.param3, other.param4) == pytest.approx(ours.parameters, abs=1e-6)
        assert (other.x, other.y) == pytest.approx((ours.latitude_deg, ours.longitude_deg), abs=1e-7)
        assert other.z == pytest.approx(ours.altitude_m, abs=1e-3)


@pytest.mark.parametrize("autopilot, firmware", [("ardupilot", 3), ("px4", 12)])
@pytest.mark.parametrize("trigger", list(Trigger))
def test_mavsdk_reads_the_same_items(trigger: Trigger, autopilot: str, firmware: int, tmp_path: Path) -> None:
    pytest.importorskip("mavsdk", reason="MAVSDK is not installed")
    mission = mission_of(made_plan(trigger, pattern="facade"), 0, autopilot, "geoid")
    write_waypoints(tmp_path / "a.waypoints", mission)
    with mission_reader(firmware) as reader:
        text = (tmp_path / "a.waypoints").read_text()
        theirs = reader.import_mission_planner_mission_from_string(text).mission_items
    homes = len(theirs) - len(mission.items)  # the file's own, and one that MAVSDK puts before it for ArduPilot
    assert homes == (2 if firmware == 3 else 1)
    assert all(home.command == 16 and home.x == round(mission.home_latitude_deg * 1e7) for home in theirs[:homes])  # type: ignore[operator]
    for ours, other in zip(mission.items, theirs[homes:], strict=True):
        assert (ours.command, ours.frame.value, ours.autocontinue) == (other.command, other.frame, other.autocontinue)
        params = (other.param1, other.param2, other.param3, other.param4)
        assert params == pytest.approx(ours.parameters, rel=1e-6, nan_ok=True)
        scale = 1 if ours.frame is MissionFrame.COMMAND else 1e7
        assert (other.x, other.y) == pytest.approx((ours.latitude_deg * scale, ours.longitude_deg * scale), abs=1.0)
        assert other.z == pytest.approx(ours.altitude_m, abs=1e-3)


def written(text: str, tmp_path: Path) -> Path:
    path = tmp_path / "x.waypoints"
    path.write_text(text)
    return path


HOME = "0\t1\t0\t16\t0\t0\t0\t0\t35.8\t139.65\t5\t1\n"


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "line 1"),
        ("QGC WPL 100\n" + HOME, "version '100'"),
        ("QGC WPL 110\n", "no mission item"),
        ("QGC WPL 110\n" + HOME + "1\t0\t3\t16\t0\t0\t0\t0\t35.8\t139.65\n", "line 3 has 10 columns"),
        ("QGC WPL 110\n" + HOME + HOME, "line 3 is item 0, 1 should follow"),
        ("QGC WPL 110\n" + HOME + "# a\n2\t0\t3\t16\t0\t0\t0\t0\t35.8\t139.65\t5\t1\n", "line 4 is item 2"),
        ("QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t35,8\t139.65\t5\t1\n", "line 2: '35,8': decimal commas"),
        ("QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\tx\t139.65\t5\t1\n", "line 2: 'x' is no number"),
        ("QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t139.65\t35.8\t5\t1\n", "line 2: .* swapped"),
        ("QGC WPL 110\n0\t1\t7\t16\t0\t0\t0\t0\t35.8\t139.65\t5\t1\n", "line 2: frame 7"),
        ("QGC WPL 110\n0\t1\t0\t-4\t0\t0\t0\t0\t35.8\t139.65\t5\t1\n", "line 2: -4 is no command"),
        ("QGC WPL 110\n0\t1\t0\t16\t0\tinf\t0\t0\t35.8\t139.65\t5\t1\n", "line 2: a parameter is infinite"),
        ("QGC WPL 110\n0\t1\t0\t1.5\t0\t0\t0\t0\t35.8\t139.65\t5\t1\n", "line 2: '1.5' is no whole number"),
    ],
)
def test_damage_is_named_with_its_line(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_waypoints(written(text, tmp_path))
    assert "x.waypoints" in str(caught.value)


def test_what_other_ground_stations_write(tmp_path: Path) -> None:
    """Carriage returns, a byte order mark, blanks for tabs, comments; Mission Planner's home without a command."""
    text = (
        "\ufeffQGC WPL 110\r\n0 1 0 0 0 0 0 0 35.8 139.65 5 1\r\n\r\n# turn\r\n1 0 6 16 0 0 0 NaN 35.9 139.65 20 0\r\n"
    )
    path = tmp_path / "x.waypoints"
    path.write_bytes(text.encode())
    mission = read_waypoints(path)
    assert (mission.home_latitude_deg, mission.home_height_geoid_m) == (35.8, 5.0)
    (item,) = mission.items
    assert (item.command, item.frame, item.autocontinue) == (16, MissionFrame.TAKE_OFF, False)
    assert math.isnan(item.parameters[3])


def test_a_file_without_home_keeps_all_its_items(tmp_path: Path) -> None:
    mission = read_waypoints(written("QGC WPL 110\n0\t1\t3\t22\t0\t0\t0\t0\t35.8\t139.65\t5\t1\n", tmp_path))
    assert mission.home_latitude_deg is None
    assert [item.command for item in mission.items] == [22]


@given(content=st.one_of(st.binary(max_size=100), st.text(max_size=100).map(lambda t: ("QGC WPL 110\n" + t).encode())))
@relaxed
def test_anything_else_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "odd.waypoints").write_bytes(content)
    with pytest.raises(InputError):
        read_waypoints(tmp_path / "odd.waypoints")
