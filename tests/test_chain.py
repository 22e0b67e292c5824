"""The whole chain on a small simulated survey: as good as it says, killed and gone on, the same with other threads."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uavkit import workflow
from uavkit.core.result import OrientedBlock
from uavkit.project import IngestOptions, Project, Standing

ROOT = Path(__file__).resolve().parents[1]
SMALL: Mapping[str, Any] = {
    "scale": 0.25,
    "strips": 2,
    "stations_per_strip": 4,
    "video_standard": "none",
    "gnss_outliers": 0,
    "workers": 2,
}


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a simulated flight of eight stills without video."""
    folder = tmp_path_factory.mktemp("flight")
    workflow.simulate(folder, SMALL)
    return folder


def new_survey(flight: Path, folder: Path) -> Project:
    """Ingest the flight."""
    project = Project(folder)
    originals = {
        "images": flight / "stills",
        "positions": flight / "positions.kml",
        "control_points": flight / "control_points.csv",
        "check_points": flight / "check_points.csv",
    }
    workflow.begin_survey(project, originals, IngestOptions())
    workflow.ingest(project)
    return project


@pytest.fixture(scope="module")
def survey(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Project:
    """Return a survey whose processing was killed as soon as its first step was kept."""
    project = new_survey(flight, tmp_path_factory.mktemp("survey"))
    command = [sys.executable, "-m", "uavkit.cli", "process", str(project.folder), "--workers", "2"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    running = subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.DEVNULL)
    cache = project.folder / "process" / "cache"
    deadline_s = time.monotonic() + 300.0
    while not any(cache.glob("features*.npz")) and time.monotonic() < deadline_s:
        time.sleep(0.02)
    running.send_signal(signal.SIGKILL)
    running.wait()
    return project


def same(one: Any, other: Any) -> bool:
    """Tell whether two results are the same to the last bit, but for times and memory."""
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.tobytes() == other.tobytes()
    if is_dataclass(one) and not isinstance(one, type):
        names = [field.name for field in fields(one) if field.name not in ("seconds", "peak_memory_mb")]
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(value, other[name]) for name, value in one.items())
    return bool(one == other)


def test_a_killed_run_says_so_goes_on_and_is_as_good_as_it_says(survey: Project) -> None:
    before = {entry.stage.value: entry for entry in survey.status()}
    assert before["process"].standing is Standing.MISSING
    assert before["process"].why == "not finished; the steps that were are kept"
    (kept,) = (survey.folder / "process" / "cache").glob("features*.npz")
    written_ns = kept.stat().st_mtime_ns
    assert workflow.run(survey, workers=2) == ["process", "report"]
    assert kept.stat().st_mtime_ns == written_ns  # found again, not computed again
    assert {entry.standing for entry in survey.status()} == {Standing.DONE}
    assert workflow.run(survey) == []
    judge(workflow.oriented_block(survey))
    assert "</html>" in workflow.report_page(survey).read_text(encoding="utf-8")


def judge(result: OrientedBlock) -> None:
    """Check points lie within what the adjustment predicts: chi-square of all their coordinates, 0.1 % each side."""
    assert result.unoriented == {}
    assert len(result.images) == 8
    assert len(result.check) >= 3
    difference = np.array([point.difference_m for point in result.check])
    assert np.isfinite(difference).all()
    chi_square = difference.ravel() @ np.linalg.solve(result.check_covariance_m2, difference.ravel())
    spread = 3.1 * np.sqrt(2.0 * difference.size)
    assert abs(chi_square - difference.size) < spread
    assert 0.7 < result.adjustment.sigma0 < 1.4


def test_the_result_can_be_given_to_other_programs(survey: Project) -> None:
    workflow.run(survey, workers=2)
    for target, count in (("colmap", 3), ("ply", 1), ("las", 1), ("laz", 1)):
        files = workflow.export(survey, target, survey.folder / "export")
        assert len(files) == count
        assert all(path.stat().st_size > 0 for path in files)


@pytest.mark.slow
def test_another_run_with_one_thread_gives_the_same_to_the_last_bit(
    survey: Project, flight: Path, tmp_path: Path
) -> None:
    workflow.run(survey, workers=2)
    again = new_survey(flight, tmp_path / "again")
    workflow.process(again, workers=1)
    assert same(workflow.oriented_block(again), workflow.oriented_block(survey))


@pytest.mark.slow
def test_the_demonstration_with_video_reaches_its_report(tmp_path: Path) -> None:
    project, done = workflow.demo(tmp_path, workers=2)
    assert done == ["ingest", "process", "report"]
    result = workflow.oriented_block(project)
    assert result.unoriented == {}
    assert result.block.video is not None
    assert result.video_share > 0.5
    assert workflow.report_page(project).is_file()
