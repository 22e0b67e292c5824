"""Tags of stills from a block as measured, and from an adjusted one."""

from dataclasses import replace

import numpy as np
import pytest

from tests.report.conftest import make_result_
from uavkit.core.adjustment import Datum
from uavkit.core.block import Block, PositionFacts, PositionSource
from uavkit.core.exposures import ExposureMatches, StillExposure, StillState
from uavkit.core.heights import HeightDatum
from uavkit.core.observations import GnssObservations
from uavkit.core.result import OrientedBlock
from uavkit.products.geotags import adjusted_tags, measured_tags


@pytest.fixture(scope="module")
def result() -> OrientedBlock:
    return make_result_()


def test_adjusted_tags_are_projection_centres_with_their_sigmas(result: OrientedBlock) -> None:
    found = adjusted_tags(result)
    assert set(found.tags) == set(result.images)
    assert set(found.without) == set(result.unoriented)
    frame, adjusted = result.frame, result.adjustment
    assert frame is not None
    for row, name in enumerate(result.images):
        tag = found.tags[name]
        place = frame.enu_from_geographic(
            np.array([tag.latitude_deg]), np.array([tag.longitude_deg]), np.array([tag.height_m])
        )
        assert place[0] == pytest.approx(adjusted.projection_centres_m[row], abs=1e-6)
        assert tag.sigma_vertical_m == pytest.approx(float(np.sqrt(adjusted.exterior_covariances[row, 2, 2])))
        assert np.array_equal(tag.R_enu_from_image, adjusted.R_object_from_image[row])


def test_a_free_network_lies_nowhere(result: OrientedBlock) -> None:
    free = replace(result, adjustment=replace(result.adjustment, datum=Datum.FREE_NETWORK))
    found = adjusted_tags(free)
    assert not found.tags
    assert all("free network" in reason for reason in found.without.values())


def measured(result: OrientedBlock, **facts: object) -> Block:
    """The block with positions of its first two stills, the second one's matched with an exposure."""
    names = [still.name for still in result.block.stills]
    gnss = GnssObservations(
        image_index=np.array([0, 1]),
        position_m=np.array([[1.0, 2.0, 30.0], [4.0, 6.0, 31.0]]),
        sigma_m=np.array([[0.3, 0.4, 0.2]] * 2),
        flight=np.zeros(2, dtype=np.int64),
    )
    entries = (
        StillExposure(still=names[1], state=StillState.MATCHED, probability=0.9995, event=1, gps_time_ns=10**18),
        StillExposure(still=names[2], state=StillState.AMBIGUOUS, probability=0.6, reason="ambiguous: 2 or 3"),
    )
    known = PositionFacts(
        source=PositionSource.LOG,
        height_datum=HeightDatum.GEOID,
        probability=np.array([1.0, 0.9995]),
        sigma_stated=np.array([True, True]),
    )
    matches = ExposureMatches(sources=("flight.BIN",), stills=entries, unused=(), events=3, clocks=())
    return replace(result.block, gnss=gnss, exposures=matches, positions=replace(known, **facts))


def test_measured_tags_are_positions_with_time_and_probability(result: OrientedBlock) -> None:
    block = measured(result)
    found = measured_tags(block)
    names = [still.name for still in block.stills]
    assert set(found.tags) == {names[0], names[1]}
    tag = found.tags[names[1]]
    assert (tag.gps_time_ns, tag.probability, tag.height_datum) == (10**18, 0.9995, HeightDatum.ELLIPSOID)
    assert tag.sigma_horizontal_m == pytest.approx(np.sqrt(0.5 * (0.09 + 0.16)))
    assert found.without[names[2]] == "ambiguous: 2 or 3"
    assert "flight logs" in found.notes[0]


def test_what_was_not_stated_is_not_written(result: OrientedBlock) -> None:
    ground = measured_tags(measured(result, height_datum=HeightDatum.GROUND)).tags.values()
    assert all(np.isnan(tag.height_m) and tag.sigma_vertical_m is None for tag in ground)
    bare = measured_tags(measured(result, source=PositionSource.EXIF, sigma_stated=np.zeros(2, dtype=np.bool_)))
    assert all(tag.sigma_horizontal_m is None and tag.probability is None for tag in bare.tags.values())


def test_heights_of_unknown_datum_stay_as_they_are_in_both_kinds_of_tags(result: OrientedBlock) -> None:
    block = measured(result, height_datum=HeightDatum.UNKNOWN)
    assert {tag.height_datum for tag in measured_tags(block).tags.values()} == {HeightDatum.UNKNOWN}
    free_of_control = replace(result.adjustment, control_used=np.zeros_like(result.adjustment.control_used))
    adjusted = adjusted_tags(replace(result, block=block, adjustment=free_of_control))
    assert {tag.height_datum for tag in adjusted.tags.values()} == {HeightDatum.UNKNOWN}
    assert any("--height-datum" in note for note in adjusted.notes)
    tag = next(iter(adjusted.tags.values()))
    assert tag.heights_m[0] == tag.height_m
    assert np.isnan(tag.heights_m[1])
