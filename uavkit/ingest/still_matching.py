"""Find stills in video pictures by their contents, and the transformation between both.

The finder shows nearly the whole still, upright, cropped by a few per cent: a candidate that would need a turn or
another scale, or lies elsewhere, is no match. Points of interest are SIFT's (Lowe 2004) with RANSAC; the final
transformation comes from phase correlation of windows of the still, brought into the field's own lines, against the
field.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Image
from uavkit.core.devices import StillSource
from uavkit.core.errors import InputError
from uavkit.core.progress import Progress
from uavkit.core.records import StillInfo
from uavkit.core.video import AffineTransformation

FEATURES = 700
FEW_FEATURES = 300
"""Where hundreds of pictures are searched."""
LEAST_MATCHES = 10
GREATEST_SHIFT = 0.15
"""Of the finder's picture against the middle of the still, as a share of its width."""
GREATEST_SCALE_OFF = 0.25
GREATEST_TURN_RAD = 0.1
WINDOWS = (6, 5)
WINDOW = (128, 64)
"""Columns and field lines of a window of the phase correlation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldPicture:
    """One field, its lines doubled to square pixels; a progressive frame as it is."""

    lines: Image
    """(lines, columns) of the field itself."""
    first_row: int
    row_step: int

    def square(self) -> Image:
        """Return the picture with as many rows as the woven frame has."""
        import cv2

        if self.row_step == 1:
            return self.lines
        height, width = self.lines.shape
        return np.asarray(cv2.resize(self.lines, (width, height * self.row_step), interpolation=cv2.INTER_CUBIC))

    def frame_from_square(self, xy: Array) -> Array:
        """Return frame coordinates (n, 2) of places in ``square``: the middle of line k is row step k + (step - 1) / 2
        there."""
        return np.asarray(xy + [0.0, self.first_row - 0.5 * (self.row_step - 1)])


def field_picture(luminance: Image, first_row: int, row_step: int) -> FieldPicture:
    """Return one field of a woven frame (step 2), or the whole frame (step 1)."""
    lines = np.ascontiguousarray(luminance[first_row::row_step])
    return FieldPicture(lines=lines, first_row=first_row, row_step=row_step)


@dataclass(frozen=True, slots=True, kw_only=True)
class Features:
    """Points of interest."""

    xy: Array
    """(n, 2) in still pixels or in frame coordinates."""
    descriptors: NDArray[np.float32] = field(repr=False)
    """(n, 128), of length 1."""


def _features(picture: Image, most: int) -> tuple[Array, NDArray[np.float32]]:
    import cv2

    points, descriptors = cv2.SIFT_create(nfeatures=most).detectAndCompute(picture, None)  # type: ignore[attr-defined,unused-ignore]
    if descriptors is None or len(points) == 0:
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    length = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return np.array([point.pt for point in points], dtype=np.float64), (descriptors / length).astype(np.float32)


def features_of_field(picture: FieldPicture, most: int = FEATURES) -> Features:
    """Return the points of interest of a field in frame coordinates."""
    xy, descriptors = _features(picture.square(), most)
    return Features(xy=picture.frame_from_square(xy), descriptors=descriptors)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReducedStill:
    """A still at the video's scale."""

    grey: Image = field(repr=False)
    still_from_reduced: float
    """Scale; pixel centres at integers on both sides."""

    def still_coordinates(self, xy: Array) -> Array:
        """Return still pixels (n, 2) of pixels of the reduced picture."""
        return np.asarray((xy + 0.5) * self.still_from_reduced - 0.5)


def reduce_still(grey: Image, video_width_px: int) -> ReducedStill:
    """Return a still reduced to about the width of the video (never enlarged)."""
    import cv2

    height, width = grey.shape
    scale = max(1.0, width / video_width_px)
    size = (round(width / scale), round(height / scale))
    return ReducedStill(
        grey=np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA)), still_from_reduced=width / size[0]
    )


def features_of_still(reduced: ReducedStill) -> Features:
    """Return the points of interest of a still in still pixels."""
    xy, descriptors = _features(reduced.grey, FEATURES)
    return Features(xy=reduced.still_coordinates(xy), descriptors=descriptors)


@dataclass(frozen=True, slots=True, kw_only=True)
class PreparedStill:
    """A still reduced, and its points of interest."""

    reduced: ReducedStill
    features: Features


@dataclass(frozen=True, slots=True, kw_only=True)
class PreparedStills:
    """All stills that can be decoded, by name, and of the others why not."""

    pictures: dict[str, PreparedStill]
    unreadable: dict[str, str]


def prepare_stills(
    stills: StillSource, infos: Sequence[StillInfo], width_px: int, progress: Progress
) -> PreparedStills:
    """Decode each still once and reduce it to ``width_px``; those that cannot be decoded are named."""
    pictures, unreadable = {}, {}
    for number, info in enumerate(infos):
        try:
            reduced = reduce_still(stills.grey(info.name), width_px)
        except InputError as error:
            unreadable[info.name] = str(error)
            continue
        pictures[info.name] = PreparedStill(reduced=reduced, features=features_of_still(reduced))
        progress("reduce stills", number + 1, len(infos))
    return PreparedStills(pictures=pictures, unreadable=unreadable)


def share_content(one: Features, two: Features) -> bool:
    """Tell whether two stills show some of the same: enough points of interest agree in one similarity."""
    import cv2

    if min(len(one.xy), len(two.xy)) < LEAST_MATCHES:
        return False
    likeness = one.descriptors @ two.descriptors.T
    best = likeness.argmax(axis=1)
    rows = np.arange(len(best))
    value = likeness[rows, best].copy()
    mutual = likeness.argmax(axis=0)[best] == rows
    likeness[rows, best] = -1.0
    keep = mutual & (np.sqrt(np.maximum(2 - 2 * value, 0)) < 0.8 * np.sqrt(np.maximum(2 - 2 * likeness.max(axis=1), 0)))
    if int(keep.sum()) < LEAST_MATCHES:
        return False
    a, b = one.xy[keep], two.xy[best[keep]]
    reach = 0.02 * float(np.ptp(one.xy[:, 0]))  # relief moves points off any one similarity
    matrix, inliers = cv2.estimateAffinePartial2D(a, b, method=cv2.RANSAC, ransacReprojThreshold=reach)
    return matrix is not None and int(inliers.sum()) >= LEAST_MATCHES


def nominal_transformation(still_size: tuple[int, int], video_size: tuple[int, int]) -> AffineTransformation:
    """Return still from video (width, height each) as if the finder showed the whole still."""
    scale = np.array([still_size[0] / video_size[0], still_size[1] / video_size[1]])
    return AffineTransformation(matrix=np.diag(scale), shift=0.5 * scale - 0.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class ContentMatch:
    """A still found in a video picture."""

    frame_xy: Array = field(repr=False)
    """(k, 2)."""
    still_xy: Array = field(repr=False)
    """(k, 2)."""
    still_from_video: AffineTransformation

    def __len__(self) -> int:
        return len(self.frame_xy)

    def shift_px(self, common: AffineTransformation) -> Array:
        """Return by how many video pixels the content lies off the place that a transformation gives it (median)."""
        expected = common.inverse().apply(self.still_xy)
        return np.asarray(np.median(self.frame_xy - expected, axis=0))


def match_content(
    video: Features, still: Features, nominal: AffineTransformation, width_px: int
) -> ContentMatch | None:
    """Return the places that a still and a video picture of ``width_px`` columns have in common, None for no match.

    Only places near where the nominal transformation puts them count.
    """
    import cv2

    if min(len(video.xy), len(still.xy)) < LEAST_MATCHES:
        return None
    expected = nominal.inverse().apply(still.xy)
    likeness = video.descriptors @ still.descriptors.T
    far = np.abs(video.xy[:, None, :] - expected[None, :, :]).max(axis=2) > GREATEST_SHIFT * width_px
    gated = np.where(far, -1.0, likeness)
    best = gated.argmax(axis=1)
    rows = np.arange(len(best))
    mutual = gated.argmax(axis=0)[best] == rows
    # distances of unit vectors: Lowe's ratio of 0.85 on angles, against every other point of the still
    value = gated[rows, best]
    likeness[rows, best] = -1.0
    distinct = np.sqrt(np.maximum(2 - 2 * value, 0)) < 0.85 * np.sqrt(np.maximum(2 - 2 * likeness.max(axis=1), 0))
    keep = mutual & distinct & (value > 0)
    if int(keep.sum()) < LEAST_MATCHES:
        return None
    a, b = video.xy[keep], still.xy[best[keep]]
    normal = nominal.inverse().apply(b)
    matrix, inliers = cv2.estimateAffinePartial2D(a, normal, method=cv2.RANSAC, ransacReprojThreshold=3.0)
    if matrix is None or inliers is None:
        return None
    inside = inliers.ravel().astype(bool)
    if int(inside.sum()) < LEAST_MATCHES or not _plausible(matrix[:, :2]):
        return None
    own = AffineTransformation(matrix=matrix[:, :2], shift=matrix[:, 2])
    whole = AffineTransformation(matrix=nominal.matrix @ own.matrix, shift=nominal.apply(own.shift[None])[0])
    return ContentMatch(frame_xy=a[inside], still_xy=b[inside], still_from_video=whole)


def _plausible(matrix: Array) -> bool:
    scale = float(np.sqrt(abs(np.linalg.det(matrix))))
    turn = float(np.arctan2(matrix[1, 0], matrix[0, 0]))
    return abs(scale - 1.0) < GREATEST_SCALE_OFF and abs(turn) < GREATEST_TURN_RAD


def common_transformation(matches: Sequence[ContentMatch], middle: Array, least: int) -> AffineTransformation | None:
    """Return the affine transformation that most matches agree in, None where fewer than half or ``least`` do.

    Each match maps the middle of the video, shape (2,), somewhere: those near the median are taken together.
    """
    if not matches:
        return None
    places = np.array([match.still_from_video.apply(middle[None])[0] for match in matches])
    scale = float(np.median([np.sqrt(abs(np.linalg.det(m.still_from_video.matrix))) for m in matches]))
    near = np.linalg.norm(places - np.median(places, axis=0), axis=1) < 0.03 * 2.0 * middle[0] * scale
    if int(near.sum()) < least or 2 * int(near.sum()) < len(matches):
        return None
    chosen = [match for match, good in zip(matches, near, strict=True) if good]
    frame_xy = np.concatenate([match.frame_xy for match in chosen])
    still_xy = np.concatenate([match.still_xy for match in chosen])
    return robust_affine(frame_xy, still_xy, np.ones(len(frame_xy)))[0]


def robust_affine(source: Array, target: Array, weight: Array) -> tuple[AffineTransformation, float]:
    """Return target from source, (n, 2) each, by least squares with Tukey's weights, and the RMS of a coordinate's
    residual over what was kept, in pixels of the target."""
    centre = source.mean(axis=0)
    design = np.column_stack([source - centre, np.ones(len(source))])
    robust = np.ones(len(source))
    solution = np.zeros((3, 2))
    for _ in range(12):
        root = np.sqrt(weight * robust)[:, None]
        solution, *_ = np.linalg.lstsq(design * root, target * root, rcond=None)
        residual = np.linalg.norm(target - design @ solution, axis=1)
        scale = max(0.849 * float(np.median(residual)), 1e-6)
        robust = np.maximum(1.0 - (residual / (4.685 * scale)) ** 2, 0.0) ** 2
    kept = robust > 0
    rms = float(np.sqrt(np.mean(residual[kept] ** 2) / 2.0))
    matrix = solution[:2].T
    return AffineTransformation(matrix=matrix, shift=solution[2] - matrix @ centre), rms


def window_correspondences(
    picture: FieldPicture, reduced: ReducedStill, still_from_video: AffineTransformation
) -> tuple[Array, Array]:
    """Return places of the field in frame coordinates (k, 2) and the same in still pixels (k, 2).

    The still is brought into the field's lines by the transformation so far; each window's remaining shift is found by
    phase correlation, and windows that do not correlate are left out.
    """
    import cv2

    lines, columns = picture.lines.shape
    warped = _still_in_field(picture, reduced, still_from_video)
    window = cv2.createHanningWindow(WINDOW, cv2.CV_32F)
    width, height = min(WINDOW[0], columns), min(WINDOW[1] * (3 - picture.row_step), lines)
    if (width, height) != WINDOW:
        window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    frame, still = [], []
    for top in np.linspace(0, lines - height, WINDOWS[1]).astype(int):
        for left in np.linspace(0, columns - width, WINDOWS[0]).astype(int):
            part = (slice(top, top + height), slice(left, left + width))
            a, b = warped[part].astype(np.float32), picture.lines[part].astype(np.float32)
            if min(float(a.std()), float(b.std())) < 3.0:
                continue
            (dx, dy), response = cv2.phaseCorrelate(a, b, window)
            if response < 0.15 or abs(dx) > 8.0 or abs(dy) * picture.row_step > 8.0:
                continue
            x, y = left + 0.5 * (width - 1), top + 0.5 * (height - 1)
            here = picture.first_row + picture.row_step * y
            still.append(still_from_video.apply(np.array([[x, here]]))[0])
            frame.append([x + dx, here + picture.row_step * dy])
    return np.array(frame).reshape(-1, 2), np.array(still).reshape(-1, 2)


TONE_SIZE = (160, 120)
TONE_BAND = (2.0, 10.0)
"""Smoothing, and smoothing taken off, of pictures of ``TONE_SIZE``: standard deviations, pixels."""
TONE_RIM = 8
"""By so many pixels of ``TONE_SIZE`` the camera may have moved between the picture and the exposure."""
LEAST_TONE = 0.4
"""Standard deviation of tone, grey values, below which a picture shows none."""


def tone(lines: Image) -> NDArray[np.float32]:
    """Return what a picture shows without detail and without wide shading, of ``TONE_SIZE``.

    It tells places apart where all detail looks alike, as in rows of plants, or is too faint to be described.
    """
    import cv2

    small = cv2.resize(lines, TONE_SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)
    detail, wide = (cv2.GaussianBlur(small, (0, 0), sigma) for sigma in TONE_BAND)
    return np.asarray(detail - wide, dtype=np.float32)


def tone_likeness(picture: FieldPicture, reduced: ReducedStill, still_from_video: AffineTransformation) -> float | None:
    """Return the highest correlation of tone of a still and a field shifted a little, None where there is no tone.

    Some 0.9 for the same place, below 0.4 for another.
    """
    import cv2

    rim = slice(TONE_RIM + 4, -TONE_RIM - 4)
    still = tone(_still_in_field(picture, reduced, still_from_video))[rim, rim]
    video = tone(picture.lines)[4:-4, 4:-4]
    if min(float(still.std()), float(video.std())) < LEAST_TONE:
        return None
    return float(cv2.matchTemplate(video, still, cv2.TM_CCOEFF_NORMED).max())


def transformation_by_tone(
    pairs: Sequence[tuple[FieldPicture, ReducedStill]], nominal: AffineTransformation, middle: Array
) -> AffineTransformation | None:
    """Return the transformation in which still and field of most pairs have the same tone, None where they have not.

    The finder shows the middle of the still by some scale, which is tried; each pair is then registered by the enhanced
    correlation coefficient, and the median of all counts.
    """
    tried = []
    for scale in np.arange(0.80, 1.101, 0.01):
        shift = nominal.apply(middle[None])[0] - nominal.matrix @ middle * scale
        one = AffineTransformation(matrix=nominal.matrix * scale, shift=shift)
        likeness = [tone_likeness(picture, reduced, one) or 0.0 for picture, reduced in pairs]
        tried.append((float(np.median(likeness)), one))
    value, start = max(tried, key=lambda entry: entry[0])
    if value < LEAST_LIKENESS:
        return None
    found = [_registered(picture, reduced, start) for picture, reduced in pairs]
    known = [one for one in found if one is not None]
    if 2 * len(known) < len(pairs) or not known:
        return start
    matrix = np.median([one.matrix for one in known], axis=0)
    centre = np.median([one.apply(middle[None])[0] for one in known], axis=0)
    return AffineTransformation(matrix=matrix, shift=centre - matrix @ middle)


LEAST_LIKENESS = 0.6
"""Median correlation of tone of pairs that belong together."""


def _registered(
    picture: FieldPicture, reduced: ReducedStill, start: AffineTransformation
) -> AffineTransformation | None:
    """Return still from video by the whole content of one pair, None where that does not converge."""
    import cv2

    still = _still_in_field(picture, reduced, start)
    flat = [
        (soft - cv2.GaussianBlur(soft, (0, 0), 12.0)).astype(np.float32)
        for soft in (cv2.GaussianBlur(lines.astype(np.float32), (0, 0), 1.5) for lines in (picture.lines, still))
    ]
    end = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-5)
    try:
        likeness, warp = cv2.findTransformECC(
            flat[0], flat[1], np.eye(2, 3, dtype=np.float32), cv2.MOTION_AFFINE, end, np.full_like(still, 255), 5
        )
    except cv2.error:
        return None
    if likeness < LEAST_REGISTERED:
        return None
    # the warp is of the field's lines: warped still from field
    step = np.array([1.0, float(picture.row_step)])
    first = np.array([0.0, float(picture.first_row)])
    matrix = step[:, None] * warp[:, :2] / step[None, :]
    shift = first + step * warp[:, 2] - matrix @ first
    return AffineTransformation(
        matrix=start.matrix @ matrix, shift=start.apply(np.asarray(shift, dtype=np.float64)[None])[0]
    )


LEAST_REGISTERED = 0.3
"""Correlation of a still and a field, finer detail included, that were brought together."""


def _still_in_field(picture: FieldPicture, reduced: ReducedStill, still_from_video: AffineTransformation) -> Image:
    """Return the still as the field would show it, shape of the field."""
    import cv2

    lines, columns = picture.lines.shape
    to_frame = np.diag([1.0, float(picture.row_step)])
    matrix = still_from_video.matrix @ to_frame / reduced.still_from_reduced
    start = still_from_video.apply(np.array([[0.0, float(picture.first_row)]]))[0]
    shift = (start + 0.5) / reduced.still_from_reduced - 0.5
    table = np.column_stack([matrix, shift])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(reduced.grey, table, (columns, lines), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    )
