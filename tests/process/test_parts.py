"""Blocks that fall into parts: all parts are found, and features between them make the block whole, true to scale."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from tests.process.made_blocks import FULL, Ground, Observed, ground_points, observe, stations
from tests.process.test_approximations import NOMINAL, SIGMAS
from uavkit.core.arrays import Array, Indices
from uavkit.core.errors import AdjustmentError
from uavkit.core.orientation import ExteriorOrientation
from uavkit.core.progress import silent
from uavkit.core.result import PointOrigin
from uavkit.process.absolute import fit_similarity
from uavkit.process.approximations import GrowingBlock, orient_approximately, ray_table
from uavkit.process.candidates import Candidates
from uavkit.process.features import pairs_to_compare
from uavkit.process.parts import Pairs, joined_by_features, orient_in_parts, pairs_to_add, part_numbers

STRIPS, PER_STRIP = 3, 7
PARTS = np.repeat([0, 1, 2], [4, 7, 10])
"""Part of each still: the stills 3 | 4 and 10 | 11 have points in common, but share none of these with a third."""


@dataclass
class Flight:
    """A made flight with rays to points of the video and to points of features; keeps which pairs were matched."""

    places: list[ExteriorOrientation]
    video: Observed
    features: Observed
    asked: list[Pairs] = field(default_factory=list)

    @property
    def count(self) -> int:
        return len(self.places)

    def through(self) -> Candidates:
        """Points of the video: within the parts, and many between the last still of one and the first of the next."""
        last = np.flatnonzero(np.diff(PARTS))
        kind = np.array([3, 3, 3, 4, -1, -1])[self.video.point % 6]  # half of the points for 3 | 4, a sixth for 10 | 11
        in_pair = np.isin(self.video.image, [last[0], last[0] + 1]) & (kind == 3)
        in_pair |= np.isin(self.video.image, [last[1], last[1] + 1]) & (kind == 4)
        group = np.where(in_pair, kind, np.where(kind < 0, PARTS[self.video.image], -1))
        return _grouped(self.video, group)

    def match(self, pairs: Pairs) -> Candidates:
        """Feature points of all pairs: those stills of a point hang together that pairs lead between."""
        self.asked.append(pairs)
        partner = np.eye(self.count, dtype=bool)
        for i, j in pairs:
            partner[i, j] = partner[j, i] = True
        group = np.full(len(self.features.point), -1)
        starts = np.flatnonzero(np.diff(self.features.point, prepend=-1))
        for rows in np.split(np.arange(len(group)), starts[1:]):
            reach = partner[np.ix_(self.features.image[rows], self.features.image[rows])].astype(int)
            group[rows] = np.argmax(np.linalg.matrix_power(reach, len(rows)) > 0, axis=1)
        return _grouped(self.features, group)

    def orient(self, candidates: Candidates) -> list[GrowingBlock]:
        point, image, xy, _ = candidates.all_rays()
        table = ray_table(point, image, xy, NOMINAL)
        return orient_in_parts(table, (self.count, len(candidates)), NOMINAL, SIGMAS, silent)


def _grouped(seen: Observed, group: Indices) -> Candidates:
    """One candidate for the rays of each point that are of one group (k,); the first is its reference; -1 is none."""
    number = np.unique(seen.point * 100 + group, return_inverse=True)[1]
    rows = np.flatnonzero((group >= 0) & (np.bincount(number)[number] >= 2))
    rows = rows[np.lexsort((seen.image[rows], number[rows]))]
    _, first, point = np.unique(number[rows], return_index=True, return_inverse=True)
    others = np.setdiff1d(np.arange(len(rows)), first)
    return Candidates(
        reference_image=seen.image[rows[first]],
        reference_px=seen.xy_px[rows[first]],
        origin=np.full(len(first), PointOrigin.VIDEO, dtype=np.int8),
        ray_point=point[others],
        ray_image=seen.image[rows[others]],
        ray_px=seen.xy_px[rows[others]],
        ray_sigma_px=np.full((len(others), 2), 0.5),
    )


def _flight(seed: int = 21) -> Flight:
    rng = np.random.default_rng(seed)
    places = stations(STRIPS, PER_STRIP, rng)
    video, features = (
        observe(places, ground_points(Ground(3.0), places, count, rng), FULL, rng) for count in (3600, 700)
    )
    return Flight(places, video, features)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return _flight()


def _errors_m(block: GrowingBlock, places: list[ExteriorOrientation]) -> Array:
    """Errors of the oriented centres (n, 3) after the best similarity."""
    rows = np.flatnonzero(block.oriented)
    truth = np.array([places[row].projection_centre_m for row in rows.tolist()])
    return fit_similarity(block.centres[rows], truth).apply(block.centres[rows]) - truth


def test_all_parts_are_found_the_largest_first(flight: Flight) -> None:
    parts = flight.orient(flight.through())
    number = part_numbers(parts, flight.count)
    # parts are numbered by their size: the ten last stills, the seven in the middle, the first four
    np.testing.assert_array_equal(number, 2 - PARTS)
    for part in parts[:3]:
        assert np.abs(_errors_m(part, flight.places)).max() < 0.3


def test_the_richest_pair_may_lead_nowhere(flight: Flight) -> None:
    """A block that begins with the pair of most points in common ends with it, where no third still sees these."""
    candidates = flight.through()
    point, image, xy, _ = candidates.all_rays()
    table = ray_table(point, image, xy, NOMINAL)
    allowed = np.isin(np.arange(flight.count), [3, 4])
    block = orient_approximately(table, (flight.count, len(candidates)), NOMINAL, SIGMAS, silent, allowed)
    assert np.flatnonzero(block.oriented).tolist() == [3, 4]


def test_features_between_the_parts_make_the_block_whole() -> None:
    """Pairs of what the first attempt left out alone would not do: it orients the stills 3 and 4 only, then twelve."""
    flight = _flight(22)
    positions = np.array([place.projection_centre_m for place in flight.places])
    pairs = pairs_to_compare(flight.count, positions, 4)
    joined = joined_by_features(flight.through(), ([], pairs), NOMINAL, flight.match, flight.orient)
    assert joined.block.oriented.all()
    assert np.sqrt(np.mean(_errors_m(joined.block, flight.places) ** 2)) < 0.05  # as of a block that never was apart
    between = [(i, j) for i, j in pairs if PARTS[i] != PARTS[j]]
    assert flight.asked == [[], between]  # what hung together before was not matched again
    assert joined.notes == [
        f"the stills fell into 3 parts with too few points in common: features were tried in {len(between)} more pairs"
    ]


def test_a_whole_block_needs_no_further_pairs() -> None:
    flight = _flight(23)
    pairs = pairs_to_compare(flight.count, None, 10)
    whole = _grouped(flight.video, np.zeros(len(flight.video.point), dtype=int))
    joined = joined_by_features(whole, ([], pairs), NOMINAL, flight.match, flight.orient)
    assert flight.asked == [[]]
    assert joined.notes == []
    assert joined.block.oriented.all()


def test_where_features_find_nothing_the_largest_part_remains() -> None:
    flight = _flight(24)
    nothing = flight.match([])
    pairs = pairs_to_compare(flight.count, None, 10)
    asked: list[Pairs] = []

    def match(now: Pairs) -> Candidates:
        asked.append(now)
        return nothing

    joined = joined_by_features(flight.through(), ([], pairs), NOMINAL, match, flight.orient)
    assert len(asked) == 2  # once between the parts; without a tie nothing within them is tried
    assert np.flatnonzero(joined.block.oriented).tolist() == np.flatnonzero(PARTS == 2).tolist()
    assert sorted(joined.block.reasons) == np.flatnonzero(PARTS != 2).tolist()


def test_without_any_points_the_error_comes_after_all_pairs() -> None:
    flight = _flight(25)
    nothing, asked = flight.match([]), list[Pairs]()

    def match(now: Pairs) -> Candidates:
        asked.append(now)
        return nothing

    with pytest.raises(AdjustmentError, match="no two stills"):
        joined_by_features(nothing, ([], [(0, 1), (1, 2)]), NOMINAL, match, flight.orient)
    assert asked == [[], [(0, 1), (1, 2)]]


def test_pairs_within_parts_follow_where_features_tie_these() -> None:
    part = np.array([0, 0, 0, 1, 1, 1])
    common = np.zeros((6, 6))
    common[2, 3] = common[3, 2] = 12
    assert pairs_to_add([(0, 1), (1, 2), (2, 4), (4, 5)], part, common) == [(2, 4)]
    assert pairs_to_add([(0, 1), (1, 2), (3, 4), (4, 5)], part, common) == [(1, 2), (3, 4)]
    assert pairs_to_add([(0, 1), (1, 2)], part, common - 1) == []  # fewer than orient a still may be mismatches
    assert pairs_to_add([(0, 1), (1, 2)], np.zeros(6, dtype=int), common) == []
