"""The page of a plan is whole, well formed and needs nothing beside it; its figures as text and as JSON."""

import base64
import io
import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.plan.made_planned import made_ground, made_planned, made_request
from tests.plan.made_plans import made_plan
from uavkit.core.errors import InputError
from uavkit.core.flightplan import FlightPlan
from uavkit.formats.plan_request import FlightRequest
from uavkit.plan.page import write_plan_page, write_plan_picture
from uavkit.plan.planner import Planned
from uavkit.plan.tables import (
    area_text,
    duration_text,
    key_table,
    percent,
    sorties_table,
    strips_table,
    summary_lines,
    write_summary_json,
)

VOID = {"meta", "img", "br", "link", "hr", "input"}
NASTY = 'Field <b>north</b> & "co" $x^2$'


class Page(HTMLParser):
    """Texts, pictures and links of a page; fails on tags that do not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images: list[str] = []
        self.links: list[str] = []
        self.texts: list[str] = []
        self.tags: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for key, value in attrs:
            if key in ("src", "href", "srcset", "data", "action") and value is not None:
                (self.images if value.startswith("data:image/png;base64,") else self.links).append(value)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self.open:
            assert "url(" not in data
            assert "@import" not in data
            return
        self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())


def named(plan: FlightPlan, name: str = NASTY) -> FlightPlan:
    areas = tuple(replace(area, name=name) for area in plan.areas)
    strips = tuple(replace(strip, area=name) for strip in plan.strips)
    return replace(plan, name=name, areas=areas, strips=strips, notes=(f"mind the {name}", "second note"))


def page_of(tmp_path: Path, planned: Planned, items: tuple[int, ...] = ()) -> Page:
    path = tmp_path / "plan.html"
    write_plan_page(path, planned, made_request(), None, items)
    return Page(path.read_text(encoding="utf-8"))


def test_page_is_whole_and_alone(tmp_path: Path) -> None:
    page = page_of(tmp_path, made_planned(named(made_plan())), (41,))
    assert page.links == []
    assert "script" not in page.tags
    assert "b" in page.tags  # the key figures; the name's own tags are text
    assert page.text.count(NASTY) >= 3 + 3  # headline, note, area, strips
    assert "Mind the Field" in page.text
    assert "Second note." in page.text
    for figure in ("80.0 / 80.0", "60.0 / 60.0", "9.0 / 10.0 / 11.0", "3600 m²", "90.0 %", "500 m", "41"):
        assert figure in page.text
    assert "Missed Area seen by 4 images or more: 90.0 %, asked for: 100 %." in page.text
    assert "level with the take-off point" in page.text
    assert len(page.images) == 4
    for data in page.images:
        picture = Image.open(io.BytesIO(base64.b64decode(data.split(",", 1)[1])))
        picture.verify()
        assert picture.format == "PNG"
        assert picture.width == 1184  # 7.4 inches of 160 pixels


def test_page_is_the_same_twice(tmp_path: Path) -> None:
    first, second = tmp_path / "a.html", tmp_path / "b.html"
    for path in (first, second):
        write_plan_page(path, made_planned(), made_request())
    assert first.read_bytes() == second.read_bytes()


def test_page_says_where_ground_and_altitudes_come_from(tmp_path: Path) -> None:
    planned = made_planned()
    request = made_request().model_copy(update={"flight": FlightRequest(altitude_from="geoid")})
    write_plan_page(tmp_path / "plan.html", planned, request, made_ground(planned.plan, 0.05, 0.0, sigma_m=0.7))
    text = Page((tmp_path / "plan.html").read_text(encoding="utf-8")).text
    assert "a made plane" in text
    assert "0.7 m (1 sigma)" in text
    assert "less 1.4 m" in text
    assert "sea level (EGM96)" in text
    assert "count from the take-off point" not in text


def test_long_tables_are_folded(tmp_path: Path) -> None:
    assert "details" not in page_of(tmp_path, made_planned(made_plan(strips=30, exposures=3))).tags
    assert "details" in page_of(tmp_path, made_planned(made_plan(strips=31, exposures=3))).tags


def test_page_of_a_thousand_images_is_small(tmp_path: Path) -> None:
    plan = made_plan(strips=20, exposures=50)
    path = tmp_path / "plan.html"
    write_plan_page(path, made_planned(plan), made_request(), made_ground(plan, 0.05, 0.02))
    assert path.stat().st_size < 5e6


def test_picture_is_written(tmp_path: Path) -> None:
    path = tmp_path / "plan.png"
    write_plan_picture(path, made_planned(named(made_plan())), made_request())
    with Image.open(path) as picture:
        assert picture.size == (1870, 1323)
    first = path.read_bytes()
    write_plan_picture(path, made_planned(named(made_plan())), made_request())
    assert path.read_bytes() == first


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_plan_page(tmp_path / "file" / "plan.html", made_planned(), made_request())


def test_summary_lines_are_aligned_and_end_with_the_notes() -> None:
    planned = made_planned(named(made_plan()))
    lines = summary_lines(planned, made_request())
    assert lines[0] == NASTY
    asked = [line.index("(asked") for line in lines if "(asked" in line]
    assert len(asked) >= 5
    assert len(set(asked)) == 1
    assert lines[-2:] == [f"  note: mind the {NASTY}", "  note: second note"]
    assert not any("nan" in line for line in lines)


def test_figures_that_do_not_exist_are_left_out_or_dashes() -> None:
    planned = made_planned()
    names = [row[0] for row in key_table(planned, made_request()).rows]
    assert not any("blur" in name or "video" in name for name in names)
    summary = replace(planned.plan.summary, side_overlap=(float("nan"), float("nan")), motion_blur_px=0.4)
    rows = key_table(replace(planned, plan=replace(planned.plan, summary=summary)), made_request()).rows
    assert ("Side overlap, least / mean [%]", "– / –", "", "") in rows
    assert ("Motion blur [px]", "0.40", "1 or less", "yes") in rows


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"forward_overlap": (0.789, 0.82)}, "Forward"),
        ({"side_overlap": (0.589, 0.62)}, "Side"),
        ({"least_clearance_m": 4.9}, "Least clearance"),
        ({"least_images": 3}, "Fewest"),
        ({"covered": 0.999}, "Area seen by one"),
        ({"motion_blur_px": 1.1}, "Motion blur"),
        ({"video_motion_px": 12.1}, "Motion between"),
    ],
)
def test_what_is_missed_is_said(change: dict[str, Any], name: str) -> None:
    planned = made_planned()
    good = {"covered_enough": 1.0, "motion_blur_px": 1.0, "video_motion_px": 12.0, "forward_overlap": (0.791, 0.8)}
    well = replace(planned, plan=replace(planned.plan, summary=replace(planned.plan.summary, **good)))
    assert not any("missed" in line for line in summary_lines(well, made_request()))
    badly = replace(planned, plan=replace(planned.plan, summary=replace(planned.plan.summary, **{**good, **change})))
    missed = [line for line in summary_lines(badly, made_request()) if "missed" in line]
    assert len(missed) == 1
    assert missed[0].strip().startswith(name)
    assert [row[0] for row in key_table(badly, made_request()).rows if row[3] == "missed"] == [
        missed[0][2:].split("  ")[0]
    ]


def test_vertical_strips_go_up_and_down() -> None:
    plan = made_plan(strips=2, exposures=4)
    exposures = plan.exposures
    still = np.zeros(len(exposures))
    heights = 40.0 + np.array([0.0, 5.0, 10.0, 15.0, 15.0, 10.0, 5.0, 0.0])
    wall = replace(exposures, latitude_deg=still + 35.8, longitude_deg=still + 139.65, height_ellipsoid_m=heights)
    assert [row[2] for row in strips_table(replace(plan, exposures=wall)).rows] == ["up", "down"]


def test_sorties_and_strips_are_counted() -> None:
    plan = made_plan(strips=4, exposures=5, sorties=2)
    sorties = sorties_table(plan, (30, 31))
    assert [row[:3] for row in sorties.rows] == [("1", "1–2", "10"), ("2", "3–4", "10")]
    assert [row[-1] for row in sorties.rows] == ["30", "31"]
    strips = strips_table(plan)
    assert [row[2] for row in strips.rows] == ["30.0", "210.0", "30.0", "210.0"]
    assert [row[6] for row in strips.rows] == ["1", "1", "2", "2"]
    assert all(row[8] == "80.0" for row in strips.rows)


def test_summary_as_json(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    planned = made_planned(named(made_plan()))
    write_summary_json(path, planned, made_request())

    def refuse(text: str) -> float:
        raise AssertionError(f"{text} is not JSON")

    read = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    assert read["name"] == NASTY
    assert read["images"] == 15
    assert read["motion_blur_px"] is None
    assert read["forward_overlap"] == {"asked": 0.8, "least": 0.8, "mean": 0.8}
    assert read["gsd_m"] == {"least": 0.009, "mean": 0.01, "greatest": 0.011}
    assert [sortie["images"] for sortie in read["sorties"]] == [15]
    assert read["notes"][1] == "second note"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (percent(1.0), "100 %"),
        (percent(0.99999), "99.9 %"),
        (percent(float("nan")), "–"),
        (area_text(9999.0), "9999 m²"),
        (area_text(67500.0), "6.75 ha"),
        (area_text(1e7), "10.00 km²"),
        (duration_text(90.0), "1.5 min"),
        (duration_text(7260.0), "2 h 01 min"),
    ],
)
def test_texts(text: str, expected: str) -> None:
    assert text == expected
