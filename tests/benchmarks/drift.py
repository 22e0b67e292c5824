"""How far points have drifted when the video has led them to the next still; beside it, chained Lucas-Kanade.

Points are followed from a still, reduced to the video's geometry, through all fields to the next still; the truth comes
from the simulator's ground and cameras. Both trackers get the same points and the same pictures.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests.benchmarks.evaluation import true_views, true_world
from uavkit.core.arrays import Array, Flags
from uavkit.core.block import StillInVideo, VideoSync
from uavkit.formats.block_file import read_block
from uavkit.formats.image_files import FileStillSource
from uavkit.formats.video import FileVideoSource
from uavkit.process.options import CandidateOptions, MeasurementOptions
from uavkit.process.pictures import PictureStore, PyramidStore
from uavkit.process.tracking import TimedPicture
from uavkit.process.video_points import Helpers, VideoInput, pictures_between, track_between_stills
from uavkit.project import Project
from uavkit.simulate.truth import read_truth

RIGHT_PX = 2.0
LEAST_CONTRAST = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """Points between two stills: where they truly are in the next, and where each tracker puts them; still pixels."""

    truth_px: Array
    ours_px: Array
    ours_found: Flags
    peer_px: Array
    peer_found: Flags


def given_of(survey: Path) -> VideoInput:
    """Return what tracking needs of an ingested survey."""
    project = Project(survey)
    block = read_block(project.block_file)
    images, video = project.original_path("images"), project.original_path("video")
    if images is None or video is None or block.video is None:
        raise ValueError(f"{survey}: no stills, no video, or no still found in it")
    store = PictureStore(FileStillSource(images), tuple(still.name for still in block.stills))
    return VideoInput(
        video=FileVideoSource(video),
        sync=block.video,
        store=store,
        pyramids=PyramidStore(store),
        candidates=CandidateOptions(),
        measurement=MeasurementOptions(),
    )


def intervals(survey: Path, flight: Path) -> Iterable[Interval]:
    """Follow the points chosen in each still to the next one, with both trackers."""
    truth = read_truth(flight / "truth" / "truth.json")
    world, views = true_world(truth), true_views(truth)
    given = given_of(survey)
    helpers = Helpers(given)
    for places in pairwise(given.sync.places):
        here, there = (views[place.still] for place in places)
        points = helpers.chosen(given.store.names.index(places[0].still))
        ground = here.intersect(world, points)
        seen = there.sees(world, ground, 25.0)
        points, ground = points[seen], ground[seen]
        if len(points) < 20:
            continue
        ours, found, _ = track_between_stills(given, places, points, helpers)
        peer, held = chained_lucas_kanade(given, places, points, helpers)
        yield Interval(truth_px=there.project(ground), ours_px=ours, ours_found=found, peer_px=peer, peer_found=held)


def chained_lucas_kanade(
    given: VideoInput, places: tuple[StillInVideo, StillInVideo], here_px: Array, helpers: Helpers
) -> tuple[Array, Flags]:
    """Follow points (n, 2) from picture to picture; returns where they are in the next still, and which were held."""
    sync: VideoSync = given.sync
    at = sync.still_from_video.inverse().apply(here_px).astype(np.float32)
    held = np.ones(len(at), dtype=bool)
    before: np.ndarray | None = None
    for picture in pictures_between(given, places, helpers):
        if not shows_something(picture):
            continue
        if before is not None:
            at, status, _ = cv2.calcOpticalFlowPyrLK(before, picture.image, at, None, winSize=(21, 21), maxLevel=3)
            held &= status.ravel() == 1
        before = picture.image
    return sync.still_from_video.apply(at.astype(float)), held


def shows_something(picture: TimedPicture) -> bool:
    """Tell whether a picture is not black; the peer has no test of its own."""
    return picture.usable and float(picture.image[::4, ::4].std()) >= LEAST_CONTRAST


def drift(survey: Path, flight: Path) -> dict[str, Any]:
    """Return errors in video pixels, of the points that each tracker holds, and how many of them are right."""
    found = list(intervals(survey, flight))
    scale = float(np.sqrt(abs(np.linalg.det(given_of(survey).sync.still_from_video.matrix))))
    ours = errors(found, "ours", scale)
    peer = errors(found, "peer", scale)
    return {"intervals": len(found), "points": sum(len(i.truth_px) for i in found), **ours, **peer}


def errors(found: list[Interval], whose: str, scale: float) -> Mapping[str, float]:
    """Return median and 95 % of the errors of the points that are held, and the share of all points that is right."""
    every = np.concatenate([np.linalg.norm(getattr(i, f"{whose}_px") - i.truth_px, axis=1) for i in found]) / scale
    held = np.concatenate([getattr(i, f"{whose}_found") for i in found])
    name = "ours" if whose == "ours" else "lk"
    return {
        f"{name}_median_video_px": float(np.median(every[held])),
        f"{name}_95_percent_video_px": float(np.quantile(every[held], 0.95)),
        f"{name}_held": int(held.sum()),
        f"{name}_right": int((held & (every <= RIGHT_PX)).sum()),
    }
