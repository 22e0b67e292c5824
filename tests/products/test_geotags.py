"""Tags of stills from a block as measured, and from an adjusted one."""

from dataclasses import replace

import numpy as np
import pytest

from tests.report.conftest import make_result_
from uavkit.core.adjustment import Datum
from uavkit.core.exposures import ExposureMatches, StillExposure, StillState
from uavkit.core.heights import HeightDatum
from uavkit.core.observations import GnssObservations
from uavkit.core.records import GnssFix
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


def measured(result: OrientedBlock, up_sigma_m: float = 0.2) -> OrientedBlock:
    """The block with positions of its first two stills, the second one's matched with an exposure."""
    names = [still.name for still in result.block.stills]
    gnss = GnssObservations(
        image_index=np.array([0, 1]),
        position_m=np.array([[1.0, 2.0, 30.0], [4.0, 6.0, 31.0]]),
        sigma_m=np.array([[0.3, 0.4, up_sigma_m]] * 2),
        flight=np.zeros(2, dtype=np.int64),
    )
    entries = (
        StillExposure(still=names[1], state=StillState.MATCHED, probability=0.9995, event=1, gps_time_ns=10**18),
        StillExposure(still=names[2], state=StillState.AMBIGUOUS, probability=0.6, reason="ambiguous: 2 or 3"),
    )
    matches = ExposureMatches(sources=("flight.BIN",), stills=entries, unused=(), events=3, clocks=())
    stills = tuple(replace(still, position=None) for still in result.block.stills)
    return replace(result, block=replace(result.block, gnss=gnss, exposures=matches, stills=stills))


def test_measured_tags_are_positions_with_time_and_probability(result: OrientedBlock) -> None:
    block = measured(result).block
    found = measured_tags(block)
    names = [still.name for still in block.stills]
    assert set(found.tags) == {names[0], names[1]}
    tag = found.tags[names[1]]
    assert (tag.gps_time_ns, tag.probability, tag.height_datum) == (10**18, 0.9995, HeightDatum.ELLIPSOID)
    assert tag.sigma_horizontal_m == pytest.approx(np.sqrt(0.5 * (0.09 + 0.16)))
    assert found.without[names[2]] == "ambiguous: 2 or 3"


def test_heights_that_ingest_did_not_get_are_not_written(result: OrientedBlock) -> None:
    found = measured_tags(measured(result, up_sigma_m=100.0).block)
    assert all(np.isnan(tag.height_m) and tag.sigma_vertical_m is None for tag in found.tags.values())


def test_a_stills_own_height_of_unknown_datum_stays_as_it_is(result: OrientedBlock) -> None:
    block = measured(result).block
    assert block.gnss is not None
    assert block.frame is not None
    place = block.frame.geographic_from_enu(block.gnss.position_m)[0]
    own = GnssFix(
        gps_time_ns=None, latitude_deg=float(place[0]), longitude_deg=float(place[1]), height_m=198.3,
        height_datum=HeightDatum.UNKNOWN,
    )  # fmt: skip
    stills = (replace(block.stills[0], position=own), *block.stills[1:])
    tag = measured_tags(replace(block, stills=stills)).tags[block.stills[0].name]
    assert (tag.height_m, tag.height_datum) == (198.3, HeightDatum.GEOID)
