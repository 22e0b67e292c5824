"""The simulator's own ray code: there and back, first hits, and against foreign camera code."""

from dataclasses import replace

import numpy as np
import pytest

from uavkit.core.camera import InteriorOrientation
from uavkit.core.collinearity import image_coordinates, object_rays
from uavkit.core.orientation import ExteriorOrientation
from uavkit.simulate.camera import LATTICE_PX, SimulatedView, true_camera
from uavkit.simulate.flight import crest_height_m, make_flight, plan_stations
from uavkit.simulate.kernels import _site_ray
from uavkit.simulate.options import FlightKind, SimulationOptions
from uavkit.simulate.stills import StillSettings, render_still, view_table
from uavkit.simulate.survey import Scene, truth_of
from uavkit.simulate.truth import truth_to_colmap_text
from uavkit.simulate.world import World, enu_from_site, make_world


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(1)


@pytest.fixture(scope="module")
def views(world: World) -> list[SimulatedView]:
    """Full size: over the crest and over both slopes."""
    options = SimulationOptions()
    flight, camera = make_flight(world, options), true_camera(1, 1.0)
    return [flight.view(camera, float(flight.exposure_s[n])) for n in (4, 16, 27)]


def _pixels(view: SimulatedView, count: int) -> np.ndarray:
    camera = view.camera
    return np.random.default_rng(5).uniform([0, 0], [camera.width_px - 1, camera.height_px - 1], (count, 2))


def test_pixel_to_ground_and_back(world: World, views: list[SimulatedView]) -> None:
    for view in views:
        pixels = _pixels(view, 3000)
        ground = view.intersect(world, pixels)
        assert np.abs(view.project(ground) - pixels).max() < 1e-6
        assert np.abs(world.height_m(ground[:, 0], ground[:, 1]) - ground[:, 2]).max() < 2e-5


def test_the_hit_is_the_first_one(world: World, views: list[SimulatedView]) -> None:
    """Nowhere between camera and hit does the ground rise above the ray: seen at places 1 cm apart in height."""
    for view in views:
        ground = view.intersect(world, _pixels(view, 1500))
        share = np.linspace(0.0, 1.0, 1200)[:, None, None]
        places = ground + (view.centre_m - ground) * share**2 * 0.35
        above = places[..., 2] - world.height_m(places[..., 0], places[..., 1])
        assert above.min() > -2e-3


def test_some_ground_is_hidden_by_boulders(world: World, views: list[SimulatedView]) -> None:
    """``sees`` is not simply "inside the image": boxes and boulders hide ground behind them."""
    hidden = 0
    for view in views:
        ground = view.intersect(world, _pixels(view, 4000)) + np.random.default_rng(2).normal(0, 0.3, (4000, 3))
        ground[:, 2] = world.height_m(ground[:, 0], ground[:, 1])
        pixels = view.project(ground)
        size = [view.camera.width_px - 1, view.camera.height_px - 1]
        inside = np.all((pixels > 30) & (pixels < np.array(size) - 30), axis=1)
        seen = view.sees(world, ground, 20.0)
        assert seen[inside].mean() > 0.9
        hidden += int((inside & ~seen).sum())
    assert hidden > 5


def test_rays_of_the_renderer_are_those_of_the_camera(views: list[SimulatedView]) -> None:
    for view in views:
        lattice, table = view.camera.lattice(), view_table(view)
        pixels = _pixels(view, 500)
        rays = np.array([_site_ray(lattice, float(LATTICE_PX), table, c, r)[:2] for c, r in pixels])
        points = view.centre_m + np.column_stack([rays, -np.ones(len(rays))]) @ enu_from_site().T * 11.0
        assert np.abs(view.project(points) - pixels).max() < 2e-3


def test_signals_appear_where_they_project(smallest_scene: Scene) -> None:
    """Black quarters where along and across agree in sign, white elsewhere: mirrored rays would show."""
    scene, checked = smallest_scene, 0
    for index, name in enumerate(scene.names):
        view = scene.view(index)
        settings = StillSettings(gain=1.0, seed=(1,))
        image = render_still(scene.world, view, scene.camera.lattice(), settings)[:, :, 1].astype(float)
        for point in [p for p in scene.control + scene.check if name in p.images]:
            quarters = np.array([[1, 1], [-1, -1], [1, -1], [-1, 1]]) * 0.055
            places = point.position_m[:2] + quarters @ enu_from_site()[:2, :2].T
            enu = np.column_stack([places, scene.world.height_m(places[:, 0], places[:, 1])])
            columns, rows = np.rint(view.project(enu)).astype(int).T
            grey = image[rows, columns]
            assert grey[2:].min() > grey[:2].max() + 60
            checked += 1
    assert checked >= 4


def test_pycolmap_reprojects_the_marks(smallest_scene: Scene, tmp_path) -> None:
    """COLMAP's camera model and conventions, not ours, bring each point to its mark within 0.01 px."""
    pycolmap = pytest.importorskip("pycolmap")
    truth_to_colmap_text(truth_of(smallest_scene), tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path))
    gaps = [
        np.abs(image.project_point(model.points3D[mark.point3D_id].xyz) - mark.xy).max()
        for image in model.images.values()
        for mark in image.points2D
    ]
    assert len(gaps) >= 8
    assert max(gaps) < 0.01


def test_core_projects_as_the_simulator_does(smallest_scene: Scene) -> None:
    """Two codes of the collinearity equations, written apart, agree."""
    interior = InteriorOrientation(**smallest_scene.camera.as_dict())
    for index in range(len(smallest_scene.names)):
        view = smallest_scene.view(index)
        exterior = ExteriorOrientation(projection_centre_m=view.centre_m, R_object_from_image=view.R_object_from_image)
        ground = view.intersect(smallest_scene.world, _pixels(view, 200))
        assert np.abs(image_coordinates(ground, exterior, interior) - view.project(ground)).max() < 1e-8
        rays = object_rays(_pixels(view, 200), exterior, interior)
        own = view.rays(_pixels(view, 200))
        assert np.abs(rays / rays[:, 2:] - own / own[:, 2:]).max() < 1e-10


def test_world_is_the_embankment(world: World) -> None:
    foot = np.array([[s, t, 0.0] for s in range(-38, 39, 4) for t in (-24.0, 24.0)]) @ enu_from_site().T
    relief = crest_height_m(world) - world.height_m(foot[:, 0], foot[:, 1]).mean()
    assert 8.5 < relief < 11.5
    gentle = world.ground.bounds[:, :, 0] > 0
    assert 0.6 < gentle.mean() < 0.99


def test_world_is_rebuilt_from_its_seed(world: World) -> None:
    again = make_world.__wrapped__(1)
    for one, other in zip(world.ground, again.ground, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize(
    ("kind", "wanted_m", "spread_m"), [(FlightKind.CONSTANT, 10.0, 0.8), (FlightKind.TRACE, 15.0, 0.6)]
)
def test_heights_above_ground(world: World, kind: FlightKind, wanted_m: float, spread_m: float) -> None:
    """Constant: 10 m above the crest by the middle strip; trace: 15 m by all."""
    stations = plan_stations(world, SimulationOptions(flight=kind))
    enu = stations @ enu_from_site().T
    height = enu[..., 2] - world.height_m(enu[..., 0], enu[..., 1])
    middle = height[1] if kind is FlightKind.CONSTANT else height
    assert abs(middle.mean() - wanted_m) < spread_m
    if kind is FlightKind.CONSTANT:
        assert np.ptp(stations[..., 2]) < 1e-9
        assert height.max() > 13.0


def test_flight_is_smooth_and_passes_its_stations(world: World) -> None:
    options = SimulationOptions(frames_between_stills=90)
    flight = make_flight(world, options)
    at_exposure = flight.positions_m(flight.exposure_s)
    assert np.abs(at_exposure - flight.stations_m).max() < 2.0
    times = np.arange(len(flight.states.state)) * flight.field_interval_s
    speed = np.linalg.norm(np.diff(flight.positions_m(times), axis=0), axis=1) / flight.field_interval_s
    assert speed.max() < 9.0
    assert np.abs(np.diff(speed)).max() < 0.35  # no jump: below 21 m/s2 at 60 fields a second
    forward = flight.rotations(flight.exposure_s)[:, :2, 0]
    turn = np.einsum("ij,ij->i", forward[:-1], forward[1:])
    assert turn[[10, 21]].max() < -0.98
    assert np.delete(turn, [10, 21]).min() > 0.98
    tilt = np.degrees(np.arccos(flight.rotations(times)[:, 2, 2]))
    assert 0.8 < np.sqrt(np.mean(tilt**2)) < 3.0


def test_true_camera_is_near_its_type(views: list[SimulatedView]) -> None:
    camera = views[0].camera
    corner = np.array([[3999.0, 2999.0]])
    undistorted = replace(camera, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
    shift = np.linalg.norm(camera.pixels_of(camera.ideal_of(corner)) - undistorted.pixels_of(camera.ideal_of(corner)))
    assert 10 < shift < 120
    assert abs(camera.principal_distance_px - 2684) < 20
