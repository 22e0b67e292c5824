"""The flight that the method was made for: 33 waypoints, 33 stills, a video with 31 shutters and 2 false ones."""

from types import SimpleNamespace

import numpy as np

from tests.ingest.synthetic import make_flight
from tests.ingest.test_build_block import STATIONS, Positions, camera
from tests.ingest.test_video_sync import check_places
from uavkit.ingest.build_block import Sources, build_block


def test_33_waypoints_33_stills_31_shutters_and_2_false_ones():
    """The KML gives each still its own position, the video 31 of them by the shutter and the others by content."""
    made = make_flight(seed=12, stations=33, gap=(46, 56), step_px=110.0, scale=1.2, still_size=(800, 600))
    damaged = made.without_event(9).without_event(23)
    damaged = damaged.with_false_event(made.first_frame[4] + 7, 4).with_false_event(made.first_frame[28] + 7, 4)
    stations = STATIONS[0] + np.arange(33)[:, None] * (STATIONS[1] - STATIONS[0])
    block = build_block(
        Sources(stills=made.stills, video=damaged.video(), positions=Positions(stations)),
        camera(800, 600),
        progress=lambda *_: None,
    )
    assert block.gnss is not None
    assert block.gnss.image_index.tolist() == list(range(33))
    wanted_m = stations - stations.mean(axis=0)
    assert np.abs(block.gnss.position_m - block.gnss.position_m.mean(axis=0) - wanted_m).max() < 0.01
    assert block.video is not None
    places = check_places(SimpleNamespace(sync=block.video), made)
    assert len(places) == 33
    by_shutter = [name for name, place in places.items() if place.kind != "content"]
    assert len(by_shutter) == 31
    assert {info.name for n, info in enumerate(made.stills.infos) if n in (9, 23)}.isdisjoint(by_shutter)
    assert len(block.video.events_without_still) == 2
