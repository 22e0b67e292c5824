"""Synchronise stills with the video: shutter events by intervals, each verified by content, none by its number.

1. One pass over the video finds the shutter events (``shutter_events``).
2. Stills and events are matched by content (``still_matching``): the still, reduced, against the last live field.
3. Times and content together are aligned over all order-preserving pairings (``sequence_alignment``).
4. All good pairs give the transformation from video to stills.
5. Stills without an event are looked for by content between their neighbours.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from uavkit.core.arrays import Array, Image
from uavkit.core.block import StillInVideo, VideoSync
from uavkit.core.devices import StillSource, VideoSource
from uavkit.core.progress import Progress, silent
from uavkit.core.records import FieldOrder, StillInfo, VideoInfo
from uavkit.core.video import AffineTransformation
from uavkit.ingest.sequence_alignment import (
    AlignmentOptions,
    SequenceAlignment,
    align_by_order,
    align_sequences,
)
from uavkit.ingest.shutter_events import (
    ShutterEvent,
    displacement,
    estimated_field_order,
    find_shutter_events,
    scan_video,
)
from uavkit.ingest.still_matching import (
    FEW_FEATURES,
    ContentMatch,
    Features,
    FieldPicture,
    PreparedStill,
    common_transformation,
    features_of_field,
    field_picture,
    match_content,
    nominal_transformation,
    prepare_stills,
    robust_affine,
    tone_likeness,
    transformation_by_tone,
    window_correspondences,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SyncOptions:
    """Options of ``synchronise``."""

    jitter_s: float = 0.04
    """Standard deviation of camera time against video time apart from offset, drift and whole-second stamps."""
    greatest_drift_ppm: float = 500.0
    wanted_probability: float = 0.99
    search_step_frames: int = 6
    """Between the frames that are searched for a still without an event."""
    whole_search_step_frames: int = 15
    """The same where the whole video is searched."""
    greatest_content_shift_px: float = 6.0
    """Of the content against its expected place, in video pixels, for a place found by content alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SyncOutcome:
    """The synchronised video, or None with the reason among the notes."""

    sync: VideoSync | None
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Scene:
    """What every step needs: the stills and the video at hand."""

    infos: tuple[StillInfo, ...]
    stills: dict[str, PreparedStill] = field(repr=False)
    video: VideoSource
    video_info: VideoInfo
    order: FieldOrder
    options: SyncOptions

    @property
    def row_step(self) -> int:
        """Lines of the frame between two lines of a picture."""
        return 1 if self.order is FieldOrder.PROGRESSIVE else 2

    @property
    def nominal(self) -> AffineTransformation:
        """Still from video as if the finder showed the whole still."""
        first = self.infos[0]
        size = (self.video_info.width_px, self.video_info.height_px)
        return nominal_transformation((first.width_px, first.height_px), size)

    @property
    def middle(self) -> Array:
        """Middle of the video picture."""
        return 0.5 * np.array([self.video_info.width_px - 1.0, self.video_info.height_px - 1.0])

    def match(self, picture: Features, still: str) -> ContentMatch | None:
        """Match a video picture with a still."""
        return match_content(picture, self.stills[still].features, self.nominal, self.video_info.width_px)


@dataclass(frozen=True, slots=True, kw_only=True)
class _EventView:
    """What the video shows just before a shutter event."""

    event: ShutterEvent
    picture: FieldPicture
    features: Features = field(repr=False)
    motion_px: Array
    """(2,) from the last live field to the exposure, in frame pixels."""


def synchronise(
    stills: StillSource,
    infos: tuple[StillInfo, ...],
    video: VideoSource,
    progress: Progress = silent,
    options: SyncOptions = SyncOptions(),
) -> SyncOutcome:
    """Return where in the video each still was taken, and the transformation between both.

    Stills that cannot be decoded are named in the notes and left without a place.
    """
    prepared = prepare_stills(stills, infos, video.info().width_px, progress)
    outcome = synchronise_prepared(prepared.pictures, infos, video, progress, options)
    unread = tuple(f"still {name} has no place in the video: {why}" for name, why in prepared.unreadable.items())
    return SyncOutcome(sync=outcome.sync, notes=(*unread, *outcome.notes))


def synchronise_prepared(
    pictures: dict[str, PreparedStill],
    infos: tuple[StillInfo, ...],
    video: VideoSource,
    progress: Progress = silent,
    options: SyncOptions = SyncOptions(),
) -> SyncOutcome:
    """Do as ``synchronise`` with stills that are reduced to the video's width already."""
    scan = scan_video(video, progress)
    notes = [f"video: {text}" for text in video.damage()]
    usable = tuple(info for info in infos if info.name in pictures)
    if len(scan) < 10:
        return SyncOutcome(sync=None, notes=(*notes, f"video not used because it has only {len(scan)} readable frames"))
    if not usable:
        return SyncOutcome(sync=None, notes=(*notes, "video not used because no still can be read"))
    order, order_notes = _field_order(video.info(), estimated_field_order(scan))
    notes += order_notes
    scene = _Scene(infos=usable, stills=pictures, video=video, video_info=video.info(), order=order, options=options)
    events = find_shutter_events(scan, order, video.info().frame_interval_ns)
    outcome = _by_events(scene, events, notes, progress) if events else None
    if outcome is not None and (_well_placed(outcome, scene) or any(event.kind == "black" for event in events)):
        return outcome
    # a hovering camera may seem frozen: pictures that stand still are no shutters unless they agree with the stills
    notes.append("the video shows no shutter: stills are placed by content alone")
    return _by_content_alone(scene, (int(scan.frame_index[0]), int(scan.frame_index[-1])), notes, progress)


def _well_placed(outcome: SyncOutcome, scene: _Scene) -> bool:
    """Tell whether at least half of the stills belong to events."""
    places = outcome.sync.places if outcome.sync is not None else ()
    return 2 * sum(place.kind != "content" for place in places) >= len(scene.infos)


def _field_order(info: VideoInfo, found: FieldOrder | None) -> tuple[FieldOrder, list[str]]:
    """Return the order to use: what motion shows, else what the source says."""
    told = info.field_order
    if found is None:
        if told is not None:
            return told, []
        return FieldOrder.PROGRESSIVE, [
            "video: the order of the fields is not told and too little moves to find it; taken as progressive"
        ]
    if told is not None and told is not found:
        return found, [
            f"video: the source says {told.value} field order, but motion is smooth only as {found.value}: that is used"
        ]
    return found, []


def _by_events(
    scene: _Scene, events: tuple[ShutterEvent, ...], earlier_notes: list[str], progress: Progress
) -> SyncOutcome:
    notes = list(earlier_notes)
    views = _event_views(scene, events)
    rough = _align(scene, events, np.zeros((len(scene.infos), len(events))))
    matches = _content_matches(scene, views, rough.matrix, progress)
    common = _common(scene, matches, rough) or _common_by_tone(scene, views, rough)
    if common is None:
        notes.append(
            f"video not used because its {len(events)} shutter events do not show what the stills show: "
            "is it the video of this flight?"
        )
        return SyncOutcome(sync=None, notes=tuple(notes))
    by_detail = _evidence(scene, views, matches, common)
    evidence = _with_tone(scene, views, (matches, by_detail), (common, rough.matrix))
    alignment = _align(scene, events, evidence)
    pairs = [(int(i), int(j)) for i, j in alignment.pairs]
    certain = [(i, j) for i, j in pairs if evidence[i, j] > 0]
    transformation, residual = _transformation(scene, views, certain, (common, _own_residual_px(matches.values())))
    places = [
        _place(scene.infos[i].name, events[j], float(p)) for (i, j), p in zip(pairs, alignment.probability, strict=True)
    ]
    notes += _ambiguous_notes(scene, alignment, events)
    places += _missing_places(scene, places, alignment.first_unpaired, transformation, events)
    return _outcome(
        scene, places, (transformation, residual), [events[j].last_frame + 1 for j in alignment.second_unpaired], notes
    )


def _place(name: str, event: ShutterEvent, probability: float) -> StillInVideo:
    return StillInVideo(
        still=name,
        last_frame=event.last_frame,
        first_frame=event.first_frame,
        exposure_time_ns=event.exposure_time_ns,
        kind=event.kind,
        confidence=min(probability, 1.0),
    )


def _outcome(
    scene: _Scene,
    places: list[StillInVideo],
    fitted: tuple[AffineTransformation, float],
    left_events: list[int],
    notes: list[str],
) -> SyncOutcome:
    placed = {place.still for place in places}
    without = tuple(info.name for info in scene.infos if info.name not in placed)
    if without:
        notes.append(f"{len(without)} stills have no place in the video: {', '.join(without)}")
    if left_events:
        notes.append(
            f"{len(left_events)} shutter events belong to no still, at frames {', '.join(map(str, left_events))}"
        )
    sync = VideoSync(
        places=tuple(sorted(places, key=lambda place: place.exposure_time_ns)),
        still_from_video=fitted[0],
        residual_px=fitted[1],
        field_order=scene.order,
        frame_interval_ns=scene.video_info.frame_interval_ns,
        stills_without_event=without,
        events_without_still=tuple(left_events),
    )
    return SyncOutcome(sync=sync, notes=tuple(notes))


def _frames(video: VideoSource, wanted: Iterable[int]) -> dict[int, Image]:
    """Return the luminance of the wanted frames that can be read, in one pass over the part they lie in."""
    left = set(wanted)
    if not left:
        return {}
    found = {}
    for frame in video.frames(min(left), max(left)):
        if frame.index in left and not frame.damaged:
            found[frame.index] = frame.luminance
    return found


def _event_views(scene: _Scene, events: tuple[ShutterEvent, ...]) -> list[_EventView]:
    frames = _frames(scene.video, (e.last_field_frame - back for e in events for back in (0, 1)))
    views = []
    for event in events:
        row = event.last_field_row if scene.row_step == 2 else 0
        here, before = frames.get(event.last_field_frame), frames.get(event.last_field_frame - 1)
        if here is None:
            here = np.zeros((scene.video_info.height_px, scene.video_info.width_px), dtype=np.uint8)
        picture = field_picture(here, row, scene.row_step)
        motion = np.zeros(2)
        if before is not None:
            moved = displacement(before[row :: scene.row_step], picture.lines) * [1.0, scene.row_step]
            share = (event.exposure_time_ns - event.last_field_ns) / scene.video_info.frame_interval_ns
            # a jump is no motion: the correlation went astray
            motion = moved * share if float(np.abs(moved).max()) < 40.0 else motion
        views.append(_EventView(event=event, picture=picture, features=features_of_field(picture), motion_px=motion))
    return views


def _align(scene: _Scene, events: tuple[ShutterEvent, ...], evidence: Array) -> SequenceAlignment:
    """Align by times and evidence where every still tells a time, by order and evidence else."""
    resolution = max(info.camera_time_resolution_ns for info in scene.infos) * 1e-9
    options = AlignmentOptions(
        first_resolution_s=resolution,
        jitter_s=scene.options.jitter_s,
        greatest_drift_ppm=scene.options.greatest_drift_ppm,
        wanted_probability=scene.options.wanted_probability,
    )
    times = [info.camera_time_ns for info in scene.infos]
    known = [time for time in times if time is not None]
    if len(known) < len(times) or any(b < a for a, b in pairwise(known)):
        return align_by_order(evidence, options)
    stills_s = (np.array(known, dtype=np.int64) - known[0]).astype(np.float64) * 1e-9
    return align_sequences(stills_s, np.array([e.exposure_time_ns for e in events]) * 1e-9, options, evidence)


def _content_matches(
    scene: _Scene, views: list[_EventView], likely: Array, progress: Progress
) -> dict[tuple[int, int], ContentMatch]:
    """Match the pairs that time does not exclude by content."""
    matches = {}
    for i, info in enumerate(scene.infos):
        for j in np.flatnonzero(likely[i] > 1e-5):
            match = scene.match(views[j].features, info.name)
            if match is not None:
                matches[i, int(j)] = match
        progress("match stills and video", i + 1, len(scene.infos))
    return matches


def _common(
    scene: _Scene, matches: dict[tuple[int, int], ContentMatch], rough: SequenceAlignment
) -> AffineTransformation | None:
    """Return the transformation in which the best match of each still agree; sure pairs by time alone go first."""
    sure = [matches[i, j] for i, j in map(tuple, rough.pairs.tolist()) if (i, j) in matches]
    if len(sure) >= 3:
        found = common_transformation(sure, scene.middle, 3)
        if found is not None:
            return found
    best: dict[int, ContentMatch] = {}
    for (i, _), match in sorted(matches.items()):
        if i not in best or len(match) > len(best[i]):
            best[i] = match
    return common_transformation(list(best.values()), scene.middle, min(3, len(scene.infos)))


def _evidence(
    scene: _Scene,
    views: list[_EventView],
    matches: dict[tuple[int, int], ContentMatch],
    common: AffineTransformation,
) -> Array:
    """Return the logarithm of how much likelier each pair is by its content.

    A pair of the same content at its place is worth +8, one off its place less by the square of the distance, to -8.
    No match counts against a pair only where both pictures have enough to be matched.
    """
    shifts = {pair: match.shift_px(common) + views[pair[1]].motion_px for pair, match in matches.items()}
    lengths = np.array([float(np.linalg.norm(shift)) for shift in shifts.values()])
    near = lengths[lengths < 0.05 * scene.video_info.width_px]
    sigma = max(2.0, 1.5 * float(np.median(near))) if len(near) else 2.0
    evidence = np.zeros((len(scene.infos), len(views)))
    for i, info in enumerate(scene.infos):
        rich = len(scene.stills[info.name].features.xy) >= 100
        for j, view in enumerate(views):
            if (i, j) in shifts:
                off = float(np.linalg.norm(shifts[i, j])) / sigma
                evidence[i, j] = max(8.0 - 0.5 * off**2, -8.0)
            elif rich and len(view.features.xy) >= 100:
                evidence[i, j] = -8.0
    return evidence


def _common_by_tone(scene: _Scene, views: list[_EventView], rough: SequenceAlignment) -> AffineTransformation | None:
    """Return the transformation in which pairs that are likely by time have the same tone: detail may be too faint."""
    likely = np.argwhere(rough.matrix > 0.5).tolist()
    pairs = [(views[j].picture, scene.stills[scene.infos[i].name].reduced) for i, j in likely]
    if len(pairs) < LEAST_BY_TONE:
        return None
    some = pairs[:: max(1, len(pairs) // MOST_BY_TONE)]
    return transformation_by_tone(some, scene.nominal, scene.middle)


LEAST_BY_TONE = 3
MOST_BY_TONE = 8
"""Pairs that give the transformation by tone."""
TONE_EVIDENCE = ((0.4, 0.7), (-8.0, 8.0))
"""Correlations of tone, and the evidence that they are."""
TONE_AGAINST_DETAIL = 2.0
"""The most that tone counts for a pair whose detail was found elsewhere: less than detail in its place."""


def _with_tone(
    scene: _Scene,
    views: list[_EventView],
    found: tuple[dict[tuple[int, int], ContentMatch], Array],
    known: tuple[AffineTransformation, Array],
) -> Array:
    """Return the evidence (n, m), found by matches of detail, with that of tone, for pairs that time leaves open.

    Where all ground looks alike, detail finds no match for the right pair and may find one for a wrong: then tone
    decides. It decides nothing where there is none.
    """
    (matches, evidence), (common, likely) = found, known
    result = evidence.copy()
    for i, j in np.argwhere(likely > 1e-5).tolist():
        likeness = tone_likeness(views[j].picture, scene.stills[scene.infos[i].name].reduced, common)
        if likeness is None:
            continue
        by_tone = float(np.interp(likeness, *TONE_EVIDENCE))
        if evidence[i, j] > 0:
            result[i, j] = min(evidence[i, j], by_tone)
        else:
            result[i, j] = min(by_tone, TONE_AGAINST_DETAIL) if (i, j) in matches else by_tone
    return result


def _transformation(
    scene: _Scene, views: list[_EventView], pairs: list[tuple[int, int]], start: tuple[AffineTransformation, float]
) -> tuple[AffineTransformation, float]:
    """Return the affine transformation over all pairs, refined twice by phase correlation, with its residual (RMS);
    what it started from where too few windows correlate."""
    result, residual = start
    for _ in range(2):
        frame_xy, still_xy = [np.zeros((0, 2))], [np.zeros((0, 2))]
        for i, j in pairs:
            reduced = scene.stills[scene.infos[i].name].reduced
            a, b = window_correspondences(views[j].picture, reduced, result)
            frame_xy.append(a + views[j].motion_px)
            still_xy.append(b)
        source, target = np.concatenate(frame_xy), np.concatenate(still_xy)
        if len(source) < 12:
            break
        result, residual = robust_affine(source, target, np.ones(len(source)))
    return result, residual


def _own_residual_px(matches: Iterable[ContentMatch]) -> float:
    """Return the RMS of a coordinate's residual of matches in their own transformations, in still pixels."""
    residuals = [match.still_xy - match.still_from_video.apply(match.frame_xy) for match in matches]
    if not residuals:
        return float("nan")
    return float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))


def _ambiguous_notes(scene: _Scene, alignment: SequenceAlignment, events: tuple[ShutterEvent, ...]) -> list[str]:
    notes = []
    for i in alignment.first_ambiguous:
        likely = np.flatnonzero(alignment.matrix[i] > 0.01)
        where = ", ".join(f"frame {events[j].last_frame} ({alignment.matrix[i, j]:.2f})" for j in likely)
        notes.append(f"still {scene.infos[i].name}: its place in the video is ambiguous and left open: {where}")
    return notes


def _missing_places(
    scene: _Scene,
    places: list[StillInVideo],
    missing: tuple[int, ...],
    transformation: AffineTransformation,
    events: tuple[ShutterEvent, ...],
) -> list[StillInVideo]:
    """Look for stills without an event by content between the places of their neighbours."""
    by_name = {place.still: place for place in places}
    found = []
    for i in missing:
        before = [by_name[info.name].first_frame for info in scene.infos[:i] if info.name in by_name]
        after = [by_name[info.name].last_frame for info in scene.infos[i + 1 :] if info.name in by_name]
        # beyond the ends: as far as three usual gaps
        gap = int(3 * np.median(np.diff([e.last_frame for e in events]))) if len(events) > 1 else 300
        first = before[-1] if before else max((after[0] - gap) if after else 0, 0)
        last = after[0] if after else first + gap
        place = _search(scene, i, (first, last), transformation)
        if place is not None:
            by_name[place.still] = place
            found.append(place)
    return found


def _search(scene: _Scene, i: int, span: tuple[int, int], transformation: AffineTransformation) -> StillInVideo | None:
    """Return the place of a still between two frames by its content, None where it does not appear."""
    step = scene.options.search_step_frames
    coarse = _shifts(scene, i, range(span[0], span[1] + 1, step), transformation)
    if not coarse:
        return None
    best = min(coarse, key=lambda index: float(np.linalg.norm(coarse[index][0])))
    near = range(max(best - step, span[0]), min(best + step, span[1]) + 1)
    fine = _shifts(scene, i, near, transformation) | {best: coarse[best]}
    best = min(fine, key=lambda index: float(np.linalg.norm(fine[index][0])))
    shift, time_ns, count = fine[best]
    if float(np.linalg.norm(shift)) > scene.options.greatest_content_shift_px or count < LEAST_CONTENT_POINTS:
        return None
    confidence = float(np.clip(count / 40.0, 0.3, 0.9) * np.exp(-0.5 * (np.linalg.norm(shift) / 6.0) ** 2))
    return StillInVideo(
        still=scene.infos[i].name,
        last_frame=best,
        first_frame=best + 1,
        exposure_time_ns=time_ns,
        kind="content",
        confidence=confidence,
    )


LEAST_CONTENT_POINTS = 15


def _shifts(
    scene: _Scene, i: int, wanted: range, transformation: AffineTransformation
) -> dict[int, tuple[Array, int, int]]:
    """Return for the wanted frames that show a still: shift (2,) of its content in video px, time, number of points."""
    left, found = set(wanted), {}
    if not left:
        return {}
    for frame in scene.video.frames(min(left), max(left)):
        if frame.index not in left or frame.damaged:
            continue
        picture = field_picture(frame.luminance, 0, scene.row_step)
        match = scene.match(features_of_field(picture), scene.infos[i].name)
        if match is not None and len(match) >= LEAST_CONTENT_POINTS:
            found[frame.index] = (match.shift_px(transformation), frame.time_ns, len(match))
    return found


def _by_content_alone(scene: _Scene, span: tuple[int, int], notes: list[str], progress: Progress) -> SyncOutcome:
    """Place the stills by content where the video shows no shutter."""
    sampled = _sampled_features(scene, span, progress)
    best: list[tuple[int, int, ContentMatch]] = []
    for i, info in enumerate(scene.infos):
        found = []
        for index, features in sampled.items():
            match = scene.match(features, info.name)
            if match is not None and len(match) >= LEAST_CONTENT_POINTS:
                found.append((float(np.linalg.norm(match.shift_px(scene.nominal))), index, match))
        if found:
            _, index, match = min(found, key=lambda entry: entry[:2])
            best.append((i, index, match))
        progress("search stills in video", i + 1, len(scene.infos))
    common = _scaled_about_middle(scene, [match for _, _, match in best])
    if common is None:
        notes.append("video not used because it shows no shutter and too few stills are found in it by content")
        return SyncOutcome(sync=None, notes=tuple(notes))
    step = scene.options.whole_search_step_frames
    places, previous = [], span[0] - 1
    for i, index, _ in best:
        place = _search(scene, i, (max(index - step, previous + 1), min(index + step, span[1])), common)
        if place is not None and place.last_frame > previous:
            places.append(place)
            previous = place.last_frame
    notes.append("places by content alone: the finder is assumed to show the middle of the still")
    residual_px = _own_residual_px(match for _, _, match in best)
    return _outcome(scene, places, (common, residual_px), [], notes)


def _sampled_features(scene: _Scene, span: tuple[int, int], progress: Progress) -> dict[int, Features]:
    step = scene.options.whole_search_step_frames
    features = {}
    for frame in scene.video.frames(*span):
        if (frame.index - span[0]) % step == 0 and not frame.damaged:
            picture = field_picture(frame.luminance, 0, scene.row_step)
            features[frame.index] = features_of_field(picture, FEW_FEATURES)
            progress("read video again", frame.index - span[0], span[1] - span[0] + 1)
    return features


def _scaled_about_middle(scene: _Scene, matches: list[ContentMatch]) -> AffineTransformation | None:
    """Return the median matrix of the matches about the middle of the still; where exactly cannot be told from content
    that moves. None for fewer than three matches."""
    if len(matches) < 3:
        return None
    matrix = np.median([match.still_from_video.matrix for match in matches], axis=0)
    target = scene.nominal.apply(scene.middle[None])[0]
    return AffineTransformation(matrix=matrix, shift=target - matrix @ scene.middle)
