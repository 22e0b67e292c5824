"""The commands about flight logs and geotags: what they tell, what they write, what they refuse."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from uavkit.cli import EXIT_ERROR, app
from uavkit.formats.exif import read_header
from uavkit.formats.flight_logs import open_log

if TYPE_CHECKING:
    from uavkit.simulate.survey import SimulatedSurvey

ROOT = Path(__file__).resolve().parents[1]
LOG = ROOT / "sim_logs" / "sitl_distance_trigger" / "flight.BIN"
RUNNER = CliRunner()


def run(*arguments: str | Path, status: int = 0) -> str:
    answer = RUNNER.invoke(app, [str(argument) for argument in arguments])
    assert answer.exit_code == status, answer.output
    if status == EXIT_ERROR:
        assert "Traceback" not in answer.output
    return answer.output


def test_log_info_tells_people_and_programs() -> None:
    told = run("log", "info", LOG)
    assert "ArduCopter V4.6.3" in told
    assert "exposures 31 (31 trigger)" in told
    plain = RUNNER.invoke(app, ["log", "info", str(LOG), "--json"]).stdout
    assert json.loads(plain)["exposures"]["count"] == 31


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("csv", ["flight_attitudes.csv", "flight_estimates.csv", "flight_exposures.csv", "flight_fixes.csv"]),
        ("kml", ["flight.kml"]),
        ("gpx", ["flight.gpx"]),
    ],
)
def test_log_export_writes_what_can_be_read_again(kind: str, names: list[str], tmp_path: Path) -> None:
    told = run("log", "export", LOG, "--to", kind, "--out", tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    assert all(name in told for name in names)
    for name in names:
        again = open_log(tmp_path / "out" / name)
        assert len(again.fix_table) + len(again.estimate_table) + len(again.attitude_table) + len(again.exposure_table)


def test_what_is_no_log_is_refused_in_one_line(tmp_path: Path) -> None:
    for path in (ROOT / "README.md", tmp_path / "none.BIN", tmp_path):
        assert str(path) in run("log", "info", path, status=EXIT_ERROR)


def test_ingest_refuses_what_the_log_options_cannot_mean(smallest_survey: "SimulatedSurvey", tmp_path: Path) -> None:
    arguments = ("ingest", tmp_path / "survey", "--images", smallest_survey.stills)
    assert "forward,right,down" in run(*arguments, "--lever-arm", "0.1;0;0", status=2)
    assert "none.BIN" in run(*arguments, "--log", tmp_path / "none.BIN", status=EXIT_ERROR)
    assert "no flight log" in run(*arguments, "--log", ROOT / "README.md", status=EXIT_ERROR)


def test_geotag_needs_a_survey_and_another_folder(smallest_survey: "SimulatedSurvey", tmp_path: Path) -> None:
    survey = tmp_path / "survey"
    assert "is no survey" in run("geotag", survey, "--out", tmp_path / "out", status=EXIT_ERROR)
    run("ingest", survey, "--images", smallest_survey.stills, "--positions", smallest_survey.image_positions)
    assert "never changed" in run("geotag", survey, "--out", smallest_survey.stills, status=EXIT_ERROR)
    assert "process" in run("geotag", survey, "--out", tmp_path / "out", "--positions", "adjusted", status=EXIT_ERROR)
    before = {path.name: path.read_bytes() for path in smallest_survey.stills.glob("*.JPG")}
    assert "2 stills with their positions" in run("geotag", survey, "--out", tmp_path / "out")
    for path in (tmp_path / "out").glob("*.JPG"):
        assert read_header(path)[0].position is not None
    assert {path.name: path.read_bytes() for path in smallest_survey.stills.glob("*.JPG")} == before
