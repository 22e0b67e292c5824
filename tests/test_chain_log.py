"""The chain with an RTK receiver's log and no control: stills matched with the shutter's marks, oriented, geotagged."""

import json
from pathlib import Path

import numpy as np
import pytest

from uavkit import workflow
from uavkit.core.adjustment import Datum
from uavkit.core.frames import LocalFrame
from uavkit.core.heights import HeightDatum
from uavkit.formats.exif import read_header
from uavkit.formats.match_file import MatchRow, read_matches, write_matches
from uavkit.project import IngestOptions, Project


@pytest.fixture(scope="module")
def survey(rtk_flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Project:
    """Return the survey of it, oriented.

    Twelve stamps of whole seconds at nearly even intervals do not settle which mark is whose: the user says it.
    """
    project, given = Project(tmp_path_factory.mktemp("survey")), tmp_path_factory.mktemp("given") / "match.csv"
    names = sorted(path.name for path in (rtk_flight / "stills").glob("*.JPG"))
    write_matches(given, [MatchRow(image=name, event=f"gnss.ubx {n}") for n, name in enumerate(names, start=1)])
    originals = {
        "images": rtk_flight / "stills",
        "log": [rtk_flight / "gnss.ubx"],
        "match": given,
        "check_points": rtk_flight / "check_points.csv",
    }
    workflow.begin_survey(project, originals, IngestOptions())
    workflow.ingest(project)
    workflow.process(project, workers=2)
    return project


def true_centres_m(flight: Path) -> dict[str, np.ndarray]:
    truth = json.loads((flight / "truth" / "truth.json").read_text(encoding="utf-8"))
    return {entry["image"]: np.array(entry["projection_centre_m"]) for entry in truth["exposures"]}


def test_stills_have_the_marks_that_the_user_gave(survey: Project) -> None:
    block = workflow.oriented_block(survey).block
    assert block.exposures is not None
    assert [entry.event for entry in block.exposures.stills] == list(range(1, 13))
    assert all(entry.gps_time_ns is not None and entry.position is not None for entry in block.exposures.stills)
    rows = read_matches(survey.folder / "ingest" / "exposures.csv")
    assert [row.event for row in rows] == [f"gnss.ubx {n}" for n in range(1, 13)]


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


def test_rtk_positions_fix_a_block_as_well_as_predicted(survey: Project) -> None:
    """Chi-square of all coordinates of the check points with their joint covariance, 0.1 % each side; centimetres."""
    result = workflow.oriented_block(survey)
    assert result.unoriented == {}
    assert result.adjustment.datum is Datum.GNSS
    difference = np.array([point.difference_m for point in result.check])
    predicted = np.array([point.sigma_m for point in result.check])
    assert len(difference) >= 6
    chi_square = difference.ravel() @ np.linalg.solve(result.check_covariance_m2, difference.ravel())
    assert abs(chi_square - difference.size) < 3.1 * np.sqrt(2.0 * difference.size)
    assert np.median(predicted) < 0.05  # the default shift of 2 m would show here
    latency_s, sigma_s = result.adjustment.gnss_latency_s, result.adjustment.gnss_latency_sigma_s
    assert np.all(np.abs(latency_s) < 4.0 * sigma_s)  # the marks are 0.8 ms late
    assert np.all(sigma_s < 0.05)


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
    assert "12 of them as told by the user" in page
    assert "Shutter latency [ms]" in page
