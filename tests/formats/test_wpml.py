"""Sorties as DJI's waypoint files: read back, and held against what the format's documentation asks for."""

import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.plan.made_plans import made_plan
from uavkit.core.errors import InputError
from uavkit.core.flightplan import FlightPlan, Trigger, WaypointRole
from uavkit.formats.wpml import KML, WPML, write_wpml

K, W = f"{{{KML}}}", f"{{{WPML}}}"
REQUIRED = {
    "missionConfig": {
        "flyToWaylineMode", "finishAction", "exitOnRCLost", "executeRCLostAction", "takeOffSecurityHeight",
        "globalTransitionalSpeed", "globalRTHHeight",
    },
    "droneInfo": {"droneEnumValue"},
    "payloadInfo": {"payloadEnumValue", "payloadPositionIndex"},
    "payloadParam": {"payloadPositionIndex", "imageFormat"},
    "waylineCoordinateSysParam": {"coordinateMode", "heightMode"},
    "waypointHeadingParam": {"waypointHeadingMode", "waypointHeadingPathMode"},
    "waypointTurnParam": {"waypointTurnMode", "waypointTurnDampingDist"},
    "actionGroup": {
        "actionGroupId", "actionGroupStartIndex", "actionGroupEndIndex", "actionGroupMode", "actionTrigger", "action",
    },
    "actionTrigger": {"actionTriggerType"},
    "action": {"actionId", "actionActuatorFunc", "actionActuatorFuncParam"},
}  # fmt: skip
WAYLINES = {
    "Folder": {"templateId", "executeHeightMode", "waylineId", "autoFlightSpeed", "Placemark"},
    "Placemark": {
        "Point", "index", "executeHeight", "waypointSpeed", "waypointHeadingParam", "waypointTurnParam",
        "useStraightLine",
    },
}  # fmt: skip
TEMPLATE = {
    "Folder": {
        "templateType", "templateId", "autoFlightSpeed", "waylineCoordinateSysParam", "payloadParam", "gimbalPitchMode",
        "globalHeight", "globalWaypointTurnMode", "globalWaypointHeadingParam", "Placemark",
    },
    "Placemark": {
        "Point", "index", "height", "useGlobalHeight", "useGlobalSpeed", "waypointSpeed", "gimbalPitchAngle",
        "waypointHeadingParam", "waypointTurnParam",
    },
}  # fmt: skip
ACTIONS = {
    "takePhoto": {"payloadPositionIndex", "fileSuffix", "useGlobalPayloadLensIndex"},
    "hover": {"hoverTime"},
    "rotateYaw": {"aircraftHeading", "aircraftPathMode"},
    "gimbalRotate": {
        "payloadPositionIndex", "gimbalHeadingYawBase", "gimbalRotateMode", "gimbalPitchRotateEnable",
        "gimbalPitchRotateAngle", "gimbalRollRotateEnable", "gimbalRollRotateAngle", "gimbalYawRotateEnable",
        "gimbalYawRotateAngle", "gimbalRotateTimeEnable", "gimbalRotateTime",
    },
}  # fmt: skip
VALUES = {
    "waypointTurnMode": {"toPointAndStopWithDiscontinuityCurvature", "toPointAndPassWithContinuityCurvature"},
    "waypointHeadingMode": {"followWayline", "smoothTransition"},
    "waypointHeadingPathMode": {"clockwise", "counterClockwise", "followBadArc"},
    "actionTriggerType": {"reachPoint", "multipleTiming", "multipleDistance"},
    "actionGroupMode": {"sequence"},
    "executeHeightMode": {"relativeToStartPoint"},
    "finishAction": {"goHome"},
}


def roots(plan: FlightPlan, tmp_path: Path, sortie: int = 0) -> tuple[ElementTree.Element, ElementTree.Element]:
    """Return the roots of template and waylines."""
    write_wpml(tmp_path / "a.kmz", plan, sortie)
    with zipfile.ZipFile(tmp_path / "a.kmz") as archive:
        assert archive.namelist() == ["wpmz/template.kml", "wpmz/waylines.wpml"]
        template, waylines = (ElementTree.fromstring(archive.read(name)) for name in archive.namelist())
    return template, waylines


def tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def value(element: ElementTree.Element, name: str) -> str:
    text = element.findtext(f".//{W}{name}")
    assert text is not None, name
    return text


def marks(root: ElementTree.Element) -> list[ElementTree.Element]:
    return list(root.iter(f"{K}Placemark"))


def groups(root: ElementTree.Element, trigger: str) -> list[ElementTree.Element]:
    return [group for group in root.iter(f"{W}actionGroup") if value(group, "actionTriggerType") == trigger]


@pytest.mark.parametrize("trigger", list(Trigger))
@pytest.mark.parametrize("pattern", ["strips", "facade"])
def test_required_elements_and_known_values(pattern: str, trigger: Trigger, tmp_path: Path) -> None:
    plan = replace(made_plan(trigger, pattern=pattern, bends=True), vehicle="DJI Mavic 3E", camera="DJI Mavic 3E")
    for root, own in zip(roots(plan, tmp_path), (TEMPLATE, WAYLINES), strict=True):
        assert root.tag == f"{K}kml"
        for element in root.iter():
            children = {tag(child) for child in element}
            assert {**REQUIRED, **own}.get(tag(element), set()) <= children, (tag(element), children)
            if tag(element) in VALUES:
                assert element.text in VALUES[tag(element)]
            if tag(element) == "action":
                (parameters,) = element.findall(f"{W}actionActuatorFuncParam")
                assert ACTIONS[value(element, "actionActuatorFunc")] <= {tag(child) for child in parameters}
        assert value(root, "droneEnumValue") == "77"
        assert value(root, "payloadEnumValue") == "66"


@pytest.mark.parametrize("trigger", list(Trigger))
def test_numbers_go_on_without_gaps(trigger: Trigger, tmp_path: Path) -> None:
    for root in roots(made_plan(trigger, pattern="facade"), tmp_path):
        assert [int(value(mark, "index")) for mark in marks(root)] == list(range(len(marks(root))))
        found = list(root.iter(f"{W}actionGroup"))
        assert [int(value(group, "actionGroupId")) for group in found] == list(range(len(found)))
        for number, mark in enumerate(marks(root)):
            for group in mark.iter(f"{W}actionGroup"):
                first, last = (int(value(group, f"actionGroup{end}Index")) for end in ("Start", "End"))
                assert first == number
                assert first <= last < len(marks(root))
                ids = [int(value(action, "actionId")) for action in group.iter(f"{W}action")]
                assert ids == list(range(len(ids)))


def test_places_heights_and_speeds(tmp_path: Path) -> None:
    plan = made_plan(bends=True)
    _, waylines = roots(plan, tmp_path)
    waypoints = plan.sorties[0].waypoints[1:]
    found = marks(waylines)
    assert len(found) == len(waypoints)
    places = np.array([[float(x) for x in (mark.findtext(f".//{K}coordinates") or "").split(",")] for mark in found])
    assert np.allclose(places[:, 0], [w.longitude_deg for w in waypoints], atol=1e-8)
    assert np.allclose(places[:, 1], [w.latitude_deg for w in waypoints], atol=1e-8)
    heights = [float(value(mark, "executeHeight")) for mark in found]
    assert heights == pytest.approx([w.height_above_takeoff_m for w in waypoints], abs=1e-3)
    # DJI's speed holds from the waypoint to the next, ours on the leg that ends there
    speeds = [float(value(mark, "waypointSpeed")) for mark in found]
    assert speeds[:-1] == pytest.approx([w.speed_m_s for w in waypoints[1:]])


@pytest.mark.parametrize(
    "trigger, kind, parameter", [(Trigger.DISTANCE, "multipleDistance", 12.0), (Trigger.TIME, "multipleTiming", 3.0)]
)
def test_triggers_span_the_strips(trigger: Trigger, kind: str, parameter: float, tmp_path: Path) -> None:
    plan = made_plan(trigger, base_m=12.0, speed_m_s=4.0, bends=True)
    waypoints = plan.sorties[0].waypoints[1:]
    for root in roots(plan, tmp_path):
        found = groups(root, kind)
        assert len(found) == len(plan.strips)
        for group in found:
            first, last = (waypoints[int(value(group, f"actionGroup{end}Index"))] for end in ("Start", "End"))
            assert (first.role, last.role) == (WaypointRole.EXPOSURE, WaypointRole.EXIT)
            assert first.strip == last.strip
            assert float(value(group, "actionTriggerParam")) == parameter
            assert value(group, "actionActuatorFunc") == "takePhoto"


def test_hover_turns_waits_and_takes_one(tmp_path: Path) -> None:
    plan = made_plan(Trigger.HOVER, pattern="facade", direction_deg=150.0)
    _, waylines = roots(plan, tmp_path)
    shots = [
        group
        for group in groups(waylines, "reachPoint")
        if "takePhoto" in [action.findtext(f"{W}actionActuatorFunc") for action in group.iter(f"{W}action")]
    ]
    assert len(shots) == len(plan.exposures)
    for group in shots:
        order = [value(action, "actionActuatorFunc") for action in group.iter(f"{W}action")]
        assert order[-3:] == ["rotateYaw", "hover", "takePhoto"]
        assert float(value(group, "aircraftHeading")) == pytest.approx(-120.0)  # 240 degrees
        assert float(value(group, "hoverTime")) == 2.0
    for mark in marks(waylines):
        if list(mark.iter(f"{W}hoverTime")):
            assert value(mark, "waypointTurnMode") == "toPointAndStopWithDiscontinuityCurvature"


@pytest.mark.parametrize("pattern, pitch", [("strips", -90.0), ("facade", 0.0)])
def test_the_gimbal_is_set_once(pattern: str, pitch: float, tmp_path: Path) -> None:
    _, waylines = roots(made_plan(pattern=pattern), tmp_path)
    pitches = [float(element.text or "nan") for element in waylines.iter(f"{W}gimbalPitchRotateAngle")]
    assert pitches == [pitch]
    modes = {element.text for element in waylines.iter(f"{W}waypointHeadingMode")}
    assert modes == ({"followWayline"} if pattern == "strips" else {"smoothTransition"})


def test_turns_fit_their_legs(tmp_path: Path) -> None:
    """DJI wants legs longer than the damping distances of both of their ends together."""
    plan = made_plan(spacing_m=2.0, base_m=1.5, exposures=6, bends=True)
    _, waylines = roots(plan, tmp_path)
    waypoints = plan.sorties[0].waypoints[1:]
    damping = [float(value(mark, "waypointTurnDampingDist")) for mark in marks(waylines)]
    for number in range(1, len(waypoints)):
        a, b = waypoints[number - 1], waypoints[number]
        length_m = np.hypot(
            (a.latitude_deg - b.latitude_deg) * 111_000.0, (a.longitude_deg - b.longitude_deg) * 90_000.0
        )
        assert damping[number - 1] + damping[number] < np.hypot(length_m, a.height_ellipsoid_m - b.height_ellipsoid_m)
    assert damping[0] == damping[-1] == 0.0


def test_same_plan_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        write_wpml(tmp_path / f"{name}.kmz", made_plan(Trigger.HOVER), 0)
    assert (tmp_path / "a.kmz").read_bytes() == (tmp_path / "b.kmz").read_bytes()


def test_what_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"16 m/s.*up to 15 m/s"):
        write_wpml(tmp_path / "a.kmz", made_plan(speed_m_s=16.0), 0)
    with pytest.raises(InputError, match="no sortie 2"):
        write_wpml(tmp_path / "a.kmz", made_plan(), 1)
    assert not list(tmp_path.iterdir())
