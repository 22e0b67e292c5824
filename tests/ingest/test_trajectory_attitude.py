"""Attitudes between samples, and the lever arm from the antenna to the camera."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from uavkit.core.errors import InputError
from uavkit.core.flight_log import AttitudeTable, Stamps, attitude_table, fix_table
from uavkit.core.frames import LocalFrame
from uavkit.core.gpstime import NO_TIME
from uavkit.ingest.camera_position import (
    AttitudeTrack,
    build_attitudes,
    camera_positions,
    rotation_enu_from_vehicle,
)
from uavkit.ingest.trajectory import Positions, build_trajectory

FRAME = LocalFrame.at(35.8, 139.65, 20.0)
START_NS = 1_479_354_600_000_000_000
EAST, NORTH, UP = np.eye(3)
FORWARD, RIGHT, DOWN = np.eye(3)
QUARTER = np.pi / 2


def ns(seconds: np.ndarray) -> np.ndarray:
    return START_NS + np.rint(np.asarray(seconds) * 1e9).astype(np.int64)


def attitudes_of(seconds: np.ndarray, angles_rad: np.ndarray) -> AttitudeTable:
    return attitude_table(Stamps.of(len(seconds), gps_ns=ns(seconds)), *np.asarray(angles_rad, dtype=float).T)


def steady(roll: float, pitch: float, yaw: float) -> AttitudeTrack:
    return build_attitudes(attitudes_of(np.arange(0.0, 11.0), np.tile([roll, pitch, yaw], (11, 1))))


def antenna(seconds: np.ndarray) -> Positions:
    t = np.arange(0.0, 11.0)
    latitude, longitude, height = FRAME.geographic_from_enu(np.column_stack([3.0 * t, 4.0 * t, 0.0 * t])).T
    table = fix_table(Stamps.of(11, gps_ns=ns(t)), latitude, longitude, height_ellipsoid_m=height)
    return build_trajectory(table).at(ns(seconds))


@pytest.mark.parametrize(
    ("angles", "axis", "points_to"),
    [
        ((0.0, 0.0, 0.0), FORWARD, NORTH),
        ((0.0, 0.0, 0.0), RIGHT, EAST),
        ((0.0, 0.0, 0.0), DOWN, -UP),
        ((0.0, 0.0, QUARTER), FORWARD, EAST),
        ((0.0, 0.0, QUARTER), RIGHT, -NORTH),
        ((0.0, QUARTER, 0.0), FORWARD, UP),
        ((0.0, QUARTER, 0.0), DOWN, NORTH),
        ((QUARTER, 0.0, 0.0), RIGHT, -UP),
        ((QUARTER, 0.0, 0.0), DOWN, -EAST),
        # First the roll, about forward, then the yaw: heading west, right side down, the underside looks left: south.
        ((QUARTER, 0.0, -QUARTER), DOWN, -NORTH),
    ],
)
def test_axes_of_a_turned_vehicle(angles: tuple[float, float, float], axis: np.ndarray, points_to: np.ndarray) -> None:
    R = rotation_enu_from_vehicle(*(np.array([angle]) for angle in angles))[0]
    np.testing.assert_allclose(R @ axis, points_to, atol=1e-12)


@given(st.floats(-np.pi, np.pi), st.floats(-1.5, 1.5), st.floats(0.0, 2 * np.pi))
@settings(max_examples=60, deadline=None)
def test_angles_go_there_and_back(roll: float, pitch: float, yaw: float) -> None:
    found = steady(roll, pitch, yaw).at(ns(np.array([2.3])))
    by_angles = rotation_enu_from_vehicle(np.array([roll]), np.array([pitch]), np.array([yaw]))
    np.testing.assert_allclose(found.R_enu_from_vehicle, by_angles, atol=1e-12)
    np.testing.assert_allclose(by_angles @ by_angles.transpose(0, 2, 1), [np.eye(3)], atol=1e-12)
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()[[1, 0, 2]] * [[1.0], [1.0], [-1.0]]
    np.testing.assert_allclose(by_angles[0], expected, atol=1e-12)
    difference = found.roll_pitch_yaw_rad()[0] - [roll, pitch, yaw]
    np.testing.assert_allclose(np.abs(np.exp(1j * difference) - 1.0), 0.0, atol=1e-9)


def test_turns_go_the_short_way_round() -> None:
    degrees = np.array([[179.0, 0.0, 359.0], [-179.0, 0.0, 1.0]])
    track = build_attitudes(attitudes_of(np.array([0.0, 0.2]), np.radians(degrees)))
    found = np.degrees(track.at(ns(np.array([0.05, 0.1, 0.15]))).roll_pitch_yaw_rad())
    turned = Rotation.from_euler("ZYX", [[359, 0, 179], [1, 0, 181]], degrees=True)
    share = Rotation.from_rotvec(np.outer([0.25, 0.5, 0.75], (turned[0].inv() * turned[1]).as_rotvec()))
    yaw, pitch, roll = (turned[0] * share).as_euler("ZYX", degrees=True).T
    np.testing.assert_allclose(np.exp(1j * np.radians(found[:, 0])), np.exp(1j * np.radians(roll)), atol=1e-9)
    np.testing.assert_allclose(found[:, 1], pitch, atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * np.radians(found[:, 2])), np.exp(1j * np.radians(yaw)), atol=1e-9)
    # Without the other sense of turning: level flight through north.
    level = build_attitudes(attitudes_of(np.array([0.0, 0.2]), np.radians([[0, 0, 359], [0, 0, 3]])))
    np.testing.assert_allclose(
        np.degrees(level.at(ns(np.array([0.1, 0.15]))).roll_pitch_yaw_rad()[:, 2]), [1.0, 2.0], rtol=1e-9
    )


@pytest.mark.parametrize(
    ("angles", "arm", "camera"),
    [
        # Flying north with the antenna a metre ahead of the camera: the camera is a metre south of it.
        ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), -NORTH),
        ((0.0, 0.0, QUARTER), (1.0, 0.0, 0.0), -EAST),
        ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), -EAST),
        # The antenna a metre above the camera: down is -1. Right side down, what was above leans to the east.
        ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), -UP),
        ((QUARTER, 0.0, 0.0), (0.0, 0.0, -1.0), -EAST),
        # Nose up: what was above leans back, to the south.
        ((0.0, QUARTER, 0.0), (0.0, 0.0, -1.0), NORTH),
    ],
)
def test_the_lever_arm_is_turned_and_taken_off(
    angles: tuple[float, float, float], arm: tuple[float, float, float], camera: np.ndarray
) -> None:
    at = antenna(np.array([1.0, 4.4]))
    found = camera_positions(at, steady(*angles), arm)
    np.testing.assert_allclose(found.position_m - at.position_m, [camera, camera], rtol=0, atol=1e-9)
    moved = FRAME.enu_from_geographic(*found.geographic().T) - FRAME.enu_from_geographic(*at.geographic().T)
    np.testing.assert_allclose(moved, [camera, camera], rtol=0, atol=2e-5)


def test_positions_without_an_attitude_are_unknown() -> None:
    t = np.array([0.0, 0.1, 0.2, 2.0, 2.1, 2.2])
    track = build_attitudes(attitudes_of(t, np.zeros((6, 3))))
    at = antenna(np.array([0.15, 0.29, 1.0, 2.05, 2.4]))
    found = camera_positions(at, track, (0.1, 0.0, -0.3))
    assert found.known.tolist() == [True, True, False, True, False]
    assert found.reasons[2] == "no attitude within 0.8 s of it"
    assert np.isnan(found.position_m[2]).all()
    assert camera_positions(at, track, (0.0, 0.0, 0.0)) is at


def test_attitudes_in_any_order_and_doubled() -> None:
    t = np.arange(0.0, 3.0, 0.1)
    angles = np.column_stack([0.1 * np.sin(t), 0.2 * np.cos(t), 0.5 * t])
    rows = np.random.default_rng(0).permutation(np.concatenate([np.arange(30), [3, 9]]))
    wanted = ns(np.array([0.55, 2.31]))
    mixed = build_attitudes(attitudes_of(t[rows], angles[rows])).at(wanted).roll_pitch_yaw_rad()
    np.testing.assert_allclose(mixed, build_attitudes(attitudes_of(t, angles)).at(wanted).roll_pitch_yaw_rad())
    truth = np.array([[0.1 * np.sin(s), 0.2 * np.cos(s), 0.5 * s] for s in (0.55, 2.31)])
    np.testing.assert_allclose(mixed, truth, atol=0.2 * 0.1**2 / 8 + 1e-6)


def test_no_attitude_with_a_time_is_an_error() -> None:
    table = attitude_table(Stamps.of(3), np.zeros(3), np.zeros(3), np.zeros(3))
    with pytest.raises(InputError, match="no attitude has GPS time"):
        build_attitudes(table)
    nothing = attitudes_of(np.arange(3.0), np.full((3, 3), np.nan))
    with pytest.raises(InputError, match="no attitude has GPS time"):
        build_attitudes(nothing)
    one = build_attitudes(attitudes_of(np.array([1.0]), np.zeros((1, 3))))
    assert one.at(np.array([NO_TIME, ns(np.array(1.0))])).reasons == ("its GPS time is not known", "")
