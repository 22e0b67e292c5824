"""Where each still was taken, as tags for its file: of the adjusted block, or as measured."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uavkit.core.block import Block, PositionSource
from uavkit.core.exposures import StillExposure
from uavkit.core.heights import HeightDatum
from uavkit.core.result import OrientedBlock

if TYPE_CHECKING:
    from uavkit.formats.geotag import GeoTag


@dataclass(frozen=True, slots=True, kw_only=True)
class StillTags:
    """Tags by still, and why other stills have none."""

    tags: "dict[str, GeoTag]"
    without: dict[str, str]
    notes: tuple[str, ...] = ()
    """What the positions are, in words."""


def adjusted_tags(result: OrientedBlock) -> StillTags:
    """Return the tags of the oriented stills: projection centre, its sigmas, and the camera's rotation.

    A free network lies nowhere on earth: then no still has a tag. Heights by positions of unknown datum alone stay of
    unknown datum.
    """
    from uavkit.formats.geotag import GeoTag

    if result.frame is None:
        reason = "the block is a free network, which lies nowhere on earth"
        return StillTags(tags={}, without={still.name: reason for still in result.block.stills})
    adjusted, times, facts = result.adjustment, _times_ns(result.block), result.block.positions
    by_control = bool(np.any(adjusted.control_used))
    datum = HeightDatum.ELLIPSOID if by_control or facts is None else _tag_datum(facts.height_datum)
    place = result.frame.geographic_from_enu(adjusted.projection_centres_m)
    sigma_m = np.sqrt(np.diagonal(adjusted.exterior_covariances, axis1=1, axis2=2)[:, :3])
    tags = {
        name: GeoTag(
            latitude_deg=float(place[row, 0]),
            longitude_deg=float(place[row, 1]),
            height_m=float(place[row, 2]),
            height_datum=datum,
            gps_time_ns=times.get(name),
            sigma_horizontal_m=float(np.sqrt(np.mean(sigma_m[row, :2] ** 2))),
            sigma_vertical_m=float(sigma_m[row, 2]),
            R_enu_from_image=adjusted.R_object_from_image[row],
        )
        for row, name in enumerate(result.images)
    }
    without = {name: f"not oriented: {reason}" for name, reason in result.unoriented.items()}
    notes = ("positions: projection centres of the adjusted block", *_datum_notes(datum))
    return StillTags(tags=tags, without=without, notes=notes)


def measured_tags(block: Block) -> StillTags:
    """Return the tags of the stills whose position was measured, with the sigmas that were stated.

    Positions whose heights count from the ground, or are missing, get no height.
    """
    from uavkit.formats.geotag import GeoTag

    names = [still.name for still in block.stills]
    if block.gnss is None or block.frame is None or block.positions is None:
        return StillTags(tags={}, without={name: "nothing tells its position" for name in names})
    facts, times = block.positions, _times_ns(block)
    datum, tags = _tag_datum(facts.height_datum), dict[str, GeoTag]()
    place = block.frame.geographic_from_enu(block.gnss.position_m)
    for row, index in enumerate(block.gnss.image_index.tolist()):
        east, north, up = block.gnss.sigma_m[row].tolist()
        stated, has_height = bool(facts.sigma_stated[row]), facts.height_datum is not HeightDatum.GROUND
        tags[names[index]] = GeoTag(
            latitude_deg=float(place[row, 0]),
            longitude_deg=float(place[row, 1]),
            height_m=float(place[row, 2]) if has_height else float("nan"),
            height_datum=datum,
            gps_time_ns=times.get(names[index]),
            sigma_horizontal_m=float(np.sqrt(0.5 * (east**2 + north**2))) if stated else None,
            sigma_vertical_m=up if stated and has_height else None,
            probability=None if facts.source is PositionSource.EXIF else float(facts.probability[row]),
        )
    reasons = {entry.still: entry.reason or entry.state.value for entry in _matches(block)}
    without = {name: reasons.get(name, "nothing tells its position") for name in names if name not in tags}
    what = "of the antenna" if any(block.gnss.lever_arm_m) else "as measured"
    notes = (f"positions: {what}, from {facts.source.value}", *_datum_notes(datum))
    return StillTags(tags=tags, without=without, notes=notes)


def _tag_datum(datum: HeightDatum) -> HeightDatum:
    """Return the datum of a block's heights: ellipsoidal, unless nothing says what the positions' count from."""
    return HeightDatum.UNKNOWN if datum is HeightDatum.UNKNOWN else HeightDatum.ELLIPSOID


def _datum_notes(datum: HeightDatum) -> tuple[str, ...]:
    if datum is not HeightDatum.UNKNOWN:
        return ()
    return ("what the heights count from is unknown: they are written as they are, state it by ingest --height-datum",)


def _matches(block: Block) -> tuple[StillExposure, ...]:
    return block.exposures.stills if block.exposures else ()


def _times_ns(block: Block) -> dict[str, int]:
    """Return the GPS times of the exposures, as far as a log or EXIF tells them."""
    times = {
        still.name: still.position.gps_time_ns
        for still in block.stills
        if still.position is not None and still.position.gps_time_ns is not None
    }
    for entry in _matches(block):
        if entry.gps_time_ns is not None:
            times[entry.still] = entry.gps_time_ns
    return times
