"""What ingest and process leave on disk: nothing is lost, damage is named."""

import json
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.formats.blocks import oriented_block, small_block, without_check_points
from uavkit.core.errors import InputError
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix, StillInfo
from uavkit.formats.adjustment_file import (
    adjustment_summary,
    read_oriented_block,
    write_adjustment,
    write_oriented_block,
)
from uavkit.formats.block_file import read_block, write_block


def same(one: Any, two: Any) -> bool:
    """Tell whether two records are equal to the bit and of the same types; NaN equals NaN."""
    if type(one) is not type(two):
        return False
    if isinstance(one, np.ndarray):
        return one.dtype == two.dtype and one.shape == two.shape and one.tobytes() == two.tobytes()
    if is_dataclass(one):
        return all(same(getattr(one, field.name), getattr(two, field.name)) for field in fields(one))
    if isinstance(one, dict):
        return one.keys() == two.keys() and all(same(one[key], two[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(two) and all(same(a, b) for a, b in zip(one, two, strict=True))
    return bool(one == two) or (one != one and two != two)


def test_a_block_comes_back_to_the_bit(tmp_path: Path) -> None:
    for block in (small_block(), small_block(None), replace(small_block(), gnss=None, video=None)):
        write_block(tmp_path / "block.json", block)
        assert same(read_block(tmp_path / "block.json"), block)
    assert "NaN" not in (tmp_path / "block.json").read_text()


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, derandomize=True)
@given(
    st.builds(
        StillInfo,
        name=st.text(),
        width_px=st.integers(1, 10**6),
        height_px=st.integers(1, 10**6),
        model=st.text(),
        focal_length_mm=st.none() | st.floats(),
        camera_time_ns=st.none() | st.integers(-(2**70), 2**70),
        position=st.none()
        | st.builds(
            GnssFix,
            gps_time_ns=st.none() | st.integers(),
            latitude_deg=st.floats(-90, 90),
            longitude_deg=st.floats(-180, 180),
            height_m=st.floats(),
            height_datum=st.sampled_from(HeightDatum),
        ),
    )
)
def test_any_still_comes_back_to_the_bit(tmp_path: Path, still: StillInfo) -> None:
    block = replace(small_block(), stills=(still,), gnss=None)
    write_block(tmp_path / "block.json", block)
    assert same(read_block(tmp_path / "block.json").stills, (still,))


def edited(tmp_path: Path, *place: Any, value: Any) -> Path:
    write_block(tmp_path / "block.json", small_block())
    content = json.loads((tmp_path / "block.json").read_text())
    part = content
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    (tmp_path / "block.json").write_text(json.dumps(content))
    return tmp_path / "block.json"


@pytest.mark.parametrize(
    "place, value, words",
    [
        (("format",), "other", "no block of uavkit"),
        (("version",), 99, "version 99"),
        (("block", "stils"), 1, "block has no 'stils'; did you mean 'stills'"),
        (("block", "stills", 1, "width_px"), "wide", r"block\.stills\[1\]\.width_px should be of type int"),
        (("block", "frame", "latitude_deg"), None, r"frame\.latitude_deg should be a number"),
        (("block", "video", "field_order"), "UPSIDE", "one of PROGRESSIVE"),
        (("block", "gnss", "sigma_m", "values"), [1.0], r"gnss\.sigma_m is no array"),
        (("block", "control_points", 0, "sigma_m"), [0.0, 1.0, 1.0], "sigma_m must be > 0"),
    ],
)
def test_a_block_that_does_not_fit_is_refused(tmp_path: Path, place: tuple[Any, ...], value: Any, words: str) -> None:
    with pytest.raises(InputError, match=rf"block\.json: .*{words}"):
        read_block(edited(tmp_path, *place, value=value))


def test_damaged_and_missing_blocks(tmp_path: Path) -> None:
    write_block(tmp_path / "block.json", small_block())
    text = (tmp_path / "block.json").read_text()
    (tmp_path / "block.json").write_text(text[: len(text) // 2])
    for name in ("block.json", "absent.json"):
        with pytest.raises(InputError, match=name):
            read_block(tmp_path / name)


def test_an_oriented_block_comes_back_to_the_bit(tmp_path: Path) -> None:
    for oriented in (oriented_block(), without_check_points(replace(oriented_block(None), pictures=None))):
        write_oriented_block(tmp_path / "oriented.npz", oriented)
        assert same(read_oriented_block(tmp_path / "oriented.npz"), oriented)


def test_the_same_oriented_block_gives_the_same_file(tmp_path: Path) -> None:
    write_oriented_block(tmp_path / "one.npz", oriented_block())
    write_oriented_block(tmp_path / "two.npz", oriented_block())
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()


def test_a_spoilt_byte_of_an_oriented_block_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "oriented.npz"
    write_oriented_block(path, oriented_block())
    good = path.read_bytes()
    for place in range(100, len(good) // 2, len(good) // 40):
        spoilt = bytearray(good)
        spoilt[place : place + 20] = b"\xff" * 20
        path.write_bytes(spoilt)
        with pytest.raises(InputError, match=r"oriented\.npz"):
            read_oriented_block(path)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_damaged_oriented_block_says_so(tmp_path: Path, share: float) -> None:
    path = tmp_path / "oriented.npz"
    write_oriented_block(path, oriented_block())
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with pytest.raises(InputError, match=r"oriented\.npz: .*run process again"):
        read_oriented_block(path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(InputError, match=r"oriented\.npz"):
        read_oriented_block(path)
    with pytest.raises(InputError, match=r"absent\.npz"):
        read_oriented_block(tmp_path / "absent.npz")


def test_adjustment_json_holds_the_figures(tmp_path: Path) -> None:
    oriented = oriented_block()
    write_adjustment(tmp_path / "adjustment.json", oriented)
    content = json.loads((tmp_path / "adjustment.json").read_text())
    residuals = oriented.adjustment.ray_residuals_px[oriented.adjustment.ray_used]
    assert content["check_rmse_xy_m"] == pytest.approx(0.05)  # (0.03, 0.04) and (0, 0.05)
    assert content["check_rmse_z_m"] == pytest.approx(np.sqrt((0.01**2 + 0.07**2) / 2))
    assert content["rms_residual_px"] == pytest.approx(np.sqrt(np.mean(residuals**2)))
    assert (content["images_total"], content["images_oriented"]) == (4, 3)
    assert content["unoriented"] == {"s1.jpg": "too few points"}
    assert (content["rays"], content["rays_rejected"]) == (35, 1)
    assert (content["object_points"], content["pass_points"], content["tie_points"]) == (11, 6, 3)
    assert content["candidates"] == {"video": {"found": 40, "survived": 10}}
    # four positions, three of oriented images, of which the second (s2) was rejected
    assert content["gnss_rejected"] == ["s2.jpg"]
    assert (content["gnss_latency_s"], content["gnss_latency_sigma_s"]) == ([], [])
    interior = content["interior_orientation"]
    assert interior["values"]["principal_distance_px"] == 900.0
    assert interior["sigmas"]["b1"] is None
    covariance = oriented.adjustment.interior_covariance
    assert interior["sigmas"]["k1"] == pytest.approx(np.sqrt(covariance[3, 3]))
    expected = covariance[0, 7] / np.sqrt(covariance[0, 0] * covariance[7, 7])
    assert interior["correlations"]["principal_distance_px"]["p2"] == pytest.approx(expected)
    assert interior["correlations"]["k1"]["k1"] == pytest.approx(1.0)
    assert content["check_points"][0]["difference_m"] == [0.03, 0.04, -0.01]
    assert (content["datum"], content["notes"]) == ("control", ["a note ü", "another"])


def test_without_check_points_their_rmse_is_null(tmp_path: Path) -> None:
    oriented = without_check_points(oriented_block())
    result = replace(oriented.adjustment, ray_used=np.zeros(36, dtype=np.bool_), sigma0=float("nan"))
    write_adjustment(tmp_path / "adjustment.json", replace(oriented, adjustment=result))
    text = (tmp_path / "adjustment.json").read_text()
    content = json.loads(text)
    nulls = ["check_rmse_xy_m", "check_rmse_z_m", "rms_residual_px", "sigma0"]
    assert [content[key] for key in nulls] == [None] * 4
    assert content["check_points"] == []
    assert "NaN" not in text


def test_summary_is_of_plain_types() -> None:
    json.dumps(adjustment_summary(oriented_block()))
