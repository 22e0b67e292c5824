"""Positions between fixes, against paths whose truth is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uavkit.core.errors import InputError
from uavkit.core.flight_log import FixTable, FixType, Stamps, fix_table, no_fixes
from uavkit.core.frames import LocalFrame
from uavkit.core.gpstime import NO_TIME
from uavkit.core.heights import HeightDatum
from uavkit.ingest.trajectory import Positions, TrajectoryOptions, build_trajectory

FRAME = LocalFrame.at(35.8, 139.65, 20.0)
START_NS = 1_479_354_600_000_000_000


def ns(seconds: np.ndarray) -> np.ndarray:
    return START_NS + np.rint(np.asarray(seconds) * 1e9).astype(np.int64)


def table_of(
    seconds: np.ndarray, position_m: np.ndarray, velocity_m_s: np.ndarray | None = None, **columns: object
) -> FixTable:
    """Fixes of a path in metres about a place, heights ellipsoidal unless said otherwise."""
    latitude, longitude, height = FRAME.geographic_from_enu(position_m).T
    if velocity_m_s is not None:
        columns["velocity_m_s"] = velocity_m_s
    if not any(name.startswith("height") for name in columns):
        columns["height_ellipsoid_m"] = height
    return fix_table(Stamps.of(len(seconds), gps_ns=ns(seconds)), latitude, longitude, **columns)


def in_frame(found: Positions) -> np.ndarray:
    """Known positions in metres about the place."""
    return FRAME.enu_from_geographic(*found.geographic()[found.known].T)


def straight(seconds: np.ndarray, speed_m_s: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    """North-east and climbing by 0.5 m/s."""
    velocity = np.tile([0.6 * speed_m_s, 0.8 * speed_m_s, 0.5], (len(seconds), 1))
    return velocity * np.asarray(seconds)[:, None], velocity


def cubic(seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    t = np.asarray(seconds)[:, None]
    a, b, c = np.array([4.0, -3.0, 0.5]), np.array([0.4, 0.7, -0.2]), np.array([-0.05, 0.08, 0.02])
    return a * t + b * t**2 + c * t**3, a + 2 * b * t + 3 * c * t**2


class Wander:
    """Accelerations held for random times of 0.3 to 2 s: as rough as a multicopter at the turns."""

    def __init__(self, seed: int, strength_m_s2: float = 2.0) -> None:
        rng = np.random.default_rng(seed)
        self.begin = np.concatenate([[0.0], np.cumsum(rng.uniform(0.3, 2.0, 60))])
        self.acceleration = rng.normal(0, strength_m_s2, (61, 3))
        h = np.diff(self.begin)[:, None]
        self.velocity = np.vstack([np.zeros(3), np.cumsum(h * self.acceleration[:-1], axis=0)])
        step = h * self.velocity[:-1] + 0.5 * h**2 * self.acceleration[:-1]
        self.position = np.vstack([np.zeros(3), np.cumsum(step, axis=0)])

    def at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        row = np.searchsorted(self.begin, seconds, side="right") - 1
        since = (np.asarray(seconds) - self.begin[row])[:, None]
        acceleration = self.acceleration[row]
        velocity = self.velocity[row] + since * acceleration
        return self.position[row] + since * self.velocity[row] + 0.5 * since**2 * acceleration, velocity


def test_a_cubic_path_is_followed_exactly() -> None:
    t = np.arange(0.0, 8.0, 0.5)
    trajectory = build_trajectory(table_of(t, *cubic(t)))
    wanted = np.random.default_rng(1).uniform(0.0, 7.5, 50)
    found, (position, velocity) = trajectory.at(ns(wanted)), cubic(wanted)
    assert found.known.all()
    np.testing.assert_allclose(in_frame(found), position, rtol=0, atol=1e-5)
    # Velocities are linear in between: off by an eighth of the interval squared times the change of acceleration.
    np.testing.assert_allclose(found.velocity_m_s, velocity, rtol=0, atol=0.5**2 / 8.0 * 6.0 * 0.08 + 1e-4)
    np.testing.assert_allclose(trajectory.at(ns(t)).velocity_m_s, cubic(t)[1], rtol=0, atol=1e-4)


def test_differences_of_positions_follow_a_parabola() -> None:
    t = np.sort(np.random.default_rng(2).uniform(0.0, 8.0, 25))
    path = cubic(t)[0] - np.array([-0.05, 0.08, 0.02]) * t[:, None] ** 3
    options = TrajectoryOptions(most_intervals=50.0)
    wanted = np.random.default_rng(3).uniform(t[0], t[-1], 50)
    expected = cubic(wanted)[0] - np.array([-0.05, 0.08, 0.02]) * wanted[:, None] ** 3
    found = build_trajectory(table_of(t, path), options).at(ns(wanted))
    np.testing.assert_allclose(in_frame(found), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
@pytest.mark.parametrize("doppler", [True, False], ids=["velocities", "differences"])
def test_errors_stay_within_their_bound(rate_hz: float, doppler: bool) -> None:
    """It comes from what the fixes show of the accelerations: it is rarely passed, and not far too wide."""
    shares, ratios = [], []
    for seed in range(12):
        path, t = Wander(seed), np.arange(0.0, 60.0, 1.0 / rate_hz)
        position, velocity = path.at(t)
        trajectory = build_trajectory(table_of(t, position, velocity if doppler else None))
        wanted = np.random.default_rng(seed).uniform(1.0, 58.0, 300)
        found, truth = trajectory.at(ns(wanted)), path.at(wanted)[0]
        error = in_frame(found) - truth
        size = np.column_stack([np.linalg.norm(error[:, :2], axis=1), np.abs(error[:, 2])])
        bound = found.interpolation_m
        shares.append(np.mean(size > bound + 1e-6))
        ratios.append(np.sqrt(np.mean(bound**2) / np.mean(size**2)))
    assert np.mean(shares) < 0.05
    assert np.median(ratios) < 8.0


def test_a_recorded_drive() -> None:
    """Every second fix of a receiver in a car, 1 Hz: the others are where the cubic leads."""
    path = Path(__file__).resolve().parents[2] / "../shared/data/logs/ubx_cartrip.log"
    if not path.is_file():
        pytest.skip(f"{path} is not there: recorded data are kept beside the project")
    from uavkit.core.progress import silent
    from uavkit.formats.ubx import read_log

    table = read_log(path, silent).fix_table
    even, odd = np.arange(0, len(table), 2), np.arange(1, len(table), 2)
    half = fix_table(
        table.when.where(even),
        table.latitude_deg[even],
        table.longitude_deg[even],
        height_ellipsoid_m=table.height_ellipsoid_m[even],
        velocity_m_s=table.velocity_m_s[even],
        fix_type=table.fix_type[even],
    )
    trajectory = build_trajectory(half)
    found = trajectory.at(table.when.gps_ns[odd])
    assert found.known.mean() > 0.99
    place = (table.latitude_deg[odd], table.longitude_deg[odd], table.height_ellipsoid_m[odd])
    error = (found.position_m - trajectory.frame.enu_from_geographic(*place))[found.known]
    size = np.linalg.norm(error[:, :2], axis=1)
    # At up to 32 m/s; the fixes themselves scatter by some centimetres from one to the next.
    assert np.sqrt(np.mean(size**2)) < 0.2
    assert np.mean(size > found.interpolation_m[found.known, 0] + 0.05) < 0.03


def test_a_turn_of_acceleration_in_the_worst_moment_is_within_the_bound() -> None:
    """Acceleration that changes its sign at a quarter and three quarters departs most from the cubic: D h^2 / 16."""
    d, h, t = 3.0, 1.0, np.arange(-5.0, 7.0)
    knots = np.array([0.0, 0.25, 0.75, 1.0])
    fine = np.linspace(0.0, 1.0, 4001)
    a = np.where((fine < knots[1]) | (fine > knots[2]), d, -d)
    v = np.concatenate([[0.0], np.cumsum(0.5 * (a[1:] + a[:-1]) * np.diff(fine))])
    p = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(fine))])
    assert abs(p[-1]) < 1e-3
    assert p[2000] == pytest.approx(d * h**2 / 16.0, rel=1e-2)
    # At both ends all is still: the fixes cannot show what happened, only neighbours that accelerate as much tell.
    position, velocity = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    velocity[t >= 2.0, 0], velocity[t <= -1.0, 0] = d * (t[t >= 2.0] - 1.0), d * t[t <= -1.0]
    position[t >= 2.0, 0], position[t <= -1.0, 0] = 0.5 * d * (t[t >= 2.0] - 1.0) ** 2, 0.5 * d * t[t <= -1.0] ** 2
    bound = build_trajectory(table_of(t, position, velocity)).at(ns(np.array([0.5]))).interpolation_m[0, 0]
    assert bound == pytest.approx(d * h**2 / 16.0, rel=1e-3)


def test_gaps_are_not_bridged_and_said() -> None:
    t = np.concatenate([np.arange(0.0, 3.0, 0.2), np.arange(5.0, 8.0, 0.2)])
    trajectory = build_trajectory(table_of(t, *straight(t)))
    assert trajectory.gaps == ((int(ns(2.8)), int(ns(5.0))),)
    assert trajectory.notes == ("1 gaps in the positions, 2.2 s together",)
    wanted = np.array([1.1, 2.95, 3.1, 4.0, 4.9, -0.15, -0.3, 7.95, 8.2])
    found = trajectory.at(ns(wanted))
    assert found.known.tolist() == [True, True, False, False, True, True, False, True, False]
    assert found.reasons[2] == found.reasons[3] == "the receiver had no position for 2.2 s about it"
    assert found.reasons[6] == "0.3 s before the receiver's first fix"
    assert found.reasons[8] == "0.4 s after the receiver's last fix"
    assert [fix is None for fix in found.fixes()] == (~found.known).tolist()
    expected = straight(wanted)[0][found.known]
    np.testing.assert_allclose(in_frame(found), expected, rtol=0, atol=1e-5)
    assert np.isnan(found.position_m[~found.known]).all()
    assert np.isnan(found.geographic()[~found.known]).all()
    # Two fixes lost in a row are bridged, with a wider bound.
    few = build_trajectory(table_of(np.delete(t, [5, 6]), *straight(np.delete(t, [5, 6]))))
    assert few.at(ns(np.array([1.1]))).known.all()


def test_time_without_a_fix_is_not_bridged_however_short() -> None:
    t = np.arange(0.0, 4.0, 0.2)
    kind = np.full(len(t), FixType.THREE_DIMENSIONAL, dtype=np.uint8)
    kind[8] = FixType.NO_FIX
    table = table_of(t, *straight(t), fix_type=kind)
    wanted = ns(np.array([1.5, 1.6, 1.7, 1.9]))
    found = build_trajectory(table).at(wanted)
    # 1.5 s and 1.7 s are within an interval of a fix, on its own side of the loss; 1.6 s is when there was none.
    assert found.known.tolist() == [True, False, True, True]
    assert found.reasons[1] == "the receiver had no fix for 0.4 s about it"
    assert found.interpolation_m[0, 0] > 3.0 * found.interpolation_m[3, 0]
    # The same where the receiver did not know the time either.
    untimed = table.when.gps_ns.copy()
    untimed[8] = NO_TIME
    silent = build_trajectory(replace(table, when=Stamps.of(len(t), gps_ns=untimed)))
    assert silent.gaps == ((int(ns(1.4)), int(ns(1.8))),)


@given(st.permutations(list(range(12))), st.lists(st.integers(0, 11), max_size=6))
@settings(max_examples=40, deadline=None)
def test_order_and_doublets_do_not_matter(order: list[int], doubled: list[int]) -> None:
    t = np.arange(0.0, 12.0)
    position, velocity = cubic(t / 2.0)
    rows = np.array([*order, *doubled])
    straight_on = build_trajectory(table_of(t, position, velocity))
    mixed = build_trajectory(table_of(t[rows], position[rows], velocity[rows]))
    assert np.all(np.diff(mixed.gps_ns) > 0)
    wanted = ns(np.array([0.3, 5.5, 10.9]))
    np.testing.assert_allclose(in_frame(mixed.at(wanted)), in_frame(straight_on.at(wanted)), rtol=0, atol=1e-5)
    assert any("had one already" in note for note in mixed.notes) == bool(doubled)


def test_the_first_receiver_with_fixes_counts() -> None:
    t = np.repeat(np.arange(0.0, 5.0), 3)
    receiver = np.tile(np.array([0, 1, 2], dtype=np.uint8), 5)
    position, velocity = straight(t)
    position[receiver == 2] += 50.0
    kind = np.where(receiver == 0, FixType.NO_GPS, FixType.DIFFERENTIAL).astype(np.uint8)
    trajectory = build_trajectory(table_of(t, position, velocity, receiver=receiver, fix_type=kind))
    assert len(trajectory) == 5
    assert trajectory.notes == ("receiver 1 is used, 2 other(s) not",)
    assert trajectory.at(ns(np.array([2.5]))).known.all()  # receiver 0, without a fix, is not this receiver's loss


def test_heights_keep_one_datum() -> None:
    t = np.arange(0.0, 20.0)
    position, velocity = straight(t)
    height = position[:, 2] + 20.0
    nan = np.full(20, np.nan)
    both = table_of(t, position, velocity, height_ellipsoid_m=height + 40.0, height_geoid_m=height)
    none = replace(both, height_ellipsoid_m=nan, height_geoid_m=nan)
    cases = [
        (both, HeightDatum.ELLIPSOID, 40.0),
        (replace(both, height_ellipsoid_m=nan), HeightDatum.GEOID, 0.0),
        (replace(none, height_above_home_m=height - 7.0), HeightDatum.GROUND, -7.0),
    ]
    for table, datum, offset in cases:
        fix = build_trajectory(table).at(ns(np.array([4.5]))).fixes()[0]
        assert fix is not None
        assert fix.height_datum is datum
        assert fix.height_m == pytest.approx(20.0 + 4.5 * 0.5 + offset, abs=1e-3)
    # A fix that alone lacks the ellipsoidal height is left out, not filled with the other; a quarter is too many.
    one = (height + 40.0).copy()
    one[5] = np.nan
    left = build_trajectory(replace(both, height_ellipsoid_m=one))
    assert (left.height_datum, len(left)) == (HeightDatum.ELLIPSOID, 19)
    one[:5] = np.nan
    assert build_trajectory(replace(both, height_ellipsoid_m=one)).height_datum is HeightDatum.GEOID
    flat = build_trajectory(none).at(ns(np.array([4.5]))).fixes()[0]
    assert flat is not None
    assert flat.height_datum is HeightDatum.UNKNOWN
    assert np.isnan(flat.height_m)
    latitude = float(FRAME.geographic_from_enu(straight(np.array([4.5]))[0])[0, 0])
    assert flat.latitude_deg == pytest.approx(latitude, abs=1e-9)  # 25 m higher or lower is nothing


def test_a_height_given_for_the_other_is_found_out() -> None:
    """At this place the geoid lies some 37 m above the ellipsoid: equal heights cannot both be what they are called."""
    t = np.arange(0.0, 20.0)
    position, velocity = straight(t)
    height = position[:, 2] + 20.0
    same = build_trajectory(table_of(t, position, velocity, height_ellipsoid_m=height, height_geoid_m=height))
    assert same.height_datum is HeightDatum.GEOID
    assert "miss the geoid's undulation by" in same.notes[0]
    coarse = table_of(t, position, velocity, height_ellipsoid_m=height + 35.0, height_geoid_m=height)
    assert build_trajectory(coarse).height_datum is HeightDatum.ELLIPSOID


def test_sigmas_are_the_receivers_and_the_bound_of_the_interpolation() -> None:
    t = np.arange(0.0, 10.0)
    position, velocity = cubic(t / 3.0)[0], cubic(t / 3.0)[1] / 3.0
    horizontal, vertical = 0.5 + 0.1 * t, np.full(10, np.nan)
    table = table_of(t, position, velocity, sigma_horizontal_m=horizontal, sigma_vertical_m=vertical)
    found = build_trajectory(table).at(ns(np.array([4.25, 3.0])))
    bound = found.interpolation_m
    np.testing.assert_allclose(found.sigma_horizontal_m, np.hypot([0.925, 0.8], bound[:, 0] / 3.0), rtol=1e-9)
    assert bound[0, 0] > 1e-4
    assert bound[1, 0] == pytest.approx(0.0, abs=1e-9)
    fix = found.fixes()[0]
    assert fix is not None
    assert fix.sigma_vertical_m is None
    assert fix.sigma_horizontal_m == found.sigma_horizontal_m[0]
    zero = build_trajectory(replace(table, sigma_horizontal_m=np.zeros(10))).at(ns(np.array([4.25]))).fixes()[0]
    assert zero is not None
    assert zero.sigma_horizontal_m is None  # a sigma of 0 is none


@pytest.mark.parametrize("wrong", ["zero", "swapped"])
def test_velocities_of_another_flight_are_not_believed(wrong: str) -> None:
    path, t = Wander(7), np.arange(0.0, 50.0)
    position, velocity = path.at(t)
    false = np.zeros_like(velocity) if wrong == "zero" else velocity[:, [1, 0, 2]]
    trajectory = build_trajectory(table_of(t, position, false))
    assert "horizontal velocities do not fit" in trajectory.notes[0]
    wanted = np.random.default_rng(0).uniform(1.0, 48.0, 100)
    error = in_frame(trajectory.at(ns(wanted))) - path.at(wanted)[0]
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 0.3
    assert not build_trajectory(table_of(t, position, velocity)).notes


def test_velocities_are_believed_beside_noisy_positions() -> None:
    """At 8 Hz the noise of 0.3 m makes steps of 3 m/s: the receiver's velocities are better than its differences."""
    path, t = Wander(7), np.arange(0.0, 50.0, 0.125)
    position, velocity = path.at(t)
    noisy = position + np.random.default_rng(1).normal(0, 0.3, position.shape)
    trajectory = build_trajectory(table_of(t, noisy, velocity))
    assert not trajectory.notes
    assert not trajectory.difference.any()
    assert build_trajectory(table_of(t, noisy, -velocity)).notes


def test_velocities_without_their_vertical_part_are_used() -> None:
    t = np.arange(0.0, 10.0)
    position, velocity = cubic(t / 3.0)[0], cubic(t / 3.0)[1] / 3.0
    velocity[:, 2] = np.nan
    trajectory = build_trajectory(table_of(t, position, velocity))
    assert trajectory.difference.tolist() == [[False, True]] * 10
    assert np.isfinite(trajectory.velocity_m_s).all()


def test_a_flight_across_the_date_line() -> None:
    t = np.arange(0.0, 10.0)
    longitude = 179.9999 + 0.00005 * t
    longitude[longitude > 180.0] -= 360.0
    table = fix_table(Stamps.of(10, gps_ns=ns(t)), np.full(10, -17.0), longitude, height_ellipsoid_m=np.full(10, 30.0))
    found = build_trajectory(table).at(ns(np.array([2.5, 1.5]))).geographic()
    np.testing.assert_allclose(found, [[-17.0, -179.999975, 30.0], [-17.0, 179.999975, 30.0]], rtol=0, atol=1e-7)


_WILD = st.one_of(st.floats(width=64), st.floats(-90.0, 90.0))


@given(
    st.lists(
        st.tuples(
            st.one_of(st.sampled_from([NO_TIME, 0, 2**63 - 1]), st.integers(START_NS, START_NS + 10**10)),
            st.tuples(*[_WILD] * 10),
            st.integers(0, 255),
            st.integers(0, 2),
        ),
        max_size=12,
    )
)
@settings(max_examples=80, deadline=None)
def test_damaged_tables_end_in_an_error_or_a_trajectory(
    rows: list[tuple[int, tuple[float, ...], int, int]],
) -> None:
    values = np.array([row[1] for row in rows]).reshape(-1, 10)
    table = fix_table(
        Stamps.of(len(rows), gps_ns=np.array([row[0] for row in rows], dtype=np.int64)),
        values[:, 0],
        values[:, 1],
        height_ellipsoid_m=values[:, 2],
        height_geoid_m=values[:, 3],
        height_above_home_m=values[:, 4],
        velocity_m_s=values[:, 5:8],
        sigma_horizontal_m=values[:, 8],
        sigma_vertical_m=values[:, 9],
        fix_type=np.array([row[2] for row in rows], dtype=np.uint8),
        receiver=np.array([row[3] for row in rows], dtype=np.uint8),
    )
    try:
        trajectory = build_trajectory(table)
    except InputError:
        return
    assert np.all(np.diff(trajectory.gps_ns) > 0)
    found = trajectory.at(np.array([START_NS + 5 * 10**9, *(row[0] for row in rows)], dtype=np.int64))
    assert np.isfinite(found.position_m[found.known]).all()
    assert len(found.fixes()) == len(rows) + 1


def test_too_little_is_an_error() -> None:
    t = np.arange(0.0, 5.0)
    table = table_of(t, *straight(t))
    assert len(build_trajectory(table)) == 5
    for bad in (
        no_fixes(),
        replace(table, when=Stamps.of(5)),
        replace(table, fix_type=np.full(5, FixType.TWO_DIMENSIONAL, dtype=np.uint8)),
        replace(table, latitude_deg=np.full(5, 91.0)),
        replace(table, longitude_deg=np.full(5, np.nan)),
    ):
        with pytest.raises(InputError, match="a trajectory needs two"):
            build_trajectory(bad)
    with pytest.raises(ValueError, match="most_intervals"):
        TrajectoryOptions(most_intervals=0.5)
    assert build_trajectory(table).at(np.array([NO_TIME])).reasons == ("its GPS time is not known",)
    assert build_trajectory(table).at(np.zeros(0, dtype=np.int64)).fixes() == ()
