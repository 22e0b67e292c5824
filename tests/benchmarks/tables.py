# ruff: noqa: T201 (its purpose is to print)
"""All rows of the benchmarks as one Markdown file, with the bars they are held to.

``python -m tests.benchmarks.tables`` writes ``results/table.md`` and prints the bars; ``make bench`` ends with it.
A bar is judged once all its rows are there; until then it says how many are.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.blocks import cases
from tests.benchmarks.rows import RESULTS, Row, kept_rows

TABLE = RESULTS / "table.md"
CIRCUMSTANCES = ("commit", "day", "load")
NOT_SHOWN = ("benchmark", "case", "cores", "python", *CIRCUMSTANCES)

Rows = Sequence[Row]


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """What the rows of some benchmarks are to reach; without limits it is only told."""

    rows: Mapping[str, int]
    """How many rows of each benchmark are needed for a judgement."""
    what: str
    measure: Callable[..., float]
    """Takes the rows of each benchmark, in the order of ``rows``."""
    least: float = -np.inf
    most: float = np.inf

    @property
    def text(self) -> str:
        """Return the bar in words."""
        ends = ((">=", self.least), ("<=", self.most))
        return ", ".join(f"{sign} {end:g}" for sign, end in ends if np.isfinite(end))


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """A bar and what was measured for it, so far; NaN where nothing was."""

    bar: Bar
    measured: float
    verdict: str


def values(rows: Rows, name: str) -> np.ndarray:
    """Return one value of each row, as floats (n,); NaN where a row has none."""
    return np.array([float(row.get(name, np.nan)) for row in rows])


def mean_of(name: str) -> Callable[[Rows], float]:
    """Return the function that takes the mean of a value over rows."""
    return lambda rows: float(values(rows, name).mean())


def largest(name: str) -> Callable[[Rows], float]:
    """Return the function that takes the largest of a value over rows."""
    return lambda rows: float(values(rows, name).max())


def smallest(name: str) -> Callable[[Rows], float]:
    """Return the function that takes the smallest of a value over rows."""
    return lambda rows: float(values(rows, name).min())


def median_of(name: str) -> Callable[[Rows], float]:
    """Return the function that takes the median of a value over rows."""
    return lambda rows: float(np.median(values(rows, name)))


def largest_share(name: str, of: str) -> Callable[[Rows], float]:
    """Return the function that takes the largest quotient of two values over rows."""
    return lambda rows: float((values(rows, name) / values(rows, of)).max())


def smallest_share(name: str, of: str) -> Callable[[Rows], float]:
    """Return the function that takes the smallest quotient of two values over rows."""
    return lambda rows: float((values(rows, name) / values(rows, of)).min())


def growth(rows: Rows) -> float:
    """Return the exponent with which processor time grows with the number of images, the name of the case; to 3000."""
    images = np.array([float(row["case"]) for row in rows])
    use = images <= 3000
    return float(np.polyfit(np.log(images[use]), np.log(values(rows, "cpu_s")[use]), 1)[0]) if use.sum() > 1 else np.nan


def spread_of(name: str) -> Callable[[Rows], float]:
    """Return the function that divides the largest of a value over rows by the smallest."""
    return lambda rows: float(values(rows, name).max() / values(rows, name).min())


def of_case(case: str, name: str) -> Callable[[Rows], float]:
    """Return the function that takes a value of the row of one case; NaN where that is not there."""
    return lambda rows: next((float(row[name]) for row in rows if row["case"] == case), float("nan"))


def pooled_prediction(*groups: Rows) -> float:
    """Return the root mean square error of all check coordinates over its prediction, all blocks together.

    Each block's squares are weighed by its number of check points, so that it is as if they lay in one table.
    """
    rows = [row for group in groups for row in group]
    points = values(rows, "check_points")
    square, predicted = (
        sum(points * values(rows, f"{name}_{axes}_mm") ** 2 for axes in ("xy", "z"))
        for name in ("rmse", "rmse_predicted")
    )
    return float(np.sqrt(np.sum(square) / np.sum(predicted)))


def beyond_chi_square(*groups: Rows) -> float:
    """Return how many blocks have a chi-square above its bound."""
    rows = [row for group in groups for row in group]
    return float(np.sum(values(rows, "chi_square") > values(rows, "chi_square_bound")))


def ratio_of_means(name: str) -> Callable[[Rows, Rows], float]:
    """Return the function that divides the mean of a value over one benchmark by that over another, on equal cases."""

    def ratio(ours: Rows, peer: Rows) -> float:
        theirs = {row["case"]: row for row in peer}
        both = [row for row in ours if row["case"] in theirs]
        if not both:
            return float("nan")
        return float(values(both, name).mean() / values([theirs[row["case"]] for row in both], name).mean())

    return ratio


def ratio_in_rows(name: str) -> Callable[[Rows], float]:
    """Return the function that divides the mean of our value by that of COLMAP's in the same rows."""
    return lambda rows: float(values(rows, f"ours_{name}").mean() / values(rows, f"colmap_{name}").mean())


FULL, PEER, SPEED = "accuracy full size", "COLMAP full size", "process speed"
TEXTURES = "textures half scale"
TIES = "fewest_ties_of_neighbouring_strips"
CALIBRATED = "true_over_calibrated"
SIX = {FULL: 6}
BOTH = {FULL: 6, PEER: 6}
EVERY = {name: len(cases(name)) for name in (FULL, "accuracy half scale", "terrains half scale", "accuracy RTK")}
"""Benchmarks of blocks whose predicted precision is judged."""
BARS: tuple[Bar, ...] = (
    Bar(rows=SIX, what="mean RMSE XY, mm", measure=mean_of("rmse_xy_mm"), most=8.0),
    Bar(rows=SIX, what="mean RMSE Z, mm", measure=mean_of("rmse_z_mm"), most=8.0),
    Bar(rows=SIX, what="stills oriented, least share", measure=smallest_share("stills_oriented", "stills"), least=1.0),
    Bar(rows=SIX, what="fewest points", measure=smallest("points"), least=5000),
    Bar(rows=SIX, what="ground cells with a point, least share", measure=smallest("cells_with_a_point"), least=0.95),
    Bar(rows=SIX, what="rays found, least share", measure=smallest("rays_found"), least=0.85),
    Bar(rows=SIX, what="fewest ties of neighbouring strips", measure=smallest(TIES), least=1),
    Bar(rows=BOTH, what="mean RMSE XY over COLMAP's", measure=ratio_of_means("rmse_xy_mm"), most=0.8),
    Bar(rows=BOTH, what="mean RMSE Z over COLMAP's", measure=ratio_of_means("rmse_z_mm"), most=0.8),
    Bar(rows={"shape": 6}, what="mean XY error over COLMAP's", measure=ratio_in_rows("shape_xy_mm"), most=0.8),
    Bar(rows={"shape": 6}, what="mean Z error over COLMAP's", measure=ratio_in_rows("shape_z_mm"), most=0.8),
    Bar(rows=SIX, what="mean RMSE XY of an exact block, mm", measure=mean_of("rmse_of_exact_block_xy_mm")),
    Bar(rows=SIX, what="mean RMSE Z of an exact block, mm", measure=mean_of("rmse_of_exact_block_z_mm")),
    Bar(rows=EVERY, what="RMSE over predicted, all blocks", measure=pooled_prediction, least=0.8, most=1.25),
    Bar(rows=EVERY, what="blocks beyond chi-square's 99.9 %", measure=beyond_chi_square, most=0),
    Bar(rows={"accuracy RTK": 3}, what="mean RMSE XY, mm", measure=mean_of("rmse_xy_mm"), most=12.0),
    Bar(rows={"accuracy RTK": 3}, what="mean RMSE Z, mm", measure=mean_of("rmse_z_mm"), most=10.0),
    Bar(
        rows={TEXTURES: len(cases(TEXTURES))},
        what="stills oriented through the video, least share",
        measure=smallest_share("stills_oriented", "stills"),
        least=1.0,
    ),
    Bar(rows={SPEED: 3}, what="time over COLMAP's, median", measure=median_of("ratio"), most=0.4),
    Bar(
        rows={SPEED: 3},
        what="peak memory over COLMAP's, largest",
        measure=largest_share("ours_peak_mb", "colmap_peak_mb"),
        most=1.0,
    ),
    Bar(rows={"bundle speed": 4}, what="time over Ceres', largest", measure=largest("ratio"), most=0.5),
    Bar(
        rows={"bundle speed": 4},
        what="peak memory over Ceres', largest",
        measure=largest_share("ours_peak_mb", "ceres_peak_mb"),
        most=1.0,
    ),
    Bar(rows={"bundle scaling": 5}, what="processor time grows with n to the power", measure=growth, most=1.3),
    Bar(rows={"tracking speed": 4}, what="time over Lucas-Kanade's, median", measure=median_of("ratio")),
    Bar(rows={"matching speed": 2}, what="times as fast as ECC, least", measure=smallest("ratio")),
    Bar(rows={"rays": 4}, what="true over calibrated sigma, least", measure=smallest(CALIBRATED), least=0.75),
    Bar(rows={"rays": 4}, what="true over calibrated sigma, largest", measure=largest(CALIBRATED), most=1.25),
    Bar(rows={"memory": 2}, what="largest peak memory, MB", measure=largest("peak_mb"), most=3072),
    Bar(rows={"memory": 2}, what="largest over smallest peak memory", measure=spread_of("peak_mb"), most=1.1),
    Bar(
        rows={"honesty": 1},
        what="mean chi-square of a check point",
        measure=of_case("0 % wrong rays", "mean_chi_square_of_a_point"),
        least=2.6,
        most=3.4,
    ),
    Bar(
        rows={"honesty": 1},
        what="sigma0^2 off 1, in its standard error",
        measure=of_case("0 % wrong rays", "sigma0_squared_deviation_sigmas"),
        least=-3.5,
        most=3.5,
    ),
)


def judge(bar: Bar, rows: Mapping[str, Rows]) -> Judgement:
    """Compare a bar with the rows of each benchmark."""
    groups = [rows.get(name, ()) for name in bar.rows]
    there, needed = [min(len(g), n) for g, n in zip(groups, bar.rows.values(), strict=True)], sum(bar.rows.values())
    measured = bar.measure(*groups) if any(there) else float("nan")
    if sum(there) < needed or np.isnan(measured):
        return Judgement(bar=bar, measured=measured, verdict=f"{sum(there)} of {needed} rows")
    if not bar.text:
        return Judgement(bar=bar, measured=measured, verdict="")
    return Judgement(bar=bar, measured=measured, verdict="met" if bar.least <= measured <= bar.most else "missed")


def by_benchmark(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Return rows grouped by benchmark, in the order in which these first appear; the cases sorted."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["benchmark"], []).append(row)
    return {name: sorted(group, key=lambda row: str(row["case"])) for name, group in groups.items()}


def table_of_bars(judgements: Iterable[Judgement]) -> list[str]:
    """Return the lines of the table of bars."""
    cells = [
        (next(iter(judged.bar.rows)), judged.bar.what, as_text(judged.measured), judged.bar.text, judged.verdict)
        for judged in judgements
    ]
    return markdown_table(("benchmark", "what", "measured", "bar", ""), cells)


def table_of_rows(rows: Rows) -> list[str]:
    """Return the lines of the table of one benchmark: a column for each plain value that any of its rows has."""
    names = dict.fromkeys(name for row in rows for name, value in row.items() if _is_shown(name, value))
    columns = ("case", *names, *CIRCUMSTANCES)
    return markdown_table(columns, [[as_text(row.get(name)) for name in columns] for row in rows])


def _is_shown(name: str, value: Any) -> bool:
    return name not in NOT_SHOWN and isinstance(value, int | float | str)


def markdown_table(headings: Sequence[str], cells: Iterable[Sequence[str]]) -> list[str]:
    """Return a table in Markdown, line by line."""
    lines = [headings, ["---"] * len(headings), *cells]
    return ["| " + " | ".join(line) + " |" for line in lines]


def as_text(value: Any) -> str:
    """Return a value as a cell: whole numbers whole, others to three figures that count."""
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "-"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    return f"{value:.0f}" if isinstance(value, int) or abs(value) >= 100 else f"{value:#.3g}"


def page(rows: Iterable[Row], bars: Sequence[Bar] = BARS) -> str:
    """Return the whole file."""
    groups = by_benchmark(rows)
    lines = ["# Benchmarks", "", "Written by `python -m tests.benchmarks.tables` from `rows.jsonl`.", ""]
    lines += ["## Bars", "", *table_of_bars(judge(bar, groups) for bar in bars), ""]
    for name, group in groups.items():
        lines += [f"## {name}", "", *table_of_rows(group), ""]
    return "\n".join(lines)


def write_table(path: Path = TABLE) -> None:
    """Write the file of all kept rows and print the bars."""
    rows = list(kept_rows().values())
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page(rows), encoding="utf-8")
    print("\n".join(table_of_bars(judge(bar, by_benchmark(rows)) for bar in BARS)))


if __name__ == "__main__":
    write_table()
