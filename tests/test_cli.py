"""The command line: one line for what is wrong, the right exit status, and a chain that goes on after it was killed."""

import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from tests.report.conftest import make_result_
from uavkit import workflow
from uavkit.cli import EXIT_DEFECT, EXIT_ERROR, EXIT_INTERRUPTED, INTERRUPTED, PlainProgress, app, oriented_summary
from uavkit.core.errors import DeviceError, InputError
from uavkit.project import IngestOptions, Manifest, Project, Stage

if TYPE_CHECKING:
    from uavkit.simulate.survey import SimulatedSurvey

ROOT = Path(__file__).resolve().parents[1]
RUNNER = CliRunner()


def uavkit(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own."""
    settings = {**os.environ, "PYTHONPATH": str(ROOT), "NO_COLOR": "1", "COLUMNS": "200", **environment}
    command = [sys.executable, "-m", "uavkit.cli", *arguments]
    return subprocess.run(command, env=settings, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture
def survey(tmp_path: Path) -> Project:
    """Return a survey of one picture that was ingested (as far as its state tells)."""
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg").write_bytes(b"picture")
    project = Project(tmp_path / "survey")
    images = project.original(tmp_path / "images")
    project.save_manifest(Manifest(originals={"images": images}, ingest=IngestOptions(camera="x")))
    with project.running(Stage.INGEST):
        project.block_file.write_text("{}")
    return project


def test_help_names_every_command() -> None:
    answer = RUNNER.invoke(app, ["--help"])
    assert answer.exit_code == 0
    for command in ("simulate", "ingest", "process", "report", "run", "status", "export", "cameras", "demo"):
        assert f"  {command} " in answer.output
        assert RUNNER.invoke(app, [command, "--help"]).exit_code == 0


def test_the_version_is_told() -> None:
    assert uavkit("--version").stdout.startswith("uavkit 0.")


def test_the_first_line_of_a_result_says_whether_it_is_provisional() -> None:
    result = make_result_(strips=2, images_per_strip=4, points=300)
    assert "PROVISIONAL" not in oriented_summary(result)[0]
    result = replace(result, adjustment=replace(result.adjustment, converged=False))
    assert "PROVISIONAL: the adjustment did not converge" in oriented_summary(result)[0]


def test_a_mistake_of_the_user_is_one_line_on_stderr_and_status_2(tmp_path: Path) -> None:
    finished = uavkit("status", str(tmp_path))
    assert finished.returncode == EXIT_ERROR
    assert finished.stdout == ""
    assert finished.stderr.count("\n") == 1
    assert finished.stderr.startswith("uavkit: ")
    assert "run 'uavkit ingest'" in finished.stderr


@pytest.mark.parametrize(("arguments", "environment"), [(("--debug",), {}), ((), {"UAVKIT_DEBUG": "1"})])
def test_debug_shows_the_traceback(tmp_path: Path, arguments: tuple[str, ...], environment: dict[str, str]) -> None:
    finished = uavkit(*arguments, "status", str(tmp_path), **environment)
    assert finished.returncode == EXIT_ERROR
    assert "Traceback" in finished.stderr
    assert "InputError" in finished.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("proces",),
        ("process",),
        ("ingest", "survey"),
        ("process", "survey", "--workers", "0"),
        ("ingest", "survey", "--images", ".", "--camera", "x", "--height-datum", "sea"),
        ("export", "survey", "--to", "word"),
        ("status", "--colour"),
    ],
)
def test_usage_errors_have_status_2_and_no_traceback(arguments: tuple[str, ...]) -> None:
    finished = uavkit(*arguments)
    assert finished.returncode == 2
    assert "Usage" in finished.stderr
    assert "Traceback" not in finished.stderr


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (InputError("line one\nline two"), EXIT_ERROR, "uavkit: line one line two"),
        (DeviceError("no link"), EXIT_ERROR, "uavkit: no link"),
        (KeyboardInterrupt(), EXIT_INTERRUPTED, INTERRUPTED),
        (MemoryError(), EXIT_ERROR, "fewer --workers"),
        (ZeroDivisionError("oops"), EXIT_DEFECT, "unexpected error (ZeroDivisionError: oops)"),
    ],
)
def test_every_kind_of_failure_ends_as_one_line(
    monkeypatch: pytest.MonkeyPatch, error: BaseException, status: int, words: str
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.delenv("UAVKIT_DEBUG", raising=False)
    monkeypatch.setattr(workflow, "cameras", fail)
    answer = RUNNER.invoke(app, ["cameras"])
    assert answer.exit_code == status
    assert words in answer.output
    assert "Traceback" not in answer.output
    assert answer.output.count("\n") == 1


def test_known_cameras_are_listed() -> None:
    answer = RUNNER.invoke(app, ["cameras"])
    assert answer.exit_code == 0
    assert "Ricoh GX200" in answer.output
    assert "4000 x 3000 px" in answer.output


def test_status_tells_what_is_done_and_why_the_rest_is_not(survey: Project) -> None:
    answer = RUNNER.invoke(app, ["status", str(survey.folder)])
    assert answer.exit_code == 0
    rows = {line.split()[0]: line for line in answer.output.splitlines()[1:]}
    assert "done" in rows["ingest"]
    assert "missing" in rows["process"]
    assert "not run yet" in rows["process"]


@pytest.mark.parametrize(
    ("setting", "advice"),
    [
        ("measurment.window_px=31", "did you mean 'measurement'"),
        ("measurement.windo_px=31", "did you mean 'window_px'"),
        ("measurement.window_px=ten", "does not fit"),
        ("measurement.window_px=30", "must be odd"),
        ("window_px", "write section.option=value"),
    ],
)
def test_unknown_settings_are_refused_with_the_nearest_right_one(survey: Project, setting: str, advice: str) -> None:
    answer = RUNNER.invoke(app, ["process", str(survey.folder), "--set", setting])
    assert answer.exit_code == EXIT_ERROR
    assert advice in answer.output
    assert survey.manifest.process == ()


def test_a_stage_whose_input_is_out_of_date_says_what_to_run(survey: Project) -> None:
    for arguments, first in ((["report"], "process"), (["export", "--to", "ply"], "process")):
        answer = RUNNER.invoke(app, [arguments[0], str(survey.folder), *arguments[1:]])
        assert answer.exit_code == EXIT_ERROR
        assert f"run 'uavkit {first}' first" in answer.output
    (survey.folder.parent / "images" / "a.jpg").write_bytes(b"another")
    answer = RUNNER.invoke(app, ["process", str(survey.folder)])
    assert answer.exit_code == EXIT_ERROR
    assert "ingest is out of date (images: a.jpg is changed)" in answer.output


def test_ingest_refuses_paths_that_do_not_exist(tmp_path: Path) -> None:
    answer = RUNNER.invoke(
        app, ["ingest", str(tmp_path / "s"), "--images", str(tmp_path / "no"), "--camera", "Ricoh GX200"]
    )
    assert answer.exit_code == EXIT_ERROR
    assert "does not exist" in answer.output


def test_plain_progress_tells_begin_end_and_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 100.0
    monkeypatch.setattr("uavkit.cli.time.monotonic", lambda: now_s)
    progress = PlainProgress()
    for done in range(0, 101):
        progress("stills", done, 100)
        now_s += 1.0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "stills: 0 of 100"
    assert lines[1] == "stills: 5 of 100, about 1 min 35 s left"
    assert lines[-1] == "stills: 100 of 100"
    assert len(lines) == 21


def damaged(path: Path, change: Callable[[bytes], bytes], name: str = "") -> None:
    """Change a file's bytes, in place or into another file of the folder."""
    path.with_name(name or path.name).write_bytes(change(path.read_bytes()))


def replaced(path: Path, old: str, new: str) -> None:
    """Change a text file."""
    text = path.read_text(encoding="utf-8")
    assert re.search(old, text)
    path.write_text(re.sub(old, new, text), encoding="utf-8")


@pytest.fixture
def flight(smallest_survey: "SimulatedSurvey", tmp_path: Path) -> Path:
    """Return a copy of the smallest simulated flight, to be damaged."""
    return Path(shutil.copytree(smallest_survey.folder, tmp_path / "flight"))


def ingest(flight: Path, *more: str) -> tuple[int, str]:
    """Ingest a flight without its video, and return exit status and words."""
    arguments = ["--images", str(flight / "stills"), "--positions", str(flight / "positions.kml")]
    control = ["--control-points", str(flight / "control_points.csv")]
    answer = RUNNER.invoke(app, ["ingest", str(flight.parent / "survey"), *arguments, *control, *more])
    return answer.exit_code, answer.output


def last_placemark(text: bytes) -> tuple[int, int]:
    return text.rindex(b"<Placemark"), text.rindex(b"</Placemark>") + len(b"</Placemark>")


def without_last_placemark(text: bytes) -> bytes:
    start, end = last_placemark(text)
    return text[:start] + text[end:]


def with_last_placemark_twice(text: bytes) -> bytes:
    start, end = last_placemark(text)
    return text[:end] + text[start:end] + text[end:]


def test_ingest_says_what_it_found(flight: Path) -> None:
    status, words = ingest(flight)
    assert status == 0
    assert "2 stills of Ricoh GX200, 2 positions, 3 control points, 0 check points" in words


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("control_points.csv", lambda t: t.replace(b"EPSG:32654", b"EPSG:32630"), r"lie 6\d\d\d km from the nearest"),
        ("control_points.csv", lambda t: t.replace(b"R00", b"X00"), r"none of its \d marks .*file of this flight"),
        ("positions.kml", lambda t: t[: len(t) // 2], "no valid KML"),
        ("stills/R0010001.JPG", lambda t: t[: len(t) // 2], "1 still is no block"),
    ],
    ids=["control in another CRS", "control of another flight", "half a KML", "one readable still"],
)
def test_files_that_cannot_be_used_end_as_one_line(
    flight: Path, file: str, change: Callable[[bytes], bytes], words: str
) -> None:
    damaged(flight / file, change)
    status, told = ingest(flight)
    assert status == EXIT_ERROR
    (line,) = (line for line in told.splitlines() if line.startswith("uavkit: "))
    assert re.search(words, line)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--camera", "Ricoh GX20"), "did you mean 'Ricoh GX200'"),
        (("--crs", "EPSG:99999"), "no coordinate reference system"),
        (("--video", "positions.kml"), "no video that can be read"),
        (("--check-points", "positions.kml"), "no coordinate reference system"),
        (("--check-points", "control_points.csv"), "both control and check"),
    ],
)
def test_arguments_that_do_not_fit_end_as_one_line(
    flight: Path, monkeypatch: pytest.MonkeyPatch, more: tuple[str, ...], words: str
) -> None:
    monkeypatch.chdir(flight)
    status, told = ingest(flight, *more)
    assert status == EXIT_ERROR
    (line,) = (line for line in told.splitlines() if line.startswith("uavkit: "))
    assert words in line


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("stills/R0010001.JPG", (lambda t: t[: len(t) // 2], "R0019999.JPG"), "R0019999.JPG: the file is truncated"),
        ("stills/R0010001.JPG", (lambda _: b"", "R0019999.JPG"), "R0019999.JPG: the file is empty"),
        ("positions.kml", (without_last_placemark,), "1 positions are fewer than 2 stills"),
        ("positions.kml", (with_last_placemark_twice,), "3 positions are more than 2 stills"),
        (
            "control_points.csv",
            (lambda t: t.replace(b"R0010002", b"R001002", 1),),
            "is none of the stills; did you mean",
        ),
        ("control_points.csv", (lambda t: b"\n".join(r for r in t.split(b"\n") if r[:2] != b"G3"),), "free network"),
    ],
    ids=["truncated still", "empty still", "position missing", "position doubled", "unknown image", "2 control points"],
)
def test_what_is_left_out_is_told_and_kept_for_the_report(
    flight: Path, file: str, change: tuple[Callable[[bytes], bytes], str], words: str
) -> None:
    if words == "free network":
        replaced(flight / "positions.kml", r"(?s)<Placemark.*</Placemark>\s*(?=<Placemark)", "")
    damaged(flight / file, *change)
    status, told = ingest(flight)
    assert status == 0
    (note,) = (line for line in told.splitlines() if words in line)
    assert note.startswith("note: ")
    kept = (flight.parent / "survey" / "ingest" / "block.json").read_text(encoding="utf-8")
    assert words in kept


def test_two_cameras_are_refused(flight: Path) -> None:
    from PIL import Image

    Image.new("L", (320, 240)).save(flight / "stills" / "other.jpg")
    status, told = ingest(flight)
    assert status == EXIT_ERROR
    assert "two cameras or sizes are mixed" in told


def test_a_file_in_place_of_the_survey_is_refused(flight: Path) -> None:
    still = flight / "stills" / "R0010001.JPG"
    answer = RUNNER.invoke(app, ["ingest", str(still), "--images", str(still.parent)])
    assert answer.exit_code == EXIT_ERROR
    assert answer.output == f"uavkit: {still}: is a file: name a folder for the survey\n"


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.ENOSPC, "the disk is full"), (errno.EROFS, "cannot be written (Read-only file system)")],
)
def test_a_disk_that_takes_nothing_is_named(
    flight: Path, monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    def refuse(file: Path, *_: object, **__: object) -> int:
        raise OSError(number, os.strerror(number), str(file))

    monkeypatch.setattr(Path, "write_text", refuse)
    status, told = ingest(flight)
    assert status == EXIT_ERROR
    assert words in told
    assert "survey" in told


def test_a_second_run_is_kept_out(flight: Path) -> None:
    with Project(flight.parent / "survey").locked():
        status, told = ingest(flight)
    assert status == EXIT_ERROR
    assert f"another run (process {os.getpid()} on " in told


def test_the_interrupt_key_ends_a_run_with_one_line(tmp_path: Path) -> None:
    """Ctrl-C at a terminal: the signal reaches Python, threads end, and the line says how to go on."""
    script = (
        "import sys, time\n"
        "from uavkit import cli, workflow\n"
        "def wait():\n"
        "    print('at work', flush=True)\n"
        "    time.sleep(60)\n"
        "workflow.cameras = wait\n"
        "sys.argv = ['uavkit', 'cameras']\n"
        "cli.main()\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.Popen(
        [sys.executable, "-c", "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n" + script],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert run.stdout is not None
    assert run.stdout.readline() == "at work\n"
    began_s = time.monotonic()
    run.send_signal(signal.SIGINT)
    _, words = run.communicate(timeout=60)
    assert time.monotonic() - began_s < 30
    assert run.returncode == EXIT_INTERRUPTED
    assert words == f"uavkit: {INTERRUPTED}\n"


@pytest.mark.parametrize("option", [("--field-order", "progressive"), ("--frames-between-stills", "5")])
def test_simulate_refuses_what_no_finder_sends(tmp_path: Path, option: tuple[str, str]) -> None:
    answer = RUNNER.invoke(app, ["simulate", str(tmp_path / "f"), *option])
    assert answer.exit_code == EXIT_ERROR
    assert not (tmp_path / "f").exists()


def test_simulate_hands_its_options_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, object] = {}

    def note(out: Path, values: dict[str, object], progress: object) -> str:
        given.update(values)
        return "uavkit ingest ..."

    monkeypatch.setattr(workflow, "simulate", note)
    arguments = ["--field-order", "top", "--frames-between-stills", "45", "--stations", "4", "--strips", "2"]
    answer = RUNNER.invoke(app, ["simulate", str(tmp_path), *arguments])
    assert answer.exit_code == 0
    assert (given["field_order"], given["frames_between_stills"], given["stations_per_strip"]) == ("top", 45.0, 4)
