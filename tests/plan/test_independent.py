"""The judge of plans is judged: plans made by hand, whose overlaps and heights are known in closed form."""

from dataclasses import replace

import numpy as np
import pyproj
import pytest
from independent import (
    Ground,
    Images,
    Judgement,
    LocalGround,
    PlaneArea,
    broken_promises,
    geocentric,
    geographic,
    image_lattice,
    judge,
    path_heights,
    path_legs,
    unlisted_neighbours,
)

from uavkit.core.arrays import Array
from uavkit.core.camera import CameraProfile
from uavkit.core.flightplan import (
    AreaKind,
    FlightPlan,
    FlightStrip,
    PlannedExposures,
    PlanSummary,
    Sortie,
    SurveyArea,
    TakeOff,
    Trigger,
    Waypoint,
    WaypointRole,
)
from uavkit.core.frames import LocalMap
from uavkit.core.surface import ElevationGrid
from uavkit.formats.camera_profiles import load_camera
from uavkit.formats.plan_request import FlightRequest, ImagingRequest, InlineArea, PlanRequest, TerrainRequest

HEIGHT_M = 50.0
PLACES = [(46.0, 7.0), (-74.5, 170.0), (0.2, -78.0)]


def camera() -> CameraProfile:
    return load_camera("DJI FC6310")


def half_tangents(profile: CameraProfile) -> tuple[float, float]:
    """Return the tangents of half the angles of view across and along (long side across)."""
    interior = profile.interior
    c = interior.principal_distance_px
    return interior.width_px / 2 / c, interior.height_px / 2 / c


def plane(
    place: LocalMap, slope: float, azimuth_deg: float, half_m: float = 700.0, cell_m: float = 20.0
) -> ElevationGrid:
    """Return a plane through height 100 m at the place, rising by a slope towards an azimuth."""
    side = np.arange(-half_m, half_m + cell_m / 2, cell_m)
    x, y = np.meshgrid(side, side)
    rise = slope * (x * np.sin(np.radians(azimuth_deg)) + y * np.cos(np.radians(azimuth_deg)))
    return ElevationGrid(
        height_ellipsoid_m=(100.0 + rise).astype(np.float32),
        crs=place.crs,
        crs_from_grid=np.array([[cell_m, 0.0, -half_m], [0.0, cell_m, -half_m]]),
        sigma_m=0.5,
        source="plane",
    )


def no_summary() -> PlanSummary:
    nan = float("nan")
    three = (nan, nan, nan)
    return PlanSummary(
        area_m2=nan,
        images=0,
        strips=0,
        sorties=1,
        length_m=nan,
        duration_s=nan,
        gsd_m=three,
        forward_overlap=(nan, nan),
        side_overlap=(nan, nan),
        height_above_ground_m=three,
        least_clearance_m=nan,
        least_images=0,
        covered=nan,
        covered_enough=nan,
        motion_blur_px=nan,
        video_motion_px=nan,
    )


def nadir(heading_deg: float) -> Array:
    """Return R_map_from_image with the top of the image forwards: columns right, forward, up."""
    s, c = np.sin(np.radians(heading_deg)), np.cos(np.radians(heading_deg))
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def made_plan(
    place: LocalMap,
    base_m: float,
    spacing_m: float,
    direction_deg: float = 0.0,
    strips: int = 3,
    count: int = 7,
    slopes: tuple[float, float] = (0.0, 0.0),
    speed_m_s: float = 5.0,
) -> FlightPlan:
    """Return parallel strips about the place, all flown in one direction; slopes of the flight: along, across.

    They turn about the place at 100 m + HEIGHT_M above the ellipsoid.
    """
    a = np.radians(direction_deg)
    along = (np.arange(count) - (count - 1) / 2) * base_m
    table: dict[str, list[float]] = {"x": [], "y": [], "z": [], "strip": []}
    waypoints: list[Waypoint] = []

    def waypoint(s: float, t: float, role: WaypointRole, strip: int, exposure: int = -1) -> Waypoint:
        xy = np.array([[s * np.sin(a) + t * np.cos(a), s * np.cos(a) - t * np.sin(a)]])
        latitude, longitude = place.geographic_from_map(xy)[0]
        height = 100.0 + HEIGHT_M + slopes[0] * s + slopes[1] * t
        return Waypoint(
            role=role,
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_ellipsoid_m=height,
            height_above_takeoff_m=height - 100.0,
            height_above_ground_m=HEIGHT_M,
            speed_m_s=speed_m_s,
            heading_deg=direction_deg,
            strip=strip,
            exposure=exposure,
        )

    for strip in range(strips):
        t = (strip - (strips - 1) / 2) * spacing_m
        first = strip * count
        waypoints.append(waypoint(along[0] - 5.0, t, WaypointRole.ENTRY, strip))
        waypoints.append(waypoint(along[0], t, WaypointRole.EXPOSURE, strip, first))
        waypoints.append(waypoint(along[-1], t, WaypointRole.EXPOSURE, strip, first + count - 1))
        waypoints.append(waypoint(along[-1] + 0.4 * base_m, t, WaypointRole.EXIT, strip))
        table["x"].extend(along * np.sin(a) + t * np.cos(a))
        table["y"].extend(along * np.cos(a) - t * np.sin(a))
        table["z"].extend(100.0 + HEIGHT_M + slopes[0] * along + slopes[1] * t)
        table["strip"].extend([strip] * count)
    n = strips * count
    latitude, longitude = place.geographic_from_map(np.column_stack([table["x"], table["y"]])).T
    convergence_deg = float(np.degrees(place.convergence_rad(latitude, longitude)).mean())
    assert abs(convergence_deg) < 0.03
    exposures = PlannedExposures(
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_ellipsoid_m=np.array(table["z"]),
        height_above_ground_m=np.full(n, HEIGHT_M),
        R_map_from_image=np.repeat(nadir(direction_deg)[None], n, axis=0),
        heading_deg=np.full(n, direction_deg),
        station=np.arange(n),
        strip=np.array(table["strip"], dtype=np.int64),
        sortie=np.zeros(n, np.int64),
        time_s=np.arange(n) * base_m / speed_m_s,
        forward_overlap=np.full(n, np.nan),
        side_overlap=np.full(n, np.nan),
        gsd_m=np.full((n, 3), np.nan),
        sees_area=np.ones(n, bool),
    )
    middle = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 8.0], [0.0, 8.0]])
    return FlightPlan(
        name="made",
        camera="DJI FC6310",
        vehicle="",
        trigger=Trigger.DISTANCE,
        areas=(
            SurveyArea(name="area", kind=AreaKind.POLYGON, latitude_longitude_deg=place.geographic_from_map(middle)),
        ),
        take_off=TakeOff(latitude_deg=place.latitude_deg, longitude_deg=place.longitude_deg, height_ellipsoid_m=100.0),
        strips=tuple(
            FlightStrip(
                area="area",
                direction_deg=direction_deg,
                base_m=base_m,
                first_exposure=k * count,
                exposures=count,
                neighbours=tuple(j for j in (k - 1, k + 1) if 0 <= j < strips),
            )
            for k in range(strips)
        ),
        exposures=exposures,
        sorties=(
            Sortie(
                waypoints=tuple(waypoints), first_exposure=0, exposures=n, length_m=0.0, duration_s=0.0, climb_m=0.0
            ),
        ),
        summary=no_summary(),
        terrain="",
    )


def with_overlaps_told(plan: FlightPlan, forward: float, side: float) -> FlightPlan:
    """Return the plan as a planner would give it that computes these overlaps."""
    last = np.append(np.diff(plan.exposures.strip) != 0, True)
    told = np.where(last, np.nan, forward)
    return replace(plan, exposures=replace(plan.exposures, forward_overlap=told, side_overlap=np.full(len(told), side)))


def request(forward: float, side: float, follow: bool = False) -> PlanRequest:
    return PlanRequest(
        areas=[InlineArea(latitude_longitude_deg=[(0.0, 0.0)])],
        camera="DJI FC6310",
        imaging=ImagingRequest(height_above_ground_m=HEIGHT_M, forward_overlap=forward, side_overlap=side),
        terrain=TerrainRequest(follow=follow),
    )


def local_map(latitude_deg: float, longitude_deg: float) -> LocalMap:
    return LocalMap(latitude_deg=latitude_deg, longitude_deg=longitude_deg, height_ellipsoid_m=100.0 + HEIGHT_M)


def rows_seen(m: float, s: float, b: float) -> tuple[float, float]:
    """Return the least and greatest tangent that the next image shows, too, over a plane of slope s, flown parallel.

    A ray of tangent t (forward) meets the ground at depth d = H / (1 + s t), t d ahead. Seen from the next image, b on
    and s b higher (all by H), that is (t d - b) / (d + s b), which must lie within +-m: solved for t.
    """
    nearest = (b * (1.0 - m * s) - m) / (1.0 - b * s * (1.0 - m * s))
    farthest = min(m, (b * (1.0 + m * s) + m) / (1.0 - b * s * (1.0 + m * s)))
    return nearest, farthest


def overlap_of_strips(m: float, s: float, b: float) -> float:
    """Return the share that a strip beside an image shows, if its images are close to one another."""
    nearest, farthest = rows_seen(m, s, b)
    return (farthest - nearest) / (2.0 * m)


def overlap_of_images(m: float, s: float, b: float) -> float:
    """Return the share that the next image shows: downhill it is nearer to the ground, and shows less to the sides.

    Of a row of tangent t by a factor (d + s b) / d = 1 + s b (1 + s t), if that is less than 1: integrated over t.
    """
    nearest, farthest = rows_seen(m, s, b)
    if s >= 0.0:
        return (farthest - nearest) / (2.0 * m)
    middle = (nearest + farthest) / 2.0
    return (farthest - nearest) / (2.0 * m) * (1.0 + s * b * (1.0 + s * middle))


def test_the_lattice_is_even_along_rows_and_columns() -> None:
    interior = camera().interior
    points = image_lattice(camera())
    for axis, size in ((0, interior.width_px), (1, interior.height_px)):
        sorted_px = np.sort(points[:, axis])
        assert np.allclose(np.diff(sorted_px), size / len(points))
        assert sorted_px[0] > -0.5
        assert sorted_px[-1] < size - 0.5


@pytest.mark.parametrize("latitude_deg, longitude_deg", PLACES)
@pytest.mark.parametrize("direction_deg", [0.0, 57.0, 200.0])
def test_overlaps_over_flat_ground(latitude_deg: float, longitude_deg: float, direction_deg: float) -> None:
    across, along = half_tangents(camera())
    base_m, spacing_m = 0.23 * 2 * along * HEIGHT_M, 0.41 * 2 * across * HEIGHT_M
    plan = made_plan(local_map(latitude_deg, longitude_deg), base_m, spacing_m, direction_deg)
    images = Images(plan, camera(), Ground(elevation=None, level_m=100.0))
    # the lattice resolves 1 / 4181; the earth falls away by 0.1 mm, the map is true to 1e-6
    assert images.forward_overlap(1) == pytest.approx(1.0 - 0.23, abs=5e-4)
    # the middle image of strip 0: strip 1 lies 0.41 of the image beside it, and is longer than the image
    assert images.side_overlap(3, (1,)) == pytest.approx(1.0 - 0.41, abs=1e-3)
    assert images.side_overlap(3, (2,)) == pytest.approx(1.0 - 0.82, abs=1e-3)
    # the first image looks back beyond the first image of strip 1: nothing is lost, they are beside one another
    assert images.side_overlap(7, (0,)) == pytest.approx(1.0 - 0.41, abs=1e-3)


@pytest.mark.parametrize("slope", [-1.0, -0.4, 0.3, 1.0])
@pytest.mark.parametrize("direction_deg", [0.0, 130.0])
def test_overlaps_along_a_slope(slope: float, direction_deg: float) -> None:
    place = local_map(46.0, 7.0)
    _, along = half_tangents(camera())
    base_m = 0.3 * 2 * along * HEIGHT_M
    plan = made_plan(place, base_m, 30.0, direction_deg, strips=2, slopes=(slope, 0.0))
    ground = Ground(elevation=plane(place, slope, direction_deg), level_m=np.nan)
    images = Images(plan, camera(), ground)
    expected = overlap_of_images(along, slope, base_m / HEIGHT_M)
    assert abs(expected - 0.7) > 0.02  # the slope matters
    assert images.forward_overlap(2) == pytest.approx(expected, abs=1.5e-3)
    assert images.height_above_ground_m(2) == pytest.approx(HEIGHT_M, abs=2e-3)


@pytest.mark.parametrize("slope", [-0.8, 0.5])
def test_side_overlap_up_and_down_a_slope(slope: float) -> None:
    """Strips beside one another at one height above a plane that rises across them: the same formula sideways."""
    place = local_map(-74.5, 170.0)
    across, _ = half_tangents(camera())
    spacing_m = 0.35 * 2 * across * HEIGHT_M
    # along the strip, images close to one another: the neighbouring strip shows all that its width allows
    plan = made_plan(place, 8.0, spacing_m, 0.0, strips=2, count=41, slopes=(0.0, slope))
    images = Images(plan, camera(), Ground(elevation=plane(place, slope, 90.0), level_m=np.nan))
    assert images.side_overlap(20, (1,)) == pytest.approx(
        overlap_of_strips(across, slope, spacing_m / HEIGHT_M), abs=2e-3
    )
    assert images.side_overlap(61, (0,)) == pytest.approx(
        overlap_of_strips(across, -slope, spacing_m / HEIGHT_M), abs=2e-3
    )


def test_an_image_moved_away_is_noticed() -> None:
    across, along = half_tangents(camera())
    place = local_map(46.0, 7.0)
    plan = made_plan(place, 0.2 * 2 * along * HEIGHT_M, 0.4 * 2 * across * HEIGHT_M)
    plan = with_overlaps_told(plan, 0.8, 0.6)
    good = judge(plan, request(0.8, 0.6), camera(), None)
    assert broken_promises(good, request(0.8, 0.6)) == []
    assert good.forward_overlap == pytest.approx(0.8, abs=1e-3)
    assert good.side_overlap == pytest.approx(0.6, abs=1e-3)
    assert good.forward_report_error < 1e-3
    assert max(good.side_told_too_high, good.side_told_too_low) < 1e-3

    north_deg = 0.05 * 2 * along * HEIGHT_M / 111000.0
    latitude = plan.exposures.latitude_deg.copy()
    latitude[10] += north_deg
    bad = judge(
        replace(plan, exposures=replace(plan.exposures, latitude_deg=latitude)), request(0.8, 0.6), camera(), None
    )
    assert bad.forward_overlap == pytest.approx(0.75, abs=2e-3)
    assert bad.forward_at == 9
    assert bad.forward_report_error == pytest.approx(0.05, abs=2e-3)
    broken = " ".join(broken_promises(bad, request(0.8, 0.6)))
    assert "forward overlap" in broken
    assert "exposure 10 is taken" in broken


def test_a_strip_moved_away_is_noticed() -> None:
    across, along = half_tangents(camera())
    plan = made_plan(local_map(46.0, 7.0), 0.2 * 2 * along * HEIGHT_M, 0.44 * 2 * across * HEIGHT_M)
    found = judge(with_overlaps_told(plan, 0.8, 0.6), request(0.8, 0.6), camera(), None)
    assert found.side_overlap == pytest.approx(0.56, abs=1e-3)
    assert found.side_told_too_high == pytest.approx(0.04, abs=1e-3)
    assert any("side overlap" in text for text in broken_promises(found, request(0.8, 0.6)))


def test_an_image_turned_is_noticed() -> None:
    """The long side along the flight: the base is then a smaller share, the spacing a greater one."""
    across, along = half_tangents(camera())
    plan = made_plan(local_map(46.0, 7.0), 0.2 * 2 * along * HEIGHT_M, 0.4 * 2 * across * HEIGHT_M)
    turned = np.repeat(nadir(90.0)[None], len(plan.exposures), axis=0)
    images = Images(
        replace(plan, exposures=replace(plan.exposures, R_map_from_image=turned)),
        camera(),
        Ground(elevation=None, level_m=100.0),
    )
    assert images.forward_overlap(1) == pytest.approx(1.0 - 0.2 * along / across, abs=1e-3)
    assert images.side_overlap(3, (1,)) == pytest.approx(1.0 - 0.4 * across / along, abs=1e-3)


def test_points_are_counted_in_images() -> None:
    """Over flat ground a point inside the block lies in as many images as fit: 1 / (0.2 x 0.4) = 5 x 2.5."""
    across, along = half_tangents(camera())
    place = local_map(46.0, 7.0)
    base_m, spacing_m = 0.2 * 2 * along * HEIGHT_M, 0.4 * 2 * across * HEIGHT_M
    plan = made_plan(place, base_m, spacing_m, count=21)
    ground = Ground(elevation=None, level_m=100.0)
    xy = np.array([[0.01, 0.01 * base_m], [0.3 * spacing_m, 0.3 * base_m], [5000.0, 0.0], [0.0, 10.6 * base_m]])
    latitude, longitude = place.geographic_from_map(xy).T
    lying, seen = Images(plan, camera(), ground).seen_by(geocentric(latitude, longitude, np.full(4, 100.0)))
    # in the middle: 5 images of each of three strips, their stations at +-2 bases and 0, strips at +-0.4 and 0 widths
    assert lying.tolist() == [15, 10, 0, 6]
    assert seen.tolist() == lying.tolist()


def test_a_ridge_hides_what_lies_behind_it() -> None:
    place = local_map(46.0, 7.0)
    grid = plane(place, 0.0, 0.0, half_m=200.0, cell_m=2.0)
    heights = grid.height_ellipsoid_m.copy()
    heights[:, 110] += 40.0  # a wall at x = 20 m, two metres to each side
    ground = Ground(elevation=replace(grid, height_ellipsoid_m=heights), level_m=np.nan)
    plan = made_plan(place, 10.0, 10.0, strips=1, count=1)
    latitude, longitude = place.geographic_from_map(np.array([[15.0, 0.0], [30.0, 0.0]])).T
    points = geocentric(latitude, longitude, np.full(2, 100.0))
    # the line from (0, 50 m) to (30 m, 0) is 17 m high above the wall's foot: the wall of 40 m stands in between
    lying, seen = Images(plan, camera(), ground).seen_by(points)
    assert lying.tolist() == [1, 1]
    assert seen.tolist() == [1, 0]


@pytest.mark.parametrize("latitude_deg, longitude_deg", PLACES)
@pytest.mark.parametrize("crs", ["utm", "degrees"])
def test_the_local_ground_is_what_pyproj_says(latitude_deg: float, longitude_deg: float, crs: str) -> None:
    rng = np.random.default_rng(5)
    if crs == "utm":
        name = (
            f"+proj=utm +zone={int((longitude_deg + 180) // 6) + 1} {'+south' if latitude_deg < 0 else ''} +datum=WGS84"
        )
        east, north = pyproj.Transformer.from_crs("EPSG:4326", name, always_xy=True).transform(
            longitude_deg, latitude_deg
        )
        turn = np.array([[8.0, 3.0], [3.0, -8.0]])
        first = np.array([east, north]) - turn @ [150.0, 150.0]
    else:
        name, turn = "EPSG:4326", np.diag([1e-4 / np.cos(np.radians(latitude_deg)), -1e-4])
        first = np.array([longitude_deg, latitude_deg]) - turn @ [150.0, 150.0]
    grid = ElevationGrid(
        height_ellipsoid_m=rng.normal(200.0, 3.0, (301, 301)).astype(np.float32),
        crs=name,
        crs_from_grid=np.column_stack([turn, first]),
        sigma_m=0.0,
        source="noise",
    )
    ground = Ground(elevation=grid, level_m=np.nan)
    local = LocalGround(ground, np.array([latitude_deg, longitude_deg, 300.0]), 900.0)
    enu = rng.uniform(-600.0, 600.0, (500, 3))
    latitude, longitude, height = geographic(local.xyz_m + enu @ local.axes.T).T
    direct = height - ground.heights_m(latitude, longitude)
    assert np.all(np.isfinite(direct))
    assert np.max(np.abs(local.above_ground_m(enu) - direct)) < 0.02


def test_ground_between_nodes_is_bilinear() -> None:
    place = local_map(46.0, 7.0)
    grid = ElevationGrid(
        height_ellipsoid_m=np.array([[1.0, 2.0, 9.0], [3.0, 8.0, np.nan]], np.float32),
        crs=place.crs,
        crs_from_grid=np.array([[10.0, 0.0, 0.0], [0.0, 10.0, 0.0]]),
        sigma_m=0.0,
        source="six nodes",
    )
    ground = Ground(elevation=grid, level_m=np.nan)
    inside = [[0.0, 0.0], [9.0, 0.0], [0.0, 10.0], [5.0, 5.0], [2.0, 5.0]]
    xy = np.array([*inside, [15.0, 5.0], [-1.0, 5.0], [5.0, 11.0]])
    latitude, longitude = place.geographic_from_map(xy).T
    xy_in_grid = ground.columns_rows(latitude, longitude) * 10.0
    assert np.allclose(xy_in_grid, xy, atol=1e-6)
    heights = ground.heights_at_nodes(np.round(xy_in_grid, 6) / 10.0)
    assert heights[:5] == pytest.approx([1.0, 1.9, 3.0, 3.5, 0.2 * 5.0 + 0.8 * 2.0], abs=1e-4)
    assert np.all(np.isnan(heights[5:]))


def test_heights_along_the_path() -> None:
    """A level flight over a plane of slope 0.5 against it: the height above ground changes by half the way."""
    place = local_map(46.0, 7.0)
    plan = made_plan(place, 10.0, 30.0, strips=1, count=11)
    ground = Ground(elevation=plane(place, 0.5, 0.0), level_m=np.nan)
    legs = path_legs(plan.sorties[0], ground, 0.5)
    assert [leg.length_m for leg in legs] == pytest.approx([5.0, 100.0, 4.0], abs=5e-3)
    above = path_heights(plan.sorties[0], ground, 0.5)
    assert above[0] == pytest.approx(HEIGHT_M + 0.5 * 55.0, abs=0.01)
    assert above.min() == pytest.approx(HEIGHT_M - 0.5 * 54.0, abs=0.01)
    found = judge(with_overlaps_told(plan, 0.5, 0.5), request(0.5, 0.0, follow=True), camera(), ground.elevation)
    assert found.clearance_m == pytest.approx(HEIGHT_M - 27.0 - 0.5, abs=0.01)
    assert found.highest_m == pytest.approx(HEIGHT_M + 27.5, abs=0.01)
    assert found.strip_height_deviation == pytest.approx(27.5 / HEIGHT_M, abs=1e-3)
    broken = broken_promises(found, request(0.5, 0.0, follow=True))
    assert any("height off" in text for text in broken)


def test_climb_is_vertical_speed_at_the_speed_over_ground() -> None:
    place = local_map(46.0, 7.0)
    plan = made_plan(place, 10.0, 30.0, strips=1, count=11, slopes=(-0.4, 0.0), speed_m_s=6.0)
    found = judge(with_overlaps_told(plan, 0.5, 0.5), request(0.5, 0.0), camera(), plane(place, -0.4, 0.0))
    assert found.descent_m_s == pytest.approx(0.4 * 6.0, abs=1e-3)
    assert found.climb_m_s == 0.0
    steep = PlanRequest.model_copy(request(0.5, 0.0), update={"flight": FlightRequest(descent_m_s=2.0, climb_m_s=9.0)})
    assert any("descends 2.40" in text for text in broken_promises(found, steep))


def test_ground_that_no_image_shows_is_found() -> None:
    place = local_map(46.0, 7.0)
    plan = with_overlaps_told(made_plan(place, 10.0, 20.0), 0.8, 0.6)
    far = np.array([[0.0, 0.0], [200.0, 0.0], [200.0, 20.0], [0.0, 20.0]])
    area = SurveyArea(name="area", kind=AreaKind.POLYGON, latitude_longitude_deg=place.geographic_from_map(far))
    found = judge(replace(plan, areas=(area,)), request(0.5, 0.5), camera(), None)
    across, _ = half_tangents(camera())
    seen_to = 20.0 + across * HEIGHT_M
    # inner points evenly over the area, and some 400 along the border, of which a part lies beyond, too
    assert found.uncovered == pytest.approx(1.0 - seen_to / 200.0, abs=0.02)
    assert found.least_images == 0


def test_a_wrong_list_of_exposures_is_noticed() -> None:
    plan = with_overlaps_told(made_plan(local_map(46.0, 7.0), 10.0, 20.0), 0.7, 0.7)
    asked = request(0.5, 0.5)

    def faults(changed: FlightPlan) -> str:
        return " ".join(judge(changed, asked, camera(), None).faults)

    assert faults(plan) == ""
    without_base = replace(plan, strips=tuple(replace(strip, base_m=12.0) for strip in plan.strips))
    assert "pictures are taken" in faults(without_base)
    sortie = plan.sorties[0]
    no_exit = tuple(w for w in sortie.waypoints if not (w.role is WaypointRole.EXIT and w.strip == 2))
    assert "no exit" in faults(replace(plan, sorties=(replace(sortie, waypoints=no_exit),)))
    first_strip = tuple(w for w in sortie.waypoints if w.strip == 0)
    assert "in no sortie" in faults(replace(plan, sorties=(replace(sortie, waypoints=first_strip),)))
    skew = replace(plan, exposures=replace(plan.exposures, heading_deg=plan.exposures.heading_deg + 0.2))
    assert "0.20 degrees off its way" in faults(skew)
    assert "turned by 0.20 degrees" in faults(skew)
    alone = tuple(replace(strip, neighbours=()) for strip in plan.strips)
    assert "lie side by side" in faults(replace(plan, strips=alone))
    assert unlisted_neighbours(replace(plan, strips=alone)) == [(0, 1), (1, 2)]
    short = replace(camera(), least_interval_s=2.5)
    assert "the camera needs" in " ".join(judge(plan, asked, short, None).faults)


def test_hovering_takes_one_picture_at_each_stop() -> None:
    place = local_map(46.0, 7.0)
    plan = with_overlaps_told(made_plan(place, 10.0, 20.0, strips=1, count=2), 0.7, 0.7)
    stops = tuple(replace(w, hold_s=2.0) if w.role is WaypointRole.EXPOSURE else w for w in plan.sorties[0].waypoints)
    hover = replace(plan, trigger=Trigger.HOVER, sorties=(replace(plan.sorties[0], waypoints=stops),))
    assert judge(hover, request(0.5, 0.0), camera(), None).faults == []
    passing = replace(hover, sorties=plan.sorties)
    assert "0 pictures are taken" in " ".join(judge(passing, request(0.5, 0.0), camera(), None).faults)


def test_holes_are_not_part_of_the_area() -> None:
    place = local_map(46.0, 7.0)

    def ring(half_m: float) -> Array:
        return place.geographic_from_map(half_m * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]))

    area = SurveyArea(name="a", kind=AreaKind.POLYGON, latitude_longitude_deg=ring(50.0), holes_deg=(ring(20.0),))
    plane_area = PlaneArea(area, Ground(elevation=None, level_m=0.0))
    assert plane_area.polygon.area == pytest.approx(100.0**2 - 40.0**2, rel=1e-4)
    latitude, longitude = place.geographic_from_map(np.array([[0.0, 0.0], [30.0, 0.0], [60.0, 0.0]])).T
    assert plane_area.contains(latitude, longitude).tolist() == [False, True, False]
    assert len(plane_area.inner_xyz_m(2000)) >= 2000


def test_promises_are_judged_by_the_request() -> None:
    kept = Judgement(
        images=1,
        judged_images=1,
        forward_overlap=0.795,
        side_overlap=0.6,
        uncovered=0.0,
        strip_height_deviation=0.3,
        clearance_m=6.0,
        highest_m=100.0,
        slowest_m_s=1.0,
    )
    assert broken_promises(kept, request(0.8, 0.6)) == []
    assert len(broken_promises(kept, request(0.8, 0.6, follow=True))) == 1
    assert len(broken_promises(kept, request(0.82, 0.62))) == 2
    bad = replace(kept, uncovered=0.001, clearance_m=4.0, highest_m=121.0, slowest_m_s=0.0)
    assert len(broken_promises(bad, request(0.8, 0.6))) == 4
