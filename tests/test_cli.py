"""The command line: one line for what is wrong, the right exit status, and a chain that goes on after it was killed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from uavkit import workflow
from uavkit.cli import EXIT_DEFECT, EXIT_ERROR, EXIT_INTERRUPTED, INTERRUPTED, PlainProgress, app
from uavkit.core.errors import DeviceError, InputError
from uavkit.project import IngestOptions, Manifest, Project, Stage

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
