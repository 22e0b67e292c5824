"""Flight plans as tables: CSV, GeoJSON, Litchi."""

import csv
import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.plan.made_plans import made_footprints, made_plan
from uavkit.core.angles import rotation_from_vector
from uavkit.core.errors import InputError
from uavkit.core.flightplan import PlannedExposures, Trigger
from uavkit.formats.plan_tables import read_exposures_csv, write_exposures_csv, write_litchi_csv, write_plan_geojson

TOLERANCES = {
    "latitude_deg": 1e-7,
    "longitude_deg": 1e-7,
    "height_ellipsoid_m": 1e-3,
    "height_above_ground_m": 1e-3,
    "R_map_from_image": 1e-9,
    "heading_deg": 1e-6,
    "time_s": 1e-3,
    "forward_overlap": 1e-6,
    "side_overlap": 1e-6,
    "gsd_m": 1e-7,
}
relaxed = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def agree(ours: PlannedExposures, theirs: PlannedExposures) -> bool:
    pairs = [(getattr(ours, f.name), getattr(theirs, f.name), TOLERANCES.get(f.name, 0.0)) for f in fields(ours)]
    return all(
        a.dtype == b.dtype and np.allclose(a, b, atol=tolerance, rtol=0, equal_nan=True) for a, b, tolerance in pairs
    )


@given(seed=st.integers(0, 2**32 - 1))
@relaxed
def test_round_trip_of_the_exposures(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    plan = made_plan(strips=2, sorties=2, direction_deg=float(rng.uniform(0, 360)))
    n = len(plan.exposures)
    table = replace(
        plan.exposures,
        R_map_from_image=rotation_from_vector(rng.normal(size=(n, 3)) * 2.0),
        sees_area=rng.random(n) < 0.5,
        side_overlap=np.where(rng.random(n) < 0.3, np.nan, rng.random(n)),
        height_ellipsoid_m=rng.uniform(-400, 9000, n),
        latitude_deg=rng.uniform(-90, 90, n),
        longitude_deg=rng.uniform(-180, 180, n),
    )
    write_exposures_csv(tmp_path / "a.csv", replace(plan, exposures=table, name="two\nlines"))
    assert agree(table, read_exposures_csv(tmp_path / "a.csv"))


def test_a_spreadsheet_may_save_the_file_again(tmp_path: Path) -> None:
    """Byte order mark, carriage returns, comments padded with commas."""
    plan = made_plan()
    path = tmp_path / "a.csv"
    write_exposures_csv(path, plan)
    lines = [line + ",,," if line.startswith("#") else line for line in path.read_text().splitlines()]
    path.write_bytes(("\ufeff" + "\r\n".join(lines)).encode())
    assert agree(plan.exposures, read_exposures_csv(path))


def swap(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda text: "", "no exposure"),
        (swap("heading_deg", "heading"), "line 5: unknown column 'heading'; did you mean"),
        (swap(",sees_area", ""), "line 5: .*missing: sees_area"),
        (swap("vertical: ellipsoid", "vertical: geoid"), "line 4: .*not 'geoid'"),
        (swap("\n2,1,1,1,", "\n3,1,1,1,"), "line 7 should be exposure 2"),
        (swap("\n2,1,1,1,", "\n2,x,1,1,"), "line 7: strip is 'x'"),
        (swap("\n2,1,1,1,3.000,", "\n2,1,1,1,,"), "line 7: time_s is ''"),
        (swap("35.8000000000", "95.8000000000"), "line 6: latitude_deg 95.8 is no place"),
        (swap("35.8000000000,", ""), "line 6 has 18 cells, the header 19"),
    ],
)
def test_damage_is_named_with_its_line(change: Callable[[str], str], words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_exposures_csv(path, made_plan())
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=words):
        read_exposures_csv(path)


@given(content=st.one_of(st.binary(max_size=80), st.text(max_size=80).map(str.encode)))
@relaxed
def test_anything_else_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "odd.csv").write_bytes(content)
    with pytest.raises(InputError):
        read_exposures_csv(tmp_path / "odd.csv")


def features_of(path: Path, kind: str) -> list[dict[str, Any]]:
    collection = json.loads(path.read_text(encoding="utf-8"))
    assert collection["type"] == "FeatureCollection"
    return [feature for feature in collection["features"] if feature["properties"]["kind"] == kind]


def turned_left(ring: list[list[float]]) -> bool:
    x, y = np.array(ring)[:, :2].T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) > 0


def test_geojson_holds_the_whole_plan(tmp_path: Path) -> None:
    plan = made_plan(strips=4, sorties=2)
    write_plan_geojson(tmp_path / "a.geojson", plan, made_footprints(plan))
    path = tmp_path / "a.geojson"
    counts = {k: len(features_of(path, k)) for k in ("area", "take-off", "path", "strip", "exposure", "footprint")}
    assert counts == {"area": 1, "take-off": 1, "path": 2, "strip": 4, "exposure": 20, "footprint": 20}
    table = plan.exposures
    places = np.array([feature["geometry"]["coordinates"] for feature in features_of(path, "exposure")])
    expected = np.column_stack([table.longitude_deg, table.latitude_deg, table.height_ellipsoid_m])
    assert np.allclose(places, expected, atol=[1e-8, 1e-8, 1e-3])


def test_geojson_turns_rings_as_the_standard_asks(tmp_path: Path) -> None:
    plan = made_plan()
    write_plan_geojson(tmp_path / "a.geojson", plan, made_footprints(plan)[:, ::-1])
    (area,) = features_of(tmp_path / "a.geojson", "area")
    outline, hole = area["geometry"]["coordinates"]
    assert outline[0] == outline[-1]
    assert hole[0] == hole[-1]
    assert turned_left(outline)
    assert not turned_left(hole)
    for feature in features_of(tmp_path / "a.geojson", "footprint"):
        assert turned_left(feature["geometry"]["coordinates"][0])


def test_a_wrong_number_of_footprints_is_refused(tmp_path: Path) -> None:
    plan = made_plan()
    with pytest.raises(InputError, match="1 footprints for 15"):
        write_plan_geojson(tmp_path / "a.geojson", plan, made_footprints(plan)[:1])


def litchi(plan: Any, tmp_path: Path) -> list[dict[str, str]]:
    write_litchi_csv(tmp_path / "litchi.csv", plan, 0)
    with (tmp_path / "litchi.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_litchi_hovers_and_takes_one_at_each_station(tmp_path: Path) -> None:
    plan = made_plan(Trigger.HOVER, height_m=30.0)
    rows = litchi(plan, tmp_path)
    waypoints = plan.sorties[0].waypoints[1:]
    assert len(rows) == len(waypoints)
    assert len(rows[0]) == 8 + 30 + 8
    for row, waypoint in zip(rows, waypoints, strict=True):
        assert float(row["latitude"]) == pytest.approx(waypoint.latitude_deg, abs=1e-8)
        assert float(row["altitude(m)"]) == waypoint.height_above_takeoff_m
        assert (row["altitudemode"], row["gimbalmode"], row["gimbalpitchangle"]) == ("0", "2", "-90.0")
        actions = [row[name] for name in ("actiontype1", "actionparam1", "actiontype2", "actionparam2", "actiontype3")]
        assert actions == (["0", "2000", "1", "0", "-1"] if waypoint.exposure >= 0 else ["-1", "0", "-1", "0", "-1"])


@pytest.mark.parametrize(
    "trigger, column, value",
    [(Trigger.DISTANCE, "photo_distinterval", 12.0), (Trigger.TIME, "photo_timeinterval", 3.0)],
)
def test_litchi_triggers_from_the_first_exposure_to_the_exit(
    trigger: Trigger, column: str, value: float, tmp_path: Path
) -> None:
    plan = made_plan(trigger, strips=1, bends=True, base_m=12.0, speed_m_s=4.0)
    rows = litchi(plan, tmp_path)
    roles = [waypoint.role.name for waypoint in plan.sorties[0].waypoints[1:]]
    assert roles == ["TRANSIT", "ENTRY", "EXPOSURE", "PATH", "EXPOSURE", "EXIT", "RETURN"]
    assert [float(row[column]) for row in rows] == [-1, -1, value, value, value, -1, -1]
    assert [float(row["speed(m/s)"]) for row in rows] == [6, 4, 4, 4, 4, 6, 6]  # of the leg that begins there


def test_litchi_looks_level_at_a_facade_and_refuses_too_many_waypoints(tmp_path: Path) -> None:
    assert {row["gimbalpitchangle"] for row in litchi(made_plan(pattern="facade"), tmp_path)} == {"0.0"}
    with pytest.raises(InputError, match="Litchi takes 99"):
        write_litchi_csv(tmp_path / "x.csv", made_plan(Trigger.HOVER, strips=10, exposures=12), 0)
    with pytest.raises(InputError, match="no sortie 3"):
        write_litchi_csv(tmp_path / "x.csv", made_plan(), 2)
