"""Flight plans as KML and KMZ."""

import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.plan.made_plans import made_footprints, made_plan
from uavkit.core.errors import InputError
from uavkit.core.flightplan import AreaKind, SurveyArea, Trigger
from uavkit.core.frames import geoid_undulation_m
from uavkit.core.heights import HeightDatum
from uavkit.formats.kml import read_positions
from uavkit.formats.plan_kml import write_plan_kml

K = "{http://www.opengis.net/kml/2.2}"


def root_of(path: Path) -> ElementTree.Element:
    return ElementTree.fromstring(path.read_bytes())


def folder(root: ElementTree.Element, name: str) -> ElementTree.Element:
    return next(element for element in root.iter(f"{K}Folder") if element.findtext(f"{K}name") == name)


def coordinates(element: ElementTree.Element) -> np.ndarray:
    text = "".join(element.itertext()) if element.tag != f"{K}coordinates" else element.text or ""
    return np.array([[float(number) for number in place.split(",")] for place in text.split()])


def test_everything_is_there_in_its_folder(tmp_path: Path) -> None:
    plan = made_plan(Trigger.HOVER, strips=4, sorties=2)
    write_plan_kml(tmp_path / "a.kml", plan, made_footprints(plan))
    root = root_of(tmp_path / "a.kml")
    assert len(list(folder(root, "Strips").iter(f"{K}LineString"))) == 4
    assert len(list(folder(root, "Exposures").iter(f"{K}Point"))) == len(plan.exposures)
    assert len(list(folder(root, "Exposures").iter(f"{K}Folder"))) == 1 + 4
    assert len(list(folder(root, "Footprints").iter(f"{K}Polygon"))) == len(plan.exposures)
    assert len(list(folder(root, "Area").iter(f"{K}innerBoundaryIs"))) == 1
    names = [mark.findtext(f"{K}name") for mark in root.iter(f"{K}Placemark")]
    assert {"Take-off", "Sortie 1", "Sortie 2", "Strip 4"} <= set(names)


def test_heights_count_from_the_geoid(tmp_path: Path) -> None:
    plan = made_plan(bends=True)
    write_plan_kml(tmp_path / "a.kml", plan, ())
    points = [
        mark
        for mark in folder(root_of(tmp_path / "a.kml"), "Exposures").iter(f"{K}Point")
        if mark.findtext(f"{K}altitudeMode") == "absolute"
    ]
    placed = np.vstack([coordinates(next(mark.iter(f"{K}coordinates"))) for mark in points])
    table = plan.exposures
    expected_m = table.height_ellipsoid_m - geoid_undulation_m(table.latitude_deg, table.longitude_deg)
    assert np.allclose(placed[:, 0], table.longitude_deg, atol=1e-8)
    assert np.allclose(placed[:, 1], table.latitude_deg, atol=1e-8)
    assert np.allclose(placed[:, 2], expected_m, atol=1e-3)


def test_the_exposures_can_be_read_as_positions(tmp_path: Path) -> None:
    plan = made_plan()
    write_plan_kml(tmp_path / "a.kmz", plan, made_footprints(plan))
    fixes = [fix for fix in read_positions(tmp_path / "a.kmz") if fix.height_datum is HeightDatum.GEOID]
    assert [fix.name for fix in fixes] == [str(number) for number in range(1, len(plan.exposures) + 1)]


def test_footprints_are_closed_and_without_corners_beside_the_ground(tmp_path: Path) -> None:
    plan = made_plan(strips=1)
    footprints = made_footprints(plan)
    footprints[1, 0] = np.nan
    footprints[2, :2] = np.nan
    write_plan_kml(tmp_path / "a.kml", plan, footprints)
    rings = [coordinates(ring) for ring in folder(root_of(tmp_path / "a.kml"), "Footprints").iter(f"{K}coordinates")]
    assert [len(ring) for ring in rings] == [5, 4, 5, 5]
    assert all(np.array_equal(ring[0], ring[-1]) for ring in rings)
    assert np.allclose(rings[0][:4, 1::-1], footprints[0], atol=1e-8)


@pytest.mark.parametrize("suffix", ["kml", "kmz"])
def test_same_plan_same_bytes(suffix: str, tmp_path: Path) -> None:
    plan = made_plan()
    for name in "ab":
        write_plan_kml(tmp_path / f"{name}.{suffix}", plan, made_footprints(plan))
    assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()


def test_a_kmz_holds_doc_kml(tmp_path: Path) -> None:
    plan = made_plan()
    write_plan_kml(tmp_path / "a.kml", plan, ())
    write_plan_kml(tmp_path / "a.kmz", plan, ())
    with zipfile.ZipFile(tmp_path / "a.kmz") as archive:
        assert archive.namelist() == ["doc.kml"]
        assert archive.read("doc.kml") == (tmp_path / "a.kml").read_bytes()


def test_lines_and_points_are_areas_too_and_names_are_escaped(tmp_path: Path) -> None:
    vertices = np.array([[35.8, 139.65], [35.801, 139.651]])
    line = SurveyArea(name="dam & <road>", kind=AreaKind.LINE, latitude_longitude_deg=vertices)
    point = SurveyArea(name="tower", kind=AreaKind.POINT, latitude_longitude_deg=vertices[:1])
    plan = replace(made_plan(), name='"a" & b', areas=(line, point))
    write_plan_kml(tmp_path / "a.kml", plan, ())
    area = folder(root_of(tmp_path / "a.kml"), "Area")
    assert [mark.findtext(f"{K}name") for mark in area.iter(f"{K}Placemark")] == ["dam & <road>", "tower"]
    assert len(list(area.iter(f"{K}LineString"))) == len(list(area.iter(f"{K}Point"))) == 1


def test_many_footprints_are_switched_off(tmp_path: Path) -> None:
    plan = made_plan(strips=2, exposures=160)
    write_plan_kml(tmp_path / "a.kml", plan, made_footprints(plan))
    assert folder(root_of(tmp_path / "a.kml"), "Footprints").findtext(f"{K}visibility") == "0"


def test_a_wrong_number_of_footprints_is_refused(tmp_path: Path) -> None:
    plan = made_plan()
    with pytest.raises(InputError, match="14 footprints for 15"):
        write_plan_kml(tmp_path / "a.kml", plan, made_footprints(plan)[1:])
    assert not list(tmp_path.iterdir())
