"""Camera profiles: every file valid, found by any spelling, refused with the nearest right key."""

import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from pydantic import Field

from uavkit.core.camera import pixels_from_ideal
from uavkit.core.errors import InputError
from uavkit.core.records import StillInfo
from uavkit.formats import camera_profiles
from uavkit.formats.camera_profiles import (
    camera_folder,
    camera_for_exif,
    camera_from_exif,
    interior_for_size,
    list_cameras,
    load_camera,
    read_camera,
)
from uavkit.formats.options_file import StrictModel, read_toml

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", list_cameras())
def test_each_profile_agrees_with_its_own_figures(name: str) -> None:
    camera = load_camera(name)
    from_sensor_px = camera.focal_length_mm / camera.pixel_size_mm
    sigma_px = camera.interior_sigmas.principal_distance_px
    assert abs(camera.interior.principal_distance_px - from_sensor_px) < sigma_px
    assert 0.005 < sigma_px / camera.interior.principal_distance_px <= 0.15  # 15 %: a crop that the maker hides
    assert camera.interior.x0_px == (camera.interior.width_px - 1) / 2
    assert camera.interior.y0_px == (camera.interior.height_px - 1) / 2
    assert np.all(camera.interior_sigmas.values()[:8] > 0)
    assert camera_for_exif(camera.maker, camera.models[0]) == camera


@pytest.mark.parametrize("name", ["Ricoh GX200", "ricoh-gx200", "RICOH_GX 200", "gx200", "ricoh_gx200"])
def test_spelling_does_not_count(name: str) -> None:
    camera = load_camera(name)
    assert (camera.name, camera.sensor_width_mm, camera.interior.width_px) == ("Ricoh GX200", 7.6, 4000)
    assert camera.pixel_size_mm == pytest.approx(1.9e-3)


def test_unknown_names_meet_the_nearest_one() -> None:
    with pytest.raises(InputError, match=r"no camera 'Rico GX20'; did you mean 'Ricoh GX200'\? .*DJI FC300S"):
        load_camera("Rico GX20")
    with pytest.raises(InputError, match="no camera ''"):
        load_camera("")


@pytest.mark.parametrize(
    "maker, model, name",
    [
        ("DJI", "FC300S", "DJI FC300S"),
        ("RICOH     ", "GX200          ", "Ricoh GX200"),
        ("Hasselblad", "L1D-20c", "DJI L1D-20c"),
        ("SONY", "DSC-RX1RM2", "Sony RX1R II"),
        ("DJI", "FC6310R", "DJI FC6310R"),
    ],
)
def test_exif_names_find_their_profile(maker: str, model: str, name: str) -> None:
    camera = camera_for_exif(maker, model)
    assert camera is not None
    assert camera.name == name


def test_other_cameras_have_none() -> None:
    assert camera_for_exif("DJI", "FC9999") is None
    assert camera_for_exif("Canon", "GX200") is None
    assert camera_for_exif("", "") is None


def still(**more: object) -> StillInfo:
    return StillInfo(**({"name": "a.jpg", "width_px": 6000, "height_px": 4000, "maker": "X", "model": "Y"} | more))  # type: ignore[arg-type]


def test_profile_from_exif_alone() -> None:
    camera = camera_from_exif(still(focal_length_mm=20.0, focal_length_35mm=30.0))
    assert camera.interior.principal_distance_px == pytest.approx(30 / 36 * 6000)  # 3:2 as film
    assert camera.sensor_width_mm == pytest.approx(24.0)
    assert camera.interior_sigmas.principal_distance_px == pytest.approx(250.0)
    with pytest.raises(InputError, match=r"a\.jpg: X Y has no profile"):
        camera_from_exif(still(focal_length_mm=20.0))


def test_crop_keeps_directions_of_the_middle() -> None:
    camera = load_camera("DJI FC6310")
    directions = np.array([[0.0, 0.0], [0.1, -0.2], [-0.3, 0.15]])
    whole = pixels_from_ideal(directions, camera.interior)
    wide = interior_for_size(camera, 5472, 3078)
    assert np.allclose(pixels_from_ideal(directions, wide.interior), whole - [0, 285])
    assert wide.pixel_size_mm == pytest.approx(camera.pixel_size_mm)
    tall = interior_for_size(wide, 5472, 3648)
    assert np.allclose(tall.interior.parameters(), camera.interior.parameters())
    narrow = interior_for_size(camera, 4864, 3648)
    assert np.allclose(pixels_from_ideal(directions, narrow.interior), whole - [304, 0])
    small = interior_for_size(camera, 2736, 1824)
    assert np.allclose(pixels_from_ideal(directions, small.interior), (whole + 0.5) / 2 - 0.5)
    assert small.sensor_width_mm == pytest.approx(13.2)
    assert small.interior_sigmas.x0_px == pytest.approx(camera.interior_sigmas.x0_px / 2)
    assert interior_for_size(camera, 5472, 3648) == camera


def spoiled(tmp_path: Path, old: str, new: str) -> Path:
    text = (camera_folder() / "ricoh_gx200.toml").read_text()
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("focal_length_mm", "focal_lenght_mm", "has no option 'focal_lenght_mm'; did you mean 'focal_length_mm'"),
        ("width_px", "widht_px", r"\[interior\] has no option 'widht_px'; did you mean 'width_px'"),
        ("k3 = 0.05", "k4 = 0.05", r"\[sigmas\] has no option 'k4'; did you mean 'k"),
        ("width_px = 4000", 'width_px = "4000"', r"\[interior\] width_px = '4000'"),
        ("width_px = 4000", "width_px = -4", r"\[interior\] width_px = -4"),
        ("[interior]", "[interior", "no valid TOML: .*line"),
    ],
)
def test_profiles_are_read_strictly(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(InputError, match=rf"mine\.toml: {words}"):
        read_camera(spoiled(tmp_path, old, new))


def test_a_profile_of_ones_own(tmp_path: Path) -> None:
    path = spoiled(tmp_path, 'name = "Ricoh GX200"', 'name = "mine"')
    assert load_camera(str(path)).name == "mine"
    with pytest.raises(InputError, match=r"absent\.toml"):
        load_camera(str(tmp_path / "absent.toml"))


class _Inner(StrictModel):
    side_overlap: float = Field(default=0.6, ge=0, lt=1)


class _Options(StrictModel):
    survey: _Inner = _Inner()
    more: list[_Inner] = Field(default_factory=list)


@pytest.mark.parametrize(
    "text, words",
    [
        ("[survey]\nside_overlp = 0.5\n", r"\[survey\] has no option 'side_overlp'; did you mean 'side_overlap'\?"),
        ("[[more]]\nside_overlp = 0.5\n", r"\[more\.0\] has no option 'side_overlp'; did you mean 'side_overlap'\?"),
        ("[surve]\n", r"has no option 'surve'; did you mean 'survey'\?"),
        ("[survey]\nside_overlap = 1.5\n", r"\[survey\] side_overlap = 1\.5"),
        ("[survey]\nside_overlap = true\n", r"\[survey\] side_overlap = True"),
    ],
)
def test_options_name_the_nearest_key(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "survey.toml").write_text(text)
    with pytest.raises(InputError, match=rf"survey\.toml: {words}"):
        read_toml(tmp_path / "survey.toml", _Options)


def test_profiles_are_found_where_a_wheel_puts_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "site-packages" / "uavkit"
    (package / "data" / "cameras").mkdir(parents=True)
    monkeypatch.setattr(camera_profiles, "PACKAGE", package)
    assert camera_folder() == package / "data" / "cameras"
    (package / "data" / "cameras").rmdir()
    with pytest.raises(InputError, match="install uavkit again"):
        camera_folder()


def test_a_built_wheel_holds_the_profiles(tmp_path: Path) -> None:
    pytest.importorskip("hatchling")
    if not (ROOT / "README.md").is_file():
        pytest.skip("a wheel needs the README")
    build = "from hatchling.build import build_wheel; import sys; print(build_wheel(sys.argv[1]))"
    run = subprocess.run([sys.executable, "-c", build, str(tmp_path)], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    look_up = "from uavkit.formats.camera_profiles import *; print(camera_folder(), len(list_cameras()))"
    run = subprocess.run([sys.executable, "-c", look_up], cwd=tmp_path / "site", capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == [str(tmp_path / "site" / "uavkit" / "data" / "cameras"), str(len(list_cameras()))]
