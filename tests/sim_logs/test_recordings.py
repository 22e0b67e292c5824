"""Recorded flights are what their ABOUT.toml says, to the last byte."""

import hashlib
import json
import tomllib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from uavkit.core.frames import LocalFrame

SIM_LOGS = Path(__file__).resolve().parents[2] / "sim_logs"
RECORDINGS = sorted(path.parent for path in SIM_LOGS.glob("*/ABOUT.toml"))


def test_every_folder_has_its_about_file_and_there_are_some() -> None:
    assert RECORDINGS
    assert sorted(path for path in SIM_LOGS.iterdir() if path.is_dir()) == RECORDINGS


@pytest.mark.parametrize("folder", RECORDINGS, ids=lambda folder: folder.name)
def test_checksums_hold_and_no_file_is_unnamed(folder: Path) -> None:
    about = tomllib.loads((folder / "ABOUT.toml").read_text(encoding="utf-8"))
    assert about["origin"].strip()
    assert about["truth"].strip()
    files = {path.name: path for path in folder.iterdir() if path.name != "ABOUT.toml"}
    assert files.keys() == about["sha256"].keys()
    for name, path in files.items():
        assert hashlib.sha256(path.read_bytes()).hexdigest() == about["sha256"][name], name
        assert path.stat().st_size < 300_000, name


def test_the_distance_triggered_flight_covers_its_site() -> None:
    """31 exposures at 15 m over 80 m x 40 m; on the legs they follow one another by the trigger distance of 12.7 m."""
    folder = SIM_LOGS / "sitl_distance_trigger"
    exposures = json.loads((folder / "exposures.json").read_text(encoding="utf-8"))["camera_feedback"]
    about = tomllib.loads((folder / "ABOUT.toml").read_text(encoding="utf-8"))
    assert len(exposures) == about["exposures"] == 31
    heights_m = np.array([row["alt_rel"] for row in exposures])
    assert np.abs(heights_m - 15.0).max() < 0.5
    frame = LocalFrame.at(35.8, 139.65, 20.0)
    latitude, longitude = (np.array([row[name] for row in exposures]) * 1e-7 for name in ("lat", "lng"))
    east_north = frame.enu_from_geographic(latitude, longitude, np.full(31, 20.0))[:, :2]
    assert np.ptp(east_north, axis=0) == pytest.approx([40.0, 75.0], abs=6.0)
    steps_m = [float(np.linalg.norm(later - earlier)) for earlier, later in pairwise(east_north)]
    assert np.median(steps_m) == pytest.approx(12.7, abs=0.5)
