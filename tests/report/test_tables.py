"""Texts of numbers, and tables of more than one flight."""

from dataclasses import replace

import numpy as np
import pytest

from uavkit.core.result import OrientedBlock
from uavkit.formats.drawing import round_number, shortened
from uavkit.formats.html_page import Table, number
from uavkit.report.measures import METRIC
from uavkit.report.tables import (
    PaperComparison,
    check_table,
    comparison_table,
    control_table,
    gnss_shift_table,
    interior_table,
    length,
    precision_table,
    unoriented_table,
)


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


def test_latencies_stand_beside_the_shifts(result: OrientedBlock) -> None:
    adjustment = replace(result.adjustment, gnss_latency_s=np.array([-0.0834]), gnss_latency_sigma_s=np.array([0.0042]))
    table = gnss_shift_table(replace(result, adjustment=adjustment))
    assert (table.header[-1], table.rows[0][-1]) == ("Shutter latency [ms]", "+83.4 ± 4.2")
    assert "--shutter-latency" in table.note
    assert "Shutter latency [ms]" not in gnss_shift_table(result).header


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


def test_lengths_take_a_sensible_unit() -> None:
    texts = [length(value, METRIC) for value in (0.0061, 0.2701, 3.6088, 100.01, float("nan"))]
    assert texts == ["6.1 mm", "270 mm", "3.61 m", "100.01 m", "–"]


def test_precision_of_many_metres_is_in_metres(result: OrientedBlock) -> None:
    covariances = np.tile(np.diag([9.0, 16.0, 1e4]), (300, 1, 1))
    poor = replace(result, adjustment=replace(result.adjustment, point_covariances_m2=covariances))
    rows = {row[0]: row[3] for row in precision_table(poor).rows}
    assert rows["Object points XY [m]"] == "5.000"
    assert rows["Object points Z [m]"] == "100.000"
    assert rows["Projection centres Z [mm]"] == "8.0"


def test_small_sigmas_keep_their_digits(result: OrientedBlock) -> None:
    covariance = result.adjustment.interior_covariance.copy()
    covariance[6, 6] = 3.2e-8**2
    fine = replace(result, adjustment=replace(result.adjustment, interior_covariance=covariance))
    rows = {row[0]: row for row in interior_table(fine).rows}
    assert rows["p1"][4] == "0.000000032"


def test_a_lost_check_point_is_listed(result: OrientedBlock) -> None:
    table = check_table(replace(result, check=result.check[:-1]))
    assert table.rows[-1] == ("C11", *("–",) * 9, "0")
    assert "in no RMSE: C11." in table.note


def test_a_reduced_survey_says_so(result: OrientedBlock) -> None:
    full = comparison_table(result, PaperComparison(flight="constant"))
    assert "Reduced" not in full.note
    small = comparison_table(result, PaperComparison(flight="trace", scale=0.25, stills=9))
    assert small.note.startswith("Reduced: 9 of 33 stills, pictures at 0.25 of their size, ")
