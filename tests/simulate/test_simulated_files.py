"""The files of a simulated survey look like a camera's, decode, agree with the truth and depend on the seed alone."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from uavkit.core.errors import InputError
from uavkit.core.records import FieldOrder
from uavkit.formats.control_file import read_surveyed_points
from uavkit.formats.video import FileVideoSource
from uavkit.simulate.control import surveyed
from uavkit.simulate.flight import FieldState
from uavkit.simulate.options import SimulationOptions, VideoStandard
from uavkit.simulate.survey import Scene, SimulatedSurvey, make_scene, simulate_survey
from uavkit.simulate.truth import read_truth
from uavkit.simulate.video import HEIGHT_PX, write_frames


@pytest.fixture(scope="module")
def frames(smallest_survey: SimulatedSurvey) -> list[np.ndarray]:
    """Luminance of all frames as an independent decoder gives it."""
    with av.open(str(smallest_survey.video)) as container:
        return [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]


def test_all_files_are_there(smallest_survey: SimulatedSurvey) -> None:
    paths = smallest_survey
    assert sorted(p.name for p in paths.stills.iterdir()) == ["R0010001.JPG", "R0010002.JPG"]
    for path in (paths.video, paths.positions, paths.control_points, paths.check_points, paths.gcp_list, paths.truth):
        assert path is not None
        assert path.stat().st_size > 100
    assert (paths.folder / "README.txt").exists()
    assert (paths.folder / "truth" / "field_poses.npz").exists()


def test_exif_is_a_cameras(smallest_survey: SimulatedSurvey) -> None:
    truth = read_truth(smallest_survey.truth)
    with Image.open(smallest_survey.stills / "R0010001.JPG") as still:
        exif = still.getexif()
        details = exif.get_ifd(0x8769)
        assert still.size == (600, 450)
        assert (exif[0x010F], exif[0x0110]) == ("RICOH", "GX200")
        assert float(details[0x920A]) == pytest.approx(5.1)
        assert len(details[0x9003]) == 19  # whole seconds
        assert not exif.get_ifd(0x8825)  # no position
    assert 60 <= abs(truth["camera_clock"]["offset_s"]) <= 400


def test_video_decodes_into_the_stated_frames(smallest_survey: SimulatedSurvey, frames: list[np.ndarray]) -> None:
    truth = read_truth(smallest_survey.truth)["video"]
    assert len(frames) == truth["frames"]
    assert frames[0].shape == (480, 640)
    with av.open(str(smallest_survey.video)) as container:
        stream = container.streams.video[0]
        assert float(stream.average_rate) == pytest.approx(30000 / 1001)
        assert stream.codec_context.name == "mpeg4"
        assert next(container.decode(stream)).interlaced_frame


@pytest.mark.parametrize("order", [FieldOrder.TOP_FIRST, FieldOrder.BOTTOM_FIRST])
def test_the_file_states_its_field_order(order: FieldOrder, tmp_path: Path) -> None:
    planes = np.full((720, 640), 128, dtype=np.uint8)
    planes[:480:2] = 60
    planes[1:480:2] = 180
    write_frames(tmp_path / "fields.avi", [planes] * 3, Fraction(25, 1), order)
    info = FileVideoSource(tmp_path / "fields.avi").info()
    assert info.field_order is order
    assert info.frame_interval_ns == 40_000_000


def test_fields_lie_in_the_stated_order(smallest_scene: Scene, frames: list[np.ndarray]) -> None:
    """While the camera moves fast, the even lines are the picture of the second field's instant (bottom first)."""
    finder, flight = smallest_scene.finder(), smallest_scene.flight
    states = flight.states.state.reshape(-1, 2)
    live = np.flatnonzero((states == FieldState.LIVE).all(axis=1))
    times = 2 * live * flight.field_interval_s
    speed = np.linalg.norm(flight.positions_m(times + 0.02) - flight.positions_m(times), axis=1)
    number = int(live[np.argmax(speed)])
    assert finder.row_of(2 * number) == 1
    frame = frames[number].astype(float)
    for index in (2 * number, 2 * number + 1):
        right = finder._render(index * flight.field_interval_s, finder.row_of(index))[:, :, 1]
        wrong = finder._render((4 * number + 1 - index) * flight.field_interval_s, finder.row_of(index))[:, :, 1]
        lines = frame[finder.row_of(index) : HEIGHT_PX : 2]
        assert _likeness(lines, right) > 0.9
        assert _likeness(lines, right) > _likeness(lines, wrong) + 0.1


def _likeness(lines: np.ndarray, picture: np.ndarray) -> float:
    middle = np.s_[20:-20, 40:-40]
    return float(np.corrcoef(lines[middle].ravel(), picture[middle].ravel())[0, 1])


def test_black_and_frozen_where_stated(smallest_survey: SimulatedSurvey, frames: list[np.ndarray]) -> None:
    truth = read_truth(smallest_survey.truth)
    poses = np.load(smallest_survey.folder / "truth" / "field_poses.npz")
    first = truth["video"]["field_order"] == "bottom"
    brightness = [[frame[(half == 0) == first :: 2].mean() for half in (0, 1)] for frame in frames]
    black = np.array(brightness).ravel() < 30
    assert np.array_equal(black, poses["state"] == FieldState.BLACK)
    for exposure in truth["exposures"]:
        start = 2 * exposure["first_black_frame"] + exposure["first_black_field"]
        assert black[start]
        assert not black[start - 1]
        gap_s = exposure["video_time_s"] - poses["time_s"][start - 1]
        assert 0.0 < gap_s < 0.007
        length = int(np.argmin(black[start:]))
        assert 12 <= length <= 20
        number = (start + length) // 2 + 2
        still = np.abs(frames[number].astype(float) - frames[number + 1])[::2]
        assert still.mean() < 6.0  # frozen: noise only


def test_same_seed_same_bytes(smallest_survey: SimulatedSurvey, smallest_scene: Scene, tmp_path: Path) -> None:
    """With another number of workers too."""
    again = simulate_survey(tmp_path, replace(smallest_scene.options, workers=1))
    for path in sorted(p for p in smallest_survey.folder.rglob("*") if p.is_file()):
        other = again.folder / path.relative_to(smallest_survey.folder)
        assert path.read_bytes() == other.read_bytes(), path.name


def test_still_shows_what_the_finder_shows(smallest_scene: Scene, frames: list[np.ndarray], smallest_survey) -> None:
    """The stated transformation brings the last live frame onto the still."""
    from scipy import ndimage

    for index, name in enumerate(smallest_scene.names):
        with Image.open(smallest_survey.stills / name) as picture:
            still = np.asarray(picture.convert("L"), dtype=float)
        last = int(smallest_scene.flight.last_live_field[index])
        finder = smallest_scene.finder()
        row = finder.row_of(last)
        rows, columns = np.mgrid[row + 20 : 460 : 2, 30:610]
        at = finder.geometry.still_from_video(np.stack([columns, rows], axis=-1).astype(float))
        sampled = ndimage.map_coordinates(still, [at[..., 1], at[..., 0]], order=1)
        field = frames[last // 2][row + 20 : 460 : 2, 30:610].astype(float)
        assert np.corrcoef(sampled.ravel(), field.ravel())[0, 1] > 0.85


def test_surveyed_points_have_the_stated_noise(smallest_scene: Scene) -> None:
    """Over many draws the marks scatter about the truth by their sigma, the coordinates by theirs."""
    marks, places = [], []
    for stream in range(60):
        points = surveyed(smallest_scene.control, 0.005, smallest_scene.options, 100 + stream)
        for point, true in zip(points.points, smallest_scene.control, strict=True):
            places.append(point.coordinates)
            marks += [[m.column_px, m.row_px] - p for m, p in zip(point.marks, true.pixels, strict=True)]
    count = len(np.ravel(marks))
    assert abs(np.std(marks) / 0.3 - 1) < 4 / np.sqrt(2 * count)
    spread = np.array(places).reshape(60, 3, 3).std(axis=0, ddof=1)
    assert abs(np.sqrt(np.mean(spread**2)) / 0.005 - 1) < 4 / np.sqrt(2 * 59 * 9)


def test_control_file_reads_back(smallest_survey: SimulatedSurvey, smallest_scene: Scene) -> None:
    """Coordinates by a formula of its own: the ellipsoid's axes and the transverse Mercator of pyproj."""
    import pyproj

    points = read_surveyed_points(smallest_survey.control_points)
    assert [p.name for p in points.points] == ["G1", "G2", "G3"]
    to_geocentric = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    origin = np.array(to_geocentric.transform(139.65, 35.8, 45.0))
    latitude, longitude = np.radians([35.8, 139.65])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    axes = np.column_stack([east, np.cross(up, east), up])
    from_utm = pyproj.Transformer.from_crs("EPSG:32654", "EPSG:4326", always_xy=True)
    for point, true in zip(points.points, smallest_scene.control, strict=True):
        longitude_deg, latitude_deg = from_utm.transform(*point.coordinates[:2])
        geocentric = np.array(to_geocentric.transform(longitude_deg, latitude_deg, point.coordinates[2]))
        assert np.abs(axes.T @ (geocentric - origin) - true.position_m).max() < 5 * 0.005


def test_waypoints_are_off_as_stated(smallest_scene: Scene) -> None:
    many = make_scene(replace(smallest_scene.options, strips=3, stations_per_strip=11, gnss_outliers=3))
    truth = many.flight.positions_m(many.flight.exposure_s)
    error = np.linalg.norm(many.waypoints.measured_m - many.waypoints.shift_m - truth, axis=1)
    outliers = np.zeros(33, dtype=bool)
    outliers[many.waypoints.outliers] = True
    assert outliers.sum() == 3
    assert error[outliers].min() > 8.0
    assert error[~outliers].max() < 5.0
    assert 0.7 < np.sqrt(np.mean(error[~outliers] ** 2) / 3) < 1.3


@pytest.mark.parametrize(
    ("option", "value"),
    [("scale", 0.05), ("scale", 2.0), ("strips", 0), ("field_order", FieldOrder.PROGRESSIVE), ("gnss_outliers", 20)],
)
def test_options_outside_their_range_are_refused(option: str, value: object) -> None:
    with pytest.raises(InputError, match=option):
        SimulationOptions(**{option: value})


def test_pal_has_its_own_times(smallest_scene: Scene) -> None:
    pal = make_scene(
        replace(smallest_scene.options, video_standard=VideoStandard.PAL, field_order=FieldOrder.TOP_FIRST)
    )
    assert pal.flight.field_interval_s == pytest.approx(0.02)
    assert pal.finder().row_of(0) == 0


def test_another_survey_in_the_folder_is_refused(smallest_survey: SimulatedSurvey, smallest_scene: Scene) -> None:
    with pytest.raises(InputError, match=r"R0010002\.JPG|video\.avi"):
        simulate_survey(smallest_survey.folder, replace(smallest_scene.options, video_standard=VideoStandard.NONE))


def test_rtk_has_no_shift_of_metres_and_a_file_that_says_so(smallest_scene: Scene) -> None:
    """Errors stay within five sigma of the stated noise; SBAS is off by more than a metre altogether."""
    from uavkit.simulate.positions import RTK_SHIFT_SIGMA_M

    asked = replace(smallest_scene.options, strips=3, stations_per_strip=11, gnss_outliers=0)
    rtk, sbas = (make_scene(replace(asked, gnss_sigma_m=sigma)) for sigma in (0.02, 1.0))
    true_m = rtk.flight.positions_m(rtk.flight.exposure_s)
    off_m = rtk.waypoints.measured_m - true_m
    assert np.abs(off_m).max() < 5 * 0.02
    assert 0.7 < off_m.std() / 0.02 < 1.3
    assert np.abs(rtk.waypoints.shift_m).max() < 1.5 * RTK_SHIFT_SIGMA_M
    assert np.abs(sbas.waypoints.shift_m).min() >= 1.0
    told = rtk.waypoints.of_images(rtk.names, 0.02)
    assert [fix.name for fix in told.fixes] == list(rtk.names)
    assert {fix.sigma_vertical_m for fix in told.fixes} == {0.02}
    assert told.shift_sigma_m == (RTK_SHIFT_SIGMA_M,) * 3
    assert sbas.waypoints.of_images(sbas.names, 1.0).shift_sigma_m is None


def test_positions_by_image_are_those_of_the_waypoints(smallest_survey: SimulatedSurvey, smallest_scene: Scene) -> None:
    from uavkit.formats.positions_file import read_image_positions
    from uavkit.simulate.site import site_frame

    fixes = read_image_positions(smallest_survey.image_positions).fixes
    place = np.array([[fix.latitude_deg, fix.longitude_deg, fix.height_m] for fix in fixes])
    measured = site_frame().enu_from_geographic(*place.T)
    assert np.abs(measured - smallest_scene.waypoints.measured_m).max() < 2e-4


def test_without_points_no_file_of_points_is_written(smallest_scene: Scene, tmp_path: Path) -> None:
    asked = replace(
        smallest_scene.options, scale=0.1, video_standard=VideoStandard.NONE, control_points=0, check_points=0
    )
    paths = simulate_survey(tmp_path, asked)
    assert (paths.control_points, paths.check_points, paths.gcp_list) == (None, None, None)
    assert not list(tmp_path.glob("*points*"))
    assert "control" not in (tmp_path / "README.txt").read_text(encoding="utf-8")
    (tmp_path / "control_points.csv").write_text("of another survey", encoding="utf-8")
    with pytest.raises(InputError, match=r"control_points\.csv"):
        simulate_survey(tmp_path, asked)
