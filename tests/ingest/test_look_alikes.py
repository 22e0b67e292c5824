"""Stills that look alike, or show hardly anything: their places follow from times and tone, and are never wrong."""

import cv2
import numpy as np
import pytest

from tests.ingest import synthetic
from tests.ingest.synthetic import MemoryStills, make_flight
from uavkit.core.errors import InputError
from uavkit.core.records import StillInfo
from uavkit.ingest.still_matching import prepare_stills
from uavkit.ingest.stills import check_overlap
from uavkit.ingest.video_sync import synchronise


def crop(rng, shape):
    """Rows of like plants, and faint tone that does not repeat."""
    y, x = np.indices(shape, dtype=np.float32)
    rows = np.cos(2 * np.pi * y / 19) * (1 + np.cos(2 * np.pi * x / 11))
    return np.clip(110 + 25 * rows + faint_tone(rng, shape), 18, 235).astype(np.uint8)


def bare_crop(rng, shape):
    """The same without tone: nothing tells one place from another."""
    y, x = np.indices(shape, dtype=np.float32)
    rows = np.cos(2 * np.pi * y / 19) * (1 + np.cos(2 * np.pi * x / 11))
    return np.clip(110 + 25 * rows, 18, 235).astype(np.uint8)


def faint_tone(rng, shape):
    tone = np.zeros(shape, dtype=np.float32)
    for size in (20, 60):
        coarse = rng.normal(size=(shape[0] // size + 3, shape[1] // size + 3)).astype(np.float32)
        tone += 3.0 * cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return tone


def sand(rng, shape):
    """Hardly any contrast."""
    return np.clip(120 + 0.7 * faint_tone(rng, shape), 18, 235).astype(np.uint8)


def places_of(made):
    """Places that are told, by the number of the still; each must be the true one."""
    outcome = synchronise(made.stills, made.stills.infos, made.video())
    number = {info.name: n for n, info in enumerate(made.stills.infos)}
    places = outcome.sync.places if outcome.sync is not None else ()
    for place in places:
        assert place.last_frame == made.last_frame[number[place.still]]
    return outcome, places


@pytest.mark.parametrize("ground", [crop, sand])
def test_times_and_tone_place_what_detail_cannot(monkeypatch, ground):
    monkeypatch.setattr(synthetic, "texture", ground)
    made = make_flight(seed=4, gap=(30, 90), resolution_s=0.1)
    outcome, places = places_of(made)
    assert len(places) == 7, outcome.notes
    corners = np.array([[0, 0], [639, 0], [0, 479], [639, 479]], dtype=float)
    off = outcome.sync.still_from_video.apply(corners) - (corners @ made.matrix.T + made.shift)
    assert np.abs(off).max() < 3.0 * 2.4  # within the search of tracking, 3 video pixels


@pytest.mark.parametrize(
    ("ground", "lost"),
    [
        (crop, 0),
        (bare_crop, 3),
        (crop, 6),
        pytest.param(bare_crop, 0, marks=pytest.mark.slow),
        pytest.param(crop, 3, marks=pytest.mark.slow),
        pytest.param(bare_crop, 6, marks=pytest.mark.slow),
    ],
)
def test_a_lost_event_among_look_alikes_shifts_no_other_place(monkeypatch, ground, lost):
    monkeypatch.setattr(synthetic, "texture", ground)
    _, places = places_of(make_flight(seed=5).without_still(lost))
    assert all(place.confidence <= 1.0 for place in places)


def test_faint_stills_are_a_note_with_a_video_and_an_error_without():
    infos = [StillInfo(name=f"{k}.jpg", width_px=800, height_px=600) for k in range(3)]
    stills = MemoryStills(infos, {info.name: np.full((600, 800), 128, np.uint8) for info in infos})
    pictures = prepare_stills(stills, infos, 640, lambda *_: None).pictures
    with pytest.raises(InputError, match="show the same ground"):
        check_overlap(infos, pictures)
    (note,) = check_overlap(infos, pictures, make_flight(stations=2).video())
    assert "the video must" in note
