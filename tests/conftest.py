"""A small simulated survey for all tests, made once in a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

    from uavkit.simulate.survey import Scene, SimulatedSurvey


@pytest.fixture(scope="session")
def smallest_scene() -> Scene:
    """Two stations over the crest, in memory."""
    from uavkit.core.records import FieldOrder
    from uavkit.simulate.options import SimulationOptions
    from uavkit.simulate.survey import make_scene

    return make_scene(
        SimulationOptions(
            scale=0.15,
            strips=1,
            stations_per_strip=2,
            frames_between_stills=30,
            field_order=FieldOrder.BOTTOM_FIRST,
            check_points=3,
            gnss_outliers=1,
            workers=2,
        )
    )


@pytest.fixture(scope="session")
def smallest_survey(smallest_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """The files of ``smallest_scene``: two stills of 600 x 450 and a video of some 80 frames."""
    from uavkit.simulate.survey import simulate_survey

    return simulate_survey(tmp_path_factory.mktemp("smallest_survey"), smallest_scene.options)


@pytest.fixture(scope="session")
def rtk_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a flight with RTK: twelve stills of 800 x 600 with stamps of whole seconds, no video."""
    from uavkit import workflow

    folder = tmp_path_factory.mktemp("rtk_flight")
    options = {
        "scale": 0.2,
        "strips": 2,
        "stations_per_strip": 6,
        "video_standard": "none",
        "gnss_sigma_m": 0.02,
        "gnss_outliers": 0,
        "check_points": 8,
        "workers": 2,
    }
    assert "positions.csv" in workflow.simulate(folder, options)
    return folder
