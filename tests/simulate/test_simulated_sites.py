"""Every terrain and texture: the truth belongs to the pictures, and each is as hard as it says."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from uavkit.core.errors import InputError
from uavkit.simulate.brightness import LEAD_S, finder_factor, still_factors
from uavkit.simulate.camera import SimulatedView, true_camera
from uavkit.simulate.flight import make_flight, plan_stations
from uavkit.simulate.kernels import CELL_M
from uavkit.simulate.options import FlightKind, SimulationOptions, Terrain, Texture, VideoStandard
from uavkit.simulate.stills import StillSettings, render_still
from uavkit.simulate.survey import Scene, make_scene
from uavkit.simulate.terrain import SHAPE, flown
from uavkit.simulate.textures import PLANT_WAVE, TILE_M
from uavkit.simulate.truth import survey_truth
from uavkit.simulate.world import World, enu_from_site, make_world

SMALL = SimulationOptions(
    scale=0.25,
    strips=1,
    stations_per_strip=2,
    station_spacing_m=5.0,
    video_standard=VideoStandard.NONE,
    check_points=4,
    gnss_outliers=0,
    flight=FlightKind.TRACE,
    workers=1,
)
SITES = [
    (Terrain.EMBANKMENT, Texture.MIXED),
    (Terrain.HILLS, Texture.REPETITIVE),
    (Terrain.FLAT, Texture.LOW_CONTRAST),
]


@pytest.fixture(scope="module")
def sites() -> dict[Terrain, tuple[Scene, list[np.ndarray]]]:
    """Each terrain with another texture: the scene and its two stills."""
    made = {}
    for terrain, texture in SITES:
        scene = make_scene(replace(SMALL, terrain=terrain, texture=texture))
        lattice = scene.camera.lattice()
        stills = [render_still(scene.world, scene.view(n), lattice, scene.still_settings(n)) for n in (0, 1)]
        made[terrain] = (scene, stills)
    return made


@pytest.mark.parametrize("terrain", list(Terrain))
def test_rays_through_marks_hit_the_true_surface(sites: dict[Terrain, tuple[Scene, list]], terrain: Terrain) -> None:
    scene, _ = sites[terrain]
    checked = 0
    for point in scene.control + scene.check:
        east, north, up = point.position_m
        assert abs(scene.world.height_m(east, north) - up) < 1e-9
        for name, pixel in zip(point.images, point.pixels, strict=True):
            met = scene.view(scene.names.index(name)).intersect(scene.world, pixel[None])[0]
            assert np.linalg.norm(met - point.position_m) < 1e-4
            checked += 1
    assert checked >= 8


@pytest.mark.parametrize("terrain", list(Terrain))
def test_the_picture_shows_the_signals_where_they_project(
    sites: dict[Terrain, tuple[Scene, list[np.ndarray]]], terrain: Terrain
) -> None:
    """White and black quarters stand out of every texture: 0.55 and 0.02 against a ground of 0.2 to 0.4."""
    scene, stills = sites[terrain]
    for image, name, n in zip(stills, scene.names, (0, 1), strict=True):
        for point in [p for p in scene.control + scene.check if name in p.images]:
            quarters = np.array([[1, 1], [-1, -1], [1, -1], [-1, 1]]) * 0.055
            places = point.position_m[:2] + quarters @ enu_from_site()[:2, :2].T
            enu = np.column_stack([places, scene.world.height_m(places[:, 0], places[:, 1])])
            columns, rows = np.rint(scene.view(n).project(enu)).astype(int).T
            grey = image[rows, columns, 1].astype(float)
            assert grey[2:].min() > grey[:2].max() + 60


def test_hills_roll_without_a_straight_crest(sites: dict[Terrain, tuple[Scene, list]]) -> None:
    heights = flown(sites[Terrain.HILLS][0].world.ground.heights_m)
    assert 6.0 < np.ptp(heights) < 8.0
    summits_m = heights[:, ::80].argmax(axis=0) * CELL_M
    assert np.ptp(summits_m) > 10.0


def test_flat_is_flat(sites: dict[Terrain, tuple[Scene, list]]) -> None:
    assert 0.1 < np.ptp(sites[Terrain.FLAT][0].world.ground.heights_m) < 0.3


@pytest.mark.parametrize("terrain", [Terrain.HILLS, Terrain.FLAT])
@pytest.mark.parametrize("kind", list(FlightKind))
def test_flights_keep_their_heights(
    sites: dict[Terrain, tuple[Scene, list]], terrain: Terrain, kind: FlightKind
) -> None:
    """Constant: one height, 15 m above the mean ground; trace: 15 m above the ground below each station."""
    world = sites[terrain][0].world
    stations = plan_stations(world, SimulationOptions(terrain=terrain, flight=kind))
    enu = stations @ enu_from_site().T
    height = enu[..., 2] - world.height_m(enu[..., 0], enu[..., 1])
    assert abs(height.mean() - 15.0) < (1.2 if kind is FlightKind.CONSTANT else 0.1)
    assert height.min() > 9.0
    if kind is FlightKind.CONSTANT:
        assert np.ptp(stations[..., 2]) < 1e-9
    else:
        assert np.ptp(height) < 1.5


def test_levels_of_the_truth_are_those_of_the_terrain(sites: dict[Terrain, tuple[Scene, list]]) -> None:
    scene = sites[Terrain.HILLS][0]
    truth = survey_truth(scene, None)
    assert (truth["options"]["terrain"], truth["options"]["texture"]) == ("hills", "repetitive")
    heights = truth["block"]["height_above_ground_at_stations_m"]
    assert truth["block"]["height_above_m"]["highest"] == pytest.approx(min(heights), abs=0.01)
    assert truth["block"]["height_above_m"]["lowest"] == pytest.approx(max(heights), abs=0.01)


def _map(world: World) -> np.ndarray:
    return world.ground.radiance[: SHAPE[0] * SHAPE[1]].reshape(SHAPE)


def test_the_crop_repeats_plant_by_plant(sites: dict[Terrain, tuple[Scene, list]]) -> None:
    """Ten plants on, the map is the same but for what is faint; natural ground is another one."""
    to_plant = TILE_M * PLANT_WAVE / (PLANT_WAVE @ PLANT_WAVE)
    columns, rows = np.rint(10 * to_plant / CELL_M).astype(int)

    def likeness(world: World) -> float:
        field = flown(_map(world)) / cv2.GaussianBlur(flown(_map(world)), (0, 0), 40)
        other = np.roll(field, (rows, columns), axis=(0, 1))
        return float(np.corrcoef(field[300:-300, 300:-300].ravel(), other[300:-300, 300:-300].ravel())[0, 1])

    assert likeness(sites[Terrain.HILLS][0].world) > 0.85
    assert likeness(sites[Terrain.EMBANKMENT][0].world) < 0.3


def test_sand_has_a_few_grey_values_of_contrast(sites: dict[Terrain, tuple[Scene, list]]) -> None:
    """Two exposures of one view: what they have in common is the picture, the rest is noise."""
    scene, _ = sites[Terrain.FLAT]
    lattice = scene.camera.lattice()
    pair = [
        render_still(scene.world, scene.view(0), lattice, StillSettings(gain=1.0, seed=(n,)))[:, :, 1].astype(float)
        for n in (1, 2)
    ]
    noise = (pair[0] - pair[1]).std() / np.sqrt(2)
    blocks = [p[:736, :992].reshape(23, 32, 31, 32).transpose(0, 2, 1, 3).reshape(-1, 1024) for p in pair]
    one, two = (b - b.mean(axis=1, keepdims=True) for b in blocks)
    contrast = np.sqrt(np.maximum((one * two).mean(axis=1), 0.0))
    assert 0.8 * noise < np.median(contrast) < 2.0 * noise < 8.0


def _sift_matches(scene: Scene, stills: list[np.ndarray]) -> tuple[int, int]:
    """Matches of two stills within 2 px of the truth that pass Lowe's ratio test (0.8), and keypoints."""
    sift = cv2.SIFT_create(8000)
    (first, a), (second, b) = (sift.detectAndCompute(cv2.cvtColor(s, cv2.COLOR_RGB2GRAY), None) for s in stills)
    pairs = cv2.BFMatcher().knnMatch(a, b, k=2)
    kept = [p for p, q in pairs if p.distance < 0.8 * q.distance]
    source = np.array([first[m.queryIdx].pt for m in kept])
    target = np.array([second[m.trainIdx].pt for m in kept])
    truth = scene.view(1).project(scene.view(0).intersect(scene.world, source))
    return int((np.linalg.norm(truth - target, axis=1) < 2.0).sum()), len(first)


def test_hard_textures_starve_sift(sites: dict[Terrain, tuple[Scene, list[np.ndarray]]]) -> None:
    """Crop: plenty of keypoints, hardly one in ten of mixed ground's share can be told; sand: hardly any keypoints."""
    (mixed, mixed_points), (crop, crop_points), (sand, sand_points) = (
        _sift_matches(*sites[terrain]) for terrain, _ in SITES
    )
    assert mixed > 400
    assert crop / crop_points < 0.15 * mixed / mixed_points
    assert crop_points > mixed_points
    assert sand < 0.05 * mixed
    assert sand_points < 0.15 * mixed_points


def test_brightness_jumps_between_neighbours() -> None:
    factors = still_factors(5, 0.4)
    assert factors[1::2] / factors[0] == pytest.approx(1.4)
    assert factors[0] == factors[2] == factors[4]
    assert np.all(still_factors(3, 0.0) == 1.0)
    plain, jumping = (make_scene(replace(SMALL, brightness_jump=jump)) for jump in (0.0, 0.4))
    ratio = jumping.gains / plain.gains
    assert ratio[1] / ratio[0] == pytest.approx(1.4)


def test_the_stills_show_the_jump(sites: dict[Terrain, tuple[Scene, list]]) -> None:
    """Of one view, grey values to the power of 2.2 differ by the factor."""
    scene = sites[Terrain.FLAT][0]
    lattice = scene.camera.lattice()
    dark, bright = (
        render_still(scene.world, scene.view(0), lattice, StillSettings(gain=g, seed=(1,)))
        for g in still_factors(2, 0.4)
    )
    middle = np.s_[200:500, 300:700, 1]
    ratio = (bright[middle] / 255.0) ** 2.2 / (dark[middle] / 255.0) ** 2.2
    assert abs(np.median(ratio) - 1.4) < 0.03


def test_the_finder_jumps_shortly_before_an_exposure() -> None:
    exposure_s = np.array([3.0, 6.0, 9.0])
    before, after = still_factors(3, 0.4)[:2]
    assert finder_factor(3.0, exposure_s, 0.4) == pytest.approx(before)
    assert finder_factor(6.0 - LEAD_S - 0.06, exposure_s, 0.4) == pytest.approx(before)
    assert finder_factor(6.0 - LEAD_S + 0.06, exposure_s, 0.4) == pytest.approx(after)
    assert finder_factor(9.5, exposure_s, 0.4) == pytest.approx(before)
    assert all(finder_factor(t, exposure_s, 0.0) == 1.0 for t in np.linspace(0, 12, 50))


def test_a_flat_single_height_block_looks_straight_down() -> None:
    """Tilts stay within some degrees, and the true centres within a metre of one height."""
    options = SimulationOptions(terrain=Terrain.FLAT, flight=FlightKind.CONSTANT)
    world = make_world(1, Terrain.FLAT)
    flight = make_flight(world, options)
    tilt = np.degrees(np.arccos(flight.rotations(flight.exposure_s)[:, 2, 2]))
    assert tilt.max() < 6.0
    assert np.ptp(flight.positions_m(flight.exposure_s)[:, 2]) < 1.6
    view = flight.view(true_camera(1, 0.1), float(flight.exposure_s[16]))
    assert isinstance(view, SimulatedView)
    corners = view.intersect(world, np.array([[0.0, 0.0], [399.0, 299.0]]))
    assert np.abs(corners[:, 2]).max() < 0.3


def test_a_jump_beyond_its_range_is_refused() -> None:
    with pytest.raises(InputError, match="brightness_jump"):
        SimulationOptions(brightness_jump=0.7)
