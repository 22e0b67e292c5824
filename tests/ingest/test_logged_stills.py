"""Stills of recorded flights: matched with the exposures of their logs, and placed there."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uavkit.core.block import StillInVideo, VideoSync
from uavkit.core.errors import InputError
from uavkit.core.exposures import StillState
from uavkit.core.flight_log import FlightLog, fix_table, no_attitudes, no_exposures, no_fixes
from uavkit.core.frames import LocalFrame, geoid_undulation_m
from uavkit.core.heights import HeightDatum
from uavkit.core.progress import silent
from uavkit.core.records import FieldOrder, StillInfo
from uavkit.core.video import AffineTransformation
from uavkit.formats.flight_logs import open_log
from uavkit.formats.match_file import MatchRow, read_matches, write_matches
from uavkit.ingest.log_positions import LogOptions
from uavkit.ingest.logged_stills import GivenMatches, LoggedStills, rows_of_matches, stills_in_logs

RECORDED = Path(__file__).resolve().parents[2] / "sim_logs"
LOCAL_TIME_S = 9 * 3600 + 83.4
SPEED_M_S = 4.0
"""Of the recorded flights."""


@pytest.fixture(scope="module")
def logs() -> dict[str, FlightLog]:
    return {
        "distance": open_log(RECORDED / "sitl_distance_trigger/flight.BIN"),
        "telemetry": open_log(RECORDED / "sitl_distance_trigger/flight.tlog"),
        "waypoints": open_log(RECORDED / "sitl_waypoint_trigger/flight.BIN"),
        "px4": open_log(RECORDED / "px4_distance_trigger/flight.ulg"),
    }


def camera(log: FlightLog, first: int = 1, lag_s: float = 0.03, unit_ns: int = 10_000_000) -> list[StillInfo]:
    """Stills of all exposures of a log by a camera on local time whose shutter lags, stamps cut down to ``unit_ns``."""
    rng = np.random.default_rng(first)
    stills = []
    for number, gps_ns in enumerate(log.exposure_table.when.gps_ns.tolist(), start=first):
        true_ns = gps_ns + round((lag_s + LOCAL_TIME_S + float(rng.normal(0.0, 0.01))) * 1e9)
        drifted_ns = true_ns + round((gps_ns % 10**12) * 30e-6)
        stills.append(
            StillInfo(
                name=f"DSC{number:05d}.JPG",
                width_px=4000,
                height_px=3000,
                camera_time_ns=drifted_ns // unit_ns * unit_ns,
                camera_time_resolution_ns=unit_ns,
            )
        )
    return stills


def found(
    stills: Sequence[StillInfo],
    logs: Sequence[FlightLog],
    given: Sequence[MatchRow] = (),
    options: LogOptions | None = None,
) -> LoggedStills:
    return stills_in_logs(
        stills, logs, GivenMatches(rows=tuple(given), source="match.csv"), options or LogOptions(), silent
    )


def events(result: LoggedStills) -> list[int | None]:
    assert result.matches is not None
    return [entry.event if entry.gps_time_ns is not None else None for entry in result.matches.stills]


def assert_right(result: LoggedStills, wanted: Sequence[int | None]) -> None:
    """No still has another's exposure, and hardly one is left open: the last of a flight may be."""
    told = events(result)
    assert [a for a, b in zip(told, wanted, strict=True) if a is not None and a != b] == []
    assert sum(a is None and b is not None for a, b in zip(told, wanted, strict=True)) <= 1


def places_m(result: LoggedStills) -> np.ndarray:
    frame = LocalFrame.at(35.8, 139.65, 0.0)
    table = np.array(
        [
            (np.nan,) * 3 if fix is None else (fix.latitude_deg, fix.longitude_deg, fix.height_m)
            for fix in result.joined.fixes
        ]
    )
    result_m = np.full(table.shape, np.nan)
    known = np.isfinite(table[:, 0])
    result_m[known] = frame.enu_from_geographic(*table[known].T)
    return result_m


@pytest.mark.parametrize("flight", ["distance", "waypoints", "px4"])
def test_each_still_has_its_exposure_and_lies_where_the_autopilot_says(logs: dict[str, FlightLog], flight: str) -> None:
    log = logs[flight]
    result = found(camera(log), [log])
    assert_right(result, range(1, len(log.exposure_table) + 1))
    table = log.exposure_table
    frame = LocalFrame.at(35.8, 139.65, 0.0)
    told_m = frame.enu_from_geographic(table.latitude_deg, table.longitude_deg, np.zeros(len(table)))[:, :2]
    apart_m = np.linalg.norm(places_m(result)[:, :2] - told_m, axis=1)
    # without the receiver's delay it would be 0.23, 0.13 and 0.49 m; PX4's simulated receiver is the noisiest
    assert np.nanmedian(apart_m) < (0.35 if flight == "px4" else 0.06)
    assert result.matches is not None
    (clock,) = result.matches.clocks
    assert clock.offset_s == pytest.approx(LOCAL_TIME_S, abs=0.1)
    assert clock.drift_ppm == pytest.approx(30.0, abs=5.0 * clock.drift_sigma_ppm + 1.0)
    assert all(fix.sigma_horizontal_m is not None for fix in result.joined.fixes if fix is not None)


def test_stills_lost_and_taken_besides_shift_nothing(logs: dict[str, FlightLog]) -> None:
    log = logs["distance"]
    stills = camera(log)
    extra = replace(stills[9], name="DSC00999.JPG", camera_time_ns=stills[9].camera_time_ns + 1_370_000_000)
    kept = [*stills[:5], *stills[6:10], extra, *stills[10:17], *stills[19:]]
    result = found(kept, [log])
    wanted = [*range(1, 6), *range(7, 11), None, *range(11, 18), *range(20, 32)]
    assert_right(result, wanted)
    assert result.matches is not None
    assert {entry.event for entry in result.matches.unused} >= {6, 18, 19}
    assert all(entry.reason for entry in result.matches.unused)
    assert any("not used" in note for note in result.notes)


def test_two_logs_of_a_flight_count_once(logs: dict[str, FlightLog]) -> None:
    stills = camera(logs["distance"])
    one, both = found(stills, [logs["distance"]]), found(stills, [logs["distance"], logs["telemetry"]])
    assert both.matches is not None
    assert both.matches.events == 31
    assert events(both) == events(one)
    assert set(both.joined.flight.tolist()) == {0}
    assert any("told by another log already" in note for note in both.notes)


def test_two_sorties_in_one_folder_are_two_flights(logs: dict[str, FlightLog]) -> None:
    stills = [*camera(logs["distance"]), *camera(logs["waypoints"], first=32)]
    result = found(stills, [logs["waypoints"], logs["distance"]])  # the order of the logs does not matter
    assert_right(result, range(1, 65))
    assert result.joined.flight.tolist() == [0] * 31 + [1] * 33


def test_the_log_of_another_flight_is_not_joined(logs: dict[str, FlightLog]) -> None:
    result = found(camera(logs["px4"]), [logs["waypoints"]])
    assert result.joined.count == 0
    assert result.matches is not None
    assert all(entry.state is not StillState.MATCHED for entry in result.matches.stills)


def test_a_later_shutter_lies_further_on_along_the_track(logs: dict[str, FlightLog]) -> None:
    log, late_s = logs["distance"], 0.2
    stills = camera(log)
    usual, late = found(stills, [log]), found(stills, [log], options=LogOptions(shutter_latency_s=late_s))
    moved = places_m(late)[:, :2] - places_m(usual)[:, :2]
    known = np.isfinite(moved[:, 0])
    assert usual.joined.velocity_m_s is not None
    moved, velocity = moved[known], usual.joined.velocity_m_s[known, :2]
    along = np.sum(moved * velocity, axis=1) / np.linalg.norm(velocity, axis=1)
    assert np.median(along) == pytest.approx(late_s * SPEED_M_S, abs=0.15)
    assert np.median(np.linalg.norm(moved - velocity * late_s, axis=1)) < 0.05


def test_the_lever_arm_turns_with_the_vehicle(logs: dict[str, FlightLog]) -> None:
    """An antenna 0.5 m ahead of the camera: the camera lies behind, against the direction of the nose."""
    log = logs["distance"]
    stills = camera(log)
    arm = found(stills, [log], options=LogOptions(lever_arm_m=(0.5, 0.0, 0.0)))
    moved = places_m(arm)[:, :2] - places_m(found(stills, [log]))[:, :2]
    yaw = log.exposure_table.yaw_rad
    nose = np.column_stack([np.sin(yaw), np.cos(yaw)])
    along_m = np.sum(moved * nose, axis=1)
    assert along_m[np.isfinite(along_m)] == pytest.approx(-0.5, abs=0.02)
    assert arm.lever_arm_taken_off


def test_shutters_in_the_video_tell_what_whole_seconds_leave_open(logs: dict[str, FlightLog]) -> None:
    """The video's times are good to a field: each still has its exposure, also without any EXIF time."""
    log, first_ns = logs["distance"], int(logs["distance"].exposure_table.when.gps_ns[0])
    stills = camera(log, unit_ns=1_000_000_000)
    places = tuple(
        StillInVideo(
            still=still.name,
            last_frame=n,
            first_frame=n + 1,
            exposure_time_ns=(gps_ns - first_ns + 5_000_000_000) // 16_683_350 * 16_683_350 + 8_341_675,
            kind="content" if n == 7 else "black",
            confidence=0.99,
        )
        for n, (still, gps_ns) in enumerate(zip(stills, log.exposure_table.when.gps_ns.tolist(), strict=True))
    )
    video = VideoSync(
        places=places,
        still_from_video=AffineTransformation(matrix=np.eye(2), shift=np.zeros(2)),
        residual_px=0.1,
        field_order=FieldOrder.BOTTOM_FIRST,
        frame_interval_ns=33_366_700,
    )
    for infos in (stills, [replace(still, camera_time_ns=None) for still in stills]):
        result = stills_in_logs(infos, [log], GivenMatches(), LogOptions(), silent, video)
        assert_right(result, range(1, 32))


def test_what_the_user_gives_counts_and_is_checked(logs: dict[str, FlightLog], tmp_path: Path) -> None:
    log = logs["distance"]
    stills = camera(log)
    result = found(stills, [log])
    path = tmp_path / "exposures.csv"
    assert result.matches is not None
    write_matches(path, rows_of_matches(result.matches), ["not used flight.BIN 40 - no still: is near"])
    assert len(read_matches(path)) == len(stills)
    assert path.read_text(encoding="utf-8").endswith("# not used flight.BIN 40 - no still: is near\n")
    assert events(found(stills, [log], read_matches(path))) == events(result)  # as written, it changes nothing
    given = MatchRow(image="DSC00007.JPG", event="none")
    changed = found(stills, [log], [given])
    assert events(changed)[6] is None
    assert changed.joined.fixes[6] is None
    with pytest.raises(InputError, match=r"match\.csv: line 2: there is no image"):
        found(stills, [log], [MatchRow(image="DSC00O8.JPG", event="none", line=2)])


def test_a_log_without_exposures_says_so(logs: dict[str, FlightLog]) -> None:
    log = replace(logs["distance"], exposure_table=no_exposures())
    result = found(camera(logs["distance"]), [log])
    assert result.matches is None
    assert result.joined.count == 0
    assert any("no log tells of exposures" in note for note in result.notes)


def test_without_fixes_the_autopilots_own_positions_count(logs: dict[str, FlightLog]) -> None:
    log = logs["distance"]
    result = found(camera(log), [replace(log, fix_table=no_fixes())])
    assert result.joined.count >= 30
    assert any("autopilot's own estimate" in note for note in result.notes)
    bare = replace(log, fix_table=no_fixes(), estimate_table=no_fixes(), attitude_table=no_attitudes())
    positions = found(camera(log), [bare]).joined.fixes
    assert positions[0].latitude_deg == pytest.approx(float(log.exposure_table.latitude_deg[0]), abs=1e-9)


def test_a_gap_in_the_fixes_leaves_the_position_of_the_event(logs: dict[str, FlightLog]) -> None:
    log = logs["distance"]
    middle = int(log.exposure_table.when.gps_ns[15])
    keep = np.abs(log.fix_table.when.gps_ns - middle) > 3 * 10**9
    table = log.fix_table
    cut = fix_table(
        table.when.where(keep),
        table.latitude_deg[keep],
        table.longitude_deg[keep],
        height_ellipsoid_m=table.height_ellipsoid_m[keep],
        fix_type=table.fix_type[keep],
        sigma_horizontal_m=table.sigma_horizontal_m[keep],
    )
    fix = found(camera(log), [replace(log, fix_table=cut)]).joined.fixes[15]
    assert fix is not None
    assert fix.latitude_deg == pytest.approx(float(log.exposure_table.latitude_deg[15]), abs=1e-9)
    assert fix.sigma_horizontal_m is None
    geoid_m = float(log.exposure_table.height_geoid_m[15])
    assert fix.height_datum is HeightDatum.ELLIPSOID
    assert fix.height_m - geoid_m == pytest.approx(
        float(geoid_undulation_m(np.array(35.8), np.array(139.65))), abs=0.01
    )


def test_truth_of_the_flight_is_the_events_own() -> None:
    """The recording's truth and the log's exposures are the same, digit by digit."""
    folder = RECORDED / "sitl_distance_trigger"
    truth = json.loads((folder / "exposures.json").read_text(encoding="utf-8"))["camera_feedback"]
    table = open_log(folder / "flight.tlog").exposure_table
    assert np.rint(table.latitude_deg * 1e7).astype(int).tolist() == [row["lat"] for row in truth]
    assert np.rint(table.longitude_deg * 1e7).astype(int).tolist() == [row["lng"] for row in truth]
