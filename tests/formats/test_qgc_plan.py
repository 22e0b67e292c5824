"""QGroundControl's plans, written and read, foreign and damaged ones."""

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.formats.made_missions import missions, same_items
from tests.formats.mavsdk_peer import mission_reader
from tests.plan.made_plans import made_plan
from uavkit.core.errors import InputError
from uavkit.core.flightplan import Trigger
from uavkit.core.mission import Mission, MissionFrame, MissionItem
from uavkit.formats.qgc_plan import read_plan, write_plan
from uavkit.plan.mission import exposures_of, mission_of

FOREIGN = Path(__file__).resolve().parents[2] / "../shared/data/plans/mavsdk"

relaxed = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@given(mission=missions)
@relaxed
def test_round_trip(mission: Mission, tmp_path: Path) -> None:
    write_plan(tmp_path / "a.plan", mission)
    back = read_plan(tmp_path / "a.plan")
    assert same_items(mission, back)
    assert back.home_latitude_deg == pytest.approx(mission.home_latitude_deg, abs=1e-7)
    assert back.home_longitude_deg == pytest.approx(mission.home_longitude_deg, abs=1e-7)
    assert back.home_height_geoid_m == pytest.approx(mission.home_height_geoid_m, abs=1e-3)
    assert (back.cruise_speed_m_s, back.hover_speed_m_s) == (mission.cruise_speed_m_s, mission.hover_speed_m_s)
    assert (back.firmware, back.vehicle_type) == (mission.firmware, mission.vehicle_type)


def test_a_home_that_is_not_known_stays_so(tmp_path: Path) -> None:
    mission = Mission(items=(MissionItem(command=20, frame=MissionFrame.COMMAND),))
    write_plan(tmp_path / "a.plan", mission)
    assert read_plan(tmp_path / "a.plan") == replace(mission, source=str(tmp_path / "a.plan"))


def test_same_mission_same_bytes(tmp_path: Path) -> None:
    mission = mission_of(made_plan(), 0, "px4", "geoid")
    for name in ("a.plan", "b.plan"):
        write_plan(tmp_path / name, mission)
    assert (tmp_path / "a.plan").read_bytes() == (tmp_path / "b.plan").read_bytes()


def test_the_file_is_what_the_format_asks_for(tmp_path: Path) -> None:
    write_plan(tmp_path / "a.plan", mission_of(made_plan(Trigger.HOVER), 0, "px4", "take_off"))
    content = json.loads((tmp_path / "a.plan").read_text())
    assert (content["fileType"], content["version"], content["groundStation"]) == ("Plan", 1, "QGroundControl")
    assert content["geoFence"] == {"circles": [], "polygons": [], "version": 2}
    assert content["rallyPoints"] == {"points": [], "version": 2}
    mission = content["mission"]
    assert (mission["version"], mission["firmwareType"], mission["vehicleType"]) == (2, 12, 2)
    assert mission["globalPlanAltitudeMode"] == 1
    assert len(mission["plannedHomePosition"]) == 3
    assert {item["type"] for item in mission["items"]} == {"SimpleItem"}
    assert [item["doJumpId"] for item in mission["items"]] == list(range(1, len(mission["items"]) + 1))
    assert all(len(item["params"]) == 7 for item in mission["items"])
    assert mission["items"][2]["params"][3] is None


@pytest.mark.parametrize("autopilot, firmware", [("ardupilot", 3), ("px4", 12)])
@pytest.mark.parametrize("trigger", list(Trigger))
def test_mavsdk_reads_the_same_items(trigger: Trigger, autopilot: str, firmware: int, tmp_path: Path) -> None:
    pytest.importorskip("mavsdk", reason="MAVSDK is not installed")
    mission = mission_of(made_plan(trigger, pattern="facade"), 0, autopilot, "geoid")
    write_plan(tmp_path / "a.plan", mission)
    with mission_reader(firmware) as reader:
        theirs = reader.import_qgroundcontrol_mission_from_string((tmp_path / "a.plan").read_text()).mission_items
    if firmware == 3:
        home, *theirs = theirs
        assert (home.command, home.x, home.y) == (16, round(mission.home_latitude_deg * 1e7), round(mission.home_longitude_deg * 1e7))  # type: ignore[operator]  # fmt: skip # noqa: E501
        assert home.z == pytest.approx(mission.home_height_geoid_m, abs=1e-3)
    assert len(theirs) == len(mission.items)
    for ours, other in zip(mission.items, theirs, strict=True):
        assert (ours.command, ours.frame.value, ours.autocontinue) == (other.command, other.frame, other.autocontinue)
        params = (other.param1, other.param2, other.param3, other.param4)
        assert params == pytest.approx(ours.parameters, rel=1e-6, nan_ok=True)
        scale = 1 if ours.frame is MissionFrame.COMMAND else 1e7
        assert (other.x, other.y) == (round(ours.latitude_deg * scale), round(ours.longitude_deg * scale))
        assert other.z == pytest.approx(ours.altitude_m, abs=1e-3)


@pytest.mark.parametrize(
    "name, count, first",
    [
        ("cpp_src_mavsdk_plugins_mission_raw_test_plans_qgroundcontrol_sample", 6, 22),
        ("cpp_src_mavsdk_plugins_mission_raw_test_plans_qgroundcontrol_sample_with_digicam_control", 1, 203),
        ("cpp_src_mavsdk_plugins_mission_raw_test_plans_qgroundcontrol_sample_with_survey", 13, 530),
        ("example_fly_qgc_mission_qgroundcontrol_sample", 9, 178),
        ("src_mavsdk_lib_plugins_mission_qgroundcontrol_sample", 16, 22),
    ],
)
def test_foreign_plans_are_read(name: str, count: int, first: int) -> None:
    path = FOREIGN / f"{name}.plan"
    if not path.is_file():
        pytest.skip("the plans of ../shared/data/plans are not here")
    mission = read_plan(path)
    assert len(mission.items) == count
    assert mission.items[0].command == first
    assert mission.source == str(path)


def test_a_survey_of_qgroundcontrol_takes_the_exposures_that_it_promises() -> None:
    path = FOREIGN / "cpp_src_mavsdk_plugins_mission_raw_test_plans_qgroundcontrol_sample_with_survey.plan"
    if not path.is_file():
        pytest.skip("the plans of ../shared/data/plans are not here")
    survey = json.loads(path.read_text())["mission"]["items"][1]["TransectStyleComplexItem"]
    assert len(exposures_of(read_plan(path))) == survey["CameraShots"]


@pytest.mark.parametrize(
    "name, words",
    [
        ("with_structured_scan", "item 2 is a 'StructureScan'"),
        ("with_survey_wrong_version", "item 2 is a 'survey' of QGroundControl, version 9"),
        ("without_mission", "holds no mission"),
        ("wrong_mission_version", "mission has version 7"),
        ("wrong_overall_version", "plan has version 42"),
    ],
)
def test_foreign_plans_are_refused_for_the_right_reason(name: str, words: str) -> None:
    path = FOREIGN / f"cpp_src_mavsdk_plugins_mission_raw_test_plans_qgroundcontrol_sample_{name}.plan"
    if not path.is_file():
        pytest.skip("the plans of ../shared/data/plans are not here")
    with pytest.raises(InputError, match=words) as caught:
        read_plan(path)
    assert str(path) in str(caught.value)


def edited(change: Callable[[dict[str, Any]], None], tmp_path: Path) -> Path:
    path = tmp_path / "edited.plan"
    write_plan(path, mission_of(made_plan(strips=1), 0, "px4", "take_off"))
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda c: c.update(fileType="GeoFence"), "GeoFence"),
        (lambda c: c.pop("version"), "version None"),
        (lambda c: c["mission"].pop("version"), "version None"),
        (lambda c: c["mission"].update(items=3), "list of items"),
        (lambda c: c["mission"]["items"].insert(1, 7), "item 2 is no mission item"),
        (lambda c: c["mission"]["items"][1].update(type="Odd"), "item 2 has the type 'Odd'"),
        (lambda c: c["mission"]["items"][2].update(params=[1, 2]), "item 3 needs a list of 7"),
        (lambda c: c["mission"]["items"][2]["params"].__setitem__(4, "x"), "item 3: the parameter 'x'"),
        (lambda c: c["mission"]["items"][2]["params"].__setitem__(4, 139.65), "item 3: latitude 139.65"),
        (lambda c: c["mission"]["items"][2].update(frame=1), "item 3: frame 1"),
        (lambda c: c["mission"]["items"][2].update(command=True), "item 3: command"),
        (lambda c: c["mission"].update(plannedHomePosition=[1]), "plannedHomePosition"),
        (lambda c: c["mission"].update(plannedHomePosition=[139.65, 35.8, 0]), "no place on earth"),
    ],
)
def test_damage_is_named(change: Callable[[dict[str, Any]], None], words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        read_plan(edited(change, tmp_path))


@given(content=st.binary(max_size=200))
@relaxed
def test_anything_else_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "odd.plan").write_bytes(content)
    with pytest.raises(InputError):
        read_plan(tmp_path / "odd.plan")


json_values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=8), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=10,
)


@given(key=st.sampled_from(["mission", "items", "item", "params", "frame", "command", "home"]), value=json_values)
@relaxed
def test_odd_values_are_read_or_refused(key: str, value: Any, tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        mission = content["mission"]
        places = {
            "mission": (content, "mission"), "items": (mission, "items"), "item": (mission["items"], 1),
            "home": (mission, "plannedHomePosition"),
        }  # fmt: skip
        holder, name = places.get(key, (mission["items"][1], key))
        holder[name] = value

    with suppress(InputError):
        read_plan(edited(change, tmp_path))
