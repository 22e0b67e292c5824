"""Joining positions with stills: by order with care, never shifted."""

import numpy as np
import pytest

from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix, StillInfo
from uavkit.ingest.positions import PositionOptions, exif_positions, fix_sigmas, join_positions

DEGREES = 1 / 111_320.0


def fix(east, north, **more):
    return GnssFix(
        gps_time_ns=more.pop("time_ns", None),
        latitude_deg=35.8 + north * DEGREES,
        longitude_deg=139.65 + east * DEGREES / np.cos(np.radians(35.8)),
        height_m=60.0,
        height_datum=HeightDatum.ELLIPSOID,
        **more,
    )


def flight(seed, strips=3, stations=11, sigma_m=1.0, outliers=3, turn=2.2):
    """Stills with times in whole seconds, and a true position of each."""
    rng = np.random.default_rng(seed)
    gaps = 3.0 * rng.uniform(0.85, 1.15, strips * stations - 1)
    gaps[stations - 1 :: stations] *= turn
    times = 1000 + np.concatenate([[0], np.cumsum(gaps)])
    infos = [
        StillInfo(name=f"R{k:04d}.JPG", width_px=400, height_px=300, camera_time_ns=int(t) * 10**9)
        for k, t in enumerate(times)
    ]
    place = np.array(
        [[7.0 * (s if r % 2 == 0 else stations - 1 - s), 9.0 * r] for r in range(strips) for s in range(stations)]
    )
    place += rng.normal(0, sigma_m, place.shape)
    for k in rng.choice(len(place), outliers, replace=False):
        angle = rng.uniform(0, 2 * np.pi)
        place[k] += rng.uniform(12, 30) * np.array([np.cos(angle), np.sin(angle)])
    return infos, [fix(*p, name=f"WP{k + 1}") for k, p in enumerate(place)]


def wrong(infos, true, joined):
    return sum(f is not None and f.name != t.name for f, t in zip(joined.fixes, true, strict=True))


@pytest.mark.parametrize("seed", range(8))
def test_equal_counts_go_by_order_in_spite_of_outliers(seed):
    infos, fixes = flight(seed)
    joined = join_positions(infos, fixes)
    assert joined.count == 33
    assert wrong(infos, fixes, joined) == 0
    assert joined.probability.min() > 0.5


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("lost", [0, 5, 10, 20, 32])
def test_too_few_positions_are_never_shifted(seed, lost):
    infos, fixes = flight(seed)
    joined = join_positions(infos, fixes[:lost] + fixes[lost + 1 :])
    assert wrong(infos, fixes, joined) == 0
    assert joined.fixes[lost] is None
    assert "32 positions are fewer than 33 stills" in joined.notes[0]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("where", [0, 7, 33])
def test_too_many_positions_are_never_shifted(seed, where):
    infos, fixes = flight(seed)
    home = fix(-60.0, -20.0, name="Home")
    joined = join_positions(infos, [*fixes[:where], home, *fixes[where:]])
    assert wrong(infos, fixes, joined) == 0
    assert "34 positions are more than 33 stills" in joined.notes[0]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("lost", [6, 18, 29])
def test_a_take_off_listed_and_an_exposure_lost_make_equal_counts_that_are_not_shifted(seed, lost):
    infos, fixes = flight(seed)
    home = fix(-60.0, -20.0, name="Home")
    joined = join_positions(infos, [home, *fixes[:lost], *fixes[lost + 1 :]])
    assert wrong(infos, fixes, joined) == 0


def test_geometry_settles_a_lost_position_of_a_clean_list():
    kept = 0
    for seed in range(6):
        infos, fixes = flight(seed, sigma_m=0.3, outliers=0)
        joined = join_positions(infos, fixes[:15] + fixes[16:])
        assert wrong(infos, fixes, joined) == 0
        kept += joined.count
    assert kept > 6 * 18


def test_a_doubled_position_is_discarded_where_geometry_tells():
    infos, fixes = flight(1, sigma_m=0.1, outliers=0, turn=1.0)
    joined = join_positions(infos, [*fixes[:15], fixes[15], *fixes[15:]])
    assert wrong(infos, fixes, joined) == 0


def test_without_any_times_a_mismatch_leaves_all_out():
    infos, fixes = flight(2)
    infos = [StillInfo(name=i.name, width_px=400, height_px=300) for i in infos]
    joined = join_positions(infos, fixes[:-1])
    assert joined.count == 0
    assert "left out" in " ".join(joined.notes)
    assert join_positions(infos, fixes).count == 33


def test_names_settle_everything():
    infos, _ = flight(3)
    named = [fix(k, k, name=i.name.lower().removesuffix(".jpg")) for k, i in enumerate(infos)][5:]
    joined = join_positions(infos, named)
    assert joined.count == 28
    assert joined.fixes[:5] == (None,) * 5
    assert joined.fixes[5].name == "r0005"


def test_times_settle_a_mismatch():
    rng = np.random.default_rng(4)
    times = 1000 + np.cumsum(rng.uniform(2.0, 6.0, 33))
    infos = [
        StillInfo(name=f"R{k:04d}.JPG", width_px=400, height_px=300, camera_time_ns=int(t) * 10**9)
        for k, t in enumerate(times)
    ]
    timed = [fix(k * 7.0, 0.0, name=str(k), time_ns=10**18 + int(t * 1000) * 10**6) for k, t in enumerate(times)]
    joined = join_positions(infos, timed[:12] + timed[14:])
    assert all(f is None or int(f.name) == k for k, f in enumerate(joined.fixes))
    assert joined.count >= 28


def test_exif_positions_settle_a_mismatch():
    infos, fixes = flight(5)
    rng = np.random.default_rng(0)
    own = [
        StillInfo(
            name=i.name, width_px=400, height_px=300,
            position=fix((f.longitude_deg - 139.65) / DEGREES * np.cos(np.radians(35.8)) + rng.normal(0, 1),
                         (f.latitude_deg - 35.8) / DEGREES + rng.normal(0, 1)),
        )
        for i, f in zip(infos, fixes, strict=True)
    ]  # fmt: skip
    joined = join_positions(own, fixes[1:])
    assert wrong(own, fixes, joined) == 0
    assert joined.count >= 30


def test_an_unreadable_still_keeps_its_place_in_the_order():
    infos, fixes = flight(6)
    readable = infos[:7] + infos[8:]
    joined = join_positions(readable, fixes, absent=[infos[7].name])
    assert joined.count == 32
    assert wrong(readable, fixes[:7] + fixes[8:], joined) == 0


def test_positions_at_the_end_of_the_world_are_discarded_and_named():
    infos, fixes = flight(7)
    nowhere = GnssFix(
        gps_time_ns=None, latitude_deg=0, longitude_deg=0, height_m=0, height_datum=HeightDatum.GEOID, name="zero"
    )
    joined = join_positions(infos, [*fixes, nowhere])
    assert joined.count == 33
    assert "zero" in joined.discarded[0]
    assert "km from the others" in joined.discarded[0]


def test_a_track_is_no_list_of_exposures():
    infos, _ = flight(8)
    joined = join_positions(infos, [fix(0.1 * k, 0.0) for k in range(400)])
    assert joined.count == 0
    assert "that is a track" in joined.notes[0]
    assert join_positions(infos, []).count == 0


def test_exif_and_sigmas():
    infos = [
        StillInfo(name="a", width_px=4, height_px=3, position=fix(0, 0)),
        StillInfo(name="b", width_px=4, height_px=3),
    ]
    joined = exif_positions(infos)
    assert joined.count == 1
    assert joined.notes == ("positions from the EXIF of 1 stills", "1 stills without EXIF position: b")
    options = PositionOptions()
    assert fix_sigmas(fix(0, 0), True, options) == (1.5, 1.5, 3.0)
    assert fix_sigmas(fix(0, 0), False, options) == (1.0, 1.0, 2.0)
    assert fix_sigmas(fix(0, 0, sigma_horizontal_m=0.02, sigma_vertical_m=0.03), False, options) == (0.02, 0.02, 0.03)
