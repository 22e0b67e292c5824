"""From sources to a block: what is taken, what is refused with which words, what is given up and said."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from tests.ingest.synthetic import MemoryStills, MemoryVideo, make_flight, texture
from uavkit.core.camera import CameraProfile, InteriorOrientation, InteriorSigmas
from uavkit.core.errors import InputError
from uavkit.core.frames import LocalFrame, geoid_undulation_m
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix, StillInfo
from uavkit.formats.control_file import FileMark, FilePoint, PixelOrigin, SurveyedPoints
from uavkit.ingest.build_block import IngestOptions, Sources, build_block

HERE = LocalFrame.at(35.8, 139.65, 60.0, "EPSG:32654")


@lru_cache(maxsize=1)
def flight():
    return make_flight(seed=2, stations=4, gap=(30, 40))


def camera(width=1600, height=1200):
    return CameraProfile(
        name="Test", maker="Ricoh", models=("GX200",), sensor_width_mm=7.6, focal_length_mm=5.1,
        interior=InteriorOrientation(
            width_px=width, height_px=height, principal_distance_px=0.67 * width, x0_px=(width - 1) / 2,
            y0_px=(height - 1) / 2,
        ),
        interior_sigmas=InteriorSigmas(principal_distance_px=5.0),
    )  # fmt: skip


class Positions:
    def __init__(self, enu, datum=HeightDatum.ELLIPSOID, geoid=False, **more):
        place = HERE.geographic_from_enu(np.asarray(enu, float))
        if geoid:
            place[:, 2] -= geoid_undulation_m(place[:, 0], place[:, 1])
        self._fixes = [
            GnssFix(
                gps_time_ns=None, latitude_deg=a, longitude_deg=b, height_m=c, height_datum=datum, name=f"W{k}", **more
            )
            for k, (a, b, c) in enumerate(place)
        ]

    def fixes(self):
        yield from self._fixes


STATIONS = np.array([[7.0 * k, 0.3 * k, 15.0 + 0.1 * k] for k in range(4)])


def points(
    count=3, crs="EPSG:32654", images=("R000.jpg", "R001.jpg"), shift=(0.0, 0.0, 0.0), prefix="G", at=(800, 600)
):
    enu = np.array([[5.0 * k, 2.0 * (k % 2), 0.0] for k in range(count)])
    place = HERE.crs_from_enu(enu) + np.array(shift)
    return SurveyedPoints(
        crs=crs, vertical=HeightDatum.ELLIPSOID, pixel_origin=PixelOrigin.CENTRE, source="control.csv",
        points=tuple(
            FilePoint(
                name=f"{prefix}{k + 1}", coordinates=tuple(map(float, p)), sigma_m=(0.01, 0.01, 0.02), line=10 * k,
                marks=tuple(
                    FileMark(image=i, column_px=at[0], row_px=at[1], sigma_px=0.5, line=10 * k + n)
                    for n, i in enumerate(images)
                ),
            )
            for k, p in enumerate(place)
        ),
    )  # fmt: skip


def block_of(stills=None, options=None, **sources):
    return build_block(Sources(stills=stills or flight().stills, **sources), camera(), options or IngestOptions())


def told(block):
    return "\n".join(block.notes)


def test_everything_together():
    made = flight()
    block = block_of(video=made.video(), positions=Positions(STATIONS), control=points(), check=points(prefix="C"))
    assert [place.last_frame for place in block.video.places] == made.last_frame
    assert block.frame.crs == "EPSG:32654"
    north = block.frame.enu_from_geographic(*HERE.geographic_from_enu(STATIONS).T)
    assert np.allclose(block.gnss.position_m, north, atol=1e-6)
    assert np.allclose(block.gnss.sigma_m, [1.0, 1.0, 2.0])
    assert block.gnss.shift_sigma_m is None
    assert [p.name for p in block.control_points] == ["G1", "G2", "G3"]
    expected = block.frame.enu_from_geographic(*HERE.geographic_from_enu(np.array([[5.0, 2.0, 0.0]])).T)[0]
    assert np.allclose(block.control_points[1].position_m, expected, atol=1e-4)
    assert [p.name for p in block.check_points] == ["C1", "C2", "C3"]
    assert "free network" not in told(block)


def test_geoid_heights_are_converted_and_an_override_counts():
    geoid = block_of(positions=Positions(STATIONS, HeightDatum.GEOID, geoid=True))
    plain = block_of(positions=Positions(STATIONS))
    assert np.ptp(geoid.gnss.position_m[:, 2] - plain.gnss.position_m[:, 2]) < 1e-3
    assert geoid.frame.height_ellipsoid_m == pytest.approx(plain.frame.height_ellipsoid_m, abs=0.02)
    over = block_of(
        positions=Positions(STATIONS, HeightDatum.GEOID, geoid=True),
        options=IngestOptions(height_datum=HeightDatum.ELLIPSOID),
    )
    assert over.frame.height_ellipsoid_m == pytest.approx(plain.frame.height_ellipsoid_m - 38, abs=6)


def test_unknown_height_datum_widens_the_vertical_shift_without_control():
    block = block_of(positions=Positions(STATIONS, HeightDatum.UNKNOWN))
    assert block.gnss.shift_sigma_m == (2.0, 2.0, 100.0)
    assert "the datum of the positions' heights is unknown" in told(block)
    assert block_of(positions=Positions(STATIONS, HeightDatum.UNKNOWN), control=points()).gnss.shift_sigma_m is None


def test_heights_above_ground_count_horizontally_only():
    block = block_of(positions=Positions(STATIONS, HeightDatum.GROUND))
    assert np.all(block.gnss.sigma_m[:, 2] >= 100.0)
    assert "only their horizontal part" in told(block)


def test_mixed_height_datums_are_refused():
    one, two = Positions(STATIONS), Positions(STATIONS, HeightDatum.GEOID)
    one._fixes[2] = two._fixes[2]
    with pytest.raises(InputError, match=r"different datums \(ellipsoid, geoid\).*--height-datum"):
        block_of(positions=one)


def test_without_listed_positions_exif_is_used():
    fixes = list(Positions(STATIONS, HeightDatum.UNKNOWN).fixes())
    infos = [replace(i, position=f) for i, f in zip(flight().stills.infos, fixes, strict=True)]
    block = block_of(MemoryStills(infos, flight().stills.pictures))
    assert len(block.gnss) == 4
    assert np.allclose(block.gnss.sigma_m, [1.5, 1.5, 3.0])
    assert "positions from the EXIF of 4 stills" in told(block)


def test_without_anything_the_block_is_a_free_network_and_says_so():
    block = block_of()
    assert block.frame is None
    assert block.gnss is None
    assert "0 control points and 0 positions do not fix the block" in told(block)
    few = block_of(control=points(2))
    assert "2 control points and 0 positions do not fix the block" in told(few)
    assert "free network" not in told(block_of(control=points(3)))


@pytest.mark.parametrize("change", [-1, 1])
def test_positions_of_another_count_are_never_shifted(change):
    listed = STATIONS[:3] if change < 0 else np.vstack([STATIONS, STATIONS[3] + [7.0, 0, 0]])
    block = block_of(positions=Positions(listed))
    assert block.gnss is None or np.all(block.gnss.image_index < 4)
    assert f"{4 + change} positions are" in told(block)
    assert block.gnss is None  # 4 stills at about equal intervals: nothing settles which one it is
    assert "free network" in told(block)


def test_a_still_that_cannot_be_read_is_named_and_the_rest_goes_on():
    made = flight()
    stills = MemoryStills(made.stills.infos, made.stills.pictures, broken={"R001.jpg"})
    block = block_of(stills, video=made.video(), positions=Positions(STATIONS), control=points())
    assert [s.name for s in block.stills] == ["R000.jpg", "R002.jpg", "R003.jpg"]
    assert "1 stills cannot be read and are left out: R001.jpg" in told(block)
    assert list(block.gnss.image_index) == [0, 1, 2]
    kept = block.frame.enu_from_geographic(*HERE.geographic_from_enu(STATIONS[[0, 2, 3]]).T)
    assert np.allclose(block.gnss.position_m, kept, atol=1e-6)  # the lost still keeps its place in the order
    assert "image 'R001.jpg' cannot be read; mark left out" in told(block)
    assert [p.still for p in block.video.places] == ["R000.jpg", "R002.jpg", "R003.jpg"]


def test_a_source_that_knows_of_unreadable_files_is_heard():
    class Told(MemoryStills):
        def unreadable(self):
            return {"R004.jpg": "the file is empty"}

    block = block_of(Told(flight().stills.infos, flight().stills.pictures))
    assert "R004.jpg: the file is empty" in told(block)
    with pytest.raises(InputError, match="no still can be read: R004"):
        block_of(Told((), {}))


def test_two_cameras_are_refused_by_name():
    infos = list(flight().stills.infos)
    infos[1] = replace(infos[1], model="GR")
    with pytest.raises(InputError, match=r"3 stills 1600 x 1200 px of Ricoh GX200 \(R000.jpg, ...\); 1 stills .* GR"):
        block_of(MemoryStills(infos, flight().stills.pictures))


def test_a_camera_of_another_shape_is_refused_and_of_another_size_scaled():
    with pytest.raises(InputError, match="another shape"):
        build_block(Sources(stills=flight().stills), camera(1600, 900))
    block = build_block(Sources(stills=flight().stills), camera(4000, 3000))
    assert block.interior.width_px == 1600
    assert block.interior.principal_distance_px == pytest.approx(0.67 * 1600)
    assert block.interior.x0_px == pytest.approx(799.5)


def test_control_in_the_wrong_crs_is_refused_with_the_distance():
    with pytest.raises(InputError, match=r"lie 54\d km from the nearest exposure station .*EPSG:32653"):
        block_of(positions=Positions(STATIONS), control=replace(points(), crs="EPSG:32653"))
    off = points()
    bad = replace(off.points[1], coordinates=(off.points[1].coordinates[0] + 4200.0, *off.points[1].coordinates[1:]))
    with pytest.raises(InputError, match=r"line 10: point 'G2' lies 4.2 km from the nearest"):
        block_of(positions=Positions(STATIONS), control=replace(off, points=(off.points[0], bad, off.points[2])))
    with pytest.raises(InputError, match=r"point 'G2' lies 4.2 km from the other points"):
        block_of(control=replace(off, points=(off.points[0], bad, off.points[2])))


def test_marks_on_unknown_images():
    case = block_of(control=points(images=("r000.JPG", "R001")))
    assert {m.image for m in case.control_points[0].marks} == {"R000.jpg", "R001.jpg"}
    assert "image 'r000.JPG' is taken for 'R000.jpg'" in told(case)
    some = block_of(control=points(images=("R000.jpg", "R009.jpg")))
    assert len(some.control_points[0].marks) == 1
    assert "line 1: image 'R009.jpg' is none of the stills; did you mean 'R00" in told(some)
    with pytest.raises(InputError, match=r"none of its 6 marks .*'IMG_1.png'.*the file of this flight"):
        block_of(control=points(images=("IMG_1.png", "IMG_2.png")))


def test_heights_of_control_without_a_datum_are_told():
    silent = replace(points(), vertical=HeightDatum.UNKNOWN)
    assert "control.csv: says not what its heights count from: taken as ellipsoidal" in told(block_of(control=silent))
    assert "count from" not in told(block_of(control=points()))


def test_a_mark_outside_of_its_image_is_refused():
    with pytest.raises(InputError, match=r"line 0: the mark of 'G1' at \(600, 1300\) lies outside of R000.jpg"):
        block_of(control=points(at=(600, 1300)))


def test_a_point_cannot_be_control_and_check():
    with pytest.raises(InputError, match="both control and check: G1, G2, G3"):
        block_of(control=points(), check=points())


def test_images_that_do_not_overlap_are_refused():
    rng = np.random.default_rng(0)
    infos = [StillInfo(name=f"{k}.jpg", width_px=1600, height_px=1200) for k in range(3)]
    pictures = {info.name: texture(rng, (1200, 1600)) for info in infos}
    with pytest.raises(InputError, match="no two of the 3 stills show the same ground"):
        block_of(MemoryStills(infos, pictures))
    with pytest.raises(InputError, match="1 still is no block"):
        block_of(MemoryStills(infos[:1], pictures))


def test_a_still_of_another_place_is_named():
    made = flight()
    alien = StillInfo(name="R900.jpg", width_px=1600, height_px=1200, maker="Ricoh", model="GX200")
    pictures = {**made.stills.pictures, "R900.jpg": texture(np.random.default_rng(1), (1200, 1600))}
    block = block_of(MemoryStills([*made.stills.infos, alien], pictures))
    assert "1 stills show nothing that their neighbours in time show: R900.jpg" in told(block)


def test_a_video_of_nothing_is_given_up_with_a_reason():
    frames = [np.full((480, 640), 90, dtype=np.uint8)] * 12
    block = block_of(video=MemoryVideo(frames))
    assert block.video is None
    assert "video not used because" in told(block)
    assert "no video" in told(block_of())


def test_heights_that_cannot_be_are_pointed_out():
    block = block_of(positions=Positions(STATIONS - [0, 0, 40.0]), control=points())
    assert "m above the surveyed points by their heights" in told(block)


def test_options_are_checked():
    with pytest.raises(ValueError, match="heights above ground"):
        IngestOptions(height_datum=HeightDatum.GROUND)
