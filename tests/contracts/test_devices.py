"""What every filling of a device Protocol promises, whether simulated or read from files."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from uavkit.core.devices import (
    Autopilot,
    Clock,
    ExposureSource,
    GnssReceiver,
    StillSource,
    StillTrigger,
    VideoSource,
)
from uavkit.core.errors import DeviceError, InputError
from uavkit.core.heights import HeightDatum
from uavkit.core.records import FieldOrder, GnssFix
from uavkit.formats.image_files import FileStillSource
from uavkit.formats.kml import KmlPositions
from uavkit.formats.video import FileVideoSource
from uavkit.simulate import devices
from uavkit.simulate.survey import Scene, SimulatedSurvey

STILL_SOURCES: dict[str, Callable[[Scene, SimulatedSurvey], StillSource]] = {
    "simulated": lambda scene, _: devices.SimulatedStills(scene),
    "files": lambda _, survey: FileStillSource(survey.stills),
}
VIDEO_SOURCES: dict[str, Callable[[Scene, SimulatedSurvey], VideoSource]] = {
    "simulated": lambda scene, _: devices.SimulatedVideo(scene),
    "file": lambda _, survey: FileVideoSource(survey.video),
}
GNSS_RECEIVERS: dict[str, Callable[[Scene, SimulatedSurvey], GnssReceiver]] = {
    "simulated waypoints": lambda scene, _: devices.SimulatedWaypoints(scene),
    "simulated receiver": lambda scene, _: devices.SimulatedReceiver(scene),
    "kml": lambda _, survey: KmlPositions(survey.positions),
}
EXPOSURE_SOURCES: dict[str, Callable[[Scene], ExposureSource]] = {"simulated": devices.SimulatedExposures}


@pytest.mark.parametrize("filling", STILL_SOURCES)
def test_still_source(filling: str, smallest_scene: Scene, smallest_survey: SimulatedSurvey) -> None:
    source = STILL_SOURCES[filling](smallest_scene, smallest_survey)
    assert isinstance(source, StillSource)
    infos = source.stills()
    assert [info.name for info in infos] == list(smallest_scene.names)
    assert len({source.fingerprint(info.name) for info in infos}) == len(infos)
    for info in infos:
        grey, colour = source.grey(info.name), source.colour(info.name)
        assert grey.shape == (info.height_px, info.width_px)
        assert colour.shape == (*grey.shape, 3)
        assert grey.dtype == colour.dtype == np.uint8
        luminance = colour @ np.array([0.299, 0.587, 0.114])
        assert abs(float(np.mean(grey - luminance))) < 1.0  # red first: blue first would shift the mean
        assert info.position is None
        assert info.camera_time_ns is not None
        assert info.camera_time_ns % 1_000_000_000 == 0
        assert source.fingerprint(info.name) == source.fingerprint(info.name)
    with pytest.raises(InputError, match="R0019999"):
        source.grey("R0019999.JPG")


def test_simulated_and_written_stills_agree(smallest_scene: Scene, smallest_survey: SimulatedSurvey) -> None:
    simulated, files = (make(smallest_scene, smallest_survey) for make in STILL_SOURCES.values())
    for one, other in zip(simulated.stills(), files.stills(), strict=True):
        assert one == other
        gap = simulated.grey(one.name).astype(float) - files.grey(one.name)
        assert np.sqrt(np.mean(gap**2)) < 4.0  # the losses of JPEG


@pytest.mark.parametrize("filling", VIDEO_SOURCES)
def test_video_source(filling: str, smallest_scene: Scene, smallest_survey: SimulatedSurvey) -> None:
    source = VIDEO_SOURCES[filling](smallest_scene, smallest_survey)
    assert isinstance(source, VideoSource)
    info = source.info()
    assert (info.width_px, info.height_px) == (640, 480)
    assert abs(info.frame_interval_ns - 33_366_667) <= 1
    assert info.field_order in (FieldOrder.BOTTOM_FIRST, None)
    assert info.frame_count == smallest_scene.finder().frame_count
    some = list(source.frames(5, 9))
    assert [frame.index for frame in some] == [5, 6, 7, 8, 9]
    for frame in some:
        assert abs(frame.time_ns - frame.index * info.frame_interval_ns) <= frame.index + 1
        assert frame.luminance.shape == (480, 640)
        assert frame.luminance.dtype == np.uint8
    assert list(source.frames(10**6)) == []
    assert np.array_equal(next(iter(source.frames(7))).luminance, some[2].luminance)  # the same whenever asked for
    assert source.damage() == ()
    assert source.fingerprint() == source.fingerprint()


@pytest.mark.parametrize("filling", GNSS_RECEIVERS)
def test_gnss_receiver(filling: str, smallest_scene: Scene, smallest_survey: SimulatedSurvey) -> None:
    receiver = GNSS_RECEIVERS[filling](smallest_scene, smallest_survey)
    assert isinstance(receiver, GnssReceiver)
    fixes = list(receiver.fixes())
    assert len(fixes) >= len(smallest_scene.names)
    times = [fix.gps_time_ns for fix in fixes]
    known = [time for time in times if time is not None]
    assert len(known) in (0, len(fixes))  # a receiver knows its times or it does not
    assert all(later > earlier for earlier, later in pairwise(known))
    for fix in fixes:
        assert abs(fix.latitude_deg - 35.8) < 0.001
        assert abs(fix.longitude_deg - 139.65) < 0.001
        assert fix.height_datum in (HeightDatum.ELLIPSOID, HeightDatum.GEOID)
        assert fix.gps_time_ns != 0
        assert fix.sigma_horizontal_m is None or fix.sigma_horizontal_m > 0


def test_waypoints_in_the_file_are_those_of_the_receiver(
    smallest_scene: Scene, smallest_survey: SimulatedSurvey
) -> None:
    """The file's heights count from the geoid, some 36 to 40 m above the ellipsoid there."""
    simulated = list(devices.SimulatedWaypoints(smallest_scene).fixes())
    written = list(KmlPositions(smallest_survey.positions).fixes())
    for one, other in zip(simulated, written, strict=True):
        assert abs(one.latitude_deg - other.latitude_deg) < 1e-7
        assert abs(one.longitude_deg - other.longitude_deg) < 1e-7
        assert other.height_datum is HeightDatum.GEOID
        assert 30.0 < one.height_m - other.height_m < 45.0


@pytest.mark.parametrize("filling", EXPOSURE_SOURCES)
def test_exposure_source(filling: str, smallest_scene: Scene) -> None:
    source = EXPOSURE_SOURCES[filling](smallest_scene)
    assert isinstance(source, ExposureSource)
    times = [event.gps_time_ns for event in source.exposures()]
    assert len(times) == len(smallest_scene.names)
    assert all(later > earlier for earlier, later in pairwise(times))


def test_clock_and_trigger() -> None:
    clock = devices.SimulatedClock(5)
    trigger = devices.SimulatedTrigger(clock, least_interval_s=1.0)
    assert isinstance(clock, Clock)
    assert isinstance(trigger, StillTrigger)
    assert trigger.trigger() == 5
    clock.advance(0.5)
    with pytest.raises(DeviceError, match="busy"):
        trigger.trigger()
    clock.advance(0.5)
    assert trigger.trigger() == 1_000_000_005
    with pytest.raises(ValueError, match="backwards"):
        clock.advance(-1.0)
    assert clock.now_ns() == 1_000_000_005


def _waypoint(latitude_deg: float, datum: HeightDatum) -> GnssFix:
    return GnssFix(
        gps_time_ns=None, latitude_deg=latitude_deg, longitude_deg=139.65, height_m=60.0, height_datum=datum, name="W"
    )


def test_autopilot_moves_only_when_confirmed_and_stops_when_told() -> None:
    clock = devices.SimulatedClock()
    pilot = devices.SimulatedAutopilot("falcon", clock, speed_m_per_s=4.0)
    assert isinstance(pilot, Autopilot)
    pilot.abort()  # in any state
    with pytest.raises(DeviceError, match="not flying"):
        next(pilot.positions())
    with pytest.raises(DeviceError, match="no mission"):
        pilot.start("falcon")
    with pytest.raises(DeviceError, match="datum"):
        pilot.upload((_waypoint(35.8, HeightDatum.UNKNOWN), _waypoint(35.8001, HeightDatum.UNKNOWN)))
    mission = (_waypoint(35.8, HeightDatum.GEOID), _waypoint(35.8002, HeightDatum.GEOID))
    pilot.upload(mission)
    with pytest.raises(DeviceError, match="confirmation"):
        pilot.start("yes")
    pilot.start("falcon")
    with pytest.raises(DeviceError, match="flying"):
        pilot.upload(mission)
    places = list(pilot.positions())
    assert places[0] == mission[0]
    assert places[-1] == mission[1]
    assert all(place.gps_time_ns is None for place in places)
    assert 5.0 < clock.now_ns() * 1e-9 < 7.0  # 22 m at 4 m/s
    pilot.start("falcon")
    positions = pilot.positions()
    next(positions)
    pilot.abort()
    assert list(positions) == []
