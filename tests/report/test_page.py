"""The page says what the result holds, needs nothing beside it, and bears what may be missing."""

import base64
import io
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from uavkit.core.adjustment import Datum
from uavkit.core.errors import AdjustmentError, InputError
from uavkit.core.result import OrientedBlock, PointDifference
from uavkit.report.page import write_report
from uavkit.report.tables import PaperComparison

VOID = {"meta", "img", "br", "link", "hr", "input"}


class Page(HTMLParser):
    """Tables by title, texts and links of a page; fails on tags that do not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.titles: list[str] = []
        self.images: list[str] = []
        self.links: list[str] = []
        self.texts: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for key, value in attrs:
            if key in ("src", "href", "srcset", "data", "action") and value is not None:
                (self.images if value.startswith("data:image/png;base64,") else self.links).append(value)
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        elif tag in ("h3", "summary"):
            self.titles.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self.open:
            assert "url(" not in data
            assert "@import" not in data
            return
        self.texts.append(data)
        if {"td", "th"} & set(self.open):
            self.tables[-1][-1][-1] += data
        elif {"h3", "summary"} & set(self.open):
            self.titles[-1] += data

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())

    def table(self, *header: str) -> list[list[str]]:
        """Return the rows of the first table whose heading starts so."""
        for table in self.tables:
            if table[0][: len(header)] == list(header):
                return table[1:]
        raise AssertionError(f"no table {header}")


def read(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("report")


@pytest.fixture(scope="module")
def page(result: OrientedBlock, folder: Path) -> Page:
    return read(write_report(result, folder, survey="Bank <A> & B", comparison=PaperComparison(flight="trace")))


def test_tables_hold_the_check_points(page: Page, result: OrientedBlock) -> None:
    rows = page.table("Point", "dE [mm]", "dN [mm]", "dU [mm]", "sigma E [mm]")
    assert len(rows) == len(result.check)
    for row, point in zip(rows, result.check, strict=True):
        assert row[0] == point.name
        np.testing.assert_allclose([float(cell) / 1e3 for cell in row[1:4]], point.difference_m, atol=0.51e-4)
        np.testing.assert_allclose([float(cell) / 1e3 for cell in row[4:7]], point.sigma_m, atol=0.51e-4)
        ratio = np.array(point.difference_m) / point.sigma_m
        np.testing.assert_allclose([float(cell) for cell in row[7:10]], ratio, atol=0.051)
        assert row[10] == str(point.rays)


def test_headline_says_rmse_and_counts(page: Page, result: OrientedBlock) -> None:
    d = 1e3 * np.array([point.difference_m for point in result.check])
    xy, z = np.sqrt(np.mean(d[:, 0] ** 2 + d[:, 1] ** 2)), np.sqrt(np.mean(d[:, 2] ** 2))
    assert f"RMSE XY (both axes) {xy:.1f} mm {xy / 5.6:.2f} GSD, at 11 check points" in page.text
    assert f"RMSE Z {z:.1f} mm {z / 5.6:.2f} GSD, at 11 check points" in page.text
    assert "Stills oriented 8 of 9" in page.text
    assert "sigma0 = 1.01 agrees with the sigmas" in page.text


def test_headline_says_what_is_provisional(page: Page, result: OrientedBlock, tmp_path: Path) -> None:
    provisional = replace(result, adjustment=replace(result.adjustment, converged=False))
    words = "its results are provisional"
    told = read(write_report(provisional, tmp_path)).text
    assert told.index(words) < told.index("sigma0 = 1.01 agrees")
    assert words not in page.text


def test_interior_orientation_with_its_states(page: Page) -> None:
    rows = {row[0]: row[1:] for row in page.table("Parameter", "Adjusted")}
    assert rows["principal distance c [px]"] == ["2691.250", "2684.000", "30.000", "0.800", "determined"]
    assert rows["k3"][-1] == "undetermined"
    assert rows["p1"][-1] == "fixed"


def test_gnss_shift_and_rejected_position(page: Page) -> None:
    shift = page.table("Flight", "Fixes used")[0]
    assert shift[:5] == ["1", "7 of 8", "+1.250 ± 0.250", "-0.750 ± 0.250", "+3.500 ± 0.300"]
    rejected = page.table("Still", "Residual E [m]")
    assert rejected == [["S05.JPG", "+31.500", "-8.250", "+12.000", "residual of 21.0 times its stated sigma"]]


def test_exterior_orientation_of_each_still(page: Page, result: OrientedBlock) -> None:
    rows = page.table("Still", "Strip")
    assert [row[0] for row in rows] == list(result.images)
    centres = np.array([[float(cell) for cell in row[2:5]] for row in rows])
    np.testing.assert_allclose(centres, result.adjustment.projection_centres_m, atol=0.51e-3)
    assert rows[0][8:11] == ["10.0", "10.0", "8.0"]


def test_observations_candidates_and_time(page: Page, result: OrientedBlock) -> None:
    groups = {row[0]: row[1:] for row in page.table("Group", "Coordinates")}
    used = int(result.adjustment.ray_used.sum())
    assert groups["Image coordinates"][:2] == [str(2 * len(result.rays)), str(2 * used)]
    assert groups["GNSS positions"][:2] == ["24", "21"]
    assert page.table("Candidates", "Found")[0] == ["Followed through the video", "2000", "880", "44 %"]
    assert "came through the video: 81 %" in page.text
    assert page.table("Step", "Seconds") == [["tracking", "41.5"], ["adjustment", "3.2"], ["Total", "44.8"]]
    assert "Largest memory: 812 MB" in page.text


def test_comparison_states_the_published_flight(page: Page) -> None:
    rows = {row[0]: row[1:] for row in page.table("Flight: topography trace")}
    assert rows["Pass and tie points found"] == ["1489", "286"]
    assert rows["RMSE XY at check points [mm]"][0] == "20"
    assert rows["RMSE Z at check points [mm]"][0] == "24"


def test_reasons_and_notes_are_told(page: Page) -> None:
    assert page.table("Still", "Reason") == [["X99.JPG", "fewer than 8 points in common with any other still"]]
    assert "Two frames of the video were damaged." in page.text
    assert "The video has no sound of the shutter." in page.text
    assert "does not determine k3" in page.text


def test_names_are_escaped(page: Page, folder: Path) -> None:
    assert "Bank <A> & B" in page.text
    assert "<A>" not in (folder / "report.html").read_text(encoding="utf-8")


def test_page_needs_nothing_beside_it(page: Page) -> None:
    assert page.links == []
    assert "script" not in page.open
    assert len(page.images) == 14


def test_figures_have_contents_and_equal_the_files(page: Page, folder: Path) -> None:
    embedded = [base64.b64decode(image.partition(",")[2]) for image in page.images]
    files = {path.read_bytes() for path in (folder / "figures").glob("*.png")}
    assert set(embedded) == files
    assert len(files) == 14
    for data in embedded:
        picture = np.asarray(Image.open(io.BytesIO(data)).convert("L"), dtype=float)
        inner = picture[picture.shape[0] // 6 : -picture.shape[0] // 6, picture.shape[1] // 6 : -picture.shape[1] // 6]
        assert inner.std() > 5.0  # an empty pair of axes with a faint grid stays below 3


def test_the_same_result_gives_the_same_bytes(result: OrientedBlock, tmp_path: Path) -> None:
    plain = replace(result, pictures=None)
    first = write_report(plain, tmp_path / "one").read_bytes()
    assert write_report(plain, tmp_path / "two").read_bytes() == first


def test_date_is_printed_only_if_given(result: OrientedBlock, tmp_path: Path) -> None:
    assert "12 May 2026" in read(write_report(result, tmp_path, date="12 May 2026")).text


def bare(result: OrientedBlock) -> OrientedBlock:
    """Return a free network without anything that may be missing."""
    a = result.adjustment
    none = np.zeros((0, 3))
    adjustment = replace(
        a,
        gnss_used=np.zeros(0, dtype=bool),
        gnss_residuals_m=none,
        gnss_shift_m=none,
        gnss_shift_covariance_m2=np.zeros((0, 3, 3)),
        control_used=np.zeros(0, dtype=bool),
        control_residuals_m=none,
        group_sigma0={},
        datum=Datum.FREE_NETWORK,
        interior_covariance=np.zeros((10, 10)),
        undetermined_interior=(),
    )
    block = replace(result.block, frame=None, gnss=None, control_points=(), check_points=(), notes=())
    return replace(
        result,
        block=block,
        adjustment=adjustment,
        control=(),
        check=(),
        check_covariance_m2=np.zeros((0, 0)),
        candidates={},
        seconds={},
        notes=(),
        pictures=None,
        unoriented={},
        strips=np.full(len(result.images), -1),
    )


def test_free_network_without_anything(result: OrientedBlock, tmp_path: Path) -> None:
    page = read(write_report(bare(result), tmp_path))
    for said in (
        "no check points: predicted, not checked",
        "No ground control points.",
        "Free network: nothing fixes position, rotation and scale",
        "No GNSS position takes part",
        "The interior orientation is fixed",
        "a bow of the heights cannot be tested",
        "Local coordinates; the place on earth is not known.",
    ):
        assert said in page.text
    assert " mm" not in page.text.replace("Principal distance 5.1134 mm", "")
    assert "model units" in page.text


@pytest.mark.parametrize("count", [1, 2])
def test_few_check_points(result: OrientedBlock, tmp_path: Path, count: int) -> None:
    few = replace(
        result, check=result.check[:count], check_covariance_m2=result.check_covariance_m2[: 3 * count, : 3 * count]
    )
    page = read(write_report(few, tmp_path))
    assert f"Only {count} check point(s): the RMSE is a rough indication" in page.text
    assert "Too few check points to fit a bow" in page.text


def test_points_without_coordinates(result: OrientedBlock, tmp_path: Path) -> None:
    a = result.adjustment
    points, covariances = a.points_m.copy(), a.point_covariances_m2.copy()
    points[5:40], covariances[5:40] = np.nan, np.nan
    lost = PointDifference(name="lost", difference_m=(np.nan,) * 3, sigma_m=(np.nan,) * 3, rays=0, gsd_m=np.nan)
    damaged = replace(
        result,
        adjustment=replace(a, points_m=points, point_covariances_m2=covariances),
        check=(*result.check, lost),
        check_covariance_m2=np.full((36, 36), np.nan),
    )
    page = read(write_report(damaged, tmp_path))
    assert "35 object points lost too many rays" in page.text
    assert "1 check point(s) were not determined" in page.text
    assert page.table("Point", "dE [mm]")[-1] == ["lost", *["–"] * 9, "0"]
    assert "nan" not in page.text.lower().split()


def test_strange_and_long_names(result: OrientedBlock, tmp_path: Path) -> None:
    names = tuple(f'<b>$x_{row}$ & "堤防" {"long" * 20}.JPG' for row in range(len(result.images)))
    stills = tuple(replace(still, name=name) for still, name in zip(result.block.stills, (*names, "last"), strict=True))
    check = tuple(replace(point, name=f"$</td>{point.name}\\frac") for point in result.check)
    surveyed = tuple(
        replace(point, name=found.name) for point, found in zip(result.block.check_points, check, strict=True)
    )
    block = replace(result.block, stills=stills, check_points=surveyed)
    page = read(write_report(replace(result, images=names, block=block, check=check), tmp_path, survey="$<i>"))
    assert [row[0] for row in page.table("Still", "Strip")] == list(names)
    assert [row[0] for row in page.table("Point", "dE [mm]")] == [point.name for point in check]


def test_an_earlier_figure_does_not_stay(result: OrientedBlock, tmp_path: Path) -> None:
    write_report(result, tmp_path)
    assert (tmp_path / "figures" / "matches.png").exists()
    write_report(bare(result), tmp_path)
    assert not (tmp_path / "figures" / "matches.png").exists()
    assert not list(tmp_path.rglob(".*"))


def test_nothing_oriented_is_no_result(result: OrientedBlock, tmp_path: Path) -> None:
    with pytest.raises(AdjustmentError, match="nothing to report"):
        write_report(replace(result, images=()), tmp_path)
    assert not list(tmp_path.iterdir())


def test_points_without_covariances_and_unknown_names(result: OrientedBlock, tmp_path: Path) -> None:
    adjustment = replace(
        result.adjustment,
        point_covariances_m2=np.zeros((0, 3, 3)),
        gnss_used=result.adjustment.gnss_used[:5],
        gnss_residuals_m=result.adjustment.gnss_residuals_m[:5],
    )
    check = tuple(replace(point, name=f"other {point.name}", sigma_m=(0.0, 0.0, 0.0)) for point in result.check)
    poor = replace(result, adjustment=adjustment, check=check, check_covariance_m2=np.zeros((33, 33)))
    page = read(write_report(poor, tmp_path))
    assert page.table("Sigma of", "Number")[0] == ["Object points XY [mm]", "0", "–", "–", "–", "–"]
    assert page.table("Still", "Residual E [m]")[0][0] == "fix 5"
    assert page.table("Point", "dE [mm]")[0][7:10] == ["–", "–", "–"]


def test_progress_goes_from_nothing_to_all(result: OrientedBlock, tmp_path: Path) -> None:
    seen: list[tuple[str, int, int]] = []
    write_report(bare(result), tmp_path, progress=lambda stage, done, total: seen.append((stage, done, total)))
    assert seen == [("figures", done, seen[0][2]) for done in range(seen[0][2] + 1)]


def test_page_that_cannot_be_written(result: OrientedBlock, tmp_path: Path) -> None:
    (tmp_path / "report.html").mkdir()
    with pytest.raises(InputError, match=r"report\.html: cannot be written"):
        write_report(bare(result), tmp_path)


def test_five_hundred_stills(make_result: Callable[..., OrientedBlock], tmp_path: Path) -> None:
    large = make_result(strips=20, images_per_strip=25, points=1500)
    page = read(write_report(large, tmp_path))
    assert "Exterior orientation of each still (500 rows)" in page.titles
    assert len(page.table("Still", "Strip")) == 500
    assert (tmp_path / "report.html").stat().st_size < 8_000_000


def test_a_facade_has_no_map_of_overlap(result: OrientedBlock, tmp_path: Path) -> None:
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # looks north
    facade = replace(
        bare(result), adjustment=replace(bare(result).adjustment, R_object_from_image=np.tile(level, (8, 1, 1)))
    )
    page = read(write_report(facade, tmp_path))
    assert "too much sideways for a map of overlap" in page.text
    assert "outlines of the stills" not in page.text
