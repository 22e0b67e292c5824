"""The evaluation of simulated flights and the tables of rows, on tiny made data; runs with the ordinary tests."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.benchmarks import rows as kept
from tests.benchmarks.blocks import cases, rendered
from tests.benchmarks.evaluation import (
    MarkedPlaces,
    check_point_errors,
    chi_square_bound,
    errors_to_truth,
    fewest_ties,
    holds_a_point,
    stills_that_show,
)
from tests.benchmarks.tables import (
    BARS,
    Bar,
    as_text,
    beyond_chi_square,
    by_benchmark,
    judge,
    mean_of,
    page,
    pooled_prediction,
    ratio_of_means,
)
from uavkit.core.angles import rotation_from_omega_phi_kappa
from uavkit.process.absolute import fit_similarity
from uavkit.simulate.camera import SimulatedView, true_camera
from uavkit.simulate.world import enu_from_site


def row(case: str, **values: Any) -> dict[str, Any]:
    return {"benchmark": "made", "case": case, "commit": "abc", "day": "2026-01-01", "load": 0.1, **values}


def block(case: str, error_mm: float, predicted_mm: float, points: int = 4) -> dict[str, Any]:
    errors = {f"rmse_{axes}_mm": error_mm for axes in ("xy", "z")}
    predicted = {f"rmse_predicted_{axes}_mm": predicted_mm for axes in ("xy", "z")}
    return row(case, **errors, **predicted, check_points=points)


def test_pooled_errors_are_those_of_all_points_in_one_table() -> None:
    """By hand: 4 points of 3 mm and 1 of 7 mm, all predicted 3 mm: sqrt((4 * 9 + 49) / (5 * 9))."""
    blocks = [block("a", 3.0, 3.0, 4), block("b", 7.0, 3.0, 1)]
    assert pooled_prediction(blocks) == pytest.approx(np.sqrt(85 / 45))
    assert pooled_prediction(blocks[:1], blocks[1:]) == pytest.approx(np.sqrt(85 / 45))


def test_ratio_of_means_takes_the_cases_that_both_have() -> None:
    ours = [row("a", error=2.0), row("b", error=4.0), row("c", error=1000.0)]
    peer = [row("b", error=8.0), row("a", error=4.0), row("d", error=1000.0)]
    assert ratio_of_means("error")(ours, peer) == pytest.approx(0.5)
    assert np.isnan(ratio_of_means("error")(ours, []))


def test_blocks_beyond_chi_square_are_counted() -> None:
    bound = chi_square_bound(33)
    # Wilson and Hilferty (1931): chi-square is near f (1 - 2 / 9 f + z sqrt(2 / 9 f))^3, z = 3.090 for 99.9 %.
    assert bound == pytest.approx(33 * (1 - 2 / 297 + 3.0902 * np.sqrt(2 / 297)) ** 3, rel=0.005)
    blocks = [row(str(n), chi_square=c, chi_square_bound=bound) for n, c in enumerate((33.0, bound + 1, bound - 1))]
    assert beyond_chi_square(blocks[:2], blocks[2:]) == 1


@pytest.mark.parametrize("errors, verdict", [((7.0, 8.5), "met"), ((7.0, 9.5), "missed"), ((7.0,), "1 of 2 rows")])
def test_bar_is_judged_when_all_its_rows_are_there(errors: tuple[float, ...], verdict: str) -> None:
    bar = Bar(rows={"made": 2}, what="mean error", measure=mean_of("error_mm"), most=8.0)
    rows = by_benchmark([row(str(n), error_mm=error) for n, error in enumerate(errors)])
    judged = judge(bar, rows)
    assert judged.verdict == verdict
    assert judged.measured == pytest.approx(np.mean(errors))
    assert judge(bar, {}).verdict == "0 of 2 rows"


def test_page_shows_all_rows_and_bars() -> None:
    text = page([row("b", error_mm=3.14159, steps={"x": 1}), row("a", error_mm=2.0, notes="as flown")])
    assert "| a | 2.00 | as flown | abc |" in text
    assert "| b | 3.14 | - | abc |" in text
    assert "steps" not in text
    assert all(bar.what in text for bar in BARS)


def test_numbers_have_three_figures() -> None:
    told = [as_text(value) for value in (0.012345, 12.3456, 1234.5, 7, None, float("nan"), "x")]
    assert told == ["0.0123", "12.3", "1234", "7", "-", "-", "x"]


def test_rows_are_kept_until_forgotten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, measurements = tmp_path / "rows.jsonl", iter(range(10))

    def measure() -> dict[str, int]:
        return {"value": next(measurements)}

    monkeypatch.delenv("UAVKIT_BENCH_FRESH", raising=False)
    assert [kept.measured("a", "x", measure, path)["value"] for _ in range(2)] == [0, 0]
    assert kept.measured("b", "x", measure, path)["value"] == 1
    monkeypatch.setenv("UAVKIT_BENCH_FRESH", "c, a")
    assert kept.measured("a", "x", measure, path)["value"] == 2
    assert kept.measured("b", "x", measure, path)["value"] == 1
    assert kept.kept_rows(path)["a", "x"]["value"] == 2
    assert kept.forget(["a"], path) == 2
    assert [json.loads(line)["benchmark"] for line in path.read_text().splitlines()] == ["b"]


TABLES = """
[x]
vary = { flight = ["a", "b"], seed = [1, 2] }
simulate = { scale = 0.5 }
[x.named]
y = { seed = 7 }
"""


def test_cases_are_all_combinations_and_the_named_ones(tmp_path: Path) -> None:
    path = tmp_path / "cases.toml"
    path.write_text(TABLES)
    found = cases("x", path)
    assert [case.name for case in found] == ["y", "a, seed 1", "a, seed 2", "b, seed 1", "b, seed 2"]
    assert [case.flight.name for case in found[:3:2]] == ["scale=0.5,seed=7", "flight=a,scale=0.5,seed=2"]


def test_errors_of_check_points_by_hand() -> None:
    """Two points of sigma 1 mm: 3, 4, 0 mm and 0, 0, 2 mm off."""
    told = check_point_errors(np.array([[3e-3, 4e-3, 0.0], [0.0, 0.0, 2e-3]]), 1e-6 * np.eye(6))
    assert told["rmse_xy_mm"] == pytest.approx(np.sqrt(25 / 2))
    assert told["rmse_z_mm"] == pytest.approx(np.sqrt(2))
    assert told["rmse_predicted_xy_mm"] == pytest.approx(np.sqrt(2))
    assert told["rmse_predicted_z_mm"] == pytest.approx(1.0)
    assert (told["chi_square"], told["chi_square_freedom"]) == (pytest.approx(29.0), 6)


def test_exact_shape_on_noisy_control_shows_the_noise_of_control() -> None:
    rng = np.random.default_rng(2)
    true, control = rng.uniform(0, 40, (9, 3)), rng.uniform(0, 40, (3, 3))
    surveyed = control + rng.normal(0, 0.005, (3, 3))
    found = fit_similarity(control, surveyed).apply(true)
    places = MarkedPlaces(
        check_m=found, check_surveyed_m=true, check_true_m=true, control_surveyed_m=surveyed, control_true_m=control
    )
    told = errors_to_truth(places)
    assert told["rmse_shape_xy_mm"] == pytest.approx(0.0, abs=1e-6)
    assert told["rmse_true_xy_mm"] > 0.5
    assert told["rmse_of_exact_block_xy_mm"] == pytest.approx(told["rmse_true_xy_mm"])
    assert told["rmse_of_exact_block_z_mm"] == pytest.approx(told["rmse_true_z_mm"])


@pytest.mark.parametrize("stills, video, complete", [(2, True, True), (1, True, False), (2, False, False)])
def test_flight_is_rendered_when_all_its_files_are_there(
    tmp_path: Path, stills: int, video: bool, complete: bool
) -> None:
    assert not rendered(tmp_path)
    for folder in ("stills", "truth"):
        (tmp_path / folder).mkdir()
    (tmp_path / "truth" / "truth.json").write_text(json.dumps({"exposures": [{}, {}], "video": {}}))
    for number in range(stills):
        (tmp_path / "stills" / f"{number}.JPG").touch()
    if video:
        (tmp_path / "video.avi").touch()
    assert rendered(tmp_path) is complete


def test_ground_cells_hold_the_points_within_half_a_metre() -> None:
    """In the axes of the site, which lie askew to east and north."""
    cells = np.array([[0.5, 0.5, 7.0], [1.5, 0.5, 7.0], [-0.5, -3.5, 7.0]]) @ enu_from_site().T
    points = np.array([[1.01, 0.99, 0.0], [-0.99, -3.01, 9.0], [2.01, 0.5, 0.0]]) @ enu_from_site().T
    assert holds_a_point(cells, points).tolist() == [False, True, True]


def test_stills_that_show_a_point_are_counted() -> None:
    """Two cameras look down from 10 m, 5 m apart; at 10 m a picture is 14.9 m x 11.2 m. A third looks up."""
    camera, down = true_camera(1, 1.0), np.eye(3)
    up = rotation_from_omega_phi_kappa(np.pi, 0.0, 0.0)
    places = (([0.0, 0.0, 10.0], down), ([5.0, 0.0, 10.0], down), ([0.0, 0.0, 10.0], up))
    views = {
        str(n): SimulatedView(camera=camera, centre_m=np.array(centre), R_object_from_image=rotation)
        for n, (centre, rotation) in enumerate(places)
    }
    seen = [[2.5, 0.0, 0.0], [-6.5, 0.0, 0.0], [11.5, 0.0, 0.0]]
    # So far aside that the distortion's polynomial brings them back into the picture, one of them after all.
    aside = [[0.0, float(y), 0.0] for y in range(7, 60)]
    assert stills_that_show(np.array(seen + aside), views).tolist() == [2, 1, 1] + [0] * len(aside)
    folded = views["0"].project(np.array(aside))
    assert np.any(np.all((folded > 0.0) & (folded < [3999.0, 2999.0]), axis=1))


def test_fewest_ties_are_of_neighbours() -> None:
    assert fewest_ties(np.array([[9, 5, 0], [5, 9, 3], [0, 3, 9]])) == 3
    assert fewest_ties(np.array([[9]])) == 0
