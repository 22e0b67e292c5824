"""Planning as a user does it: from files to a folder of files, and checks of plans that exist."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.plan.made_requests import SQUARE, area, hills
from uavkit.cli import app
from uavkit.formats.elevation_file import write_elevation
from uavkit.formats.flightplan_file import read_flightplan
from uavkit.formats.plan_request import PlanRequest, request_of, request_text

USUAL = ["--camera", "Ricoh GX200", "--height-above-ground", "50", "--forward-overlap", "80%", "--side-overlap", "0.6"]


@pytest.fixture
def field(tmp_path: Path) -> Path:
    """An area file with a terrain model beside it."""
    ring = [[float(b), float(a)] for a, b in area(SQUARE).latitude_longitude_deg]
    shape = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
    path = tmp_path / "field.geojson"
    path.write_text(json.dumps({"type": "Feature", "properties": {"name": "field"}, "geometry": shape}))
    write_elevation(tmp_path / "ground.tif", hills())
    return path


def run(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return done.exit_code, done.output


def test_a_plan_is_a_folder_of_files(field: Path) -> None:
    out = field.parent / "flight"
    status, told = run("plan", field, *USUAL, "--terrain", field.parent / "ground.tif", "--follow", "--out", out)
    assert status == 0, told
    for name in (".flightplan.json", ".plan", ".waypoints", ".kml", ".geojson", ".toml", ".html", ".png"):
        assert (out / f"field{name}").stat().st_size > 100
    assert (out / "field_exposures.csv").is_file()
    assert json.loads((out / "field_summary.json").read_text())
    assert "Forward overlap" in told
    assert not list(field.parent.glob("*.part"))
    assert not list(field.parent.glob("*.old"))
    plan = read_flightplan(out / "field.flightplan.json")
    assert plan.summary.forward_overlap[0] >= 0.795


def test_a_plan_takes_the_place_of_a_plan_and_of_nothing_else(field: Path) -> None:
    out = field.parent / "flight"
    assert run("plan", field, *USUAL, "--out", out)[0] == 0
    (out / "field_7.plan").write_text("of an earlier plan with more sorties")
    assert run("plan", field, *USUAL, "--out", out)[0] == 0
    assert not (out / "field_7.plan").exists()
    other = field.parent / "photos"
    other.mkdir()
    (other / "dear.jpg").write_text("x")
    status, told = run("plan", field, *USUAL, "--out", other)
    assert status == 2
    assert "holds other files than a plan" in told
    assert (other / "dear.jpg").read_text() == "x"


def test_with_a_survey_the_plan_lies_in_it(field: Path) -> None:
    survey = field.parent / "survey"
    assert run("plan", field, *USUAL, "--survey", survey)[0] == 0
    assert (survey / "plan" / "field.flightplan.json").is_file()


def test_the_request_beside_a_plan_gives_the_same_plan(field: Path) -> None:
    out, again = field.parent / "flight", field.parent / "again"
    assert run("plan", field, *USUAL, "--terrain", field.parent / "ground.tif", "--out", out)[0] == 0
    assert run("plan", out / "field.toml", "--out", again)[0] == 0
    for name in ("field.plan", "field.flightplan.json", "field.kml", "field_exposures.csv"):
        assert (out / name).read_bytes() == (again / name).read_bytes(), name


def test_the_rest_of_a_flight_is_planned(field: Path) -> None:
    out, rest = field.parent / "flight", field.parent / "rest"
    assert run("plan", field, *USUAL, "--out", out)[0] == 0
    assert run("plan", out / "field.toml", "--resume-after", 30, "--out", rest)[0] == 0
    stations = read_flightplan(rest / "field.flightplan.json").exposures.station
    assert stations[0] == 28  # three images are taken again


def test_the_rest_does_not_take_the_place_of_the_whole(field: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(field.parent)
    assert run("plan", field, *USUAL)[0] == 0
    assert run("plan", Path("field") / "field.toml", "--resume-after", 30)[0] == 0
    assert read_flightplan(Path("field") / "field.flightplan.json").exposures.station[0] == 0
    assert read_flightplan(Path("field_after_30") / "field.flightplan.json").exposures.station[0] == 28
    assert run("plan", field, *USUAL, "--out", "a", "--survey", "b")[0] == 2


@pytest.mark.parametrize("kind", ["field.plan", "field.waypoints", "field.flightplan.json"])
@pytest.mark.parametrize("trigger", ["distance", "hover"])
def test_a_check_tells_what_the_planner_told(field: Path, kind: str, trigger: str) -> None:
    out, ground = field.parent / "flight", field.parent / "ground.tif"
    assert run("plan", field, *USUAL, "--terrain", ground, "--follow", "--trigger", trigger, "--out", out)[0] == 0
    plan = read_flightplan(out / "field.flightplan.json")
    status, told = run("check-plan", out / kind, "--camera", "Ricoh GX200", "--terrain", ground)
    assert status == 0, told
    lines = {line[:27].strip(): line[27:].strip() for line in told.splitlines()}
    assert lines["images"].startswith(f"{plan.summary.images} in {len(plan.strips)} strips")
    assert float(lines["forward overlap"].split("%")[0]) == pytest.approx(
        100 * plan.summary.forward_overlap[0], abs=0.6
    )
    gsd = [float(part) for part in lines["ground distance of a pixel"].split(" mm")[0].split(" / ")]
    assert gsd == pytest.approx(1e3 * np.array(plan.summary.gsd_m), rel=0.01)
    clearance = float(lines["least clearance of the path"].split(" m")[0])
    assert clearance == pytest.approx(plan.summary.least_clearance_m, abs=0.3)


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--forward-overlap", "100%"], "less than 100 %"),
        (["--side-overlap", "lots"], "write 80% or 0.8"),
        (["--camera", "Rico GX200"], "did you mean 'Ricoh GX200'"),
        (["--vehicle", "ascteq falcon 8"], "did you mean"),
        (["--gsd-mm", "20"], "give height_above_ground_m or gsd_mm, one of them"),
        (["--terrain", "nowhere.tif"], "nowhere.tif"),
        (["--follow"], "needs a terrain model"),
        (["--direction", "north"], "degrees from north"),
        (["--take-off", "here"], "latitude,longitude"),
    ],
)
def test_what_is_wrong_is_said(field: Path, arguments: list[str], words: str) -> None:
    status, told = run("plan", field, *USUAL, *arguments, "--out", field.parent / "none")
    assert status == 2
    assert " ".join(words.split()) in " ".join(told.replace("│", " ").split())
    assert not (field.parent / "none").exists()


def test_a_misspelt_option_of_a_request_is_named(tmp_path: Path) -> None:
    path = tmp_path / "request.toml"
    path.write_text('camera = "Ricoh GX200"\narea_file = "a.kml"\n[imaging]\ngsd_mm = 10\nside_overlp = 0.6\n')
    status, told = run("plan", path)
    assert status == 2
    assert "[imaging] has no option 'side_overlp'; did you mean 'side_overlap'?" in told


def test_a_request_as_text_reads_back(tmp_path: Path) -> None:
    request = PlanRequest.model_validate(
        {
            "name": 'Grüne "Wiese"',
            "camera": "Ricoh GX200",
            "pattern": "corridor",
            "areas": [{"kind": "line", "latitude_longitude_deg": [(47.0, 8.0), (47.1, 8.1)]}],
            "imaging": {"gsd_mm": 12.5, "direction_deg": 33.0},
            "corridor": {"width_m": 40.0},
            "flight": {"take_off_deg": (47.0, 8.0), "shutter_s": 1e-3},
        }
    )
    path = tmp_path / "request.toml"
    path.write_text(request_text(request), encoding="utf-8")
    assert request_of(path, {}) == request


def test_vehicles_are_listed() -> None:
    status, told = run("vehicles")
    assert status == 0
    assert "Falcon 8" in told
