"""A survey folder: what is out of date and why, what survives a killed run, and who may work in it."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uavkit.core.cache import Arrays
from uavkit.core.errors import InputError
from uavkit.project import FolderCache, IngestOptions, Manifest, Project, Stage, Standing

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def project(tmp_path: Path) -> Project:
    """Return a survey with two pictures and a control file, nothing of it done."""
    images = tmp_path / "flight" / "images"
    images.mkdir(parents=True)
    for name in ("a.jpg", "b.jpg"):
        (images / name).write_bytes(b"picture " + name.encode())
    (tmp_path / "flight" / "control.csv").write_text("P1,1,2,3\n")
    survey = Project(tmp_path / "flight" / "survey")
    survey.save_manifest(
        Manifest(
            originals={
                "images": survey.original(images),
                "control_points": survey.original(tmp_path / "flight" / "control.csv"),
            },
            ingest=IngestOptions(camera="gx200"),
        )
    )
    return survey


def do(project: Project, *stages: Stage) -> None:
    """Do stages that write one small file each."""
    for stage in stages:
        with project.locked(), project.running(stage):
            (project.stage_folder(stage) / "result.txt").write_text(f"result of {stage.value}")


def standings(project: Project) -> list[str]:
    return [status.standing.value for status in project.status()]


def why(project: Project, stage: Stage) -> str:
    return next(status.why for status in project.status() if status.stage is stage)


def test_a_new_survey_has_nothing_done(project: Project) -> None:
    assert standings(project) == ["missing", "missing", "missing"]
    assert why(project, Stage.PROCESS) == "not run yet"


def test_finished_stages_are_done(project: Project) -> None:
    do(project, *Stage)
    assert standings(project) == ["done", "done", "done"]


def test_a_changed_picture_makes_all_out_of_date(project: Project) -> None:
    do(project, *Stage)
    (project.folder.parent / "images" / "b.jpg").write_bytes(b"another picture")
    assert standings(project) == ["out of date", "out of date", "out of date"]
    assert why(project, Stage.INGEST) == "images: b.jpg is changed"
    assert why(project, Stage.PROCESS) == "ingest is out of date"


def test_a_picture_of_the_same_size_changed_in_one_byte_is_noticed(project: Project) -> None:
    do(project, *Stage)
    picture = project.folder.parent / "images" / "b.jpg"
    picture.write_bytes(picture.read_bytes()[:-1] + b"x")
    os.utime(picture, ns=(1, 1))
    assert "b.jpg is changed" in why(project, Stage.INGEST)


def test_new_and_missing_pictures_are_named(project: Project) -> None:
    do(project, *Stage)
    images = project.folder.parent / "images"
    (images / "c.jpg").write_bytes(b"new")
    assert why(project, Stage.INGEST) == "images: c.jpg is new"
    for picture in images.iterdir():
        picture.unlink()
    assert why(project, Stage.INGEST) == "images: a.jpg and 1 other file are gone"


def test_a_touched_or_copied_picture_is_not_out_of_date(project: Project) -> None:
    do(project, *Stage)
    os.utime(project.folder.parent / "images" / "a.jpg", ns=(1, 1))
    assert standings(project) == ["done", "done", "done"]


def test_control_concerns_ingest_only_by_its_own_result(project: Project) -> None:
    """Ingest again with a corrected control file, and process runs again if and only if the block changed."""
    do(project, *Stage)
    (project.folder.parent / "control.csv").write_text("P1,1,2,4\n")
    assert why(project, Stage.INGEST) == "control_points: control.csv is changed"
    do(project, Stage.INGEST)
    assert standings(project) == ["done", "done", "done"]
    (project.folder / "ingest" / "result.txt").write_text("another block")
    assert standings(project)[0] == "out of date"


def test_a_changed_option_reruns_from_its_own_stage(project: Project) -> None:
    do(project, *Stage)
    project.save_manifest(project.manifest.model_copy(update={"process": ("measurement.window_px=25",)}))
    assert standings(project) == ["done", "out of date", "out of date"]
    assert why(project, Stage.PROCESS) == "option measurement.window_px changed"
    do(project, Stage.PROCESS)
    assert standings(project) == ["done", "done", "done"]  # the same result came out: the report still fits
    ingest = project.manifest.ingest.model_copy(update={"height_datum": "geoid"})
    project.save_manifest(project.manifest.model_copy(update={"ingest": ingest}))
    assert why(project, Stage.INGEST) == "option height_datum changed"


def test_a_damaged_result_is_out_of_date(project: Project) -> None:
    do(project, *Stage)
    (project.folder / "process" / "result.txt").unlink()
    assert standings(project) == ["done", "out of date", "out of date"]
    assert why(project, Stage.PROCESS) == "process/result.txt is gone"


def test_another_version_of_uavkit_reruns_all(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    do(project, *Stage)
    monkeypatch.setattr("uavkit.project.__version__", "9.9")
    assert why(project, Stage.INGEST).startswith("made by uavkit 0.")


def test_a_survey_may_move_alone_or_with_its_pictures(project: Project, tmp_path: Path) -> None:
    do(project, *Stage)
    moved_alone = Project(project.folder.rename(tmp_path / "survey elsewhere"))
    assert standings(moved_alone) == ["done", "done", "done"]
    moved_alone.folder.rename(project.folder)
    both = shutil.move(tmp_path / "flight", tmp_path / "other disk")
    assert standings(Project(Path(both) / "survey")) == ["done", "done", "done"]


def test_pictures_that_are_gone_are_named(project: Project) -> None:
    do(project, *Stage)
    shutil.rmtree(project.folder.parent / "images")
    assert "(images) is gone: put it back" in why(project, Stage.INGEST)
    with pytest.raises(InputError, match="put it back"):
        project.original_path("images")
    assert project.original_path("video") is None


def test_a_stage_that_fails_is_not_done(project: Project) -> None:
    do(project, *Stage)
    with pytest.raises(InputError), project.running(Stage.PROCESS):
        raise InputError("no")
    assert standings(project) == ["done", "missing", "out of date"]


def test_an_interrupted_stage_says_that_its_steps_are_kept(project: Project) -> None:
    do(project, Stage.INGEST)

    def interrupted() -> None:
        with project.running(Stage.PROCESS):
            project.cache(Stage.PROCESS).arrays("step", "key", lambda: {"a": np.ones(2)})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert why(project, Stage.PROCESS) == "not finished; the steps that were are kept"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "damaged"),
        ("[]", "damaged"),
        ('{"uavkit_survey": 2}', "newer uavkit"),
        ('{"uavkit_survey": 1, "orignals": {}}', "no 'orignals'; did you mean 'originals'"),
        ('{"originals": {}, "ingest": {"camera": "x", "heigth_datum": "geoid"}}', "did you mean 'height_datum'"),
        ('{"originals": {}, "ingest": {"camera": "x", "height_datum": "sea"}}', "height_datum"),
    ],
)
def test_a_bad_manifest_is_refused_by_name_of_the_fault(tmp_path: Path, text: str, message: str) -> None:
    if "orignals" in text:
        text = text[:-1] + ', "originals": {}, "ingest": {"camera": "x"}}'
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        _ = Project(tmp_path).manifest
    assert "manifest.json" in str(caught.value)


def test_a_folder_without_manifest_is_no_survey(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no survey"):
        Project(tmp_path).status()


def test_a_missing_original_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        Project(tmp_path).original(tmp_path / "nowhere")


HOLD_THE_LOCK = """
import sys, time
from pathlib import Path
from uavkit.project import Project, Stage
with Project(Path(sys.argv[1])).locked(), Project(Path(sys.argv[1])).running(Stage.PROCESS):
    print("locked", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def other_run(project: Project) -> Iterator[subprocess.Popen[str]]:
    """Start another process that works in the survey."""
    script = HOLD_THE_LOCK.replace("with Project", "project = Project(Path(sys.argv[1]))\nwith project", 1)
    script = script.replace("project(Path(sys.argv[1])).locked()", "project.locked()")
    script = script.replace("Project(Path(sys.argv[1])).running", "project.running")
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(project.folder)], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_two_runs_do_not_work_in_one_survey(project: Project, other_run: subprocess.Popen[str]) -> None:
    with pytest.raises(InputError, match=f"process {other_run.pid} .* is at work in this survey"), project.locked():
        pytest.fail("the lock was given twice")
    assert standings(project)[1] == "running"


def test_the_lock_of_a_killed_run_is_no_lock(project: Project, other_run: subprocess.Popen[str]) -> None:
    other_run.send_signal(signal.SIGKILL)
    other_run.wait()
    assert standings(project) == ["missing", "missing", "missing"]
    with project.locked():
        pass


def test_the_lock_is_free_again_after_an_error(project: Project) -> None:
    with pytest.raises(InputError), project.locked():
        raise InputError("no")
    with project.locked():
        pass


def test_a_full_disk_does_not_break_the_lock(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lock's text only tells who holds it; without room for it the stage itself says that the disk is full."""

    def full(*_: Any) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with (
            project.locked(),
            pytest.raises(InputError, match="another run is at work"),
            Project(project.folder).locked(),
        ):
            pytest.fail("the lock was given twice")
    with project.locked():
        pass


class Counted:
    """A step that counts how often it is computed."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self) -> Arrays:
        self.count += 1
        return {
            "codes": np.arange(2000, dtype=np.uint8).reshape(50, 40),
            "xy": np.linspace(0, 1, 7),
            "none": np.zeros(0),
        }


def test_a_step_is_computed_once_and_found_again_by_a_new_run(tmp_path: Path) -> None:
    step = Counted()
    first = FolderCache(tmp_path / "c").arrays("codes of a.jpg", "key", step)
    again = FolderCache(tmp_path / "c").arrays("codes of a.jpg", "key", step)
    assert step.count == 1
    assert first.keys() == again.keys()
    for name, array in first.items():
        assert array.dtype == again[name].dtype
        assert np.array_equal(array, again[name])


def test_another_key_or_step_is_another_result(tmp_path: Path) -> None:
    step, cache = Counted(), FolderCache(tmp_path)
    for name, key in (("a/b", "k"), ("a_b", "k"), ("a/b", "l"), ("../../x", "k")):
        cache.arrays(name, key, step)
    assert step.count == 4
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize("damage", ["empty", "truncated", "flipped", "text", "folder"])
def test_a_damaged_file_is_computed_anew(tmp_path: Path, damage: str) -> None:
    step = Counted()
    FolderCache(tmp_path).arrays("s", "k", step)
    (path,) = tmp_path.iterdir()
    content = bytearray(path.read_bytes())
    middle = len(content) // 3
    content[middle] ^= 0xFF
    kinds = {"empty": b"", "truncated": bytes(content[:middle]), "flipped": bytes(content), "text": b"not a zip file"}
    if damage == "folder":
        path.unlink()
    else:
        path.write_bytes(kinds[damage])
    arrays = FolderCache(tmp_path).arrays("s", "k", step)
    assert step.count == 2
    assert np.array_equal(arrays["codes"].ravel(), np.arange(2000, dtype=np.uint8))
    FolderCache(tmp_path).arrays("s", "k", step)
    assert step.count == 2


def test_equal_arrays_give_equal_files(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        FolderCache(tmp_path / folder).arrays("s", "k", Counted())
    one, two = (next((tmp_path / folder).iterdir()) for folder in ("one", "two"))
    assert one.name == two.name
    assert one.read_bytes() == two.read_bytes()


def test_steps_of_earlier_options_are_forgotten_and_those_in_use_are_not(tmp_path: Path) -> None:
    step = Counted()
    FolderCache(tmp_path).arrays("s", "old", step)
    FolderCache(tmp_path).arrays("s", "found", step)
    cache = FolderCache(tmp_path)
    cache.arrays("s", "found", step)
    cache.arrays("s", "new", step)
    cache.forget_unused()
    assert step.count == 3
    assert len(list(tmp_path.iterdir())) == 2


def test_a_full_disk_says_how_to_go_on_and_keeps_what_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step, cache = Counted(), FolderCache(tmp_path)
    cache.arrays("s", "finished", step)

    def full(file: Path, **arrays: Any) -> None:
        file.write_bytes(b"half of")
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(InputError, match=r"disk is full.*free some space and run the same command again"):
            cache.arrays("s", "next", step)
    assert len(list(tmp_path.iterdir())) == 1
    cache.arrays("s", "finished", step)
    assert step.count == 2


def test_the_files_of_a_survey_are_readable_text(project: Project) -> None:
    do(project, Stage.INGEST)
    manifest = json.loads((project.folder / "manifest.json").read_text())
    assert manifest["originals"]["images"]["relative"] == "../images"
    state = json.loads((project.folder / "ingest" / "state.json").read_text())
    assert list(state["outputs"]) == ["ingest/result.txt"]
    assert set(state["inputs"]) == {"images: a.jpg", "images: b.jpg", "control_points: control.csv"}


def test_standing_words_are_those_that_the_user_reads() -> None:
    assert [standing.value for standing in Standing] == ["done", "out of date", "running", "missing"]
