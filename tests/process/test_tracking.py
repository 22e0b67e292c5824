"""Tracking through simulated interlaced video: plane ground, relief, turns, brightness, blind pictures."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from tests.process import textures
from tests.process.video_of_truth import FIELD_S, OVER, Pose, Scene, fields, make_scene, positions, straight
from uavkit.core.errors import AdjustmentError, InputError
from uavkit.process.affine_motion import (
    apply_affine,
    compose,
    fit_affine_robustly,
    nearest_similarity,
    similarity_power,
)
from uavkit.process.orientation_code import orientation_codes, richness, select_points
from uavkit.process.tracking import (
    TimedPicture,
    TrackingOptions,
    TrackingResult,
    advance,
    coarse_motion,
    frame_from_half,
    half_from_frame,
    predict,
    square_field,
    square_field_half,
    start,
    track,
)

COUNT = 150  # fields, 2.5 s
SECONDS = COUNT * FIELD_S


@dataclass(frozen=True)
class Outcome:
    result: TrackingResult
    error_px: np.ndarray
    """Of the points that are still in the picture, lost ones included."""
    alive: np.ndarray
    points_px: np.ndarray


def film(scene: Scene, pose: Pose, count: int = COUNT, every: int = 3, **more: object) -> list[TimedPicture]:
    rng = np.random.default_rng(11)
    return [
        TimedPicture(image=square_field(lines, parity), time_s=t)
        for parity, lines, t in fields(scene, pose, count, rng, every=every, **more)  # type: ignore[arg-type]
    ]


def follow(scene: Scene, pose: Pose, pictures: list[TimedPicture], options: TrackingOptions | None = None) -> Outcome:
    codes = orientation_codes(pictures[0].image)
    points = select_points(richness(codes, 25, 0.5), 40, 1, 16)
    result = track(pictures, points, options, rng=np.random.default_rng(0))
    truth = positions(scene, points, pose(result.time_s))
    inside = ((truth > 25) & (truth < [614, 454])).all(axis=1)
    assert inside.sum() > 50
    return Outcome(result, np.hypot(*(result.points_px - truth).T)[inside], result.alive[inside], points)


def demand(outcome: Outcome, share: float) -> None:
    """The bar before least squares matching: median half a video pixel, 95 % within two."""
    assert outcome.alive.mean() >= share
    error = outcome.error_px[outcome.alive]
    assert np.median(error) < 0.3
    assert np.quantile(error, 0.95) < 0.8
    assert (error > 2).mean() < 0.01


@pytest.fixture(scope="module")
def plane() -> Scene:
    return make_scene(np.random.default_rng(1))


def test_plane_ground_without_drift(plane: Scene) -> None:
    pose = straight((20, 100), SECONDS)
    pictures = film(plane, pose)
    outcome = follow(plane, pose, pictures)
    demand(outcome, 0.93)
    expected = compose(pose(outcome.result.time_s)[0], np.eye(2, 3))
    assert outcome.result.affine[:, :2] == pytest.approx(expected[:, :2], abs=0.003)
    assert outcome.result.pictures_used < len(pictures)  # steps by predicted motion
    again = follow(plane, pose, pictures)
    assert np.array_equal(again.result.points_px, outcome.result.points_px)


def test_points_on_relief_survive_although_no_affine_is_true() -> None:
    scene = make_scene(np.random.default_rng(2), relief=0.5)
    pose = straight((25, 90), SECONDS)
    outcome = follow(scene, pose, film(scene, pose))
    demand(outcome, 0.93)
    off = outcome.result.points_px - apply_affine(outcome.result.affine, outcome.points_px)
    assert np.hypot(*off[outcome.result.alive].T).max() > 5  # parallax: far more than a tracking error


def test_the_heading_turns_round(plane: Scene) -> None:
    pose = straight((10, 15), 4.0, turn_deg=180)
    outcome = follow(plane, pose, film(plane, pose, count=240))
    demand(outcome, 0.9)
    assert outcome.result.affine[:, :2] == pytest.approx(-np.eye(2), abs=0.03)


def test_climbing_and_turning(plane: Scene) -> None:
    pose = straight((15, 60), SECONDS, turn_deg=-25, scale=0.85)
    demand(follow(plane, pose, film(plane, pose)), 0.93)


def test_brightness_jumps(plane: Scene) -> None:
    pose = straight((20, 100), SECONDS)
    demand(follow(plane, pose, film(plane, pose, gain=lambda i: 1.4 if (i // 21) % 2 else 1.0)), 0.95)


def crop(scene: Scene, period_px: float, noise: float) -> Scene:
    """The scene under a crop: rows with plants along them, the same everywhere, and a little of the scene's texture."""
    y, x = np.indices(scene.grey.shape, dtype=np.float32) / OVER
    c, s = np.cos(0.3), np.sin(0.3)
    rows = np.cos(2 * np.pi * (c * x + s * y) / period_px)
    plants = np.cos(2 * np.pi * (c * y - s * x) / (0.6 * period_px))
    return replace(scene, grey=(120 + 25 * rows * (0.6 + 0.4 * plants) + noise * (scene.grey - 120)).astype(np.float32))


@pytest.mark.parametrize("period_px", [10.0, 15.0])
def test_rows_of_crop_do_not_make_points_jump_a_period(plane: Scene, period_px: float) -> None:
    scene, pose = crop(plane, period_px, 0.3), straight((20, 100), SECONDS)
    outcome = follow(scene, pose, film(scene, pose))
    assert outcome.alive.mean() > 0.8
    error = outcome.error_px[outcome.alive]
    assert np.median(error) < 0.5
    assert (error > 2).mean() < 0.01  # a plant is 6 px long, a row 10 px wide: a jump would show


def test_low_contrast_is_followed(plane: Scene) -> None:
    """Texture of 6 grey values (standard deviation) under noise of 2.5."""
    scene, pose = replace(plane, grey=120 + (plane.grey - 120) * np.float32(6 / 38)), straight((20, 100), SECONDS)
    outcome = follow(scene, pose, film(scene, pose))
    assert outcome.alive.mean() > 0.8
    error = outcome.error_px[outcome.alive]
    assert np.median(error) < 0.5
    assert np.quantile(error, 0.95) < 2.0


@pytest.mark.parametrize("gain", [0.6, 1.4])
def test_a_change_of_gain_costs_no_points(gain: float) -> None:
    """As many are right as Lucas-Kanade has where nothing changes; with the change it loses many."""
    texture, move = textures.wave_texture(np.random.default_rng(3)), np.array([2.4, -1.8])
    moved = np.column_stack([np.eye(2), move])

    def seen(brighter: float, shift: np.ndarray, seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        return textures.picture(
            texture, (240, 320), shift, gain=40 * brighter, offset=125 * brighter, noise=2.0, rng=rng
        )

    before, same, changed = seen(1.0, np.eye(2, 3), 1), seen(1.0, moved, 2), seen(gain, moved, 2)
    points = np.random.default_rng(4).uniform(40, [280, 200], (250, 2))
    truth = points - move
    state = start(TimedPicture(image=before, time_s=0.0), points)
    ours = advance(state, TimedPicture(image=changed, time_s=0.04), np.random.default_rng(0))
    given = points.astype(np.float32)
    right = ((ours.misses == 0) & (np.linalg.norm(ours.points_px - truth, axis=1) < 1.0)).sum()
    peer = [
        cv2.calcOpticalFlowPyrLK(before, after, given, None, winSize=(21, 21), maxLevel=3)[0]
        for after in (same, changed)
    ]
    peer_right = [(np.linalg.norm(found - truth, axis=1) < 1.0).sum() for found in peer]
    assert right >= peer_right[0]
    assert peer_right[1] < 0.8 * peer_right[0]  # so the change is one


def test_threads_change_no_bit(plane: Scene) -> None:
    pose = straight((20, 100), SECONDS)
    pictures = film(plane, pose, count=40)
    points = np.random.default_rng(0).uniform(30, [610, 450], (400, 2))
    alone = track(pictures, points, rng=np.random.default_rng(0))
    with ThreadPoolExecutor(3) as pool:
        shared = track(pictures, points, rng=np.random.default_rng(0), pool=pool)
    for name in ("points_px", "alive", "dissimilarity", "ambiguity", "affine", "warps"):
        assert np.array_equal(getattr(alone, name), getattr(shared, name), equal_nan=True)


def spoilt(pictures: list[TimedPicture], bad: Callable[[int], str]) -> list[TimedPicture]:
    result: list[TimedPicture] = []
    for i, picture in enumerate(pictures):
        kind = bad(i)
        if kind == "black":
            picture = replace(picture, image=np.full_like(picture.image, 12))
        elif kind == "flash":
            picture = replace(picture, image=np.clip(picture.image.astype(int) + 170, 0, 255).astype(np.uint8))
        elif kind == "frozen":
            picture = replace(picture, image=result[-1].image)
        elif kind == "flagged":
            picture = replace(picture, image=np.random.default_rng(0).integers(0, 255, picture.image.shape, np.uint8))
            picture = replace(picture, usable=False)
        result.append(picture)
    return result


@pytest.mark.parametrize("kind", ["black", "flash", "frozen", "flagged"])
def test_blind_pictures_are_bridged(plane: Scene, kind: str) -> None:
    pose = straight((20, 100), SECONDS)
    pictures = spoilt(film(plane, pose), lambda i: kind if i % 20 in range(8, 14) else "")
    outcome = follow(plane, pose, pictures)
    demand(outcome, 0.9)
    assert outcome.result.gaps > 0


def test_a_gap_with_an_unforeseen_jump_is_searched_for_globally(plane: Scene) -> None:
    before, after = straight((10, 30), 1.0, sway_px=0.0), straight((10, 30), 1.0, sway_px=0.0)

    def jumped(t: float) -> tuple[np.ndarray, np.ndarray]:
        A, b = before(t) if t < 0.7 else after(t)
        if t >= 0.7:
            c, s = np.cos(np.radians(9)), np.sin(np.radians(9))
            turn = np.array([[c, -s, 60.0], [s, c, -70.0]])
            A = compose(turn, A)
        return A, b

    pictures = [p for p in film(plane, jumped, count=80) if not 0.5 < p.time_s < 0.8]
    demand(follow(plane, jumped, pictures), 0.9)


def test_the_position_at_the_still_is_predicted_over_a_black_end(plane: Scene) -> None:
    pose = straight((20, 100), SECONDS)
    pictures = film(plane, pose)
    blind = 5
    outcome = follow(plane, pose, spoilt(pictures, lambda i: "black" if i >= len(pictures) - blind else ""))
    still_s = pictures[-1].time_s
    assert outcome.result.time_s < still_s - 0.15
    truth = positions(plane, outcome.points_px, pose(still_s))
    error = np.hypot(*(predict(outcome.result, still_s) - truth).T)[outcome.result.alive]
    standing = np.hypot(*(outcome.result.points_px - truth).T)[outcome.result.alive]
    blind_s = still_s - outcome.result.time_s
    sway_px_s2 = 3 * np.hypot(4.4**2, 3.7**2)  # what constant velocity cannot know
    assert np.median(error) < 0.5 * sway_px_s2 * blind_s * (blind_s + 0.1) + 0.5
    assert np.median(error) < 0.5 * np.median(standing)


def test_points_of_an_earlier_instant_and_its_motion(plane: Scene) -> None:
    pose = straight((20, 100), SECONDS)
    pictures = film(plane, pose)
    first = follow(plane, pose, pictures[:20])
    shifted = np.column_stack([np.eye(2), [5.0, -3.0]])
    points = first.points_px - [5.0, -3.0]
    second = track(
        pictures[:20], points, rng=np.random.default_rng(0), initial_affine=shifted, motion=first.result.motion
    )
    assert second.points_px[second.alive] == pytest.approx(first.result.points_px[second.alive], abs=0.5)


def test_a_different_scene_is_not_tracked(plane: Scene) -> None:
    pose = straight((20, 100), SECONDS)
    other = make_scene(np.random.default_rng(77))
    pictures = film(plane, pose, count=30) + [replace(p, time_s=p.time_s + 0.6) for p in film(other, pose, count=30)]
    result = follow(plane, pose, pictures).result
    assert result.time_s < 0.55
    assert result.gaps >= 9


def test_inputs_are_checked(plane: Scene) -> None:
    black = TimedPicture(image=np.zeros((480, 640), np.uint8), time_s=0.0)
    with pytest.raises(InputError, match="no usable picture"):
        track([black], np.zeros((10, 2)), rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="at least 6"):
        track(film(plane, straight((1, 1), 1), 2), np.zeros((3, 2)), rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="parity"):
        square_field(np.zeros((10, 10), np.uint8), 2)


@pytest.mark.parametrize("parity", [0, 1])
def test_both_parities_land_in_frame_pixels(parity: int) -> None:
    rows, columns = np.indices((480, 640), dtype=float)
    dither = np.random.default_rng(0).uniform(-0.5, 0.5, rows.shape)
    frame = 20 + 0.1 * columns + 0.3 * rows
    lines = np.round(frame + dither).astype(np.uint8)[parity::2]
    full = square_field(lines, parity).astype(float)
    assert full.shape == (480, 640)
    assert np.abs(full - frame)[4:-4].max() <= 1.7
    assert abs((full - frame)[4:-4].mean()) < 0.1
    half = square_field_half(lines, parity).astype(float)
    r, c = np.indices(half.shape)
    at = frame_from_half(np.column_stack([c.ravel(), r.ravel()]))
    expected = (20 + 0.1 * at[:, 0] + 0.3 * at[:, 1]).reshape(half.shape)
    # half a frame row wrong would be 0.15 grey values, the rounding of eighths is 0.06
    assert abs((half - expected)[2:-2].mean()) < 0.1
    assert half_from_frame(at) == pytest.approx(np.column_stack([c.ravel(), r.ravel()]))


def test_the_parity_does_not_move_the_picture(plane: Scene) -> None:
    rng = np.random.default_rng(3)
    still = straight((0, 0), 1.0, sway_px=0.0)
    (p0, top, _), (p1, bottom, _) = fields(plane, still, 2, rng, noise=0.5, jpeg=98)
    points = select_points(richness(orientation_codes(square_field(top, p0)), 25, 0.5), 40, 1, 30)
    pair = [TimedPicture(image=square_field(lines, p), time_s=p * FIELD_S) for p, lines in ((p0, top), (p1, bottom))]
    result = track(pair, points, rng=np.random.default_rng(0))
    moved = (result.points_px - points)[result.alive]
    assert result.alive.mean() > 0.9
    assert np.abs(np.median(moved, axis=0)).max() < 0.1  # a wrong parity would move by a whole row


def test_least_median_of_squares_stands_40_percent_of_blunders() -> None:
    rng = np.random.default_rng(4)
    source = rng.uniform(0, 600, (200, 2))
    truth = np.array([[0.98, 0.12, 4.0], [-0.11, 1.01, -7.0]])
    target = apply_affine(truth, source) + rng.normal(0, 0.2, (200, 2))
    target[:80] += rng.uniform(3, 40, (80, 2))  # one-sided: a mean would follow
    motion = fit_affine_robustly(source, target, rng)
    assert not motion.inliers[:80].any()
    assert motion.inliers[80:].mean() > 0.95
    assert 0.2 < motion.scale_px < 0.8  # the median is taken over blunders as well, through triples of noisy points
    at_corners = apply_affine(motion.target_from_source, np.array([[0.0, 0.0], [600.0, 600.0]]))
    assert at_corners == pytest.approx(apply_affine(truth, np.array([[0.0, 0.0], [600.0, 600.0]])), abs=0.15)


def test_degenerate_points_determine_no_affine() -> None:
    rng = np.random.default_rng(0)
    line = np.column_stack([np.arange(20.0), 2 * np.arange(20.0)])
    with pytest.raises(AdjustmentError, match="line"):
        fit_affine_robustly(line, line, rng)
    with pytest.raises(AdjustmentError, match="at least 6"):
        fit_affine_robustly(line[:5], line[:5], rng)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-6, 3.0, 60.0])
def test_motion_continues_at_its_own_speed(angle_deg: float) -> None:
    a = np.radians(angle_deg)
    step = np.array([[np.cos(a), -np.sin(a), 5.0], [np.sin(a), np.cos(a), 2.0]]) * [[1.01, 1.01, 1], [1.01, 1.01, 1]]
    twice = similarity_power(step, 2.0)
    assert twice == pytest.approx(compose(step, step), abs=1e-5)
    half = similarity_power(step, 0.5)
    assert compose(half, half) == pytest.approx(step, abs=1e-5)
    assert nearest_similarity(step, np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 50.0]])) == pytest.approx(step, abs=1e-9)


def test_coarse_motion_finds_shift_and_turn(plane: Scene) -> None:
    pose = straight((70, -50), 1.0, turn_deg=12, sway_px=0.0)
    first, *_, last = film(plane, pose, count=61, every=60)
    found = coarse_motion(first.image, last.image, np.eye(2, 3))
    A, _ = pose(last.time_s)
    points = np.array([[200.0, 150.0], [440.0, 150.0], [320.0, 330.0]])
    assert np.abs(apply_affine(found, points) - apply_affine(A, points)).max() < 8  # what the wide search covers


def test_a_match_that_locked_elsewhere_is_found_out(plane: Scene) -> None:
    pose = straight((20, 60), 1.0, sway_px=0.0)
    pictures = film(plane, pose, count=40)
    points = select_points(richness(orientation_codes(pictures[0].image), 25, 0.5), 40, 1, 30)
    rng = np.random.default_rng(0)
    state = start(pictures[0], points)
    for picture in pictures[1:6]:
        state = advance(state, picture, rng)
    wrong = int(np.argmin(np.hypot(*(state.points_px - [320, 240]).T)))
    moved = state.points_px.copy()
    moved[wrong] += [9.0, -6.0]  # as if it had locked on similar ground, with a template from there
    source_px, warps = state.source_px.copy(), state.source_warps
    source_px[wrong] += [9.0, -6.0]
    strayed = replace(state, points_px=moved, source_px=source_px, source_warps=warps)
    after = advance(strayed, pictures[6], rng)
    assert after.misses[wrong] > 0
    truth = positions(plane, points[wrong : wrong + 1], pose(pictures[6].time_s))
    assert after.points_px[wrong] == pytest.approx(truth[0], abs=1.0)  # it waits where the neighbours imply it


def test_decayed_templates_are_renewed_with_their_warp(plane: Scene) -> None:
    pose = straight((10, 30), 2.0, turn_deg=60)
    pictures = film(plane, pose, count=120)
    eager = TrackingOptions(renewal_dissimilarity=0.0)  # every match counts as decayed
    outcome = follow(plane, pose, pictures, eager)
    error = outcome.error_px[outcome.alive]
    assert outcome.alive.mean() > 0.85
    # renewed every third picture: the error adds up as a random walk, but nothing jumps
    assert np.quantile(error, 0.95) < 2.0
    lasting = follow(plane, pose, pictures)
    assert np.median(lasting.error_px[lasting.alive]) < np.median(error)
