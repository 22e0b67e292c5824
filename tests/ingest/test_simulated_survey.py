"""The stage on a survey that ``uavkit.simulate`` renders: codec, noise, lens and all, against its truth."""

import json

import numpy as np
import pytest

from uavkit.core.frames import LocalFrame
from uavkit.core.records import FieldOrder, VideoFrame
from uavkit.formats.control_file import read_surveyed_points
from uavkit.formats.image_files import FileStillSource
from uavkit.formats.kml import KmlPositions
from uavkit.formats.video import FileVideoSource
from uavkit.ingest.build_block import Sources, build_block
from uavkit.ingest.video_sync import synchronise
from uavkit.simulate.options import FrozenPicture, SimulationOptions
from uavkit.simulate.survey import simulate_survey

pytestmark = pytest.mark.slow
FRAME_S = 1001 / 30000


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    options = SimulationOptions(
        seed=5, scale=0.2, strips=2, stations_per_strip=3, frames_between_stills=40, field_order=FieldOrder.TOP_FIRST,
        frozen_picture=FrozenPicture.REVIEW, check_points=2, gnss_outliers=1, workers=2,
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("survey")
    paths = simulate_survey(folder, options)
    truth = json.loads(paths.truth.read_text())
    return paths, truth, np.load(folder / "truth" / "field_poses.npz")["state"]


def true_places(truth, state):
    """Last and first usable frame and time of each exposure."""
    places = {}
    for exposure in truth["exposures"]:
        last = 2 * exposure["last_live_frame"] + exposure["last_live_field"]
        first = last + 1 + int(np.argmax(state[last + 1 :] == 0))
        places[exposure["image"]] = ((last - 1) // 2, (first + 1) // 2, exposure["video_time_s"])
    return places


def test_every_still_and_the_transformation(survey):
    paths, truth, state = survey
    stills, video = FileStillSource(paths.stills), FileVideoSource(paths.video)
    sync = synchronise(stills, stills.stills(), video).sync
    truth_of = true_places(truth, state)
    assert {place.still for place in sync.places} == set(truth_of)
    for place in sync.places:
        last, first, time_s = truth_of[place.still]
        assert (place.last_frame, place.first_frame) == (last, first)
        assert abs(place.exposure_time_ns * 1e-9 - time_s) < FRAME_S / 2
    assert sync.field_order is FieldOrder.TOP_FIRST
    true = truth["video"]["still_from_video"]
    corners = np.array([[0, 0], [639, 0], [0, 479], [639, 479]], dtype=float)
    off = sync.still_from_video.apply(corners) - (corners @ np.array(true["matrix"]).T + true["shift_px"])
    assert np.abs(off).max() < 0.3 * np.sqrt(np.linalg.det(np.array(true["matrix"])))


class Edited:
    """A decoded video with some of its frames replaced."""

    def __init__(self, video, edits):
        self.original, self.edits = video, edits

    def info(self):
        return self.original.info()

    def damage(self):
        return ()

    def fingerprint(self):
        return "edited"

    def frames(self, first=0, last=None):
        for frame in self.original.frames(first, last):
            new = self.edits.get(frame.index, frame.luminance)
            yield VideoFrame(index=frame.index, time_ns=frame.time_ns, luminance=new)


@pytest.mark.parametrize("lost", [0, 3, 5])
def test_a_lost_and_a_false_event_shift_nothing(survey, lost):
    paths, truth, state = survey
    stills, video = FileStillSource(paths.stills), FileVideoSource(paths.video)
    truth_of = true_places(truth, state)
    frames = {frame.index: frame.luminance for frame in video.frames()}
    last, first, _ = list(truth_of.values())[lost]
    # the approach back again, and the departure beforehand, in place of what the shutter hid
    middle = (last + first) // 2
    edits = {n: frames[2 * last - n] if n <= middle else frames[2 * first - n] for n in range(last + 1, first)}
    false = list(truth_of.values())[2][1] + 6
    edits |= {n: np.full_like(frames[0], 16) for n in range(false, false + 5)}
    sync = synchronise(stills, stills.stills(), Edited(video, edits)).sync
    assert len(sync.places) >= 5
    for place in sync.places:
        if place.kind != "content":
            assert place.last_frame == truth_of[place.still][0]
        else:
            assert abs(place.exposure_time_ns * 1e-9 - truth_of[place.still][2]) < 20 * FRAME_S
    assert len(sync.events_without_still) == 1


def test_a_truncated_file_is_used_as_far_as_it_goes(survey, tmp_path):
    paths, truth, state = survey
    content = paths.video.read_bytes()
    (tmp_path / "cut.avi").write_bytes(content[: int(0.6 * len(content))])
    stills = FileStillSource(paths.stills)
    outcome = synchronise(stills, stills.stills(), FileVideoSource(tmp_path / "cut.avi"))
    truth_of = true_places(truth, state)
    assert 2 <= len(outcome.sync.places) < 6
    assert all(place.last_frame == truth_of[place.still][0] for place in outcome.sync.places)
    assert any(note.startswith("video: ") for note in outcome.notes)


def test_the_whole_block(survey):
    paths, truth, _ = survey
    block = build_block(
        Sources(
            stills=FileStillSource(paths.stills),
            video=FileVideoSource(paths.video),
            positions=KmlPositions(paths.positions),
            control=read_surveyed_points(paths.control_points),
            check=read_surveyed_points(paths.check_points),
        )
    )
    true = truth["frame"]
    frame = LocalFrame.at(true["latitude_deg"], true["longitude_deg"], true["height_ellipsoid_m"], true["crs"])

    def here(enu):
        return block.frame.enu_from_geographic(*frame.geographic_from_enu(np.atleast_2d(enu)).T)

    centres = {exposure["image"]: exposure["projection_centre_m"] for exposure in truth["exposures"]}
    names = [block.stills[index].name for index in block.gnss.image_index]
    difference = block.gnss.position_m - here([centres[name] for name in names]) - truth["gnss"]["shift_m"]
    good = [name not in truth["gnss"]["outliers"] for name in names]
    assert len(names) == 6
    assert np.abs(difference[good]).max() < 5.0  # five sigma; a shift by one station is 7 m
    for point, known in zip(block.control_points, truth["control_points"], strict=True):
        assert np.allclose(point.position_m, here(known["position_m"])[0], atol=0.03)  # six sigma
    assert block.camera.name == "Ricoh GX200"
    assert len(block.video.places) == 6
