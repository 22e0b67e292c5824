"""Which stills hold one another: chains, their ends, and parts that only pairs of rays join."""

import numpy as np

from uavkit.process.holding import loose_stills


def _rays(*groups: tuple[tuple[int, ...], int]) -> tuple[np.ndarray, np.ndarray]:
    """Return image and point of rays: each group is the stills that see it, and how many points."""
    image, point, total = [], [], 0
    for stills, points in groups:
        for still in stills:
            image.append(np.full(points, still))
            point.append(total + np.arange(points))
        total += points
    return np.concatenate(image), np.concatenate(point)


def test_a_chain_whose_points_are_seen_three_times_holds() -> None:
    image, point = _rays(((0, 1, 2), 50), ((1, 2, 3), 50), ((2, 3, 4), 50))
    assert len(loose_stills(image, point, 5)) == 0


def test_stills_that_only_pairs_of_rays_join_are_loose() -> None:
    """Between 2 and 3 there are points of two rays alone: the scale of 3, 4, 5 is open, and they are fewer."""
    image, point = _rays(((0, 1, 2), 50), ((1, 2), 50), ((0, 1), 50), ((2, 3), 90), ((3, 4), 50), ((4, 5), 50))
    assert loose_stills(image, point, 6).tolist() == [3, 4, 5]


def test_the_larger_part_stays_whichever_has_the_richest_pair() -> None:
    image, point = _rays(((0, 1), 500), ((2, 3, 4), 40), ((3, 4, 5), 40))
    assert loose_stills(image, point, 6).tolist() == [0, 1]


def test_a_still_by_itself_and_a_thinly_held_one_are_loose() -> None:
    image, point = _rays(((0, 1, 2), 50), ((0, 1, 4), 9))
    assert loose_stills(image, point, 5).tolist() == [3]  # 4 has enough, while 3 has nothing
    image, point = _rays(((0, 1, 2), 50), ((0, 1, 3), 9))
    assert loose_stills(image, point, 4).tolist() == [3]  # by the next demand


def test_no_rays_hold_nothing() -> None:
    none = np.zeros(0, dtype=np.int64)
    assert loose_stills(none, none, 3).tolist() == [0, 1, 2]
