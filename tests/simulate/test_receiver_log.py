"""The simulated receiver's recording, read back by the reader and by another program."""

from pathlib import Path

import numpy as np
import pytest

from uavkit.core.flight_log import ExposureKind, FixType
from uavkit.formats.flight_logs import open_log
from uavkit.simulate.receiver_log import FEEDBACK_LATENCY_S
from uavkit.simulate.site import gps_time_ns, site_frame
from uavkit.simulate.survey import Scene, SimulatedSurvey


def test_fixes_and_marks_are_those_of_the_flight(smallest_scene: Scene, smallest_survey: SimulatedSurvey) -> None:
    log = open_log(smallest_survey.receiver_log)
    flight, fixes, marks = smallest_scene.flight, log.fix_table, log.exposure_table
    assert log.damage.lost_bytes == 0
    assert set(marks.kind.tolist()) == {ExposureKind.MARK}
    wanted_ns = [gps_time_ns(time_s + FEEDBACK_LATENCY_S) for time_s in flight.exposure_s.tolist()]
    assert np.abs(marks.when.gps_ns - wanted_ns).max() < 300
    assert np.diff(fixes.when.gps_ns).tolist() == [200_000_000] * (len(fixes) - 1)
    time_s = (fixes.when.gps_ns - gps_time_ns(0.0)) * 1e-9
    true_m = flight.positions_m(time_s)
    told_m = site_frame().enu_from_geographic(fixes.latitude_deg, fixes.longitude_deg, fixes.height_ellipsoid_m)
    error_m = told_m - true_m - smallest_scene.waypoints.shift_m
    sigma_m = smallest_scene.options.gnss_sigma_m
    assert np.std(error_m) == pytest.approx(sigma_m, rel=4.0 / np.sqrt(2.0 * error_m.size))
    assert fixes.sigma_horizontal_m == pytest.approx(sigma_m, rel=1e-3)
    assert fixes.sigma_vertical_m == pytest.approx(sigma_m, rel=1e-3)
    moved_m = flight.positions_m(time_s + 0.01) - flight.positions_m(time_s - 0.01)
    assert np.median(np.abs(fixes.velocity_m_s - moved_m / 0.02)) < 0.2
    assert set(fixes.fix_type.tolist()) == {FixType.THREE_DIMENSIONAL}
    assert np.median(fixes.height_ellipsoid_m - fixes.height_geoid_m) == pytest.approx(37.5, abs=2.0)


def test_another_program_reads_it_too(smallest_survey: SimulatedSurvey) -> None:
    pyubx2 = pytest.importorskip("pyubx2")
    with Path(smallest_survey.receiver_log).open("rb") as stream:
        messages = [message for _, message in pyubx2.UBXReader(stream, quitonerror=2)]
    log = open_log(smallest_survey.receiver_log)
    assert sum(message.identity == "TIM-TM2" for message in messages) == len(log.exposure_table)
    pvt = [message for message in messages if message.identity == "NAV-PVT"]
    assert [(m.lat, m.lon) for m in pvt] == [
        pytest.approx(place, abs=1.01e-7)
        for place in zip(log.fix_table.latitude_deg, log.fix_table.longitude_deg, strict=True)
    ]
