"""Synchronising stills and video: every still at its place or named, never shifted."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from tests.ingest.synthetic import INTERVAL_NS, MemoryStills, MemoryVideo, make_flight
from uavkit.core.records import FieldOrder
from uavkit.ingest.shutter_events import estimated_field_order, find_shutter_events, scan_video
from uavkit.ingest.video_sync import SyncOptions, synchronise


@lru_cache(maxsize=3)
def flight(**kinds):
    return make_flight(**kinds)


def sync(made, video=None):
    return synchronise(made.stills, made.stills.infos, video or made.video())


def check_places(outcome, made, tolerance_frames=0):
    """Every place that is told must be the true one."""
    truth = {i.name: n for n, i in enumerate(made.stills.infos)}
    for place in outcome.sync.places:
        n = truth[place.still]
        if place.kind == "content":
            # a hovering camera shows the same for many frames: what counts is where it was
            assert np.linalg.norm(made.centre(place.exposure_time_ns) - made.centre(made.exposure_ns[n])) < 10.0
            continue
        assert abs(place.last_frame - made.last_frame[n]) <= tolerance_frames
        assert -tolerance_frames <= place.first_frame - made.first_frame[n] <= 2 + tolerance_frames
        assert abs(place.exposure_time_ns - made.exposure_ns[n]) < INTERVAL_NS * (0.5 + tolerance_frames)
    return {place.still: place for place in outcome.sync.places}


def test_every_still_at_its_place_and_the_transformation_within_a_tenth_of_a_video_pixel():
    made = flight(seed=1)
    outcome = sync(made)
    assert len(check_places(outcome, made)) == 7
    assert outcome.sync.field_order is FieldOrder.BOTTOM_FIRST
    assert outcome.sync.stills_without_event == ()
    assert outcome.sync.events_without_still == ()
    assert all(place.kind == "black" and place.confidence > 0.99 for place in outcome.sync.places)
    corners = np.array([[0, 0], [639, 0], [0, 479], [639, 479]], dtype=float)
    off = outcome.sync.still_from_video.apply(corners) - (corners @ made.matrix.T + made.shift)
    assert np.abs(off).max() < 0.15 * 2.4
    assert outcome.sync.residual_px < 0.5 * 2.4


@pytest.mark.parametrize("order", [FieldOrder.TOP_FIRST, FieldOrder.BOTTOM_FIRST, FieldOrder.PROGRESSIVE])
def test_field_order_is_found_and_checked(order):
    made = make_flight(seed=3, stations=3, order=order)
    scan = scan_video(made.video(), lambda *_: None)
    assert estimated_field_order(scan) is order
    if order is FieldOrder.TOP_FIRST:
        outcome = sync(made, made.video(order=FieldOrder.BOTTOM_FIRST))
        assert outcome.sync.field_order is FieldOrder.TOP_FIRST
        assert "source says bottom" in " ".join(outcome.notes)


@pytest.mark.parametrize("lost", [0, 3, 6])
def test_a_lost_event_is_found_by_content_or_named(lost):
    made = flight(seed=1)
    outcome = sync(made, made.without_event(lost).video())
    places = check_places(outcome, made)
    name = made.stills.infos[lost].name
    assert len(places) >= 6
    if name in places:
        assert places[name].kind == "content"
    else:
        assert name in outcome.sync.stills_without_event


@pytest.mark.parametrize("where", [3, 148, 205])
def test_a_false_event_is_named(where):
    made = flight(seed=1)
    outcome = sync(made, made.with_false_event(where).video())
    assert len(check_places(outcome, made)) == 7
    assert outcome.sync.events_without_still == (where,)


@pytest.mark.parametrize("removed", [0, 2, 6])
def test_the_event_of_a_removed_still_is_named(removed):
    whole = flight(seed=1)
    made = whole.without_still(removed)
    outcome = sync(made)
    assert len(check_places(outcome, made)) == 6
    assert abs(outcome.sync.events_without_still[0] - whole.last_frame[removed]) <= 1


def test_lost_event_false_event_and_shifted_clock_together():
    made = make_flight(seed=8, stations=6, clock_offset_s=-86_400.37)
    damaged = made.without_event(2).with_false_event(made.first_frame[4] + 8, length=6)
    outcome = sync(made, damaged.video())
    assert len(check_places(outcome, made)) >= 5
    assert len(outcome.sync.events_without_still) == 1


@pytest.mark.parametrize("lost", [0, 4])
def test_regular_intervals_are_settled_by_content(lost):
    made = flight(seed=5, gap=(40, 40), stations=5)
    outcome = sync(made, made.without_event(lost).video())
    assert len(check_places(outcome, made)) >= 4


def test_stills_without_times_are_settled_by_content():
    made = flight(seed=1)
    infos = [replace(info, camera_time_ns=None) for info in made.stills.infos]
    timeless = replace(made, stills=MemoryStills(infos, made.stills.pictures))
    assert len(check_places(sync(timeless, made.without_event(1).video()), timeless)) >= 6


def test_frozen_pictures_without_black_are_events():
    made = make_flight(seed=6, black=None, stations=5)
    outcome = sync(made)
    assert len(check_places(outcome, made, tolerance_frames=2)) == 5
    assert {place.kind for place in outcome.sync.places} == {"frozen"}


def test_video_without_shutter_places_stills_by_content_alone():
    made = make_flight(seed=7, black=None, frozen=None, stations=3)
    outcome = sync(made)
    places = check_places(outcome, made)
    assert len(places) == 3
    assert {place.kind for place in places.values()} == {"content"}
    assert 0.0 < outcome.sync.residual_px < 3.0 * 2.4
    assert any("shows no shutter" in note for note in outcome.notes)


def test_the_video_of_another_flight_is_not_used():
    made, other = flight(seed=1), make_flight(seed=9, stations=4)
    outcome = sync(made, other.video())
    assert outcome.sync is None
    assert "is it the video of this flight?" in outcome.notes[-1]


def test_a_video_of_nothing_is_not_used():
    made = flight(seed=1)
    rng = np.random.default_rng(0)
    frames = [rng.integers(98, 103, (480, 640)).astype(np.uint8) for _ in range(30)]
    outcome = sync(made, MemoryVideo(frames))
    assert outcome.sync is None
    assert "video not used because" in outcome.notes[-1]
    assert sync(made, MemoryVideo(frames[:5])).sync is None


def test_truncated_video_places_what_it_holds_and_names_the_rest():
    made = flight(seed=1)
    cut = MemoryVideo(made.frames[: made.last_frame[5] + 4], damage=("the end of the file is missing",))
    outcome = sync(made, cut)
    places = check_places(outcome, made)
    assert len(places) >= 5
    assert "R006.jpg" in outcome.sync.stills_without_event
    assert "video: the end of the file is missing" in outcome.notes


def test_a_still_that_cannot_be_decoded_is_named_and_shifts_nothing():
    made = flight(seed=1)
    stills = MemoryStills(made.stills.infos, made.stills.pictures, broken={"R002.jpg"})
    outcome = synchronise(stills, stills.infos, made.video())
    assert len(check_places(outcome, made)) == 6
    assert any("R002.jpg has no place in the video" in note for note in outcome.notes)


def test_events_are_told_to_the_field():
    made = flight(seed=1)
    scan = scan_video(made.video(), lambda *_: None)
    events = find_shutter_events(scan, FieldOrder.BOTTOM_FIRST, INTERVAL_NS)
    assert [event.last_frame for event in events] == made.last_frame
    assert np.abs(np.array([e.exposure_time_ns for e in events]) - made.exposure_ns).max() < INTERVAL_NS / 4


def test_options_are_used():
    made = flight(seed=1)
    outcome = synchronise(made.stills, made.stills.infos, made.video(), options=SyncOptions(wanted_probability=1.0))
    assert outcome.sync.places == ()
    assert any("ambiguous and left open" in note for note in outcome.notes)
