"""The chain with a receiver's log for positions: stills matched with the shutter's marks, and geotagged."""

import json
from pathlib import Path

import numpy as np
import pytest

from uavkit import workflow
from uavkit.core.exposures import StillState
from uavkit.core.frames import LocalFrame
from uavkit.core.heights import HeightDatum
from uavkit.formats.exif import read_header
from uavkit.formats.match_file import read_matches
from uavkit.project import IngestOptions, Project


@pytest.fixture(scope="module")
def survey(rtk_flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Project:
    """Return the survey of it, oriented."""
    project = Project(tmp_path_factory.mktemp("survey"))
    originals = {
        "images": rtk_flight / "stills",
        "log": [rtk_flight / "gnss.ubx"],
        "control_points": rtk_flight / "control_points.csv",
        "check_points": rtk_flight / "check_points.csv",
    }
    workflow.begin_survey(project, originals, IngestOptions())
    workflow.ingest(project)
    workflow.process(project, workers=2)
    return project


def true_centres_m(flight: Path) -> dict[str, np.ndarray]:
    truth = json.loads((flight / "truth" / "truth.json").read_text(encoding="utf-8"))
    return {entry["image"]: np.array(entry["projection_centre_m"]) for entry in truth["exposures"]}


def test_stills_are_matched_with_their_marks(survey: Project, rtk_flight: Path) -> None:
    block = workflow.oriented_block(survey).block
    assert block.exposures is not None
    matched = [entry for entry in block.exposures.stills if entry.state is StillState.MATCHED]
    assert len(matched) >= 10
    numbers = [int(entry.still[5:8]) for entry in matched]
    assert [entry.event for entry in matched] == [number for number in numbers]
    rows = read_matches(survey.folder / "ingest" / "exposures.csv")
    assert [row.image for row in rows] == [still.name for still in block.stills]
    assert sum(bool(row.event) for row in rows) == len(matched)


def test_the_positions_are_those_of_the_exposures(survey: Project, rtk_flight: Path) -> None:
    """Within the noise of RTK and half the step of its positions; the shutter's lag of 0.8 ms is less."""
    block, truth = workflow.oriented_block(survey).block, true_centres_m(rtk_flight)
    assert block.gnss is not None
    assert block.gnss.velocity_m_s is not None
    wanted = np.array([truth[block.stills[index].name] for index in block.gnss.image_index])
    error_m = block.gnss.position_m - wanted
    error_m -= error_m.mean(axis=0)  # the shift of the flight, and the origin of the frame
    assert np.abs(error_m / block.gnss.sigma_m).max() < 5.0
    assert block.gnss.sigma_m.max() < 0.05


def test_geotagged_copies_say_where_the_cameras_were(survey: Project, rtk_flight: Path, tmp_path: Path) -> None:
    found = workflow.geotag(survey, tmp_path / "adjusted", None)
    truth = true_centres_m(rtk_flight)
    assert sorted(found.tags) == sorted(truth)
    frame = workflow.oriented_block(survey).frame
    assert frame is not None
    site = LocalFrame.at(35.8, 139.65, 45.0)
    for name, centre_m in truth.items():
        position = read_header(tmp_path / "adjusted" / name)[0].position
        assert position is not None
        assert position.height_datum is HeightDatum.GEOID
        place_m = site.enu_from_geographic(
            np.array([position.latitude_deg]), np.array([position.longitude_deg]), np.array([found.tags[name].height_m])
        )
        assert np.abs(place_m[0] - centre_m).max() < 0.15
        assert (tmp_path / "adjusted" / name).stat().st_mtime_ns == (rtk_flight / "stills" / name).stat().st_mtime_ns
    measured = workflow.geotag(survey, tmp_path / "measured", True)
    assert len(measured.tags) + len(measured.without) == len(truth)
    assert all(tag.gps_time_ns is not None for tag in measured.tags.values())


def test_the_report_tells_of_the_exposures(survey: Project) -> None:
    page = workflow.report(survey).read_text(encoding="utf-8")
    assert "Stills and exposures" in page
    assert "The camera&#x27;s clock" in page or "The camera's clock" in page
    assert (survey.folder / "report" / "figures" / "camera_clock.png").is_file()
    assert "Shutter latency [ms]" in page
