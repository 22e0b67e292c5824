"""Where each still was taken, as tags for its file: of the adjusted block, or as measured."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.block import Block
from uavkit.core.heights import HeightDatum
from uavkit.core.records import StillInfo
from uavkit.core.result import OrientedBlock

if TYPE_CHECKING:
    from uavkit.formats.geotag import GeoTag


SAME_DEG = 1e-8
NO_HEIGHT_SIGMA_M = 50.0
"""Heights that ingest did not get are in the block with a sigma of 100 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StillTags:
    """Tags by still, and why other stills have none."""

    tags: "dict[str, GeoTag]"
    without: dict[str, str]


def adjusted_tags(result: OrientedBlock) -> StillTags:
    """Return the tags of the oriented stills: projection centre, its sigmas, and the camera's rotation.

    A free network lies nowhere on earth: then no still has a tag.
    """
    from uavkit.formats.geotag import GeoTag

    if result.frame is None:
        reason = "the block is a free network, which lies nowhere on earth"
        return StillTags(tags={}, without={still.name: reason for still in result.block.stills})
    adjusted, times = result.adjustment, _times_ns(result.block)
    place = result.frame.geographic_from_enu(adjusted.projection_centres_m)
    sigma_m = np.sqrt(np.diagonal(adjusted.exterior_covariances, axis1=1, axis2=2)[:, :3])
    tags = {
        name: GeoTag(
            latitude_deg=float(place[row, 0]),
            longitude_deg=float(place[row, 1]),
            height_m=float(place[row, 2]),
            height_datum=HeightDatum.ELLIPSOID,
            gps_time_ns=times.get(name),
            sigma_horizontal_m=float(np.sqrt(np.mean(sigma_m[row, :2] ** 2))),
            sigma_vertical_m=float(sigma_m[row, 2]),
            R_enu_from_image=adjusted.R_object_from_image[row],
        )
        for row, name in enumerate(result.images)
    }
    without = {name: f"not oriented: {reason}" for name, reason in result.unoriented.items()}
    return StillTags(tags=tags, without=without)


def measured_tags(block: Block) -> StillTags:
    """Return the tags of the stills whose position was measured: positions of the antenna with their sigmas.

    Positions whose heights count from the ground, or are missing, get no height.
    """
    from uavkit.formats.geotag import GeoTag

    names = [still.name for still in block.stills]
    if block.gnss is None or block.frame is None:
        return StillTags(tags={}, without={name: "nothing tells its position" for name in names})
    matches = block.exposures.stills if block.exposures else ()
    probability = {entry.still: entry.probability for entry in matches}
    place, tags = block.frame.geographic_from_enu(block.gnss.position_m), dict[str, GeoTag]()
    times = _times_ns(block)
    for row, index in enumerate(block.gnss.image_index.tolist()):
        still = block.stills[index]
        east, north, up = block.gnss.sigma_m[row].tolist()
        height_m, datum = _height(still, place[row], up)
        tags[still.name] = GeoTag(
            latitude_deg=float(place[row, 0]),
            longitude_deg=float(place[row, 1]),
            height_m=height_m,
            height_datum=datum,
            gps_time_ns=times.get(still.name),
            sigma_horizontal_m=float(np.sqrt(0.5 * (east**2 + north**2))),
            sigma_vertical_m=up if np.isfinite(height_m) else None,
            probability=probability.get(still.name, 1.0),
        )
    reasons = {entry.still: entry.reason or entry.state.value for entry in matches}
    without = {name: reasons.get(name, "nothing tells its position") for name in names if name not in tags}
    return StillTags(tags=tags, without=without)


def _height(still: StillInfo, place: Array, sigma_up_m: float) -> tuple[float, HeightDatum]:
    """Return the height to be written: none where the block has none, and a still's own, of unknown datum, as it is."""
    own = still.position
    if own is not None and own.height_datum is HeightDatum.UNKNOWN:
        same = abs(own.latitude_deg - place[0]) < SAME_DEG and abs(own.longitude_deg - place[1]) < SAME_DEG
        if same:
            return own.height_m, HeightDatum.GEOID
    return (float(place[2]) if sigma_up_m < NO_HEIGHT_SIGMA_M else float("nan")), HeightDatum.ELLIPSOID


def _times_ns(block: Block) -> dict[str, int]:
    """Return the GPS times of the exposures, as far as a log or EXIF tells them."""
    times = {
        still.name: still.position.gps_time_ns
        for still in block.stills
        if still.position is not None and still.position.gps_time_ns is not None
    }
    for entry in block.exposures.stills if block.exposures else ():
        if entry.gps_time_ns is not None:
            times[entry.still] = entry.gps_time_ns
    return times
