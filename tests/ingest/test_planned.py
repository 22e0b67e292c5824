"""A plan against what was taken: stations without a still are named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uavkit.core.errors import InputError
from uavkit.core.frames import LocalFrame
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix
from uavkit.ingest.planned import planned_notes
from uavkit.ingest.positions import JoinedPositions
from uavkit.plan.expected import expected_positions

ROOT = Path(__file__).resolve().parents[2]


def fixes(enu_m: np.ndarray, word: str = "station") -> list[GnssFix]:
    place = LocalFrame.at(35.8, 139.65, 0.0).geographic_from_enu(np.column_stack([enu_m, np.zeros(len(enu_m))]))
    return [
        GnssFix(
            gps_time_ns=None, latitude_deg=a, longitude_deg=b, height_m=float("nan"),
            height_datum=HeightDatum.GROUND, name=f"{word} {n}",
        )
        for n, (a, b, _) in enumerate(place)
    ]  # fmt: skip


def strips(count: int = 24) -> np.ndarray:
    """Strips of eight stations, 10 m apart, flown to and fro at 25 m."""
    n = np.arange(count)
    along = np.where(n // 8 % 2 == 0, n % 8, 7 - n % 8) * 10.0
    return np.column_stack([along, n // 8 * 25.0])


def joined(given: list[GnssFix | None]) -> JoinedPositions:
    return JoinedPositions(fixes=tuple(given), probability=np.ones(len(given)), from_exif=False, discarded=(), notes=())


def test_stations_without_a_still_are_named() -> None:
    planned, rng = strips(), np.random.default_rng(3)
    taken = np.delete(planned + rng.normal(0.0, 1.0, planned.shape), [5, 17], axis=0)
    (note,) = planned_notes(fixes(planned), joined([*fixes(taken, "still"), None]))
    assert "24 exposures, there are 23 stills" in note
    assert "(1 stills have no position) lies near 2 planned stations: station 5, station 17" in note
    (whole,) = planned_notes(fixes(planned), joined(list(fixes(planned + 0.5))))
    assert "lies near each planned station" in whole


@pytest.mark.parametrize(("latitude_deg", "longitude_deg", "away_km"), [(-20.0, 10.0, 11_700), (-35.8, -40.35, 12_700)])
def test_a_plan_of_another_place_is_told_so(latitude_deg: float, longitude_deg: float, away_km: float) -> None:
    """The second place is on the other side of the earth, whose plane projection falls on the stills."""
    there = GnssFix(
        gps_time_ns=None, latitude_deg=latitude_deg, longitude_deg=longitude_deg, height_m=float("nan"),
        height_datum=HeightDatum.GROUND,
    )  # fmt: skip
    beside = replace(there, latitude_deg=latitude_deg + 1e-4)
    (note,) = planned_notes([there, beside], joined(list(fixes(strips()))))
    assert "is it this flight's?" in note
    told_km = float(note.split(" km from all")[0].split()[-1])
    assert told_km == pytest.approx(away_km, rel=0.02)  # along a straight line through the earth


def test_a_mission_without_pictures_is_no_plan_to_compare_with(tmp_path: Path) -> None:
    path = tmp_path / "way.waypoints"
    rows = [f"{n}\t0\t3\t16\t0\t0\t0\t0\t{35.8 + n * 1e-4}\t139.65\t15\t1" for n in range(4)]
    path.write_text("\n".join(["QGC WPL 110", *rows, ""]))
    with pytest.raises(InputError, match="takes no picture"):
        expected_positions(path)


def test_without_positions_only_the_numbers_are_told() -> None:
    assert planned_notes(fixes(strips()), joined([None] * 20)) == ("the plan has 24 exposures, there are 20 stills",)


def test_plans_of_all_kinds_tell_their_exposures(tmp_path: Path) -> None:
    mission = expected_positions(ROOT / "sim_logs" / "sitl_waypoint_trigger" / "mission.waypoints")
    assert len(mission) == 33
    assert mission[0].latitude_deg == pytest.approx(35.8, abs=0.01)
    ours = sorted((ROOT / "flightplans").glob("*.plan"))
    assert all(len(expected_positions(path)) > 3 for path in ours[:2])
    other = tmp_path / "plan.doc"
    other.write_text("plan")
    with pytest.raises(InputError, match="a plan is"):
        expected_positions(other)
