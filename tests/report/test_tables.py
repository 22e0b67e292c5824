"""Texts of numbers, and tables of more than one flight."""

from dataclasses import replace

import numpy as np
import pytest

from uavkit.core.result import OrientedBlock
from uavkit.report.drawing import round_number, shortened
from uavkit.report.tables import Table, control_table, gnss_shift_table, interior_table, number, unoriented_table


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [
        (1.25, 1, "1.2"),
        (-0.04, 1, "0.0"),
        (-0.06, 1, "-0.1"),
        (float("nan"), 1, "–"),
        (float("inf"), 2, "–"),
        (7, 0, "7"),
    ],
)
def test_numbers_as_texts(value: float, decimals: int, text: str) -> None:
    assert number(value, decimals) == text


@pytest.mark.parametrize(("value", "rounded"), [(0.0137, 0.01), (0.5, 0.5), (7.0, 5.0), (20.0, 20.0), (49.9, 20.0)])
def test_round_numbers(value: float, rounded: float) -> None:
    assert round_number(value) == pytest.approx(rounded)


def test_shortened_names_keep_their_end() -> None:
    assert shortened("DJI_20260512_0815_0001.JPG", 10) == "…_0001.JPG"
    assert shortened("S01.JPG", 10) == "S01.JPG"


def test_a_table_has_cells_for_each_heading() -> None:
    with pytest.raises(ValueError, match="has not 2 cells"):
        Table(title="x", header=("a", "b"), rows=(("1",),))


def test_each_flight_has_its_shift_and_residuals(result: OrientedBlock) -> None:
    gnss = result.block.gnss
    assert gnss is not None
    flight = (np.arange(8) >= 5).astype(np.int64)
    residual = np.where(flight[:, None] == 0, 3.0, [0.3, 0.4, 0.5])
    adjustment = replace(
        result.adjustment,
        gnss_shift_m=np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, -6.0]]),
        gnss_shift_covariance_m2=np.tile(np.diag([0.01, 0.04, 0.09]), (2, 1, 1)),
        gnss_residuals_m=residual,
    )
    block = replace(result.block, gnss=replace(gnss, flight=flight))
    rows = gnss_shift_table(replace(result, block=block, adjustment=adjustment)).rows
    # Of the first flight one of five is rejected.
    assert rows[0] == ("1", "4 of 5", "+1.000 ± 0.100", "+2.000 ± 0.200", "+3.000 ± 0.300", "3.000", "3.000", "3.000")
    assert rows[1] == ("2", "3 of 3", "-4.000 ± 0.100", "+5.000 ± 0.200", "-6.000 ± 0.300", "0.300", "0.400", "0.500")


def test_rejected_control_points_are_marked(result: OrientedBlock) -> None:
    adjustment = replace(result.adjustment, control_used=np.array([True, False, True]))
    states = [row[-1] for row in control_table(replace(result, adjustment=adjustment)).rows]
    assert states == ["used", "rejected", "used"]


def test_prior_sigmas_belong_to_the_size_of_the_stills(result: OrientedBlock) -> None:
    half = replace(result.block, interior=result.block.interior.scaled(2000, 1500))
    adjustment = replace(result.adjustment, interior=result.adjustment.interior.scaled(2000, 1500))
    table = interior_table(replace(result, block=half, adjustment=adjustment))
    rows = {row[0]: row for row in table.rows}
    assert rows["principal distance c [px]"][3] == "15.000"  # of 30 px at full size
    assert rows["k1"][3] == "0.050000"
    assert "5.1134 mm at 3.800 µm" in table.note


def test_long_lists_are_folded(result: OrientedBlock) -> None:
    lost = {f"S{row}": "too dark" for row in range(60)}
    assert unoriented_table(replace(result, unoriented=lost)).folded
    assert not unoriented_table(result).folded
