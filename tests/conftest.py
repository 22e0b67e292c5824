"""A small simulated survey for all tests, made once in a run."""

from pathlib import Path

import pytest

from uavkit.core.records import FieldOrder
from uavkit.simulate.options import SimulationOptions
from uavkit.simulate.survey import Scene, SimulatedSurvey, make_scene, simulate_survey

SMALLEST = SimulationOptions(
    scale=0.15,
    strips=1,
    stations_per_strip=2,
    frames_between_stills=30,
    field_order=FieldOrder.BOTTOM_FIRST,
    control_points=3,
    check_points=3,
    gnss_outliers=1,
    workers=2,
)


@pytest.fixture(scope="session")
def smallest_scene() -> Scene:
    """Two stations over the crest, in memory."""
    return make_scene(SMALLEST)


@pytest.fixture(scope="session")
def smallest_survey(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """The files of ``smallest_scene``: two stills of 600 x 450 and a video of some 80 frames."""
    folder: Path = tmp_path_factory.mktemp("smallest_survey")
    return simulate_survey(folder, SMALLEST)
